#include "mesh/cut_search.h"

#include <algorithm>
#include <cmath>

#include "core/assert.h"

namespace tensormass::mesh {
namespace {

__extension__ typedef __int128 Wide;
using Place = std::array<std::int64_t, 3>;

/// The plane of a triangle, to leave out cells that lie on one side of it.
class Plane {
 public:
  explicit Plane(const std::array<LatticePoint, 3>& triangle) : origin_(triangle[0].at) {
    const auto along = [&](std::size_t corner, std::size_t axis) {
      return Wide{triangle[corner].at[axis] - origin_[axis]};
    };
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const std::size_t y = (axis + 1) % 3, z = (axis + 2) % 3;
      normal_[axis] = along(1, y) * along(2, z) - along(1, z) * along(2, y);
    }
  }

  /// Returns whether the plane touches a closed box.
  bool touches(const Place& low, const Place& high) const {
    Wide least = 0, most = 0;
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const Wide at_low = normal_[axis] * (low[axis] - origin_[axis]);
      const Wide at_high = normal_[axis] * (high[axis] - origin_[axis]);
      least += std::min(at_low, at_high);
      most += std::max(at_low, at_high);
    }
    return least <= 0 && most >= 0;
  }

 private:
  Place origin_;
  std::array<Wide, 3> normal_{};
};

}  // namespace

std::string_view words(SweepRefusal refusal) {
  switch (refusal) {
    case SweepRefusal::kOddPoints:
      return "a blade needs two or more points, and as many after a move as before";
    case SweepRefusal::kPosition:
      return "a blade point is not a number, or is far outside of the body; leave the blade out of this step";
    case SweepRefusal::kTooManyEdges:
      return "a blade crosses more edges in one move than there is room for; move it in smaller steps";
  }
  return "";
}

CutSearch::CutSearch(const CutTopology& topology)
    : topology_(topology),
      lattice_(topology.mesh().nodes),
      tested_(topology.edge_count(), 0),
      crossed_(topology.edge_count(), 0) {
  for (const Eigen::Vector3d& position : topology.mesh().nodes) node_at_.push_back(lattice_.at(position).value());
  Place high{};
  for (const Place& at : node_at_) {
    for (std::size_t axis = 0; axis < 3; ++axis) high[axis] = std::max(high[axis], at[axis]);
  }
  // About one cell an edge if the edges filled their box.
  const double per_side = std::max(1.0, std::cbrt(static_cast<double>(topology.edge_count())));
  cell_steps_ = std::max<std::int64_t>(1, static_cast<std::int64_t>(static_cast<double>(kLatticeSteps) / per_side));
  for (std::size_t axis = 0; axis < 3; ++axis) cells_[axis] = high[axis] / cell_steps_ + 1;

  // Counts, then fills.
  const auto for_each_cell = [&](std::uint32_t edge, auto&& visit) {
    const auto [a, b] = topology_.ends(edge);
    Place low = node_at_[a], top = node_at_[a];
    for (const std::uint32_t n : {b, topology_.middle(edge)}) {
      if (n == kNone) continue;
      for (std::size_t axis = 0; axis < 3; ++axis) {
        low[axis] = std::min(low[axis], node_at_[n][axis]);
        top[axis] = std::max(top[axis], node_at_[n][axis]);
      }
    }
    const Cells around = cells_around(low, top);
    for (std::int64_t z = around.low[2]; z <= around.high[2]; ++z) {
      for (std::int64_t y = around.low[1]; y <= around.high[1]; ++y) {
        for (std::int64_t x = around.low[0]; x <= around.high[0]; ++x) visit(cell(x, y, z));
      }
    }
  };
  cell_edges_.offsets.assign(static_cast<std::size_t>(cells_[0] * cells_[1] * cells_[2]) + 1, 0);
  for (std::uint32_t edge = 0; edge < topology.edge_count(); ++edge) {
    for_each_cell(edge, [&](std::size_t c) { ++cell_edges_.offsets[c + 1]; });
  }
  for (std::size_t c = 0; c + 1 < cell_edges_.offsets.size(); ++c) cell_edges_.offsets[c + 1] += cell_edges_.offsets[c];
  cell_edges_.items.resize(cell_edges_.offsets.back());
  std::vector<std::uint32_t> next(cell_edges_.offsets.begin(), cell_edges_.offsets.end() - 1);
  for (std::uint32_t edge = 0; edge < topology.edge_count(); ++edge) {
    for_each_cell(edge, [&](std::size_t c) { cell_edges_.items[next[c]++] = edge; });
  }
}

CutSearch::Cells CutSearch::cells_around(Place low, Place high) const {
  Cells cells;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const auto of = [&](std::int64_t at) { return at < 0 ? std::int64_t{-1} : at / cell_steps_; };
    cells.low[axis] = std::max<std::int64_t>(0, of(low[axis]));
    cells.high[axis] = std::min(cells_[axis] - 1, of(high[axis]));
  }
  return cells;
}

double CutSearch::crossing_of(std::uint32_t edge, const std::array<LatticePoint, 3>& triangle) const {
  const auto [a, b] = topology_.ends(edge);
  const auto& [p, q, r] = triangle;
  const std::uint32_t middle = topology_.middle(edge);
  if (middle == kNone) return mesh::crossing(node(a), node(b), p, q, r).value_or(-1.0);
  if (const auto first = mesh::crossing(node(a), node(middle), p, q, r)) return 0.5 * *first;
  if (const auto second = mesh::crossing(node(middle), node(b), p, q, r)) return 0.5 + 0.5 * *second;
  return -1.0;
}

void CutSearch::test(const std::array<LatticePoint, 3>& triangle, Found& found) {
  ++triangle_;
  Place low = triangle[0].at, high = low;
  for (const LatticePoint& corner : triangle) {
    for (std::size_t axis = 0; axis < 3; ++axis) {
      low[axis] = std::min(low[axis], corner.at[axis]);
      high[axis] = std::max(high[axis], corner.at[axis]);
    }
  }
  const Plane plane(triangle);
  const Cells around = cells_around(low, high);
  for (std::int64_t z = around.low[2]; z <= around.high[2]; ++z) {
    for (std::int64_t y = around.low[1]; y <= around.high[1]; ++y) {
      for (std::int64_t x = around.low[0]; x <= around.high[0]; ++x) {
        const Place corner{x * cell_steps_, y * cell_steps_, z * cell_steps_};
        if (!plane.touches(corner, {corner[0] + cell_steps_, corner[1] + cell_steps_, corner[2] + cell_steps_})) {
          continue;
        }
        for (const std::uint32_t edge : cell_edges_[static_cast<std::uint32_t>(cell(x, y, z))]) {
          if (tested_[edge] == triangle_ || crossed_[edge] == sweep_) continue;
          tested_[edge] = triangle_;
          const double at = crossing_of(edge, triangle);
          if (at < 0.0) continue;
          if (found.count == found.room.size()) {
            found.full = true;
            return;
          }
          crossed_[edge] = sweep_;
          found.room[found.count++] = {edge, at};
        }
      }
    }
  }
}

Sweep CutSearch::sweep(std::span<const Eigen::Vector3d> before_m, std::span<const Eigen::Vector3d> after_m,
                       std::span<CutEdge> room) {
  const auto refuse = [](SweepRefusal why) { return Sweep{.edges = {}, .refused = true, .refusal = why}; };
  const std::size_t count = before_m.size();
  if (count < 2 || count != after_m.size()) return refuse(SweepRefusal::kOddPoints);
  // Every position is checked before the first test. Indices rise with time, so that the points between two sweeps
  // break ties in both of them alike.
  for (std::size_t i = 0; i < count; ++i) {
    if (!lattice_.at(before_m[i]) || !lattice_.at(after_m[i])) return refuse(SweepRefusal::kPosition);
  }
  const std::uint64_t nodes = topology_.node_count();
  const auto before = [&](std::size_t i) { return LatticePoint{*lattice_.at(before_m[i]), nodes + i}; };
  const auto after = [&](std::size_t i) { return LatticePoint{*lattice_.at(after_m[i]), nodes + count + i}; };

  ++sweep_;
  Found found{room};
  for (std::size_t i = 0; i + 1 < count && !found.full; ++i) {
    // A pair of points that did not move sweeps nothing.
    if (before(i).at == after(i).at && before(i + 1).at == after(i + 1).at) continue;
    test({before(i), before(i + 1), after(i + 1)}, found);
    if (!found.full) test({before(i), after(i + 1), after(i)}, found);
  }
  if (found.full) return refuse(SweepRefusal::kTooManyEdges);
  const std::span<CutEdge> edges = room.first(found.count);
  std::sort(edges.begin(), edges.end(), [](const CutEdge& a, const CutEdge& b) { return a.edge < b.edge; });
  return {.edges = edges};
}

}  // namespace tensormass::mesh
