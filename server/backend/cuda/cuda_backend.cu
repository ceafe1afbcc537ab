#include <algorithm>
#include <array>
#include <cstddef>
#include <ctime>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <cuda_runtime.h>
#include <sys/prctl.h>

#include "backend/backend.h"
#include "backend/cuda/elements.h"
#include "backend/cuda/launch.cuh"
#include "backend/cuda/rows.cuh"
#include "backend/cuda/solve_plan.cuh"
#include "backend/newton.h"
#include "backend/results.h"
#include "backend/stages.h"
#include "model/bind.h"

/// A step is one CUDA graph: the tools' positions go up, each stage is a kernel with one block a patch, the solve is
/// one cooperative kernel, and the reports come back. The host waits once. A step that solves more than once is a graph
/// for each of its phases.
namespace tensormass::backend {

namespace {

struct CudaFailure : std::runtime_error {
  using std::runtime_error::runtime_error;
};

void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw CudaFailure(std::string(what) + ": " + cudaGetErrorString(status));
}

/// Buffers of a scene in device memory. Small ones share blocks of the size in which the driver gives memory: each
/// allocation and each release may wait for what other scenes do.
class DeviceArena {
 public:
  DeviceArena() = default;
  DeviceArena(const DeviceArena&) = delete;
  DeviceArena& operator=(const DeviceArena&) = delete;
  ~DeviceArena() {
    for (void* block : blocks_) cudaFree(block);
  }

  template <class T, class U>
  const T* constant(std::string_view name, const std::vector<U>& items) {
    return generated<T>(name, items.size(), [&](T* to) {
      std::transform(items.begin(), items.end(), to, [](U item) { return static_cast<T>(item); });
    });
  }
  template <class T, class Fill>
  const T* generated(std::string_view name, std::size_t count, const Fill& fill) {
    T* copy = zeros<T>(name, count);
    if (count == 0) return copy;
    std::vector<T> items(count);
    fill(items.data());
    check(cudaMemcpy(copy, items.data(), count * sizeof(T), cudaMemcpyHostToDevice), "upload");
    return copy;
  }
  template <class T>
  T* zeros(std::string_view, std::size_t count) {
    if (count == 0) return nullptr;
    return static_cast<T*>(take(count * sizeof(T)));
  }

 private:
  /// Cleared, and aligned for every type.
  void* take(std::size_t bytes) {
    constexpr std::size_t kAlignment = 256, kBlockBytes = std::size_t{2} << 20;
    bytes = (bytes + kAlignment - 1) / kAlignment * kAlignment;
    if (bytes > left_) {
      const std::size_t size = std::max(bytes, kBlockBytes);
      void* block = nullptr;
      check(cudaMalloc(&block, size), "device memory of the scene's buffers");
      blocks_.push_back(block);
      check(cudaMemset(block, 0, size), "clear");
      if (size - bytes < left_) return block;  // what is left of the last one is more
      next_ = static_cast<char*>(block);
      left_ = size;
    }
    void* taken = next_;
    next_ += bytes;
    left_ -= bytes;
    return taken;
  }

  std::vector<void*> blocks_;
  char* next_ = nullptr;
  std::size_t left_ = 0;
};

/// Page-locked host memory, which copies beside the kernels.
template <class T>
class Pinned {
 public:
  explicit Pinned(std::size_t count, const T& value = {}) : count_(count) {
    if (count > 0) check(cudaMallocHost(&data_, count * sizeof(T)), "page-locked host memory");
    std::fill_n(data_, count, value);
  }
  Pinned(const Pinned&) = delete;
  Pinned& operator=(const Pinned&) = delete;
  ~Pinned() { cudaFreeHost(data_); }
  T* data() const { return data_; }
  std::size_t size() const { return count_; }
  std::span<T> span() const { return {data_, count_}; }
  std::size_t bytes() const { return count_ * sizeof(T); }

 private:
  std::size_t count_;
  T* data_ = nullptr;
};

/// What a step is told, in host memory and in the device's: one copy brings all of it.
class StepInputs {
 public:
  template <class T>
  struct Item {
    T* host;
    const T* device;
  };
  /// Of all items.
  explicit StepInputs(std::size_t bytes, DeviceArena& arena)
      : host_(bytes), device_(arena.zeros<std::byte>("what a step is told", bytes)) {}
  template <class T>
  static std::size_t bytes_of(std::size_t count) {
    return (count * sizeof(T) + kAlignment - 1) / kAlignment * kAlignment;
  }
  template <class T>
  Item<T> add(std::size_t count) {
    const std::size_t at = used_;
    used_ += bytes_of<T>(count);
    return {reinterpret_cast<T*>(host_.data() + at), reinterpret_cast<const T*>(device_ + at)};
  }
  cudaError_t upload(cudaStream_t stream) const {
    return cudaMemcpyAsync(device_, host_.data(), host_.bytes(), cudaMemcpyHostToDevice, stream);
  }

 private:
  static constexpr std::size_t kAlignment = 64;
  Pinned<std::byte> host_;
  std::byte* device_;
  std::size_t used_ = 0;
};

/// A stream, at the end of which nothing of it is under way.
struct EndStream {
  void operator()(cudaStream_t stream) const {
    cudaStreamSynchronize(stream);
    cudaStreamDestroy(stream);
  }
};
using Stream = std::unique_ptr<CUstream_st, EndStream>;

Stream make_stream() {
  cudaStream_t stream = nullptr;
  check(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking), "stream");
  return Stream(stream);
}

struct DestroyGraph {
  void operator()(cudaGraphExec_t graph) const { cudaGraphExecDestroy(graph); }
};
using Graph = std::unique_ptr<CUgraphExec_st, DestroyGraph>;

/// Waits until a stream has done what it was given, without holding a processor: many scenes have more threads than a
/// machine has processors. An event that blocks comes late, and makes all scenes meet at a lock of the driver.
cudaError_t wait_asleep(cudaStream_t stream) {
  constexpr long kSleepNs = 20'000;
  thread_local const bool precise = prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL) == 0;
  static_cast<void>(precise);
  for (;;) {
    if (const cudaError_t status = cudaStreamQuery(stream); status != cudaErrorNotReady) return status;
    const timespec sleep{0, kSleepNs};
    nanosleep(&sleep, nullptr);
  }
}

using cuda::run_stage;

template <class Real>
class CudaState final : public SceneState {
 public:
  /// device: what the scene has of it. shares: other scenes step on the device at the same time.
  CudaState(const model::Model& model, const cudaDeviceProp& device, bool shares)
      : model_(model),
        device_(device),
        shares_(shares),
        inputs_(StepInputs::bytes_of<tensor::ToolState<Real>>(model.tools.size()) +
                    StepInputs::bytes_of<Real>(4 * model.prescribed.size()) +
                    StepInputs::bytes_of<tensor::StepControl<Real>>(1),
                arena_),
        tools_(inputs_.add<tensor::ToolState<Real>>(model.tools.size())),
        prescribed_(inputs_.add<Real>(4 * model.prescribed.size())),
        control_(inputs_.add<tensor::StepControl<Real>>(1)),
        newton_(model.iterates() ? 1 : 0),
        solve_(1),
        patches_(model.layout.patch_count),
        residuals_(model.iterates() ? model.layout.patch_count : 0),
        watch_(model.groups.size() * model.layout.patch_count),
        volume_parts_(parts_of(model)),
        min_det_f_(model.checks_volume() ? model.groups.size() * model.layout.patch_count * volume_parts_ : 0,
                   std::numeric_limits<Real>::infinity()),
        loads_(model.tools.size() * model.layout.patch_count),
        visible_(3 * std::size_t{model.visible.count()}),
        view_(model::bind<Real>(model, arena_, exchange())) {
    for (std::size_t g = 0; g < model.groups.size(); ++g) groups_.push_back(model::bind<Real>(model, g, arena_));
    std::uint32_t largest = 0;
    for (std::uint32_t p = 0; p < view_.patch_count; ++p) {
      largest = std::max(largest, model.layout.patch_rows[p + 1] - model.layout.patch_rows[p]);
    }
    threads_ = std::clamp(largest, 128u, cuda::kMaxBlockThreads) / cuda::kWarp * cuda::kWarp;
    if constexpr (kSinglePrecision) solve_plan_ = cuda::plan_solve(model.layout);
    if (model.solve_keeps_vectors && !solve_plan_.keeps_vectors()) throw CudaFailure("no room for the solve's vectors");
    if (model.iterates()) {
      for (const model::Phase phase : {model::Phase::kBegin, model::Phase::kEvaluate, model::Phase::kSolve,
                                       model::Phase::kBacktrack, model::Phase::kEnd}) {
        graph(phase) = record([&] { enqueue_phase(phase); });
      }
    } else {
      step_ = record([&] {
        for (const model::Phase phase :
             {model::Phase::kBegin, model::Phase::kEvaluate, model::Phase::kSolve, model::Phase::kEnd}) {
          enqueue_phase(phase);
        }
      });
    }
    graph(model::Phase::kWatch) = record([&] { enqueue_phase(model::Phase::kWatch); });
    if (view_.visible_count > 0) gather_ = record([&] { enqueue_gather(); });
    finish_copies("start of the scene");
  }

  StepResult step(const StepInput& input, std::span<ToolForce> forces) override {
    for (std::size_t tool = 0; tool < input.centers.size(); ++tool) {
      tools_.host[tool] = tool_state<Real>(model_.tools[tool], input.centers[tool]);
    }
    write_prescribed(model_, input.end_time_s, prescribed_.host);
    *control_.host = memory_.begin(model_, input);
    StepResult result;
    if (model_.iterates()) {
      result = newton_step<Real>(*this, model_.newton_max_iterations, model_.newton_tolerance, input.careful,
                                 memory_.largest_force_squared());
    } else {
      launch_graph(step_, "step");
    }
    if (input.gather_visible && gather_) launch_graph(gather_, "frame");
    wait("step");
    read_forces<Real>(loads_.span(), forces);
    if (!model_.iterates()) result = this->result();
    result.min_det_f = read_volume<Real>(model_, result.min_det_f, min_det_f_.span());
    memory_.end(input);
    return result;
  }

  void restore() override {
    memory_.restore(
        model_, view_, std::span<const ElementView<Real>>(groups_), [&](const Real* from, std::size_t count, Real* to) {
          if (count == 0) return;
          check(cudaMemcpyAsync(to, from, count * sizeof(Real), cudaMemcpyDeviceToDevice, stream()), "restore");
        });
    wait("restore");  // reading back does not go by this stream
  }

  std::span<const float> visible_positions() override { return visible_.span(); }

  void gather_visible() override {
    if (gather_) launch_graph(gather_, "frame");
    wait("frame");
  }

  void watch(std::span<GroupWatch> groups) override {
    run(model::Phase::kWatch);
    wait("watch");
    read_watch<Real>(watch_.span(), groups);
  }

  RowState read() override {
    return read_state(model_, view_, std::span<const ElementView<Real>>(groups_), memory_.history_dt_s(),
                      [&](const Real* from, std::size_t count) { return download(from, count); });
  }
  void write(const RowState& state) override {
    write_state(model_, view_, std::span<const ElementView<Real>>(groups_), state,
                [&](Real* to, std::span<const double> from) { upload(to, from); });
    memory_.start_anew(state.history_dt_s);
    finish_copies("write");
  }

  // What newton_step needs of a device.
  void run(model::Phase phase) { launch_graph(graph(phase), "step"); }
  tensor::NewtonControl& control() {
    wait("step");  // the last launch has read it
    return *newton_.data();
  }
  Imbalance imbalance() {
    wait("step");
    return read_imbalance<Real>(residuals_.span());
  }
  StepResult result() {
    wait("step");
    return read_step<Real>(*solve_.data(), patches_.span());
  }

 private:
  void launch_graph(const Graph& graph, const char* what) { check(cudaGraphLaunch(graph.get(), stream()), what); }
  void wait(const char* what) { check(shares_ ? wait_asleep(stream()) : cudaStreamSynchronize(stream()), what); }
  cudaStream_t stream() const { return stream_.get(); }
  /// Copies from pageable memory and clearing are under way in a stream of their own. Not by waiting for the device:
  /// other scenes may never leave it idle.
  static void finish_copies(const char* what) { check(cudaStreamSynchronize(cudaStreamLegacy), what); }
  Graph& graph(model::Phase phase) { return phases_[static_cast<std::size_t>(phase)]; }

  std::vector<double> download(const Real* from, std::size_t count) {
    std::vector<Real> copy(count);
    check(cudaMemcpy(copy.data(), from, copy.size() * sizeof(Real), cudaMemcpyDeviceToHost), "read back");
    return {copy.begin(), copy.end()};
  }
  void upload(Real* to, std::span<const double> from) {
    const std::vector<Real> copy(from.begin(), from.end());
    check(cudaMemcpy(to, copy.data(), copy.size() * sizeof(Real), cudaMemcpyHostToDevice), "write");
  }

  /// Few elements a thread, and few blocks: each has a number to report.
  static std::uint32_t parts_of(const model::Model& model) {
    constexpr std::uint32_t kMostParts = 8, kItemsOfThread = 2;
    std::uint32_t most = 0;
    for (const model::ElementGroup& group : model.groups) {
      if (!group.checks_volume || group.solve_checks_volume) continue;
      most = std::max(most, group.element_count * std::min(group.point_count, tensor::kThreadsOfPoints));
    }
    const std::uint32_t of_part = model.layout.patch_count * cuda::kStageThreads * kItemsOfThread;
    return std::clamp((most + of_part - 1) / of_part, 1u, kMostParts);
  }

  /// What a step reports goes straight to host memory: a few numbers a patch, and no copy after the last kernel.
  model::StepExchange<Real> exchange() const {
    return {.control = control_.device,
            .tools = tools_.device,
            .prescribed = prescribed_.device,
            .solve_report = solve_.data(),
            .patch_reports = patches_.data(),
            .residuals = residuals_.data(),
            .watch = watch_.data(),
            .min_det_f = min_det_f_.data(),
            .tool_loads = loads_.data()};
  }

  template <class Enqueue>
  Graph record(const Enqueue& enqueue) {
    cudaGraph_t graph = nullptr;
    cudaGraphExec_t executable = nullptr;
    // Thread-local capture: other scenes allocate and launch at the same time.
    check(cudaStreamBeginCapture(stream(), cudaStreamCaptureModeThreadLocal), "begin of the step's graph");
    try {
      enqueue();
    } catch (...) {
      // Else the thread could load no other scene: it would still be recording.
      cudaStreamEndCapture(stream(), &graph);
      if (graph) cudaGraphDestroy(graph);
      throw;
    }
    check(cudaStreamEndCapture(stream(), &graph), "end of the step's graph");
    const cudaError_t status = cudaGraphInstantiate(&executable, graph, 0);
    cudaGraphDestroy(graph);
    check(status, "the step's graph");
    return Graph(executable);
  }

  /// Single precision has a kernel that does these stages in one.
  static constexpr bool kSinglePrecision = std::is_same_v<Real, float>;
  bool is_part_of_fast_solve(const model::Stage& stage) const {
    if (!kSinglePrecision) return false;
    return stage.kind == model::StageKind::kScaleEdges || stage.kind == model::StageKind::kAdvance ||
           (stage.kind == model::StageKind::kFactorize && solve_plan_.resident) ||
           (stage.kind == model::StageKind::kCheckVolume && model_.groups[stage.group].solve_checks_volume);
  }

  template <class StageType>
  void launch(const ElementView<Real>& elements, std::uint32_t items = 0) {
    launch(StageType::kCommunication, reinterpret_cast<const void*>(&run_stage<StageType, Real>), elements, items);
  }
  /// items: how many the stage has in all, a thread for each; 0: as many as rows, or as the surface has triangles.
  void launch(Communication communication, const void* kernel, const ElementView<Real>& elements,
              std::uint32_t items = 0) {
    void* arguments[] = {const_cast<SceneView<Real>*>(&view_), const_cast<ElementView<Real>*>(&elements)};
    if (communication == Communication::kExchanges) {
      int resident = 0, processors = 0, device = 0;
      check(cudaGetDevice(&device), "device");
      check(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device), "device");
      check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, kernel, static_cast<int>(threads_), 0), "solve");
      if (static_cast<std::uint64_t>(resident) * static_cast<std::uint64_t>(processors) < view_.patch_count) {
        throw CudaFailure("the scene's patches do not fit on the device at once");
      }
      check(cudaLaunchCooperativeKernel(kernel, view_.patch_count, threads_, arguments, 0, stream()), "solve");
    } else if (communication == Communication::kReducesInParts) {
      const dim3 grid(view_.patch_count, volume_parts_);
      check(cudaLaunchKernel(kernel, grid, cuda::kStageThreads, arguments, 0, stream()), "stage");
    } else if (communication == Communication::kReduces) {
      check(cudaLaunchKernel(kernel, view_.patch_count, threads_, arguments, 0, stream()), "stage");
    } else {
      if (items == 0) items = std::max(view_.row_count, view_.triangle_count);
      const dim3 grid(view_.patch_count, items / view_.patch_count / cuda::kStageThreads + 1);
      check(cudaLaunchKernel(kernel, grid, cuda::kStageThreads, arguments, 0, stream()), "stage");
    }
  }

  void launch_elements(const model::ElementGroup& group, const ElementView<Real>& elements) {
    const cuda::ElementKernels kernels = cuda::element_kernels<Real>(group.shape, group.law);
    if (!group.prony.empty()) launch(Communication::kNone, kernels.move_histories, elements, elements.count);
    if (elements.decompositions != nullptr) {
      physics::for_each_type(physics::Shapes{}, [&](auto shape, int index) {
        if (index != group.shape) return;
        launch<Decompose<typename decltype(shape)::Type>>(elements, elements.count * elements.point_count);
      });
    }
    cuda::RowsLaunch rows = cuda::rows_launch<Real>(elements.slice_count, model_.layout.widest_slice(),
                                                    kernels.keeps_neighbours, kernels.adds_in_turns, device_);
    cuda::allow_all_shared_bytes(kernels.assemble);
    void* arguments[] = {const_cast<SceneView<Real>*>(&view_), const_cast<ElementView<Real>*>(&elements),
                         &rows.capacity};
    check(
        cudaLaunchKernel(kernels.assemble, elements.slice_count, rows.threads, arguments, rows.shared_bytes, stream()),
        "element tensors");
  }

  void enqueue_phase(model::Phase phase) {
    using model::Phase;
    if (phase == Phase::kBegin) {
      check(inputs_.upload(stream()), "what the step is told");
    }
    if (phase == Phase::kEvaluate || phase == Phase::kBacktrack)
      upload_pinned(view_.newton, newton_, "outer iteration");
    for (const model::Stage& stage : model_.stages) {
      if (stage.phase != phase || is_part_of_fast_solve(stage)) continue;
      if constexpr (kSinglePrecision) {
        if (stage.kind == model::StageKind::kSolve) {
          check(cuda::launch_solve(solve_plan_, view_, stream()), "solve");
          continue;
        }
      }
      if (stage.kind == model::StageKind::kElements) {
        launch_elements(model_.groups[stage.group], groups_[stage.group]);
        continue;
      }
      if (stage.kind == model::StageKind::kWatch) {
        const model::ElementGroup& group = model_.groups[stage.group];
        launch(Communication::kReduces, cuda::element_kernels<Real>(group.shape, group.law).watch,
               groups_[stage.group]);
        continue;
      }
      with_stage(model_, stage, [&](auto type) {
        launch<decltype(type)>(groups_.empty() ? ElementView<Real>{} : groups_[stage.group]);
      });
    }
  }

  void enqueue_gather() {
    launch<GatherVisible>({}, view_.visible_count);
    download_pinned(visible_, view_.visible_positions);
  }

  template <class T>
  void upload_pinned(const T* to, const Pinned<T>& from, const char* what) {
    if (from.size() == 0) return;
    check(cudaMemcpyAsync(const_cast<T*>(to), from.data(), from.bytes(), cudaMemcpyHostToDevice, stream()), what);
  }
  template <class T>
  void download_pinned(const Pinned<T>& to, const T* from) {
    if (to.size() == 0) return;
    check(cudaMemcpyAsync(to.data(), from, to.bytes(), cudaMemcpyDeviceToHost, stream()), "results");
  }

  const model::Model& model_;
  const cudaDeviceProp device_;
  const bool shares_;
  DeviceArena arena_;
  StepInputs inputs_;
  const StepInputs::Item<tensor::ToolState<Real>> tools_;
  const StepInputs::Item<Real> prescribed_;  // [.., 4]
  const StepInputs::Item<tensor::StepControl<Real>> control_;
  Pinned<tensor::NewtonControl> newton_;
  Pinned<tensor::SolveReport<Real>> solve_;
  Pinned<tensor::PatchReport<Real>> patches_;
  Pinned<tensor::PatchResidual<Real>> residuals_;
  Pinned<tensor::PatchWatch<Real>> watch_;
  const std::uint32_t volume_parts_;  // blocks of a patch in the stages that reduce in parts
  Pinned<Real> min_det_f_;
  Pinned<tensor::ToolLoad<Real>> loads_;
  Pinned<float> visible_;
  const SceneView<Real> view_;
  std::vector<ElementView<Real>> groups_;
  unsigned threads_ = 0;
  cuda::SolvePlan solve_plan_;
  Memory<Real> memory_;
  Graph step_;
  Graph gather_;
  std::array<Graph, model::kPhases> phases_{};
  const Stream stream_ = make_stream();  // last, so that its work has ended before anything that it uses goes
};

class CudaBackend final : public Backend {
 public:
  CudaBackend(const cudaDeviceProp& properties, std::uint32_t scenes) : properties_(properties), scenes_(scenes) {}

  std::string name() const override { return "cuda"; }
  std::string device() const override { return properties_.name; }
  model::PatchPolicy patch_policy(const v1::Scene&) const override {
    // One block a multiprocessor is always resident; fewer than that many nodes leave a block waiting for others, more
    // than that many do not fit on the chip. Scenes that share the device take as few multiprocessors as will do.
    constexpr std::uint32_t kMinNodesPerPatch = 96, kMaxNodesPerPatch = 416, kMaxNodesIfShared = 480;
    const std::uint32_t max_nodes = scenes_ > 1 ? kMaxNodesIfShared : kMaxNodesPerPatch;
    return {processors(), kMinNodesPerPatch,       tensor::Storage::kRows,           processors() / scenes_,
            max_nodes,    cuda::kMostResidentRows, cuda::most_kept_rows(properties_)};
  }
  model::MachineRates rates(const v1::Scene&) const override {
    return {.bytes_per_s = 3e12, .operations_per_s = 2e13, .stage_latency_s = 3e-6, .iteration_latency_s = 4e-6};
  }
  double measure_bandwidth_bytes_per_s() const override {
    constexpr std::size_t kBytes = std::size_t{1} << 30;
    constexpr int kCopies = 20;
    void *from = nullptr, *to = nullptr;
    cudaEvent_t begin = nullptr, end = nullptr;
    float ms = 0;
    const bool measured = cudaMalloc(&from, kBytes) == cudaSuccess && cudaMalloc(&to, kBytes) == cudaSuccess &&
                          cudaEventCreate(&begin) == cudaSuccess && cudaEventCreate(&end) == cudaSuccess;
    if (measured) {
      for (int i = 0; i <= kCopies; ++i) {  // the first one warms up
        if (i == 1) cudaEventRecord(begin);
        cudaMemcpyAsync(to, from, kBytes, cudaMemcpyDeviceToDevice);
      }
      cudaEventRecord(end);
      cudaEventSynchronize(end);
      cudaEventElapsedTime(&ms, begin, end);
    }
    cudaEventDestroy(begin);
    cudaEventDestroy(end);
    cudaFree(from);
    cudaFree(to);
    cudaGetLastError();
    return ms > 0 ? 2e3 * kCopies * static_cast<double>(kBytes) / static_cast<double>(ms) : 0;
  }
  Result<std::unique_ptr<SceneState>> create(const model::Model& model) const override try {
    std::unique_ptr<SceneState> state;
    if (model.double_precision) {
      state = std::make_unique<CudaState<double>>(model, share(), scenes_ > 1);
    } else {
      state = std::make_unique<CudaState<float>>(model, share(), scenes_ > 1);
    }
    return state;
  } catch (const CudaFailure& failure) {
    cudaGetLastError();
    return fail(ErrorCode::kResourceExhausted, std::string("CUDA: ") + failure.what());
  }

 private:
  std::uint32_t processors() const { return static_cast<std::uint32_t>(properties_.multiProcessorCount); }
  /// What a scene has of the device, so that it does not spread its work out over processors that others need: that
  /// takes longer in all.
  cudaDeviceProp share() const {
    cudaDeviceProp share = properties_;
    share.multiProcessorCount = static_cast<int>(std::max(1u, processors() / scenes_));
    return share;
  }
  const cudaDeviceProp properties_;
  const std::uint32_t scenes_;
};

}  // namespace

Result<std::unique_ptr<Backend>> make_cuda_backend(std::uint32_t scenes) {
  int count = 0;
  if (const cudaError_t status = cudaGetDeviceCount(&count); status != cudaSuccess || count == 0) {
    return fail(ErrorCode::kUnavailable, std::string("no CUDA device answers: ") +
                                             (status != cudaSuccess ? cudaGetErrorString(status) : "none"));
  }
  cudaDeviceProp properties{};
  cudaFuncAttributes attributes{};
  if (cudaGetDeviceProperties(&properties, 0) != cudaSuccess) {
    return fail(ErrorCode::kUnavailable, "the CUDA device does not tell its properties");
  }
  if (cudaFuncGetAttributes(&attributes, run_stage<Advance, float>) != cudaSuccess) {
    cudaGetLastError();
    return fail(ErrorCode::kUnavailable, std::string("this build has no code for ") + properties.name +
                                             "; configure with TENSORMASS_CUDA_ARCHITECTURES of its generation");
  }
  return std::unique_ptr<Backend>(std::make_unique<CudaBackend>(properties, std::max(scenes, 1u)));
}

}  // namespace tensormass::backend
