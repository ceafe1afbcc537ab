#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <fstream>
#include <memory>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

#include <fmt/format.h>

#include "backend/backend.h"
#include "backend/checkpoint.h"
#include "backend/cpu/arena.h"
#include "backend/cpu/elements.h"
#include "backend/cpu/team.h"
#include "backend/edited_state.h"
#include "backend/saved_state.h"
#include "backend/step_inputs.h"
#include "backend/step_reports.h"
#include "core/thread_name.h"
#include "model/bind.h"
#include "solver/coarse_level.h"
#include "solver/newton.h"
#include "solver/row_sums.h"
#include "step/run.h"

namespace tensormass::backend {

namespace {

/// Copies to buffers, the neighbouring ones in one.
class Copies final : public PreparedEdit {
 public:
  void add(std::byte* to, const void* from, std::size_t bytes) {
    if (copies_.empty() || copies_.back().to + copies_.back().bytes != to) copies_.push_back({to, from_.size(), 0});
    copies_.back().bytes += bytes;
    const auto* const first = static_cast<const std::byte*>(from);
    from_.insert(from_.end(), first, first + bytes);
  }
  void run() const {
    for (const Copy& copy : copies_) std::memcpy(copy.to, from_.data() + copy.from, copy.bytes);
  }

 private:
  struct Copy {
    std::byte* to;
    std::size_t from, bytes;
  };
  std::vector<Copy> copies_;
  std::vector<std::byte> from_;
};

template <class Real>
class CpuState final : public SceneState {
 public:
  explicit CpuState(const model::Model& model)
      : model_(model),
        stages_(step::list_stages(model)),
        bound_(model::bind<Real>(model, arena_)),
        coarse_(model::bind_coarse<Real>(model, arena_)),
        barrier_(view_.patches.patch_count),
        load_factors_(model) {
    for (const step::Stage& stage : stages_) phases_ |= command(stage.info->phase);
    for (std::size_t g = 0; g < model.groups.size(); ++g) {
      groups_.push_back(model::bind<Real>(model, g, arena_, &buffers_.emplace_back()));
      passes_.push_back(cpu::element_passes<Real>(model.groups[g].shape, model.groups[g].law));
    }
    try {
      for (std::uint32_t patch = 1; patch < view_.patches.patch_count; ++patch) {
        workers_.emplace_back([this, patch] { work(patch); });
      }
    } catch (...) {
      open_gate(Gate::kTooFew);
      for (std::thread& worker : workers_) worker.join();
      throw;
    }
    open_gate(Gate::kAllThere);
  }

  ~CpuState() override {
    command_ = kQuit;
    barrier_.arrive_and_wait();
    for (std::thread& worker : workers_) worker.join();
  }

  StepResult step(const StepInput& input, std::span<ToolForce> forces) override {
    write_tools(model_, input, view_.contact.samples, inputs_.tools);
    write_prescribed(model_, input, inputs_.prescribed);
    load_factors_.write(model_, input, inputs_.external, inputs_.faces);
    *inputs_.control = checkpoint_.begin(model_, input);
    StepResult result;
    if (model_.iterates()) {
      result = solver::newton_step<Real>(*this, model_.newton_max_iterations, model_.newton_tolerance,
                                         input.projects_stiffness, checkpoint_.largest_force_squared());
      if (model_.extrapolates()) result.take_motion(this->result());
      repeats(result);  // the guard makes the step again if it failed; it is then told to do without
      if (input.gather_visible) gather_visible();
    } else {
      run_linearized(input);
      result = this->result();
      while (repeats(result) && input.saves_checkpoint) {
        restore();
        *inputs_.control = checkpoint_.begin(model_, input);
        run_linearized(input);
        result = this->result();
      }
    }
    throw_if_stopped();
    read_forces<Real>({view_.contact.tool_loads, std::size_t{view_.contact.tool_count} * view_.patches.patch_count},
                      forces);
    result.min_det_f = read_volume<Real>(model_, result.min_det_f,
                                         {view_.guard.min_det_f, model_.groups.size() * view_.patches.patch_count});
    solver::read_links<Real>({view_.links.reports, view_.links.count() > 0 ? view_.patches.patch_count : 0}, result);
    solver::read_balance<Real>({view_.balance.reports, view_.balance.body_count}, result);
    checkpoint_.end(input);
    return result;
  }

  void restore() override {
    checkpoint_.restore(model_, view_, std::span<const view::ElementView<Real>>(groups_), copy);
  }

  void come_to_rest() override {
    checkpoint_.come_to_rest(view_, copy, [](std::size_t count, Real* to) { std::fill(to, to + count, Real(0)); });
  }

  std::span<const float> visible_positions() override {
    return {view_.surface.positions, 3 * std::size_t{view_.surface.vertex_count}};
  }
  void gather_visible() override { run(step::Phase::kFrame); }

  void apply(const model::ModelEdit& edit) override {
    model::for_each_write<Real>(model_, edit.ranges, bound_.buffers, buffers_,
                                [](void* to, const void* from, std::size_t bytes) { std::memcpy(to, from, bytes); });
    for (const std::uint32_t row : edit.held_rows) hold_row(view_, row);
    for (const std::uint32_t spring : edit.severed) view_.links.broken[spring] = view::kSpringBroken;
    for (std::uint32_t i = 0; view_.contact.slips != nullptr && i < slips_of_triangle(view_.contact); ++i) {
      for (const auto& [from, to] : edit.moved_triangles) move_slip(view_.contact, i, from, to);
    }
    if (edit.changes_loads) load_factors_.forget(model_);
    checkpoint_.lag().forget();
  }
  std::unique_ptr<PreparedEdit> prepare(const model::Model& next,
                                        const std::vector<model::EditRange>& ranges) const override {
    auto out = std::make_unique<Copies>();
    model::for_each_write<Real>(
        next, ranges, bound_.buffers, buffers_,
        [&](void* to, const void* from, std::size_t bytes) { out->add(static_cast<std::byte*>(to), from, bytes); });
    return out;
  }
  void apply(const PreparedEdit& edit) override {
    static_cast<const Copies&>(edit).run();
    checkpoint_.lag().forget();
  }
  std::vector<ConstantBuffer> read_constants() override {
    std::vector<ConstantBuffer> all;
    for (const cpu::Arena::Constant& one : arena_.constants()) {
      const auto* const begin = static_cast<const std::byte*>(one.items);
      all.push_back({one.name, {begin, begin + one.bytes}});
    }
    return all;
  }

  void read_broken(std::span<std::uint8_t> broken) override {
    copy_broken(std::span<const Real>(view_.links.broken, view_.links.spring_count), broken);
  }

  void read_blades(std::span<BladeFront> fronts) override {
    copy_blades<Real>({view_.links.blades.reports, view_.links.blades.point_count}, fronts);
  }

  void diagnose(std::span<GroupDiagnostics> groups) override {
    run(step::Phase::kDiagnostics);
    read_diagnostics<Real>({view_.guard.diagnostics, groups.size() * view_.patches.patch_count}, groups);
  }

  RowState read() override {
    return read_state(model_, view_, std::span<const view::ElementView<Real>>(groups_), checkpoint_.internal_dt_s(),
                      [](const Real* from, std::size_t count) { return std::vector<double>(from, from + count); });
  }
  void write(const RowState& state) override {
    write_state(model_, view_, std::span<const view::ElementView<Real>>(groups_), state,
                [](Real* to, std::span<const double> from) {
                  std::transform(from.begin(), from.end(), to, [](double value) { return static_cast<Real>(value); });
                });
    checkpoint_.start_anew(state.internal_dt_s);
  }
  StepHistory read_history() override {
    return backend::read_history(
        view_, checkpoint_.past(), checkpoint_.coarse().state(),
        [](const Real* from, std::size_t count) { return std::vector<double>(from, from + count); });
  }
  void write_history(const StepHistory& history) override {
    backend::write_history(view_, history, [](Real* to, std::span<const double> from) {
      std::transform(from.begin(), from.end(), to, [](double value) { return static_cast<Real>(value); });
    });
    checkpoint_.go_on(history);
  }

  // solver::newton_step calls these.
  void begin() { run(step::Phase::kBegin); }
  void evaluate() {
    choose_level();
    run(step::Phase::kEvaluate);
  }
  void solve() {
    run(step::Phase::kSolve);
    take_solve();
  }
  void backtrack() { run(step::Phase::kBacktrack); }
  void end() { run(step::Phase::kEnd); }
  view::NewtonControl& control() { return *inputs_.newton; }
  solver::NewtonResidual residual() const {
    return solver::read_residual<Real>({view_.newton.residuals, view_.patches.patch_count});
  }
  StepResult result() const {
    return solver::read_step<Real>(*view_.solve.report, inputs_.control->cg_max_iterations,
                                   {view_.guard.patch_reports, view_.patches.patch_count});
  }

 private:
  static void copy(const Real* from, std::size_t count, Real* to) { std::copy(from, from + count, to); }
  /// The phases that the team must run, one bit each, and a bit to quit.
  using Command = unsigned;
  static constexpr Command command(step::Phase phase) { return 1u << static_cast<unsigned>(phase); }
  static constexpr Command kQuit = 1u << step::kPhases;
  static constexpr Command kWholeStep = command(step::Phase::kBegin) | command(step::Phase::kEvaluate) |
                                        command(step::Phase::kSolve) | command(step::Phase::kEnd);

  void run(step::Phase phase) { run_team(command(phase)); }
  /// Runs a step that is linearized once.
  void run_linearized(const StepInput& input) {
    choose_level();
    run_team(kWholeStep | (input.gather_visible ? command(step::Phase::kFrame) : 0));
    take_solve();
  }
  void choose_level() { uses_coarse_ = coarse_.aggregate_count > 0 && checkpoint_.coarse().is_on(model_); }
  void take_solve() {
    const view::SolveReport<Real>& solve = *view_.solve.report;
    const double error = solver::missing_share(solve, inputs_.control->cg_max_iterations);
    checkpoint_.coarse().take_solve(solve.iterations, error, kCoarseByStages);
  }
  bool repeats(const StepResult& result) {
    return coarse_.aggregate_count > 0 && checkpoint_.coarse().repeats(model_, result, uses_coarse_);
  }
  /// The calling thread is patch 0. A barrier starts the team and one ends each stage. Without a stage there would be
  /// none after the first, and the caller could write its next command before a worker has read this one.
  void run_team(Command what) {
    what &= phases_;
    if (what == 0) return;
    command_ = what;
    barrier_.arrive_and_wait();
    run_patch(0, what);
  }

  /// Workers wait at the gate until all of them exist, because the team's barrier needs every one. kTooFew: a thread
  /// could not be started, so they end.
  enum class Gate : std::uint8_t { kClosed, kAllThere, kTooFew };
  void open_gate(Gate gate) {
    gate_ = gate;
    gate_.notify_all();
  }

  void work(std::uint32_t patch) {
    name_thread("step");
    gate_.wait(Gate::kClosed);
    if (gate_ == Gate::kTooFew) return;
    for (;;) {
      barrier_.arrive_and_wait();
      const Command what = command_;  // the caller may write the next one after the last barrier
      if (what == kQuit) return;
      run_patch(patch, what);
    }
  }

  void run_patch(std::uint32_t patch, Command what) {
    cpu::Team team(patch, view_.patches.patch_count, barrier_, stop_flag());
    for (const step::Stage& stage : stages_) {
      if ((what & command(stage.info->phase)) == 0) continue;
      const step::StageKind kind = stage.info->kind;
      if (kind == step::StageKind::kElements || kind == step::StageKind::kLaggedElements) {
        passes_[stage.group].tensors(team, view_, groups_[stage.group]);
      } else if (stage.info->kind == step::StageKind::kDiagnostics) {
        passes_[stage.group].diagnose(team, view_, groups_[stage.group]);
      } else if (stage.info->kind == step::StageKind::kRowErrors) {
        if (!uses_coarse_) continue;  // all patches alike
        solver::measure_row_errors(team, view_.patches, view_.state, view_.matrix, coarse_);
      } else if (stage.info->kind == step::StageKind::kCoarseLevel) {
        if (!uses_coarse_) continue;
        solver::sum_free_rows(team, view_.patches, view_.state, view_.matrix, coarse_);
        solver::assemble_coarse(team, view_.patches, view_.state, view_.matrix, coarse_);
        barrier_.arrive_and_wait();
        solver::factorize_coarse(team, view_.patches, coarse_);
      } else if (stage.info->kind == step::StageKind::kSolve && uses_coarse_) {
        solver::measure_row_losses(team, view_.patches, view_.matrix, coarse_);
        solver::CoarseLevel<cpu::Team, Real> coarse(team, view_.patches, coarse_);
        solver::conjugate_gradients(team, view_.patches, view_.state, view_.matrix, view_.solve, view_.links, coarse);
      } else {
        step::with_stage(model_, stage, [&](auto type) {
          decltype(type)::run(team, view_, groups_.empty() ? view::ElementView<Real>{} : groups_[stage.group]);
        });
      }
      barrier_.arrive_and_wait();
    }
  }

  const model::Model& model_;
  const std::vector<step::Stage> stages_;
  cpu::Arena arena_;
  const model::BoundScene<Real> bound_;
  const view::CoarseView<Real> coarse_;
  const view::SceneView<Real>& view_ = bound_.view;
  const model::HostInputs<Real>& inputs_ = bound_.inputs;
  std::vector<view::ElementView<Real>> groups_;
  std::vector<model::GroupBuffers<Real>> buffers_;  // [group]
  std::vector<cpu::ElementPasses<Real>> passes_;
  cpu::Barrier barrier_;
  Command command_ = 0;
  Command phases_ = 0;        // that have stages
  bool uses_coarse_ = false;  // the next evaluation and solve have a coarse level; written between two commands
  Checkpoint<Real> checkpoint_;
  LoadFactors load_factors_;
  std::atomic<Gate> gate_{Gate::kClosed};
  std::vector<std::thread> workers_;
};

std::string processor_name() {
  std::ifstream file("/proc/cpuinfo");
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with("model name")) return line.substr(line.find(':') + 2);
  }
  return "unknown processor";
}

class CpuBackend final : public Backend {
 public:
  explicit CpuBackend(std::uint32_t default_threads) : default_threads_(default_threads) {}

  std::string name() const override { return "cpu"; }
  std::string device() const override {
    return processor_name() + ", " + std::to_string(std::thread::hardware_concurrency()) + " threads";
  }
  model::PatchPolicy patch_policy(std::uint32_t cpu_threads) const override {
    // With fewer nodes a thread, waiting for each other costs more than the work saved.
    constexpr std::uint32_t kMinNodesPerThread = 512;
    return {threads_of(cpu_threads), kMinNodesPerThread, matrix::Storage::kEdges};
  }
  step::MachineRates rates(std::uint32_t cpu_threads) const override {
    // For one core of a current server, with vectors. tensormass-bench measures the real rates.
    const double threads = threads_of(cpu_threads);
    return {.bytes_per_s = 8e9 * threads,
            .operations_per_s = 6e9 * threads,
            .stage_latency_s = threads > 1 ? 2e-6 : 0,
            .iteration_latency_s = threads > 1 ? 2e-6 : 0};
  }
  double measure_bandwidth_bytes_per_s() const override {
    const std::size_t count = std::size_t{16} << 20;  // numbers in a thread's part of each array
    const std::uint32_t threads = std::max(default_threads_, 1u);
    std::vector<double> a(count * threads, 1), b(count * threads, 2), c(count * threads, 3);
    double best = 0;
    for (int repeat = 0; repeat < 5; ++repeat) {
      const auto begin = std::chrono::steady_clock::now();
      std::vector<std::thread> workers;
      for (std::uint32_t t = 0; t < threads; ++t) {
        workers.emplace_back([&, t] {
          for (std::size_t i = t * count; i < (t + 1) * count; ++i) a[i] = b[i] + 3 * c[i];
        });
      }
      for (std::thread& worker : workers) worker.join();
      const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - begin;
      best = std::max(best, 3.0 * sizeof(double) * static_cast<double>(count * threads) / elapsed.count());
    }
    return best;
  }
  Result<std::unique_ptr<SceneState>> create(const model::Model& model) const override try {
    std::unique_ptr<SceneState> state;
    if (model.double_precision) {
      state = std::make_unique<CpuState<double>>(model);
    } else {
      state = std::make_unique<CpuState<float>>(model);
    }
    return state;
  } catch (const std::bad_alloc&) {
    return fail(ErrorCode::kResourceExhausted, "not enough host memory for the scene's buffers; use a coarser mesh");
  } catch (const std::system_error& error) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("cannot start {} threads: {}; lower scene.solver.cpu_threads", model.layout.patch_count,
                            error.code().message()));
  }

 private:
  std::uint32_t threads_of(std::uint32_t cpu_threads) const {
    return cpu_threads != 0 ? cpu_threads : default_threads_;
  }

  const std::uint32_t default_threads_;
};

}  // namespace

std::unique_ptr<Backend> make_cpu_backend(std::uint32_t default_threads) {
  return std::make_unique<CpuBackend>(std::max(default_threads, 1u));
}

}  // namespace tensormass::backend
