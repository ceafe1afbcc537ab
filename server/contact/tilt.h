#pragma once

#include <cmath>

#include "contact/surface.h"

/// How the force of a contact follows its triangle when that tilts.
///
///               c           c     point of the tool's core, taken as fixed
///               │ L         L     distance from c to the contact point [m]
///          _____↓n____      n     direction in which the tissue is pushed
///         a     p     b     p     contact point Σ w_a x_a, the point of the triangle that is closest to c
///                           s     contact force, stiffness · loaded_m [N]
///
/// A triangle that tilts under a tool carries the load with another of its points: p moves to the corner that comes
/// closer to c, which pushes that corner back. The energy of the contact, k/2 (radius − L)², therefore resists tilt:
///
///   k (n·y)² + s L |θ + T y / L|² − s |y_t|² / L
///
///   y     Σ w_a d_a, motion of the tissue at p, and y_t its part across n [m];  w_a, d_a: as in tools.h
///   θ     Σ g_a (n·d_a), tilt;  g_a: gradient of the barycentric coordinate of corner a [1/m]
///   T     projection on the directions in which p is free: the face, the edge that p is on, or none at a corner
///
/// 1. The first term is the stiffness along n (tools.h). The second one is this file's.
/// 2. The last term makes tissue slip off a tool. It is left out, so that the system stays positive definite. This
///    changes the way to an equilibrium, not the equilibrium.
/// 3. Without the second term a linearized step does not know how stiff the contact is, and steps over the equilibrium:
///    under a tool that holds still, surface nodes of soft tissue moved to and fro by a millimetre for ever.
/// 4. A rotation of the triangle about c changes nothing: θ = −T y / L. So these forces have no moment about c.
/// 5. On a flat tool p reaches a corner of the triangle after very little tilt, and then this stiffness ends. If L is
///    more than kMaxSizes times the triangle's size, the second term therefore falls with 1 / L. In full it would hold
///    every tilt that a triangle on a plane has, and tissue would creep to its equilibrium.
namespace tensormass::contact {

inline constexpr int kMaxSizes = 16;

template <class Real>
class Tilt {
 public:
  /// corners: where the contact was generated.
  TM_HOST_DEVICE Tilt(const Corners<Real>& corners, const view::TriangleContact<Real>& touch)
      : touch_(touch), normal_(touch.normal[0], touch.normal[1], touch.normal[2]), free_(Mat3<Real>::Zero()) {
    using std::sqrt;
    for (auto& gradient : gradient_) gradient = Vec3<Real>::Zero();
    if (!(touch.lever_m > 0)) return;
    inverse_lever_ = 1 / touch.lever_m;
    Vec3<Real> edges[3];  // opposite each corner, in the triangle's direction of rotation
    for (int c = 0; c < 3; ++c) edges[c] = corners.x[(c + 2) % 3] - corners.x[(c + 1) % 3];
    const Real* w = touch.weight;
    Real size = 0;
    if (w[0] > 0 && w[1] > 0 && w[2] > 0) {
      const Vec3<Real> area = corners.normal();
      const Real squared = area.dot(area);
      if (!(squared > 0)) return;
      size = sqrt(sqrt(squared));
      for (int c = 0; c < 3; ++c) gradient_[c] = physics::cross<Real>(area, edges[c]) / squared;
      free_ = Mat3<Real>::Identity() - normal_ * normal_.transpose();
    } else {
      for (int c = 0; c < 3; ++c) {
        const int a = (c + 1) % 3, b = (c + 2) % 3;
        const Real squared = edges[c].dot(edges[c]);
        if (!(w[a] > 0 && w[b] > 0 && squared > 0)) continue;
        size = sqrt(squared);
        gradient_[b] = edges[c] / squared;
        gradient_[a] = -gradient_[b];
        free_ = edges[c] * edges[c].transpose() / squared;
      }
    }
    const Real longest = kMaxSizes * size;
    stiffness_ =
        touch.stiffness * maximum(touch.loaded_m, Real(0)) * minimum(touch.lever_m, longest * longest * inverse_lever_);
  }

  /// Returns θ + T y / L for a motion of the corners.
  TM_HOST_DEVICE Vec3<Real> of(const Corners<Real>& motion) const {
    Vec3<Real> sum = Vec3<Real>::Zero();
    for (int c = 0; c < 3; ++c) sum += row(c) * motion.x[c];
    return sum;
  }
  /// Returns the force on a corner of the triangle, for a value of `of` [N].
  TM_HOST_DEVICE Vec3<Real> force(int corner, const Vec3<Real>& tilt) const {
    return row(corner).transpose() * tilt * -stiffness_;
  }
  /// Returns the sum of the forces on the three corners, for a value of `of` [N]. It acts at c.
  TM_HOST_DEVICE Vec3<Real> total_force(const Vec3<Real>& tilt) const {
    return free_ * tilt * (-stiffness_ * inverse_lever_);
  }
  /// Returns the stiffness against a value of `of` [N m].
  TM_HOST_DEVICE Real stiffness() const { return stiffness_; }
  /// Returns the stiffness between two corners [N/m]; all zero if p is at a corner, or c behind the surface.
  TM_HOST_DEVICE Mat3<Real> block(int a, int b) const { return row(a).transpose() * row(b) * stiffness_; }

 private:
  /// Returns the matrix that takes the motion of a corner to its part of θ + T y / L.
  TM_HOST_DEVICE Mat3<Real> row(int corner) const {
    return gradient_[corner] * normal_.transpose() + free_ * (touch_.weight[corner] * inverse_lever_);
  }

  const view::TriangleContact<Real>& touch_;
  Vec3<Real> normal_;
  Real inverse_lever_ = 0;
  Real stiffness_ = 0;  // the second term, without its square [N m]
  Vec3<Real> gradient_[3];
  Mat3<Real> free_;
};

}  // namespace tensormass::contact
