#include "backend/cuda/resident_solve.cuh"

#include "backend/cuda/solve_kernels.h"

namespace tensormass::backend::cuda {

namespace {

template <unsigned Threads, int Rows, int Held>
ResidentKernel kernel() {
  return {Threads, Rows, Held, reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, true, false>),
          reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, false, false>)};
}
/// One kernel for whole and partly, because each takes long to compile, and few scenes have links. Registers for the
/// links hold fewer blocks.
template <unsigned Threads, int Rows, int Held>
ResidentKernel linked_kernel() {
  const auto kernel = reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, false, true>);
  return {Threads, Rows, Held, kernel, kernel};
}

}  // namespace

std::span<const ResidentKernel> resident_kernels(bool linked) {
  static const ResidentKernel linked_kernels[] = {linked_kernel<256, 1, 14>(),
                                                  linked_kernel<kMaxResidentRows / 2, 2, 6>()};
  if (linked) return linked_kernels;
  static const ResidentKernel kernels[] = {kernel<128, 1, 18>(), kernel<256, 1, 18>(), kernel<384, 1, 12>(),
                                           // Two rows a thread: half as many warps must wait for each other.
                                           kernel<224, 2, 8>(), kernel<kMaxResidentRows / 2, 2, 8>()};
  return kernels;
}

}  // namespace tensormass::backend::cuda
