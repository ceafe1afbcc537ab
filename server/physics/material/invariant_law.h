#pragma once

#include <Eigen/Geometry>

#include "physics/material/stretch_law.h"

/// Isotropic laws W(I1, J), evaluated from F itself.
///
/// Why: stress and stiffness of such a law are polynomials in F, and a decomposition of F costs more than all of them.
/// Near rest the projection to positive semi-definite needs no eigenvectors either. Far from rest it takes the absolute
/// values of the eigenvalues, as other laws do (stretch_law.h). Few points are far from rest, so few are decomposed.
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
/// **The projection near rest.** For J > 0 the last term is q / J ((cof F a)(cof F b)ᵀ − (cof F b)(cof F a)ᵀ). In the
/// axes of the stretches (stretch_law.h) the nine eigenvalues are therefore, with planes numbered by their normal k,
///
///   rotation in plane k      w + q σ_k
///   distortion in plane k    w − q σ_k
///   of the 3 × 3 matrix      A + β c cᵀ + 4 W_11 σ σᵀ,   A = diag(w − q J / σ_i²)
///
/// W_11 and w are not negative. So K becomes positive semi-definite in three parts:
///
///   (1)  Rotations, if q < 0. X = |q| (I + FᵀF) / 2 − w I has eigenvalues x_k ≥ −(w + q σ_k), as (1 + σ²) / 2 ≥ σ.
///        Let them be in [l, m] with m > 0 and l ≤ −m. Then the parabola m (x − l)² / (m − l)² is above zero and above
///        x, and equals x at m. K gets
///
///          R [a]× H [b]×ᵀ Rᵀ = [R a]× R H Rᵀ [R b]×ᵀ,   H = m (X − l I)² / (m − l)²
///
///        which gives the most negative rotation its absolute value. R is the rotation of F, or here F times the first
///        three terms of the series of (FᵀF)⁻¹ᐟ²: wrong by less than 1 % at kNear
///   (2)  Changes of shape, if q > 0. All is well if w ≥ q s, s = J / (the smallest σ)². Otherwise w grows and q is
///        reduced in the ratio s, which near rest moves changes of shape alone
///   (3)  The 3 × 3 matrix. β must be at least β*, the value at which the matrix is singular: a quotient of polynomials
///        in I1, I2 and J² (Sherman, Morrison 1950). Otherwise β grows
///
/// Each ends as far above its bound as it was below, so that what was most negative gets its absolute value (law.h).
/// Bounds of σ are roots of the characteristic polynomial of FᵀF; a Newton step that comes from outside gives values
/// that are never too tight.
///
/// **Far from rest** that leaves some directions too soft. The share `far` of the exact projection therefore grows with
/// the strain e = ‖FᵀF − I‖ (Frobenius norm), from zero at kNear to one at kFar and wherever J ≤ 0:
///
///   K projected = K + (1 − far) (what (1) to (3) add) + far (what absolute eigenvalues add)
///
/// Both projections are positive semi-definite, so any mixture is. The first one counts only for e < kFar = 1/2 and a
/// positive J. No eigenvalue of FᵀF is then farther from one than e, so all σ² are in (1/2, 3/2), J is above 0.35, and
/// nothing divides by zero. The mixture keeps three quarters of every absolute eigenvalue, but for a hundredth of ‖K‖
/// (tests/physics/invariant_law_test.cpp).

/// Keeps a function out of its callers, so that a path that is rarely taken does not take their registers.
#if defined(__CUDACC__)
#define TM_NOINLINE __noinline__
#else
#define TM_NOINLINE [[gnu::noinline]]
#endif

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
    // Zero before project_to_psd:
    T far;                    // share of the exact projection, in [0, 1]
    Mat3<T> rotation, twist;  // R and R H Rᵀ [Pa], against rotations near rest; only if `twists`
    bool twists;
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
    p.far = T(0);
    p.twists = false;
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
    Vec3<T> rotated;                          // R a
    Mat3<T> twisted;                          // [R a]× R H Rᵀ
  };

  template <class T>
  TM_HOST_DEVICE static Node<T> at_node(const Point<T>& p, const Vec3<T>& gradient) {
    Node<T> node = weighted<T>(p, gradient, p.deformation_gradient * gradient, p.cofactor * gradient);
    const Vec3<T> scaled = gradient * p.stiffness.q;
    for (int c = 0; c < 3; ++c) {
      const int i = (c + 1) % 3, j = (c + 2) % 3;
      node.turn.col(c) = p.deformation_gradient.col(j) * scaled[i] * T(-1) + p.deformation_gradient.col(i) * scaled[j];
    }
    if (p.twists) twist(p, Vec3<T>(p.rotation * gradient), node);
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
    if (p.twists) twist(p, Vec3<T>(p.rotation.col(axis)), node);
    return node;
  }

  /// Returns P a from P. The two terms cancel in P for all nodes alike; with w F a + q cof F a, rounding errors of the
  /// modulus would not add up to zero over the nodes.
  template <class T>
  TM_HOST_DEVICE static Vec3<T> traction(const Point<T>& p, const Node<T>& a) {
    return stress(p) * a.gradient;
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const Point<T>& p, const Node<T>& a, const Node<T>& b) {
    Mat3<T> k = a.area_by_wjj * b.area.transpose();
    k += a.moved_by_w11 * b.moved.transpose();
    k.diagonal().array() += a.by_w.dot(b.gradient);
    if (p.twists) {
      const Vec3<T>& y = b.rotated;
      for (int c = 0; c < 3; ++c) {  // + M [y]×ᵀ with M = a.twisted
        const int i = (c + 1) % 3, j = (c + 2) % 3;
        k.col(c) += a.twisted.col(j) * y[i] - a.twisted.col(i) * y[j];
      }
    }
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
    const Strain<T> strain(p.deformation_gradient);
    constexpr double kWidth = kFar * kFar - kNear * kNear;
    const T beyond = (strain.square_norm - T(kNear * kNear)) * T(1 / kWidth);
    p.far = select_greater(p.j, T(0), maximum(T(0), minimum(T(1), beyond)), T(1));
    const T near = T(1) - p.far;
    // Far from rest the changes may be infinite, so they are not multiplied by zero.
    const ChangeNearRest<T> change(p, strain);
    p.stiffness.w += select_greater(near, T(0), T(near * change.stiffness.w), T(0));
    p.stiffness.q += select_greater(near, T(0), T(near * change.stiffness.q), T(0));
    p.stiffness.wjj += select_greater(near, T(0), T(near * change.stiffness.wjj), T(0));
    p.rotation = change.rotation;
    for (int i = 0; i < 9; ++i) p.twist(i) = select_greater(near, T(0), T(near * change.twist(i)), T(0));
    p.twists = true;
  }

  /// Returns whether project_to_psd left a part of the projection to far_part, in any lane of a pack.
  template <class T>
  TM_HOST_DEVICE static bool has_far_part(const Point<T>& p) {
    return !all_greater(T(kTiny), p.far);
  }

  /// Returns the rest of the projection: `far` times what absolute eigenvalues add to the consistent stiffness. It is
  /// a StretchPoint whose stiffness must be added; FarPart has the functions for that. Zero in lanes near rest.
  template <class T>
  TM_NOINLINE TM_FLATTEN TM_HOST_DEVICE static StretchPoint<T> far_part(Point<T> p) {
    StretchPoint<T> out;
    out.f = signed_singular_values(p.deformation_gradient);
    const InvariantSlopes<T> slopes = Derived::in_invariants(p.i1, p.j, p.parameters);
    InvariantEnergy<T> w{T(0), Vec3<T>(slopes.w1, T(0), slopes.wj), Mat3<T>::Zero()};
    w.hessian(0, 0) = slopes.w11;
    w.hessian(2, 2) = slopes.wjj;
    const StretchEnergy<T> now = from_invariants(w, out.f.sigma, Invariants<T>(out.f.sigma));
    const auto share = [&p](const T& added) { return select_greater(p.far, T(0), T(added * p.far), T(0)); };
    const Mat3<T> added = added_by_absolute_eigenvalues(now.hessian);
    for (int i = 0; i < 9; ++i) out.w.hessian(i) = share(added(i));
    for (int i = 0; i < 3; ++i) {
      out.w.distortion[i] = share(maximum(T(now.distortion[i] * T(-2)), T(0)));
      out.w.rotation[i] = share(maximum(T(now.rotation[i] * T(-2)), T(0)));
    }
    out.w.energy = T(0);
    out.w.gradient.setZero();
    return out;
  }

  /// Law of a far_part: at_node, at_axis and stiffness.
  using FarPart = StretchLaw<Derived>;

 private:
  static constexpr double kFlat = 0.05;             // a principal stretch
  static constexpr double kNear = 0.3, kFar = 0.5;  // strains ‖FᵀF − I‖
  static constexpr double kTiny = 1e-30;            // a divisor; a float
  static constexpr double kLeastSpan = 1e-12;       // times w − q: keeps a quotient of rounding errors finite

  /// FᵀF − I, so that small strains keep their digits.
  template <class T>
  struct Strain {
    Vec3<T> diagonal, other;  // other: entries 12, 20, 01
    T square_norm;

    TM_HOST_DEVICE explicit Strain(const Mat3<T>& f) {
      for (int c = 0; c < 3; ++c) {
        diagonal[c] = f.col(c).squaredNorm() - T(1);
        other[c] = f.col((c + 1) % 3).dot(f.col((c + 2) % 3));
      }
      square_norm = diagonal.squaredNorm() + T(2) * other.squaredNorm();
    }
    TM_HOST_DEVICE Mat3<T> matrix() const {
      Mat3<T> m;
      m << diagonal[0], other[2], other[1], other[2], diagonal[1], other[0], other[1], other[0], diagonal[2];
      return m;
    }
  };

  template <class T>
  TM_HOST_DEVICE static Node<T> weighted(const Point<T>& p, const Vec3<T>& gradient, const Vec3<T>& moved,
                                         const Vec3<T>& area) {
    return {gradient, moved, area, gradient * p.stiffness.w, moved * p.four_w11, area * p.stiffness.wjj, {}, {}, {}};
  }
  template <class T>
  TM_HOST_DEVICE static void twist(const Point<T>& p, const Vec3<T>& rotated, Node<T>& node) {
    node.rotated = rotated;
    for (int c = 0; c < 3; ++c) node.twisted.col(c) = rotated.cross(p.twist.col(c));
  }

  /// Bounds of the eigenvalues of FᵀF: from below and from above.
  template <class T>
  struct Extremes {
    T least, most;

    TM_HOST_DEVICE explicit Extremes(const Strain<T>& strain) {
      // Eigenvalues are 1 + mean + root y with y³ − 3 y = 2 r; r is in [−1, 1], and the largest y in [1, 2].
      const Vec3<T>&diagonal = strain.diagonal, &other = strain.other;
      const T mean = diagonal.sum() * T(1.0 / 3);
      const T x = diagonal[0] - mean, y = diagonal[1] - mean, z = diagonal[2] - mean;
      const T square = (x * x + y * y + z * z + T(2) * other.squaredNorm()) * T(1.0 / 6), root = square_root(square);
      const T determinant = x * (y * z - other[0] * other[0]) - other[2] * (other[2] * z - other[0] * other[1]) +
                            other[1] * (other[2] * other[0] - y * other[1]);
      const T quotient_of_both = T(0.5) * determinant / maximum(T(square * root), T(kTiny));
      const T r = maximum(T(-1), minimum(T(1), quotient_of_both));
      // The largest solution is concave in r, so its tangent at r = 0 is above it; so is a Newton step from there.
      const auto largest = [](const T& of) {
        const T above = T(1.7320508075688773) + of * T(1.0 / 3);
        return T((above * above * above + of) * T(2.0 / 3) / (above * above - T(1)));
      };
      most = T(1) + mean + root * largest(r);
      least = T(1) + mean - root * largest(T(-r));
    }
  };

  /// What the projection near rest adds. Any numbers where e > kFar or J ≤ 0.
  template <class T>
  struct ChangeNearRest {
    Coefficients<T> stiffness;
    Mat3<T> rotation, twist;

    TM_HOST_DEVICE ChangeNearRest(const Point<T>& p, const Strain<T>& strain) {
      const Extremes<T> squares(strain);
      add_against_rotations(p, strain, squares);
      add_to_coefficients(p, squares);
    }

   private:
    TM_HOST_DEVICE void add_against_rotations(const Point<T>& p, const Strain<T>& strain, const Extremes<T>& squares) {
      const T half = maximum(T(-p.q), T(0)) * T(0.5), at_one = half + half - p.w;  // X is at_one where a σ is one
      const T most = select_greater(half, T(0), maximum(T(0), T(at_one + half * (squares.most - T(1)))), T(0));
      const T least = minimum(T(-most), T(at_one + half * (squares.least - T(1))));
      const T span = maximum(T(most - least), T((p.w + half) * T(kLeastSpan) + T(kTiny)));
      // C⁻¹ᐟ² of C = FᵀF to second order, and (X − least I) / span.
      const Mat3<T> e = strain.matrix();
      const Mat3<T> root = Mat3<T>::Identity() - e * T(0.5) + e * e * T(0.375);
      const Mat3<T> x = Mat3<T>::Identity() * T((at_one - least) / span) + e * T(half / span);
      rotation = p.deformation_gradient * root;
      const Mat3<T> rotated = rotation * x;
      twist = rotated * rotated.transpose() * most;
    }

    TM_HOST_DEVICE void add_to_coefficients(const Point<T>& p, const Extremes<T>& squares) {
      const T w = p.w, q = p.q, i1 = p.i1, i2 = p.cofactor.squaredNorm(), j = p.j;
      // J / σ2² is (σ0 σ1)² / J, so I2 / J is a bound too: a better one if σ2 is small.
      const T s = minimum(T(j / squares.least), T(i2 / j));
      const T missing = select_greater(q, T(0), maximum(T(q * s - w), T(0)), T(0));
      const T to_q = -missing / s, w_now = w + missing, q_now = q + to_q;
      // A smaller β leaves the change of volume as it was near rest.
      const T to_beta = T(-2) * missing / maximum(i2, T(kTiny));
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
      stiffness = {missing, to_q, to_beta + T(2) * maximum(T(least - beta), T(0)) - to_q / j};
    }
  };
};

}  // namespace tensormass::physics
