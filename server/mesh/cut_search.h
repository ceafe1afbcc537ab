#pragma once

#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "mesh/cut_predicates.h"
#include "mesh/cut_topology.h"

namespace tensormass::mesh {

/// A mesh edge that a blade crosses.
struct CutEdge {
  std::uint32_t edge = kNone;
  double crossing = 0.5;  ///< from 0 at the lower node to 1 at the higher one
};

/// Why a blade found no edges.
enum class SweepRefusal {
  kOddPoints,     ///< not two or more blade points, or not equally many before and after
  kPosition,      ///< a position is not a number, or farther away than kMaxLatticeCoordinate
  kTooManyEdges,  ///< more edges than the caller has room for
};

/// Returns what happened and what helps.
std::string_view words(SweepRefusal refusal);

/// The edges that a blade crossed, or why there is no answer.
struct Sweep {
  std::span<const CutEdge> edges;  ///< ascending, each once
  bool refused = false;
  SweepRefusal refusal{};  ///< valid if refused
};

/// Finds the edges of a mesh that a blade crosses.
///
/// A blade is a line of points, and moves in material coordinates: as if the tissue were at rest. Between two positions
/// it sweeps two triangles for each pair of neighbouring points:
///
///   before   0 ─── 1 ─── 2
///            │  ╲  │  ╲  │
///   after    0 ─── 1 ─── 2
///
/// An edge cannot slip between two triangles, nor between two sweeps if the second starts where the first ended. The
/// edge of a quadratic element counts as two straight ones that meet in its middle node.
///
/// Memory is allocated by the constructor alone.
class CutSearch {
 public:
  /// The topology must outlive this object.
  explicit CutSearch(const CutTopology& topology);

  /// Writes the crossed edges to `room`. If a sweep crosses an edge several times, the first triangle counts. All
  /// positions [m] are material ones.
  Sweep sweep(std::span<const Eigen::Vector3d> before_m, std::span<const Eigen::Vector3d> after_m,
              std::span<CutEdge> room);

 private:
  struct Cells {
    std::array<std::int64_t, 3> low{}, high{};
  };
  struct Found {
    std::span<CutEdge> room;
    std::size_t count = 0;
    bool full = false;
  };

  Cells cells_around(std::array<std::int64_t, 3> low, std::array<std::int64_t, 3> high) const;
  std::size_t cell(std::int64_t x, std::int64_t y, std::int64_t z) const {
    return static_cast<std::size_t>(x + cells_[0] * (y + cells_[1] * z));
  }
  LatticePoint node(std::uint32_t node) const { return {node_at_[node], node}; }
  void test(const std::array<LatticePoint, 3>& triangle, Found& found);
  /// Returns where a triangle crosses an edge, below 0 if it does not.
  double crossing_of(std::uint32_t edge, const std::array<LatticePoint, 3>& triangle) const;

  const CutTopology& topology_;
  Lattice lattice_;
  std::vector<std::array<std::int64_t, 3>> node_at_;
  std::array<std::int64_t, 3> cells_{1, 1, 1};
  std::int64_t cell_steps_ = 1;
  Rows cell_edges_;
  std::vector<std::uint64_t> tested_;   // [edge] the triangle it was tested against last
  std::vector<std::uint64_t> crossed_;  // [edge] the sweep that crossed it last
  std::uint64_t triangle_ = 0, sweep_ = 0;
};

}  // namespace tensormass::mesh
