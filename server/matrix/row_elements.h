#pragma once

#include "matrix/element_points.h"
#include "physics/material/law.h"

/// The elements of a row, as the thread that owns the row (matrix/rows.h) finds and reads them.
///
///   row ──> its list of elements ──> Places of the element's nodes ──> blocks of the row to which it adds
///                (ElementView::listed)  └─> a ReadPoint for each quadrature point ──> F, stress, stiffness
///
///   place   column of a slot within the row's slice, in 8 or 16 bits; all bits set: the row itself
///   F       deformation gradient; F = U Σ Vᵀ is its signed singular value decomposition
///
/// 1. An element has one place for each of its nodes, relative to the row that reads it. 8 bits suffice if the widest
///    slice has fewer than 255 columns.
/// 2. Laws of the principal stretches need F = U Σ Vᵀ. All rows of an element need the same one, and it is expensive. A
///    first pass therefore computes it once for each quadrature point.
namespace tensormass::matrix {

using namespace view;

/// The place that stands for the row itself.
TM_HOST_DEVICE constexpr std::uint32_t own_place(std::uint32_t bits) { return bits == 8 ? 0xFF : 0xFFFF; }
/// Words of 32 bits that hold the places of one element.
TM_HOST_DEVICE constexpr std::uint32_t place_words(std::uint32_t nodes, std::uint32_t bits) {
  return (nodes * bits + 31) / 32;
}

/// Places of an element's nodes in one of its rows.
template <int Nodes>
class Places {
 public:
  /// The places as they are stored.
  struct Packed {
    std::uint32_t words[place_words(Nodes, 16)];
    template <class Real>
    TM_HOST_DEVICE static Packed read(const ElementView<Real>& e, std::uint32_t column, std::uint32_t lane) {
      Packed packed;
      const std::uint32_t count = place_words(Nodes, e.place_bits);
      const std::uint32_t* words = e.places + std::size_t{column} * count * kSliceRows + lane;
      TM_UNROLL_ALL
      for (std::uint32_t i = 0; i < place_words(Nodes, 16); ++i) {
        packed.words[i] = read_once(words + minimum(i, count - 1) * kSliceRows);
      }
      return packed;
    }
  };

  Places() = default;
  TM_HOST_DEVICE Places(const Packed& packed, std::uint32_t bits) {
    const std::uint32_t own = own_place(bits);
    TM_UNROLL_ALL
    for (std::uint32_t l = 0; l < Nodes; ++l) {
      nodes_[l] = of_node(packed, bits, l);
      is_own_[l] = nodes_[l] == own;
    }
    TM_UNROLL_ALL
    for (std::uint32_t m = 0; m + 1 < Nodes; ++m) others_[m] = is_own_[m + 1] ? nodes_[0] : nodes_[m + 1];
  }

  /// Whether node l is the row itself; otherwise of(l) is its place.
  TM_HOST_DEVICE bool is_own(int l) const { return is_own_[l]; }
  TM_HOST_DEVICE std::uint32_t of(int l) const { return nodes_[l]; }

  /// Places of the other nodes, in the order of physics::kOthers.
  TM_HOST_DEVICE const std::uint32_t (&others() const)[Nodes - 1] { return others_; }

 private:
  TM_HOST_DEVICE static std::uint32_t of_node(const Packed& packed, std::uint32_t bits, std::uint32_t m) {
    const std::uint32_t word = bits == 8 ? packed.words[m / 4] : packed.words[m / 2];
    return word >> (bits == 8 ? 8 * (m % 4) : 16 * (m % 2)) & own_place(bits);
  }

  bool is_own_[Nodes];
  std::uint32_t nodes_[Nodes], others_[Nodes - 1];
};

/// F = U Σ Vᵀ of a quadrature point, as it is stored between the two passes over elements. U and V are rotations, so
/// two columns of each are stored; the third is their cross product.
template <class Real>
struct Decomposition {
  Real reals[kDecompositionReals];

  Decomposition() = default;
  TM_HOST_DEVICE Decomposition(const ElementView<Real>& e, std::uint32_t q, std::uint32_t element) {
    read_reals(place(e, q, element), reals);
  }
  TM_HOST_DEVICE static void keep(const physics::SignedSingularValues<Real>& f, const ElementView<Real>& e,
                                  std::uint32_t q, std::uint32_t element) {
    Real reals[kDecompositionReals] = {};
    for (int c = 0; c < 6; ++c) {
      reals[c] = f.u(c);
      reals[6 + c] = f.v(c);
    }
    for (int c = 0; c < 3; ++c) reals[12 + c] = f.sigma[c];
    write_reals(reals, place(e, q, element));
  }
  TM_HOST_DEVICE physics::SignedSingularValues<Real> values() const {
    physics::SignedSingularValues<Real> f;
    for (int c = 0; c < 6; ++c) {
      f.u(c) = reals[c];
      f.v(c) = reals[6 + c];
    }
    for (Mat3<Real>* rotation : {&f.u, &f.v}) rotation->col(2) = rotation->col(0).cross(rotation->col(1));
    for (int c = 0; c < 3; ++c) f.sigma[c] = reals[12 + c];
    return f;
  }

 private:
  TM_HOST_DEVICE static Real* place(const ElementView<Real>& e, std::uint32_t q, std::uint32_t element) {
    return e.decompositions + (std::size_t{element} * e.point_count + q) * kDecompositionReals;
  }
};

/// Decomposes F at each quadrature point once, for laws that need it (physics::kDecomposes).
/// Reads displacement; writes decompositions.
template <class Shape, class Team, class Real>
TM_HOST_DEVICE void decompose(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                              const ElementView<Real>& e) {
  const ElementRange range = element_range(patches, e, team.patch());
  const std::uint32_t points = points_of<Shape>(e);
  team.for_each(range.begin * points, range.end * points, [&](std::uint32_t i) {
    const std::uint32_t element = i / points, q = i % points;
    Vec3<Real> u[Shape::kNodes];
    load_displacement<SingleLane<Real>, Shape>(state, e, element, u);
    const StoredPoint<SingleLane<Real>, Shape, NoLaw> stored(e, q, element);
    const Mat3<Real> f = stored.gradients().deformation_gradient(u);
    Decomposition<Real>::keep(physics::signed_singular_values(f), e, q, element);
  });
}

/// The stored data of a quadrature point. For laws that decompose it contains F, decomposed; other laws compute F from
/// displacements.
template <class Shape, class Law, class Real>
struct ReadPoint {
  struct Nothing {
    Nothing() = default;
    TM_HOST_DEVICE Nothing(const ElementView<Real>&, std::uint32_t, std::uint32_t) {}
  };
  StoredPoint<SingleLane<Real>, Shape, Law> stored;
  std::conditional_t<physics::kDecomposes<Law>, Decomposition<Real>, Nothing> decomposition;

  ReadPoint() = default;
  TM_HOST_DEVICE ReadPoint(const ElementView<Real>& e, std::uint32_t q, std::uint32_t element)
      : stored(e, q, element), decomposition(e, q, element) {}
};

/// Elements of a row that a thread evaluates side by side. The arithmetic of one hides the memory latency of the other.
template <class Shape>
inline constexpr std::uint32_t kElementsAtOnce = Shape::kSinglePoint ? 2 : 1;

}  // namespace tensormass::matrix
