#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <span>
#include <utility>
#include <vector>

#include "core/assert.h"
#include "mesh/cut_surface.h"
#include "mesh/shapes.h"
#include "model/compile_parts.h"
#include "model/cut_bodies.h"

/// Finds the contact triangles that elements carry: those of the surface of a cut body that lie between no three rows.
namespace tensormass::model {

namespace {

constexpr std::uint32_t kRows = 4;  // the element that carries a triangle has four

/// A triangle while the surface is made.
struct Carried {
  std::array<std::uint32_t, kRows> rows{};
  std::array<double, 3 * kRows> weights{};
  std::array<std::uint32_t, 3> vertices{};
  Eigen::Vector3d centroid = Eigen::Vector3d::Zero();
  double area_m2 = 0;
  std::uint32_t element = 0;  ///< numbered in the scene
  std::uint32_t loaded = 0;   ///< numbered in the body, as loaded
  std::uint32_t part = 0;     ///< mesh::CutSurface::triangle_parts
  bool is_face_of_cut = false;
  std::uint32_t twin = view::kNoTriangle;  ///< place among all of `Carried`
};

class Carrier {
 public:
  Carrier(const ReadBodies& bodies, const matrix::Layout& layout, ContactSurface& surface)
      : bodies_(bodies), layout_(layout), out_(surface) {
    next_vertex_ = static_cast<std::uint32_t>(out_.surface_rows.size());
  }

  void run() {
    for (const ReadBody& body : bodies_.bodies) {
      if (body.cut != nullptr && !body.cut->batches().empty()) add(body);
    }
    if (all_.empty()) return;
    // By the row that stands for a triangle, as outer triangles are: its patch owns them.
    std::vector<std::uint32_t> order(all_.size()), place(all_.size());
    std::iota(order.begin(), order.end(), 0);
    std::stable_sort(order.begin(), order.end(),
                     [&](std::uint32_t a, std::uint32_t b) { return all_[a].rows[0] < all_[b].rows[0]; });
    for (std::uint32_t i = 0; i < order.size(); ++i) place[order[i]] = out_.outer_count() + i;
    write_triangles(order, place);
    write_entries();
    write_vertices();
    find_neighbours();
  }

 private:
  void add(const ReadBody& body) {
    const mesh::CutSurface& surface = body.cut->surface();
    const std::vector<Eigen::Vector3d> positions = mesh::row_positions(body.cut->cut());
    const auto row_of = [&](std::uint32_t node) { return layout_.row_of_node[body.node_begin + node]; };
    std::vector<std::uint32_t> vertices(surface.vertex_count(), mesh::kNone);
    const auto is_node = [&](std::uint32_t v) { return surface.offsets[v + 1] - surface.offsets[v] == 1; };
    const auto vertex_of = [&](std::uint32_t v) {
      if (vertices[v] == mesh::kNone) {
        vertices[v] = is_node(v) ? vertex_of_row(row_of(surface.rows[surface.offsets[v]])) : next_vertex_++;
      }
      return vertices[v];
    };
    const std::size_t first = all_.size();
    for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
      const mesh::Triangle& corners = surface.triangles[t];
      const bool is_face_of_cut = surface.triangle_is_cut[t] != 0;
      const std::uint32_t loaded = surface.triangle_elements[t], part = surface.triangle_parts[t];
      if (!carries_triangles(body.cut->topology().shape(loaded))) continue;
      if (!is_face_of_cut && std::all_of(corners.begin(), corners.end(), is_node)) continue;  // no cut crosses it
      Carried& one = all_.emplace_back();
      one.loaded = loaded;
      one.part = part;
      one.element = body.element_begin + (part == mesh::kNone ? loaded : body.part_elements[part]);
      one.is_face_of_cut = is_face_of_cut;
      const std::span<const std::uint32_t> nodes =
          part == mesh::kNone ? body.cut->topology().nodes(loaded)
                              : std::span<const std::uint32_t>(body.cut->cut().parts()[part].rows).first(kRows);
      std::array<Eigen::Vector3d, 3> x;
      for (std::uint32_t c = 0; c < 3; ++c) {
        one.vertices[c] = vertex_of(corners[c]);
        x[c] = surface.position(corners[c], positions);
        one.centroid += x[c] / 3;
        for (std::uint32_t i = surface.offsets[corners[c]]; i < surface.offsets[corners[c] + 1]; ++i) {
          const auto at = std::ranges::find(nodes, surface.rows[i]);
          TM_ASSERT(at != nodes.end(), "a triangle lies within its element");
          one.weights[kRows * c + static_cast<std::size_t>(at - nodes.begin())] = surface.weights[i];
        }
      }
      for (std::size_t k = 0; k < kRows; ++k) one.rows[k] = row_of(nodes[k]);
      one.area_m2 = 0.5 * (x[1] - x[0]).cross(x[2] - x[0]).norm();
    }
    find_twins(first);
  }

  /// Returns the vertex at a row; one that no outer triangle has is new.
  std::uint32_t vertex_of_row(std::uint32_t row) {
    const auto at = std::ranges::lower_bound(out_.surface_rows, row);
    if (at != out_.surface_rows.end() && *at == row) return static_cast<std::uint32_t>(at - out_.surface_rows.begin());
    const auto [entry, is_new] = vertex_at_row_.try_emplace(row, next_vertex_);
    if (is_new) ++next_vertex_;
    return entry->second;
  }

  /// Finds for each face of a cut the triangle at the same place in another part of its element.
  void find_twins(std::size_t first) {
    std::map<std::uint32_t, std::vector<std::uint32_t>> of_element;
    for (std::size_t i = first; i < all_.size(); ++i) {
      if (all_[i].is_face_of_cut) of_element[all_[i].loaded].push_back(static_cast<std::uint32_t>(i));
    }
    for (const auto& [element, faces] : of_element) {
      for (const std::uint32_t face : faces) {
        double least = std::numeric_limits<double>::infinity();
        for (const std::uint32_t other : faces) {
          if (all_[other].part == all_[face].part) continue;
          const double squared = (all_[other].centroid - all_[face].centroid).squaredNorm();
          if (!(squared < least)) continue;
          least = squared;
          all_[face].twin = other;
        }
        TM_ASSERT(all_[face].twin != view::kNoTriangle, "a cut has two faces");
      }
    }
  }

  void write_triangles(std::span<const std::uint32_t> order, std::span<const std::uint32_t> place) {
    CarriedTriangles& carried = out_.carried;
    carried.patch_triangles.assign(layout_.patch_count + 1, 0);
    for (const std::uint32_t i : order) {
      const Carried& one = all_[i];
      carried.rows.insert(carried.rows.end(), one.rows.begin(), one.rows.end());
      carried.weights.insert(carried.weights.end(), one.weights.begin(), one.weights.end());
      carried.twins.push_back(one.twin == view::kNoTriangle ? view::kNoTriangle : place[one.twin]);
      out_.triangle_area.push_back(one.area_m2);
      out_.vertex_of_corner.insert(out_.vertex_of_corner.end(), one.vertices.begin(), one.vertices.end());
      out_.triangle_neighbours.insert(out_.triangle_neighbours.end(), 3, view::kNoTriangle);
      add_moduli(bodies_.bodies, one.element, out_);
      ++carried.patch_triangles[layout_.patch_of_row(one.rows[0]) + 1];
    }
    carried.patch_triangles[0] = out_.outer_count();
    std::partial_sum(carried.patch_triangles.begin(), carried.patch_triangles.end(), carried.patch_triangles.begin());
  }

  /// Lists for each row the carried triangles that move with it.
  void write_entries() {
    CarriedTriangles& carried = out_.carried;
    std::map<std::uint32_t, std::vector<std::array<std::uint32_t, 5>>> of_row;
    for (std::uint32_t i = 0; i < carried.count(); ++i) {
      const std::uint32_t* rows = &carried.rows[kRows * std::size_t{i}];
      const double* weights = &carried.weights[3 * kRows * std::size_t{i}];
      for (std::uint32_t k = 0; k < kRows; ++k) {
        if (weights[k] == 0 && weights[kRows + k] == 0 && weights[2 * kRows + k] == 0) continue;
        std::array<std::uint32_t, 5> entry{out_.outer_count() + i, k};
        for (std::uint32_t next = 1; next < kRows; ++next) {
          entry[1 + next] = layout_.slot(rows[k], rows[(k + next) % kRows]);
        }
        of_row[rows[k]].push_back(entry);
      }
    }
    carried.entry_begin.assign(1, 0);
    const auto list = [&](std::uint32_t row) {
      if (const auto found = of_row.find(row); found != of_row.end()) {
        for (const auto& entry : found->second) {
          carried.entries.insert(carried.entries.end(), entry.begin(), entry.end());
        }
        of_row.erase(found);
      }
      carried.entry_begin.push_back(static_cast<std::uint32_t>(carried.entries.size() / 5));
    };
    for (const std::uint32_t row : out_.surface_rows) list(row);
    carried.patch_rows.assign(layout_.patch_count + 1, 0);
    while (!of_row.empty()) {
      const std::uint32_t row = of_row.begin()->first;
      ++carried.patch_rows[layout_.patch_of_row(row) + 1];
      list(row);
    }
    std::partial_sum(carried.patch_rows.begin(), carried.patch_rows.end(), carried.patch_rows.begin());
  }

  void write_vertices() {
    CarriedTriangles& carried = out_.carried;
    std::vector<std::uint32_t>& begin = carried.around_begin;
    begin.assign(std::size_t{next_vertex_} + 1, 0);
    const std::uint32_t first = out_.outer_count(), end = out_.triangle_count();
    for (std::size_t i = 3 * std::size_t{first}; i < 3 * std::size_t{end}; ++i) ++begin[out_.vertex_of_corner[i] + 1];
    std::partial_sum(begin.begin(), begin.end(), begin.begin());
    carried.around.resize(2 * std::size_t{begin.back()});
    std::vector<std::uint32_t> next(begin.begin(), begin.end() - 1);
    for (std::uint32_t t = first; t < end; ++t) {
      for (std::uint32_t c = 0; c < 3; ++c) {
        const std::size_t at = 2 * std::size_t{next[out_.vertex_of_corner[3 * std::size_t{t} + c]]++};
        carried.around[at] = t;
        carried.around[at + 1] = c;
      }
    }
  }

  /// Finds neighbours where carried triangles meet each other or the rim of outer ones, as mesh::Surface::neighbours.
  void find_neighbours() {
    using Side = std::pair<std::uint32_t, std::uint32_t>;  // triangle, corner at which the side begins
    std::map<std::pair<std::uint32_t, std::uint32_t>, std::vector<Side>> sides;
    const auto ends_of = [&](std::uint32_t triangle, std::uint32_t side) {
      const std::uint32_t* vertices = &out_.vertex_of_corner[3 * std::size_t{triangle}];
      return std::pair(vertices[side], vertices[(side + 1) % 3]);
    };
    for (std::uint32_t t = 0; t < out_.triangle_count(); ++t) {
      for (std::uint32_t side = 0; side < 3; ++side) {
        if (out_.triangle_neighbours[3 * std::size_t{t} + side] != view::kNoTriangle) continue;
        const auto [from, to] = ends_of(t, side);
        sides[std::minmax(from, to)].emplace_back(t, side);
      }
    }
    for (const auto& [ends, at] : sides) {
      if (at.size() != 2 || ends_of(at[0].first, at[0].second) == ends_of(at[1].first, at[1].second)) continue;
      out_.triangle_neighbours[3 * std::size_t{at[0].first} + at[0].second] = at[1].first;
      out_.triangle_neighbours[3 * std::size_t{at[1].first} + at[1].second] = at[0].first;
    }
  }

  const ReadBodies& bodies_;
  const matrix::Layout& layout_;
  ContactSurface& out_;
  std::vector<Carried> all_;
  std::map<std::uint32_t, std::uint32_t> vertex_at_row_;
  std::uint32_t next_vertex_ = 0;
};

}  // namespace

void carry_triangles(const ReadBodies& bodies, const matrix::Layout& layout, ContactSurface& surface) {
  Carrier(bodies, layout, surface).run();
}

}  // namespace tensormass::model
