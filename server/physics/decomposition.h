#pragma once

#include "core/scalar.h"

/// Eigenvalues and singular values of 3×3 matrices, without a branch: for numbers and packs, host and device.
namespace tensormass::physics {

/// No eigenvalue of the symmetric matrix is below (Gershgorin).
template <class T>
TM_HOST_DEVICE T gershgorin_lower_bound(const Mat3<T>& s) {
  const T xy = absolute(s(0, 1)), yz = absolute(s(1, 2)), zx = absolute(s(2, 0));
  return minimum(minimum(T(s(0, 0) - xy - zx), T(s(1, 1) - xy - yz)), T(s(2, 2) - yz - zx));
}

}  // namespace tensormass::physics
