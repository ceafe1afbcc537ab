#include "backend/cpu/elements.h"

#include "tensor/assembly.h"

// TM_LAW, an index into physics::Laws, comes from the build.
namespace tensormass::backend::cpu {

template <int Law, class Real>
ElementPass<Real> element_pass_of_law(int shape) {
  ElementPass<Real> pass = nullptr;
  physics::for_each_type(physics::Shapes{}, [&](auto shape_tag, int index) {
    if (index == shape) {
      pass = &tensor::element_pass<typename decltype(shape_tag)::Type, physics::LawAt<Law>, Team, Real>;
    }
  });
  return pass;
}

template ElementPass<float> element_pass_of_law<TM_LAW, float>(int);
template ElementPass<double> element_pass_of_law<TM_LAW, double>(int);

}  // namespace tensormass::backend::cpu
