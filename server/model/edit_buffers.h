#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

#include "core/assert.h"
#include "model/model.h"

/// The buffers that an edit may change: each holds one vector of the model, converted to a type.
///
///                      +--> bind (bind.h): the whole vector, once
///   BufferOf<kRest> ──+
///                      +--> for_each_write: the entries that an edit lists
///
/// Both follow from the one description, so they cannot disagree. The tests compare the buffers of an edited state with
/// those that `bind` makes of the edited model, byte for byte.
namespace tensormass::model {

enum class EditBuffer : std::uint8_t {
  kRest,
  kInertia,
  kExternal,
  kMassEdges,
  kConstantEdges,
  kPressures,  ///< pressure_pa of the faces
  kCheckedTetrahedra,
  kRowBodies,
  kCenterRows,
  // The contact surface:
  kTriangleRows,
  kTriangleNeighbours,
  kTriangleAreas,
  kTriangleModuli,
  kCornerVertices,
  kTrianglesEnd,
  kSurfaceRows,
  kSurfaceEnd,
  kIncidence,
  kIncidenceEnd,
  // The visible surface:
  kVisibleRows,
  kVisibleWeights,
  // Contact between bodies:
  kCandidateModuli,
  kEdgeNumbers,
  kCount,
  // Those of a group (EditRange::group):
  kElementRows = kCount,
  kElementRest,        ///< kEdges: as ElementGroup::rest; else within the records
  kElementParameters,  ///< likewise ElementGroup::parameters
};

/// Entries of one vector of the model: begin, begin + step, ...
struct EditRange {
  EditBuffer buffer;
  std::uint32_t group = 0;
  std::uint32_t begin = 0, count = 0, step = 1;
};

/// A buffer of the scene. `Type` is its type on a device.
template <EditBuffer>
struct BufferOf;

#define TM_EDIT_BUFFER(buffer, member, name, type)             \
  template <>                                                  \
  struct BufferOf<EditBuffer::buffer> {                        \
    static constexpr std::string_view kName = name;            \
    template <class Real>                                      \
    using Type = type;                                         \
    static const auto& in(const Model& m) { return m.member; } \
  }
TM_EDIT_BUFFER(kRest, rest, "rest positions", Real);
TM_EDIT_BUFFER(kInertia, inertia, "inertia", Real);
TM_EDIT_BUFFER(kExternal, external, "external forces", Real);
TM_EDIT_BUFFER(kMassEdges, mass_edges, "consistent mass", Real);
TM_EDIT_BUFFER(kConstantEdges, constant_edges, "constant edge tensors", Real);
TM_EDIT_BUFFER(kPressures, pressure.faces, "pressure faces", view::PressureFace<Real>);
TM_EDIT_BUFFER(kCheckedTetrahedra, checked.rows, "checked tetrahedra", std::uint16_t);
TM_EDIT_BUFFER(kRowBodies, free_bodies.row_body, "free bodies of rows", std::uint32_t);
TM_EDIT_BUFFER(kCenterRows, free_bodies.center_rows, "centres of free bodies", std::uint32_t);
TM_EDIT_BUFFER(kTriangleRows, contact.triangle_rows, "contact triangles", std::uint32_t);
TM_EDIT_BUFFER(kTriangleNeighbours, contact.triangle_neighbours, "contact neighbours", std::uint32_t);
TM_EDIT_BUFFER(kTriangleAreas, contact.triangle_area, "contact areas", Real);
TM_EDIT_BUFFER(kTriangleModuli, contact.triangle_moduli, "contact moduli", Real);
TM_EDIT_BUFFER(kCornerVertices, contact.vertex_of_corner, "contact corners", std::uint32_t);
TM_EDIT_BUFFER(kTrianglesEnd, contact.triangles_end, "ends of contact triangles of patches", std::uint32_t);
TM_EDIT_BUFFER(kSurfaceRows, contact.surface_rows, "contact rows", std::uint32_t);
TM_EDIT_BUFFER(kSurfaceEnd, contact.surface_end, "ends of contact rows of patches", std::uint32_t);
TM_EDIT_BUFFER(kIncidence, contact.incidence, "contact incidence", std::uint32_t);
TM_EDIT_BUFFER(kIncidenceEnd, contact.incidence_end, "ends of contact incidence", std::uint32_t);
TM_EDIT_BUFFER(kVisibleRows, visible.rows, "visible rows", std::uint32_t);
TM_EDIT_BUFFER(kVisibleWeights, visible.weights, "visible weights", Real);
TM_EDIT_BUFFER(kCandidateModuli, links.candidate_modulus, "moduli of contact candidates", Real);
TM_EDIT_BUFFER(kEdgeNumbers, links.edge_numbers, "areas of sharp edges", Real);
#undef TM_EDIT_BUFFER

/// Places of the buffers of a scene, [EditBuffer]. Null: the scene does not need it.
using SceneBuffers = std::array<void*, static_cast<std::size_t>(EditBuffer::kCount)>;
/// The same of a group. kEdges has `rest` and `parameters`, other storages have `records`.
template <class Real>
struct GroupBuffers {
  std::uint32_t* rows = nullptr;
  Real* rest = nullptr;
  Real* parameters = nullptr;
  Real* records = nullptr;
};

/// Allocates a buffer of the scene, as `bind` does, and remembers where it is.
template <EditBuffer Buffer, class Real, class Arena>
auto* place_buffer(const Model& m, Arena& arena, SceneBuffers& buffers) {
  using Of = BufferOf<Buffer>;
  auto* const items = arena.template constant<typename Of::template Type<Real>>(Of::kName, Of::in(m));
  buffers[static_cast<std::size_t>(Buffer)] = items;
  return items;
}

/// Returns where the i-th entry of ElementGroup::rest is within the records of its group (view/elements.h).
inline std::size_t place_in_records(const ElementGroup& group, std::size_t i) {
  const std::size_t reals = group.rest.size() / group.stride / group.point_count;
  const std::size_t component = i / group.stride, element = i % group.stride;
  const std::size_t step = view::point_stride(static_cast<std::uint32_t>(reals), group.point_count);
  return element * group.record_reals() + component / reals * step + component % reals;
}

/// The same of the i-th entry of ElementGroup::parameters.
inline std::size_t place_of_parameter(const ElementGroup& group, std::size_t i) {
  const std::size_t reals = group.rest.size() / group.stride / group.point_count;
  const std::size_t step = view::point_stride(static_cast<std::uint32_t>(reals), group.point_count);
  return i % group.stride * group.record_reals() + group.point_count * step + i / group.stride;
}

namespace detail {

template <class Visit, std::size_t... Index>
void with_buffer(std::size_t buffer, const Visit& visit, std::index_sequence<Index...>) {
  ((Index == buffer ? visit(std::integral_constant<EditBuffer, static_cast<EditBuffer>(Index)>{}) : void()), ...);
}

}  // namespace detail

/// Visits what an edit writes to the buffers of a scene and its groups.
///
///   write(to, from, bytes)   is called for each entry, converted to its type on the device; `to` points into a buffer
///                            and is only an address here: it may be one of another device
template <class Real, class Write>
void for_each_write(const Model& m, const std::vector<EditRange>& ranges, const SceneBuffers& scene,
                    const std::vector<GroupBuffers<Real>>& groups, const Write& write) {
  const auto each = [](const EditRange& range, std::size_t size, const auto& visit) {
    TM_ASSERT(range.count == 0 || range.begin + std::size_t{range.step} * (range.count - 1) < size,
              "an edit stays within the vectors of its model");
    for (std::size_t n = 0; n < range.count; ++n) visit(range.begin + n * range.step);
  };
  for (const EditRange& range : ranges) {
    if (range.buffer == EditBuffer::kElementRows) {
      const std::vector<std::uint32_t>& rows = m.groups[range.group].rows;
      each(range, rows.size(), [&](std::size_t i) { write(groups[range.group].rows + i, &rows[i], sizeof rows[i]); });
    } else if (range.buffer == EditBuffer::kElementRest) {
      const ElementGroup& group = m.groups[range.group];
      const GroupBuffers<Real>& to = groups[range.group];
      each(range, group.rest.size(), [&](std::size_t i) {
        const Real value = static_cast<Real>(group.rest[i]);
        write(to.rest != nullptr ? to.rest + i : to.records + place_in_records(group, i), &value, sizeof value);
      });
    } else if (range.buffer == EditBuffer::kElementParameters) {
      const ElementGroup& group = m.groups[range.group];
      const GroupBuffers<Real>& to = groups[range.group];
      each(range, group.parameters.size(), [&](std::size_t i) {
        const Real value = static_cast<Real>(group.parameters[i]);
        write(to.records == nullptr ? to.parameters + i : to.records + place_of_parameter(group, i), &value,
              sizeof value);
      });
    } else {
      constexpr auto kBuffers = static_cast<std::size_t>(EditBuffer::kCount);
      const auto buffer = static_cast<std::size_t>(range.buffer);
      detail::with_buffer(
          buffer,
          [&](auto tag) {
            using Of = BufferOf<decltype(tag)::value>;
            using Type = typename Of::template Type<Real>;
            const auto& items = Of::in(m);
            Type* const to = static_cast<Type*>(scene[buffer]);
            each(range, items.size(), [&](std::size_t i) {
              if constexpr (decltype(tag)::value == EditBuffer::kPressures) {
                const Real value = static_cast<Real>(items[i].pressure_pa);  // the rest of a face never changes
                write(&to[i].pressure_pa, &value, sizeof value);
              } else {
                const Type value = static_cast<Type>(items[i]);
                write(to + i, &value, sizeof value);
              }
            });
          },
          std::make_index_sequence<kBuffers>{});
    }
  }
}

}  // namespace tensormass::model
