#pragma once

#include <tuple>
#include <type_traits>

#include "physics/element/hexahedron.h"
#include "physics/element/linear_tetrahedron.h"
#include "physics/element/pyramid.h"
#include "physics/element/quadratic_hexahedron.h"
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
#include "physics/tool/box_solid.h"
#include "physics/tool/capsule.h"
#include "physics/tool/grasper.h"
#include "physics/tool/mesh_solid.h"
#include "physics/tool/plane.h"
#include "physics/tool/retractor.h"
#include "physics/tool/scalpel.h"
#include "physics/tool/scissors.h"
#include "physics/tool/spherical_probe.h"
#include "physics/tool/tool.h"

/// The lists of all shapes, all laws and all kinds of tools. One line here generates dispatch, instantiation on every
/// backend and the tests that every entry must pass. The kName of a law is its name in the protocol's `Law.kind`, that
/// of a tool in `Tool.kind`.
namespace tensormass::physics {

/// A list of types.
template <class... Types>
struct TypeList {
  static constexpr int kCount = sizeof...(Types);
};

/// All shapes, in the order of mesh::Shape.
using Shapes = TypeList<LinearTetrahedron, Pyramid, Wedge, Hexahedron, QuadraticTetrahedron, QuadraticHexahedron>;
/// All laws. Their indices are internal; the protocol uses names.
using Laws = TypeList<Hooke, StVenantKirchhoff, Corotational, NeoHookean, StableNeoHookean, MooneyRivlin, Ogden,
                      TransverselyIsotropic, Hencky>;
/// All kinds of tools. Their indices are internal; the protocol uses names.
using ThinTools = TypeList<SphericalProbe, Capsule, Retractor, Grasper>;
using SolidTools = TypeList<BoxSolid, Plane, MeshSolid>;
using Blades = TypeList<Scalpel, Scissors>;

namespace detail {
template <class... First, class... Second>
TypeList<First..., Second...> joined(TypeList<First...>, TypeList<Second...>);
}  // namespace detail

using Tools = decltype(detail::joined(detail::joined(ThinTools{}, SolidTools{}), Blades{}));

namespace detail {
template <class... Types>
std::tuple<Types...> as_tuple(TypeList<Types...>);
template <Law... Types>
constexpr bool are_laws(TypeList<Types...>) {
  return true;
}
template <Tool... Types>
constexpr bool are_tools(TypeList<Types...>) {
  return ((Types::kJoints.size() <= limits::kMaxToolJoints && Types::kParameters.size() <= limits::kMaxToolParameters &&
           Types::kCorePoints <= limits::kMaxCorePoints) &&
          ...);
}
template <BladeTool... Types>
constexpr bool are_blades(TypeList<Types...>) {
  return true;
}
}  // namespace detail
static_assert(detail::are_laws(Laws{}));
static_assert(detail::are_tools(Tools{}));
static_assert(detail::are_blades(Blades{}));

/// The place in `Tools` from which on all kinds are blades.
inline constexpr int kFirstBlade = Tools::kCount - Blades::kCount;

/// The law at an index of the list.
template <int Index>
using LawAt = std::tuple_element_t<Index, decltype(detail::as_tuple(Laws{}))>;

/// A type as a value, to pass it to a generic lambda.
template <class T>
struct TypeTag {
  using Type = T;
};
/// Visits each type of a list in order.
///
///   visit(TypeTag<T>{}, index)   is called once for each type T
template <class... Types, class Visit>
constexpr void for_each_type(TypeList<Types...>, Visit&& visit) {
  int index = 0;
  (visit(TypeTag<Types>{}, index++), ...);
}

/// Returns the index of a type in a list; −1 if it is not in the list.
template <class T, class... Types>
constexpr int index_of(TypeList<Types...>) {
  int index = 0;
  const bool found = ((std::is_same_v<T, Types> || (++index, false)) || ...);
  return found ? index : -1;
}

/// Returns kDecomposes of the law at an index of the list; false for any other index.
inline bool decomposes(int law) {
  bool out = false;
  for_each_type(Laws{}, [&](auto tag, int index) { out |= index == law && kDecomposes<typename decltype(tag)::Type>; });
  return out;
}

/// Visits the pair of types at these indices of the lists. Indices out of range visit nothing; they are checked when a
/// scene is compiled.
///
///   visit(TypeTag<Shape>{}, TypeTag<Law>{})   is called once
template <class Visit>
void with_shape_and_law(int shape, int law, Visit&& visit) {
  for_each_type(Shapes{}, [&](auto shape_tag, int shape_index) {
    for_each_type(Laws{}, [&](auto law_tag, int law_index) {
      if (shape_index == shape && law_index == law) visit(shape_tag, law_tag);
    });
  });
}

namespace detail {
template <class... Types, class Visit>
TM_HOST_DEVICE void with_type_at(TypeList<Types...>, std::uint32_t place, const Visit& visit) {
  std::uint32_t index = 0;
  ((index++ == place ? visit(TypeTag<Types>{}) : void()), ...);
}
}  // namespace detail

/// Visits the kind of tool at a place in `Tools`. A place that is out of range visits nothing.
///
///   visit(TypeTag<Tool>{})   is called once
template <class Visit>
TM_HOST_DEVICE void with_tool(std::uint32_t kind, const Visit& visit) {
  detail::with_type_at(Tools{}, kind, visit);
}
/// The same for a kind that is a blade; any other visits nothing.
template <class Visit>
TM_HOST_DEVICE void with_blade(std::uint32_t kind, const Visit& visit) {
  detail::with_type_at(Blades{}, kind - static_cast<std::uint32_t>(kFirstBlade), visit);
}

}  // namespace tensormass::physics
