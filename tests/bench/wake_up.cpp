// How late the loop of a scene wakes up for a step, by the ways to wait: prints CSV.
//
//     tensormass-bench-wake-up [ROUNDS [SECONDS]]
//
// The ways take turns, so that the load of the machine is the same for all. Each waits for steps at 1 kHz on the
// condition variable of the loop and then works for 0.3 ms, as a small scene does. Steps that a late one leaves no time
// for are skipped: wake_ups counts the others.

#include <pthread.h>
#include <sched.h>
#include <sys/prctl.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <condition_variable>
#include <cstdlib>
#include <mutex>
#include <thread>
#include <vector>

#include <fmt/format.h>

namespace {

using Clock = std::chrono::steady_clock;
using namespace std::chrono_literals;

constexpr auto kPeriod = 1ms;
constexpr auto kWork = 300us;

struct Way {
  const char* name;
  unsigned long slack_ns;  // the kernel's timers may be late by this; 50 µs by default
  bool realtime;           // SCHED_FIFO
  Clock::duration spin;    // the last stretch of the wait
};

constexpr std::array<Way, 6> kWays{{{"default", 50'000, false, 0us},
                                    {"timer slack 1 ns", 1, false, 0us},
                                    {"timer slack 1 ns, spin 100 us", 1, false, 100us},
                                    {"SCHED_FIFO", 1, true, 0us},
                                    {"SCHED_FIFO, spin 100 us", 1, true, 100us},
                                    {"timer slack 50 us, spin 100 us", 50'000, false, 100us}}};

void spin_until(Clock::time_point end) {
  while (Clock::now() < end) {
  }
}

/// Adds the lateness of each wake-up [us] in a thread of its own, because its scheduling must not last. Returns false
/// if the machine refuses real-time scheduling.
bool run(const Way& way, Clock::duration time, std::vector<double>& late_us) {
  bool allowed = true;
  std::thread([&] {
    prctl(PR_SET_TIMERSLACK, way.slack_ns);
    if (way.realtime) {
      sched_param parameters{};
      parameters.sched_priority = 30;
      allowed = pthread_setschedparam(pthread_self(), SCHED_FIFO, &parameters) == 0;
      if (!allowed) return;
    }
    std::mutex mutex;
    std::condition_variable wake;
    std::unique_lock lock(mutex);
    const auto end = Clock::now() + time;
    for (auto due = Clock::now() + kPeriod; due < end; due += kPeriod) {
      wake.wait_until(lock, due - way.spin, [] { return false; });
      spin_until(due);
      const auto now = Clock::now();
      late_us.push_back(std::chrono::duration<double, std::micro>(now - due).count());
      spin_until(now + kWork);
      while (due + kPeriod < Clock::now()) due += kPeriod;  // only waits count, not the debt of a late step
    }
  }).join();
  return allowed;
}

}  // namespace

int main(int argc, char** argv) {
  const int rounds = argc > 1 ? std::atoi(argv[1]) : 20;
  const auto time = std::chrono::milliseconds(argc > 2 ? 1000 * std::atoi(argv[2]) : 1000);
  std::array<std::vector<double>, kWays.size()> late_us;
  std::array<bool, kWays.size()> allowed{};
  for (int round = 0; round < rounds; ++round) {
    for (std::size_t i = 0; i < kWays.size(); ++i) allowed[i] = run(kWays[i], time, late_us[i]);
  }
  fmt::print("way,wake_ups,p50_us,p99_us,max_us\n");
  for (std::size_t i = 0; i < kWays.size(); ++i) {
    std::vector<double>& all = late_us[i];
    std::sort(all.begin(), all.end());
    if (!allowed[i] || all.empty()) {
      fmt::print("\"{}\",0,refused,refused,refused\n", kWays[i].name);
      continue;
    }
    fmt::print("\"{}\",{},{:.1f},{:.1f},{:.1f}\n", kWays[i].name, all.size(), all[all.size() / 2],
               all[all.size() * 99 / 100], all.back());
  }
}
