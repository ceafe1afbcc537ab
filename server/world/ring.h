#pragma once

#include <atomic>
#include <cstddef>
#include <vector>

#include "core/assert.h"

namespace tensormass::world {

/// A bounded queue from one writing thread to one reading thread. Neither waits for the other, and no push allocates.
///
///     writer    room() -> back() = value -> push()         pushed_ counts up
///     reader    front() -> use it        -> pop()          popped_ counts up
///
///     filled slots: pushed_ - popped_, at most the capacity; slot of a count: count modulo the capacity
///
/// The thread that counts up releases the slot's contents, and the other one acquires them.
template <class T>
class Ring {
 public:
  explicit Ring(std::size_t capacity) : slots_(capacity) { TM_ASSERT(capacity > 0, "a ring has slots"); }

  // -- the writing thread ---------------------------------------------------------------------------------------------

  /// Number of slots that are free.
  std::size_t room() const {
    return slots_.size() - (pushed_.load(kRelaxed) - popped_.load(std::memory_order_acquire));
  }
  /// The slot that the next `push` hands over. Needs room.
  T& back() { return slots_[pushed_.load(kRelaxed) % slots_.size()]; }
  void push() {
    TM_ASSERT(room() > 0, "the writer looks for room before it pushes");
    pushed_.store(pushed_.load(kRelaxed) + 1, std::memory_order_release);
  }

  // -- the reading thread ---------------------------------------------------------------------------------------------

  /// Returns the oldest value, valid until `pop`. An empty ring returns nullptr.
  T* front() {
    const std::size_t popped = popped_.load(kRelaxed);
    return popped == pushed_.load(std::memory_order_acquire) ? nullptr : &slots_[popped % slots_.size()];
  }
  void pop() {
    TM_ASSERT(front() != nullptr, "the reader pops what it has read");
    popped_.store(popped_.load(kRelaxed) + 1, std::memory_order_release);
  }

 private:
  static constexpr std::memory_order kRelaxed = std::memory_order_relaxed;

  std::vector<T> slots_;
  std::atomic<std::size_t> pushed_{0}, popped_{0};
};

}  // namespace tensormass::world
