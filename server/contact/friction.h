#pragma once

#include <cmath>

#include "view/scene.h"

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
/// 3. ξ is predicted with the velocities before the solve. N is that of the last step, or of the iterate if the scene
///    iterates. A prediction from the depth alone would be many times too large when a tool strikes tissue.
/// 4. After the solve the stretch is returned to the cone k |ξ| ≤ μ N (return mapping: Wriggers 2006, section 5.2). It
///    is kept in the frame of the tool's shape, and turns with the tool.
namespace tensormass::contact {

/// A contact of a triangle with a tool that has friction.
template <class Real>
struct FrictionPoint {
  const view::StateView<Real>& state;
  const std::uint32_t* rows;  // rows of the triangle's corners
  const view::TriangleContact<Real>& touch;

  TM_HOST_DEVICE Vec3<Real> normal() const { return {touch.normal[0], touch.normal[1], touch.normal[2]}; }
  TM_HOST_DEVICE Vec3<Real> tangential(const Vec3<Real>& v) const { return v - normal() * normal().dot(v); }
  /// Returns D, at the velocities as they are stored.
  TM_HOST_DEVICE Vec3<Real> tissue_motion() const {
    Vec3<Real> motion = Vec3<Real>::Zero();
    for (int c = 0; c < 3; ++c) motion += view::motion_in_step(state, rows[c]) * touch.weight[c];
    return motion;
  }
  /// Returns ξ if the spring's stretch is `ahead` while the tissue stands still.
  TM_HOST_DEVICE Vec3<Real> stretch(const view::TriangleFriction<Real>& friction) const {
    const Vec3<Real> ahead(friction.ahead_m[0], friction.ahead_m[1], friction.ahead_m[2]);
    return ahead - tangential(tissue_motion());
  }
};

/// Returns ξ₀ in the scene's frame, tangential to the contact.
template <class Real>
TM_HOST_DEVICE Vec3<Real> old_stretch(const FrictionPoint<Real>& at, const physics::PlacedTool<Real>& tool,
                                      const Real* slip) {
  return at.tangential(tool.to_scene(Vec3<Real>(slip[0], slip[1], slip[2])));
}

/// Predicts whether a contact sticks or slides in this step.
///
///   point    the contact's point of the tissue
///   predicted_n   N of the iterate; used only if the scene iterates
///   slip     the contact's entry of ContactView::slips
template <class Real>
TM_HOST_DEVICE view::TriangleFriction<Real> predict_friction(const FrictionPoint<Real>& at,
                                                             const physics::PlacedTool<Real>& tool,
                                                             const Vec3<Real>& point, Real predicted_n,
                                                             const Real* slip) {
  using std::sqrt;
  const Vec3<Real> ahead = old_stretch(at, tool, slip) + at.tangential(tool.motion_at(point));
  view::TriangleFriction<Real> out{{ahead[0], ahead[1], ahead[2]}, 0};
  const Vec3<Real> stretch = at.stretch(out);
  const Real most = tool.friction * (at.state.base_displacement == nullptr ? slip[3] : predicted_n);
  const Real spring = at.touch.stiffness * sqrt(stretch.dot(stretch));
  if (most > 0) out.stiffness = at.touch.stiffness * (spring > most ? most / spring : Real(1));
  return out;
}

/// Returns the stretch with which the next step starts, in the frame of the tool's shape.
///
///   stretch    ξ at the time for which the step solves
///   pressure   N there
template <class Real>
TM_HOST_DEVICE Vec3<Real> next_stretch(const FrictionPoint<Real>& at, const physics::PlacedTool<Real>& tool,
                                       const Vec3<Real>& stretch, Real pressure, const Real* slip) {
  using std::sqrt;
  const Real reach = at.state.control->scheme.reach;  // the midpoint rule solves for the middle of the step
  const Vec3<Real> end = stretch + (stretch - old_stretch(at, tool, slip)) * (reach - 1);
  const Real spring = at.touch.stiffness * sqrt(end.dot(end)), most = tool.friction * pressure;
  return tool.to_shape(spring > most ? Vec3<Real>(end * (most / spring)) : end);
}

}  // namespace tensormass::contact
