#include <algorithm>
#include <cmath>
#include <vector>

#include "mesh/components.h"
#include "mesh/partition.h"
#include "mesh/shapes.h"
#include "model/compile_parts.h"
#include "view/coarse.h"

/// Makes the aggregates of the coarse level (solver/coarse_level.h).
///
///   mesh ── components ──> pieces ── each its share of kMaxAggregates ──> bisection by coordinates ──> aggregates
///                                                                    └──> unions of patches (GPU), or parts of one
///
/// An aggregate never spans two pieces of a body that a cut has separated: they do not move together.
namespace tensormass::model {

namespace {

/// Fewer nodes move almost rigidly at the scale at which block-Jacobi already converges.
constexpr std::size_t kNodesOfAggregate = 48;

/// Returns the nodes of each connected piece of a mesh, larger pieces first.
std::vector<std::vector<std::uint32_t>> pieces_of(const mesh::Mesh& mesh) {
  mesh::Components components(mesh.nodes.size());
  for (const std::span<const std::uint32_t> element : mesh::element_nodes(mesh)) {
    for (const std::uint32_t node : element) components.join(element[0], node);
  }
  std::vector<std::vector<std::uint32_t>> pieces;
  std::vector<std::size_t> place(mesh.nodes.size());
  for (std::uint32_t node = 0; node < place.size(); ++node) {
    const std::uint32_t root = components.root(node);  // the lowest node
    if (root == node) {
      place[node] = pieces.size();
      pieces.emplace_back();
    }
    place[node] = place[root];
    pieces[place[node]].push_back(node);
  }
  std::stable_sort(pieces.begin(), pieces.end(), [](const auto& a, const auto& b) { return a.size() > b.size(); });
  return pieces;
}

/// Adds an aggregate of some nodes.
void add(std::span<const std::uint32_t> nodes, const mesh::Mesh& mesh, const matrix::Layout& layout, Aggregates& out) {
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (const std::uint32_t node : nodes) mean += mesh.nodes[node];
  mean /= static_cast<double>(nodes.size());
  const auto distance = [&](std::uint32_t node) { return (mesh.nodes[node] - mean).squaredNorm(); };
  std::uint32_t center = nodes.front();
  double radius = 0;
  for (const std::uint32_t node : nodes) {
    if (distance(node) < distance(center)) center = node;
    radius = std::max(radius, std::sqrt(distance(node)));
    out.row_aggregate[layout.row_of_node[node]] = out.count();
  }
  out.inverse_sizes.push_back(radius > 0 ? 1 / radius : 1);
  out.center_rows.push_back(layout.row_of_node[center]);
}

/// Divides some nodes into compact aggregates.
void divide(std::span<const std::uint32_t> nodes, std::uint32_t parts, const mesh::Mesh& mesh,
            const matrix::Layout& layout, Aggregates& out) {
  std::vector<Eigen::Vector3d> points;
  for (const std::uint32_t node : nodes) points.push_back(mesh.nodes[node]);
  const mesh::Partition partition = mesh::partition(points, parts, static_cast<std::uint32_t>(nodes.size()));
  for (std::uint32_t part = 0; part < parts; ++part) {
    std::vector<std::uint32_t> of_part;
    for (std::uint32_t i = partition.offsets[part]; i < partition.offsets[part + 1]; ++i) {
      of_part.push_back(nodes[partition.order[i]]);
    }
    if (!of_part.empty()) add(of_part, mesh, layout, out);
  }
}

/// Returns the nodes of a piece by their patches. Neighbouring patches follow each other.
std::vector<std::vector<std::uint32_t>> by_patch(const std::vector<std::uint32_t>& piece,
                                                 const matrix::Layout& layout) {
  std::vector<std::vector<std::uint32_t>> patches(layout.patch_count);
  for (const std::uint32_t node : piece) patches[layout.patch_of_row(layout.row_of_node[node])].push_back(node);
  std::erase_if(patches, [](const auto& nodes) { return nodes.empty(); });
  return patches;
}

/// Least cg_tolerance of a scene that gets a coarse level by itself. Below it rounding decides how far a solve comes,
/// and c, which follows by recurrence (solver/coarse_level.h), drifts away from the residual.
constexpr double kLeastTolerance = 1e-6;

/// Returns whether a solve of the scene may take so many iterations that it gets a coarse level.
bool may_use(const Settings& settings) {
  if (settings.coarse_use != CoarseUse::kAutomatic) return settings.coarse_use == CoarseUse::kAlways;
  return settings.cg_tolerance >= kLeastTolerance && settings.cg_max_iterations > kCoarseFromIterations;
}

}  // namespace

Aggregates make_aggregates(const Settings& settings, const mesh::Mesh& mesh, const matrix::Layout& layout) {
  Aggregates out;
  // A streamed solve has no coarse level.
  if (!may_use(settings) || layout.storage == matrix::Storage::kTiles) return out;
  out.row_aggregate.assign(layout.row_count, view::kNoAggregate);
  const std::size_t most = std::clamp<std::size_t>(mesh.nodes.size() / kNodesOfAggregate, 1, view::kMaxAggregates);
  for (const std::vector<std::uint32_t>& piece : pieces_of(mesh)) {
    if (out.count() == view::kMaxAggregates) break;  // the rest is left to block-Jacobi
    const std::size_t share = std::max<std::size_t>(most * piece.size() / mesh.nodes.size(), 1);
    const std::size_t parts = std::min<std::size_t>(share, std::size_t{view::kMaxAggregates} - out.count());
    if (layout.storage == matrix::Storage::kEdges) {
      divide(piece, static_cast<std::uint32_t>(parts), mesh, layout, out);
      continue;
    }
    // Whole patches where they are small enough, so that a patch adds to few aggregates.
    const std::vector<std::vector<std::uint32_t>> patches = by_patch(piece, layout);
    const std::size_t groups = std::min(parts, patches.size());
    for (std::size_t group = 0, patch = 0; group < groups; ++group) {
      std::vector<std::uint32_t> nodes;
      for (; patch < (group + 1) * patches.size() / groups; ++patch) {
        nodes.insert(nodes.end(), patches[patch].begin(), patches[patch].end());
      }
      divide(nodes, static_cast<std::uint32_t>(parts / groups), mesh, layout, out);
    }
  }
  return out;
}

}  // namespace tensormass::model
