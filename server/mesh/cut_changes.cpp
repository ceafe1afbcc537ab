#include "mesh/cut_changes.h"

#include <algorithm>

namespace tensormass::mesh {

CutChanges::CutChanges(const Surface& surface)
    : loaded_vertices_(static_cast<std::uint32_t>(surface.nodes.size())),
      loaded_triangles_(static_cast<std::uint32_t>(surface.triangles.size())) {
  for (std::uint32_t v = 0; v < loaded_vertices_; ++v) vertex_of_node_.emplace(surface.nodes[v], v);
  for (std::uint32_t t = 0; t < loaded_triangles_; ++t) alive_.emplace(key_of(surface.triangles[t], false), t);
}

CutChanges::Key CutChanges::key_of(const Triangle& triangle, bool is_cut) {
  const auto first = std::min_element(triangle.begin(), triangle.end()) - triangle.begin();
  const auto corner = [&](std::ptrdiff_t i) { return triangle[static_cast<std::size_t>((first + i) % 3)]; };
  return {corner(0), corner(1), corner(2), is_cut ? 1u : 0u};
}

std::uint32_t CutChanges::number_of(Vertex vertex) {
  std::sort(vertex.begin(), vertex.end());
  if (vertex.size() == 1) {
    const auto loaded = vertex_of_node_.find(vertex.front().first);
    if (loaded != vertex_of_node_.end()) return loaded->second;
  }
  const auto next = loaded_vertices_ + static_cast<std::uint32_t>(vertices_.size());
  const auto [entry, is_new] = numbers_.try_emplace(vertex, next);
  if (is_new) vertices_.push_back(std::move(vertex));
  return entry->second;
}

void CutChanges::take(const CutSurface& surface) {
  std::vector<std::uint32_t> numbers;
  for (std::uint32_t v = 0; v < surface.vertex_count(); ++v) {
    Vertex vertex;
    for (std::uint32_t i = surface.offsets[v]; i < surface.offsets[v + 1]; ++i) {
      vertex.emplace_back(surface.rows[i], surface.weights[i]);
    }
    numbers.push_back(number_of(std::move(vertex)));
  }
  std::map<Key, std::uint32_t> before;
  before.swap(alive_);
  for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
    Triangle triangle = surface.triangles[t];
    for (std::uint32_t& vertex : triangle) vertex = numbers[vertex];
    const bool is_cut = surface.triangle_is_cut[t] != 0;
    const Key key = key_of(triangle, is_cut);
    if (auto same = before.extract(key); !same.empty()) {
      alive_.insert(std::move(same));
      continue;
    }
    alive_.emplace(key, loaded_triangles_ + static_cast<std::uint32_t>(triangles_.size()));
    triangles_.push_back(triangle);
    is_cut_.push_back(is_cut ? 1 : 0);
  }
  const auto middle = static_cast<std::ptrdiff_t>(dead_.size());
  for (const auto& [key, triangle] : before) dead_.push_back(triangle);
  std::sort(dead_.begin() + middle, dead_.end());
  std::inplace_merge(dead_.begin(), dead_.begin() + middle, dead_.end());
}

}  // namespace tensormass::mesh
