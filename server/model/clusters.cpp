#include "model/clusters.h"

#include <algorithm>
#include <optional>
#include <span>
#include <string_view>

#include <fmt/format.h>

#include "core/finding_kinds.h"
#include "mesh/adjacency.h"
#include "mesh/shapes.h"
#include "model/cut_bodies.h"
#include "model/tetrahedron_rings.h"
#include "model/wedge_pairs.h"

namespace tensormass::model {

namespace {

/// Poisson's ratio above which an element without a cluster is too stiff.
constexpr double kNearlyIncompressible = 0.49;

/// A mesh with its elements by node and its nodes by element.
struct Neighbours {
  const mesh::Mesh& mesh;
  std::vector<std::span<const std::uint32_t>> nodes_of = mesh::element_nodes(mesh);
  mesh::Rows elements_of = mesh::node_elements(mesh);
};

/// Fills the nodes of clusters up to eight with those that share the most elements with them: the matrix couples most
/// of them already.
class ClusterFiller {
 public:
  explicit ClusterFiller(const Neighbours& neighbours)
      : neighbours_(neighbours), shared_(neighbours.mesh.nodes.size(), 0) {}

  /// Returns false if there are too few. The lowest of several equal nodes comes first.
  bool fill(std::vector<std::uint32_t>& nodes) {
    if (nodes.size() == kClusterNodes) return true;
    candidates_.clear();
    for (const std::uint32_t node : nodes) {
      for (const std::uint32_t element : neighbours_.elements_of[node]) {
        for (const std::uint32_t other : neighbours_.nodes_of[element]) {
          if (shared_[other]++ == 0) candidates_.push_back(other);
        }
      }
    }
    for (const std::uint32_t node : nodes) shared_[node] = 0;
    while (nodes.size() < kClusterNodes) {
      const auto best = std::min_element(candidates_.begin(), candidates_.end(), [&](std::uint32_t a, std::uint32_t b) {
        return shared_[a] != shared_[b] ? shared_[a] > shared_[b] : a < b;
      });
      if (best == candidates_.end() || shared_[*best] == 0) break;
      nodes.push_back(*best);
      shared_[*best] = 0;
    }
    for (const std::uint32_t node : candidates_) shared_[node] = 0;
    return nodes.size() == kClusterNodes;
  }

 private:
  const Neighbours& neighbours_;
  std::vector<std::uint32_t> shared_;  // [node] elements that it shares with the cluster's nodes; 0 between two calls
  std::vector<std::uint32_t> candidates_;  // nodes that share at least one
};

/// Makes the cluster of some elements. Returns nothing if the mesh has fewer than eight nodes.
/// Leaves body and deviatoric_part open. Nodes are numbered in the body.
template <class Shape>
std::optional<Cluster> make_cluster(const ReadBody& body, const Neighbours& neighbours, ClusterFiller& filler,
                                    std::span<const std::uint32_t> elements) {
  std::vector<std::uint32_t> nodes;
  for (const std::uint32_t element : elements) {
    for (const std::uint32_t node : neighbours.nodes_of[element]) {
      if (std::find(nodes.begin(), nodes.end(), node) == nodes.end()) nodes.push_back(node);
    }
  }
  if (!filler.fill(nodes)) return std::nullopt;
  Cluster cluster{};
  cluster.elements.fill(mesh::kNone);
  std::copy(elements.begin(), elements.end(), cluster.elements.begin());
  std::copy(nodes.begin(), nodes.end(), cluster.nodes.begin());
  for (Vec3<double>& a : cluster.mean.a) a.setZero();
  for (std::size_t e = 0; e < elements.size(); ++e) {
    const std::span<const std::uint32_t> of_element = neighbours.nodes_of[elements[e]];
    Vec3<double> x[Shape::kNodes];
    for (std::size_t k = 0; k < of_element.size(); ++k) x[k] = neighbours.mesh.nodes[of_element[k]];
    const auto point = physics::rest_points<Shape>(x, physics::Quadrature::kReduced).front();
    auto mean = physics::PointGradients<Shape, double>::read([&](int i) { return point[std::size_t(i)]; });
    if (const mesh::PartShares* part = part_of(body, elements[e]).shares; part != nullptr) mean.weight *= part->volume;
    for (std::size_t k = 0; k < of_element.size(); ++k) {
      const auto place = std::find(nodes.begin(), nodes.end(), of_element[k]) - nodes.begin();
      cluster.mean.a[place] += mean.a[k] * mean.weight;
    }
    cluster.parts[e] = mean.weight;
    cluster.mean.weight += mean.weight;
  }
  for (Vec3<double>& a : cluster.mean.a) a /= cluster.mean.weight;
  for (double& part : cluster.parts) part /= cluster.mean.weight;
  return cluster;
}

/// Adds a finding if many elements of a shape stay alone and lock.
///
///   alone     [element of the body]
///   partner   where an element's partner would be
void find_unpaired(const ReadBody& body, const std::vector<bool>& alone, mesh::Shape shape, std::string_view partner,
                   std::vector<Finding>& findings) {
  const mesh::Topology& topology = mesh::topology(shape);
  std::uint32_t all = 0, locking = 0;
  mesh::for_each_element(body.mesh, [&](std::uint32_t e, const mesh::Topology& of, std::span<const std::uint32_t>) {
    if (&of != &topology) return;
    ++all;
    if (alone[e] && body.material(e).poisson_ratio > kNearlyIncompressible) ++locking;
  });
  if (locking <= thresholds::kLockingPart * all) return;
  findings.push_back(
      {.code = FindingCode::kUnpairedElements,
       .value = static_cast<double>(locking) / all,
       .limit = thresholds::kLockingPart,
       .place = fmt::format("body '{}'.quadrature", body.name),
       .body = body.name,
       .message = fmt::format("body '{}': {} of {} elements of shape {} have no partner for their change of volume and "
                              "are too stiff near a Poisson's ratio of 0.5",
                              body.name, locking, all, topology.name),
       .remedy = fmt::format("a partner {} and has the same law and moduli", partner)});
}

}  // namespace

bool same_dilatation(const Material& a, const Material& b) {
  return a.law == b.law && a.young_modulus_pa == b.young_modulus_pa && a.poisson_ratio == b.poisson_ratio &&
         a.prony == b.prony;
}

Clusters make_clusters(std::span<const ReadBody> bodies) {
  Clusters out;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    const ReadBody& body = bodies[b];
    if (body.quadrature != physics::Quadrature::kSelective) continue;
    std::vector<bool> alone(body.element_count, true);
    const bool forms_clusters = std::any_of(body.mesh.blocks.begin(), body.mesh.blocks.end(), [](const auto& block) {
      return block.shape == mesh::Shape::kWedge || block.shape == mesh::Shape::kTetrahedron;
    });
    if (!forms_clusters) continue;
    const Neighbours neighbours{body.mesh};
    ClusterFiller filler(neighbours);
    const auto add = [&](auto shape, std::span<const std::uint32_t> elements, double part) {
      std::optional<Cluster> cluster = make_cluster<typename decltype(shape)::Type>(body, neighbours, filler, elements);
      if (!cluster) return;
      cluster->body = b;
      cluster->deviatoric_part = part;
      for (std::uint32_t& node : cluster->nodes) node += body.node_begin;
      out.clusters.push_back(*cluster);
      for (const std::uint32_t element : elements) alone[element] = false;
    };
    for (const ElementPair& pair : pair_wedges(body)) add(physics::TypeTag<physics::Wedge>{}, pair, 0);
    for (const ElementRing& ring : body.cut == nullptr ? ring_tetrahedra(body) : rings_of_cut(body)) {
      add(physics::TypeTag<physics::LinearTetrahedron>{}, ring, kRingPart);
    }
    if (body.cut != nullptr) continue;  // a cut may leave elements alone
    find_unpaired(body, alone, mesh::Shape::kWedge, "lies across a quadrilateral face", out.findings);
    find_unpaired(body, alone, mesh::Shape::kTetrahedron, "shares an edge", out.findings);
  }
  return out;
}

physics::ElementAtRest<ClusterShape> mean_at_rest(const Cluster& cluster) {
  physics::ElementAtRest<ClusterShape> rest;
  auto& point = rest.points.emplace_back();
  for (std::size_t k = 1; k < kClusterNodes; ++k) {
    for (std::size_t i = 0; i < 3; ++i) point[3 * (k - 1) + i] = cluster.mean.a[k][static_cast<Eigen::Index>(i)];
  }
  point.back() = cluster.mean.weight;
  rest.shares.push_back({cluster.deviatoric_part, 1});
  return rest;
}

}  // namespace tensormass::model
