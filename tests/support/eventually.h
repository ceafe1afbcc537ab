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
    std::this_thread::sleep_for(std::chrono::milliseconds(1));  // leaves the core to what is waited for
  }
  return true;
}

}  // namespace tensormass::tests
