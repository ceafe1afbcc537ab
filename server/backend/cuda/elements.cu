#include "backend/cuda/elements.h"

#include "backend/cuda/launch.cuh"
#include "backend/cuda/rows.cuh"

// TM_LAW, an index into physics::Laws, comes from the build.
namespace tensormass::backend::cuda {

template <class Shape, class Law>
struct MoveHistories {
  template <class Team, class Real>
  __device__ static void run(Team& team, const SceneView<Real>& s, const ElementView<Real>& e) {
    tensor::move_histories<Shape, Law>(team, s, e);
  }
};

template <class Shape, class Law>
struct Watch {
  template <class Team, class Real>
  __device__ static void run(Team& team, const tensor::SceneView<Real>& s, const tensor::ElementView<Real>& e) {
    tensor::watch_elements<Shape, Law>(team, s, e);
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
    kernels.keeps_neighbours = tensor::kKeepsNeighbours<Shape>;
    kernels.adds_in_turns = tensor::kAddsInTurns<Shape>;
    kernels.move_histories = reinterpret_cast<const void*>(&run_stage<MoveHistories<Shape, Of>, Real, kStageThreads>);
    kernels.watch = reinterpret_cast<const void*>(&run_stage<Watch<Shape, Of>, Real>);
  });
  return kernels;
}

template ElementKernels element_kernels_of_law<TM_LAW, float>(int);
template ElementKernels element_kernels_of_law<TM_LAW, double>(int);

}  // namespace tensormass::backend::cuda
