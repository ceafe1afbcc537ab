#include <algorithm>
#include <chrono>
#include <cstdio>
#include <thread>
#include <vector>

#include <CLI/CLI.hpp>

#include "step/plan.h"
#include "support/scenes.h"
#include "support/staged_scene.h"
#include "tensormass/v1/control.pb.h"

/// tensormass-bench-stages: time of each stage of a step on the CPU, and the rate at which it moves the plan's bytes.
/// The rate is also given relative to STREAM's triad in the same run.
namespace {

using namespace tensormass;
using Clock = std::chrono::steady_clock;

template <class Run>
double fastest_s(int repeats, const Run& run) {
  double best = 1e9;
  for (int i = 0; i < repeats; ++i) {
    const Clock::time_point begin = Clock::now();
    run();
    best = std::min(best, std::chrono::duration<double>(Clock::now() - begin).count());
  }
  return best;
}

double triad_bytes_per_s(std::uint32_t threads) {
  const std::size_t count = std::size_t{8} << 20;
  std::vector<double> a(count * threads, 1), b(count * threads, 2), c(count * threads, 3);
  const double seconds = fastest_s(10, [&] {
    std::vector<std::jthread> workers;
    for (std::uint32_t t = 0; t < threads; ++t) {
      workers.emplace_back([&, t] {
        for (std::size_t i = t * count; i < (t + 1) * count; ++i) a[i] = b[i] + 3 * c[i];
      });
    }
  });
  return 3.0 * sizeof(double) * static_cast<double>(count * threads) / seconds;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{"Stages of a step on the CPU: the beam of 307,200 tetrahedra, 50 CG iterations, float."};
  tests::Beam beam{.cells_x = 160, .cells_y = 20, .cells_z = 16};
  std::uint32_t threads = std::max(1u, std::thread::hardware_concurrency());
  int repeats = 10;
  app.add_option("--threads", threads);
  app.add_option("--cells-x", beam.cells_x);
  app.add_option("--repeats", repeats, "the fastest counts");
  app.add_flag("--linear", beam.linear);
  CLI11_PARSE(app, argc, argv);

  tests::StagedScene<float> staged(tests::beam_scene(beam), threads);
  for (int i = 0; i < 3; ++i) staged.step();
  const double triad = triad_bytes_per_s(threads);
  const double slots = staged.model.layout.slot_count();
  std::printf("%u threads, triad %.1f GB/s, %.0f slots, %.1f %% of them padding\n", threads, triad / 1e9, slots,
              100 *
                  static_cast<double>(std::count(staged.model.layout.neighbour_rows.begin(),
                                                 staged.model.layout.neighbour_rows.end(), mesh::kNone)) /
                  slots);
  std::printf("%-42s %10s %10s %10s %10s\n", "stage", "ms", "MB", "GB/s", "of triad");
  // Whole steps, so that each stage finds the caches as the stages before it leave them.
  const std::vector<step::Stage> stages = step::list_stages(staged.model);
  const auto is_timed = [&](std::size_t i) {
    return stages[i].info->phase != step::Phase::kDiagnostics && stages[i].info->phase != step::Phase::kFrame;
  };
  std::vector<double> best(stages.size(), 1e9);
  for (int repeat = 0; repeat < repeats; ++repeat) {
    for (std::size_t i = 0; i < stages.size(); ++i) {
      if (!is_timed(i)) continue;
      best[i] = std::min(best[i], fastest_s(1, [&] { staged.run(stages[i]); }));
    }
  }
  const v1::SceneReport report = step::make_report(staged.model, {});
  double total = 0;
  for (std::size_t i = 0; i < stages.size(); ++i) {
    if (!is_timed(i)) continue;
    const v1::PlanStage& planned = report.stages(static_cast<int>(i));
    const bool solve = step::costs_an_iteration(*stages[i].info);
    const double seconds = best[i] / (solve ? staged.model.cg_max_iterations : 1);
    const double rate = static_cast<double>(planned.bytes()) / seconds;
    std::printf("%-42s %10.3f %10.2f %10.1f %9.0f %%\n", (planned.name() + (solve ? ", an iteration" : "")).c_str(),
                seconds * 1e3, static_cast<double>(planned.bytes()) / 1e6, rate / 1e9, 100 * rate / triad);
    total += best[i];
  }
  std::printf("%-42s %10.3f\n", "together", total * 1e3);
  return 0;
}
