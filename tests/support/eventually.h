#pragma once

#include <chrono>
#include <thread>

namespace tensormass::tests {

/// Polls until `condition()` is true; returns false at the deadline, which matters in a broken build only. For
/// conditions without an event to wait for.
template <class Condition>
bool eventually(const Condition& condition, std::chrono::seconds limit) {
  const auto deadline = std::chrono::steady_clock::now() + limit;
  while (!condition()) {
    if (std::chrono::steady_clock::now() > deadline) return false;
    std::this_thread::yield();
  }
  return true;
}

}  // namespace tensormass::tests
