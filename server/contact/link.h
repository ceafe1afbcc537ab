#pragma once

#include "view/scene.h"

/// The arithmetic of one link (view/links.h).
namespace tensormass::contact {

inline constexpr std::uint32_t kAllRows = 4;

/// Returns Σ weight · d of the rows of a link, except one.
///
///   of_row(row) -> Vec3   d of a row
///   except                0 to 3: leaves out that row; kAllRows: none
template <class Real, class OfRow>
TM_HOST_DEVICE Vec3<Real> relative(const view::Link<Real>& link, std::uint32_t except, const OfRow& of_row) {
  Vec3<Real> sum = Vec3<Real>::Zero();
  for (std::uint32_t r = 0; r < 4; ++r) {
    if (r != except && link.weight[r] != 0) sum += of_row(link.rows[r]) * link.weight[r];
  }
  return sum;
}

/// Returns S [N/m].
template <class Real>
TM_HOST_DEVICE Mat3<Real> stiffness_of(const view::Link<Real>& link) {
  const Vec3<Real> n(link.normal[0], link.normal[1], link.normal[2]);
  return Mat3<Real>::Identity() * link.across + n * n.transpose() * (link.stiffness - link.across);
}

/// Returns S v.
template <class Real>
TM_HOST_DEVICE Vec3<Real> stiffness_times(const view::Link<Real>& link, const Vec3<Real>& v) {
  const Vec3<Real> n(link.normal[0], link.normal[1], link.normal[2]);
  return v * link.across + n * ((link.stiffness - link.across) * n.dot(v));
}

/// Returns the force on the node of a link after a motion of its rows [N].
///
///   of_row(row) -> Vec3   motion of a row since the link was made
template <class Real, class OfRow>
TM_HOST_DEVICE Vec3<Real> force_after(const view::Link<Real>& link, const OfRow& of_row) {
  const Vec3<Real> force(link.force[0], link.force[1], link.force[2]);
  return force - stiffness_times(link, relative(link, kAllRows, of_row));
}

}  // namespace tensormass::contact
