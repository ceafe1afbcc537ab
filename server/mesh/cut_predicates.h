#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>

#include <Eigen/Core>

/// Exact tests of a blade against the edges of a mesh.
///
/// Points are rounded to a lattice of the body's box, and every test after that is exact. Four points in one plane
/// still get an answer: the points count as moved by infinitesimal distances that depend on their index alone
/// (simulation of simplicity; Edelsbrunner, Mücke 1990). All answers are therefore those of one arrangement of points
/// in which nothing touches by chance, so they never contradict each other. A blade that goes through a node, along an
/// edge or in a face needs no case of its own.
namespace tensormass::mesh {

/// Lattice steps along the longest side of the body's box.
inline constexpr std::int64_t kLatticeSteps = std::int64_t{1} << 24;
/// Largest lattice coordinate, 16,384 boxes away. A determinant of three differences then has less than 120 bits.
inline constexpr std::int64_t kMaxLatticeCoordinate = std::int64_t{1} << 38;

/// A point of the lattice.
struct LatticePoint {
  std::array<std::int64_t, 3> at{};
  /// Breaks ties; differs for each point of a test. A lower index is moved farther. Mesh nodes have the lowest ones, so
  /// that the nodes in a blade's plane all move to the same side of it.
  std::uint64_t index = 0;
};

/// Rounds positions to the lattice of a box.
class Lattice {
 public:
  /// The box of the given points [m]. Needs at least one.
  explicit Lattice(std::span<const Eigen::Vector3d> points);

  /// Returns the lattice point nearest to a position [m]; nothing if a coordinate is not a number or lies beyond
  /// kMaxLatticeCoordinate.
  std::optional<std::array<std::int64_t, 3>> at(const Eigen::Vector3d& position_m) const;

 private:
  Eigen::Vector3d origin_m_;
  double steps_per_m_;
};

/// Returns the sign of the volume of the tetrahedron a b c d: +1 if b c d runs counter-clockwise seen from outside, as
/// in VTK's tetrahedron, otherwise −1. Never 0.
int orientation(const LatticePoint& a, const LatticePoint& b, const LatticePoint& c, const LatticePoint& d);

/// Returns where the segment from a to b crosses the triangle p q r, from 0 (at a) to 1 (at b), if it does. A segment
/// in the triangle's plane counts as crossed in its middle.
std::optional<double> crossing(const LatticePoint& a, const LatticePoint& b, const LatticePoint& p,
                               const LatticePoint& q, const LatticePoint& r);

}  // namespace tensormass::mesh
