#pragma once

#include <limits>

#include "matrix/element_points.h"
#include "view/guard.h"

/// Finds elements that a step has inverted, for laws that do not recover from inversion (Law::kInversion).
///
///   x_k, X_k   current and rest position of node k
///   ∂N_k/∂r    gradient of its shape function in the reference shape, at a quadrature point
///   J          Σ x_k ⊗ ∂N_k/∂r, likewise J⁰ from X_k
///   det F      det J / det J⁰; inverted: not above zero
///
///   GPU   det J of each point ── not above 0 ──> det F
///   CPU   lower bound of det J of a pack ── not above 0 ──> det J of each point ── not above 0 ──> det F
///
/// 1. Nearly always no element is inverted, so the cheap sign of det J comes first.
/// 2. det F follows from differences of the stored positions, which keeps rounding small.
/// 3. A fused GPU solve checks linear tetrahedra itself, in single precision (backend/cuda/patch_volume.cuh).
namespace tensormass::step {

/// det F of a linear tetrahedron, from the rest positions and displacements of its nodes; 1 for padding. Edges are
/// differences of stored values. det F therefore has an error of only a few roundings times |edges|³ / (6 V), as F
/// itself has.
template <class Real>
TM_HOST_DEVICE Real det_f_of_nodes(const Vec3<Real> (&rest)[4], const Vec3<Real> (&displacement)[4]) {
  Vec3<Real> at_rest[3], now[3];
  for (int k = 0; k < 3; ++k) {
    at_rest[k] = rest[k + 1] - rest[0];
    now[k] = at_rest[k] + (displacement[k + 1] - displacement[0]);
  }
  const Real before = at_rest[0].dot(at_rest[1].cross(at_rest[2])), after = now[0].dot(now[1].cross(now[2]));
  return before != 0 ? quotient(after, before) : Real(1);
}

/// J from node positions relative to the first node, which suffices because the gradients of all nodes add up to zero.
/// gradients: [nodes][3] at a quadrature point.
template <class Shape, class T, class Real>
TM_HOST_DEVICE Mat3<T> jacobian(const Vec3<T> (&nodes)[Shape::kNodes], const Real* gradients) {
  Mat3<T> j = Mat3<T>::Zero();
  TM_UNROLL_ALL
  for (int k = 1; k < Shape::kNodes; ++k) {
    for (int c = 0; c < 3; ++c) j.col(c) += nodes[k] * T(gradients[3 * k + c]);
  }
  return j;
}

/// Threads that share the points of an element in check_inversion, if it has several points.
inline constexpr std::uint32_t kThreadsOfPoints = 2;

/// Returns the smallest det F of an element's inverted quadrature points; infinity if no point is inverted. It checks
/// the points first_point, first_point + step, ... It reads positions instead of stored rest shapes: 16 bytes instead
/// of 64 for a tetrahedron, 32 instead of 850 for a hexahedron.
template <class Shape, class Real>
TM_HOST_DEVICE Real least_det_f(const view::StateView<Real>& state, const view::ElementView<Real>& e,
                                std::uint32_t element, std::uint32_t first_point = 0, std::uint32_t step = 1) {
  constexpr int kNodes = Shape::kNodes;
  constexpr Real kNone = std::numeric_limits<Real>::infinity();
  Vec3<Real> rest[kNodes], displacement[kNodes];
  TM_UNROLL_ALL
  for (int k = 0; k < kNodes; ++k) {
    const std::uint32_t row = e.rows[static_cast<std::uint32_t>(k) * std::size_t{e.count} + element];
    rest[k] = view::load3<Real>(state.rest, row);
    displacement[k] = view::load3<Real>(state.displacement, row);
  }
  if constexpr (Shape::kSinglePoint) {
    const Real det_f = det_f_of_nodes(rest, displacement);
    return det_f > 0 ? kNone : det_f;
  } else {
    Vec3<Real> now[kNodes];
    TM_UNROLL_ALL
    for (int k = 1; k < kNodes; ++k) {
      rest[k] -= rest[0];
      now[k] = rest[k] + (displacement[k] - displacement[0]);
    }
    Real least = kNone;
    TM_UNROLL(1)
    for (std::uint32_t q = first_point; q < e.reference_points; q += step) {
      const Real* gradients = e.reference_gradients + std::size_t{3} * kNodes * q;
      const Real after = jacobian<Shape>(now, gradients).determinant();
      if (after > 0) continue;
      const Real before = jacobian<Shape>(rest, gradients).determinant();
      if (before != 0) least = minimum(least, quotient(after, before));  // else: padding
    }
    return least;
  }
}

/// Returns a lower bound of det J over the quadrature points of some elements. Where it is positive, least_det_f finds
/// nothing. It uses relative positions, which are rounded to the size of the scene. It reads no rest shapes, and half
/// as much of each node as least_det_f. Returns a negative value for padding.
template <class Lanes, class Shape, class Real>
TM_HOST_DEVICE typename Lanes::Scalar bound_det_j(const view::StateView<Real>& state,
                                                  const view::GuardView<Real>& guard, const view::ElementView<Real>& e,
                                                  std::uint32_t first) {
  using T = typename Lanes::Scalar;
  constexpr int kNodes = Shape::kNodes;
  Vec3<T> x[kNodes];
  TM_UNROLL_ALL
  for (int k = 0; k < kNodes; ++k) {
    x[k] =
        Lanes::gather3(guard.relative_position, e.rows + std::size_t{static_cast<std::uint32_t>(k)} * e.count + first);
    if (k > 0) x[k] -= x[0];
  }
  // The error of an edge is at most four roundings of the scene's size and of the element's distance. det J multiplies
  // it by the other two columns and by the sum of a shape's gradients at its points. That sum is less than seven, with
  // more than ten nodes at most twelve.
  constexpr int kRoundings = kNodes > 10 ? 80 : 32;
  const T away = absolute(x[0][0]) + absolute(x[0][1]) + absolute(x[0][2]);
  const T rounding = T(kRoundings * std::numeric_limits<Real>::epsilon() / 2) * (T(state.size_m) + away);
  T least = T(std::numeric_limits<Real>::infinity());
  const auto look = [&](const Vec3<T>& a, const Vec3<T>& b, const Vec3<T>& c) {
    const T volume = a.dot(b.cross(c));
    T squares = rounding * rounding;
    TM_UNROLL_ALL
    for (int i = 0; i < 3; ++i) squares += a[i] * a[i] + (b[i] * b[i] + c[i] * c[i]);
    least = minimum(least, T(volume - rounding * squares));
  };
  if constexpr (Shape::kSinglePoint) {
    look(x[1], x[2], x[3]);
  } else {
    TM_UNROLL(1)
    for (std::uint32_t q = 0; q < e.reference_points; ++q) {
      const Mat3<T> j = jacobian<Shape>(x, e.reference_gradients + std::size_t{3} * kNodes * q);
      look(j.col(0), j.col(1), j.col(2));
    }
  }
  return least;
}

/// Finds the smallest det F of a group's inverted elements, after each step.
/// Reads displacement, relative_position; writes min_det_f: infinity if no element is inverted.
template <class Shape, class Team, class Real>
TM_HOST_DEVICE void check_inversion(const Team& team, const view::PatchesView& patches,
                                    const view::StateView<Real>& state, const view::GuardView<Real>& guard,
                                    const view::ElementView<Real>& e) {
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  const matrix::ElementRange range = matrix::element_range(patches, e, team.patch());
  T compression = T(-std::numeric_limits<Real>::infinity());  // −det F
  const auto report = [&] {
    const Real worst = team.patch_max(Lanes::largest(compression));
    if (team.leads_patch()) guard.min_det_f[(e.report_begin + team.patch()) * team.parts() + team.part()] = -worst;
  };
  if (e.reference_gradients != nullptr) {
    if constexpr (matrix::kReadsRecords<Lanes>) {
      constexpr std::uint32_t kThreads = Shape::kSinglePoint ? 1 : kThreadsOfPoints;
      constexpr int kAtOnce = Shape::kSinglePoint ? 4 : 1;  // bodies only read, and each waits for memory
      team.template for_each<kAtOnce>(kThreads * range.begin, kThreads * range.end, [&](std::uint32_t i) {
        compression = maximum(compression, T(-least_det_f<Shape>(state, e, i / kThreads, i % kThreads, kThreads)));
      });
    } else {
      const auto one_by_one = [&](std::uint32_t begin, std::uint32_t end) {
        for (std::uint32_t i = begin; i < end; ++i) {
          compression = maximum(compression, T(-least_det_f<Shape>(state, e, i)));
        }
      };
      const auto is_sound = [](const T& bound) { return Lanes::largest(T(-bound)) < 0; };
      // First the bound of all packs together: in nearly all steps no more is needed. Testing each pack takes longer
      // than its bound.
      const std::uint32_t packed = range.end - (range.end - range.begin) % Lanes::kWidth;
      T least = T(std::numeric_limits<Real>::infinity());
      team.template for_lanes<Lanes::kWidth>(range.begin, packed, [&](std::uint32_t first) {
        least = minimum(least, bound_det_j<Lanes, Shape>(state, guard, e, first));
      });
      if (!is_sound(least)) {
        team.template for_lanes<Lanes::kWidth>(range.begin, packed, [&](std::uint32_t first) {
          if (!is_sound(bound_det_j<Lanes, Shape>(state, guard, e, first))) one_by_one(first, first + Lanes::kWidth);
        });
      }
      one_by_one(packed, range.end);
    }
    return report();
  }
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    Vec3<T> u[Shape::kNodes];
    matrix::load_displacement<Lanes, Shape>(state, e, first, u);
    TM_UNROLL(1)
    for (std::uint32_t q = 0; q < matrix::points_of<Shape>(e); ++q) {
      const matrix::StoredPoint<Lanes, Shape, matrix::NoLaw> stored(e, q, first);
      const Mat3<T> f = stored.gradients().deformation_gradient(u);  // the identity for padding
      compression = maximum(compression, T(-f.determinant()));
    }
  });
  report();
}

}  // namespace tensormass::step
