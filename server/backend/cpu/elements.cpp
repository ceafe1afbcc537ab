#include "backend/cpu/elements.h"

#include "tensor/assembly.h"

// TM_LAW, an index into physics::Laws, comes from the build.
namespace tensormass::backend::cpu {

template <int Law, class Real>
ElementPasses<Real> element_passes_of_law(int shape) {
  ElementPasses<Real> passes;
  physics::for_each_type(physics::Shapes{}, [&](auto shape_tag, int index) {
    using Shape = typename decltype(shape_tag)::Type;
    if (index != shape) return;
    passes.tensors = &tensor::element_pass<Shape, physics::LawAt<Law>, Team, Real>;
    passes.watch = &tensor::watch_elements<Shape, physics::LawAt<Law>, Team, Real>;
  });
  return passes;
}

template ElementPasses<float> element_passes_of_law<TM_LAW, float>(int);
template ElementPasses<double> element_passes_of_law<TM_LAW, double>(int);

}  // namespace tensormass::backend::cpu
