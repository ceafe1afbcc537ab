#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace tensormass {

/// Most threads that a loop uses while a scene is compiled. Running scenes keep the other cores.
inline constexpr std::size_t kMaxCompileThreads = 8;

/// Calls body for every index below `count`, on several threads and in any order. Returns when all calls are done. For
/// compiling scenes, not for the step loop: it starts threads. If a call throws, as without memory, no further ones are
/// made, and the first exception comes out of here.
///
///   body(i)   is called once for each i in [0, count), possibly at the same time for different i
template <class Body>
void parallel_for(std::size_t count, const Body& body) {
  const std::size_t machine = std::max(1u, std::thread::hardware_concurrency());
  const std::size_t threads = std::min({count, machine, kMaxCompileThreads});
  std::atomic<std::size_t> next{0};
  std::mutex mutex;
  std::exception_ptr thrown;  // guarded by mutex
  const auto work = [&] {
    try {
      for (std::size_t i = next.fetch_add(1); i < count; i = next.fetch_add(1)) body(i);
    } catch (...) {
      next.store(count);
      const std::lock_guard lock(mutex);
      if (!thrown) thrown = std::current_exception();
    }
  };
  {
    std::vector<std::jthread> others;
    others.reserve(threads);
    for (std::size_t t = 1; t < threads; ++t) others.emplace_back(work);
    work();
  }
  if (thrown) std::rethrow_exception(thrown);
}

/// Does the same for ranges of `grain` > 0 indices; the last range may be shorter.
///
///   body(begin, end)   is called once for each range [begin, end)
template <class Body>
void parallel_ranges(std::size_t count, std::size_t grain, const Body& body) {
  parallel_for((count + grain - 1) / grain, [&](std::size_t i) { body(i * grain, std::min(count, (i + 1) * grain)); });
}

}  // namespace tensormass
