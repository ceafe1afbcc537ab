#include "backend/device_faults.h"

#undef NDEBUG  // one of the faults is an assertion
#include <cassert>
#include <cstdint>

#include <cuda_runtime.h>

namespace tensormass::tests {

namespace {

__global__ void commit(DeviceFault fault, char* place) {
  switch (fault) {
    case DeviceFault::kIllegalAddress:
      *reinterpret_cast<volatile int*>(std::uintptr_t{64}) = 1;
      break;
    case DeviceFault::kMisalignedAddress:
      *reinterpret_cast<volatile std::int64_t*>(place + 1) = 1;
      break;
    case DeviceFault::kAssert:
      assert(place == nullptr);
      break;
    case DeviceFault::kTrap:
      __trap();
      break;
  }
}

}  // namespace

std::vector<std::string> answers_to(DeviceFault fault) {
  char* place = nullptr;
  std::vector<std::string> answers;
  if (cudaMalloc(&place, 64) != cudaSuccess) return answers;
  commit<<<1, 1>>>(fault, place);
  answers.emplace_back(cudaGetErrorString(cudaDeviceSynchronize()));
  answers.emplace_back(cudaGetErrorString(cudaMalloc(&place, 64)));
  answers.emplace_back(cudaGetErrorString(cudaDeviceSynchronize()));
  return answers;
}

std::string make_current(int device) { return cudaGetErrorString(cudaSetDevice(device)); }

std::string answer_to_allocation(std::size_t bytes) {
  void* place = nullptr;
  const cudaError_t answer = cudaMalloc(&place, bytes);
  cudaGetLastError();
  cudaFree(place);
  return cudaGetErrorString(answer);
}

}  // namespace tensormass::tests
