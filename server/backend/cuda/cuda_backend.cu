#include <algorithm>
#include <memory>
#include <string>

#include <cuda_runtime.h>

#include "backend/backend.h"
#include "backend/cuda/state.cuh"

/// The CUDA device as a backend: how it cuts meshes, how fast it is, and its scenes (state.cuh).
namespace tensormass::backend {

namespace {

class CudaBackend final : public Backend {
 public:
  CudaBackend(const cudaDeviceProp& properties, std::uint32_t scenes) : properties_(properties), scenes_(scenes) {}

  std::string name() const override { return "cuda"; }
  std::string device() const override { return properties_.name; }
  model::PatchPolicy patch_policy(std::uint32_t) const override {
    // One block a multiprocessor is always resident. With fewer nodes than the least, blocks mostly wait for each
    // other. With more than the most, a patch does not fit on the chip. Scenes that share the device take as few
    // multiprocessors as will do.
    constexpr std::uint32_t kMinNodesPerPatch = 96, kMaxNodesPerPatch = 416, kMaxNodesIfShared = 480;
    const std::uint32_t max_nodes = scenes_ > 1 ? kMaxNodesIfShared : kMaxNodesPerPatch;
    return {processors(),
            kMinNodesPerPatch,
            matrix::Storage::kRows,
            processors() / scenes_,
            max_nodes,
            cuda::kMaxResidentRows,
            cuda::most_kept_rows(properties_),
            [](const matrix::Layout& layout) {
              return cuda::plan_solve(layout, false).resident ? model::SolveKind::kResident
                                                              : model::SolveKind::kStreamed;
            }};
  }
  step::MachineRates rates(std::uint32_t) const override {
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
      state = std::make_unique<cuda::CudaState<double>>(model, share(), scenes_ > 1);
    } else {
      state = std::make_unique<cuda::CudaState<float>>(model, share(), scenes_ > 1);
    }
    return state;
  } catch (const cuda::CudaFailure& failure) {
    cudaGetLastError();
    return fail(ErrorCode::kResourceExhausted, std::string("CUDA: ") + failure.what() + free_memory());
  }

 private:
  /// The device's free memory in words, and a remedy if that is too little; empty if the device does not tell.
  static std::string free_memory() {
    constexpr std::size_t kMiB = std::size_t{1} << 20;
    std::size_t free = 0, total = 0;
    if (cudaMemGetInfo(&free, &total) != cudaSuccess) {
      cudaGetLastError();
      return {};
    }
    return " (" + std::to_string(free / kMiB) + " of " + std::to_string(total / kMiB) +
           " MiB of device memory are free; unload a scene, or load one with fewer elements)";
  }
  std::uint32_t processors() const { return static_cast<std::uint32_t>(properties_.multiProcessorCount); }
  /// The device as one scene sees it: with its share of the multiprocessors. Spreading its work over those that other
  /// scenes need would take longer in all.
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
  if (cudaFuncGetAttributes(&attributes, cuda::streamed_kernels().near) != cudaSuccess) {
    cudaGetLastError();
    return fail(ErrorCode::kUnavailable, std::string("this build has no code for ") + properties.name +
                                             "; configure with TENSORMASS_CUDA_ARCHITECTURES of its generation");
  }
  return std::unique_ptr<Backend>(std::make_unique<CudaBackend>(properties, std::max(scenes, 1u)));
}

}  // namespace tensormass::backend
