#include "backend/cuda/elements.h"

#include "backend/cuda/launch.cuh"
#include "backend/cuda/rows.cuh"
#include "step/diagnostics.h"

// TM_LAW, an index into physics::Laws, comes from the build.
namespace tensormass::backend::cuda {

/// Calls a stage over elements with the parts of the scene that it may touch, as step/run.h does for other stages.
template <class Shape, class Law>
struct InternalVariables {
  template <class Team, class Real>
  __device__ static void run(Team& team, const view::SceneView<Real>& s, const view::ElementView<Real>& e) {
    matrix::advance_internal_variables<Shape, Law>(team, s.patches, s.state, s.newton, e);
  }
};

template <class Shape, class Law>
struct LaggedElements {
  template <class Team, class Real>
  __device__ static void run(Team& team, const view::SceneView<Real>& s, const view::ElementView<Real>& e) {
    matrix::keep_elements<Shape, Law>(team, s.patches, s.state, s.matrix, s.newton, e);
  }
};

template <class Shape, class Law>
struct Diagnostics {
  template <class Team, class Real>
  __device__ static void run(Team& team, const view::SceneView<Real>& s, const view::ElementView<Real>& e) {
    step::diagnose_elements<Shape, Law>(team, s.patches, s.state, s.guard, e);
  }
};

template <int Law, class Real>
ElementKernels element_kernels_of_law(int shape) {
  ElementKernels kernels;
  physics::for_each_type(physics::Shapes{}, [&](auto shape_tag, int index) {
    using Shape = typename decltype(shape_tag)::Type;
    using Of = physics::LawAt<Law>;
    if (index != shape) return;
    kernels.assemble = reinterpret_cast<const void*>(&assemble_rows<Shape, Of, Real>);
    kernels.keeps_neighbours = matrix::kKeepsNeighbours<Shape>;
    kernels.adds_in_turns = matrix::kAddsInTurns<Shape>;
    kernels.internal_variables =
        reinterpret_cast<const void*>(&run_stage<InternalVariables<Shape, Of>, Real, kStageThreads>);
    kernels.lagged = reinterpret_cast<const void*>(&run_stage<LaggedElements<Shape, Of>, Real, kStageThreads>);
    kernels.diagnostics = reinterpret_cast<const void*>(&run_stage<Diagnostics<Shape, Of>, Real>);
  });
  return kernels;
}

template ElementKernels element_kernels_of_law<TM_LAW, float>(int);
template ElementKernels element_kernels_of_law<TM_LAW, double>(int);

}  // namespace tensormass::backend::cuda
