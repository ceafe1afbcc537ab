#include "backend/cuda/resident_solve.cuh"

#include "backend/cuda/solve_kernels.h"

namespace tensormass::backend::cuda {

namespace {

template <unsigned Threads, int Rows, int Held>
ResidentKernel kernel() {
  return {Threads, Rows, Held, reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, true>),
          reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, false>)};
}

}  // namespace

std::span<const ResidentKernel> resident_kernels() {
  static const ResidentKernel kernels[] = {kernel<128, 1, 18>(), kernel<256, 1, 18>(), kernel<384, 1, 12>(),
                                           // Two rows a thread: half as many warps must wait for each other.
                                           kernel<224, 2, 8>(), kernel<kMaxResidentRows / 2, 2, 8>()};
  return kernels;
}

}  // namespace tensormass::backend::cuda
