#pragma once

#include <algorithm>
#include <array>
#include <chrono>
#include <cstddef>
#include <limits>
#include <memory>
#include <mutex>
#include <span>
#include <vector>

#include <cuda_runtime.h>

#include "backend/backend.h"
#include "backend/checkpoint.h"
#include "backend/cuda/blocks.h"
#include "backend/cuda/coarse_stages.cuh"
#include "backend/cuda/edit_kernels.cuh"
#include "backend/cuda/elements.h"
#include "backend/cuda/graph.cuh"
#include "backend/cuda/memory.cuh"
#include "backend/cuda/rows_memory.h"
#include "backend/cuda/solve_plan.cuh"
#include "backend/cuda/stage_kernels.h"
#include "backend/cuda/stop.cuh"
#include "backend/saved_state.h"
#include "backend/step_inputs.h"
#include "backend/step_reports.h"
#include "model/bind.h"
#include "solver/newton.h"
#include "step/inversion_check.h"
#include "step/stages.h"

/// One scene on a CUDA device.
///
///   host                                   device (one stream)
///   inputs_: tools, prescribed, control ──> one copy
///   graph of the step ────────────────────> a kernel for each stage; the solve is a cooperative one
///   wait <── reports in page-locked memory, written by the kernels: no copy comes back
///
/// 1. A step is one graph, so that the host launches once. With Newton iterations each phase is a graph, and the host
///    decides which one is next.
/// 2. Everything that a step needs is allocated in the constructor.
/// 3. A scene that shares the device uses only its share of the multiprocessors.
/// 4. The caller makes the device current (device_state.cuh).
/// 5. A scene whose solves may get a coarse level (coarse_stages.cuh) has each graph twice. The host decides before
///    each step, or before each Newton iteration, which one it launches.
namespace tensormass::backend::cuda {

template <class Real>
class CudaState : public SceneState {
 public:
  /// device: the scene's share of the device.
  /// shares: other scenes step on the device at the same time.
  CudaState(const model::Model& model, const cudaDeviceProp& device, bool shares)
      : model_(model),
        stages_(step::list_stages(model)),
        device_(device),
        shares_(shares),
        takes_long_(may_take_long<Real>(model)),
        inputs_(StepInputs::bytes_of<physics::PlacedTool<Real>>(model.tools.size()) +
                    StepInputs::bytes_of<Real>(4 * model.prescribed.size()) +
                    StepInputs::bytes_of<view::StepControl<Real>>(1),
                arena_),
        tools_(inputs_.add<physics::PlacedTool<Real>>(model.tools.size())),
        prescribed_(inputs_.add<Real>(4 * model.prescribed.size())),
        control_(inputs_.add<view::StepControl<Real>>(1)),
        newton_(model.iterates() ? 1 : 0),
        solve_(1),
        patches_(model.layout.patch_count),
        residuals_(model.iterates() ? model.layout.patch_count : 0),
        diagnostics_(model.groups.size() * model.layout.patch_count),
        volume_parts_(parts_of(model)),
        min_det_f_(model.checks_volume() ? model.groups.size() * model.layout.patch_count * volume_parts_ : 0,
                   std::numeric_limits<Real>::infinity()),
        loads_(model.tools.size() * model.layout.patch_count),
        link_reports_(model.links.count() > 0 ? model.layout.patch_count : 0),
        blade_reports_(model.links.blades.point_count()),
        balance_reports_(model.free_bodies.count()),
        visible_(3 * std::size_t{model.visible.point_count()}),
        broken_(model.links.spring_count()),
        external_(loads_change(model) ? model.external.size() : 0),
        faces_(loads_change(model) ? model.pressure.faces.size() : 0),
        bound_(model::bind<Real>(model, arena_, exchange())),
        coarse_(model, bound_.view, arena_),
        edits_(model.edit_tables != nullptr || model.links.spring_count() > 0),
        load_factors_(model) {
    for (std::size_t g = 0; g < model.groups.size(); ++g) {
      groups_.push_back(model::bind<Real>(model, g, arena_, &buffers_.emplace_back()));
    }
    if (model.edit_tables != nullptr) moves_.reserve(2 * std::size_t{model.contact.triangle_count()});
    std::uint32_t largest = 0;
    for (std::uint32_t p = 0; p < view_.patches.patch_count; ++p) {
      largest = std::max(largest, model.layout.patch_rows[p + 1] - model.layout.patch_rows[p]);
    }
    threads_ = std::clamp(largest, 128u, kMaxBlockThreads) / kWarp * kWarp;
    if constexpr (kSinglePrecision) {
      solve_plan_ = plan_solve(model.layout, model.links.count() > 0);
      if (model.solve == model::SolveKind::kResident) link_room_ = room_for_links();
    }
    if (model.solve_keeps_vectors && !solve_plan_.keeps_vectors()) throw CudaFailure("no room for the solve's vectors");
    for (const bool coarse : {false, true}) {
      if (coarse && !coarse_.exists()) continue;
      uses_coarse_ = coarse;
      record(coarse);
    }
    uses_coarse_ = false;
    graph(step::Phase::kDiagnostics) = record_graph(stream(), [&] { enqueue_phase(step::Phase::kDiagnostics); });
    if (view_.surface.vertex_count > 0) {
      graph(step::Phase::kFrame) = record_graph(stream(), [&] { enqueue_phase(step::Phase::kFrame); });
    }
    finish_copies("start of the scene");
  }

  StepResult step(const StepInput& input, std::span<ToolForce> forces) override {
    write_tools(model_, input, view_.contact.samples, tools_.host);
    write_prescribed(model_, input, prescribed_.host);
    if (load_factors_.write(model_, input, external_.data(), faces_.data())) {
      copy_to_device(bound_.inputs.external, external_, stream(), "loads");
      copy_to_device(bound_.inputs.faces, faces_, stream(), "loads");
    }
    *control_.host = checkpoint_.begin(model_, input);
    StepResult result;
    if (model_.iterates()) {
      result = solver::newton_step<Real>(*this, model_.newton_max_iterations, model_.newton_tolerance,
                                         input.projects_stiffness, checkpoint_.largest_force_squared());
      if (model_.extrapolates()) result.take_motion(this->result());
      repeats(result);  // the guard makes the step again if it failed; it is then told to do without
    } else {
      run_linearized();
    }
    if (input.gather_visible) launch_frame();
    wait("step");
    throw_if_stopped();
    if (!model_.iterates()) {
      result = this->result();
      while (repeats(result) && input.saves_checkpoint) {
        restore();
        *control_.host = checkpoint_.begin(model_, input);
        run_linearized();
        if (input.gather_visible) launch_frame();
        wait("step");
        throw_if_stopped();
        result = this->result();
      }
    }
    read_forces<Real>(loads_.span(), forces);
    result.min_det_f = read_volume<Real>(model_, result.min_det_f, min_det_f_.span());
    solver::read_links<Real>(link_reports_.span(), result);
    solver::read_balance<Real>(balance_reports_.span(), result);
    checkpoint_.end(input);
    return result;
  }

  void restore() override {
    checkpoint_.restore(model_, view_, std::span<const view::ElementView<Real>>(groups_), copy_within());
    wait("restore");  // a later read uses another stream
  }

  void come_to_rest() override {
    checkpoint_.come_to_rest(view_, copy_within(), [&](std::size_t count, Real* to) {
      check(cudaMemsetAsync(to, 0, count * sizeof(Real), stream()), "come_to_rest");
    });
    wait("come_to_rest");
  }

  std::span<const float> visible_positions() override { return visible_.span(); }

  void gather_visible() override {
    launch_frame();
    wait("frame");
  }

  void apply(const model::ModelEdit& edit) override {
    edits_.begin(stream());
    const auto write = [&](void* to, const void* from, std::size_t bytes) { edits_.write(to, from, bytes, stream()); };
    model::for_each_write<Real>(model_, edit.ranges, bound_.buffers, buffers_, write);
    const Real broken = view::kSpringBroken;
    for (const std::uint32_t spring : edit.severed) write(view_.links.broken + spring, &broken, sizeof broken);
    edits_.end(stream());
    edits_.with_numbers(edit.held_rows.data(), edit.held_rows.size(), 1, stream(),
                        [&](const std::uint32_t* rows, std::uint32_t count) {
                          constexpr unsigned kThreads = EditQueue::kThreads;
                          hold_rows<<<(count + kThreads - 1) / kThreads, kThreads, 0, stream()>>>(view_, rows, count);
                        });
    if (view_.contact.slips != nullptr && !edit.moved_triangles.empty()) {
      moves_.clear();
      for (const auto& [from, to] : edit.moved_triangles) moves_.insert(moves_.end(), {from, to});
      edits_.with_numbers(
          moves_.data(), moves_.size(), 2, stream(), [&](const std::uint32_t* moves, std::uint32_t count) {
            constexpr unsigned kThreads = EditQueue::kThreads;
            const std::uint32_t slips = slips_of_triangle(view_.contact);
            move_slips<<<(slips + kThreads - 1) / kThreads, kThreads, 0, stream()>>>(view_, moves, count);
          });
    }
    // A state may be written next, by copies that do not wait for this stream.
    if (!edit.held_rows.empty() || !edit.severed.empty() || !edit.moved_triangles.empty()) wait("edit");
    if (edit.changes_loads) load_factors_.forget(model_);
    checkpoint_.lag().forget();
  }
  std::unique_ptr<PreparedEdit> prepare(const model::Model& next,
                                        const std::vector<model::EditRange>& ranges) const override {
    // Not before: the device deals its queues out to streams by turns, and one that is idle takes one all the same.
    std::call_once(edit_memory_is_made_, [&] { edit_memory_ = std::make_shared<EditMemory>(); });
    return bring_entries<Real>(edit_memory_, next, ranges, bound_.buffers, buffers_);
  }
  void apply(const PreparedEdit& edit) override {
    static_cast<const DeviceEntries&>(edit).run(stream());
    wait("edit");  // the caller may release it
    checkpoint_.lag().forget();
  }
  std::vector<ConstantBuffer> read_constants() override {
    wait("read back");
    std::vector<ConstantBuffer> all;
    for (const DeviceArena::Constant& one : arena_.constants()) {
      ConstantBuffer& copy = all.emplace_back(ConstantBuffer{one.name, std::vector<std::byte>(one.bytes)});
      check(cudaMemcpy(copy.bytes.data(), one.items, one.bytes, cudaMemcpyDeviceToHost), "read back");
    }
    return all;
  }

  void read_broken(std::span<std::uint8_t> broken) override {
    if (broken.empty()) return;
    copy_to_host(broken_, view_.links.broken, stream());
    wait("broken springs");
    copy_broken(std::span<const Real>(broken_.span()), broken);
  }

  void read_blades(std::span<BladeFront> fronts) override { copy_blades<Real>(blade_reports_.span(), fronts); }

  void diagnose(std::span<GroupDiagnostics> groups) override {
    run(step::Phase::kDiagnostics);
    wait("diagnostics");
    read_diagnostics<Real>(diagnostics_.span(), groups);
  }

  RowState read() override {
    return read_state(model_, view_, std::span<const view::ElementView<Real>>(groups_), checkpoint_.internal_dt_s(),
                      [&](const Real* from, std::size_t count) { return download(from, count); });
  }
  void write(const RowState& state) override {
    write_state(model_, view_, std::span<const view::ElementView<Real>>(groups_), state,
                [&](Real* to, std::span<const double> from) { upload(to, from); });
    checkpoint_.start_anew(state.internal_dt_s);
    finish_copies("write");
  }
  StepHistory read_history() override {
    return backend::read_history(view_, checkpoint_.past(), checkpoint_.coarse().state(),
                                 [&](const Real* from, std::size_t count) { return download(from, count); });
  }
  void write_history(const StepHistory& history) override {
    backend::write_history(view_, history, [&](Real* to, std::span<const double> from) { upload(to, from); });
    checkpoint_.go_on(history);
    finish_copies("write");
  }

  // solver::newton_step calls these.
  void begin() { run(step::Phase::kBegin); }
  void evaluate() {
    choose_level();
    run(step::Phase::kEvaluate);
  }
  void solve() {
    begin_solve();
    run(step::Phase::kSolve);
  }
  void backtrack() { run(step::Phase::kBacktrack); }
  void end() { run(step::Phase::kEnd); }
  void run(step::Phase phase) { launch_graph(graph(phase), "step"); }
  view::NewtonControl& control() {
    wait("step");  // the last launch has read it
    return *newton_.data();
  }
  solver::NewtonResidual residual() {
    wait("step");
    take_solve();
    return solver::read_residual<Real>(residuals_.span());
  }
  StepResult result() {
    wait("step");
    take_solve();
    return solver::read_step<Real>(*solve_.data(), control_.host->cg_max_iterations, patches_.span());
  }

 private:
  /// Single precision has fused solves (step::Scope::kFusedOnDevice).
  static constexpr bool kSinglePrecision = std::is_same_v<Real, float>;
  bool is_fused() const { return kSinglePrecision && model_.solve != model::SolveKind::kStages; }
  /// A wait for a solve that may take long spins for this time, as others do throughout.
  static constexpr std::chrono::microseconds kAwake{1000};

  /// Launches a step that is linearized once.
  void run_linearized() {
    choose_level();
    begin_solve();
    launch_graph(steps_[uses_coarse_ ? 1 : 0], "step");
  }
  /// Decides whether the next evaluation and the solve after it have a coarse level. With Newton's method, a solve
  /// whose end the host has not seen does not count yet: the wait would cost more than the coarse level saves.
  void choose_level() { uses_coarse_ = coarse_.exists() && checkpoint_.coarse().is_on(model_); }
  bool repeats(const StepResult& result) {
    return coarse_.exists() && checkpoint_.coarse().repeats(model_, result, uses_coarse_);
  }
  void begin_solve() {
    if (solve_had_coarse_ && !uses_coarse_) {  // the next one reports inverted elements elsewhere
      std::fill(min_det_f_.span().begin(), min_det_f_.span().end(), std::numeric_limits<Real>::infinity());
    }
    solve_had_coarse_ = uses_coarse_;
    solve_is_new_ = true;
  }
  /// Takes the iterations of the last solve, once. Call when it has ended.
  void take_solve() {
    if (!solve_is_new_) return;
    solve_is_new_ = false;
    const view::SolveReport<Real>& solve = *solve_.data();
    checkpoint_.coarse().take_solve(solve.iterations, solver::missing_share(solve, control_.host->cg_max_iterations),
                                    is_fused() ? kCoarseBesideFused : kCoarseByStages);
  }
  void launch_graph(const Graph& graph, const char* what) { check(cudaGraphLaunch(graph.get(), stream()), what); }
  void launch_frame() {
    if (const Graph& frame = graph(step::Phase::kFrame)) launch_graph(frame, "frame");
  }
  /// Copies reals within the device, after what the stream does.
  auto copy_within() {
    return [this](const Real* from, std::size_t count, Real* to) {
      if (count == 0) return;
      check(cudaMemcpyAsync(to, from, count * sizeof(Real), cudaMemcpyDeviceToDevice, stream()), "copy");
    };
  }
  void wait(const char* what) {
    if (!shares_ && !takes_long_) return check(cudaStreamSynchronize(stream()), what);
    const auto look = [this] {
      if (stopped()) ask_for_end(*solve_.data());
    };
    check(wait_and_look(stream(), shares_ ? std::chrono::microseconds{0} : kAwake, look), what);
  }
  cudaStream_t stream() const { return stream_.get(); }
  /// Waits for copies from pageable memory and for clearing, which have a stream of their own. It does not wait for the
  /// whole device, which other scenes may never leave idle.
  static void finish_copies(const char* what) { check(cudaStreamSynchronize(cudaStreamLegacy), what); }
  Graph& graph(step::Phase phase) {
    const bool coarse = uses_coarse_ && (phase == step::Phase::kEvaluate || phase == step::Phase::kSolve);
    return phases_[coarse ? 1 : 0][static_cast<std::size_t>(phase)];
  }
  /// Records the graphs of a step.
  void record(bool coarse) {
    using step::Phase;
    if (model_.iterates()) {
      for (const Phase phase : {Phase::kBegin, Phase::kEvaluate, Phase::kSolve, Phase::kBacktrack, Phase::kEnd}) {
        Graph& place = graph(phase);
        if (!place) place = record_graph(stream(), [&] { enqueue_phase(phase); });
      }
    } else {
      steps_[coarse ? 1 : 0] = record_graph(stream(), [&] {
        for (const Phase phase : {Phase::kBegin, Phase::kEvaluate, Phase::kSolve, Phase::kEnd}) enqueue_phase(phase);
      });
    }
  }

  std::vector<double> download(const Real* from, std::size_t count) {
    std::vector<Real> copy(count);
    check(cudaMemcpy(copy.data(), from, copy.size() * sizeof(Real), cudaMemcpyDeviceToHost), "read back");
    return {copy.begin(), copy.end()};
  }
  void upload(Real* to, std::span<const double> from) {
    const std::vector<Real> copy(from.begin(), from.end());
    check(cudaMemcpy(to, copy.data(), copy.size() * sizeof(Real), cudaMemcpyHostToDevice), "write");
  }

  /// Blocks of a patch in the stages that reduce in parts. Enough that each thread has few elements, but few, because
  /// each block reports a number.
  static std::uint32_t parts_of(const model::Model& model) {
    constexpr std::uint32_t kMaxParts = 8, kItemsOfThread = 2;
    std::uint32_t most = 0;
    for (const model::ElementGroup& group : model.groups) {
      if (!group.checks_volume || group.solve_checks_volume) continue;
      most = std::max(most, group.element_count * std::min(group.point_count, step::kThreadsOfPoints));
    }
    const std::uint32_t of_part = model.layout.patch_count * kStageThreads * kItemsOfThread;
    return std::clamp((most + of_part - 1) / of_part, 1u, kMaxParts);
  }

  /// Buffers that a step reports to, in host memory: a few numbers a patch, and no copy after the last kernel.
  model::StepExchange<Real> exchange() const {
    return {.control = control_.device,
            .tools = tools_.device,
            .prescribed = prescribed_.device,
            .solve_report = solve_.data(),
            .patch_reports = patches_.data(),
            .residuals = residuals_.data(),
            .diagnostics = diagnostics_.data(),
            .min_det_f = min_det_f_.data(),
            .tool_loads = loads_.data(),
            .link_reports = link_reports_.data(),
            .blade_reports = blade_reports_.data(),
            .balance_reports = balance_reports_.data()};
  }

  LinkRoom room_for_links() {
    const std::size_t blocks = LinkRoom::kBlocksOfLink * std::size_t{model_.links.count()};
    if (blocks == 0) return {};
    return {arena_.zeros<LinkBlock>("blocks of links", blocks), arena_.zeros<LinkGuest>("guests of links", blocks),
            arena_.zeros<LinkRange>("blocks of rows with links", view_.patches.row_count),
            arena_.zeros<std::uint32_t>("taken blocks of links", 2)};
  }

  /// Shared memory of a block of assemble_rows if two fit on a multiprocessor [bytes].
  static std::size_t most_rows_bytes(const cudaDeviceProp& device) {
    return std::min(device.sharedMemPerMultiprocessor / 2 - device.reservedSharedMemPerBlock,
                    device.sharedMemPerBlockOptin);
  }

  /// Launches a stage. items: its number of items, a thread for each; 0: the larger number of rows or triangles.
  void launch(step::Communication communication, const void* kernel, const view::ElementView<Real>& elements,
              std::uint32_t items = 0) {
    const view::SceneView<Real>& scene = uses_coarse_ ? coarse_.scene() : view_;
    void* arguments[] = {const_cast<view::SceneView<Real>*>(&scene), const_cast<view::ElementView<Real>*>(&elements)};
    if (communication == step::Communication::kExchanges) {
      int resident = 0, processors = 0, device = 0;
      check(cudaGetDevice(&device), "device");
      check(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device), "device");
      check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, kernel, static_cast<int>(threads_), 0), "solve");
      if (static_cast<std::uint64_t>(resident) * static_cast<std::uint64_t>(processors) < view_.patches.patch_count) {
        throw CudaFailure("the scene's patches do not fit on the device at once");
      }
      check(cudaLaunchCooperativeKernel(kernel, view_.patches.patch_count, threads_, arguments, 0, stream()), "solve");
    } else if (communication == step::Communication::kReducesInParts) {
      const dim3 grid(view_.patches.patch_count, volume_parts_);
      check(cudaLaunchKernel(kernel, grid, kStageThreads, arguments, 0, stream()), "stage");
    } else if (communication == step::Communication::kReduces) {
      check(cudaLaunchKernel(kernel, view_.patches.patch_count, threads_, arguments, 0, stream()), "stage");
    } else {
      if (items == 0) items = std::max(view_.patches.row_count, view_.contact.triangle_count);
      const dim3 grid(view_.patches.patch_count, items / view_.patches.patch_count / kStageThreads + 1);
      check(cudaLaunchKernel(kernel, grid, kStageThreads, arguments, 0, stream()), "stage");
    }
  }

  void launch_elements(const model::ElementGroup& group, const view::ElementView<Real>& elements) {
    const ElementKernels kernels = element_kernels<Real>(group.shape, group.law);
    allow_all_shared_bytes(kernels.assemble);
    const auto processors = static_cast<std::uint32_t>(device_.multiProcessorCount);
    const std::size_t most_bytes = most_rows_bytes(device_);
    if (!kernels.adds_in_turns) {
      return launch_rows(kernels.assemble, elements, 0, elements.slice_count,
                         launch_with_sums<Real>(elements.slice_count, model_.layout.widest_slice(),
                                                kernels.keeps_neighbours, processors, most_bytes));
    }
    const std::span<const view::ListedSlice> slices = group.row_lists.slices;
    const std::uint32_t wide = wide_slices(slices), count = elements.slice_count;
    for (const auto& [begin, end] : {std::pair{0u, wide}, std::pair{wide, count}}) {
      if (begin == end) continue;
      std::uint32_t widest = 0;
      for (const view::ListedSlice& slice : slices.subspan(begin, end - begin)) {
        widest = std::max(widest, slice.columns_end - slice.columns_begin);
      }
      launch_rows(
          kernels.assemble, elements, begin, end,
          launch_in_turns<Real>(end - begin, widest, processors, most_bytes, [&](unsigned threads, std::size_t bytes) {
            int blocks = 0;
            check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, kernels.assemble, static_cast<int>(threads),
                                                                bytes),
                  "element tensors");
            return static_cast<std::uint32_t>(blocks);
          }));
    }
  }
  void launch_gather(const model::ElementGroup& group, const view::ElementView<Real>& elements) {
    const void* const kernel = gather_kernel<Real>(group.shape);
    allow_all_shared_bytes(kernel);
    launch_rows(
        kernel, elements, 0, elements.slice_count,
        launch_with_sums<Real>(elements.slice_count, model_.layout.widest_slice(), false,
                               static_cast<std::uint32_t>(device_.multiProcessorCount), most_rows_bytes(device_)));
  }
  /// Launches assemble_rows, or gather_rows, for the slices [begin, end) of a group.
  void launch_rows(const void* kernel, view::ElementView<Real> elements, std::uint32_t begin, std::uint32_t end,
                   RowsLaunch rows) {
    elements.slices += begin;
    void* arguments[] = {const_cast<view::SceneView<Real>*>(&view_), &elements, &rows.capacity};
    check(cudaLaunchKernel(kernel, end - begin, rows.threads, arguments, rows.shared_bytes, stream()),
          "element tensors");
  }

  void launch_stage(const step::Stage& stage) {
    using step::StageKind;
    const bool of_group = step::is_of_group(stage.info->scope);
    const view::ElementView<Real> elements = of_group ? groups_[stage.group] : view::ElementView<Real>{};
    if (stage.info->kind == StageKind::kRowErrors) {
      if (uses_coarse_) coarse_.launch_errors(stream());
      return;
    }
    if (stage.info->kind == StageKind::kCoarseLevel) {
      if (uses_coarse_) coarse_.launch_matrix(stream());
      return;
    }
    if (uses_coarse_ && stage.info->kind == StageKind::kSolve) return coarse_.launch_solve(stream());
    if (uses_coarse_ && stage.info->scope == step::Scope::kFusedOnDevice) return launch_fused_stages();
    if (stage.info->scope == step::Scope::kFusedOnDevice) {
      if constexpr (kSinglePrecision) check(launch_solve(solve_plan_, view_, link_room_, stream()), "solve");
      return;
    }
    if (stage.info->scope == step::Scope::kShapeAndLaw) {
      const model::ElementGroup& group = model_.groups[stage.group];
      if (stage.info->kind == StageKind::kElements) return launch_elements(group, groups_[stage.group]);
      if (stage.info->kind == StageKind::kGatherKept) return launch_gather(group, groups_[stage.group]);
      const ElementKernels kernels = element_kernels<Real>(group.shape, group.law);
      if (stage.info->kind == StageKind::kInternalVariables) {
        return launch(stage.info->communication, kernels.internal_variables, elements, elements.count);
      }
      if (stage.info->kind == StageKind::kLaggedElements) {
        return launch(stage.info->communication, kernels.lagged, elements, elements.count);
      }
      return launch(stage.info->communication, kernels.diagnostics, elements);
    }
    std::uint32_t items = 0;
    if (stage.info->kind == StageKind::kDecompose) items = elements.count * elements.point_count;
    if (stage.info->kind == StageKind::kGatherSurface) items = view_.surface.vertex_count;
    if (const void* kernel = stage_kernel<Real>(model_, stage)) {
      launch(stage.info->communication, kernel, elements, items);
    }
  }

  /// Launches the stages that a fused solve does in one kernel, with a coarse level.
  void launch_fused_stages() {
    using step::StageKind;
    for (const StageKind kind :
         {StageKind::kFactorize, StageKind::kScaleEdges, StageKind::kSolve, StageKind::kAdvance}) {
      // Before a streamed solve, the diagonal is factorized already.
      if (kind == StageKind::kFactorize && model_.solve != model::SolveKind::kResident) continue;
      launch_stage({&step::info(kind)});
    }
    for (std::uint32_t g = 0; g < model_.groups.size(); ++g) {
      if (!model_.groups[g].solve_checks_volume) continue;
      const step::Stage check{&step::info(StageKind::kCheckInversion), g};
      launch(check.info->communication, stage_kernel<Real>(model_, check), coarse_.checked(groups_[g]));
    }
  }

  void enqueue_phase(step::Phase phase) {
    using step::Phase;
    if (phase == Phase::kBegin) {
      check(inputs_.upload(stream()), "inputs of the step");
    }
    if (phase == Phase::kEvaluate || phase == Phase::kBacktrack)
      copy_to_device(bound_.inputs.newton, newton_, stream(), "Newton's control");
    for (const step::Stage& stage : stages_) {
      if (stage.info->phase == phase) launch_stage(stage);
    }
    if (phase == Phase::kFrame) copy_to_host(visible_, view_.surface.positions, stream());
  }

  const model::Model& model_;
  const std::vector<step::Stage> stages_;
  const cudaDeviceProp device_;
  const bool shares_, takes_long_;
  DeviceArena arena_;
  StepInputs inputs_;
  const StepInputs::Item<physics::PlacedTool<Real>> tools_;
  const StepInputs::Item<Real> prescribed_;  // [.., 4]
  const StepInputs::Item<view::StepControl<Real>> control_;
  Pinned<view::NewtonControl> newton_;
  Pinned<view::SolveReport<Real>> solve_;
  Pinned<view::PatchReport<Real>> patches_;
  Pinned<view::PatchResidual<Real>> residuals_;
  Pinned<view::PatchDiagnostics<Real>> diagnostics_;
  const std::uint32_t volume_parts_;  // blocks of a patch in the stages that reduce in parts
  Pinned<Real> min_det_f_;
  Pinned<view::ToolLoad<Real>> loads_;
  Pinned<view::LinkReport<Real>> link_reports_;
  Pinned<view::BladeReport<Real>> blade_reports_;
  Pinned<view::BalanceReport<Real>> balance_reports_;
  Pinned<float> visible_;
  Pinned<Real> broken_;                     // [spring_count]
  Pinned<Real> external_;                   // [row_count, 4]; empty unless loads_change()
  Pinned<view::PressureFace<Real>> faces_;  // likewise
  const model::BoundScene<Real> bound_;
  const view::SceneView<Real>& view_ = bound_.view;
  CoarseStages<Real> coarse_;
  bool uses_coarse_ = false;       // the next evaluation and solve have a coarse level
  bool solve_had_coarse_ = false;  // the last solve had one
  bool solve_is_new_ = false;      // its iterations have not been taken
  std::vector<view::ElementView<Real>> groups_;
  std::vector<model::GroupBuffers<Real>> buffers_;  // [group]
  EditQueue edits_;
  mutable std::once_flag edit_memory_is_made_;
  mutable std::shared_ptr<EditMemory> edit_memory_;
  std::vector<std::uint32_t> moves_;  // [move, 2] contact triangles in the present edit: from, to
  unsigned threads_ = 0;
  SolvePlan solve_plan_;
  LinkRoom link_room_{};
  Checkpoint<Real> checkpoint_;
  LoadFactors load_factors_;
  std::array<Graph, 2> steps_{};  // without and with a coarse level
  std::array<std::array<Graph, step::kPhases>, 2> phases_{};
  const Stream stream_ = make_stream();  // last, so that its work has ended before anything that it uses goes
};

}  // namespace tensormass::backend::cuda
