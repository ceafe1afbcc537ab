#pragma once

#include "contact/links.h"
#include "solver/jacobi_scaling.h"

/// The part of Â p that links contribute (contact/links.h): blocks between rows that the matrix has no edge for.
///
///   q_i += Σ over links of row i  w_i L_i⁻¹ (h² S) Σ_{j ≠ i} w_j L_j⁻ᵀ p_j       w, S: weights and stiffness of a link
///
/// The blocks with j = i are in the matrix's diagonal. A row of the link may belong to another patch, which need not be
/// a neighbour, so p is read where its owner keeps it.
namespace tensormass::solver {

/// Adds to the rows of one patch.
///
///   direction   p as stored patch by patch (SolveView::direction); all patches have written theirs
///   product     [row_count, 4] Â p without links
///   pq, qq      sums of the calling thread, to which the change of p·q and q·q is added
template <class Team, class Real>
TM_HOST_DEVICE void add_link_product(const Team& team, const view::StateView<Real>& state,
                                     const view::MatrixView<Real>& matrix, const view::LinksView<Real>& links,
                                     const Real* direction, Real* product, Real& pq, Real& qq) {
  const auto unscaled_direction = [&](std::uint32_t row) -> Vec3<Real> {
    return load_lower<Real>(matrix.diagonal, row).transpose() * view::load3<Real>(direction, links.row_place[row]);
  };
  team.for_each(links.patch_rows[team.patch()], links.patch_rows[team.patch() + 1], [&](std::uint32_t i) {
    const std::uint32_t row = links.rows[i];
    if (links.head[row] == view::kNoEntry) return;
    Vec3<Real> sum = Vec3<Real>::Zero();
    contact::for_each_link(links, row, [&](const view::Link<Real>& link, std::uint32_t role) {
      const Vec3<Real> others = contact::relative(link, role, unscaled_direction);
      sum += contact::stiffness_times(link, others) * link.weight[role];
    });
    const Vec3<Real> more = load_lower<Real>(matrix.diagonal, row) * sum * view::contact_factor(state);
    const Vec3<Real> q = view::load3<Real>(product, row);
    view::store3<Real>(product, row, q + more);
    pq += view::load3<Real>(direction, links.row_place[row]).dot(more);
    qq += more.dot(2 * q + more);
  });
}

}  // namespace tensormass::solver
