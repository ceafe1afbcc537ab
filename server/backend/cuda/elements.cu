#include "backend/cuda/elements.h"

#include "backend/cuda/launch.cuh"
#include "tensor/assembly.h"

// TM_LAW, an index into physics::Laws, comes from the build.
namespace tensormass::backend::cuda {

template <class Shape, class Law>
struct Elements {
  template <class Team, class Real>
  __device__ static void run(Team& team, const tensor::SceneView<Real>& s, const tensor::ElementView<Real>& e) {
    tensor::element_pass<Shape, Law>(team, s, e);
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
    kernels.tensors = reinterpret_cast<const void*>(&run_stage<Elements<Shape, Of>, Real, kStageThreads>);
    kernels.watch = reinterpret_cast<const void*>(&run_stage<Watch<Shape, Of>, Real>);
  });
  return kernels;
}

template ElementKernels element_kernels_of_law<TM_LAW, float>(int);
template ElementKernels element_kernels_of_law<TM_LAW, double>(int);

}  // namespace tensormass::backend::cuda
