#pragma once

#include <cstdint>

#include "core/scalar.h"
#include "physics/element/face.h"
#include "physics/element/prony.h"
#include "physics/element/rest.h"

/// What a stage sees of a scene: plain pointers, to host or to device memory, in one precision.
///
/// Nodes are renumbered to *rows*: the mesh is cut into compact patches, each patch owns a contiguous range of rows
/// that begins and ends at a multiple of kSliceRows, and the gap at the end of a patch is filled with rows that nothing
/// refers to. A patch's *halo* is the rows of other patches that its own rows are coupled to. Solver vectors are kept
/// per patch, own rows first and halo rows behind them, so that a patch reads its neighbours only through `exchange`.
///
/// Matrices are sliced ELLPACK (Kreutzer et al. 2014): 32 neighbouring rows form a slice that is as wide as its longest
/// row. A GPU warp and a CPU vector register both walk it along the rows.
namespace tensormass::tensor {

inline constexpr std::uint32_t kSliceRows = 32;

/// An element's record, where elements are read one by one (Storage::kRows): the reals of each quadrature point, then
/// the law's parameters. Records, and points if there are several, begin at multiples of four, which a device reads at
/// once.
TM_HOST_DEVICE constexpr std::uint32_t round_to_four(std::uint32_t reals) { return (reals + 3) / 4 * 4; }
TM_HOST_DEVICE constexpr std::uint32_t point_stride(std::uint32_t rest_reals, std::uint32_t points) {
  return points == 1 ? rest_reals : round_to_four(rest_reals);
}
TM_HOST_DEVICE constexpr std::uint32_t record_reals(std::uint32_t rest_reals, std::uint32_t points,
                                                    std::uint32_t parameters) {
  return round_to_four(points * point_stride(rest_reals, points) + parameters);
}

/// Of a quadrature point F = U Σ Vᵀ: two columns of U and of V, Σ and what fills up to a multiple of four.
inline constexpr std::uint32_t kDecompositionReals = 16;

/// What a quadrature point integrates of the deviatoric and of the volumetric moduli (physics::ModuliWeights).
template <class Real>
struct ModuliWeights {
  Real deviatoric;
  Real volumetric;

  ModuliWeights() = default;
  explicit ModuliWeights(const physics::ModuliWeights& s)
      : deviatoric(static_cast<Real>(s.deviatoric)), volumetric(static_cast<Real>(s.volumetric)) {}
};

/// α_i, τ_i of physics/element/prony.h.
template <class Real>
struct PronyTerm {
  Real share;
  Real relaxation_time_s;
};

/// What patch-local columns stand for: own rows, then rows of the halo.
struct PatchColumns {
  std::uint32_t row_begin, row_end;
  std::uint32_t halo_begin;
  TM_HOST_DEVICE std::uint32_t own() const { return row_end - row_begin; }
};

/// A slice that has elements of a group. A device reads it at once: what it needs next is behind it.
struct alignas(16) ListedSlice {
  std::uint32_t slice_and_state;             // 4 slice + 1 if rows have been begun + 2 if they are to be finished
  std::uint32_t columns_begin, columns_end;  // of slots
  std::uint32_t list_begin, list_end;        // in columns of kSliceRows
  PatchColumns patch;

  TM_HOST_DEVICE std::uint32_t slice() const { return slice_and_state / 4; }
  TM_HOST_DEVICE bool is_begun() const { return (slice_and_state & 1) != 0; }
  TM_HOST_DEVICE bool is_to_be_finished() const { return (slice_and_state & 2) != 0; }
};

/// Elements of one (shape, law). Structures of arrays, padded to a multiple of kSliceRows with elements of zero weight.
template <class Real>
struct ElementView {
  std::uint32_t count;                // a multiple of kSliceRows
  std::uint32_t point_count;          // quadrature points of an element
  std::uint32_t watch_begin;          // of its patches in SceneView::watch
  const std::uint32_t* rows;          // [shape nodes][count]
  const Real* rest;                   // [quadrature points][physics::kRestReals][count]; nullptr: in records
  const Real* parameters;             // [law parameters][count]; nullptr: in records
  const ModuliWeights<Real>* shares;  // [quadrature points]; nullptr: each integrates all moduli
  std::uint32_t prony_count;
  PronyTerm<Real> prony[physics::kMaxPronyTerms];
  Real* history;       // Γ_i [Pa] [quadrature points][prony_count][6][count]
  Real* kept_history;  // of the state to go back to

  // For the check of volumes, see physics::reference_gradients; nullptr: none, or of mean gradients.
  std::uint32_t reference_points;
  const Real* reference_gradients;

  // Only where rows evaluate their elements (tensor/rows.h):
  std::uint32_t record_reals;
  const Real* records;          // [count][record_reals], see tensor::record_reals
  Real* decompositions;         // [count][quadrature points][kDecompositionReals]; nullptr: the law has no use for them
  std::uint32_t slice_count;    // slices with elements of the group
  const ListedSlice* slices;    // [slice_count]
  const std::uint32_t* listed;  // [column][kSliceRows] element; kNoPlace: the row's list has ended
  std::uint32_t place_bits;     // 8 or 16
  const std::uint32_t* places;  // [column][words][kSliceRows], see tensor::Places
  // Only where the matrix stores edges (tensor/edges.h):
  const std::uint32_t* patch_elements;  // [patch_count, 2] begin and end of those that touch a patch; nullptr: shares
  const std::uint32_t* pair_places;     // [pairs][count] 2 slot + 1 if it holds the transposed block; kNoPlace: nowhere
};

/// A spherical probe as a step sees it.
template <class Real>
struct ToolState {
  Real center_m[3];
  Real radius_m;
  Real penalty_pa_per_m;
};

/// Where a tool touches a triangle in this step.
template <class Real>
struct TriangleContact {
  Real weight[3];  // barycentric coordinates of the contact point
  Real normal[3];  // the direction in which the tissue is pushed
  Real depth_m;    // penetration; zero: no contact
  Real stiffness;  // [N/m]
};

/// How close a patch's closest triangle is to a tool.
template <class Real>
struct ClosestTriangle {
  Real distance_squared;
  Real side;  // +1 the tool's centre is outside the tissue, −1 inside
};

/// What the guards look at after each step; one for each patch, then reduced by the host in order.
template <class Real>
struct PatchReport {
  Real max_speed_m_per_s;
  Real finite;            // 1, or 0 if a value of the patch is not a number
  Real max_move_m;        // from the kept state
  Real max_distance_m;    // from rest
  Real kinetic_energy_j;  // of the masses of nodes
  Real work_j;            // of gravity and loads since the kept state
  Real min_det_f;         // of tetrahedra that the solve has found inside out; infinity: none
};

/// What the solve says of itself.
template <class Real>
struct SolveReport {
  Real relative_residual;
  std::uint32_t iterations;
  std::uint32_t negative_curvature;  // 1 if the iteration stopped on it
};

/// A step is u = û + h v and M (v − v̂) / h = forces, with û (base_displacement) and v̂ (base_velocity) made from the
/// last two steps. Implicit Euler has h = dt, û = u and v̂ = v; linearized once, it needs no base fields.
template <class Real>
struct StepScheme {
  Real step_s;                   // h
  Real displacement_weights[2];  // of u at the ends of the last two steps, the newer one first
  Real velocity_weights[2];
};

/// What the host tells the coming step, and may change from one to the next.
template <class Real>
struct StepControl {
  StepScheme<Real> scheme;
  Real dt_s;          // of the step
  Real history_dt_s;  // of the step before, by which histories are to move on; 0: they have
  std::uint32_t cg_max_iterations;
  std::uint32_t keeps;  // the state that it begins with is the one to go back to
};

/// What the outer iteration asks of the stages; only in scenes that solve more than once a step.
struct NewtonControl {
  std::uint32_t positive_stiffness;  // 0: the consistent one
  std::uint32_t begins_step;         // displacement is that of the last step's end: histories move on
  float line_share;                  // of the last increment, to be taken
};

/// How far a patch is from balance, for the outer iteration; of its free components but for the forces.
template <class Real>
struct PatchResidual {
  Real imbalance_squared;  // of rhs [N² s²]
  Real force_squared;      // of internal and external forces, held components included [N² s²]
  Real slope;              // rhs · increment [J]
  Real moved_squared;      // how far the increment moves a node, relative to |(u, size_m)|: the largest, squared
};

/// What elements look like now; one for each group and patch.
template <class Real>
struct PatchWatch {
  Real min_det_f;
  Real max_strain;     // largest component of |sym F − I|
  Real max_rotation;   // |axial vector of skew F|, about the angle in radians
  Real least_stretch;  // smallest principal stretch, at most 1; 1 for laws that state none (kLeastStretch)
  Real elastic_energy_j;
};

/// A face under pressure and the rows of its nodes; physics/element/face.h.
template <class Real>
struct PressureFace {
  std::uint32_t node_count;
  std::uint32_t rows[physics::kMaxFaceNodes];
  Real pressure_pa;

  PressureFace() = default;
  template <class Other>
  explicit PressureFace(const PressureFace<Other>& f)
      : node_count(f.node_count), pressure_pa(static_cast<Real>(f.pressure_pa)) {
    for (int k = 0; k < physics::kMaxFaceNodes; ++k) rows[k] = f.rows[k];
  }
};

/// Force and torque of a patch's tissue on a tool.
template <class Real>
struct ToolLoad {
  Real force_n[3];
  Real torque_n_m[3];  // about the probe's centre
};

template <class Real>
struct SceneView {
  // -- sizes
  std::uint32_t row_count;
  std::uint32_t patch_count;
  std::uint32_t tool_count;
  std::uint32_t triangle_count;

  // -- numbers of the step
  const StepControl<Real>* control;  // [1]
  Real cg_tolerance;
  Real size_m;  // diagonal of the box around the scene at rest

  // -- patches; rows and halo by offsets
  const std::uint32_t* patch_rows;  // [patch_count + 1]
  const std::uint32_t* patch_halo;  // [patch_count + 1] into halo
  const std::uint32_t* halo;        // global rows

  // -- matrix structure
  const std::uint32_t* slice_begin;  // [row_count / 32 + 1], in columns of slots
  const std::uint32_t* columns;      // [slot] patch-local: own rows, then halo; padding slots name the row itself
  // Only with Storage::kTiles, else nullptr (tensor/tiles.h):
  std::uint32_t tile_rows;
  const std::uint32_t* slice_read;  // [row_count / 32] where the columns end that a solve has to read
  const std::uint32_t* used_twice;  // [column] bits of the lanes whose block serves the row that it names, too
  // Only where the matrix stores edges, else nullptr (tensor/edges.h):
  const std::uint32_t* slice_halo;      // [row_count / 8] where the halo of a slice begins
  const std::uint32_t* patch_boundary;  // [patch_count + 1] into boundary
  const std::uint32_t* boundary;        // patch-local rows that are in the halo of others
  Real* own_product;                    // [row_count, 4] Â p, zero between iterations

  // -- constant tensors of the linear laws
  const Real* constant_edges;  // [slot] 3×3

  // -- only where groups leave rows to be finished (tensor/rows.h)
  const std::uint8_t* begun_slices;  // [row_count / 32] 1: edges hold K and rhs forces of elements

  // -- state and fields of rows, [row_count, 4]
  Real* displacement;       // u [m]
  Real* velocity;           // [m/s]
  const Real* rest;         // X [m], 4th: bits of the free directions, 7 for a free row, 0 for a fixed or padding row
  Real* relative_position;  // where rows have moved to [m], from where row 0 rests; nullptr: nobody asks
  const Real* inertia;      // mass [kg], Rayleigh α [1/s], Rayleigh β [s], s of solver/jacobi_scaling.h
  const Real* external;     // constant force [N]
  Real* base_displacement;  // û; nullptr: displacement itself
  Real* base_velocity;      // v̂; nullptr: velocity itself
  Real* previous_displacement;  // of the step before the last; nullptr: its weight is zero
  Real* previous_velocity;
  Real* kept_displacement;  // the state to go back to
  Real* kept_velocity;
  Real* kept_previous_displacement;  // nullptr as previous_displacement
  Real* kept_previous_velocity;
  Real* increment;                 // L⁻ᵀ x of the last solve; only for outer iterations, as are:
  Real* iterate;                   // velocity before that increment
  Real* internal_force;            // of elements [N]
  const NewtonControl* newton;     // [1]
  PatchResidual<Real>* residuals;  // [patch_count]

  // -- consistent mass, off the diagonal; nullptr: lumped
  const Real* mass_edges;  // [slot] kg

  // -- displacements that are given
  const std::uint32_t* patch_driven;  // [patch_count + 1] into driven
  const std::uint32_t* driven;        // [.., 3] row, index into prescribed, bits of the directions
  const Real* prescribed;             // [.., 4] m, at the end of the step

  // -- faces under pressure
  const PressureFace<Real>* pressure_faces;
  const std::uint32_t* patch_pressed;    // [patch_count + 1] into pressed_rows
  const std::uint32_t* pressed_rows;     // rows of pressure faces, grouped by patch
  const std::uint32_t* pressed_begin;    // [pressed row + 1] into pressed_corners
  const std::uint32_t* pressed_corners;  // [.., 2] face, corner

  // -- tetrahedra whose volume the solve checks where it ends (tensor/patch_tetrahedra.h); nullptr: none
  const std::uint32_t* patch_tetrahedra;  // [2 patch_count + 1] into tetrahedron_rows
  const std::uint16_t* tetrahedron_rows;  // [.., 4] patch-local

  // -- the linear system of the step: A Δv = b, scaled to Â x = b̂ with Â = L⁻¹ A L⁻ᵀ, b̂ = s L⁻¹ b
  Real* edges;      // [slot] 3×3
  Real* diagonal;   // [row_count, 8]: upper triangle of A_ii, then (after factorize) L⁻¹; 6 used
  Real* rhs;        // [row_count, 4]
  Real* solution;   // [row_count, 4] x
  Real* residual;   // [own + halo of every patch, 4]
  Real* direction;  // [own + halo of every patch, 4]
  Real* product;  // [2, row_count, 4] Â p, by parity of the iteration: what patches exchange; of boundary rows at least

  // -- tissue surface, only for scenes with tools
  const std::uint32_t* triangle_rows;        // [triangle_count, 3]
  const std::uint32_t* triangle_neighbours;  // [triangle_count, 3] over the edges 01, 12, 20; kNoTriangle at a rim
  const std::uint32_t* patch_triangles;      // [patch_count + 1]
  const Real* triangle_area;                 // [triangle_count] m², at rest
  const std::uint32_t* surface_rows;         // [surface vertex], grouped by patch
  const std::uint32_t* patch_surface;        // [patch_count + 1] into surface_rows
  const std::uint32_t* incidence_begin;      // [surface vertex + 1]
  const std::uint32_t* incidence;         // [.., 4]: triangle, corner, slots of the two following corners, or kNoPlace
  const std::uint32_t* vertex_of_corner;  // [triangle_count, 3] surface vertex
  const ToolState<Real>* tools;           // [tool_count]
  ClosestTriangle<Real>* closest;         // [tool_count, patch_count]
  TriangleContact<Real>* contacts;        // [tool_count, triangle_count]
  ToolLoad<Real>* tool_loads;             // [tool_count, patch_count]

  // -- what clients see
  std::uint32_t visible_count;
  const std::uint32_t* visible_rows;  // [visible_count, 4] rows of the element that carries the vertex
  const Real* visible_weights;        // [visible_count, 4]
  float* visible_positions;           // [visible_count, 3] m

  // -- reports
  PatchReport<Real>* patch_reports;  // [patch_count]
  SolveReport<Real>* solve_report;   // [1]
  PatchWatch<Real>* watch;           // [group, patch_count]
  Real* min_det_f;                   // [group, patch_count, parts of a patch], of groups whose volume steps check
  Real* reduction;                   // partial sums of patches, room for [2, patch_count, kPatchSums]
  std::uint32_t* exchange_tags;      // [patch_count] exchanges so far, where cells carry their number (backend/cuda)
};

/// Reals from the sums of one patch to those of the next, at most: every patch polls all of them, and what lies close
/// together comes from few of a device's memory channels.
inline constexpr std::uint32_t kPatchSums = 16;
inline constexpr std::uint32_t kNoTriangle = 0xFFFFFFFFu;
inline constexpr std::uint32_t kNoPlace = 0xFFFFFFFFu;

/// One patch's ranges.
struct Patch : PatchColumns {
  std::uint32_t index;
  std::uint32_t halo_count;
  std::size_t local_begin;  // of its own rows in residual and direction
};

template <class Real>
TM_HOST_DEVICE Patch patch_of(const SceneView<Real>& s, std::uint32_t index) {
  const std::uint32_t rows = s.patch_rows[index], halo = s.patch_halo[index];
  return {{rows, s.patch_rows[index + 1], halo}, index, s.patch_halo[index + 1] - halo, std::size_t{rows} + halo};
}

/// The row of the scene behind a patch-local column.
template <class Real>
TM_HOST_DEVICE std::uint32_t global_row(const SceneView<Real>& s, const PatchColumns& patch, std::uint32_t column) {
  return column < patch.own() ? patch.row_begin + column : s.halo[patch.halo_begin + column - patch.own()];
}

/// Where the 3×3 block of a slot begins; its nine components lie kSliceRows apart.
TM_HOST_DEVICE constexpr std::size_t block_begin(std::size_t slot) {
  return slot / kSliceRows * (9 * kSliceRows) + slot % kSliceRows;
}
template <class Real>
TM_HOST_DEVICE Mat3<Real> load_block(const Real* blocks, std::size_t slot) {
  const Real* p = blocks + block_begin(slot);
  Mat3<Real> m;
  for (int c = 0; c < 9; ++c) m(c / 3, c % 3) = p[c * kSliceRows];
  return m;
}
/// As load_block, of what a step reads once.
template <class Real>
TM_HOST_DEVICE Mat3<Real> load_block_once(const Real* blocks, std::size_t slot) {
  const Real* p = blocks + block_begin(slot);
  Mat3<Real> m;
  for (int c = 0; c < 9; ++c) m(c / 3, c % 3) = read_once(p + c * kSliceRows);
  return m;
}
template <class Real>
TM_HOST_DEVICE void store_block(Real* blocks, std::size_t slot, const Mat3<Real>& m) {
  Real* p = blocks + block_begin(slot);
  for (int c = 0; c < 9; ++c) p[c * kSliceRows] = m(c / 3, c % 3);
}

/// Calls visit(slot, column) for each slot of a row.
template <class Real, class Visit>
TM_HOST_DEVICE void for_each_slot(const SceneView<Real>& s, std::uint32_t row, Visit&& visit) {
  const std::uint32_t slice = row / kSliceRows;
  for (std::uint32_t j = s.slice_begin[slice]; j < s.slice_begin[slice + 1]; ++j) {
    const std::size_t slot = std::size_t{j} * kSliceRows + row % kSliceRows;
    visit(slot, s.columns[slot]);
  }
}

template <class Real>
TM_HOST_DEVICE Vec3<Real> load3(const Real* vectors, std::size_t row) {
  return read3(vectors + 4 * row);
}
template <class Real>
TM_HOST_DEVICE void store3(Real* vectors, std::size_t row, const Vec3<Real>& v) {
  write3(vectors + 4 * row, v);
}
/// Upper triangle of a symmetric block, 8 reals a row: xx xy xz yy yz zz.
template <class Real>
TM_HOST_DEVICE void store_symmetric(Real* diagonal, std::uint32_t row, const Mat3<Real>& m) {
  Real* p = diagonal + std::size_t{8} * row;
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    reinterpret_cast<float4*>(p)[0] = {m(0, 0), m(0, 1), m(0, 2), m(1, 1)};
    reinterpret_cast<float2*>(p)[2] = {m(1, 2), m(2, 2)};
    return;
  }
#endif
  p[0] = m(0, 0);
  p[1] = m(0, 1);
  p[2] = m(0, 2);
  p[3] = m(1, 1);
  p[4] = m(1, 2);
  p[5] = m(2, 2);
}

/// h of the step.
template <class Real>
TM_HOST_DEVICE Real step_size(const SceneView<Real>& s) {
  return s.control->scheme.step_s;
}

/// How far a row moves from `displacement`, where forces are evaluated, to the step's end as `velocity` has it [m].
template <class Real>
TM_HOST_DEVICE Vec3<Real> change_ahead(const SceneView<Real>& s, std::size_t row) {
  const Vec3<Real> ahead = load3<Real>(s.velocity, row) * step_size(s);
  if (s.base_displacement == nullptr) return ahead;
  return load3<Real>(s.base_displacement, row) + ahead - load3<Real>(s.displacement, row);
}

/// Bits of the directions in which a row is free.
template <class Real>
TM_HOST_DEVICE std::uint32_t free_bits(const SceneView<Real>& s, std::size_t row) {
  return static_cast<std::uint32_t>(s.rest[4 * row + 3]);
}

/// Of relative_position, of a row at rest. From a row of the scene, so that wherever that lies, only its size rounds.
template <class Real>
TM_HOST_DEVICE Vec3<Real> relative_rest(const SceneView<Real>& s, std::size_t row) {
  return load3<Real>(s.rest, row) - load3<Real>(s.rest, 0);
}

/// Where a row is now [m].
template <class Real>
TM_HOST_DEVICE Vec3<Real> position(const SceneView<Real>& s, std::size_t row) {
  return load3<Real>(s.rest, row) + load3<Real>(s.displacement, row);
}

}  // namespace tensormass::tensor
