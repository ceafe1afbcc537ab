#pragma once

#include <cmath>

#include "contact/body_contact.h"
#include "contact/edge_contact.h"
#include "view/scene.h"

/// Ties couple bodies within one linear system: contact between bodies, and springs that attach one to another.
///
///   body_contact.h ──> a tie for each node that touches a surface ──┐
///   edge_contact.h ──> a tie for each two sharp edges that touch ───┤
///   springs of attachments ──> a tie each, until it breaks ─────────┴──> list of each row ──> assembly, A p
///
/// 1. A tie has up to four rows: a node, and the corners of a triangle or another node; or the ends of two edges. What
///    a node or an edge touches changes from step to step, while the matrix has fixed edges. So only the diagonal
///    blocks of a tie are added to the matrix. The solve multiplies by the other blocks tie by tie
///    (solver/tie_product.h).
/// 2. Forces on the rows of a tie add up to zero, so contact and attachments keep the momentum of a scene.
/// 3. Each row lists its ties. The lists are made anew for each linearization, by all threads at once, and then sorted:
///    sums repeat bitwise.
namespace tensormass::contact {

/// Calls visit(tie, role) for each tie of a row. role: which of the tie's rows it is.
template <class Real, class Visit>
TM_HOST_DEVICE void for_each_tie(const view::TiesView<Real>& ties, std::uint32_t row, const Visit& visit) {
  for (std::uint32_t entry = ties.head[row]; entry != view::kNoEntry; entry = ties.next[entry]) {
    visit(ties.ties[entry / 4], entry % 4);
  }
}

/// Stage 1, begin ties: empties the lists of rows and puts the boxes around the present surface.
/// Reads displacement; writes head, boxes.
template <class Team, class Real>
TM_HOST_DEVICE void begin_ties(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                               const view::ContactView<Real>& contact, const view::TiesView<Real>& ties) {
  team.for_each(ties.patch_rows[team.patch()], ties.patch_rows[team.patch() + 1],
                [&](std::uint32_t i) { ties.head[ties.rows[i]] = view::kNoEntry; });
  refit_boxes(team, patches, state, contact, ties);
}

/// Puts the rows of a tie into their lists.
template <class Team, class Real>
TM_HOST_DEVICE void list_tie(const Team& team, const view::TiesView<Real>& ties, std::uint32_t place) {
  const view::Tie<Real>& tie = ties.ties[place];
  for (std::uint32_t r = 0; r < 4; ++r) {
    if (tie.weight[r] != 0) ties.next[4 * place + r] = team.replace(ties.head + tie.rows[r], 4 * place + r);
  }
}

/// Makes the tie of a spring that is taut. A ligament only pulls.
///
///   T = k (L − L₀)    tension; L: length now, along e
///   S = k e eᵀ + T / L (I − e eᵀ)
template <class Real>
TM_HOST_DEVICE view::Tie<Real> tie_of_spring(const view::StateView<Real>& state, const view::TiesView<Real>& ties,
                                             std::uint32_t spring) {
  using std::sqrt;
  const std::uint32_t* rows = ties.spring_rows + std::size_t{2} * spring;
  const Real* numbers = ties.spring_numbers + std::size_t{3} * spring;
  const Vec3<Real> way = view::position(state, rows[0]) - view::position(state, rows[1]);
  const Real length = sqrt(way.dot(way)), tension = numbers[0] * (length - numbers[1]);
  view::Tie<Real> tie{{rows[0], rows[1], rows[0], rows[0]}, {1, -1, 0, 0}, {}, {}, 0, 0};
  if (ties.broken[spring] != 0 || !(tension >= 0)) return tie;
  const Vec3<Real> along = unit(way);
  for (int c = 0; c < 3; ++c) {
    tie.normal[c] = along[c];
    tie.force[c] = -tension * along[c];
  }
  tie.stiffness = numbers[0];
  tie.across = length > 0 ? tension / length : numbers[0];
  return tie;
}

/// Stage 2, find ties: finds what each candidate and each sharp edge touches, and which springs are taut.
/// Reads displacement, velocity, boxes, slips, broken; writes ties, head, next.
template <class Team, class Real>
TM_HOST_DEVICE void find_ties(const Team& team, const view::StateView<Real>& state,
                              const view::ContactView<Real>& contact, const view::TiesView<Real>& ties) {
  const auto add = [&](std::uint32_t place, const view::Tie<Real>& tie) {
    ties.ties[place] = tie;
    if (tie.stiffness > 0) list_tie(team, ties, place);
  };
  if (ties.candidate_count > 0) {
    team.for_each(ties.patch_candidates[team.patch()], ties.patch_candidates[team.patch() + 1],
                  [&](std::uint32_t i) { add(i, tie_of_candidate(state, contact, ties, i)); });
  }
  if (ties.spring_count > 0) {
    team.for_each(ties.patch_springs[team.patch()], ties.patch_springs[team.patch() + 1],
                  [&](std::uint32_t i) { add(ties.candidate_count + i, tie_of_spring(state, ties, i)); });
  }
  if (ties.edges.candidate_count > 0) {
    team.for_each(ties.edges.patch_candidates[team.patch()], ties.edges.patch_candidates[team.patch() + 1],
                  [&](std::uint32_t i) {
                    const EdgeTouches<Real> touches = EdgeSearch<Real>(state, ties, i).find();
                    for (std::uint32_t slot = 0; slot < view::kEdgeSlots; ++slot) {
                      const std::uint32_t place = i * view::kEdgeSlots + slot;
                      ties.edges.partners[place] = touches.other[slot];
                      add(ties.first_edge_tie() + place, tie_of_touch(state, ties, i, touches, slot));
                    }
                  });
  }
}

/// Sorts the list of a row by entry: insertion into a list, because most rows have few ties.
template <class Real>
TM_HOST_DEVICE void sort_list(const view::TiesView<Real>& ties, std::uint32_t row) {
  std::uint32_t first = view::kNoEntry;
  for (std::uint32_t entry = ties.head[row]; entry != view::kNoEntry;) {
    const std::uint32_t following = ties.next[entry];
    std::uint32_t* link = &first;
    while (*link < entry) link = ties.next + *link;  // kNoEntry is larger than every entry
    ties.next[entry] = *link;
    *link = entry;
    entry = following;
  }
  ties.head[row] = first;
}

/// Stage 3, assemble ties: adds their forces and the diagonal blocks of their stiffness to the system.
/// Reads ties, velocity; sorts head, next; adds to diagonal, rhs.
template <class Team, class Real>
TM_HOST_DEVICE void assemble_ties(const Team& team, const view::StateView<Real>& state,
                                  const view::MatrixView<Real>& matrix, const view::TiesView<Real>& ties) {
  const Real h = view::step_size(state), factor = view::contact_factor(state);
  team.for_each(ties.patch_rows[team.patch()], ties.patch_rows[team.patch() + 1], [&](std::uint32_t i) {
    const std::uint32_t row = ties.rows[i];
    if (ties.head[row] == view::kNoEntry) return;
    sort_list(ties, row);
    Vec3<Real> force = Vec3<Real>::Zero();
    Mat3<Real> stiffness = Mat3<Real>::Zero();
    for_each_tie(ties, row, [&](const view::Tie<Real>& tie, std::uint32_t role) {
      const Real weight = tie.weight[role];
      force += force_after(tie, [&](std::uint32_t r) { return view::change_ahead_to_end(state, r); }) * weight;
      stiffness += stiffness_of(tie) * (weight * weight);
    });
    view::store3<Real>(matrix.rhs, row, view::load3<Real>(matrix.rhs, row) + force * h);
    Real* d = matrix.diagonal + std::size_t{8} * row;
    for (int r = 0, c = 0; r < 3; ++r) {
      for (int j = r; j < 3; ++j, ++c) d[c] += stiffness(r, j) * factor;
    }
  });
}

/// Stage 4, measure ties: after the solve, breaks springs that are pulled too hard, takes the springs of friction to
/// the end of the step, and reports. Reads ties, displacement, velocity; writes broken, slips, their checkpoints,
/// reports.
template <class Team, class Real>
TM_HOST_DEVICE void measure_ties(Team& team, const view::StateView<Real>& state, const view::TiesView<Real>& ties) {
  const bool saves = state.control->saves_checkpoint != 0;
  const auto change_made = [&](std::uint32_t row) { return view::change_made_to_end(state, row); };
  Real deepest[1] = {0}, counts[4] = {0, 0, 0, 0};  // contacts, broken springs, TieReport::pressed_n and changed_n
  const auto count_force = [&](Real before, Real after) {
    counts[2] += maximum(before, after);
    counts[3] += maximum(before, after) - minimum(before, after);
  };
  if (ties.candidate_count > 0) {
    team.for_each(ties.patch_candidates[team.patch()], ties.patch_candidates[team.patch() + 1], [&](std::uint32_t i) {
      const view::Tie<Real>& tie = ties.ties[i];
      const Vec3<Real> n(tie.normal[0], tie.normal[1], tie.normal[2]);
      const Real pressure = tie.stiffness > 0 ? n.dot(force_after(tie, change_made)) : Real(0);
      const std::size_t slip = std::size_t{4} * i;
      count_force(maximum(ties.slips[slip + 3], Real(0)), maximum(pressure, Real(0)));
      end_contact_friction(state, tie, friction_of(ties, ties.candidates[std::size_t{2} * i + 1]), pressure,
                           ties.slips + slip, ties.checkpoint_slips + slip);
      if (!(pressure > 0)) return;
      counts[0] += 1;
      deepest[0] = maximum(deepest[0], pressure / tie.stiffness);
    });
  }
  if (ties.edges.candidate_count > 0) {
    const std::uint32_t* begin = ties.edges.patch_candidates + team.patch();
    team.for_each(begin[0], begin[1], [&](std::uint32_t i) {
      counts[0] += end_edge_contacts(state, ties, i, change_made, count_force, deepest[0]);
    });
  }
  if (ties.spring_count > 0) {
    team.for_each(ties.patch_springs[team.patch()], ties.patch_springs[team.patch() + 1], [&](std::uint32_t i) {
      const view::Tie<Real>& tie = ties.ties[ties.candidate_count + i];
      if (saves) ties.checkpoint_broken[i] = ties.broken[i];
      if (tie.stiffness > 0) {
        const Vec3<Real> force = force_after(tie, change_made);
        const Real most = ties.spring_numbers[std::size_t{3} * i + 2];
        if (force.dot(force) > most * most) ties.broken[i] = 1;
      }
      counts[1] += ties.broken[i];
    });
  }
  team.patch_reduce(deepest, counts);
  if (team.leads_patch()) ties.reports[team.patch()] = {counts[0], deepest[0], counts[1], counts[2], counts[3]};
}

}  // namespace tensormass::contact
