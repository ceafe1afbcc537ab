#pragma once

#include <array>
#include <atomic>
#include <cstdint>

#include "core/assert.h"

namespace tensormass::world {

/// A mailbox that keeps the newest value, for one writing thread and one reading thread. Neither waits for the other.
///
/// Two slots are not enough: a writer with a new value would have to wait until the reader lets go of the old one. So
/// there are three, and an atomic number says which one is between the two threads:
///
///     writer                     shared                      reader
///     fills slots_[writing_]     slots_[shared_ & kIndex]    reads slots_[reading_]
///         publish: exchange writing_ and shared_, set kFresh
///                                take: exchange reading_ and shared_ if kFresh is set, clear kFresh
///
/// The three indices are always different. A value that was published and not taken before the next `publish` is
/// dropped. One atomic exchange orders the slot's contents: the side that lets go of a slot releases its writes, and
/// the side that receives it acquires them.
template <class T>
class Latest {
 public:
  Latest() = default;
  /// Starts with three copies of `initial`, so that a T with buffers of its own need not allocate later.
  explicit Latest(const T& initial) : slots_{initial, initial, initial} {}

  /// Writer: the slot to fill before `publish`. Still holds a value from an earlier round.
  T& writing() { return slots_[writing_]; }
  /// Writer: makes the filled slot the newest. Returns true if this drops a value that was never taken.
  bool publish() {
    const std::uint32_t before = shared_.exchange(writing_ | kFresh, std::memory_order_acq_rel);
    TM_ASSERT((before & kIndex) < 3 && (before & kIndex) != writing_,
              "the shared slot is not the writer's; is there a second writer?");
    writing_ = before & kIndex;
    return (before & kFresh) != 0;
  }

  /// Reader: the newest value if one was published since the last call, else nullptr. Valid until the next call.
  const T* take() {
    if ((shared_.load(std::memory_order_relaxed) & kFresh) == 0) return nullptr;
    const std::uint32_t before = shared_.exchange(reading_, std::memory_order_acq_rel);
    TM_ASSERT((before & kFresh) != 0 && (before & kIndex) < 3 && (before & kIndex) != reading_,
              "a fresh slot stays fresh until its one reader takes it; is there a second reader?");
    reading_ = before & kIndex;
    return &slots_[reading_];
  }

 private:
  static constexpr std::uint32_t kFresh = 4;  // bit of shared_: published and not yet taken
  static constexpr std::uint32_t kIndex = 3;  // bits of shared_: index of the slot between the threads
  std::array<T, 3> slots_{};
  std::uint32_t writing_ = 0;
  std::uint32_t reading_ = 1;
  std::atomic<std::uint32_t> shared_{2};
};

}  // namespace tensormass::world
