#pragma once

#include <cstddef>
#include <utility>

#include "physics/lists.h"

/// The kernels over elements. elements.cu is compiled once for each law, as on the CPU.
namespace tensormass::backend::cuda {

struct ElementKernels {
  const void* assemble = nullptr;  ///< assemble_rows (rows.cuh), a block a slice
  bool keeps_neighbours = false;   ///< matrix::kKeepsNeighbours of the shape
  bool adds_in_turns = false;      ///< matrix::kAddsInTurns of the shape
  // With the signature of run_stage (launch.cuh):
  const void* internal_variables = nullptr;  ///< matrix::advance_internal_variables; does not reduce
  const void* lagged = nullptr;              ///< matrix::keep_elements; does not reduce
  const void* diagnostics = nullptr;         ///< step::diagnose_elements; reduces
};

/// The kernels of the law at index Law of physics::Laws.
template <int Law, class Real>
ElementKernels element_kernels_of_law(int shape);

template <class Real>
ElementKernels element_kernels(int shape, int law) {
  ElementKernels kernels;
  [&]<int... Law>(std::integer_sequence<int, Law...>) {
    ((Law == law ? void(kernels = element_kernels_of_law<Law, Real>(shape)) : void()), ...);
  }
  (std::make_integer_sequence<int, physics::Laws::kCount>{});
  return kernels;
}

}  // namespace tensormass::backend::cuda
