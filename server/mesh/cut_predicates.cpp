#include "mesh/cut_predicates.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace tensormass::mesh {
namespace {

__extension__ typedef __int128 Wide;  // ISO C++ has no integer of 128 bits
using Row = std::array<std::int64_t, 3>;

Wide determinant(const Row& a, const Row& b, const Row& c) {
  const auto minor = [&](std::size_t i, std::size_t j) { return Wide{b[i]} * c[j] - Wide{b[j]} * c[i]; };
  return a[0] * minor(1, 2) - a[1] * minor(0, 2) + a[2] * minor(0, 1);
}

Row difference(const LatticePoint& a, const LatticePoint& b) {
  return {a.at[0] - b.at[0], a.at[1] - b.at[1], a.at[2] - b.at[2]};
}

int sign(Wide value) { return value > 0 ? 1 : value < 0 ? -1 : 0; }

/// Six times the volume of the tetrahedron a b c d. Not perturbed.
Wide exact_six_volumes(const LatticePoint& a, const LatticePoint& b, const LatticePoint& c, const LatticePoint& d) {
  return -determinant(difference(a, d), difference(b, d), difference(c, d));
}

constexpr int kUnmoved = 3;  // instead of a coordinate

}  // namespace

Lattice::Lattice(std::span<const Eigen::Vector3d> points) {
  Eigen::Vector3d low = points[0], high = points[0];
  for (const Eigen::Vector3d& point : points) {
    low = low.cwiseMin(point);
    high = high.cwiseMax(point);
  }
  origin_m_ = low;
  const double side_m = (high - low).maxCoeff();
  steps_per_m_ = side_m > 0 ? static_cast<double>(kLatticeSteps) / side_m : 1.0;
}

std::optional<std::array<std::int64_t, 3>> Lattice::at(const Eigen::Vector3d& position_m) const {
  std::array<std::int64_t, 3> rounded{};
  for (int axis = 0; axis < 3; ++axis) {
    const double steps = (position_m[axis] - origin_m_[axis]) * steps_per_m_;
    if (!(std::abs(steps) <= static_cast<double>(kMaxLatticeCoordinate))) return std::nullopt;  // also not a number
    rounded[static_cast<std::size_t>(axis)] = std::llround(steps);
  }
  return rounded;
}

// Point i in the order of indices counts as moved by ε_ix, ε_iy, ε_iz. They are so chosen that
// ε_0x >> ε_0y >> ε_0z >> ε_1x >> ..., and each is larger than all products of smaller ones. The determinant is linear
// in each of them, so its sign is that of its first coefficient that is not zero. The coefficient of ε_ic ε_jd ... is
// the determinant whose rows i, j, ... are unit vectors along c, d, ... The loops below visit the coefficients in
// falling order; the product ε_0z ε_1y ε_2x has ±1, so they end.
int orientation(const LatticePoint& a, const LatticePoint& b, const LatticePoint& c, const LatticePoint& d) {
  if (const int exact = sign(exact_six_volumes(a, b, c, d)); exact != 0) return exact;
  std::array<const LatticePoint*, 4> sorted{&a, &b, &c, &d};
  int parity = -1;  // as in exact_six_volumes
  for (std::size_t i = 1; i < 4; ++i) {
    for (std::size_t j = i; j > 0 && sorted[j]->index < sorted[j - 1]->index; --j) {
      std::swap(sorted[j], sorted[j - 1]);
      parity = -parity;
    }
  }
  const std::array<Row, 3> rows{difference(*sorted[0], *sorted[3]), difference(*sorted[1], *sorted[3]),
                                difference(*sorted[2], *sorted[3])};
  const auto moved = [&](std::size_t row, int axis) {
    if (axis == kUnmoved) return rows[row];
    Row unit{};
    unit[static_cast<std::size_t>(axis)] = 1;
    return unit;
  };
  for (const int axis2 : {kUnmoved, 0, 1, 2}) {
    for (const int axis1 : {kUnmoved, 0, 1, 2}) {
      for (const int axis0 : {kUnmoved, 0, 1, 2}) {
        const int found = sign(determinant(moved(0, axis0), moved(1, axis1), moved(2, axis2)));
        if (found != 0) return parity * found;
      }
    }
  }
  return parity;  // never reached
}

std::optional<double> crossing(const LatticePoint& a, const LatticePoint& b, const LatticePoint& p,
                               const LatticePoint& q, const LatticePoint& r) {
  if (orientation(p, q, r, a) == orientation(p, q, r, b)) return std::nullopt;
  const int side = orientation(a, b, p, q);
  if (orientation(a, b, q, r) != side || orientation(a, b, r, p) != side) return std::nullopt;
  const double at_a = std::abs(static_cast<double>(exact_six_volumes(p, q, r, a)));
  const double at_b = std::abs(static_cast<double>(exact_six_volumes(p, q, r, b)));
  return at_a + at_b > 0 ? at_a / (at_a + at_b) : 0.5;
}

}  // namespace tensormass::mesh
