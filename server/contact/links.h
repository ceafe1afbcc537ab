#pragma once

#include <cmath>

#include "contact/blades.h"
#include "contact/body_contact.h"
#include "contact/edge_contact.h"
#include "contact/severing.h"
#include "view/scene.h"

/// Links couple bodies within one linear system: contact between bodies, and springs that attach one to another.
///
///   body_contact.h ──> a link for each node that touches a surface ──┐
///   edge_contact.h ──> a link for each two sharp edges that touch ───┤
///   springs of attachments ──> a link each, until it breaks ─────────┤
///   blades.h ──> two links for each blade point that holds tissue ───┴──> list of each row ──> assembly, A p
///
/// 1. A link has up to four rows: a node, and the corners of a triangle or another node; or the ends of two edges. What
///    a node or an edge touches changes from step to step, while the matrix has fixed edges. So only the diagonal
///    blocks of a link are added to the matrix. The solve multiplies by the other blocks link by link
///    (solver/link_product.h).
/// 2. Forces on the rows of a link add up to zero, so contact and attachments keep the momentum of a scene. Those of a
///    pin add up to what the blade exerts.
/// 3. Each row lists its links. The lists are made anew for each linearization, by all threads at once, and then
/// sorted:
///    sums repeat bitwise.
namespace tensormass::contact {

/// Calls visit(link, role) for each link of a row. role: which of the link's rows it is.
template <class Real, class Visit>
TM_HOST_DEVICE void for_each_link(const view::LinksView<Real>& links, std::uint32_t row, const Visit& visit) {
  for (std::uint32_t entry = links.head[row]; entry != view::kNoEntry; entry = links.next[entry]) {
    visit(links.links[entry / 4], entry % 4);
  }
}

/// Stage 1, begin links: empties the lists of rows and puts the boxes around the present surface.
/// Reads displacement; writes head, boxes.
template <class Team, class Real>
TM_HOST_DEVICE void begin_links(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                                const view::ContactView<Real>& contact, const view::LinksView<Real>& links) {
  team.for_each(links.patch_rows[team.patch()], links.patch_rows[team.patch() + 1],
                [&](std::uint32_t i) { links.head[links.rows[i]] = view::kNoEntry; });
  refit_boxes(team, patches, state, contact, links);
}

/// Puts the rows of a link into their lists.
template <class Team, class Real>
TM_HOST_DEVICE void list_link(const Team& team, const view::LinksView<Real>& links, std::uint32_t place) {
  const view::Link<Real>& link = links.links[place];
  for (std::uint32_t r = 0; r < 4; ++r) {
    if (link.weight[r] != 0) links.next[4 * place + r] = team.replace(links.head + link.rows[r], 4 * place + r);
  }
}

/// Makes the link of a spring that is taut. A ligament only pulls.
///
///   T = k (L − L₀)    tension; L: length now, along e
///   S = k e eᵀ + T / L (I − e eᵀ)
template <class Real>
TM_HOST_DEVICE view::Link<Real> link_of_spring(const view::StateView<Real>& state, const view::LinksView<Real>& links,
                                               std::uint32_t spring) {
  using std::sqrt;
  const std::uint32_t* rows = links.spring_rows + std::size_t{2} * spring;
  const Real* numbers = links.spring_numbers + std::size_t{3} * spring;
  const Vec3<Real> way = view::position(state, rows[0]) - view::position(state, rows[1]);
  const Real length = sqrt(way.dot(way)), tension = numbers[0] * (length - numbers[1]);
  view::Link<Real> link{{rows[0], rows[1], rows[0], rows[0]}, {1, -1, 0, 0}, {}, {}, 0, 0};
  if (links.broken[spring] != 0 || !(tension >= 0)) return link;
  const Vec3<Real> along = unit(way);
  for (int c = 0; c < 3; ++c) {
    link.normal[c] = along[c];
    link.force[c] = -tension * along[c];
  }
  link.stiffness = numbers[0];
  link.across = length > 0 ? tension / length : numbers[0];
  return link;
}

/// Stage 2, find links: finds what each candidate and each sharp edge touches, which springs are taut, and which blade
/// points hold tissue. Reads displacement, velocity, boxes, slips, broken, tools; writes links, head, next, slips.
template <class Team, class Real>
TM_HOST_DEVICE void find_links(const Team& team, const view::StateView<Real>& state,
                               const view::ContactView<Real>& contact, const view::LinksView<Real>& links) {
  const auto add = [&](std::uint32_t place, const view::Link<Real>& link) {
    links.links[place] = link;
    if (link.stiffness > 0) list_link(team, links, place);
  };
  if (links.candidate_count > 0) {
    team.for_each(links.patch_candidates[team.patch()], links.patch_candidates[team.patch() + 1],
                  [&](std::uint32_t i) { add(i, link_of_candidate(state, contact, links, i)); });
  }
  if (links.spring_count > 0) {
    team.for_each(links.patch_springs[team.patch()], links.patch_springs[team.patch() + 1],
                  [&](std::uint32_t i) { add(links.candidate_count + i, link_of_spring(state, links, i)); });
  }
  if (team.patch() == 0) {
    team.for_each(0, links.blades.point_count, [&](std::uint32_t i) {
      const PinLinks<Real> pin = links_of_pin(state, contact, links.blades, i);
      const std::uint32_t place = links.first_pin() + view::kPinLinks * i;
      add(place, pin.cuts);
      add(place + 1, pin.sideways);
    });
  }
  if (links.edges.candidate_count > 0) {
    team.for_each(links.edges.patch_candidates[team.patch()], links.edges.patch_candidates[team.patch() + 1],
                  [&](std::uint32_t i) {
                    const EdgeTouches<Real> touches = EdgeSearch<Real>(state, links, i).find();
                    for (std::uint32_t slot = 0; slot < view::kEdgeSlots; ++slot) {
                      const std::uint32_t place = i * view::kEdgeSlots + slot;
                      links.edges.partners[place] = touches.other[slot];
                      add(links.first_edge_link() + place, link_of_touch(state, links, i, touches, slot));
                    }
                  });
  }
}

/// Sorts the list of a row by entry: insertion into a list, because most rows have few links.
template <class Real>
TM_HOST_DEVICE void sort_list(const view::LinksView<Real>& links, std::uint32_t row) {
  std::uint32_t first = view::kNoEntry;
  for (std::uint32_t entry = links.head[row]; entry != view::kNoEntry;) {
    const std::uint32_t following = links.next[entry];
    std::uint32_t* link = &first;
    while (*link < entry) link = links.next + *link;  // kNoEntry is larger than every entry
    links.next[entry] = *link;
    *link = entry;
    entry = following;
  }
  links.head[row] = first;
}

/// Stage 3, assemble links: adds their forces and the diagonal blocks of their stiffness to the system.
/// Reads links, velocity; sorts head, next; adds to diagonal, rhs.
template <class Team, class Real>
TM_HOST_DEVICE void assemble_links(const Team& team, const view::StateView<Real>& state,
                                   const view::MatrixView<Real>& matrix, const view::LinksView<Real>& links) {
  const Real h = view::step_size(state), factor = view::contact_factor(state);
  team.for_each(links.patch_rows[team.patch()], links.patch_rows[team.patch() + 1], [&](std::uint32_t i) {
    const std::uint32_t row = links.rows[i];
    if (links.head[row] == view::kNoEntry) return;
    sort_list(links, row);
    Vec3<Real> force = Vec3<Real>::Zero();
    Mat3<Real> stiffness = Mat3<Real>::Zero();
    for_each_link(links, row, [&](const view::Link<Real>& link, std::uint32_t role) {
      const Real weight = link.weight[role];
      force += force_after(link, [&](std::uint32_t r) { return view::change_ahead_to_end(state, r); }) * weight;
      stiffness += stiffness_of(link) * (weight * weight);
    });
    view::store3<Real>(matrix.rhs, row, view::load3<Real>(matrix.rhs, row) + force * h);
    Real* d = matrix.diagonal + std::size_t{8} * row;
    for (int r = 0, c = 0; r < 3; ++r) {
      for (int j = r; j < 3; ++j, ++c) d[c] += stiffness(r, j) * factor;
    }
  });
}

/// Stage 4, measure links: after the solve, breaks springs that are pulled too hard or that a tool severs, takes the
/// springs of friction and the anchors of blades to the end of the step, and reports. Reads links, displacement,
/// velocity, tools; writes broken, slips, their checkpoints, reports, tool_loads of blades.
template <class Team, class Real>
TM_HOST_DEVICE void measure_links(Team& team, const view::StateView<Real>& state,
                                  const view::ContactView<Real>& contact, const view::LinksView<Real>& links) {
  const bool saves = state.control->saves_checkpoint != 0;
  const auto change_made = [&](std::uint32_t row) { return view::change_made_to_end(state, row); };
  Real deepest[1] = {0}, counts[4] = {0, 0, 0, 0};  // contacts, broken springs, LinkReport::pressed_n and changed_n
  const auto count_force = [&](Real before, Real after) {
    counts[2] += maximum(before, after);
    counts[3] += maximum(before, after) - minimum(before, after);
  };
  if (links.candidate_count > 0) {
    team.for_each(links.patch_candidates[team.patch()], links.patch_candidates[team.patch() + 1], [&](std::uint32_t i) {
      const view::Link<Real>& link = links.links[i];
      const Vec3<Real> n(link.normal[0], link.normal[1], link.normal[2]);
      const Real pressure = link.stiffness > 0 ? n.dot(force_after(link, change_made)) : Real(0);
      const std::size_t slip = std::size_t{4} * i;
      count_force(maximum(links.slips[slip + 3], Real(0)), maximum(pressure, Real(0)));
      end_contact_friction(state, link, friction_of(links, links.candidates[std::size_t{2} * i + 1]), pressure,
                           links.slips + slip, links.checkpoint_slips + slip);
      if (!(pressure > 0)) return;
      counts[0] += 1;
      deepest[0] = maximum(deepest[0], pressure / link.stiffness);
    });
  }
  if (links.edges.candidate_count > 0) {
    const std::uint32_t* begin = links.edges.patch_candidates + team.patch();
    team.for_each(begin[0], begin[1], [&](std::uint32_t i) {
      counts[0] += end_edge_contacts(state, links, i, change_made, count_force, deepest[0]);
    });
  }
  if (links.spring_count > 0) {
    team.for_each(links.patch_springs[team.patch()], links.patch_springs[team.patch() + 1], [&](std::uint32_t i) {
      const view::Link<Real>& link = links.links[links.candidate_count + i];
      if (saves) links.checkpoint_broken[i] = links.broken[i];
      if (link.stiffness > 0) {
        const Vec3<Real> force = force_after(link, change_made);
        const Real most = links.spring_numbers[std::size_t{3} * i + 2];
        if (force.dot(force) > most * most) links.broken[i] = view::kSpringBroken;
      }
      if (links.broken[i] == 0) {
        const std::uint32_t tool = tool_that_severs(state, contact, links.spring_rows + std::size_t{2} * i);
        if (tool != kNoTool) links.broken[i] = static_cast<Real>(view::kSpringSevered + tool);
      }
      counts[1] += links.broken[i] != 0 ? Real(1) : Real(0);
    });
  }
  measure_blades(team, state, contact, links);
  team.patch_reduce(deepest, counts);
  if (team.leads_patch()) links.reports[team.patch()] = {counts[0], deepest[0], counts[1], counts[2], counts[3]};
}

}  // namespace tensormass::contact
