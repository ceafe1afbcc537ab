#include <algorithm>
#include <utility>

#include "core/assert.h"
#include "model/edit.h"

/// Skins of bodies that are edited. A skin is cut nowhere: its triangles go whole, and what they covered comes to
/// light.
///
///   skin       ───────┐a                 ┌──────      a triangle goes with the first of the elements that it hangs on
///                wall │                  │            a wall joins an edge that is left open to the boundary below
///   boundary   ───────┴a'──┐        ┌────┴──────      pieces of living elements that the triangle covered are shown
///                          └────────┘ burnt faces
///
/// So nobody can look between skin and boundary. Pieces are shown whole, and lie partly under what is left of the skin.
namespace tensormass::model {

using mesh::kNone;

std::size_t Editor::body_of_skin_triangle(std::uint32_t triangle) const {
  const std::vector<std::uint32_t>& begin = tables().skin.triangle_begin;
  return static_cast<std::size_t>(std::upper_bound(begin.begin(), begin.end(), triangle) - begin.begin()) - 1;
}

/// Adds what an edit appends where it tears skins. Rows that count already are marked in change_.
void Editor::count_torn_skin(const Model& m, std::span<const Ablation> ablations, std::size_t& triangles,
                             std::size_t& vertices) const {
  const SkinTables& skin = tables().skin;
  tearing_.clear();
  if (skin.empty()) return;
  for (const Ablation& one : ablations) {
    if (!will_go(one.element)) continue;
    for (const std::uint32_t t : skin.hanging[one.element]) {
      if (is_torn_[t] == 0 && std::exchange(tearing_met_[t], check_number_) != check_number_) tearing_.push_back(t);
    }
  }
  const std::size_t seen = m.layout.patch_count + std::size_t{m.layout.row_count};
  for (const std::uint32_t t : tearing_) {
    for (const std::uint32_t piece : skin.covered[t]) {
      const std::uint32_t element = skin.piece_element[piece];
      if (is_gone(element) || will_go(element) || piece_visible_[piece] != kNone) continue;
      if (std::exchange(piece_met_[piece], check_number_) == check_number_) continue;
      ++triangles;
      for (const std::uint32_t row : tables().pieces.items[piece]) {
        if (visible_vertex_[row] == kNone && change_[seen + row]++ == 0) ++vertices;
      }
    }
    const std::size_t b = body_of_skin_triangle(t);
    const mesh::Triangle& corners = m.bodies[b].triangles[t - skin.triangle_begin[b]];
    for (std::uint32_t side = 0; side < 3; ++side) {
      const std::uint32_t neighbour = skin.neighbours[t][side];
      if (neighbour == kNone || is_torn_[neighbour] != 0 || tearing_met_[neighbour] == check_number_) continue;
      triangles += wall_count(m, b, t, side);
      for (const std::uint32_t corner : {corners[side], corners[(side + 1) % 3]}) {
        const std::size_t vertex = std::size_t{m.bodies[b].vertex_begin} + corner;
        const bool is_new = skin.feet[vertex].rows[0] != kNone && foot_vertices_[vertex] == kNone;
        if (is_new && std::exchange(foot_met_[vertex], check_number_) != check_number_) ++vertices;
      }
    }
  }
  for (const std::uint32_t t : tearing_) {
    for (const std::uint32_t piece : skin.covered[t]) {
      for (const std::uint32_t row : tables().pieces.items[piece]) change_[seen + row] = 0;
    }
  }
}

/// Takes away the skin triangles that hang on an element that went, and their walls.
void Editor::tear_skin(const Model& m, std::uint32_t element) {
  const SkinTables& skin = tables().skin;
  if (skin.empty()) return;
  for (const std::uint32_t t : skin.hanging[element]) {
    if (std::exchange(is_torn_[t], std::uint8_t{1}) != 0) continue;
    torn_.push_back(t);
    const std::size_t body = body_of_skin_triangle(t);
    kill(body, t - skin.triangle_begin[body]);
    for (std::uint32_t side = 0; side < 3; ++side) {
      const std::uint32_t wall = walls_[3 * std::size_t{t} + side];
      for (std::uint32_t i = 0; wall != kNone && i < wall_count(m, body, t, side); ++i) kill(body, wall + i);
    }
  }
}

/// Shows what torn triangles covered, and closes the edges that they left open.
void Editor::close_skin(Model& m) {
  const SkinTables& skin = tables().skin;
  for (const std::uint32_t t : torn_) {
    const std::size_t body = body_of_skin_triangle(t);
    for (const std::uint32_t piece : skin.covered[t]) {
      if (!is_gone(skin.piece_element[piece]) && piece_visible_[piece] == kNone) show(m, piece, body, Face::kOuter);
    }
    for (const std::uint32_t neighbour : skin.neighbours[t]) {
      if (neighbour == kNone || is_torn_[neighbour] != 0) continue;
      const auto& back = skin.neighbours[neighbour];
      for (std::uint32_t side = 0; side < 3; ++side) {
        const bool is_open = back[side] == t && walls_[3 * std::size_t{neighbour} + side] == kNone;
        if (is_open) add_wall(m, body, neighbour, side);
      }
    }
  }
}

/// Returns the triangles of the wall at an edge: one for each end that is not on the boundary itself.
std::uint32_t Editor::wall_count(const Model& m, std::size_t body, std::uint32_t triangle, std::uint32_t side) const {
  const SkinTables& skin = tables().skin;
  const mesh::Triangle& corners = m.bodies[body].triangles[triangle - skin.triangle_begin[body]];
  const auto stands = [&](std::uint32_t corner) {
    return skin.feet[std::size_t{m.bodies[body].vertex_begin} + corner].rows[0] != kNone ? 1u : 0u;
  };
  return stands(corners[side]) + stands(corners[(side + 1) % 3]);
}

/// Appends the wall at an edge of a triangle that is left. It runs along the edge the other way round.
void Editor::add_wall(Model& m, std::size_t body, std::uint32_t triangle, std::uint32_t side) {
  const mesh::Triangle& corners = m.bodies[body].triangles[triangle - tables().skin.triangle_begin[body]];
  const std::uint32_t a = corners[side], b = corners[(side + 1) % 3];
  const std::uint32_t below_a = foot_vertex(m, body, a), below_b = foot_vertex(m, body, b);
  std::uint32_t first = kNone;
  const auto append = [&](const mesh::Triangle& of) {
    const std::uint32_t number = append_triangle(m, body, of, Face::kOuter);
    if (first == kNone) first = number;
  };
  if (below_a != a) append({b, a, below_a});
  if (below_b != b) append({b, below_a, below_b});
  walls_[3 * std::size_t{triangle} + side] = first;
}

/// Returns the foot of a skin vertex as a vertex of the body: the vertex itself if it is on the boundary.
std::uint32_t Editor::foot_vertex(Model& m, std::size_t body, std::uint32_t vertex) {
  const std::size_t v = std::size_t{m.bodies[body].vertex_begin} + vertex;
  const SkinTables::Foot& foot = tables().skin.feet[v];
  if (foot.rows[0] == kNone) return vertex;
  if (foot_vertices_[v] == kNone) {
    foot_vertices_[v] = append_vertex(m, body, {foot.rows[0], foot.rows[1], foot.rows[2], foot.rows[2]},
                                      {foot.weights[0], foot.weights[1], foot.weights[2], 0});
  }
  return foot_vertices_[v];
}

void Editor::heal_skin() {
  const SkinTables& skin = tables().skin;
  is_torn_.assign(skin.neighbours.size(), 0);
  walls_.assign(3 * skin.neighbours.size(), kNone);
  foot_vertices_.assign(skin.feet.size(), kNone);
  exposed_.clear();
}

}  // namespace tensormass::model
