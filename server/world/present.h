#pragma once

#include <memory>
#include <mutex>
#include <utility>

namespace tensormass::world {

/// A value that one thread replaces while others use it. Whoever got it keeps it until the end of its work.
///
/// No step waits: the loop takes the mutex only when it replaces the value, and readers hold it to copy a pointer.
template <class T>
class Present {
 public:
  explicit Present(std::shared_ptr<const T> value) : value_(std::move(value)) {}

  std::shared_ptr<const T> get() const {
    const std::lock_guard lock(mutex_);
    return value_;
  }
  /// Returns the value before, so that the caller decides where it ends.
  std::shared_ptr<const T> replace(std::shared_ptr<const T> next) noexcept {
    const std::lock_guard lock(mutex_);
    value_.swap(next);
    return next;
  }

 private:
  mutable std::mutex mutex_;
  std::shared_ptr<const T> value_;  // guarded by mutex_
};

}  // namespace tensormass::world
