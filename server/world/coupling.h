#pragma once

#include <algorithm>

#include <Eigen/Cholesky>

#include "core/scalar.h"

/// The virtual coupling between the hand and a tool that has a mass (Colgate, Stanley, Brown 1995; Adams, Hannaford
/// 1999).
///
///     hand h ──spring k, damper c──> tool x, v, mass m <──contact F, stiffness K── tissue
///
///     m v' = k (h − x) + c (h' − v) + F(x)         force on the hand = k (x − h) + c (v − h')
///
/// Reasons:
/// 1. The hand feels a spring of at most k, however stiff the tissue is. k can be what the device renders, and contact
///    can be as stiff as the simulation wants.
/// 2. The mass filters contact: a force that jumps from step to step moves the tool before it moves the hand.
///
/// The step is implicit Euler in spring, damper and contact, with F(x) = F − K (x − x0) at the start x0 of the step:
///
///     ((m / dt + c + dt k) I + dt K) v = (m / dt) v0 + k (h − x0) + c h' + F
///
/// Spring and damper are then stable for every mass, stiffness and step. Contact is stable as long as K is at least
/// half of what the tissue shows within a step. A formula of contact is often softer than that: Hertz's is, for a thin
/// organ or a coarse mesh. `feel` therefore raises K along the way of the tool to what the last step showed. It forgets
/// that only slowly, because a tool that bounces off would otherwise fall back into the same contact, for ever.
namespace tensormass::world {

struct Coupling {
  double mass_kg, stiffness_n_per_m, damping_n_s_per_m;
};

/// The tissue as the tool felt it at the end of the last step.
struct FeltContact {
  Vec3<double> position_m = Vec3<double>::Zero();  ///< the tool's
  Vec3<double> force_n = Vec3<double>::Zero();
  Mat3<double> stiffness_n_per_m = Mat3<double>::Zero();  ///< K
  Mat3<double> shown_n_per_m = Mat3<double>::Zero();      ///< the part of K that steps have shown
};

/// Share of `shown_n_per_m` that is left after a step.
inline constexpr double kShownKept = 0.8;

/// A step shows a stiffness only if the force changes by more than this share. Held still, tool and force change by
/// rounding alone, and their quotient says nothing.
inline constexpr double kLeastChange = 1e-5;

/// Returns the velocity of the tool at the end of a step [m/s].
/// hand_m, hand_m_per_s: place of the hand at the end of the step, and its velocity within it.
inline Vec3<double> coupled_velocity(const Coupling& coupling, const Vec3<double>& tool_m,
                                     const Vec3<double>& tool_m_per_s, const Vec3<double>& hand_m,
                                     const Vec3<double>& hand_m_per_s, const FeltContact& contact, double dt_s) {
  const auto& [m, k, c] = coupling;
  const Mat3<double> left = (m / dt_s + c + dt_s * k) * Mat3<double>::Identity() + dt_s * contact.stiffness_n_per_m;
  return left.ldlt().solve((m / dt_s) * tool_m_per_s + k * (hand_m - tool_m) + c * hand_m_per_s + contact.force_n);
}

/// Returns the stiffness of the coupling and the tissue behind it, which the hand feels in a slow press [N/m].
inline Mat3<double> in_series(double coupling_n_per_m, const Mat3<double>& tissue_n_per_m) {
  const Mat3<double> sum = coupling_n_per_m * Mat3<double>::Identity() + tissue_n_per_m;
  const Mat3<double> series = coupling_n_per_m * sum.ldlt().solve(tissue_n_per_m);
  return (series + series.transpose()) / 2;
}

/// Returns the contact at the end of a step. stiffness_n_per_m: what a formula says about it.
/// before: the contact a step ago. most_n_per_m: bound of what a step may show.
inline FeltContact feel(const FeltContact& before, const Vec3<double>& position_m, const Vec3<double>& force_n,
                        const Mat3<double>& stiffness_n_per_m, double most_n_per_m) {
  FeltContact now{position_m, force_n, stiffness_n_per_m, kShownKept * before.shown_n_per_m};
  const Vec3<double> way = position_m - before.position_m;
  const double way2 = way.squaredNorm();
  const Vec3<double> change_n = force_n - before.force_n;
  if (way2 > 0 && change_n.norm() > kLeastChange * force_n.norm()) {
    const double shown = std::min(-change_n.dot(way) / way2, most_n_per_m);
    const double known = way.dot((stiffness_n_per_m + now.shown_n_per_m) * way) / way2;
    if (shown > known) now.shown_n_per_m += (shown - known) / way2 * way * way.transpose();
  }
  now.stiffness_n_per_m += now.shown_n_per_m;
  return now;
}

}  // namespace tensormass::world
