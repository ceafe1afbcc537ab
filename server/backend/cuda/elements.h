#pragma once

#include <utility>

#include "physics/lists.h"

/// The element kernels. elements.cu is compiled once for each law, as on the CPU.
namespace tensormass::backend::cuda {

/// The kernel, of the signature of run_stage (launch.cuh), for the law at this index of physics::Laws.
template <int Law, class Real>
const void* element_kernel_of_law(int shape);

template <class Real>
const void* element_kernel(int shape, int law) {
  const void* kernel = nullptr;
  [&]<int... Law>(std::integer_sequence<int, Law...>) {
    ((Law == law ? void(kernel = element_kernel_of_law<Law, Real>(shape)) : void()), ...);
  }
  (std::make_integer_sequence<int, physics::Laws::kCount>{});
  return kernel;
}

}  // namespace tensormass::backend::cuda
