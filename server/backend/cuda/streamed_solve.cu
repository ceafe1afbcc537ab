#include "backend/cuda/streamed_solve.cuh"

#include "backend/cuda/solve_kernels.h"

namespace tensormass::backend::cuda {

StreamedKernels streamed_kernels() {
  return {kStreamedThreads, reinterpret_cast<const void*>(&streamed_solve<kStreamedThreads, std::uint16_t, true>),
          reinterpret_cast<const void*>(&streamed_solve<kStreamedThreads, std::uint16_t, false>),
          reinterpret_cast<const void*>(&streamed_solve<kStreamedThreads, std::uint32_t, false>),
          Neighbour<std::uint16_t>::kMaxLocals};
}

}  // namespace tensormass::backend::cuda
