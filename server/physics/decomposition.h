#pragma once

#include "core/scalar.h"

/// Eigenvalues and singular values of 3×3 matrices.
///
/// Why our own: these run for every quadrature point in every step, for numbers and for packs, on host and device. A
/// pack's lanes and a warp's threads hold different matrices, so the code has no branch on values and a fixed number of
/// sweeps. Library routines iterate until convergence.
///
/// Both use Jacobi's method. It builds U and V from rotations, so they are orthogonal for any input, also for a
/// singular F.
///
///   F ──three plane rotations a sweep, kSweeps times──► B = F V, orthogonal columns
///     ──order columns by length──► |b_0| ≥ |b_1| ≥ |b_2|
///     ──complete to a rotation──► U, and σ = (|b_0|, |b_1|, u_2·b_2)
///
///   F         deformation gradient, no unit
///   U, V      rotations, det = +1
///   σ         principal stretches, σ0 ≥ σ1 ≥ |σ2|; σ2 has the sign of det F
///   B         F V; its columns b_i end as σ_i u_i
///   I, J      the two columns that a plane rotation mixes
///
/// Range: the entries of a deformation gradient are of order one. Values below 1e-9 may be treated as zero; values
/// above 1e9 overflow in float.
namespace tensormass::physics {

/// Returns a lower bound of the eigenvalues of a symmetric matrix (Gershgorin). It is the smallest, over rows, of the
/// diagonal entry minus the absolute values of the other entries.
template <class T>
TM_HOST_DEVICE T gershgorin_lower_bound(const Mat3<T>& s) {
  const T xy = absolute(s(0, 1)), yz = absolute(s(1, 2)), zx = absolute(s(2, 0));
  return minimum(minimum(T(s(0, 0) - xy - zx), T(s(1, 1) - xy - yz)), T(s(2, 2) - yz - zx));
}

namespace detail {

/// Number of cyclic sweeps after which the off-diagonal entries are at rounding level, in double too. Found by trying
/// random, nearly singular, nearly equal and integer matrices (tests/physics/decomposition_test.cpp). Convergence is
/// quadratic.
inline constexpr int kSweeps = 4;
/// Divisors are clamped to at least this value. Its square is still a float.
inline constexpr double kTiny = 1e-18;

template <class T>
struct PlaneRotation {
  T cosine, sine;
};

/// Returns the rotation by at most 45° that diagonalizes the symmetric [α γ; γ β]. It is exactly the identity if γ is
/// zero.
template <class T>
TM_HOST_DEVICE PlaneRotation<T> diagonalizing(T alpha, T beta, T gamma) {
  const T difference = alpha - beta, twice = gamma + gamma;
  const T length = square_root(T(difference * difference + twice * twice));
  // (x, y) points along half the angle of (difference, twice), mirrored to the right half of the plane.
  const T x = maximum(T(absolute(difference) + length), T(kTiny));
  const T y = select_greater(T(0), difference, T(-twice), twice);
  const T norm = square_root(T(x * x + y * y));
  return {x / norm, y / norm};
}

/// Replaces columns I and J of m by c m_I + s m_J and c m_J − s m_I. The indices are template parameters, so that
/// matrices stay in registers.
template <int I, int J, class T>
TM_HOST_DEVICE void rotate_columns(Mat3<T>& m, const PlaneRotation<T>& r) {
  for (int row = 0; row < 3; ++row) {
    const T x = m(row, I), y = m(row, J);
    m(row, I) = r.cosine * x + r.sine * y;
    m(row, J) = r.cosine * y - r.sine * x;
  }
}

/// Makes columns I and J of B orthogonal by a rotation, and applies the same rotation to V.
template <int I, int J, class T>
TM_HOST_DEVICE void orthogonalize_columns(Mat3<T>& b, Mat3<T>& v) {
  const PlaneRotation<T> r =
      diagonalizing(T(b.col(I).squaredNorm()), T(b.col(J).squaredNorm()), T(b.col(I).dot(b.col(J))));
  rotate_columns<I, J>(b, r);
  rotate_columns<I, J>(v, r);
}

/// Makes entry IJ of the symmetric A zero by a rotation, and applies the same rotation to V.
template <int I, int J, class T>
TM_HOST_DEVICE void diagonalize_plane(Mat3<T>& a, Mat3<T>& v) {
  constexpr int kOther = 3 - I - J;
  const PlaneRotation<T> r = diagonalizing(T(a(I, I)), T(a(J, J)), T(a(I, J)));
  const T cc = r.cosine * r.cosine, ss = r.sine * r.sine, mixed = T(2) * r.cosine * r.sine * a(I, J);
  const T i = a(I, I), j = a(J, J), x = a(I, kOther), y = a(J, kOther);
  a(I, I) = cc * i + mixed + ss * j;
  a(J, J) = ss * i - mixed + cc * j;
  a(I, J) = a(J, I) = T(0);
  a(I, kOther) = a(kOther, I) = r.cosine * x + r.sine * y;
  a(J, kOther) = a(kOther, J) = r.cosine * y - r.sine * x;
  rotate_columns<I, J>(v, r);
}

/// If key_I < key_J, exchanges them and rotates columns I and J of both matrices by 90°. That exchanges the columns,
/// one with its sign changed, and keeps the determinants.
template <int I, int J, class T>
TM_HOST_DEVICE void order_columns(Mat3<T>& b, Mat3<T>& v, Vec3<T>& key) {
  const T ki = key[I], kj = key[J];
  const T turn = select_greater(kj, ki, T(1), T(0));
  const PlaneRotation<T> r{T(1) - turn, turn};
  rotate_columns<I, J>(b, r);
  rotate_columns<I, J>(v, r);
  key[I] = maximum(ki, kj);
  key[J] = minimum(ki, kj);
}

}  // namespace detail

/// The decomposition F = U diag(σ) Vᵀ.
template <class T>
struct SignedSingularValues {
  Mat3<T> u, v;  // rotations: det = +1
  Vec3<T> sigma;

  TM_HOST_DEVICE Mat3<T> product() const { return u * sigma.asDiagonal() * v.transpose(); }
};

/// Decomposes F into rotations U, V and principal stretches σ0 ≥ σ1 ≥ |σ2|.
///
/// σ2 has the sign of det F: an element counts as inverted along its smallest stretch (Irving, Teran, Fedkiw 2004). U
/// is not unique if F is singular; any valid one is returned.
template <class T>
TM_HOST_DEVICE SignedSingularValues<T> signed_singular_values(const Mat3<T>& f) {
  SignedSingularValues<T> out;
  // One-sided Jacobi (Hestenes 1958) rotates the columns of F until they are orthogonal: B = F V. It never forms FᵀF,
  // which would lose half of the digits of a small σ.
  Mat3<T> b = f;
  out.v = Mat3<T>::Identity();
  for (int sweep = 0; sweep < detail::kSweeps; ++sweep) {
    detail::orthogonalize_columns<0, 1>(b, out.v);
    detail::orthogonalize_columns<0, 2>(b, out.v);
    detail::orthogonalize_columns<1, 2>(b, out.v);
  }
  Vec3<T> key(b.col(0).squaredNorm(), b.col(1).squaredNorm(), b.col(2).squaredNorm());
  detail::order_columns<0, 1>(b, out.v, key);
  detail::order_columns<0, 2>(b, out.v, key);
  detail::order_columns<1, 2>(b, out.v, key);

  // Columns of U, from those of B with the largest first; orthogonal even where a column of B is zero. u_0 is the
  // direction of b_0, or x if b_0 is zero.
  const T tiny = T(detail::kTiny * 1e3);
  const T first = square_root(key[0]);
  const Vec3<T> x = b.col(0) / maximum(first, tiny);
  const Vec3<T> u(select_greater(first, tiny, x[0], T(1)), select_greater(first, tiny, x[1], T(0)),
                  select_greater(first, tiny, x[2], T(0)));
  // s and t complete u_0 to a basis (Duff et al. 2017).
  const T sign = select_greater(T(0), u[2], T(-1), T(1));
  const T q = T(-1) / (sign + u[2]), xy = u[0] * u[1] * q;
  const Vec3<T> s(T(1) + sign * u[0] * u[0] * q, sign * xy, -sign * u[0]);
  const Vec3<T> t(xy, sign + u[1] * u[1] * q, -u[1]);
  // Rotates s and t about u_0 so that the first of them points along b_1.
  const T along_s = s.dot(b.col(1)), along_t = t.dot(b.col(1));
  const T second = square_root(T(along_s * along_s + along_t * along_t));
  const T cosine = select_greater(second, tiny, T(along_s / maximum(second, tiny)), T(1));
  const T sine = select_greater(second, tiny, T(along_t / maximum(second, tiny)), T(0));
  out.u.col(0) = u;
  out.u.col(1) = s * cosine + t * sine;
  out.u.col(2) = t * cosine - s * sine;
  out.sigma = Vec3<T>(first, second, out.u.col(2).dot(b.col(2)));
  return out;
}

/// Returns whether a symmetric matrix is positive definite by more than rounding errors, in every lane of a pack.
///
/// e1, e2, e3 are the sums of its principal minors of order 1, 2, 3. All eigenvalues are positive if and only if these
/// three are. The smallest is at least e3 / e2, and e2 ≤ e1² / 3. Here e1 = 1, so it is above 3 kMargin, far above what
/// eigenvalues lose to rounding.
template <class T>
TM_HOST_DEVICE bool is_positive_definite(const Mat3<T>& symmetric) {
  constexpr double kMargin = 4e-6;  // for float
  const T trace = symmetric.trace();
  const Mat3<T> s = symmetric * (T(1) / trace);
  const T x = s(1, 2), y = s(2, 0), z = s(0, 1);
  const T xx = s(1, 1) * s(2, 2) - x * x, yy = s(0, 0) * s(2, 2) - y * y, zz = s(0, 0) * s(1, 1) - z * z;
  const T e3 = s(0, 0) * xx + z * (x * y - z * s(2, 2)) + y * (z * x - s(1, 1) * y);
  return all_greater(trace, T(0)) && all_greater(T(xx + yy + zz), T(kMargin)) && all_greater(e3, T(kMargin));
}

/// Returns the symmetric matrix with its eigenvalues replaced by their absolute values. The result equals the input
/// bitwise if none is negative; rotations are left out where that is certain.
template <class T>
TM_HOST_DEVICE Mat3<T> with_absolute_eigenvalues(const Mat3<T>& symmetric) {
  if (is_positive_definite(symmetric)) return symmetric;
  Mat3<T> a = symmetric, v = Mat3<T>::Identity();
  for (int sweep = 0; sweep < detail::kSweeps; ++sweep) {
    detail::diagonalize_plane<0, 1>(a, v);
    detail::diagonalize_plane<0, 2>(a, v);
    detail::diagonalize_plane<1, 2>(a, v);
  }
  Mat3<T> result = symmetric;
  for (int i = 0; i < 3; ++i) result += v.col(i) * (v.col(i) * maximum(T(-a(i, i) - a(i, i)), T(0))).transpose();
  return result;
}

}  // namespace tensormass::physics
