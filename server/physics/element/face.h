#pragma once

#include "core/scalar.h"

/// Integrals over an element's face, for tractions and pressures. The face has three nodes (linear), four (bilinear),
/// six or eight (quadratic: corners, then the middles of the sides 01 12 ..), counter-clockwise seen from outside.
///
///   (r, s)      coordinates of the reference face: [0, 1]², or the triangle r, s ≥ 0, r + s ≤ 1
///   N_k         shape function of node k
///   x           position; x_r and x_s are its derivatives by r and s
///   n, da       outward unit normal and area element
namespace tensormass::physics {

inline constexpr int kMaxFaceNodes = 8;

/// A quadrature point of a face, with the values that an integral over the face needs.
template <class T>
struct FacePoint {
  T weight;
  T n[kMaxFaceNodes];      // shape functions
  T dn[kMaxFaceNodes][2];  // their derivatives by r and s
};

namespace detail {

template <class T>
TM_HOST_DEVICE FacePoint<T> quadrilateral_point(int q) {
  // 2×2 Gauss on [0, 1]². Exact for N_k (x_r × x_s), whose degree is three in each direction.
  const T near = T(0.21132486540518713), far = T(0.78867513459481287);
  const T r = q % 2 == 0 ? near : far, s = q / 2 == 0 ? near : far;
  return {T(0.25),
          {(1 - r) * (1 - s), r * (1 - s), r * s, (1 - r) * s},
          {{s - 1, r - 1}, {1 - s, -r}, {s, r}, {-s, 1 - r}}};
}

template <class T>
TM_HOST_DEVICE FacePoint<T> quadratic_quadrilateral_point(int q) {
  // 3×3 Gauss on [−1, 1]². Exact for N_k (x_r × x_s), whose degree is five in each direction.
  const T far = T(0.77459666924148338);
  const T x[2] = {far * static_cast<T>(q % 3 - 1), far * static_cast<T>(q / 3 - 1)};
  const auto weight = [](int i) { return i == 1 ? T(8) / 18 : T(5) / 18; };  // they add up to one
  FacePoint<T> p{};
  p.weight = weight(q % 3) * weight(q / 3);
  // Places of the nodes. Derivatives by r and s are twice those by x.
  constexpr int kPlaces[8][2] = {{-1, -1}, {1, -1}, {1, 1}, {-1, 1}, {0, -1}, {1, 0}, {0, 1}, {-1, 0}};
  for (int k = 0; k < 8; ++k) {
    T factor[2], slope[2];
    for (int c = 0; c < 2; ++c) {
      const T at = static_cast<T>(kPlaces[k][c]);
      factor[c] = kPlaces[k][c] == 0 ? 1 - x[c] * x[c] : 1 + at * x[c];
      slope[c] = kPlaces[k][c] == 0 ? -2 * x[c] : at;
    }
    // Corner: ¼ (1 + σ₀ x₀)(1 + σ₁ x₁)(σ · x − 1). Middle: half the product.
    const bool corner = k < 4;
    const T last =
        corner ? (static_cast<T>(kPlaces[k][0]) * x[0] + static_cast<T>(kPlaces[k][1]) * x[1] - 1) / 4 : T(0.5);
    p.n[k] = factor[0] * factor[1] * last;
    for (int c = 0; c < 2; ++c) {
      const T of_last = corner ? static_cast<T>(kPlaces[k][c]) / 4 : T(0);
      p.dn[k][c] = 2 * factor[1 - c] * (slope[c] * last + factor[c] * of_last);
    }
  }
  return p;
}

template <class T>
TM_HOST_DEVICE FacePoint<T> triangle_point(int nodes, int q) {
  FacePoint<T> p{};
  T l[3];
  if (nodes == 3) {
    p.weight = T(0.5);
    l[0] = l[1] = l[2] = T(1) / 3;
  } else {  // six points, exact to degree four (Cowper 1973)
    const bool inner = q < 3;
    p.weight = (inner ? T(0.22338158967801147) : T(0.10995174365532187)) / 2;
    const T other = inner ? T(0.44594849091596489) : T(0.091576213509770743);
    for (int k = 0; k < 3; ++k) l[k] = k == q % 3 ? 1 - 2 * other : other;
  }
  const T slope[3][2] = {{-1, -1}, {1, 0}, {0, 1}};
  for (int k = 0; k < 3; ++k) {
    p.n[k] = nodes == 3 ? l[k] : l[k] * (2 * l[k] - 1);
    for (int c = 0; c < 2; ++c) p.dn[k][c] = nodes == 3 ? slope[k][c] : (4 * l[k] - 1) * slope[k][c];
  }
  for (int k = 3; k < nodes; ++k) {
    const int i = k - 3, j = (k - 2) % 3;
    p.n[k] = 4 * l[i] * l[j];
    for (int c = 0; c < 2; ++c) p.dn[k][c] = 4 * (l[i] * slope[j][c] + l[j] * slope[i][c]);
  }
  return p;
}

}  // namespace detail

/// Returns the number of quadrature points of a face with 3, 4, 6 or 8 nodes.
TM_HOST_DEVICE constexpr int face_points(int nodes) { return nodes == 3 ? 1 : nodes == 4 ? 4 : nodes == 6 ? 6 : 9; }

/// Returns quadrature point q of a face with 3, 4, 6 or 8 nodes; 0 ≤ q < face_points(nodes).
template <class T>
TM_HOST_DEVICE FacePoint<T> face_point(int nodes, int q) {
  if (nodes == 4) return detail::quadrilateral_point<T>(q);
  if (nodes == 8) return detail::quadratic_quadrilateral_point<T>(q);
  return detail::triangle_point<T>(nodes, q);
}

/// x_r and x_s at a point of the face [m per unit of reference length].
template <class T>
struct FaceTangents {
  Vec3<T> r = Vec3<T>::Zero(), s = Vec3<T>::Zero();

  TM_HOST_DEVICE FaceTangents(const FacePoint<T>& p, const Vec3<T>* x, int nodes) {
    for (int k = 0; k < nodes; ++k) {
      r += x[k] * p.dn[k][0];
      s += x[k] * p.dn[k][1];
    }
  }
  /// Returns x_r × x_s: the normal times the area element per unit of reference area [m²].
  TM_HOST_DEVICE Vec3<T> normal() const {
    return {r[1] * s[2] - r[2] * s[1], r[2] * s[0] - r[0] * s[2], r[0] * s[1] - r[1] * s[0]};
  }
};

/// Returns ∫ N_corner n da [m²] over the face at positions x. A pressure p loads the node with −p times this vector.
template <class T>
TM_HOST_DEVICE Vec3<T> face_area_vector(const Vec3<T>* x, int nodes, int corner) {
  Vec3<T> sum = Vec3<T>::Zero();
  for (int q = 0; q < face_points(nodes); ++q) {
    const FacePoint<T> p = face_point<T>(nodes, q);
    sum += FaceTangents<T>(p, x, nodes).normal() * (p.weight * p.n[corner]);
  }
  return sum;
}

/// Returns the vector g_kl = ∫ N_k (∂N_l/∂s x_r − ∂N_l/∂r x_s) dr ds [m]. If node l moves by d, the area vector of
/// corner k changes by g_kl × d.
template <class T>
TM_HOST_DEVICE Vec3<T> face_area_change(const Vec3<T>* x, int nodes, int corner, int other) {
  Vec3<T> sum = Vec3<T>::Zero();
  for (int q = 0; q < face_points(nodes); ++q) {
    const FacePoint<T> p = face_point<T>(nodes, q);
    const FaceTangents<T> tangents(p, x, nodes);
    sum += (tangents.r * p.dn[other][1] - tangents.s * p.dn[other][0]) * (p.weight * p.n[corner]);
  }
  return sum;
}

/// Returns ∫ N_corner da [m²]. A traction loads the node with this area times the traction. Exact for plane faces.
template <class T>
TM_HOST_DEVICE T face_area(const Vec3<T>* x, int nodes, int corner) {
  T sum = 0;
  for (int q = 0; q < face_points(nodes); ++q) {
    const FacePoint<T> p = face_point<T>(nodes, q);
    sum += FaceTangents<T>(p, x, nodes).normal().norm() * p.weight * p.n[corner];
  }
  return sum;
}

}  // namespace tensormass::physics
