#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include <cuda_runtime.h>

#include "backend/backend.h"
#include "backend/cuda/team.cuh"
#include "backend/results.h"
#include "backend/stages.h"
#include "model/bind.h"

/// A step is one CUDA graph: the tools' positions go up, each stage is a kernel with one block a patch, the solve is
/// one cooperative kernel, and the reports come back. The host waits once.
namespace tensormass::backend {

namespace {

struct CudaFailure : std::runtime_error {
  using std::runtime_error::runtime_error;
};

void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw CudaFailure(std::string(what) + ": " + cudaGetErrorString(status));
}

/// Buffers of a scene in device memory.
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
    T* copy = zeros<T>(name, items.size());
    if (items.empty()) return copy;
    const std::vector<T> converted(items.begin(), items.end());
    check(cudaMemcpy(copy, converted.data(), converted.size() * sizeof(T), cudaMemcpyHostToDevice), "upload");
    return copy;
  }
  template <class T>
  T* zeros(std::string_view, std::size_t count) {
    if (count == 0) return nullptr;
    void* block = nullptr;
    check(cudaMalloc(&block, count * sizeof(T)), "device memory of the scene's buffers");
    blocks_.push_back(block);
    check(cudaMemset(block, 0, count * sizeof(T)), "clear");
    return static_cast<T*>(block);
  }

 private:
  std::vector<void*> blocks_;
};

/// Page-locked host memory, which copies beside the kernels.
template <class T>
class Pinned {
 public:
  explicit Pinned(std::size_t count) : count_(count) {
    if (count > 0) check(cudaMallocHost(&data_, count * sizeof(T)), "page-locked host memory");
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

template <class StageType, class Real>
__global__ void __launch_bounds__(cuda::kMaxBlockThreads)
    run_stage(const __grid_constant__ SceneView<Real> view, const __grid_constant__ ElementView<Real> elements) {
  cuda::Team team;
  StageType::run(team, view, elements);
}

/// Threads of a block of a stage whose patches neither reduce nor exchange.
constexpr unsigned kStageThreads = 128;

template <class Real>
class CudaState final : public SceneState {
 public:
  explicit CudaState(const model::Model& model)
      : model_(model),
        view_(model::bind<Real>(model, arena_)),
        tools_(model.tools.size()),
        solve_(1),
        patches_(view_.patch_count),
        loads_(std::size_t{view_.tool_count} * view_.patch_count),
        visible_(3 * std::size_t{view_.visible_count}) {
    for (const model::ElementGroup& group : model.groups) groups_.push_back(model::bind<Real>(group, arena_));
    std::uint32_t largest = 0;
    for (std::uint32_t p = 0; p < view_.patch_count; ++p) {
      largest = std::max(largest, model.layout.patch_rows[p + 1] - model.layout.patch_rows[p]);
    }
    threads_ = std::clamp(largest, 128u, cuda::kMaxBlockThreads) / cuda::kWarp * cuda::kWarp;
    check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "stream");
    step_ = record([&] { enqueue_step(); });
    if (view_.visible_count > 0) gather_ = record([&] { enqueue_gather(); });
    check(cudaDeviceSynchronize(), "start of the scene");
  }

  ~CudaState() override {
    cudaStreamSynchronize(stream_);
    if (step_) cudaGraphExecDestroy(step_);
    if (gather_) cudaGraphExecDestroy(gather_);
    cudaStreamDestroy(stream_);
  }

  StepResult step(ToolCenters centers, std::span<ToolForce> forces, bool gather) override {
    for (std::size_t tool = 0; tool < centers.size(); ++tool) {
      tools_.data()[tool] = tool_state<Real>(model_.tools[tool], centers[tool]);
    }
    check(cudaGraphLaunch(step_, stream_), "step");
    if (gather && gather_) check(cudaGraphLaunch(gather_, stream_), "frame");
    check(cudaStreamSynchronize(stream_), "step");
    read_forces<Real>(loads_.span(), forces);
    return read_step<Real>(*solve_.data(), patches_.span());
  }

  std::span<const float> visible_positions() override { return visible_.span(); }

  void gather_visible() override {
    if (gather_) check(cudaGraphLaunch(gather_, stream_), "frame");
    check(cudaStreamSynchronize(stream_), "frame");
  }

  void read_rows(std::span<double> displacement, std::span<double> velocity) override {
    read(view_.displacement, displacement);
    read(view_.velocity, velocity);
  }
  void write_rows(std::span<const double> displacement, std::span<const double> velocity) override {
    write(view_.displacement, displacement);
    write(view_.velocity, velocity);
  }

 private:
  void read(const Real* from, std::span<double> to) {
    std::vector<Real> copy(to.size());
    check(cudaMemcpy(copy.data(), from, copy.size() * sizeof(Real), cudaMemcpyDeviceToHost), "read back");
    std::copy(copy.begin(), copy.end(), to.begin());
  }
  void write(Real* to, std::span<const double> from) {
    const std::vector<Real> copy(from.begin(), from.end());
    check(cudaMemcpy(to, copy.data(), copy.size() * sizeof(Real), cudaMemcpyHostToDevice), "write");
  }

  template <class Enqueue>
  cudaGraphExec_t record(const Enqueue& enqueue) {
    cudaGraph_t graph = nullptr;
    cudaGraphExec_t executable = nullptr;
    // Thread-local capture: other scenes allocate and launch at the same time.
    check(cudaStreamBeginCapture(stream_, cudaStreamCaptureModeThreadLocal), "begin of the step's graph");
    enqueue();
    check(cudaStreamEndCapture(stream_, &graph), "end of the step's graph");
    const cudaError_t status = cudaGraphInstantiate(&executable, graph, 0);
    cudaGraphDestroy(graph);
    check(status, "the step's graph");
    return executable;
  }

  template <class StageType>
  void launch(const ElementView<Real>& elements) {
    void* arguments[] = {const_cast<SceneView<Real>*>(&view_), const_cast<ElementView<Real>*>(&elements)};
    const auto kernel = reinterpret_cast<const void*>(&run_stage<StageType, Real>);
    if constexpr (StageType::kCommunication == Communication::kExchanges) {
      int resident = 0, processors = 0, device = 0;
      check(cudaGetDevice(&device), "device");
      check(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device), "device");
      check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, kernel, static_cast<int>(threads_), 0), "solve");
      if (static_cast<std::uint64_t>(resident) * static_cast<std::uint64_t>(processors) < view_.patch_count) {
        throw CudaFailure("the scene's patches do not fit on the device at once");
      }
      check(cudaLaunchCooperativeKernel(kernel, view_.patch_count, threads_, arguments, 0, stream_), "solve");
    } else if constexpr (StageType::kCommunication == Communication::kReduces) {
      check(cudaLaunchKernel(kernel, view_.patch_count, threads_, arguments, 0, stream_), "stage");
    } else {
      // A thread an item, about: elements are the most.
      const std::uint32_t items = std::max({view_.row_count, elements.count, view_.visible_count}) / view_.patch_count;
      const dim3 grid(view_.patch_count, items / kStageThreads + 1);
      check(cudaLaunchKernel(kernel, grid, kStageThreads, arguments, 0, stream_), "stage");
    }
  }

  void enqueue_step() {
    if (tools_.size() > 0) {
      check(cudaMemcpyAsync(const_cast<tensor::ToolState<Real>*>(view_.tools), tools_.data(), tools_.bytes(),
                            cudaMemcpyHostToDevice, stream_),
            "tools");
    }
    for (const model::Stage& stage : model_.stages) {
      with_stage(model_, stage, [&](auto type) {
        launch<decltype(type)>(groups_.empty() ? ElementView<Real>{} : groups_[stage.group]);
      });
    }
    download(solve_, view_.solve_report);
    download(patches_, view_.patch_reports);
    download(loads_, view_.tool_loads);
  }

  void enqueue_gather() {
    launch<GatherVisible>({});
    download(visible_, view_.visible_positions);
  }

  template <class T>
  void download(const Pinned<T>& to, const T* from) {
    if (to.size() == 0) return;
    check(cudaMemcpyAsync(to.data(), from, to.bytes(), cudaMemcpyDeviceToHost, stream_), "results");
  }

  const model::Model& model_;
  DeviceArena arena_;
  const SceneView<Real> view_;
  std::vector<ElementView<Real>> groups_;
  Pinned<tensor::ToolState<Real>> tools_;
  Pinned<tensor::SolveReport<Real>> solve_;
  Pinned<tensor::PatchReport<Real>> patches_;
  Pinned<tensor::ToolLoad<Real>> loads_;
  Pinned<float> visible_;
  unsigned threads_ = 0;
  cudaStream_t stream_ = nullptr;
  cudaGraphExec_t step_ = nullptr;
  cudaGraphExec_t gather_ = nullptr;
};

class CudaBackend final : public Backend {
 public:
  explicit CudaBackend(const cudaDeviceProp& properties) : properties_(properties) {}

  std::string name() const override { return "cuda"; }
  std::string device() const override { return properties_.name; }
  model::PatchPolicy patch_policy(const v1::Scene&) const override {
    // One block a multiprocessor is always resident; fewer than that many nodes leave a block waiting for others.
    constexpr std::uint32_t kMinNodesPerPatch = 96;
    return {static_cast<std::uint32_t>(properties_.multiProcessorCount), kMinNodesPerPatch};
  }
  model::MachineRates rates(const v1::Scene&) const override {
    return {.bytes_per_s = 3e12, .operations_per_s = 2e13, .stage_latency_s = 3e-6, .iteration_latency_s = 4e-6};
  }
  Result<std::unique_ptr<SceneState>> create(const model::Model& model) const override try {
    std::unique_ptr<SceneState> state;
    if (model.double_precision) {
      state = std::make_unique<CudaState<double>>(model);
    } else {
      state = std::make_unique<CudaState<float>>(model);
    }
    return state;
  } catch (const CudaFailure& failure) {
    cudaGetLastError();
    return fail(ErrorCode::kResourceExhausted, std::string("CUDA: ") + failure.what());
  }

 private:
  const cudaDeviceProp properties_;
};

}  // namespace

Result<std::unique_ptr<Backend>> make_cuda_backend() {
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
  return std::unique_ptr<Backend>(std::make_unique<CudaBackend>(properties));
}

}  // namespace tensormass::backend
