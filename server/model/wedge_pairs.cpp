#include "model/wedge_pairs.h"

#include <algorithm>
#include <deque>
#include <span>

#include "mesh/faces.h"
#include "mesh/shapes.h"
#include "model/clusters.h"

namespace tensormass::model {

namespace {

constexpr const mesh::Topology& kWedge = mesh::topology(mesh::Shape::kWedge);

struct SharedFace {
  ElementPair elements;
  double area_m2;
};

std::vector<bool> wedges_of(const mesh::Mesh& mesh) {
  std::vector<bool> wedges;
  wedges.reserve(mesh::element_count(mesh));
  mesh::for_each_element(mesh, [&](std::uint32_t, const mesh::Topology& shape, std::span<const std::uint32_t>) {
    wedges.push_back(&shape == &kWedge);
  });
  return wedges;
}

/// Returns the quadrilaterals between two wedges that could be a pair, the largest first.
std::vector<SharedFace> shared_faces(const ReadBody& body) {
  const std::vector<bool> is_wedge = wedges_of(body.mesh);
  const auto nodes_of = mesh::element_nodes(body.mesh);
  std::vector<SharedFace> shared;
  mesh::match_faces(body.mesh, [&](std::span<const mesh::ElementFace> faces) {
    if (faces.size() != 2 || faces[0].corners.back() == mesh::kNone) return;
    const std::uint32_t first = faces[0].element, second = faces[1].element;
    if (!is_wedge[first] || !is_wedge[second]) return;
    if (!same_dilatation(body.material(first), body.material(second))) return;
    const mesh::FaceNodes face = mesh::face_nodes(kWedge.faces[faces[0].face], nodes_of[first]);
    const auto& x = body.mesh.nodes;
    shared.push_back({{first, second}, 0.5 * (x[face[2]] - x[face[0]]).cross(x[face[3]] - x[face[1]]).norm()});
  });
  std::stable_sort(shared.begin(), shared.end(),
                   [](const SharedFace& a, const SharedFace& b) { return a.area_m2 > b.area_m2; });
  return shared;
}

}  // namespace

std::vector<ElementPair> pair_wedges(const ReadBody& body) {
  if (body.quadrature != physics::Quadrature::kSelective) return {};
  const std::vector<SharedFace> faces = shared_faces(body);
  const std::size_t element_count = mesh::element_count(body.mesh);
  std::vector<std::vector<std::uint32_t>> candidates(element_count);
  for (const auto& [elements, area] : faces) {
    candidates[elements[0]].push_back(elements[1]);
    candidates[elements[1]].push_back(elements[0]);
  }
  std::vector<bool> taken(element_count, false);
  std::vector<std::size_t> free_candidates(element_count);
  std::deque<std::uint32_t> served_first;
  for (std::uint32_t e = 0; e < element_count; ++e) {
    free_candidates[e] = candidates[e].size();
    if (free_candidates[e] == 1) served_first.push_back(e);
  }

  std::vector<ElementPair> pairs;
  const auto take = [&](std::uint32_t a, std::uint32_t b) {
    pairs.push_back({std::min(a, b), std::max(a, b)});
    for (const std::uint32_t member : pairs.back()) taken[member] = true;
    for (const std::uint32_t member : pairs.back()) {
      for (const std::uint32_t other : candidates[member]) {
        if (!taken[other] && --free_candidates[other] == 1) served_first.push_back(other);
      }
    }
  };
  const auto serve_waiting = [&] {
    for (; !served_first.empty(); served_first.pop_front()) {
      const std::uint32_t element = served_first.front();
      if (taken[element]) continue;
      const auto& of = candidates[element];
      const auto partner = std::find_if(of.begin(), of.end(), [&](std::uint32_t other) { return !taken[other]; });
      if (partner != of.end()) take(element, *partner);
    }
  };
  serve_waiting();
  for (const auto& [elements, area] : faces) {
    if (taken[elements[0]] || taken[elements[1]]) continue;
    take(elements[0], elements[1]);
    serve_waiting();
  }
  std::sort(pairs.begin(), pairs.end());
  return pairs;
}

}  // namespace tensormass::model
