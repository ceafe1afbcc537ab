#pragma once

#include <Eigen/Geometry>

#include "core/scalar.h"

/// Isotropic laws W(I1, J), evaluated from F itself.
///
/// Why: stress and stiffness of such a law are polynomials in F, and a decomposition of F costs more than all of them.
/// The projection to positive semi-definite changes three scalars and needs no eigenvectors.
///
///   F ──cofactor, determinant──► I1, J ──Derived::in_invariants──► W_1, W_J, W_11, W_JJ ──► stress, stiffness
///
/// Symbols:
///
///   I1, I2, J   |F|², |cof F|², det F
///   cof F       cofactor matrix, J F⁻ᵀ
///   W_1, W_J    ∂W/∂I1, ∂W/∂J [Pa], and so on for second derivatives; W_1J is zero
///   a, b        shape gradients of two nodes
///   σ_i, c_i    principal stretches and singular values of cof F: c_i = J / σ_i
///   w, q, β     2 W_1, W_J, and W_JJ + W_J / J [Pa]
///
/// Formulas (Bonet, Gil, Ortigosa 2015 give the derivatives by F; cof F and J are its only other arguments):
///
///   P    = w F + q cof F
///   K_ab = w (a·b) I + 4 W_11 (F a)(F b)ᵀ + W_JJ (cof F a)(cof F b)ᵀ + q [F (a × b)]×ᵀ
///
/// **The projection.** For J > 0 the last term is q / J ((cof F a)(cof F b)ᵀ − (cof F b)(cof F a)ᵀ). In the axes of the
/// stretches (stretch_law.h) the nine eigenvalues are therefore, with planes numbered by their normal k,
///
///   rotation in plane k      w + q σ_k
///   distortion in plane k    w − q σ_k
///   of the 3 × 3 matrix      A + β c cᵀ + 4 W_11 σ σᵀ,   A = diag(w − q J / σ_i²)
///
/// W_11 and w are not negative. So K is positive semi-definite if
///
///   (1)  w ≥ |q| s.  s is the largest σ if q < 0, and J / (the smallest σ)², which is larger, if q > 0
///   (2)  β ≥ β*, the value at which the 3 × 3 matrix is singular: a quotient of polynomials in I1, I2 and J² (Sherman,
///        Morrison 1950)
///
/// If (1) fails, w grows and |q| shrinks in the ratio s. Near rest that moves rotations alone (q < 0), or changes of
/// shape alone (q > 0). If (2) fails, β grows. Both end as far above the bound as they were below, so that what was
/// most negative gets its absolute value (law.h). Bound (1) is sharp if q < 0, which only strong expansion ends. s
/// needs a root of the characteristic polynomial of FᵀF; a Newton step that comes from above gives one that is never
/// too small.
///
/// β is not finite where an element is flat or inverted. There w grows above |q| 2 √(I1 / 3), the largest absolute
/// eigenvalue of ∂²J/∂F² (Smith, de Goes, Kim 2019), and W_JJ is clamped at zero.
namespace tensormass::physics {

/// Derivatives of W at a point [Pa].
template <class T>
struct InvariantSlopes {
  T w1, wj;    // W_1, W_J
  T w11, wjj;  // W_11 ≥ 0, W_JJ
};

/// Base of a law that is given by its InvariantSlopes, with two parameters. The law provides
///
///   template <class T> static InvariantSlopes<T> in_invariants(const T& i1, const T& j, const T* parameters);
///   template <class T> static T energy_of(const T& i1, const T& j, const T* parameters);
template <class Derived>
struct InvariantLaw {
  static constexpr bool kConstantStiffness = false;

  /// The coefficients of K that the projection changes [Pa].
  template <class T>
  struct Coefficients {
    T w, q, wjj;
  };

  template <class T>
  struct Point {
    Mat3<T> deformation_gradient, cofactor;
    T i1, j;
    T w, q;  // 2 W_1 and W_J, for the stress
    T four_w11;
    Coefficients<T> stiffness;
    T parameters[2];
  };

  template <class T>
  TM_HOST_DEVICE static Point<T> at(const Mat3<T>& deformation_gradient, const T* parameters) {
    Point<T> p;
    const Mat3<T>& f = p.deformation_gradient = deformation_gradient;
    for (int c = 0; c < 3; ++c) p.cofactor.col(c) = f.col((c + 1) % 3).cross(f.col((c + 2) % 3));
    p.j = f.col(0).dot(p.cofactor.col(0));
    p.i1 = f.squaredNorm();
    for (int c = 0; c < 2; ++c) p.parameters[c] = parameters[c];
    const InvariantSlopes<T> slopes = Derived::in_invariants(p.i1, p.j, parameters);
    p.w = slopes.w1 + slopes.w1;
    p.q = slopes.wj;
    p.four_w11 = T(4) * slopes.w11;
    p.stiffness = {p.w, p.q, slopes.wjj};
    return p;
  }

  template <class T>
  TM_HOST_DEVICE static T energy(const Point<T>& p) {
    return Derived::energy_of(p.i1, p.j, p.parameters);
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> stress(const Point<T>& p) {
    return p.deformation_gradient * p.w + p.cofactor * p.q;
  }

  /// Returns S = w I + q (cof F)ᵀ cof F / J. Where the smallest |σ| is below kFlat, the second part is scaled down to
  /// zero with it, for the reason in StretchLaw::second_piola.
  template <class T>
  TM_HOST_DEVICE static Mat3<T> second_piola(const Point<T>& p) {
    // I2 ≤ 3 σ0² σ1², so J² is above this where |σ2| is above kFlat.
    const T least = maximum(T(p.cofactor.squaredNorm() * T(kFlat * kFlat / 3)), T(kTiny));
    Mat3<T> s = p.cofactor.transpose() * p.cofactor * (p.q * p.j / maximum(T(p.j * p.j), least));
    s.diagonal().array() += p.w;
    return s;
  }

  template <class T>
  struct Node {
    Vec3<T> gradient, moved, area;            // a, F a, cof F a
    Vec3<T> by_w, moved_by_w11, area_by_wjj;  // those times their coefficients of K
    Mat3<T> turn;                             // q F [a]×
  };

  template <class T>
  TM_HOST_DEVICE static Node<T> at_node(const Point<T>& p, const Vec3<T>& gradient) {
    Node<T> node = weighted<T>(p, gradient, p.deformation_gradient * gradient, p.cofactor * gradient);
    const Vec3<T> scaled = gradient * p.stiffness.q;
    for (int c = 0; c < 3; ++c) {
      const int i = (c + 1) % 3, j = (c + 2) % 3;
      node.turn.col(c) = p.deformation_gradient.col(j) * scaled[i] * T(-1) + p.deformation_gradient.col(i) * scaled[j];
    }
    return node;
  }

  template <class T>
  TM_HOST_DEVICE static Node<T> at_axis(const Point<T>& p, int axis) {
    const Mat3<T>& f = p.deformation_gradient;
    const int i = (axis + 1) % 3, j = (axis + 2) % 3;
    Node<T> node = weighted<T>(p, Vec3<T>::Unit(axis), f.col(axis), p.cofactor.col(axis));
    node.turn.col(axis).setZero();
    node.turn.col(i) = f.col(j) * p.stiffness.q;
    node.turn.col(j) = f.col(i) * T(-p.stiffness.q);
    return node;
  }

  /// Returns P a from P. The two terms cancel in P for all nodes alike; with w F a + q cof F a, rounding errors of the
  /// modulus would not add up to zero over the nodes.
  template <class T>
  TM_HOST_DEVICE static Vec3<T> traction(const Point<T>& p, const Node<T>& a) {
    return stress(p) * a.gradient;
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const Point<T>&, const Node<T>& a, const Node<T>& b) {
    Mat3<T> k = a.area_by_wjj * b.area.transpose();
    k += a.moved_by_w11 * b.moved.transpose();
    k.diagonal().array() += a.by_w.dot(b.gradient);
    const Vec3<T> x = a.turn * b.gradient;
    for (int c = 0; c < 3; ++c) {
      const int i = (c + 1) % 3, j = (c + 2) % 3;
      k(i, j) += x[c];
      k(j, i) -= x[c];
    }
    return k;
  }

  template <class T>
  TM_HOST_DEVICE static void project_to_psd(Point<T>& p) {
    const Coefficients<T> round = of_a_round_element(p), flat = of_a_flat_element(p);
    // Positive where the element is neither flat nor inverted. J² is I1 I2 / 9 at rest.
    const T roundness =
        minimum(T(p.j - T(kMinVolume)), T(p.j * p.j - p.i1 * p.cofactor.squaredNorm() * T(kMinRoundness / 9)));
    p.stiffness.w = select_greater(roundness, T(0), round.w, flat.w);
    p.stiffness.q = select_greater(roundness, T(0), round.q, flat.q);
    p.stiffness.wjj = select_greater(roundness, T(0), round.wjj, flat.wjj);
  }

 private:
  static constexpr double kFlat = 0.05;  // a principal stretch
  // Bounds of J and of 9 J² / (I1 I2), below which an element counts as flat: a stretch of 0.09 between two of one.
  static constexpr double kMinVolume = 1e-3, kMinRoundness = 0.02;
  static constexpr double kTiny = 1e-30;  // a divisor; a float

  template <class T>
  TM_HOST_DEVICE static Node<T> weighted(const Point<T>& p, const Vec3<T>& gradient, const Vec3<T>& moved,
                                         const Vec3<T>& area) {
    return {gradient, moved, area, gradient * p.stiffness.w, moved * p.four_w11, area * p.stiffness.wjj, {}};
  }

  /// Returns a bound of the largest eigenvalue of FᵀF from above (side 1), or of the smallest from below (side −1).
  template <class T>
  TM_HOST_DEVICE static T extreme_square(const Mat3<T>& f, T side) {
    // Eigenvalues are 1 + mean + root y with y³ − 3 y = 2 r; r is in [−1, 1], and the largest y in [1, 2]. Subtracting
    // the identity first keeps the digits of small strains.
    Vec3<T> diagonal, other;
    for (int c = 0; c < 3; ++c) {
      diagonal[c] = f.col(c).squaredNorm() - T(1);
      other[c] = f.col((c + 1) % 3).dot(f.col((c + 2) % 3));
    }
    const T mean = diagonal.sum() * T(1.0 / 3);
    const T x = diagonal[0] - mean, y = diagonal[1] - mean, z = diagonal[2] - mean;
    const T square = (x * x + y * y + z * z + T(2) * other.squaredNorm()) * T(1.0 / 6), root = square_root(square);
    const T determinant = x * (y * z - other[0] * other[0]) - other[2] * (other[2] * z - other[0] * other[1]) +
                          other[1] * (other[2] * other[0] - y * other[1]);
    const T quotient_of_both = T(0.5) * determinant / maximum(T(square * root), T(kTiny));
    const T r = side * maximum(T(-1), minimum(T(1), quotient_of_both));
    // The largest solution is concave in r, so its tangent at r = 0 is above it; so is a Newton step from there.
    const T above = T(1.7320508075688773) + r * T(1.0 / 3);
    const T nearer = (above * above * above + r) * T(2.0 / 3) / (above * above - T(1));
    return T(1) + mean + side * root * nearer;
  }

  /// Returns the coefficients where J > 0 and β is finite.
  template <class T>
  TM_HOST_DEVICE static Coefficients<T> of_a_round_element(const Point<T>& p) {
    const T w = p.w, q = p.q, i1 = p.i1, i2 = p.cofactor.squaredNorm(), j = maximum(p.j, T(kMinVolume));
    const T side = select_greater(q, T(0), T(-1), T(1));
    const T square = maximum(extreme_square(p.deformation_gradient, side), T(kMinVolume * kMinVolume));
    // J / σ2² is (σ0 σ1)² / J, so I2 / J is a bound too: a better one if σ2 is small.
    const T s = select_greater(q, T(0), minimum(T(j / square), T(i2 / j)), square_root(square));
    const T missing = maximum(T(absolute(q) * s - w), T(0));
    const T to_q = side * missing / s, w_now = w + missing, q_now = q + to_q;
    // If (1) moved changes of shape, a smaller β leaves the change of volume as it was near rest.
    const T to_beta = -select_greater(q, T(0), T(T(2) * missing / maximum(i2, T(kTiny))), T(0));
    const T beta = p.stiffness.wjj + q / j + to_beta;

    // (2) in numbers of order one: A σ² = a σ² + b.
    const T size = maximum(maximum(w_now, T(absolute(q_now) * j)), T(kTiny)), unit = T(1) / size;
    const T a = w_now * unit, b = -q_now * j * unit, h = p.four_w11 * unit, e = j * j;
    const T aa = a * a, ab = a * b, bb = b * b;
    const T product = maximum(T(a * (aa * e + ab * i2 + bb * i1) + b * bb), T(0));  // Π (a σ_i² + b)
    // Σ σ_i²ⁿ / (a σ_i² + b), times the product, for n = 0, 1, 2.
    const T sum0 = aa * i2 + T(2) * ab * i1 + T(3) * bb;
    const T sum1 = T(3) * aa * e + T(2) * ab * i2 + bb * i1;
    const T sum2 = aa * e * i1 + ab * (i1 * i2 - T(3) * e) + bb * (i1 * i1 - T(2) * i2);
    const T with_w11 = product + h * sum2;
    const T inverse = e * (sum0 * with_w11 - h * sum1 * sum1);
    const T least = -size * product * with_w11 / maximum(inverse, T(kTiny));  // β*
    // The sum of all changes is added, so that a stiffness without missing parts keeps its bits.
    return {w_now, q_now, p.stiffness.wjj + (to_beta + T(2) * maximum(T(least - beta), T(0)) - to_q / j)};
  }

  /// Returns the coefficients for any F.
  template <class T>
  TM_HOST_DEVICE static Coefficients<T> of_a_flat_element(const Point<T>& p) {
    const T largest = absolute(p.q) * T(2) * square_root(T(p.i1 * T(1.0 / 3)));
    const T missing = maximum(T(largest - p.w), T(0));
    return {p.w + missing + missing, p.q, maximum(p.stiffness.wjj, T(0))};
  }
};

}  // namespace tensormass::physics
