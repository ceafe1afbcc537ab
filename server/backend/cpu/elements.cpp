#include "backend/cpu/elements.h"

#include "matrix/edge_assembly.h"
#include "step/diagnostics.h"

// TM_LAW, an index into physics::Laws, comes from the build.
namespace tensormass::backend::cpu {

namespace {

/// Calls a stage over elements with the parts of the scene that it may touch, as step/run.h does for other stages.
template <class Shape, class Law, class Real>
void element_tensors(const Team& team, const view::SceneView<Real>& s, const view::ElementView<Real>& e) {
  matrix::element_pass<Shape, Law>(team, s.patches, s.state, s.matrix, s.newton, e);
}
template <class Shape, class Law, class Real>
void diagnose(const Team& team, const view::SceneView<Real>& s, const view::ElementView<Real>& e) {
  step::diagnose_elements<Shape, Law>(team, s.patches, s.state, s.guard, e);
}

}  // namespace

template <int Law, class Real>
ElementPasses<Real> element_passes_of_law(int shape) {
  ElementPasses<Real> passes;
  physics::for_each_type(physics::Shapes{}, [&](auto shape_tag, int index) {
    using Shape = typename decltype(shape_tag)::Type;
    if (index != shape) return;
    passes.tensors = &element_tensors<Shape, physics::LawAt<Law>, Real>;
    passes.diagnose = &diagnose<Shape, physics::LawAt<Law>, Real>;
  });
  return passes;
}

template ElementPasses<float> element_passes_of_law<TM_LAW, float>(int);
template ElementPasses<double> element_passes_of_law<TM_LAW, double>(int);

}  // namespace tensormass::backend::cpu
