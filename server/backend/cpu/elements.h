#pragma once

#include <utility>

#include "backend/cpu/team.h"
#include "physics/lists.h"
#include "view/scene.h"

/// The passes over elements on the CPU. elements.cpp is compiled once for each law, because these passes are many and
/// take longest to compile.
namespace tensormass::backend::cpu {

template <class Real>
using ElementPass = void (*)(const Team&, const view::SceneView<Real>&, const view::ElementView<Real>&);

template <class Real>
struct ElementPasses {
  ElementPass<Real> tensors = nullptr;   ///< matrix::element_pass
  ElementPass<Real> diagnose = nullptr;  ///< step::diagnose_elements
};

/// The passes of the law at index Law of physics::Laws.
template <int Law, class Real>
ElementPasses<Real> element_passes_of_law(int shape);

template <class Real>
ElementPasses<Real> element_passes(int shape, int law) {
  ElementPasses<Real> passes;
  [&]<int... Law>(std::integer_sequence<int, Law...>) {
    ((Law == law ? void(passes = element_passes_of_law<Law, Real>(shape)) : void()), ...);
  }
  (std::make_integer_sequence<int, physics::Laws::kCount>{});
  return passes;
}

}  // namespace tensormass::backend::cpu
