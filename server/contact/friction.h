#pragma once

#include <cmath>

#include "contact/surface.h"

/// Coulomb friction between tools and tissue: a spring at each contact that yields.
///
///        tool     ─────●───→ g         n     normal of the contact
///                      ╱╱ ξ            ξ     stretch of the spring, from the tissue to the tool, tangential [m]
///        tissue   ──●──→ D             k     stiffness of the contact (tools.h), tangential as well as normal [N/m]
///                                      N     normal force [N];  μ: the tool's coefficient
///
///   ξ = ξ₀ + P (g − D)      P = I − n nᵀ; ξ₀: at the start of the step; g, D: motion of tool and tissue in the step
///   t = k ξ if k |ξ| ≤ μ N, else μ N ξ / |ξ|      force on the tissue
///
/// 1. A spring holds without creep. A force that only depends on the sliding velocity, as in many engines, does not: a
///    held organ would sink out of the jaws.
/// 2. The force enters the step's linear system with a secant stiffness: t = k_s ξ with k_s = min(k, μ N / |ξ|), for ξ
///    and N predicted before the solve. The system stays symmetric and positive definite. Where it slides, the force is
///    then exact only if the prediction is; in steady sliding it is.
/// 3. ξ is predicted with the velocities before the solve. In a step that is linearized once, N is that of the last
///    step: predicted, it would be many times too large when a tool strikes tissue. Newton's method predicts N, too.
///    Its iterations correct it, and they measure the force at the end of the step.
/// 4. After the solve the stretch is returned to the cone k |ξ| ≤ μ N (return mapping: Wriggers 2006, section 5.2). It
///    is kept in the frame of the tool's shape, and turns with the tool, though not with a joint.
namespace tensormass::contact {

/// Part of the secant along the slip that Newton's method leaves out of the matrix. Friction at Coulomb's limit does
/// not grow along the slip; the rest keeps a body that only friction holds from a singular system.
inline constexpr double kIteratedSlip = 0.95;

/// Returns the factor that takes a spring's force to Coulomb's limit: 1 where it sticks, most / (k |ξ|) where it
/// slides. most: μ N [N].
template <class Real>
TM_HOST_DEVICE Real yield_factor(Real stiffness, const Vec3<Real>& stretch, Real most) {
  using std::sqrt;
  const Real spring = stiffness * sqrt(stretch.dot(stretch));
  return spring > most ? most / spring : Real(1);
}

/// Returns ξ at the velocities as they are stored.
template <class Real>
TM_HOST_DEVICE Vec3<Real> stretch_of(const ContactPoint<Real>& at, const view::TriangleFriction<Real>& friction) {
  const Vec3<Real> ahead(friction.ahead_m[0], friction.ahead_m[1], friction.ahead_m[2]);
  return ahead - at.tangential(at.motion_in_step());
}

/// Returns ξ₀ in the scene's frame, tangential to the contact.
template <class Real>
TM_HOST_DEVICE Vec3<Real> old_stretch(const ContactPoint<Real>& at, const physics::PlacedTool<Real>& tool,
                                      const Real* slip) {
  return at.tangential(tool.to_scene(Vec3<Real>(slip[0], slip[1], slip[2])));
}

/// Predicts whether a contact sticks or slides in this step.
///
///   tool_motion   motion of the tool's point that touches the tissue, in this step [m]
///   predicted_n   N at the velocities as they are stored; only Newton's method takes it
///   slip          the contact's entry of ContactView::slips
template <class Real>
TM_HOST_DEVICE view::TriangleFriction<Real> predict_friction(const ContactPoint<Real>& at,
                                                             const physics::PlacedTool<Real>& tool,
                                                             const Vec3<Real>& tool_motion, Real predicted_n,
                                                             const Real* slip) {
  const Vec3<Real> ahead = old_stretch(at, tool, slip) + at.tangential(tool_motion);
  view::TriangleFriction<Real> out{{ahead[0], ahead[1], ahead[2]}, 0};
  const Vec3<Real> stretch = stretch_of(at, out);
  const Real most = tool.friction * (at.state.iterates == 0 ? slip[3] : predicted_n);
  if (most > 0) out.stiffness = at.touch.stiffness * yield_factor(at.touch.stiffness, stretch, most);
  return out;
}

/// Stores the stretch and the normal force with which the next step starts. Saves those of this step if it makes the
/// checkpoint.
///
///   stretch    ξ at the end of the step
///   pressure   N there; zero: the contact has ended, and its stretch is forgotten
///   place      index of the contact
template <class Real>
TM_HOST_DEVICE void end_contact(const ContactPoint<Real>& at, const view::ContactView<Real>& contact,
                                const physics::PlacedTool<Real>& tool, const Vec3<Real>& stretch, Real pressure,
                                std::size_t place) {
  Real* slip = contact.slips + 4 * place;
  if (at.state.control->saves_checkpoint != 0) {
    for (std::size_t c = 0; c < 4; ++c) contact.checkpoint_slips[4 * place + c] = slip[c];
  }
  Vec3<Real> next = Vec3<Real>::Zero();  // in the frame of the tool's shape
  if (pressure > 0) {
    next = tool.to_shape(stretch * yield_factor(at.touch.stiffness, stretch, tool.friction * pressure));
  }
  for (int c = 0; c < 3; ++c) slip[c] = next[c];
  slip[3] = pressure;
}

}  // namespace tensormass::contact
