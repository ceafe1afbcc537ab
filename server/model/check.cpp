#include "model/check.h"

#include <algorithm>

#include "core/assert.h"
#include "core/offsets.h"
#include "physics/lists.h"

namespace tensormass::model {

namespace {

using view::kSliceRows;

template <class T>
bool is_empty_or(const std::vector<T>& items, std::size_t size) {
  return items.empty() || items.size() == size;
}

template <class Items>
bool are_below(const Items& items, std::uint32_t end) {
  return std::all_of(items.begin(), items.end(), [end](std::uint32_t item) { return item < end; });
}

void check_row_lists(const ElementGroup& group, const matrix::Layout& layout) {
  const matrix::RowLists& lists = group.row_lists;
  TM_ASSERT(lists.place_bits == 8 || lists.place_bits == 16, "places have 8 or 16 bits");
  TM_ASSERT(lists.listed.size() % kSliceRows == 0, "a list column has an element for each row of a slice");
  TM_ASSERT(lists.places.size() % kSliceRows == 0, "a list column has places for each row of a slice");
  const std::size_t columns = lists.listed.size() / kSliceRows;
  for (const view::ListedSlice& slice : lists.slices) {
    TM_ASSERT(slice.slice() < layout.row_count / kSliceRows, "lists are those of slices");
    TM_ASSERT(slice.list_begin <= slice.list_end && slice.list_end <= columns, "lists lie within their columns");
  }
}

void check_patch_elements(const ElementGroup& group, const matrix::Layout& layout) {
  TM_ASSERT(group.patch_elements.size() == 2 * std::size_t{layout.patch_count}, "each patch has a range of elements");
  for (std::size_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::uint32_t first = group.patch_elements[2 * patch], last = group.patch_elements[2 * patch + 1];
    TM_ASSERT(first % kSliceRows == 0, "the elements of a patch start at a vector register");
    TM_ASSERT(first <= last && last <= group.stride, "the elements of a patch lie within the group");
  }
  TM_ASSERT(group.pair_places.size() % group.stride == 0, "pair_places: [pairs][stride]");
}

void check_group(const ElementGroup& group, const matrix::Layout& layout) {
  TM_ASSERT(group.element_count > 0 && group.point_count > 0, "a group has elements, and these have points");
  TM_ASSERT(group.stride % kSliceRows == 0, "elements are padded to whole vector registers and warps");
  TM_ASSERT(group.stride >= group.element_count, "each element has a place");
  TM_ASSERT(group.elements.size() <= group.stride, "each place has at most one element");
  TM_ASSERT(!group.rows.empty() && group.rows.size() % group.stride == 0, "rows: [shape nodes][stride]");
  TM_ASSERT(are_below(group.rows, layout.row_count), "elements name rows of the layout");
  TM_ASSERT(!group.rest.empty() && group.rest.size() % (std::size_t{group.point_count} * group.stride) == 0,
            "rest: [point_count][rest reals][stride]");
  TM_ASSERT(group.parameters.size() % group.stride == 0, "parameters: [law parameters][stride]");
  TM_ASSERT(is_empty_or(group.shares, group.point_count), "each point has its weights, or none has");
  TM_ASSERT(group.prony.size() <= physics::kMaxPronyTerms, "ElementView has room for the Prony terms");
  TM_ASSERT(is_empty_or(group.members, kMaxClusterElements * std::size_t{group.stride}) &&
                group.member_parts.size() == group.members.size(),
            "members, member_parts: [kMaxClusterElements][stride]");
  TM_ASSERT(group.record_reals() % 4 == 0, "records start at multiples of four reals");
  if (layout.storage == matrix::Storage::kEdges) {
    check_patch_elements(group, layout);
  } else {
    check_row_lists(group, layout);
  }
}

void check_boundary(const Model& m) {
  const std::size_t patches = m.layout.patch_count;
  const PrescribedRows& prescribed = m.prescribed_rows;
  TM_ASSERT(prescribed.rows.size() % 3 == 0, "an entry is row, displacement, directions");
  if (!prescribed.rows.empty()) assert_offsets(prescribed.patch_begin, patches, prescribed.rows.size() / 3);
  for (std::size_t i = 0; i < prescribed.rows.size(); i += 3) {
    TM_ASSERT(prescribed.rows[i] < m.layout.row_count, "displacements are prescribed to rows of the layout");
    TM_ASSERT(prescribed.rows[i + 1] < m.prescribed.size(), "each prescribed row has a displacement");
  }
  if (!m.pressure.faces.empty()) {
    assert_offsets(m.pressure.patch_begin, patches, m.pressure.rows.size());
    assert_offsets(m.pressure.corner_begin, m.pressure.rows.size(), m.pressure.corners.size() / 2);
    TM_ASSERT(m.pressure.slots.size() == physics::kMaxFaceNodes * (m.pressure.corners.size() / 2),
              "each pressed corner has a slot for each node of a face");
    TM_ASSERT(are_below(m.pressure.rows, m.layout.row_count), "pressure acts on rows of the layout");
  }
  const ScheduledLoads& scheduled = m.scheduled;
  const auto schedules = static_cast<std::uint32_t>(scheduled.schedules.size());
  TM_ASSERT(scheduled.of_entry.size() == scheduled.rows.size() && scheduled.forces.size() == 3 * scheduled.rows.size(),
            "an entry is row, schedule, force");
  TM_ASSERT(std::is_sorted(scheduled.rows.begin(), scheduled.rows.end()), "rows of scheduled forces ascend");
  TM_ASSERT(are_below(scheduled.rows, m.layout.row_count) && are_below(scheduled.of_entry, schedules),
            "scheduled forces name rows of the layout and schedules");
  TM_ASSERT(scheduled.rows.empty() || !m.external.empty(), "a scene with scheduled forces has external forces");
  TM_ASSERT(is_empty_or(scheduled.of_face, m.pressure.faces.size()), "each pressure face has a schedule or kNone");
}

void check_surfaces(const Model& m) {
  const ContactSurface& contact = m.contact;
  const std::size_t triangles = contact.triangle_count();
  TM_ASSERT(triangles == 0 || !m.tools.empty() || m.links.candidate_count() > 0,
            "only scenes with tools or contact between bodies have a contact surface");
  std::uint32_t core_points = 0, contact_points = 0;
  for (const ToolModel& tool : m.tools) {
    TM_ASSERT(tool.kind < std::uint32_t{physics::Tools::kCount}, "a tool has a kind of the list");
    TM_ASSERT(tool.first_core_point == core_points, "core points of tools follow each other");
    TM_ASSERT(tool.first_contact_point == contact_points, "contact points of tools follow each other");
    core_points += tool.core_points;
    contact_points += tool.contact_points;
  }
  if (triangles > 0) {
    assert_offsets(contact.patch_triangles, m.layout.patch_count, contact.outer_count());
    assert_offsets(contact.patch_surface, m.layout.patch_count, contact.surface_rows.size());
    assert_offsets(contact.incidence_begin, contact.surface_rows.size(), contact.incidence.size() / 4);
  }
  const CarriedTriangles& carried = contact.carried;
  const std::size_t outer = contact.outer_count(), vertices = contact.surface_rows.size();
  TM_ASSERT(outer + carried.count() == triangles && contact.triangle_neighbours.size() == 3 * triangles &&
                contact.vertex_of_corner.size() == 3 * triangles,
            "a triangle has three corners");
  TM_ASSERT(are_below(contact.triangle_rows, m.layout.row_count), "triangles name rows of the layout");
  const auto all_vertices =
      static_cast<std::uint32_t>(carried.count() == 0 ? vertices : carried.around_begin.size() - 1);
  TM_ASSERT(are_below(contact.vertex_of_corner, all_vertices), "triangles name vertices");
  if (carried.count() > 0) {
    TM_ASSERT(are_below(carried.rows, m.layout.row_count), "triangles name rows of the layout");
    TM_ASSERT(carried.weights.size() == 12 * std::size_t{carried.count()} && carried.twins.size() == carried.count(),
              "a corner has a weight for each row");
    TM_ASSERT(carried.patch_triangles.front() == outer && carried.patch_triangles.back() == triangles,
              "carried triangles follow the others");
    TM_ASSERT(carried.patch_rows.size() == m.layout.patch_count + 1 &&
                  carried.entry_begin.size() == vertices + carried.patch_rows.back() + 1 &&
                  carried.entries.size() == 5 * std::size_t{carried.entry_begin.back()} &&
                  carried.around.size() == 2 * std::size_t{carried.around_begin.back()},
              "rows and vertices list the triangles around them");
  }
  TM_ASSERT(m.visible.rows.size() % 4 == 0 && m.visible.weights.size() == m.visible.rows.size(),
            "a visible vertex has four rows and their weights");
  TM_ASSERT(are_below(m.visible.rows, m.layout.row_count), "visible vertices name rows of the layout");
  TM_ASSERT(m.visible.vertex_count <= m.visible.count(), "ends of springs come after the vertices");
  std::size_t springs = 0;
  for (const VisibleAttachment& attachment : m.attachments) {
    springs += attachment.springs.size();
    TM_ASSERT(attachment.rest_lengths_m.size() == attachment.springs.size(), "a spring has a length at rest");
    for (const auto& ends : attachment.springs) {
      TM_ASSERT(are_below(ends, m.visible.attachment_point_count()), "springs name attachment points");
    }
  }
  TM_ASSERT(m.attachments.empty() || springs == m.links.spring_count(), "clients see all springs");
}

void check_links(const Model& m) {
  const Links& links = m.links;
  if (links.count() == 0) return;
  const std::size_t patches = m.layout.patch_count, sides = links.side_groups.size() / 3;
  TM_ASSERT(m.solve != SolveKind::kStreamed, "the streamed solve knows no links");
  assert_offsets(links.patch_rows, patches, links.rows.size());
  TM_ASSERT(are_below(links.rows, m.layout.row_count) && links.row_place.size() == m.layout.row_count,
            "links name rows of the layout");
  if (links.candidate_count() > 0) assert_offsets(links.patch_candidates, patches, links.candidate_count());
  if (links.spring_count() > 0) assert_offsets(links.patch_springs, patches, links.spring_count());
  TM_ASSERT(links.spring_places.size() == links.spring_count() && are_below(links.spring_places, links.spring_count()),
            "a spring of the scene has a place");
  if (!links.attachment_begin.empty()) {
    assert_offsets(links.attachment_begin, links.attachment_begin.size() - 1, links.spring_count());
  }
  TM_ASSERT(links.candidates.size() == 2 * std::size_t{links.candidate_count()}, "a candidate has a vertex and a side");
  for (std::size_t i = 0; i < links.candidates.size(); i += 2) {
    TM_ASSERT(links.candidates[i] < m.contact.surface_rows.size() && links.candidates[i + 1] < sides,
              "it names those that exist");
  }
  TM_ASSERT(links.side_numbers.size() == view::kSideNumbers * sides, "each side has its numbers");
  TM_ASSERT(links.leaf_count() % view::kGroupLeaves == 0, "groups of leaves are full");
  for (std::size_t side = 0; side < sides; ++side) {
    TM_ASSERT(links.side_groups[3 * side] <= links.side_groups[3 * side + 1] &&
                  links.side_groups[3 * side + 1] * view::kGroupLeaves <= links.leaf_count(),
              "a side has groups of leaves");
  }
  TM_ASSERT(are_below(links.spring_rows, m.layout.row_count), "springs name rows of the layout");
  TM_ASSERT(links.spring_numbers.size() == 3 * std::size_t{links.spring_count()}, "each spring has its numbers");
  if (links.edge_candidate_count() == 0) return;
  const std::size_t edges = links.edge_rows.size() / 4;
  TM_ASSERT(are_below(links.edge_rows, m.layout.row_count), "edges name rows of the layout");
  TM_ASSERT(links.edge_numbers.size() == view::kEdgeNumbers * edges, "each edge has its numbers");
  TM_ASSERT(links.triangle_edges.size() == m.contact.triangle_rows.size(), "a triangle has three edges");
  for (const std::uint32_t edge : links.triangle_edges) {
    TM_ASSERT(edge < edges || edge == view::kNoEntry, "triangles name edges that exist");
  }
  assert_offsets(links.patch_edge_candidates, patches, links.edge_candidate_count());
  for (std::size_t i = 0; i < links.edge_candidates.size(); i += 2) {
    TM_ASSERT(links.edge_candidates[i] < edges && links.edge_candidates[i + 1] < sides, "it names those that exist");
  }
}

}  // namespace

void check_model(const Model& m) {
  const std::size_t rows = m.layout.row_count, slots = m.layout.slot_count();
  TM_ASSERT(m.rest.size() == 4 * rows && m.inertia.size() == 4 * rows && m.row_mass.size() == rows,
            "each row has a position at rest and a mass");
  TM_ASSERT(is_empty_or(m.external, 4 * rows), "each row has an external force, or none has");
  TM_ASSERT(is_empty_or(m.initial_displacement, 4 * rows) && is_empty_or(m.initial_velocity, 4 * rows),
            "each row has an initial state, or all are at rest");
  TM_ASSERT(is_empty_or(m.constant_edges, 9 * slots), "each slot has a constant tensor, or none has");
  TM_ASSERT(is_empty_or(m.mass_edges, slots), "each slot has a consistent mass, or none has");
  TM_ASSERT(is_empty_or(m.begun_slices, rows / kSliceRows), "each slice has a flag, or none has");
  TM_ASSERT(std::is_partitioned(m.groups.begin(), m.groups.end(), [](const auto& group) { return !group.is_constant; }),
            "groups whose tensors are computed in each step come first");
  for (const ElementGroup& group : m.groups) check_group(group, m.layout);
  if (!m.checked.rows.empty()) {
    assert_offsets(m.checked.begin, 2 * std::size_t{m.layout.patch_count}, m.checked.rows.size() / 4);
  }
  check_boundary(m);
  check_surfaces(m);
  check_links(m);
}

}  // namespace tensormass::model
