#pragma once

#include <cmath>
#include <limits>

#include "physics/element/element.h"
#include "view/elements.h"
#include "view/newton.h"
#include "view/state.h"

/// Quadrature points of elements: their stored data, and the law evaluated there.
///
///   lane   one of several elements that are evaluated together. A GPU thread has one lane; a CPU has as many as a
///          vector register holds. Lanes::Scalar is a number or a pack of numbers, and formulas do not know which.
///   first  index of the first element of the lanes
///   q      index of a quadrature point
///   u      displacement of the elements' nodes [m]
///   F      deformation gradient, I + Σ u_k ⊗ ∇N_k over the nodes k with shape functions N_k
namespace tensormass::matrix {

using namespace view;

/// The elements of a group that a patch works on. If the matrix stores edges, these are all elements that touch the
/// patch, so several patches may evaluate the same element. Otherwise each patch has an even share of whole slices,
/// whichever patches own their nodes.
struct ElementRange {
  std::uint32_t begin, end;
};
template <class Real>
TM_HOST_DEVICE ElementRange element_range(const view::PatchesView& patches, const ElementView<Real>& e,
                                          std::uint32_t patch) {
  if (e.patch_elements != nullptr) return {e.patch_elements[2 * patch], e.patch_elements[2 * patch + 1]};
  const std::uint32_t slices = e.count / kSliceRows;
  return {static_cast<std::uint32_t>(std::uint64_t{slices} * patch / patches.patch_count) * kSliceRows,
          static_cast<std::uint32_t>(std::uint64_t{slices} * (patch + 1) / patches.patch_count) * kSliceRows};
}

/// Reads the displacements of the nodes of the elements from `first` on.
template <class Lanes, class Shape, class Real>
TM_HOST_DEVICE void load_displacement(const view::StateView<Real>& state, const ElementView<Real>& e,
                                      std::uint32_t first, Vec3<typename Lanes::Scalar> (&u)[Shape::kNodes]) {
  TM_UNROLL_ALL
  for (int k = 0; k < Shape::kNodes; ++k) {
    u[k] = Lanes::gather3(state.displacement, e.rows + std::size_t{static_cast<std::uint32_t>(k)} * e.count + first);
  }
}

/// Reads reals that lie together. The address and Count must be multiples of four, so that a GPU reads four at once.
/// Once: the step does not read them again later (core/scalar.h, read_once).
template <bool Once = false, std::uint32_t Count, class Real>
TM_HOST_DEVICE void read_reals(const Real* from, Real (&to)[Count]) {
  static_assert(Count % 4 == 0);
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < Count; c += 4) {
      const auto* p = reinterpret_cast<const float4*>(from + c);
      const float4 v = Once ? read_once(p) : *p;
      to[c] = v.x;
      to[c + 1] = v.y;
      to[c + 2] = v.z;
      to[c + 3] = v.w;
    }
  } else
#endif
  {
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < Count; ++c) to[c] = from[c];
  }
}

/// Writes reals where read_reals can read them.
template <std::uint32_t Count, class Real>
TM_HOST_DEVICE void write_reals(const Real (&from)[Count], Real* to) {
  static_assert(Count % 4 == 0);
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < Count; c += 4) {
      *reinterpret_cast<float4*>(to + c) = {from[c], from[c + 1], from[c + 2], from[c + 3]};
    }
  } else
#endif
  {
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < Count; ++c) to[c] = from[c];
  }
}

/// Quadrature points of an element: a constant for shapes with one.
template <class Shape, class Real>
TM_HOST_DEVICE std::uint32_t points_of(const ElementView<Real>& e) {
  return Shape::kSinglePoint ? 1 : e.point_count;
}

/// Whether elements are read from records, one at a time, or from structures of arrays, in packs (view/elements.h).
template <class Lanes>
inline constexpr bool kReadsRecords = Lanes::kWidth == 1;

/// A quadrature point as it is stored. The constructor only reads. Derived values are computed where they are used, so
/// that a GPU thread does not wait for the reads here.
template <class Lanes, class Shape, class Law>
struct StoredPoint {
  using T = typename Lanes::Scalar;
  static constexpr std::uint32_t kReals = physics::kRestReals<Shape>;
  T reals[round_to_four(kReals)];
  T parameters[maximum(Law::kParameterCount, 1)];

  StoredPoint() = default;
  template <class Real>
  TM_HOST_DEVICE StoredPoint(const ElementView<Real>& e, std::uint32_t q, std::uint32_t first) {
    if constexpr (kReadsRecords<Lanes>) {
      const std::uint32_t points = points_of<Shape>(e), stride = point_stride(kReals, points);
      const Real* record = e.records + std::size_t{first} * e.record_reals;
      // The rows of an element with a single point lie in few slices, which a GPU evaluates at about the same time. One
      // read from memory serves all of them, so the cache need not keep it longer.
      read_reals<Shape::kSinglePoint>(record + q * stride, reals);
      // The padding behind the reals of a single point holds its first parameters. They are already read.
      constexpr int kParameters = Law::kParameterCount;
      constexpr int kFilling = static_cast<int>(round_to_four(kReals) - kReals);
      constexpr int kRead = Shape::kSinglePoint ? minimum(kFilling, kParameters) : 0;
      TM_UNROLL_ALL
      for (int c = 0; c < kRead; ++c) parameters[c] = reals[kReals + c];
      TM_UNROLL_ALL
      for (int c = kRead; c < kParameters; ++c) parameters[c] = record[points * stride + c];
    } else {
      const Real* rest = e.rest + std::size_t{q} * kReals * e.count + first;
      TM_UNROLL_ALL
      for (std::uint32_t c = 0; c < kReals; ++c) reals[c] = Lanes::load(rest + std::size_t{c} * e.count);
      for (int c = 0; c < Law::kParameterCount; ++c) {
        parameters[c] = Lanes::load(e.parameters + static_cast<std::size_t>(c) * e.count + first);
      }
    }
  }

  TM_HOST_DEVICE auto gradients() const {
    return physics::PointGradients<Shape, T>::read([&](int c) { return reals[c]; });
  }
  /// Evaluates the law at F, or at the decomposition of F. Its moduli are multiplied by the point's integration
  /// weights.
  template <class Real, class DeformationGradient>
  TM_HOST_DEVICE auto law_at(const ElementView<Real>& e, std::uint32_t q, const DeformationGradient& f) const {
    T own[maximum(Law::kParameterCount, 1)];
    for (int c = 0; c < Law::kParameterCount; ++c) own[c] = parameters[c];
    if (!Shape::kSinglePoint && e.moduli_weights != nullptr) {
      Law::scale_moduli(own, T(e.moduli_weights[q].deviatoric), T(e.moduli_weights[q].volumetric));
    }
    return Law::at(f, own);
  }
};

/// Stands for the law in code that needs only the shape: no parameters are read.
struct NoLaw {
  static constexpr int kParameterCount = 0;
};

/// Returns the time by which the internal variables must advance in this evaluation [s]: StepControl::internal_dt_s in
/// the first evaluation of a step, zero in later Newton iterations.
template <class Real>
TM_HOST_DEVICE Real internal_step(const view::StateView<Real>& state, const view::NewtonView<Real>& newton) {
  return newton.control == nullptr || newton.control->begins_step != 0 ? state.control->internal_dt_s : Real(0);
}

/// Returns the viscous part of a point's stress in a step of dt_s (physics/element/prony.h). If internal_dt_s is
/// positive, it first advances the internal variables by that time, to the stress at the end of the last step, and
/// stores them.
template <class Lanes, class Law, class Point, class Real>
TM_HOST_DEVICE auto viscous_stress_at(const ElementView<Real>& e, std::uint32_t q, std::uint32_t first,
                                      const Point& point, Real dt_s, Real internal_dt_s) {
  using T = typename Lanes::Scalar;
  T stress[physics::kSymmetricReals], memory[physics::kSymmetricReals];
  physics::to_symmetric<T>(Law::second_piola(point), stress);
  for (T& value : memory) value = T(0);
  T instant = T(1);
  for (std::uint32_t term = 0; term < e.prony_count; ++term) {
    const PronyTerm<Real> t = e.prony[term];
    const auto now = physics::prony_step(t.share, t.relaxation_time_s, dt_s);
    const auto last = physics::prony_step(t.share, t.relaxation_time_s, internal_dt_s);
    instant -= T(now.gain);
    for (std::uint32_t c = 0; c < physics::kSymmetricReals; ++c) {
      Real* place = e.internal_variables +
                    ((std::size_t{q} * e.prony_count + term) * physics::kSymmetricReals + c) * e.count + first;
      T gamma = Lanes::load(place);
      if (internal_dt_s > 0) {
        gamma = T(last.gain) * stress[c] + T(last.decay) * gamma;
        Lanes::store(place, gamma);
      }
      memory[c] += T(now.decay) * gamma;
    }
  }
  return physics::Viscous<T>{instant, physics::symmetric<T>(memory)};
}

/// Evaluates every quadrature point.
///
///   visit(gradients, F, point, q)   called for each point; point: the law evaluated at F
template <class Lanes, class Shape, class Law, class Real, class Visit>
TM_HOST_DEVICE void for_each_point(const ElementView<Real>& e, std::uint32_t first,
                                   const Vec3<typename Lanes::Scalar> (&u)[Shape::kNodes], const Visit& visit) {
  TM_UNROLL(1)
  for (std::uint32_t q = 0; q < points_of<Shape>(e); ++q) {
    const StoredPoint<Lanes, Shape, Law> stored(e, q, first);
    const auto gradients = stored.gradients();
    const Mat3<typename Lanes::Scalar> f = gradients.deformation_gradient(u);
    auto point = stored.law_at(e, q, f);
    visit(gradients, f, point, q);
  }
}

/// The stiffness that the host asks for: the consistent one, or the one projected to positive definite.
template <class Real>
TM_HOST_DEVICE physics::Stiffness stiffness_kind(const view::StateView<Real>& state,
                                                 const view::NewtonView<Real>& newton) {
  const std::uint32_t projects =
      newton.control == nullptr ? state.control->projects_stiffness : newton.control->projects_stiffness;
  return projects != 0 ? physics::Stiffness::kProjected : physics::Stiffness::kConsistent;
}

/// Computes a point's viscous stress, if its group has Prony terms.
///
///   add(const physics::Viscous*)   called once, with nullptr for a group without Prony terms
///
/// internal_dt_s: as for viscous_stress_at.
template <class Lanes, class Law, class Real, class Point, class Add>
TM_HOST_DEVICE void with_viscous_stress(const view::StateView<Real>& state, const ElementView<Real>& e, std::uint32_t q,
                                        std::uint32_t first, const Point& point, Real internal_dt_s, const Add& add) {
  using Memory = physics::Viscous<typename Lanes::Scalar>;
  if (e.prony_count == 0) return add(static_cast<const Memory*>(nullptr));
  const Memory memory = viscous_stress_at<Lanes, Law>(e, q, first, point, state.control->dt_s, internal_dt_s);
  add(&memory);
}

/// Advances the internal variables of a group to the stress at the end of the last step. A GPU does this in a stage of
/// its
/// own: several rows evaluate an element there, and none of them may write its variables.
/// Reads displacement, internal variables; writes internal variables.
template <class Shape, class Law, class Team, class Real>
TM_HOST_DEVICE void advance_internal_variables(const Team& team, const view::PatchesView& patches,
                                               const view::StateView<Real>& state, const view::NewtonView<Real>& newton,
                                               const ElementView<Real>& e) {
  using Lanes = typename Team::template Lanes<Real>;
  const Real internal_dt_s = internal_step(state, newton);
  if (!(internal_dt_s > 0)) return;
  const ElementRange range = element_range(patches, e, team.patch());
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    Vec3<typename Lanes::Scalar> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(state, e, first, u);
    for_each_point<Lanes, Shape, Law>(e, first, u, [&](const auto&, const auto&, const auto& point, std::uint32_t q) {
      viscous_stress_at<Lanes, Law>(e, q, first, point, state.control->dt_s, internal_dt_s);
    });
  });
}

}  // namespace tensormass::matrix
