#include "model/wedge_pairs.h"

#include <algorithm>
#include <deque>
#include <utility>

#include <fmt/format.h>

#include "mesh/faces.h"
#include "mesh/shapes.h"

namespace tensormass::model {

namespace {

constexpr const mesh::Topology& kWedge = mesh::topology(mesh::Shape::kWedge);

/// Poisson's ratio above which a wedge without a partner is too stiff.
constexpr double kNearlyIncompressible = 0.49;
/// Fraction of a body's wedges that may lock without a warning. An irregular mesh leaves up to 0.02 alone.
constexpr double kNoticeablePart = 0.1;

struct SharedFace {
  ElementPair elements;
  double area_m2;
};

bool same_dilatation(const Material& a, const Material& b) {
  return a.law == b.law && a.young_modulus_pa == b.young_modulus_pa && a.poisson_ratio == b.poisson_ratio &&
         a.prony == b.prony;
}

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

void make_wedge_pairs(Compilation& c) {
  for (std::size_t b = 0; b < c.bodies.size(); ++b) {
    const ReadBody& body = c.bodies[b];
    if (body.quadrature != physics::Quadrature::kSelective) continue;
    const BodyModel& of = c.model.bodies[b];
    const auto nodes_of = mesh::element_nodes(body.mesh);
    const std::vector<bool> is_wedge = wedges_of(body.mesh);
    std::vector<bool> alone = is_wedge;
    for (const ElementPair& elements : pair_wedges(body)) {
      WedgePair pair{b, elements, {}, {}};
      const auto first = nodes_of[elements[0]], second = nodes_of[elements[1]];
      std::copy(first.begin(), first.end(), pair.nodes.begin());
      std::size_t count = first.size();
      for (std::size_t k = 0; k < second.size(); ++k) {
        const auto place = static_cast<std::size_t>(std::find(first.begin(), first.end(), second[k]) - first.begin());
        pair.second_nodes[k] = place < first.size() ? place : count++;
        pair.nodes[pair.second_nodes[k]] = second[k];
      }
      for (std::uint32_t& node : pair.nodes) node += of.node_begin;
      c.wedge_pairs.push_back(pair);
      for (const std::uint32_t element : elements) alone[element] = false;
    }
    std::uint32_t wedges = 0, locking = 0;
    for (std::uint32_t e = 0; e < of.element_count; ++e) {
      wedges += is_wedge[e] ? 1 : 0;
      if (alone[e] && body.material(e).poisson_ratio > kNearlyIncompressible) ++locking;
    }
    if (locking <= kNoticeablePart * wedges) continue;
    c.model.warnings.push_back(fmt::format(
        "body '{}': {} of {} wedges have no partner for their change of volume and are too stiff near a "
        "Poisson's ratio of 0.5; a partner lies across a quadrilateral face and has the same law and moduli",
        of.name, locking, wedges));
  }
}

mesh::ElementBlock wedge_pair_block(const Compilation& c) {
  mesh::ElementBlock block{mesh::Shape::kHexahedron, {}};
  for (const WedgePair& pair : c.wedge_pairs)
    block.nodes.insert(block.nodes.end(), pair.nodes.begin(), pair.nodes.end());
  return block;
}

WedgePairAtRest wedge_pair_at_rest(const Compilation& c, const WedgePair& pair) {
  using physics::Wedge;
  using Gradients = physics::PointGradients<Wedge, double>;
  const auto mean = [&](const auto& place) {
    Vec3<double> x[Wedge::kNodes];
    for (std::size_t k = 0; k < Wedge::kNodes; ++k) x[k] = c.merged.nodes[pair.nodes[place(k)]];
    const auto point = physics::rest_points<Wedge>(x, physics::Quadrature::kReduced).front();
    return Gradients::read([&](int i) { return point[static_cast<std::size_t>(i)]; });
  };
  const Gradients first = mean([](std::size_t k) { return k; });
  const Gradients second = mean([&](std::size_t k) { return pair.second_nodes[k]; });

  Vec3<double> a[WedgePairShape::kNodes];
  for (Vec3<double>& gradient : a) gradient.setZero();
  const double volume = first.weight + second.weight;
  for (std::size_t k = 0; k < Wedge::kNodes; ++k) {
    a[k] += first.a[k] * (first.weight / volume);
    a[pair.second_nodes[k]] += second.a[k] * (second.weight / volume);
  }
  WedgePairAtRest out{{}, first.weight / volume};
  auto& point = out.rest.points.emplace_back();
  for (std::size_t k = 1; k < WedgePairShape::kNodes; ++k) {
    for (std::size_t i = 0; i < 3; ++i) point[3 * (k - 1) + i] = a[k][static_cast<Eigen::Index>(i)];
  }
  point.back() = volume;
  out.rest.shares.push_back({0, 1});
  return out;
}

}  // namespace tensormass::model
