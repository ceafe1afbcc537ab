#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <thread>
#include <vector>

namespace tensormass {

/// Threads of a loop while a scene is compiled; the scenes that run keep the rest of the machine.
inline constexpr std::size_t kMaxCompileThreads = 8;

/// body(i) for each i below `count`, on several threads, in any order: for work that does not depend on it. Not for the
/// step loop. `body` must not throw.
template <class Body>
void parallel_for(std::size_t count, const Body& body) {
  const std::size_t machine = std::max(1u, std::thread::hardware_concurrency());
  const std::size_t threads = std::min({count, machine, kMaxCompileThreads});
  std::atomic<std::size_t> next{0};
  const auto work = [&] {
    for (std::size_t i = next.fetch_add(1); i < count; i = next.fetch_add(1)) body(i);
  };
  std::vector<std::jthread> others;
  for (std::size_t t = 1; t < threads; ++t) others.emplace_back(work);
  work();
}

/// The same by ranges: body(begin, end), each of `grain` indices.
template <class Body>
void parallel_ranges(std::size_t count, std::size_t grain, const Body& body) {
  parallel_for((count + grain - 1) / grain, [&](std::size_t i) { body(i * grain, std::min(count, (i + 1) * grain)); });
}

}  // namespace tensormass
