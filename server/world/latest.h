#pragma once

#include <array>
#include <atomic>
#include <cstdint>

namespace tensormass::world {

/// A mailbox that keeps the newest value, for one writer and one reader. Neither waits for the other: of three slots
/// one is the writer's, one the reader's, and the third changes hands.
template <class T>
class Latest {
 public:
  Latest() = default;
  /// All three slots start as copies of `initial`, so that a T with buffers of its own never allocates later.
  explicit Latest(const T& initial) : slots_{initial, initial, initial} {}

  /// The slot to fill before `publish`. Holds whatever an earlier round left in it.
  T& writing() { return slots_[writing_]; }
  /// True if the value before it was never read.
  bool publish() {
    const std::uint32_t before = shared_.exchange(writing_ | kFresh, std::memory_order_acq_rel);
    writing_ = before & kIndex;
    return (before & kFresh) != 0;
  }

  /// The newest value if there is one since the last call, else nullptr. Stays valid until the next call.
  const T* take() {
    if ((shared_.load(std::memory_order_relaxed) & kFresh) == 0) return nullptr;
    reading_ = shared_.exchange(reading_, std::memory_order_acq_rel) & kIndex;
    return &slots_[reading_];
  }

 private:
  static constexpr std::uint32_t kFresh = 4, kIndex = 3;
  std::array<T, 3> slots_{};
  std::uint32_t writing_ = 0;
  std::uint32_t reading_ = 1;
  std::atomic<std::uint32_t> shared_{2};
};

}  // namespace tensormass::world
