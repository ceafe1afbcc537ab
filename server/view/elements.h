#pragma once

#include "physics/element/prony.h"
#include "physics/element/rest.h"
#include "view/matrix.h"
#include "view/patches.h"

/// The elements of one group, which all have the same shape and law. They are stored in one of two ways:
///
/// 1. A CPU reads several elements into one vector register. It needs structures of arrays, padded to a multiple of
///    kSliceRows with elements of zero weight.
/// 2. A GPU thread reads one element at a time. It needs *records*: the reals of the quadrature points, then the law's
///    parameters.
///
///   record:  point 0 | point 1 | ... | parameters | padding
///
/// Records, and each of several points, start at a multiple of four reals. Parameters follow a single point directly.
namespace tensormass::view {

TM_HOST_DEVICE constexpr std::uint32_t round_to_four(std::uint32_t reals) { return (reals + 3) / 4 * 4; }
/// Reals from one quadrature point of a record to the next.
TM_HOST_DEVICE constexpr std::uint32_t point_stride(std::uint32_t rest_reals, std::uint32_t points) {
  return points == 1 ? rest_reals : round_to_four(rest_reals);
}
/// Reals of a whole record.
TM_HOST_DEVICE constexpr std::uint32_t record_reals(std::uint32_t rest_reals, std::uint32_t points,
                                                    std::uint32_t parameters) {
  return round_to_four(points * point_stride(rest_reals, points) + parameters);
}

/// Reals of a stored decomposition F = U Σ Vᵀ: two columns each of U and V, Σ, and padding to a multiple of four.
inline constexpr std::uint32_t kDecompositionReals = 16;

/// Selective reduced integration weights of a quadrature point (physics::ModuliWeights).
template <class Real>
struct ModuliWeights {
  Real deviatoric;
  Real volumetric;

  ModuliWeights() = default;
  explicit ModuliWeights(const physics::ModuliWeights& s)
      : deviatoric(static_cast<Real>(s.deviatoric)), volumetric(static_cast<Real>(s.volumetric)) {}
};

/// One term of a Prony series: α_i and τ_i of physics/element/prony.h.
template <class Real>
struct PronyTerm {
  Real share;
  Real relaxation_time_s;
};

/// A slice of the matrix whose rows have elements of a group. A GPU reads it as a whole, before the data that it refers
/// to.
struct alignas(16) ListedSlice {
  std::uint32_t slice_and_state;             // 4 · slice, + 1 if begun, + 2 if the group finishes
  std::uint32_t columns_begin, columns_end;  // its slots
  std::uint32_t list_begin, list_end;        // its element lists, in columns of kSliceRows
  PatchColumns patch;

  TM_HOST_DEVICE std::uint32_t slice() const { return slice_and_state / 4; }
  /// An earlier group has left its sums in these rows.
  TM_HOST_DEVICE bool is_begun() const { return (slice_and_state & 1) != 0; }
  /// This group is the last one: it forms the rows of A and b.
  TM_HOST_DEVICE bool finishes() const { return (slice_and_state & 2) != 0; }
};

template <class Real>
struct ElementView {
  std::uint32_t count;                        // a multiple of kSliceRows
  std::uint32_t point_count;                  // quadrature points of an element
  std::uint32_t report_begin;                 // first of its patches in per-group reports (GuardView)
  const std::uint32_t* rows;                  // [shape nodes][count]
  const Real* rest;                           // [quadrature points][physics::kRestReals][count]; nullptr: in records
  const Real* parameters;                     // [law parameters][count]; nullptr: in records
  const ModuliWeights<Real>* moduli_weights;  // [quadrature points]; nullptr: each point integrates all moduli

  // Viscoelastic internal variables Γ_i of each Prony term [Pa].
  std::uint32_t prony_count;
  PronyTerm<Real> prony[physics::kMaxPronyTerms];
  Real* internal_variables;             // [quadrature points][prony_count][6][count]
  Real* checkpoint_internal_variables;  // copy for restoring the checkpoint

  // For the inversion check (physics::reference_gradients); nullptr: no check, or F from stored rest shapes.
  std::uint32_t reference_points;
  const Real* reference_gradients;

  // Storage by rows (matrix/rows.h):
  std::uint32_t record_reals;
  const Real* records;          // [count][record_reals]
  Real* decompositions;         // [count][quadrature points][kDecompositionReals]; nullptr: the law does not use them
  std::uint32_t slice_count;    // slices with elements of the group
  const ListedSlice* slices;    // [slice_count]
  const std::uint32_t* listed;  // [column][kSliceRows] element; kNoPlace: the row's list has ended
  std::uint32_t place_bits;     // 8 or 16
  const std::uint32_t* places;  // [column][words][kSliceRows], see matrix::Places

  // Lagged tangents (matrix/lagged_tangents.h); nullptr: the group is evaluated in each step.
  std::uint32_t begins_kept;   // 1: the first such group of the scene
  Real* kept;                  // [pack][kKeptReals][lane]
  const std::uint32_t* turns;  // [count] StepControl::refresh_turn in which it is evaluated however little it moved

  // Storage by edges (matrix/edges.h):
  const std::uint32_t* patch_elements;  // [patch_count, 2] range of elements that touch a patch; nullptr: even split
  const std::uint32_t* pair_places;  // [pairs][count] 2 · slot + 1 if it holds the transposed block; kNoPlace: no slot
};

}  // namespace tensormass::view
