#include <algorithm>
#include <array>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"
#include "model/coagulation.h"
#include "model/edit.h"

/// The surfaces of a scene that is edited: what tools can touch, and what clients see.
///
///   an element goes ──> its faces that were in sight: their triangles go
///                  └──> faces of the elements behind it come to light: new triangles
///
/// The contact surface has no gaps: the last triangle of a patch takes the place of one that goes. What clients see is
/// append-only: triangles die where they are, and new ones come at the end.
namespace tensormass::model {

namespace {

using mesh::kNone;

}  // namespace

Result<void> Editor::check_surfaces(const Model& m, std::span<const Ablation> ablations) const {
  if (!has_contact() && !has_clients()) return {};
  const std::size_t patches = m.layout.patch_count, rows = m.layout.row_count;
  const auto for_each_change = [&](const auto& visit) {  // visit(piece, whether it comes)
    for (const Ablation& one : ablations) {
      if (!will_go(one.element)) continue;
      for (const std::uint32_t face : tables().faces[one.element]) {
        const std::uint32_t behind = tables().face_behind[face];
        const bool in_sight = behind == kNone || is_gone(tables().face_element[behind]);
        if (!in_sight && will_go(tables().face_element[behind])) continue;
        const std::uint32_t changed = in_sight ? face : behind;
        for (std::uint32_t p = tables().pieces.begin[changed]; p < tables().pieces.begin[changed + 1]; ++p) {
          visit(p, !in_sight);
        }
      }
    }
  };
  std::size_t new_triangles = 0, new_vertices = 0;
  for_each_change([&](std::uint32_t piece, bool comes) {
    const auto& corners = tables().pieces.items[piece];
    const std::int32_t by = comes ? 1 : -1;
    change_[m.layout.patch_of_row(corners[0])] += by;
    for (const std::uint32_t row : corners) {
      change_[patches + row] += by;
      if (comes && visible_vertex_[row] == kNone && change_[patches + rows + row]++ == 0) ++new_vertices;
    }
    if (comes) ++new_triangles;
  });
  count_torn_skin(m, ablations, new_triangles, new_vertices);
  bool fits = true;
  const ContactSurface& contact = m.contact;
  for_each_change([&](std::uint32_t piece, bool) {
    const auto& corners = tables().pieces.items[piece];
    const std::uint32_t patch = m.layout.patch_of_row(corners[0]);
    if (has_contact()) {
      const auto room = [](std::uint32_t begin, std::uint32_t end) { return static_cast<std::int64_t>(end) - begin; };
      fits = fits && room(contact.triangles_end[patch], contact.patch_triangles[patch + 1]) >= change_[patch];
      for (const std::uint32_t row : corners) {
        const std::uint32_t v = surface_vertex_[row];
        const std::int64_t left = v == kNone ? std::int64_t{kRoomOfNewVertex}
                                             : room(contact.incidence_end[v], contact.incidence_begin[v + 1]);
        fits = fits && left >= change_[patches + row];
      }
    }
  });
  for_each_change([&](std::uint32_t piece, bool) {
    const auto& corners = tables().pieces.items[piece];
    change_[m.layout.patch_of_row(corners[0])] = 0;
    for (const std::uint32_t row : corners) change_[patches + row] = change_[patches + rows + row] = 0;
  });
  if (!fits) {
    return fail(ErrorCode::kResourceExhausted,
                "the contact surface has no room for what comes to light: too many triangles meet in one place; ablate "
                "the loose elements there too, or reset the scene");
  }
  if (!has_clients()) return {};
  if (appended_triangles_ + new_triangles > tables().max_new_triangles) {
    return fail(
        ErrorCode::kResourceExhausted,
        fmt::format("the visible surface would have {} new triangles, more than scene.editing.max_new_triangles "
                    "= {}; raise it, or reset the scene",
                    appended_triangles_ + new_triangles, tables().max_new_triangles));
  }
  if (m.visible.appended_count + new_vertices > tables().max_new_vertices) {
    return fail(
        ErrorCode::kResourceExhausted,
        fmt::format("the visible surface would have {} new vertices, more than scene.editing.max_new_vertices = "
                    "{}; raise it, or reset the scene",
                    m.visible.appended_count + new_vertices, tables().max_new_vertices));
  }
  return {};
}

/// Takes away what elements that went showed, then shows what lies behind them.
void Editor::write_surfaces(Model& m) {
  if (went_.empty() || (!has_contact() && !has_clients())) return;
  vertices_.clear();
  torn_.clear();
  for (const std::uint32_t element : went_) {
    for (const std::uint32_t face : tables().faces[element]) hide(m, face);
    tear_skin(m, element);
  }
  for (const std::uint32_t element : went_) {
    for (const std::uint32_t face : tables().faces[element]) {
      const std::uint32_t behind = tables().face_behind[face];
      if (behind != kNone && !is_gone(tables().face_element[behind])) expose(m, behind);
    }
  }
  close_skin(m);
  for (const std::uint32_t vertex : vertices_) {
    const std::size_t begin = m.contact.incidence_begin[vertex], end = m.contact.incidence_end[vertex];
    for (std::size_t i = begin; i < end; ++i) find_neighbours(m, m.contact.incidence[4 * i]);
    // All of its room: entries that were written may lie behind the end by now.
    add(EditBuffer::kIncidence, 4 * begin, 4 * (m.contact.incidence_begin[vertex + 1] - begin));
    add(EditBuffer::kIncidenceEnd, vertex, 1);
  }
  if (has_clients()) ++surface_revision_, ++shape_revision_;
}

/// Pales the vertices around elements that the present edit has heated, and around those that are gone. Tissue stays
/// coagulated until it is healed.
void Editor::coagulate(const Model& m) {
  if (!has_clients()) return;
  pales_ = false;
  for (const std::uint32_t element : elements_) {
    const std::uint8_t seen = coagulation_seen(kept_[element]);
    if (seen <= element_coagulation_[element]) continue;
    element_coagulation_[element] = seen;
    const std::size_t body = m.body_of_element(element);
    for (const std::uint32_t row : tables().rows[element]) {
      row_coagulation_[row] = std::max(row_coagulation_[row], seen);
      if (visible_vertex_[row] != kNone) pale(m, body, visible_vertex_[row], seen);
    }
    const SkinTables& skin = tables().skin;
    if (skin.empty() || !m.bodies[body].has_skin) continue;
    for (const std::uint32_t t : skin.hanging[element]) {
      for (const std::uint32_t vertex : m.bodies[body].triangles[t - skin.triangle_begin[body]]) {
        pale(m, body, vertex, seen);
      }
    }
  }
  if (pales_) ++surface_revision_;
}

/// Makes a vertex of a body as pale as coagulation that is seen, unless it is paler.
void Editor::pale(const Model& m, std::size_t body, std::uint32_t vertex, std::uint8_t seen) {
  if (seen == 0) return;
  BodySurface& surface = surfaces_[body];
  const std::size_t count = m.bodies[body].vertex_count + surface.appended_vertices.size();
  if (surface.coagulation.size() < count) surface.coagulation.resize(count, 0);
  std::uint8_t& present = surface.coagulation[vertex];
  if (seen <= present) return;
  present = seen;
  pales_ = true;
}

void Editor::hide(Model& m, std::uint32_t face) {
  const std::size_t body = m.body_of_element(tables().face_element[face]);
  for (std::uint32_t p = tables().pieces.begin[face]; p < tables().pieces.begin[face + 1]; ++p) {
    if (piece_triangle_[p] != kNone) remove_triangle(m, p);
    if (piece_visible_[p] == kNone) continue;
    kill(body, std::exchange(piece_visible_[p], kNone));
  }
}

void Editor::kill(std::size_t body, std::uint32_t triangle) {
  std::vector<std::uint32_t>& dead = surfaces_[body].dead_triangles;
  dead.insert(std::lower_bound(dead.begin(), dead.end(), triangle), triangle);
}

void Editor::expose(Model& m, std::uint32_t face) {
  const std::uint32_t element = tables().face_element[face];
  for (std::uint32_t p = tables().pieces.begin[face]; p < tables().pieces.begin[face + 1]; ++p) {
    if (has_contact()) add_triangle(m, p, element);
    if (!has_clients()) continue;
    const std::size_t body = m.body_of_element(element);
    show(m, p, body, Face::kBurnt);
    if (m.bodies[body].has_skin) exposed_.push_back(p);
  }
}

/// Appends a piece to what clients see.
void Editor::show(Model& m, std::uint32_t piece, std::size_t body, Face kind) {
  mesh::Triangle triangle;
  for (std::size_t c = 0; c < 3; ++c) {
    const std::uint32_t row = tables().pieces.items[piece][c];
    if (visible_vertex_[row] == kNone) {
      visible_vertex_[row] = append_vertex(m, body, {row, row, row, row}, {1, 0, 0, 0});
    }
    triangle[c] = visible_vertex_[row];
  }
  piece_visible_[piece] = append_triangle(m, body, triangle, kind);
}

/// Returns the number of the new vertex in its body.
std::uint32_t Editor::append_vertex(Model& m, std::size_t body, const std::array<std::uint32_t, 4>& rows,
                                    const std::array<double, 4>& weights) {
  std::vector<std::uint32_t>& appended = surfaces_[body].appended_vertices;
  const std::size_t point = std::size_t{m.visible.count()} + m.visible.appended_count++;
  TM_ASSERT(point < m.visible.point_count(), "the edit was checked");
  appended.push_back(static_cast<std::uint32_t>(point));
  std::copy(rows.begin(), rows.end(), m.visible.rows.begin() + 4 * static_cast<std::ptrdiff_t>(point));
  std::copy(weights.begin(), weights.end(), m.visible.weights.begin() + 4 * static_cast<std::ptrdiff_t>(point));
  add(EditBuffer::kVisibleRows, 4 * point, 4);
  add(EditBuffer::kVisibleWeights, 4 * point, 4);
  const auto vertex = m.bodies[body].vertex_count + static_cast<std::uint32_t>(appended.size()) - 1;
  // A row that comes to light may have coagulated before. The other points lie between rows, below a skin.
  if (weights[0] == 1) pale(m, body, vertex, row_coagulation_[rows[0]]);
  return vertex;
}

/// Returns the number of the new triangle in its body.
std::uint32_t Editor::append_triangle(const Model& m, std::size_t body, const mesh::Triangle& triangle, Face kind) {
  BodySurface& surface = surfaces_[body];
  surface.appended_triangles.push_back(triangle);
  surface.appended_kinds.push_back(kind);
  ++appended_triangles_;
  return static_cast<std::uint32_t>(m.bodies[body].triangles.size() + surface.appended_triangles.size()) - 1;
}

void Editor::list_triangle(std::uint32_t triangle) {
  const std::size_t t = triangle;
  add(EditBuffer::kTriangleRows, 3 * t, 3);
  add(EditBuffer::kTriangleAreas, t, 1);
  add(EditBuffer::kTriangleModuli, 2 * t, 2);
  add(EditBuffer::kCornerVertices, 3 * t, 3);
}

void Editor::touch_vertex(std::uint32_t vertex) {
  if (std::exchange(vertex_met_[vertex], number_) != number_) vertices_.push_back(vertex);
}

/// Takes a piece out of the contact surface. The last triangle of the patch takes its place.
void Editor::remove_triangle(Model& m, std::uint32_t piece) {
  ContactSurface& contact = m.contact;
  const std::uint32_t t = std::exchange(piece_triangle_[piece], kNone);
  const std::uint32_t patch = m.layout.patch_of_row(contact.triangle_rows[3 * std::size_t{t}]);
  const auto entry_of = [&](std::uint32_t vertex, std::uint32_t triangle) {
    std::uint32_t i = contact.incidence_begin[vertex];
    while (contact.incidence[4 * std::size_t{i}] != triangle) ++i;
    TM_ASSERT(i < contact.incidence_end[vertex], "a surface vertex lists the triangles around it");
    return contact.incidence.begin() + 4 * std::ptrdiff_t{i};
  };
  for (std::size_t c = 0; c < 3; ++c) {
    const std::uint32_t vertex = contact.vertex_of_corner[3 * std::size_t{t} + c];
    const auto entry = entry_of(vertex, t);
    const auto last = contact.incidence.begin() + 4 * (std::ptrdiff_t{contact.incidence_end[vertex]} - 1);
    std::copy(last, last + 4, entry);
    --contact.incidence_end[vertex];
    touch_vertex(vertex);
  }
  const std::uint32_t last = --contact.triangles_end[patch];
  add(EditBuffer::kTrianglesEnd, patch, 1);
  if (last == t) return;
  for (std::size_t c = 0; c < 3; ++c) {
    const std::uint32_t vertex = contact.vertex_of_corner[3 * std::size_t{last} + c];
    *entry_of(vertex, last) = t;
    touch_vertex(vertex);
    contact.vertex_of_corner[3 * std::size_t{t} + c] = vertex;
    contact.triangle_rows[3 * std::size_t{t} + c] = contact.triangle_rows[3 * std::size_t{last} + c];
  }
  contact.triangle_area[t] = contact.triangle_area[last];
  for (std::size_t c = 0; c < 2; ++c) {
    contact.triangle_moduli[2 * std::size_t{t} + c] = contact.triangle_moduli[2 * std::size_t{last} + c];
  }
  triangle_piece_[t] = triangle_piece_[last];
  triangle_element_[t] = triangle_element_[last];
  piece_triangle_[triangle_piece_[t]] = t;
  edit_.moved_triangles.emplace_back(last, t);
  list_triangle(t);
}

/// Puts a piece at the end of the triangles of its patch.
void Editor::add_triangle(Model& m, std::uint32_t piece, std::uint32_t element) {
  ContactSurface& contact = m.contact;
  const auto& rows = tables().pieces.items[piece];
  const std::uint32_t patch = m.layout.patch_of_row(rows[0]), t = contact.triangles_end[patch]++;
  TM_ASSERT(t < contact.patch_triangles[patch + 1], "the edit was checked");
  add(EditBuffer::kTrianglesEnd, patch, 1);
  Vec3<double> x[3];
  for (std::uint32_t c = 0; c < 3; ++c) {
    const std::uint32_t vertex = surface_vertex(m, rows[c]);
    contact.triangle_rows[3 * std::size_t{t} + c] = rows[c];
    contact.vertex_of_corner[3 * std::size_t{t} + c] = vertex;
    const std::uint32_t entry = contact.incidence_end[vertex]++;
    TM_ASSERT(entry < contact.incidence_begin[vertex + 1], "the edit was checked");
    const std::array<std::uint32_t, 4> incidence{t, c, m.layout.slot(rows[c], rows[(c + 1) % 3]),
                                                 m.layout.slot(rows[c], rows[(c + 2) % 3])};
    std::copy(incidence.begin(), incidence.end(), contact.incidence.begin() + 4 * std::ptrdiff_t{entry});
    touch_vertex(vertex);
    x[c] = view::load3<double>(m.rest.data(), rows[c]);
  }
  contact.triangle_area[t] = 0.5 * (x[1] - x[0]).cross(x[2] - x[0]).norm();
  for (std::size_t c = 0; c < 2; ++c) {
    contact.triangle_moduli[2 * std::size_t{t} + c] = m.element_moduli[2 * std::size_t{element} + c];
  }
  piece_triangle_[piece] = t;
  triangle_piece_[t] = piece;
  triangle_element_[t] = element;
  edit_.moved_triangles.emplace_back(kNone, t);
  list_triangle(t);
}

/// Returns the surface vertex of a row; a row that had none gets the next one of its patch.
std::uint32_t Editor::surface_vertex(Model& m, std::uint32_t row) {
  std::uint32_t& vertex = surface_vertex_[row];
  if (vertex != kNone) return vertex;
  const std::uint32_t patch = m.layout.patch_of_row(row);
  vertex = m.contact.surface_end[patch]++;
  TM_ASSERT(vertex < m.contact.patch_surface[patch + 1], "a patch has room for a vertex at each of its rows");
  m.contact.surface_rows[vertex] = row;
  m.contact.incidence_end[vertex] = m.contact.incidence_begin[vertex];
  add(EditBuffer::kSurfaceEnd, patch, 1);
  add(EditBuffer::kSurfaceRows, vertex, 1);
  return vertex;
}

/// Finds the neighbours of a triangle across its edges, as mesh::Surface::neighbours has them.
void Editor::find_neighbours(Model& m, std::uint32_t triangle) {
  ContactSurface& contact = m.contact;
  const std::uint32_t* rows = &contact.triangle_rows[3 * std::size_t{triangle}];
  for (std::size_t side = 0; side < 3; ++side) {
    const std::uint32_t from = rows[side], to = rows[(side + 1) % 3];
    const std::uint32_t vertex = contact.vertex_of_corner[3 * std::size_t{triangle} + side];
    std::uint32_t met = 0, neighbour = view::kNoTriangle;
    for (std::size_t i = contact.incidence_begin[vertex]; i < contact.incidence_end[vertex]; ++i) {
      const std::uint32_t other = contact.incidence[4 * i], corner = contact.incidence[4 * i + 1];
      if (other == triangle) continue;
      const std::uint32_t* const of_other = &contact.triangle_rows[3 * std::size_t{other}];
      const bool runs_back = of_other[(corner + 2) % 3] == to, runs_along = of_other[(corner + 1) % 3] == to;
      if (runs_back || runs_along) ++met;
      if (runs_back && of_other[corner] == from) neighbour = other;
    }
    contact.triangle_neighbours[3 * std::size_t{triangle} + side] = met == 1 ? neighbour : view::kNoTriangle;
  }
  add(EditBuffer::kTriangleNeighbours, 3 * std::size_t{triangle}, 3);
}

const ModelEdit& Editor::heal_surfaces(Model& m) {
  edit_.clear();
  if (has_contact() && piece_triangle_ != tables().piece_triangle) {
    m.contact = tables().contact;
    const std::size_t triangles = m.contact.triangle_count(), vertices = m.contact.surface_rows.size();
    add(EditBuffer::kTriangleRows, 0, 3 * triangles);
    add(EditBuffer::kTriangleNeighbours, 0, 3 * triangles);
    add(EditBuffer::kTriangleAreas, 0, triangles);
    add(EditBuffer::kTriangleModuli, 0, 2 * triangles);
    add(EditBuffer::kCornerVertices, 0, 3 * triangles);
    add(EditBuffer::kTrianglesEnd, 0, m.layout.patch_count);
    add(EditBuffer::kSurfaceRows, 0, vertices);
    add(EditBuffer::kSurfaceEnd, 0, m.layout.patch_count);
    add(EditBuffer::kIncidence, 0, m.contact.incidence.size());
    add(EditBuffer::kIncidenceEnd, 0, vertices);
    piece_triangle_ = tables().piece_triangle;
    surface_vertex_ = tables().surface_vertex;
    place_loaded_triangles();
    write_triangle_moduli(m);
  }
  bool changed = false;
  pales_ = false;
  std::fill(element_coagulation_.begin(), element_coagulation_.end(), std::uint8_t{0});
  std::fill(row_coagulation_.begin(), row_coagulation_.end(), std::uint8_t{0});
  for (BodySurface& surface : surfaces_) {
    // A hole inside of a body appends triangles, and none dies.
    changed = changed || !surface.dead_triangles.empty() || !surface.appended_triangles.empty();
    pales_ = pales_ || !surface.coagulation.empty();
    surface.coagulation.clear();
    surface.dead_triangles.clear();
    surface.appended_vertices.clear();
    surface.appended_triangles.clear();
    surface.appended_kinds.clear();
  }
  if (changed || pales_) ++surface_revision_;
  if (!changed) return edit_;
  piece_visible_ = tables().piece_visible;
  visible_vertex_ = tables().visible_vertex;
  heal_skin();
  const std::size_t first = 4 * std::size_t{m.visible.count()}, count = 4 * std::size_t{m.visible.appended_count};
  std::fill_n(m.visible.rows.begin() + static_cast<std::ptrdiff_t>(first), count, 0u);
  std::fill_n(m.visible.weights.begin() + static_cast<std::ptrdiff_t>(first), count, 0.0);
  add(EditBuffer::kVisibleRows, first, count);
  add(EditBuffer::kVisibleWeights, first, count);
  m.visible.appended_count = appended_triangles_ = 0;
  ++shape_revision_;
  return edit_;
}

/// Makes the contact triangles those that the scene was loaded with.
void Editor::place_loaded_triangles() {
  std::fill(triangle_piece_.begin(), triangle_piece_.end(), kNone);
  std::fill(triangle_element_.begin(), triangle_element_.end(), kNone);
  const std::vector<std::uint32_t>& begin = tables().pieces.begin;
  for (std::size_t face = 0; face + 1 < begin.size(); ++face) {
    for (std::uint32_t p = begin[face]; p < begin[face + 1]; ++p) {
      if (piece_triangle_[p] == kNone) continue;
      triangle_piece_[piece_triangle_[p]] = p;
      triangle_element_[piece_triangle_[p]] = tables().face_element[face];
    }
  }
}

}  // namespace tensormass::model
