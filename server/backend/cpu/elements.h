#pragma once

#include <utility>

#include "backend/cpu/team.h"
#include "physics/lists.h"
#include "tensor/view.h"

/// The element passes of the CPU. elements.cpp is compiled once for each law: they are many, and the longest to
/// compile.
namespace tensormass::backend::cpu {

template <class Real>
using ElementPass = void (*)(const Team&, const tensor::SceneView<Real>&, const tensor::ElementView<Real>&);

/// Of the law at this index of physics::Laws.
template <int Law, class Real>
ElementPass<Real> element_pass_of_law(int shape);

template <class Real>
ElementPass<Real> element_pass(int shape, int law) {
  ElementPass<Real> pass = nullptr;
  [&]<int... Law>(std::integer_sequence<int, Law...>) {
    ((Law == law ? void(pass = element_pass_of_law<Law, Real>(shape)) : void()), ...);
  }
  (std::make_integer_sequence<int, physics::Laws::kCount>{});
  return pass;
}

}  // namespace tensormass::backend::cpu
