#pragma once

#include "physics/element/linear_tetrahedron.h"
#include "physics/material/hooke.h"
#include "physics/material/st_venant_kirchhoff.h"

/// The shapes and the laws that exist. One line here generates dispatch, instantiation on every backend and the tests
/// that every shape and law must pass; the protocol's `Law.kind` names the law.
namespace tensormass::physics {

template <class... Types>
struct TypeList {
  static constexpr int kCount = sizeof...(Types);
};

using Shapes = TypeList<LinearTetrahedron>;
using Laws = TypeList<Hooke, StVenantKirchhoff>;

/// Calls visit(type<T>, index) for each type in order.
template <class T>
struct TypeTag {
  using Type = T;
};
template <class... Types, class Visit>
constexpr void for_each_type(TypeList<Types...>, Visit&& visit) {
  int index = 0;
  (visit(TypeTag<Types>{}, index++), ...);
}

/// Calls visit(shape tag, law tag) for the pair at these indices of the lists. The indices are checked when a scene
/// is compiled.
template <class Visit>
void with_shape_and_law(int shape, int law, Visit&& visit) {
  for_each_type(Shapes{}, [&](auto shape_tag, int shape_index) {
    for_each_type(Laws{}, [&](auto law_tag, int law_index) {
      if (shape_index == shape && law_index == law) visit(shape_tag, law_tag);
    });
  });
}

}  // namespace tensormass::physics
