#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <thread>
#include <vector>

#include <fmt/format.h>
#include <CLI/CLI.hpp>

#include "backend/backend.h"
#include "backend/devices.h"
#include "bench/floor.h"
#include "model/compile.h"
#include "step/plan.h"
#include "support/laws.h"
#include "support/scenes.h"
#include "world/placement.h"
#include "world/runner.h"
#include "world/world.h"

/// tensormass-bench: milliseconds a step on scenes that anyone can rebuild, with their floor.
namespace {

using namespace tensormass;
using Clock = std::chrono::steady_clock;

struct Case {
  std::string name;
  v1::Scene scene;
  double target_s = 0;         ///< time of a step; 0: no target
  bool target_is_p99 = false;  ///< false: the target is for the median
  bool checks_volume = true;   ///< false: without the guard's check of volumes
};

/// A beam of x × y × z cells that takes exactly 50 CG iterations a step.
v1::Scene beam(std::uint32_t x, std::uint32_t y, std::uint32_t z, bool linear, bool double_precision) {
  tests::Beam beam;
  beam.cells_x = x;
  beam.cells_y = y;
  beam.cells_z = z;
  beam.linear = linear;
  beam.double_precision = double_precision;
  return tests::beam_scene(beam);
}

/// The beam of 43,200 tetrahedra with every law, and its 7,200 cells in every shape and quadrature.
std::vector<Case> family() {
  std::vector<Case> cases;
  const auto add = [&](const std::string& name, v1::Shape shape, const std::string& law, v1::Quadrature quadrature) {
    v1::Scene scene = beam(60, 12, 10, false, false);
    v1::Body& body = *scene.mutable_bodies(0);
    body.mutable_mesh()->mutable_grid()->set_shape(shape);
    *body.mutable_law() = tests::law(law, 1e6, 0.4);
    body.set_quadrature(quadrature);
    cases.push_back({name, std::move(scene)});
  };
  for (const std::string& law : tests::law_names()) {
    add("tetrahedra, " + law, v1::SHAPE_TETRAHEDRON, law, v1::QUADRATURE_FULL);
  }
  for (const auto& [quadrature, name] :
       {std::pair{v1::QUADRATURE_FULL, "full"}, std::pair{v1::QUADRATURE_SELECTIVE, "selective"},
        std::pair{v1::QUADRATURE_REDUCED, "reduced"}}) {
    add(fmt::format("pyramids, StVK, {}", name), v1::SHAPE_PYRAMID, "st_venant_kirchhoff", quadrature);
    add(fmt::format("wedges, StVK, {}", name), v1::SHAPE_WEDGE, "st_venant_kirchhoff", quadrature);
    add(fmt::format("hexahedra, StVK, {}", name), v1::SHAPE_HEXAHEDRON, "st_venant_kirchhoff", quadrature);
    add(fmt::format("quadratic, StVK, {}", name), v1::SHAPE_QUADRATIC_TETRAHEDRON, "st_venant_kirchhoff", quadrature);
  }
  add("hexahedra, corotational", v1::SHAPE_HEXAHEDRON, "corotational", v1::QUADRATURE_FULL);
  return cases;
}

/// The targets for one H200 (docs/performance.md).
std::vector<Case> gpu_suite() {
  const auto hexahedra = [](const std::string& law) {
    v1::Scene scene = beam(160, 20, 16, false, false);
    scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(v1::SHAPE_HEXAHEDRON);
    *scene.mutable_bodies(0)->mutable_law() = tests::law(law, 1e6, 0.4);
    return scene;
  };
  v1::Scene million = beam(236, 30, 24, false, false);
  million.mutable_stepping()->set_dt_s(1e-3);
  million.mutable_solver()->set_cg_tolerance(1e-3);
  return {{"beam 307200 StVK", beam(160, 20, 16, false, false), 0.25e-3},
          {"beam 307200 Hooke", beam(160, 20, 16, true, false), 0.19e-3},
          {"beam 43200 StVK", beam(60, 12, 10, false, false), 0.13e-3},
          {"beam 2457600 StVK", beam(320, 40, 32, false, false), 2.5e-3},
          {"beam 1019520 StVK, dt 1 ms, to 1e-3", million, 1e-3, true},
          {"51200 hexahedra, corotational", hexahedra("corotational")},
          {"51200 hexahedra, StVK", hexahedra("st_venant_kirchhoff")}};
}

/// Cost of the volume check: each case with and without it, in turns because machines drift.
std::vector<Case> guards() {
  std::vector<Case> cases;
  for (const Case& one : gpu_suite()) {
    if (one.name.find("StVK") == std::string::npos) continue;
    for (int turn = 1; turn <= 3; ++turn) {
      cases.push_back({fmt::format("{}, checked {}", one.name, turn), one.scene});
      cases.push_back({fmt::format("{}, unchecked {}", one.name, turn), one.scene, 0, false, false});
    }
  }
  return cases;
}

/// Step time against elements, up to the most that a scene may have (core/limits.h).
std::vector<Case> sizes() {
  std::vector<Case> cases;
  for (const std::array<std::uint32_t, 3> cells : {std::array{24u, 3u, 2u},
                                                   {40u, 5u, 4u},
                                                   {64u, 8u, 6u},
                                                   {100u, 12u, 10u},
                                                   {160u, 20u, 16u},
                                                   {236u, 30u, 24u},
                                                   {320u, 40u, 32u},
                                                   {590u, 73u, 58u},
                                                   {880u, 110u, 86u}}) {
    const std::uint32_t count = cells[0] * cells[1] * cells[2] * 6;
    cases.push_back({fmt::format("size {} StVK", count), beam(cells[0], cells[1], cells[2], false, false)});
  }
  return cases;
}

/// Scenes of up to 20 million tetrahedra at 60 Hz.
std::vector<Case> largest() {
  std::vector<Case> cases;
  for (const std::array<std::uint32_t, 3> cells :
       {std::array{480u, 60u, 48u}, {560u, 70u, 56u}, {590u, 73u, 58u}, {652u, 80u, 64u}}) {
    const std::uint32_t count = cells[0] * cells[1] * cells[2] * 6;
    v1::Scene scene = beam(cells[0], cells[1], cells[2], false, false);
    scene.mutable_stepping()->set_dt_s(1.0 / 60);
    scene.mutable_solver()->set_cg_max_iterations(30);
    cases.push_back({fmt::format("60 Hz, {} StVK, 30 iterations", count), std::move(scene), 1.0 / 60});
  }
  return cases;
}

struct Measured {
  double median_s = 0, p99_s = 0, min_s = 0;
};

Measured percentiles(std::vector<double> seconds) {
  std::sort(seconds.begin(), seconds.end());
  return {seconds[seconds.size() / 2], seconds[seconds.size() * 99 / 100], seconds.front()};
}

struct Row {
  std::string name, backend, device;
  std::uint64_t elements = 0, nodes = 0;
  std::uint32_t patches = 0, iterations = 0, steps = 0;
  std::uint32_t restarts = 0;  ///< restarts from rest after a guard stopped the scene
  double compile_s = 0, floor_s = 0, iteration_s = 0;
  double bytes_per_element = 0;
  double target_s = 0;
  bool target_is_p99 = false;
  Measured step{};

  double times_floor() const { return step.median_s / floor_s; }
  bool meets_target() const { return (target_is_p99 ? step.p99_s : step.median_s) <= target_s; }
};

void leave_volumes_unchecked(model::Model& model) {
  for (model::ElementGroup& group : model.groups) group.checks_volume = group.solve_checks_volume = false;
  model.checked = {};
}

Result<Measured> time_steps(const Case& one, const backend::Backend& backend, std::uint32_t steps, Row& row) {
  const v1::Scene& scene = one.scene;
  const Clock::time_point begin = Clock::now();
  TM_ASSIGN_OR_RETURN(model, model::compile(scene, backend.patch_policy(model::requested_cpu_threads(scene))));
  if (!one.checks_volume) leave_volumes_unchecked(model);
  const v1::SceneReport report = step::make_report(model, backend.rates(model::requested_cpu_threads(scene)));
  row.elements = model.bodies[0].element_count;
  row.nodes = model.bodies[0].node_count;
  row.patches = model.layout.patch_count;
  row.bytes_per_element = static_cast<double>(report.bytes_total()) / static_cast<double>(row.elements);
  row.floor_s = bench::floor_bytes(model);  // divided by the bandwidth when the row is written
  TM_ASSIGN_OR_RETURN(world, world::World::create(std::make_unique<model::Model>(std::move(model)), backend));
  row.compile_s = std::chrono::duration<double>(Clock::now() - begin).count();
  // A St-Venant-Kirchhoff beam that falls for long inverts, and its guard stops it. It then restarts from rest. Neither
  // that step nor a retried one is a sample.
  const auto sample = [&](std::uint32_t count) -> Result<std::vector<double>> {
    std::vector<double> seconds;
    for (std::uint32_t tried = 0; seconds.size() < count; ++tried) {
      if (tried > 2 * count + 10) return invalid("more than half of the steps leave the bounds of the guards");
      const Clock::time_point start = Clock::now();
      const bool good = world->step(false);
      const double elapsed_s = std::chrono::duration<double>(Clock::now() - start).count();
      if (good && world->guard_event() == nullptr) seconds.push_back(elapsed_s);
      if (!good) world->reset();
      if (!good) ++row.restarts;
    }
    return seconds;
  };
  TM_RETURN_IF_ERROR(sample(3));
  TM_ASSIGN_OR_RETURN(seconds, sample(steps));
  row.iterations = world->last().cg_iterations;
  const Measured measured = percentiles(seconds);
  // Time of an iteration: the difference to the same scene with ten iterations.
  constexpr std::uint32_t kFew = 10;
  if (scene.solver().cg_tolerance() == 0 && row.iterations > kFew) {
    world->set_cg_limit(kFew);
    TM_ASSIGN_OR_RETURN(shorter, sample(std::max(steps / 2, 5u)));
    row.iteration_s = (measured.median_s - percentiles(shorter).median_s) / (row.iterations - kFew);
  }
  return measured;
}

/// Options of scenes that run in real time. The first tool of each moves to `press` and back every two seconds.
struct RealTime {
  std::string scene_file;
  std::uint32_t copies = 0;  ///< concurrent copies of `station()` instead of a file
  double rate_hz = 0;        ///< 0: the scene's own
  double seconds = 10;
  bool together = false;        ///< no scene steps before all are loaded
  std::uint32_t lag_steps = 0;  ///< Solver.tangent_lag_steps; 0: the scene's own
  std::vector<double> press;
};

/// One of many concurrent scenes: 20,520 St-Venant-Kirchhoff tetrahedra under a probe, 1000 steps a second.
v1::Scene station() {
  v1::Scene scene = tests::block_with_probe();
  v1::Grid& grid = *scene.mutable_bodies(0)->mutable_mesh()->mutable_grid();
  grid.set_cells_x(19);
  grid.set_cells_y(10);
  grid.set_cells_z(18);
  scene.mutable_stepping()->set_rate_hz(1000);
  scene.mutable_stepping()->set_dt_s(1e-3);
  scene.mutable_solver()->set_cg_tolerance(1e-3);
  return scene;
}
const std::vector<double> kStationPress{0.05, 0.053, 0.05};  // 7 mm into the tissue

Result<v1::Scene> read_scene(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  v1::Scene scene;
  if (!scene.ParseFromIstream(&file)) {
    return invalid(
        path + ": not a serialized tensormass.v1.Scene; write one in Python with scene.message.SerializeToString()");
  }
  return scene;
}

/// Sends poses of the path to every runner until `end`, at 1 kHz like a haptic device. The devices take turns within a
/// millisecond: a step starts with its pose, and hands of several people do not move at the same instants.
void press_and_lift(std::span<const std::unique_ptr<world::Runner>> runners, const v1::Tool& tool,
                    const RealTime& options, Clock::time_point end) {
  const Clock::time_point begin = Clock::now();
  v1::ToolPose pose;
  const auto period = std::chrono::duration_cast<Clock::duration>(std::chrono::milliseconds(1));
  const auto count = static_cast<Clock::rep>(runners.size());
  for (Clock::rep turn = 0; Clock::now() < end; ++turn) {
    const Clock::time_point due = begin + turn * period / count;
    std::this_thread::sleep_until(due);
    const double t = std::chrono::duration<double>(due - begin).count();
    const double down = 0.5 - 0.5 * std::cos(M_PI * t);
    const auto mix = [&](double from, std::size_t c) { return from + down * (options.press[c] - from); };
    pose.set_sequence(static_cast<std::uint64_t>(turn / count) + 1);
    pose.set_client_id(1);
    tests::set(*pose.mutable_position_m(), mix(tool.position_m().x(), 0), mix(tool.position_m().y(), 1),
               mix(tool.position_m().z(), 2));
    (void)runners[static_cast<std::size_t>(turn % count)]->submit_pose(tool.name(), pose);
  }
}

/// One status for all runners: sums of counts, and times of the slowest.
v1::SceneStatus of_all(std::span<const std::unique_ptr<world::Runner>> runners) {
  v1::SceneStatus status = runners.front()->status();
  for (std::size_t i = 1; i < runners.size(); ++i) {
    const v1::SceneStatus other = runners[i]->status();
    status.set_step(status.step() + other.step());
    status.set_missed_deadlines(status.missed_deadlines() + other.missed_deadlines());
    status.set_reached_rate_hz(std::min(status.reached_rate_hz(), other.reached_rate_hz()));
    status.set_step_time_p50_s(std::max(status.step_time_p50_s(), other.step_time_p50_s()));
    status.set_step_time_p99_s(std::max(status.step_time_p99_s(), other.step_time_p99_s()));
    status.set_step_time_max_s(std::max(status.step_time_max_s(), other.step_time_max_s()));
    if (status.fault().empty()) status.set_fault(other.fault());
  }
  return status;
}

Result<std::string> run_in_real_time(const RealTime& options, world::RunnerOptions runner_options,
                                     const std::string& commit, const std::string& command) {
  v1::Scene scene = station();
  if (options.copies == 0) {
    TM_ASSIGN_OR_RETURN(read, read_scene(options.scene_file));
    scene = read;
  }
  scene.mutable_stepping()->set_lockstep(false);
  if (options.lag_steps > 0) scene.mutable_solver()->set_tangent_lag_steps(options.lag_steps);
  if (options.rate_hz > 0) {
    scene.mutable_stepping()->set_rate_hz(options.rate_hz);
    scene.mutable_stepping()->set_dt_s(1 / options.rate_hz);
  }
  const Clock::time_point begin = Clock::now();
  std::vector<std::unique_ptr<world::Runner>> runners;
  for (std::uint32_t i = 0; i < std::max(options.copies, 1u); ++i) {
    TM_ASSIGN_OR_RETURN(runner, world::Runner::start(scene, runner_options));
    if (options.together) TM_RETURN_IF_ERROR(runner->pause());
    runners.push_back(std::move(runner));
  }
  for (const auto& runner : runners) {
    if (options.together) TM_RETURN_IF_ERROR(runner->resume());
  }
  const double ready_s = std::chrono::duration<double>(Clock::now() - begin).count();
  const double dt_s = scene.stepping().has_dt_s() ? scene.stepping().dt_s() : 1.0 / 60;
  TM_ASSIGN_OR_RETURN(description, world::describe_backend(runner_options.backend));
  // Scenes that load delay those that already run; deadlines missed meanwhile are counted separately.
  constexpr std::chrono::seconds kSettling{1};
  const Clock::time_point settled = Clock::now() + kSettling;
  const Clock::time_point end =
      settled + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(options.seconds));
  double largest_force_n = 0;
  v1::SceneStatus before;
  std::thread watcher([&] {
    std::this_thread::sleep_until(settled);
    before = of_all(runners);
    while (Clock::now() < end) {
      const v1::SceneStatus status = runners.front()->status();
      for (const v1::ToolFeedback& tool : status.tools()) {
        const v1::Vector3& f = tool.force_n();
        largest_force_n = std::max(largest_force_n, std::sqrt(f.x() * f.x() + f.y() * f.y() + f.z() * f.z()));
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
  });
  if (scene.tools_size() > 0 && options.press.size() == 3) press_and_lift(runners, scene.tools(0), options, end);
  watcher.join();
  const v1::SceneStatus status = of_all(runners);
  // Otherwise each scene that ends competes for the driver's lock with all that still step, which takes minutes if the
  // device is behind.
  for (const auto& runner : runners) TM_RETURN_IF_ERROR(runner->pause());
  std::map<std::uint32_t, std::uint32_t> scenes_of_device;
  for (const auto& runner : runners) ++scenes_of_device[runner->device()];
  std::string placed;
  for (const auto& [device, scenes] : scenes_of_device)
    placed += fmt::format("{}{}", placed.empty() ? "" : ",", scenes);
  return fmt::format(
      R"({{"case":"real time: {}","scenes":{},"scenes_of_device":[{}],"backend":"{}","device":"{}","commit":"{}","command":"{}","elements":{},"dt_ms":{:.4f},)"
      R"("target_rate_hz":{:.1f},"reached_rate_hz":{:.1f},"steps":{},"missed_deadlines":{},"missed_while_loading":{},)"
      R"("step_ms_median":{:.4f},"step_ms_p99":{:.4f},"step_ms_max":{:.4f},"cg_iterations_last":{},"largest_force_n":{:.3f},"ready_s":{:.3f},"fault":"{}"}})",
      scene.name(), runners.size(), placed, description.backend, description.device, commit, command,
      runners.front()->report().bodies(0).element_count(), dt_s * 1e3, status.target_rate_hz(),
      status.reached_rate_hz(), status.step() - before.step(), status.missed_deadlines() - before.missed_deadlines(),
      before.missed_deadlines(), status.step_time_p50_s() * 1e3, status.step_time_p99_s() * 1e3,
      status.step_time_max_s() * 1e3, status.cg_iterations(), largest_force_n, ready_s, status.fault());
}

std::string json(const Row& row, const std::string& commit, const std::string& command, double bandwidth) {
  return fmt::format(
      R"({{"case":"{}","backend":"{}","device":"{}","commit":"{}","command":"{}","elements":{},"nodes":{},"patches":{},)"
      R"("steps":{},"restarts":{},"cg_iterations":{},"step_ms_median":{:.4f},"step_ms_p99":{:.4f},"step_ms_min":{:.4f},)"
      R"("cg_iteration_us":{:.3f},"floor_ms":{:.4f},"ratio_to_floor":{:.2f},"achieved_gb_per_s":{:.1f},"bandwidth_gb_per_s":{:.1f},"ready_s":{:.3f},)"
      R"("bytes_per_element":{:.1f},"target_ms":{:.3f},"target_met":{}}})",
      row.name, row.backend, row.device, commit, command, row.elements, row.nodes, row.patches, row.steps, row.restarts,
      row.iterations, row.step.median_s * 1e3, row.step.p99_s * 1e3, row.step.min_s * 1e3, row.iteration_s * 1e6,
      row.floor_s * 1e3, row.times_floor(), bandwidth / row.times_floor() / 1e9, bandwidth / 1e9, row.compile_s,
      row.bytes_per_element, row.target_s * 1e3,
      row.target_s == 0    ? "null"
      : row.meets_target() ? "true"
                           : "false");
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app{
      "Milliseconds a step on beams that anyone can rebuild: 8 x 1 x 0.8 m, E 1 MPa, nu 0.4, 50 CG iterations."};
  std::string backend_name, output, commit = "unknown";
  std::uint32_t steps = 0, threads = std::max(1u, std::thread::hardware_concurrency());
  std::string suite = "beams", only;
  bool small = false, of_family = false;
  app.add_option("--backend", backend_name, "cpu or cuda; default: cuda with --suite gpu, else cpu")
      ->check(CLI::IsMember({"cpu", "cuda"}));
  app.add_option("--steps", steps, "measured steps of each case; default: 500 with --suite gpu and largest, else 100")
      ->check(CLI::Range(1, 100000));
  app.add_option("--threads", threads, "CPU threads of a scene");
  app.add_option("--commit", commit, "written into the results");
  const auto* const wants_json =
      app.add_option("--json", output,
                     "append one JSON line a case to this file; without a file, print JSON instead of the table")
          ->expected(0, 1);
  app.add_flag("--small", small, "leave out the beams of more than 50,000 tetrahedra");
  app.add_option("--only", only, "cases whose names contain this");
  auto* const suites =
      app.add_option("--suite", suite,
                     "beams; gpu: the targets of docs/performance.md; sizes; largest at 60 Hz; guards: "
                     "cost of the volume check")
          ->check(CLI::IsMember({"beams", "gpu", "sizes", "largest", "guards"}));
  auto* const family_flag =
      app.add_flag("--family", of_family, "instead of beams of three sizes: every law, every shape, every quadrature");
  RealTime real_time;
  auto* const scene_file =
      app.add_option("--scene", real_time.scene_file, "instead of beams: a serialized scene, run in real time");
  bool unpaced = false;
  app.add_flag("--unpaced", unpaced, "with --scene: one step after the other, like the beams")
      ->needs(scene_file)
      ->excludes(suites)
      ->excludes(family_flag);
  app.add_option("--stations", real_time.copies,
                 "instead of --scene: concurrent scenes of 20,520 tetrahedra under a probe, 1 kHz");
  std::uint32_t devices = 1;
  app.add_option("--devices", devices, "with --stations: GPUs over which the scenes are placed")
      ->check(CLI::Range(1, 64));
  app.add_option("--rate", real_time.rate_hz, "with --scene: steps a second, dt = 1 / rate");
  app.add_option("--seconds", real_time.seconds, "with --scene or --stations")->check(CLI::Range(0.1, 3600.0));
  app.add_flag("--together", real_time.together, "with --stations: no scene steps before all are loaded");
  app.add_option("--lag", real_time.lag_steps, "with --scene or --stations: Solver.tangent_lag_steps");
  app.add_option("--press", real_time.press, "with --scene: position x y z to which the first tool presses [m]")
      ->expected(3);
  CLI11_PARSE(app, argc, argv);
  if (steps == 0) steps = suite == "gpu" || suite == "largest" ? 500 : 100;
  if (backend_name.empty()) backend_name = suite == "gpu" ? "cuda" : "cpu";
  const bool prints_table = wants_json->count() == 0 || !output.empty();
  std::ofstream results;
  if (!output.empty()) results.open(output, std::ios::app);
  const auto write_line = [&](const std::string& line) {
    if (!prints_table) std::printf("%s\n", line.c_str());
    if (!output.empty()) results << line << std::endl;
  };
  const auto wrote_all = [&] {
    if (results.good()) return true;
    std::fprintf(stderr, "--json: cannot write to '%s'\n", output.c_str());
    return false;
  };
  if (!wrote_all()) return 1;
  std::string command = "tensormass-bench";  // without the path of the results
  for (int i = 1; i < argc; ++i) {
    if (std::string_view(argv[i]) == "--json") {
      i += output.empty() ? 0 : 1;
    } else {
      command += std::string(" ") + argv[i];
    }
  }

  if (real_time.copies > 0) real_time.press = kStationPress;
  if ((!real_time.scene_file.empty() && !unpaced) || real_time.copies > 0) {
    const auto choice = backend_name == "cuda" ? world::BackendChoice::kCuda : world::BackendChoice::kCpu;
    world::RunnerOptions options{choice, threads, std::max(1u, (real_time.copies + devices - 1) / devices)};
    if (devices > 1) {
      std::vector<std::uint32_t> numbers = backend::list_cuda_devices();
      if (numbers.size() < devices) {
        std::fprintf(stderr, "--devices %u: there are %zu GPUs of a kind\n", devices, numbers.size());
        return 77;
      }
      numbers.resize(devices);
      options.placement = std::make_shared<world::Placement>(std::move(numbers));
    }
    const auto line = run_in_real_time(real_time, options, commit, command);
    if (!line) {
      std::fprintf(stderr, "%s\n", line.error().message.c_str());
      return line.error().code == ErrorCode::kUnavailable ? 77 : 1;
    }
    if (prints_table) std::printf("%s\n", line->c_str());
    write_line(*line);
    return wrote_all() ? 0 : 1;
  }

  std::unique_ptr<backend::Backend> backend;
  if (backend_name == "cuda") {
    auto cuda = backend::make_cuda_backend();
    if (!cuda) {
      std::fprintf(stderr, "SKIPPED: %s\n", cuda.error().message.c_str());
      return 77;
    }
    backend = std::move(*cuda);
  } else {
    backend = backend::make_cpu_backend(threads);
  }
  const double bandwidth = backend->measure_bandwidth_bytes_per_s();

  struct Size {
    std::uint32_t x, y, z;
  };
  std::vector<Case> cases;
  if (unpaced) {
    auto scene = read_scene(real_time.scene_file);
    if (!scene) {
      std::fprintf(stderr, "%s\n", scene.error().message.c_str());
      return 1;
    }
    cases.push_back({scene->name(), std::move(*scene)});
  }
  const bool beams = suite == "beams" && !of_family && !unpaced;
  if (of_family) cases = family();
  if (suite == "gpu") cases = gpu_suite();
  if (suite == "sizes") cases = sizes();
  if (suite == "largest") cases = largest();
  if (suite == "guards") cases = guards();
  for (const Size size : {Size{40, 9, 9}, Size{60, 12, 10}, Size{160, 20, 16}}) {
    if (!beams || (small && size.x > 60)) continue;
    const std::uint32_t count = size.x * size.y * size.z * 6;
    cases.push_back({fmt::format("beam {} StVK float", count), beam(size.x, size.y, size.z, false, false)});
    cases.push_back({fmt::format("beam {} Hooke float", count), beam(size.x, size.y, size.z, true, false)});
  }
  if (beams) cases.push_back({"beam 43200 StVK double", beam(60, 12, 10, false, true)});
  std::erase_if(cases, [&](const Case& one) { return one.name.find(only) == std::string::npos; });
  if (cases.empty()) {
    std::fprintf(stderr, "--only: no case has '%s' in its name\n", only.c_str());
    return 1;
  }

  if (prints_table) {
    std::printf("%s on %s, %.0f GB/s\n", backend->name().c_str(), backend->device().c_str(), bandwidth / 1e9);
    std::printf("%-36s %9s %8s %10s %10s %10s %8s %8s %12s %8s %9s %s\n", "case", "elements", "patches", "median ms",
                "p99 ms", "floor ms", "x floor", "GB/s", "us/iteration", "ready s", "B/element", "target ms");
  }
  for (Case& one : cases) {
    Row row{.name = one.name, .backend = backend->name(), .device = backend->device(), .steps = steps};
    row.target_s = one.target_s;
    row.target_is_p99 = one.target_is_p99;
    if (backend->name() == "cpu") row.steps = std::max(10u, steps / 5);
    const auto measured = time_steps(one, *backend, row.steps, row);
    if (!measured) {
      std::fprintf(stderr, "%s: %s\n", one.name.c_str(), measured.error().message.c_str());
      return 1;
    }
    row.step = *measured;
    row.floor_s /= bandwidth;
    const std::string target =
        row.target_s == 0 ? "" : fmt::format("{:.2f} {}", row.target_s * 1e3, row.meets_target() ? "met" : "missed");
    if (prints_table) {
      std::printf("%-36s %9lu %8u %10.3f %10.3f %10.3f %8.2f %8.0f %12.2f %8.2f %9.1f %s\n", row.name.c_str(),
                  row.elements, row.patches, row.step.median_s * 1e3, row.step.p99_s * 1e3, row.floor_s * 1e3,
                  row.times_floor(), bandwidth / row.times_floor() / 1e9, row.iteration_s * 1e6, row.compile_s,
                  row.bytes_per_element, target.c_str());
    }
    write_line(json(row, commit, command, bandwidth));
    std::fflush(stdout);
    if (!wrote_all()) return 1;
  }
  return 0;
}
