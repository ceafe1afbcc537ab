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

template <int Law, class Real>
const void* element_kernel_of_law(int shape) {
  const void* kernel = nullptr;
  physics::for_each_type(physics::Shapes{}, [&](auto shape_tag, int index) {
    using Pass = Elements<typename decltype(shape_tag)::Type, physics::LawAt<Law>>;
    if (index == shape) kernel = reinterpret_cast<const void*>(&run_stage<Pass, Real, kStageThreads>);
  });
  return kernel;
}

template const void* element_kernel_of_law<TM_LAW, float>(int);
template const void* element_kernel_of_law<TM_LAW, double>(int);

}  // namespace tensormass::backend::cuda
