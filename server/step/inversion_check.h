#pragma once

#include <limits>

#include "matrix/element_points.h"
#include "view/guard.h"

/// Looks for elements that a step has turned inside out, for laws that do not come back from that (Law::kInversion).
/// Nearly always there is none. So first what is cheap: the sign of det J of where nodes are, J = Σ x_k ⊗ ∂N_k/∂r; and
/// only where that is not positive det F, from differences of what was given.
///
/// Linear tetrahedra in single precision on a GPU are looked at by the solve (backend/cuda/patch_volume.cuh).
namespace tensormass::step {

/// det F of a linear tetrahedron, from where its nodes are at rest and how far they have moved. 1 for padding. Edges
/// are differences of what was given, so that it is known to a few roundings in |edges|³ / (6 V), as well as F itself.
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

/// J of nodes that are each given less the first one, as gradients add up to zero. gradients: [nodes][3] of the
/// reference shape at a quadrature point.
template <class Shape, class T, class Real>
TM_HOST_DEVICE Mat3<T> jacobian(const Vec3<T> (&nodes)[Shape::kNodes], const Real* gradients) {
  Mat3<T> j = Mat3<T>::Zero();
  TM_UNROLL_ALL
  for (int k = 1; k < Shape::kNodes; ++k) {
    for (int c = 0; c < 3; ++c) j.col(c) += nodes[k] * T(gradients[3 * k + c]);
  }
  return j;
}

/// Threads that share the points of an element in check_inversion, where it has several.
inline constexpr std::uint32_t kThreadsOfPoints = 2;

/// The smallest det F of those of an element's quadrature points that look inside out; infinity: none does.
/// det J of where its nodes are over det J of where they rest. Rest shapes are left alone, 64 bytes of a tetrahedron
/// for 16, 850 of a hexahedron for 32. Of points first_point, first_point + step, ..
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

/// At most the smallest det J of some elements' quadrature points, from relative positions, which are rounded to the
/// size of the scene: above zero where least_det_f finds nothing. Rest shapes are left alone, and half of what that
/// reads of nodes. Of padding: below zero.
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
  // An edge is off by four roundings of a scene's size and of how far away the element is, which det J takes times the
  // other two columns and what a shape's gradients add up to, less than five.
  const T away = absolute(x[0][0]) + absolute(x[0][1]) + absolute(x[0][2]);
  const T rounding = T(32 * std::numeric_limits<Real>::epsilon() / 2) * (T(state.size_m) + away);
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

/// The smallest det F of a group, after each step: what a law that does not recover from inversion is guarded by.
/// Reads displacement, relative_position; writes min_det_f, infinity where nothing looks inside out.
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
      constexpr int kAtOnce = Shape::kSinglePoint ? 4 : 1;  // nothing is written, and every turn waits for memory
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
      // All packs at once, since to look into one takes longer than to bound it; in nearly all steps that is all.
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
      const Mat3<T> f = stored.gradients().deformation_gradient(u);  // of padding: the identity
      compression = maximum(compression, T(-f.determinant()));
    }
  });
  report();
}

}  // namespace tensormass::step
