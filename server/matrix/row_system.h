#pragma once

#include "view/matrix.h"
#include "view/newton.h"
#include "view/state.h"

/// The linear system of one implicit step, row by row.
///
///   u, v            displacement and velocity now             view/state.h defines these
///   u', v'          the same at the end of the step
///   û, v̂, h         base displacement, base velocity, effective step
///   f, f_ext        forces of the elements at u; gravity and loads
///   M               mass
///   K = −∂f/∂u      stiffness; K_kl is its 3×3 block for the rows k and l (an edge tensor)
///   α, β            Rayleigh damping, C = α M + β K
///   d = û + h v − u   how far v still moves the rows from u
///
/// The step must satisfy
///
///   u' = û + h v',   M (v' − v̂) / h = f(u') + f_ext − α M v' − β K v'
///
/// The elements are evaluated at u. Linearized about u and about any velocity v, the step becomes
///
///   A (v' − v) = b,   A = (1 + α h) M + h (β + h) K
///                     b = h (f + f_ext − α M v − K (β v + d)) + M (v̂ − v)
///
/// 1. Implicit Euler has û = u and v̂ = v. The system is then that of Baraff and Witkin 1998.
/// 2. In a later Newton iteration d = 0, and b is the residual.
/// 3. A rigid translation causes no force, so the diagonal tensor is K_kk = −Σ K_kl over the row's edges. Only edge
///    tensors are summed, and K d of a row is the sum of K_kl (d_l − d_k).
/// 4. Edge tensors of linear laws are constant and stored. The others are *refreshed*: evaluated in each step, or kept
///    for some steps (lagged_tangents.h).
namespace tensormass::matrix {

using namespace view;

/// The factors of M and K for one row. Neighbours belong to the same body and have its damping, so a row's factors hold
/// for all of its blocks.
template <class Real>
struct RowTerms {
  const view::StateView<Real>& state;
  Real h, mass, alpha, beta;

  TM_HOST_DEVICE RowTerms(const view::StateView<Real>& of_state, std::size_t row)
      : state(of_state),
        h(step_size(of_state)),
        mass(of_state.inertia[4 * row]),
        alpha(of_state.inertia[4 * row + 1]),
        beta(of_state.inertia[4 * row + 2]) {}

  /// Factor of M in A.
  TM_HOST_DEVICE Real mass_share() const { return 1 + alpha * h; }
  /// Factor of K in A [s²].
  TM_HOST_DEVICE Real stiffness_share() const { return h * (beta + h); }
  /// What M multiplies in b: v̂ − v − α h v of any row of the body [m/s].
  TM_HOST_DEVICE Vec3<Real> momentum_gap(std::size_t row) const {
    const Vec3<Real> velocity = load3<Real>(state.velocity, row);
    const Vec3<Real> lost = velocity * (-alpha * h);
    if (state.base_velocity == nullptr) return lost;
    return lost + load3<Real>(state.base_velocity, row) - velocity;
  }
  /// What K multiplies in b: β v + d of any row of the body [m].
  TM_HOST_DEVICE Vec3<Real> stretch_ahead(std::size_t row) const {
    return change_ahead(state, row) + load3<Real>(state.velocity, row) * beta;
  }
};

/// The sums from which a row of A and b follows.
template <class Real>
struct RowSums {
  Vec3<Real> force = Vec3<Real>::Zero();            // f [N]
  Mat3<Real> vertex = Mat3<Real>::Zero();           // K_kk [N/m]
  Vec3<Real> stiffness_ahead = Vec3<Real>::Zero();  // K (β v + d) [N]
  Vec3<Real> momentum = Vec3<Real>::Zero();         // Σ M_kl momentum_gap(l) over the neighbours [N s]
};

/// Forms one row of A and b from the edge tensors K_kl of its slots.
/// HasConstant: there are constant tensors, or kept ones.
template <bool HasConstant, class Real>
class RowAssembly {
 public:
  /// Reads the data of the row itself, so that nothing waits for it later.
  TM_HOST_DEVICE RowAssembly(const view::PatchesView& patches, const view::StateView<Real>& state,
                             const view::MatrixView<Real>& matrix, const view::NewtonView<Real>& newton,
                             const PatchColumns& patch, std::uint32_t row)
      : patches_(patches),
        state_(state),
        matrix_(matrix),
        newton_(newton),
        patch_(patch),
        row_(row),
        terms_(state, row),
        displacement_(load3<Real>(state.displacement, row)),
        own_ahead_(terms_.stretch_ahead(row)),
        momentum_gap_(terms_.momentum_gap(row)),
        external_(state.external != nullptr ? load3<Real>(state.external, row) : Vec3<Real>(Vec3<Real>::Zero())) {}

  /// Data of the row behind a slot, which couple() needs. They are read before the refreshed tensors, so that the reads
  /// overlap.
  struct Neighbour {
    std::uint32_t row;
    Vec3<Real> ahead;  // stretch_ahead of that row
    // Set only with constant or kept tensors:
    Vec3<Real> stretch;   // u_l − u_k
    Mat3<Real> constant;  // K_kl of linear laws, and that of lagged tangents
  };
  TM_HOST_DEVICE Neighbour neighbour(std::size_t slot) const {
    Neighbour out;
    out.row = global_row(patches_, patch_, matrix_.columns[slot]);
    out.ahead = terms_.stretch_ahead(out.row);
    if constexpr (HasConstant) {
      out.stretch = load3<Real>(state_.displacement, out.row) - displacement_;
      if (matrix_.constant_edges != nullptr) {
        out.constant = load_block_once(matrix_.constant_edges, slot);
        if (matrix_.kept_edges != nullptr) out.constant += load_block_once(matrix_.kept_edges, slot);
      } else {
        out.constant = load_block_once(matrix_.kept_edges, slot);
      }
    }
    return out;
  }
  /// Reads them likewise, for a caller that already has `ahead` and no constant tensors.
  TM_HOST_DEVICE Neighbour neighbour(std::size_t slot, const Vec3<Real>& ahead) const {
    static_assert(!HasConstant);
    Neighbour out;
    out.row = matrix_.mass_edges != nullptr ? global_row(patches_, patch_, matrix_.columns[slot]) : 0;
    out.ahead = ahead;
    return out;
  }
  /// Adds the neighbour's part to the sums and returns the block A_kl.
  /// edge: K_kl of the refreshed elements.
  TM_HOST_DEVICE Mat3<Real> couple(std::size_t slot, const Neighbour& neighbour, Mat3<Real> edge,
                                   RowSums<Real>& sums) const {
    if constexpr (HasConstant) {
      sums.force -= neighbour.constant * neighbour.stretch;
      edge += neighbour.constant;
    }
    sums.vertex -= edge;
    sums.stiffness_ahead += edge * (neighbour.ahead - own_ahead_);
    edge *= terms_.stiffness_share();
    if (matrix_.mass_edges != nullptr) {
      const Real shared = matrix_.mass_edges[slot];
      edge += Mat3<Real>::Identity() * (shared * terms_.mass_share());
      sums.momentum += terms_.momentum_gap(neighbour.row) * shared;
    }
    return edge;
  }
  /// Writes the row's diagonal block and right-hand side. sums: complete, from all of its slots.
  TM_HOST_DEVICE void finish(const RowSums<Real>& sums) const {
    const Mat3<Real> diagonal =
        sums.vertex * terms_.stiffness_share() + Mat3<Real>::Identity() * (terms_.mass * terms_.mass_share());
    store_symmetric(matrix_.diagonal, row_, diagonal);
    const Vec3<Real> momentum = sums.momentum + momentum_gap_ * terms_.mass;
    const Vec3<Real> force = sums.force - sums.stiffness_ahead + external_;
    store3<Real>(matrix_.rhs, row_, force * terms_.h + momentum);
    if (newton_.internal_force != nullptr) store3<Real>(newton_.internal_force, row_, sums.force);
  }

 private:
  const view::PatchesView& patches_;
  const view::StateView<Real>& state_;
  const view::MatrixView<Real>& matrix_;
  const view::NewtonView<Real>& newton_;
  const PatchColumns& patch_;
  const std::uint32_t row_;
  const RowTerms<Real> terms_;
  const Vec3<Real> displacement_, own_ahead_, momentum_gap_, external_;
};

}  // namespace tensormass::matrix
