#pragma once

#include "view/scene.h"

/// The arithmetic of one tie (view/ties.h).
namespace tensormass::contact {

inline constexpr std::uint32_t kAllRows = 4;

/// Returns Σ weight · d of the rows of a tie, except one.
///
///   of_row(row) -> Vec3   d of a row
///   except                0 to 3: leaves out that row; kAllRows: none
template <class Real, class OfRow>
TM_HOST_DEVICE Vec3<Real> relative(const view::Tie<Real>& tie, std::uint32_t except, const OfRow& of_row) {
  Vec3<Real> sum = Vec3<Real>::Zero();
  for (std::uint32_t r = 0; r < 4; ++r) {
    if (r != except && tie.weight[r] != 0) sum += of_row(tie.rows[r]) * tie.weight[r];
  }
  return sum;
}

/// Returns S [N/m].
template <class Real>
TM_HOST_DEVICE Mat3<Real> stiffness_of(const view::Tie<Real>& tie) {
  const Vec3<Real> n(tie.normal[0], tie.normal[1], tie.normal[2]);
  return Mat3<Real>::Identity() * tie.across + n * n.transpose() * (tie.stiffness - tie.across);
}

/// Returns S v.
template <class Real>
TM_HOST_DEVICE Vec3<Real> stiffness_times(const view::Tie<Real>& tie, const Vec3<Real>& v) {
  const Vec3<Real> n(tie.normal[0], tie.normal[1], tie.normal[2]);
  return v * tie.across + n * ((tie.stiffness - tie.across) * n.dot(v));
}

/// Returns the force on the node of a tie after a motion of its rows [N].
///
///   of_row(row) -> Vec3   motion of a row since the tie was made
template <class Real, class OfRow>
TM_HOST_DEVICE Vec3<Real> force_after(const view::Tie<Real>& tie, const OfRow& of_row) {
  const Vec3<Real> force(tie.force[0], tie.force[1], tie.force[2]);
  return force - stiffness_times(tie, relative(tie, kAllRows, of_row));
}

}  // namespace tensormass::contact
