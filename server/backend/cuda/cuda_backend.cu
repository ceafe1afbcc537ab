#include <algorithm>
#include <memory>
#include <string>
#include <string_view>
#include <tuple>
#include <vector>

#include <cuda_runtime.h>

#include "backend/backend.h"
#include "backend/cuda/current_device.cuh"
#include "backend/cuda/device_state.cuh"
#include "backend/devices.h"

/// A CUDA device as a backend: how it cuts meshes, how fast it is, and its scenes (state.cuh).
namespace tensormass::backend {

namespace {

class CudaBackend final : public Backend {
 public:
  CudaBackend(int device, const cudaDeviceProp& properties, std::uint32_t scenes)
      : device_(device), properties_(properties), scenes_(scenes) {}

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
            [device = device_](const matrix::Layout& layout) {
              cuda::use_device_if_possible(device);
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
    cuda::use_device_if_possible(device_);
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
      state = std::make_unique<cuda::DeviceState<double>>(device_, model, share(), scenes_ > 1);
    } else {
      state = std::make_unique<cuda::DeviceState<float>>(device_, model, share(), scenes_ > 1);
    }
    return state;
  } catch (const cuda::CudaFailure& failure) {
    cudaGetLastError();
    return fail(ErrorCode::kResourceExhausted, std::string("CUDA: ") + failure.what() + free_memory(device_));
  }

 private:
  /// The free memory of a device in words, and a remedy if that is too little; empty if the device does not tell.
  static std::string free_memory(int device) {
    constexpr std::uint64_t kMiB = std::uint64_t{1} << 20;
    const auto memory = read_cuda_memory(static_cast<std::uint32_t>(device));
    if (!memory) return {};
    return " (" + std::to_string(memory->free / kMiB) + " of " + std::to_string(memory->total / kMiB) +
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
  const int device_;
  const cudaDeviceProp properties_;
  const std::uint32_t scenes_;
};

/// Returns the number of devices, or 0 and writes the reason to status.
int count_devices(cudaError_t& status) {
  int count = 0;
  status = cudaGetDeviceCount(&count);
  if (status == cudaSuccess) return count;
  cudaGetLastError();
  return 0;
}

/// Whether a scene is compiled alike for both, and gives the same bits.
bool are_of_a_kind(const cudaDeviceProp& a, const cudaDeviceProp& b) {
  const auto kind = [](const cudaDeviceProp& of) {
    return std::tuple(std::string_view(of.name), of.major, of.minor, of.multiProcessorCount, of.sharedMemPerBlockOptin,
                      of.sharedMemPerMultiprocessor, of.reservedSharedMemPerBlock);
  };
  return kind(a) == kind(b);
}

}  // namespace

std::vector<std::uint32_t> list_cuda_devices() {
  std::vector<std::uint32_t> devices;
  cudaError_t status{};
  cudaDeviceProp first{}, other{};
  for (int i = 0, count = count_devices(status); i < count; ++i) {
    if (cudaGetDeviceProperties(i == 0 ? &first : &other, i) != cudaSuccess) {
      cudaGetLastError();
      if (i == 0) return {};
      continue;
    }
    if (i == 0 || are_of_a_kind(first, other)) devices.push_back(static_cast<std::uint32_t>(i));
  }
  return devices;
}

Result<DeviceMemory> read_cuda_memory(std::uint32_t device) {
  std::size_t free = 0, total = 0;
  cuda::use_device_if_possible(static_cast<int>(device));
  if (cuda::current_device() == static_cast<int>(device) && cudaMemGetInfo(&free, &total) == cudaSuccess) {
    return DeviceMemory{free, total};
  }
  const std::string reason = cudaGetErrorString(cudaGetLastError());
  return fail(ErrorCode::kUnavailable, "GPU " + std::to_string(device) + " does not answer: " + reason);
}

Result<std::unique_ptr<Backend>> make_cuda_backend(std::uint32_t scenes, std::uint32_t device) {
  cudaError_t status{};
  const int count = count_devices(status);
  if (count == 0) {
    return fail(ErrorCode::kUnavailable, std::string("no CUDA device answers: ") +
                                             (status != cudaSuccess ? cudaGetErrorString(status) : "none"));
  }
  const int number = static_cast<int>(device);
  if (number >= count) {
    return fail(ErrorCode::kUnavailable, "there is no GPU " + std::to_string(device) + ": CUDA sees " +
                                             std::to_string(count) + ", from number 0");
  }
  cudaDeviceProp properties{};
  cudaFuncAttributes attributes{};
  cuda::use_device_if_possible(number);
  if (cudaGetDeviceProperties(&properties, number) != cudaSuccess) {
    cudaGetLastError();
    return fail(ErrorCode::kUnavailable, "the CUDA device does not tell its properties");
  }
  status = cudaFuncGetAttributes(&attributes, cuda::streamed_kernels().near);
  if (status != cudaSuccess) {
    cudaGetLastError();
    const bool has_no_code = status == cudaErrorNoKernelImageForDevice || status == cudaErrorInvalidDeviceFunction;
    const std::string name = properties.name;
    return fail(ErrorCode::kUnavailable, has_no_code
                                             ? "this build has no code for " + name +
                                                   "; configure with TENSORMASS_CUDA_ARCHITECTURES of its generation"
                                             : name + " does not answer: " + cudaGetErrorString(status));
  }
  return std::unique_ptr<Backend>(std::make_unique<CudaBackend>(number, properties, std::max(scenes, 1u)));
}

}  // namespace tensormass::backend
