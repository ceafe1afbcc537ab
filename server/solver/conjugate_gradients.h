#pragma once

#include <cmath>

#include "matrix/edges.h"
#include "solver/coarse_level.h"
#include "solver/link_product.h"
#include "solver/vector_updates.h"
#include "view/scene.h"

/// Conjugate gradients on Â x = b̂, written for one patch. Each iteration communicates once.
///
///   Â, b̂, x   the scaled system and its solution (jacobi_scaling.h); Â has unit diagonal blocks
///   r         residual b̂ − Â x                 r'  the residual after the update
///   p         search direction                 q   Â p
///   α         r·r / p·q, the step along p:     x += α p,  r' = r − α q
///   β         r'·r' / r·r, next direction:     p' = r' + β p
///
///   start: x = 0, r = b̂, p = x of the last step
///
///   own rows: q = Â p ──> exchange q, p·q, q·q, r·r ──> α, β ──┬──> own rows: update x, r, p ──> next iteration
///                                                              └──> halo:     update r, p
///
/// 1. A patch needs q on its halo, and every patch needs the same three sums. One exchange carries both.
/// 2. Each patch also updates r and p of its halo, redundantly. So p needs no exchange of its own.
/// 3. β needs r'·r' in the same iteration. It follows from the sums at hand: r'·r' = r·r − 2α p·q + α² q·q. So β needs
///    no second exchange.
/// 4. r·r itself is summed afresh in every iteration, which keeps the recurrence from drifting (Saad 1985; Meurant
///    1987).
/// 5. Links couple rows of patches that need not be neighbours (link_product.h). A scene with links has a second
/// barrier
///    in each iteration, before p of other patches is read.
/// 6. Sums run in a fixed order: results repeat bitwise for the same number of patches.
/// 7. The first iteration searches along the last step's solution, with α = p·r / p·q and β = 0. Successive steps
///    resemble each other, so it brings the solve as far as many iterations do. Then conjugate gradients start at
///    p = r. docs/decisions/preconditioner.md has the gain, and says why x does not start at that solution itself.
///    A step after one of another length has no such solution, nor has the first step of a scene: p = b̂ there.
/// 8. A coarse level (coarse_level.h) preconditions a solve that would take many iterations. Then z = r + Ẑ E⁻¹ Ẑᵀ r
///    replaces r in α, β and p, and c = Ẑᵀ r, y = E⁻¹ c, d = Ẑᵀ q:
///
///      α   r·z / p·q             r·z = r·r + c·y       r'·r' = r·r − 2α r·q + α² q·q,  r·q = p·q − y·d
///      β   r'·z' / r·z           p' = r' + Ẑ y' + β p
///
///    The solve then ends at a fraction of √(r·z), the residual's M⁻¹ norm. That is close to the error's energy norm,
///    where √(r·r) says nothing about smooth errors: a slender body may still be half off.
namespace tensormass::solver {

/// Returns where the solution of the last step is, [row_count, 4], in units of Â's system.
template <class Real>
TM_HOST_DEVICE const Real* last_solution(const view::PatchesView& patches, const view::StateView<Real>& state,
                                         const view::SolveView<Real>& solve) {
  return solve.kept + std::size_t{4} * patches.row_count * state.control->last_solution;
}
/// Keeps the solution of a row for the next step. Call when every patch has read `last_solution`.
template <class Real>
TM_HOST_DEVICE void keep_solution(const view::PatchesView& patches, const view::StateView<Real>& state,
                                  const view::SolveView<Real>& solve, std::uint32_t row, const Vec3<Real>& x) {
  if (solve.kept == nullptr) return;
  view::store3<Real>(solve.kept + std::size_t{4} * patches.row_count * state.control->next_solution, row, x);
}

/// The scalars of the iteration: α, β and when it ends. They are the same in every patch.
template <class Real>
class Recurrence {
 public:
  TM_HOST_DEVICE Recurrence(const view::StateView<Real>& state, const view::SolveView<Real>& solve)
      : tolerance_squared_(solve.cg_tolerance * solve.cg_tolerance),
        max_iterations_(state.control->cg_max_iterations),
        starts_from_last_(may_start_from_last(state)) {}

  /// Whether a solve starts from the last step's solution. If it has one iteration only, that must be a search along
  /// the residual.
  TM_HOST_DEVICE static bool may_start_from_last(const view::StateView<Real>& state) {
    return state.control->starts_from_last != 0 && state.control->cg_max_iterations > 1;
  }
  /// Whether the coming iteration searches along the last step's solution.
  TM_HOST_DEVICE bool is_along_last() const { return starts_from_last_ && iterations_ == 0; }

  /// Takes the sums of an iteration and computes α and β. Returns false if the solve must end without an update: the
  /// residual is zero or not a number, or the curvature p·q is not positive.
  /// qq: p·r instead, if the iteration is along the last step's solution.
  TM_HOST_DEVICE bool take(Real pq, Real qq, Real rr) {
    if (iterations_ == 0) first_rr_ = rr_next_ = rr;
    if (!(rr > 0)) return false;  // solved exactly, or not a number
    if (is_along_last()) {
      alpha_ = pq > 0 ? quotient(qq, pq) : Real(0);
      beta_ = 0;
      gained_ += alpha_ * qq;
      ++iterations_;
      return true;
    }
    if (starts_from_last_ && iterations_ == 1) {
      rr_next_ = rr;
      if (!goes_on()) return false;  // the last step's solution was good enough
    }
    if (!(pq > 0)) {
      negative_curvature_ = pq != 0;  // zero: the residual is so small that products underflow
      return false;
    }
    alpha_ = quotient(rr, pq);
    rr_next_ = maximum(rr - 2 * alpha_ * pq + alpha_ * alpha_ * qq, Real(0));
    beta_ = quotient(rr_next_, rr);
    gained_ += alpha_ * rr;
    ++iterations_;
    return true;
  }
  /// Does what `take` does in a solve with a coarse level. `finish` then computes β.
  /// cy: c · y. yd: y · d. Neither counts along the last step's solution.
  TM_HOST_DEVICE bool take(Real pq, Real qq, Real rr, Real cy, Real yd) {
    searches_coarse_ = !is_along_last();
    rz_ = rr + cy;
    if (!take(pq, qq, rz_)) return false;
    if (searches_coarse_) plain_rr_next_ = maximum(rr - 2 * alpha_ * (pq - yd) + alpha_ * alpha_ * qq, Real(0));
    return true;
  }
  /// Computes β of a solve with a coarse level, and what `goes_on` tests: r·z instead of r·r. cy: c' · y'.
  TM_HOST_DEVICE void finish(Real cy) {
    if (!searches_coarse_) return;
    rr_next_ = plain_rr_next_ + cy;
    beta_ = quotient(rr_next_, rz_);
  }
  /// Whether another iteration is needed. Call after an update. The solve ends when ‖r'‖ has fallen to `cg_tolerance`
  /// ‖b̂‖.
  TM_HOST_DEVICE bool goes_on() const {
    return iterations_ < max_iterations_ && !(rr_next_ <= tolerance_squared_ * first_rr_);
  }
  /// Reports the energy that the solve has gained, at the iterations at which missing_energy.h needs it. One thread
  /// must call it after each update.
  TM_HOST_DEVICE void report_gain(const view::SolveView<Real>& solve) const {
    if (iterations_ == max_iterations_ / 2) solve.report->gained_energy[0] = gained_;
    if (iterations_ == max_iterations_ - max_iterations_ / 4) solve.report->gained_energy[1] = gained_;
  }
  TM_HOST_DEVICE void report(const view::SolveView<Real>& solve) const {
    using std::sqrt;
    solve.report->relative_residual = first_rr_ == 0 ? Real(0) : sqrt(rr_next_ / first_rr_);
    solve.report->iterations = iterations_;
    solve.report->negative_curvature = negative_curvature_ ? 1 : 0;
    solve.report->gained_energy[2] = gained_;
  }

  TM_HOST_DEVICE Real alpha() const { return alpha_; }
  TM_HOST_DEVICE Real beta() const { return beta_; }
  TM_HOST_DEVICE std::uint32_t iterations() const { return iterations_; }

 private:
  Real tolerance_squared_;
  std::uint32_t max_iterations_;
  bool starts_from_last_;
  Real alpha_ = 0, beta_ = 0, first_rr_ = 0, rr_next_ = 0;
  Real gained_ = 0;  // x·Âx: each iteration adds α r·r, or α p·r along the last step's solution
  std::uint32_t iterations_ = 0;
  bool negative_curvature_ = false;
  // Only of a solve with a coarse level.
  Real rz_ = 0, plain_rr_next_ = 0;  // r·z, and r'·r'
  bool searches_coarse_ = false;     // this iteration is not along the last step's solution
};

/// Solves Â x = b̂. The system must be scaled: `edges` holds Â, `rhs` holds b̂.
/// coarse: the patch's CoarseLevel, or NoCoarseLevel.
/// Reads edges, diagonal, rhs, kept, links; writes solution, kept, residual, direction, product, own_product,
/// reduction, solve_report.
template <class Team, class Real, class Coarse>
TM_FLATTEN TM_HOST_DEVICE void conjugate_gradients(Team& team, const view::PatchesView& patches,
                                                   const view::StateView<Real>& state,
                                                   const view::MatrixView<Real>& matrix,
                                                   const view::SolveView<Real>& solve,
                                                   const view::LinksView<Real>& links,
                                                   [[maybe_unused]] Coarse& coarse) {
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  const view::Patch patch = view::patch_of(patches, team.patch());
  Real* r = solve.residual + 4 * patch.local_begin;
  Real* p = solve.direction + 4 * patch.local_begin;

  const bool starts_from_last = Recurrence<Real>::may_start_from_last(state);
  const auto start_from = [&](std::uint32_t local, std::uint32_t row) {
    const Real* b = matrix.rhs + std::size_t{4} * row;
    const Real* start = starts_from_last ? last_solution(patches, state, solve) + std::size_t{4} * row : b;
    for (int c = 0; c < 4; ++c) {
      // The fourth component is padding. It must be zero even if an earlier solve has left NaN there.
      r[std::size_t{4} * local + c] = c < 3 ? b[c] : Real(0);
      p[std::size_t{4} * local + c] = c < 3 ? start[c] : Real(0);
    }
  };
  team.for_each(0, patch.own(), [&](std::uint32_t local) {
    const std::size_t row = std::size_t{patch.row_begin} + local;
    start_from(local, patch.row_begin + local);
    for (int c = 0; c < 4; ++c) {
      solve.solution[4 * row + c] = 0;
      if (matrix::stores_edges(matrix)) solve.own_product[4 * row + c] = 0;
    }
  });
  team.for_each(0, patch.halo_count,
                [&](std::uint32_t h) { start_from(patch.own() + h, patches.halo[patch.halo_begin + h]); });
  team.sync();
  if constexpr (Coarse::kExists) {
    coarse.begin(state, matrix, r);
    if (!starts_from_last) coarse.add_modes(p);
  }

  // r·r of the own rows is summed where r is computed: here, and in each update.
  T sum_rr = T(0), sum_pr = T(0);
  team.template for_lanes<Lanes::kWidth>(0, 4 * patch.own(), [&](std::uint32_t c) {
    const T residual = Lanes::load(r + c);
    sum_rr += residual * residual;
    sum_pr += residual * Lanes::load(p + c);
  });
  Recurrence<Real> recurrence(state, solve);
  do {
    const std::uint32_t iteration = recurrence.iterations();
    Real* product = solve.product + std::size_t{iteration & 1} * 4 * patches.row_count;
    Real* own_product = product + std::size_t{4} * patch.row_begin;
    T sum_pq = T(0), sum_qq = T(0);
    Real link_pq = 0, link_qq = 0;
    const bool has_links = links.count() > 0;
    if (has_links) team.meet();
    if constexpr (requires { Team::kOneThread; }) {
      if (matrix::stores_edges(matrix)) {
        own_product = solve.own_product + std::size_t{4} * patch.row_begin;
        matrix::multiply_edges<Lanes>(matrix, patch, p, own_product);
        if constexpr (Coarse::kExists) coarse.correct(p, own_product);
        if (has_links) {
          add_link_product(team, state, matrix, links, solve.direction, solve.own_product, link_pq, link_qq);
          link_pq = link_qq = 0;  // the next line sums them
        }
        matrix::publish_product<Lanes>(matrix, patch, p, own_product, product, sum_pq, sum_qq);
      }
    }
    if (!matrix::stores_edges(matrix)) {
      team.template for_lanes<Lanes::kWidth>(0, patch.own(), [&](std::uint32_t local) {
        const std::uint32_t row = patch.row_begin + local;
        const std::uint32_t slice = row / view::kSliceRows, lane = row % view::kSliceRows;
        const Vec3<T> own = Lanes::load3(p, local);
        Vec3<T> q = own;
        TM_UNROLL(4)
        for (std::uint32_t j = matrix.slice_begin[slice]; j < matrix.slice_begin[slice + 1]; ++j) {
          const Real* block = matrix.edges + std::size_t{j} * (9 * view::kSliceRows) + lane;
          const Vec3<T> x = Lanes::gather3(p, matrix.columns + std::size_t{j} * view::kSliceRows + lane);
          for (int i = 0; i < 3; ++i) {
            for (int c = 0; c < 3; ++c) q[i] += Lanes::load(block + (3 * i + c) * view::kSliceRows) * x[c];
          }
        }
        if constexpr (requires { coarse.correct(row, own, q); }) coarse.correct(row, own, q);
        Lanes::store3(product, row, q);
        sum_pq += own[0] * q[0] + own[1] * q[1] + own[2] * q[2];
        sum_qq += q[0] * q[0] + q[1] * q[1] + q[2] * q[2];
      });
      if (has_links) {
        team.sync();
        add_link_product(team, state, matrix, links, solve.direction, product, link_pq, link_qq);
      }
    }
    const bool along_last = recurrence.is_along_last();
    if constexpr (Coarse::kExists) coarse.publish(r, own_product, iteration);
    Real sums[3] = {Lanes::sum(sum_pq) + link_pq, along_last ? Lanes::sum(sum_pr) : Lanes::sum(sum_qq) + link_qq,
                    Lanes::sum(sum_rr)};
    team.exchange(sums, solve.reduction + std::size_t{iteration & 1} * 4 * patches.patch_count);
    if constexpr (Coarse::kExists) {
      coarse.receive(iteration);
      if (!recurrence.take(sums[0], sums[1], sums[2], coarse.cy(), coarse.yd())) break;
      coarse.advance(recurrence.alpha());
      recurrence.finish(coarse.cy());
    } else {
      if (!recurrence.take(sums[0], sums[1], sums[2])) break;
    }
    const Real alpha = recurrence.alpha(), beta = recurrence.beta();
    // Component by component: a row has four, and the fourth stays zero.
    sum_rr = T(0);
    team.template for_lanes<Lanes::kWidth>(0, 4 * patch.own(), [&](std::uint32_t c) {
      const std::size_t of_scene = std::size_t{4} * patch.row_begin + c;
      const T direction = Lanes::load(p + c);
      const T residual = next_residual(Lanes::load(r + c), Lanes::load(own_product + c), T(alpha));
      const T solution = next_solution(Lanes::load(solve.solution + of_scene), direction, T(alpha));
      Lanes::store(solve.solution + of_scene, solution);
      Lanes::store(r + c, residual);
      Lanes::store(p + c, next_direction(residual, direction, T(beta)));
      sum_rr += residual * residual;
      if (matrix::stores_edges(matrix)) Lanes::store(own_product + c, T(0));  // multiply_edges adds to it
    });
    team.for_each(0, patch.halo_count, [&](std::uint32_t h) {
      const std::uint32_t local = patch.own() + h;
      const Vec3<Real> q = view::load3<Real>(product, patches.halo[patch.halo_begin + h]);
      const Vec3<Real> residual = next_residual(view::load3<Real>(r, local), q, alpha);
      view::store3<Real>(r, local, residual);
      view::store3<Real>(p, local, next_direction(residual, view::load3<Real>(p, local), beta));
    });
    if constexpr (Coarse::kExists) coarse.add_modes(p);
    if (team.leads()) recurrence.report_gain(solve);
    team.sync();
  } while (recurrence.goes_on());

  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    keep_solution(patches, state, solve, row, view::load3<Real>(solve.solution, row));
  });
  if (team.leads()) recurrence.report(solve);
}

/// Solves it without a coarse level.
template <class Team, class Real>
TM_HOST_DEVICE void conjugate_gradients(Team& team, const view::PatchesView& patches,
                                        const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                        const view::SolveView<Real>& solve, const view::LinksView<Real>& links) {
  NoCoarseLevel none;
  conjugate_gradients(team, patches, state, matrix, solve, links, none);
}

}  // namespace tensormass::solver
