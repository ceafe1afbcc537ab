#pragma once

#include <tuple>
#include <type_traits>

#include "physics/element/hexahedron.h"
#include "physics/element/linear_tetrahedron.h"
#include "physics/element/pyramid.h"
#include "physics/element/quadratic_tetrahedron.h"
#include "physics/element/wedge.h"
#include "physics/material/corotational.h"
#include "physics/material/hencky.h"
#include "physics/material/hooke.h"
#include "physics/material/law.h"
#include "physics/material/mooney_rivlin.h"
#include "physics/material/neo_hookean.h"
#include "physics/material/ogden.h"
#include "physics/material/st_venant_kirchhoff.h"
#include "physics/material/stable_neo_hookean.h"
#include "physics/material/transversely_isotropic.h"

/// The shapes and the laws that exist. One line here generates dispatch, instantiation on every backend and the tests
/// that every shape and law must pass; the protocol's `Law.kind` names the law.
namespace tensormass::physics {

template <class... Types>
struct TypeList {
  static constexpr int kCount = sizeof...(Types);
};

/// In the order of mesh::Shape.
using Shapes = TypeList<LinearTetrahedron, Pyramid, Wedge, Hexahedron, QuadraticTetrahedron>;
using Laws = TypeList<Hooke, StVenantKirchhoff, Corotational, NeoHookean, StableNeoHookean, MooneyRivlin, Ogden,
                      TransverselyIsotropic, Hencky>;

namespace detail {
template <class... Types>
std::tuple<Types...> as_tuple(TypeList<Types...>);
template <Law... Types>
constexpr bool are_laws(TypeList<Types...>) {
  return true;
}
}  // namespace detail
static_assert(detail::are_laws(Laws{}));

/// The law at an index of the list.
template <int Index>
using LawAt = std::tuple_element_t<Index, decltype(detail::as_tuple(Laws{}))>;

/// A type as a value.
template <class T>
struct TypeTag {
  using Type = T;
};
/// Calls visit(TypeTag<T>{}, index) for each type in order.
template <class... Types, class Visit>
constexpr void for_each_type(TypeList<Types...>, Visit&& visit) {
  int index = 0;
  (visit(TypeTag<Types>{}, index++), ...);
}

/// Where a type stands in a list.
template <class T, class... Types>
constexpr int index_of(TypeList<Types...>) {
  int index = 0;
  const bool found = ((std::is_same_v<T, Types> || (++index, false)) || ...);
  return found ? index : -1;
}

/// kDecomposes of the law at an index of the list.
inline bool decomposes(int law) {
  bool out = false;
  for_each_type(Laws{}, [&](auto tag, int index) { out |= index == law && kDecomposes<typename decltype(tag)::Type>; });
  return out;
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
