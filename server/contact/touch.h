#pragma once

#include <cmath>

#include "contact/surface.h"

/// How a tool touches a triangle, what that contact remembers, and whether it acts across a gap.
///
/// Tools stand where they will be at the end of the step, and tissue where it is at the start. So a tool that moves
/// away from tissue that follows it leaves a gap g, and so does one jaw of a grasper that carries a piece along.
/// Without its contact the tissue would fall freely, or recoil, for a step, and be thrown back in the next. A contact
/// that pressed when the last step ended therefore acts if the gap closes within the step:
///
///   g < n·Σ w_a d_a + N / (m / h² + E s)
///
///   d_a   motion of corner a by its present velocity, gravity and loads
///   N     normal force at the end of the last step. Without it the point would go further than by d_a: the second term
///         is a lower bound of that, because only the mass m and the element behind the triangle (E s) resist.
///   h     the step
///
/// Newton's method decides contacts again in each of its iterations, where N is not what holds the point back. Across a
/// gap, the line of a contact (line.h) and its load in tilt (tilt.h) are those of the depth at which it pressed.
namespace tensormass::contact {

/// The widest gap across which a thin tool touches by a penalty, in radii. A fast tool that leaves a wider one behind
/// may have gone through the tissue.
inline constexpr double kWidestGap = 0.25;
/// Cosine of the angle between the direction in which a thin tool pushes and the outward normal from which a triangle
/// is turned away. Across a gap the tool has gone through such a triangle.
inline constexpr double kTurnedAway = 0.5;

/// A point of a triangle that touches a tool.
template <class Real>
struct Touch {
  Real depth_m = 0;     // not positive: it does not touch, or acts across a gap that closes in the step
  Real lever_m = 0;     // view::TriangleContact::lever_m
  Real share = 1;       // part of the triangle's area that it carries
  Real line_share = 0;  // view::TriangleContact::line_stiffness, as a part of that of the whole triangle
  Vec3<Real> line = Vec3<Real>::Zero();  // view::TriangleContact::line
  Vec3<Real> weights = Vec3<Real>::Zero();
  Vec3<Real> normal = Vec3<Real>::Zero();
};

/// What a contact remembers of the end of the last step.
template <class Real>
struct Remembered {
  Real pressed_n = 0;  // normal force; zero if nothing depends on it
  Real loaded_m = 0;   // depth at which a contact of all of the triangle has that force
  Real depth_m = 0;    // by which the contact counts as deeper than it is, because it keeps that force
};

/// Returns k of a contact that carries all of its triangle [N/m].
template <class Real>
TM_HOST_DEVICE Real whole_stiffness(const view::ContactView<Real>& contact, const physics::PlacedTool<Real>& tool,
                                    std::uint32_t triangle) {
  const Real per_m = tool.penalty_per_m * contact.triangle_moduli[std::size_t{2} * triangle];
  return (tool.penalty_pa_per_m + per_m) * contact.triangle_area[triangle];
}

/// Returns what a contact remembers, with λ / k for a contact that carries all of its triangle.
template <class Real>
TM_HOST_DEVICE Remembered<Real> remembered(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                           const physics::PlacedTool<Real>& tool, std::uint32_t point,
                                           std::uint32_t triangle) {
  Remembered<Real> out;
  const bool keeps_force = tool.keeps_force != 0;
  if (tool.remembers == 0 || (state.iterates != 0 && !keeps_force)) return out;
  out.pressed_n = tool.presence * contact.slips[4 * contact_place(contact, tool, point, triangle) + 3];
  if (!(out.pressed_n > 0)) return out;
  const Real stiffness = whole_stiffness(contact, tool, triangle);
  if (stiffness > 0) out.loaded_m = out.pressed_n / stiffness;
  if (keeps_force) out.depth_m = out.loaded_m;
  return out;
}

/// Returns how the corners of a triangle move to the end of the step if nothing touches them: by the present
/// velocities, gravity and loads [m].
template <class Real>
TM_HOST_DEVICE Corners<Real> motion_ahead(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                          std::uint32_t triangle) {
  const Real h = view::step_size(state);
  return at_corners<Real>(contact, triangle, [&](std::uint32_t row) {
    Vec3<Real> motion = view::change_ahead_to_end(state, row);
    const Real mass = state.inertia[std::size_t{4} * row];
    if (state.external != nullptr && mass > 0) motion += view::load3<Real>(state.external, row) * (h * h / mass);
    return motion;
  });
}

/// Returns the stiffness at which a spring and the mass of a contact point have a period of about six steps [N/m].
template <class Real>
TM_HOST_DEVICE Real inertial_stiffness(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                       std::uint32_t triangle, const Vec3<Real>& weights) {
  const Real h = view::step_size(state);
  Real mass = 0;
  const TriangleRows<Real> of(contact, triangle);
  for (std::uint32_t k = 0; k < of.count(); ++k) {
    mass += state.inertia[std::size_t{4} * of.rows[k]] * of.share(k, weights);
  }
  return mass / (h * h);
}

/// Returns a measure of the stiffness of the element behind a triangle: E times half the leg of a right triangle of
/// this size [N/m].
template <class Real>
TM_HOST_DEVICE Real element_stiffness(const view::ContactView<Real>& contact, std::uint32_t triangle) {
  using std::sqrt;
  return contact.triangle_moduli[std::size_t{2} * triangle] * sqrt(contact.triangle_area[triangle] / 2);
}

/// Returns whether a contact with a gap closes within the step.
/// pressed_n: N
template <class Real>
TM_HOST_DEVICE bool closes(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                           std::uint32_t triangle, const Touch<Real>& touch, Real pressed_n) {
  if (!(touch.share > 0) || touch.normal.dot(touch.normal) == 0) return false;
  Real back = 0;
  if (pressed_n > 0 && state.iterates == 0) {
    const Real inertial = inertial_stiffness(state, contact, triangle, touch.weights);
    back = pressed_n / (inertial + element_stiffness(contact, triangle));
  }
  return touch.depth_m + back > touch.normal.dot(motion_ahead(state, contact, triangle).at(touch.weights));
}

}  // namespace tensormass::contact
