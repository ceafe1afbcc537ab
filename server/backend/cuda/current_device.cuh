#pragma once

#include <string>

#include <cuda_runtime.h>

#include "backend/cuda/memory.cuh"

/// The device that CUDA's calls of a thread concern.
///
///   thread of a loop ────────> CudaState of device 0      its device is current from the first step on
///   thread that cuts ────────> states of its scene        allocates beside the loop
///   threads of gRPC  ────────> states of any device       load, adjust, unload
///
/// CUDA remembers the current device for each thread. Most calls use it without saying so: allocations, copies without
/// a stream, launches, graphs and limits of kernels. Every entry of the backend therefore makes its device current,
/// and nobody relies on what was current before. A thread that stays with its device pays for a comparison.
namespace tensormass::backend::cuda {

/// Returns a negative number if CUDA does not tell.
inline int current_device() {
  int device = -1;
  return cudaGetDevice(&device) == cudaSuccess ? device : -1;
}

/// Makes a device current. CUDA may report the failure of another device here; this one works all the same. Throws
/// CudaFailure if the device does not become current.
inline void use_device(int device) {
  if (current_device() == device) return;
  const cudaError_t status = cudaSetDevice(device);
  if (status == cudaSuccess) return;
  cudaGetLastError();
  if (current_device() != device) check(status, "choice of a device");
}

/// The same where nothing may be thrown: what follows then fails by itself.
inline void use_device_if_possible(int device) noexcept {
  if (current_device() != device && cudaSetDevice(device) != cudaSuccess) cudaGetLastError();
}

}  // namespace tensormass::backend::cuda
