#pragma once

#include <cmath>

#include "contact/link.h"
#include "physics/contact/closest_point.h"
#include "physics/lists.h"
#include "view/scene.h"

/// Blades that cut tissue: each point of an edge holds the tissue by a spring that yields.
///
///          n ⊙──▶ c   cutting direction         p   blade point; it owns a length l of the edge
///     e: along the edge                         a   its anchor: a place in a tetrahedron, so four rows
///                                               ξ   p − a, where the step ends [m]
///     ──────────●a~~~~~●p──▶                    k   Gc l / t with the blade's thickness t [N/m]
///               cut so far
///
///   F = k ξ with its parts   along c   0 ≤ F·c ≤ Gc l             Gc: toughness of the tetrahedron [J/m²]
///                            along n   |F·n| ≤ kSideways Gc l
///                            along e   none
///
/// 1. Beyond a limit the anchor moves through the material (return mapping: Wriggers 2006, section 5.2). So a cut needs
///    the force Gc times its width, whatever the stiffness of the tissue is, and the work Gc times its area (Mahvash,
///    Hayward 2001; Mahvash, Okamura 2005; Azar, Hayward 2008). A blade that stops keeps its force.
/// 2. A pin is two links (view/links.h) with four rows each: one along c, one along n. They enter the step's linear
///    system. One that yields at the velocities before the solve enters with the secant to its limit: limit / |stretch|
///    instead of k. The system stays symmetric and positive definite, and the force that is reported is the one that
///    tissue received. The secant goes through zero stretch, so what has no weight follows the blade and does not
///    overtake it; a constant force would throw it.
/// 3. Backwards nothing holds. The anchor goes along, and until it comes to where it was, nothing holds forwards
/// either.
/// 4. Along the edge the anchor slides. A blade that moves along its edge cuts no area.
/// 5. A free point takes its anchor where it is in the step after tissue came around it, without any force.
/// 6. Scissors have two edges, each a blade of its own. Where one has passed the other, tissue between them is cut: the
///    point lets go, and its anchor goes to where it is. The load on the joint is −Σ F · ∂p/∂θ, so closing by dθ does
///    the work Gc dA on the area that both edges sweep: torque = Gc t ds/dθ for tissue that is t thick, s: the mean
///    depth of the cut (Mahvash et al. 2008).
///
/// Patch 0 does the work of all blade points, each in a thread of its own. All patches look for tissue around free
/// points.
namespace tensormass::contact {

/// Tissue that is pushed aside by the flat of a blade tears at this multiple of the force that cuts it.
inline constexpr double kSideways = 4;
/// Tetrahedra through which an anchor may move in a step. One that moves farther stops.
inline constexpr int kMostTetrahedraOfStep = 64;
/// Blade points that tissue is looked for around in one pass over a patch.
inline constexpr std::size_t kPointsOfPass = 8;

/// A point of an edge, where the step ends.
template <class Real>
struct BladePoint {
  Vec3<Real> position, motion;     // motion in this step
  Vec3<Real> cuts, normal, along;  // c, n, e
  Vec3<Real> by_joint;             // ∂p/∂θ; zero without a joint
  Real length_m;                   // l
  bool is_past;                    // the other edge has passed it
};

/// Returns the edge of its tool that a blade is. Edges of a tool follow each other.
template <class Real>
TM_HOST_DEVICE std::uint32_t edge_of(const view::BladesView<Real>& blades, std::uint32_t blade) {
  std::uint32_t edge = 0;
  while (edge < blade && blades.tools[blade - edge - 1] == blades.tools[blade]) ++edge;
  return edge;
}

/// point: among those of all blades
template <class Real>
TM_HOST_DEVICE BladePoint<Real> blade_point(const view::ContactView<Real>& contact,
                                            const view::BladesView<Real>& blades, std::uint32_t blade,
                                            std::uint32_t point) {
  const physics::PlacedTool<Real>& tool = contact.tools[blades.tools[blade]];
  const std::uint32_t last = blades.first_points[blade + 1] - blades.first_points[blade] - 1;
  const std::uint32_t own = point - blades.first_points[blade];
  BladePoint<Real> out{};
  physics::with_blade(tool.kind, [&](auto kind) {
    using Kind = typename decltype(kind)::Type;
    const std::uint32_t edge = edge_of(blades, blade);
    const physics::EdgePoint<Real> at = Kind::edge_point(tool, edge, own, last);
    out.position = at.position;
    out.cuts = at.cuts;
    out.along = at.along;
    out.is_past = at.is_past;
    out.motion = tool.motion_at(at.position);
    if constexpr (Kind::kJoints.size() > 0) {
      out.by_joint = Kind::motion_of_edge(tool, edge, at.position);
      out.motion += out.by_joint * tool.joints_moved[0];
    }
  });
  out.normal = tool.axis(1);
  const Real spacing = tool.parameters[0] / static_cast<Real>(last);
  out.length_m = own == 0 || own == last ? spacing / 2 : spacing;
  return out;
}

template <class Real>
TM_HOST_DEVICE std::uint32_t blade_of(const view::BladesView<Real>& blades, std::uint32_t point) {
  std::uint32_t blade = 0;
  while (point >= blades.first_points[blade + 1]) ++blade;
  return blade;
}

/// The tetrahedron that a blade point remembers as `which`, or kNoTetrahedron.
template <class Real>
TM_HOST_DEVICE std::uint32_t tetrahedron_in(const Real* memory, std::uint32_t which) {
  return memory[which] > 0 ? static_cast<std::uint32_t>(memory[which]) - 1 : view::kNoTetrahedron;
}

template <class Real>
TM_HOST_DEVICE bool has_event(const Real* memory, view::BladeEvent event) {
  return static_cast<std::uint32_t>(memory[view::kBladeEvent]) == event;
}

/// Returns where a row is when the step ends.
template <class Real>
TM_HOST_DEVICE Vec3<Real> position_at_end(const view::StateView<Real>& state, std::uint32_t row) {
  return view::position(state, row) + view::beyond(state, row);
}

/// Returns Σ weight · of_row of a tetrahedron.
template <class Real, class OfRow>
TM_HOST_DEVICE Vec3<Real> mean_of(const view::BladesView<Real>& blades, std::uint32_t tetrahedron, const Real* weights,
                                  const OfRow& of_row) {
  const std::uint32_t* rows = blades.rows + std::size_t{4} * tetrahedron;
  Vec3<Real> sum = Vec3<Real>::Zero();
  for (int k = 0; k < 4; ++k) sum += of_row(rows[k]) * weights[k];
  return sum;
}

/// Computes barycentric coordinates of x in a tetrahedron. Returns false if that is flat.
template <class Real, class OfRow>
TM_HOST_DEVICE bool barycentric(const view::BladesView<Real>& blades, std::uint32_t tetrahedron, const Vec3<Real>& x,
                                const OfRow& of_row, Real* weights) {
  using std::abs;
  const std::uint32_t* rows = blades.rows + std::size_t{4} * tetrahedron;
  const Vec3<Real> o = of_row(rows[0]);
  const Vec3<Real> a = of_row(rows[1]) - o, b = of_row(rows[2]) - o, c = of_row(rows[3]) - o, d = x - o;
  const Vec3<Real> bc = physics::cross<Real>(b, c);
  const Real volume = a.dot(bc);
  if (!(abs(volume) > 0)) return false;
  weights[1] = d.dot(bc) / volume;
  weights[2] = a.dot(physics::cross<Real>(d, c)) / volume;
  weights[3] = a.dot(physics::cross<Real>(b, d)) / volume;
  weights[0] = 1 - weights[1] - weights[2] - weights[3];
  return true;
}

/// Moves an anchor through the material to x, or as far as the material goes. Returns false if x is beside it: the
/// weights are then those of x in the last tetrahedron.
template <class Real, class OfRow>
TM_HOST_DEVICE bool move_anchor(const view::BladesView<Real>& blades, const Vec3<Real>& x, const OfRow& of_row,
                                std::uint32_t& tetrahedron, Real* weights) {
  constexpr Real kInside = Real(-1e-5);
  for (int moves = 0; moves < kMostTetrahedraOfStep; ++moves) {
    Real next[4];
    if (!barycentric(blades, tetrahedron, x, of_row, next)) return true;  // it stays until the tetrahedron has a volume
    int across = -1;
    bool inside = true;
    for (int k = 0; k < 4; ++k) {
      if (!(next[k] < kInside)) continue;
      inside = false;
      const bool goes_on =
          blades.neighbours[std::size_t{4} * tetrahedron + static_cast<std::size_t>(k)] != view::kNoTetrahedron;
      if (goes_on && (across < 0 || next[k] < next[across])) across = k;
    }
    if (inside || across < 0) {
      for (int k = 0; k < 4; ++k) weights[k] = next[k];
      return inside;
    }
    tetrahedron = blades.neighbours[std::size_t{4} * tetrahedron + static_cast<std::size_t>(across)];
    for (int k = 0; k < 4; ++k) weights[k] = Real(0.25);
  }
  return true;
}

/// The limits and the stiffness of a pin.
template <class Real>
struct PinLimits {
  Real stiffness;  // k [N/m]
  Real cut_n;      // Gc l
  Real side_n;

  TM_HOST_DEVICE PinLimits(const physics::PlacedTool<Real>& tool, Real toughness, Real length_m) {
    cut_n = tool.presence * toughness * length_m;
    side_n = Real(kSideways) * cut_n;
    stiffness = cut_n / tool.parameters[1];
  }
};

/// Takes the anchor of a free point around which tissue was found when the last step ended.
template <class Real>
TM_HOST_DEVICE void take_anchor(const view::StateView<Real>& state, const view::BladesView<Real>& blades,
                                const physics::PlacedTool<Real>& tool, const BladePoint<Real>& at,
                                std::uint32_t point) {
  Real* memory = blades.memory_of(point);
  if (!(tool.presence > 0) || (at.is_past && !(memory[view::kBladeTetrahedron] > 0))) {
    for (std::uint32_t i = 0; i < view::kBladeMemory; ++i) memory[i] = 0;
    return;
  }
  if (memory[view::kBladeTetrahedron] > 0) {
    memory[view::kBladeSearches] = 0;
    return;
  }
  if (memory[view::kBladeSearches] > 0) {
    Real found = 0;
    for (std::uint32_t patch = 0; patch < blades.patch_count; ++patch) {
      const Real one = blades.memory[blades.found_place(point, patch)];
      if (one > 0 && (!(found > 0) || one < found)) found = one;
    }
    Real weights[4];
    const auto now = [&](std::uint32_t row) -> Vec3<Real> { return view::position(state, row); };
    if (found > 0 &&
        barycentric(blades, static_cast<std::uint32_t>(found) - 1, Vec3<Real>(at.position - at.motion), now, weights)) {
      memory[view::kBladeTetrahedron] = found;
      for (std::uint32_t k = 0; k < 4; ++k) memory[view::kBladeWeights + k] = weights[k];
      memory[view::kBladeRetreat] = 0;
      if (memory[view::kBladeOutside] > 0) memory[view::kBladeEvent] = static_cast<Real>(view::kBladeEntered);
      memory[view::kBladeOutside] = 0;
      memory[view::kBladeSearches] = 0;
      return;
    }
    memory[view::kBladeOutside] = 1;
  }
  memory[view::kBladeSearches] = 1;
}

/// The links of a pin: along c, along n.
template <class Real>
struct PinLinks {
  view::Link<Real> cuts, sideways;
};

/// Makes a link along a direction of a pin, whose force is s ξ where the step ends.
///
///   direction   c or n
///   now         stretch where the step begins, but with the blade where it ends [m]
///   ahead       stretch where the step ends, at the velocities before the solve [m]
///   limit_n     force beyond which it yields
///
/// s = min(k, limit / stretch). The larger of both stretches counts, so that tissue that moves along and is then
/// stopped feels no more than the limit.
template <class Real>
TM_HOST_DEVICE view::Link<Real> link_along(const Vec3<Real>& direction, const Vec3<Real>& now, const Vec3<Real>& ahead,
                                           Real stiffness, Real limit_n) {
  using std::abs;
  const Real start = direction.dot(now), stretch = maximum(abs(direction.dot(ahead)), abs(start));
  view::Link<Real> link{};
  link.stiffness = stiffness * stretch > limit_n ? limit_n / stretch : stiffness;
  for (int i = 0; i < 3; ++i) {
    link.normal[i] = direction[i];
    link.force[i] = link.stiffness * start * direction[i];
  }
  return link;
}

/// Makes the links of a blade point, and takes its anchor if it has none. Without rows: the point holds nothing.
template <class Real>
TM_HOST_DEVICE PinLinks<Real> links_of_pin(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                           const view::BladesView<Real>& blades, std::uint32_t point) {
  const std::uint32_t blade = blade_of(blades, point);
  const physics::PlacedTool<Real>& tool = contact.tools[blades.tools[blade]];
  const BladePoint<Real> at = blade_point(contact, blades, blade, point);
  take_anchor(state, blades, tool, at, point);
  const Real* memory = blades.memory_of(point);
  const std::uint32_t tetrahedron = tetrahedron_in(memory, view::kBladeTetrahedron);
  if (tetrahedron == view::kNoTetrahedron || memory[view::kBladeRetreat] > 0) return {};
  const Real* weights = memory + view::kBladeWeights;
  const Vec3<Real> now = at.position - mean_of(blades, tetrahedron, weights, [&](std::uint32_t row) -> Vec3<Real> {
                           return view::position(state, row);
                         });
  const Vec3<Real> ahead = now - mean_of(blades, tetrahedron, weights, [&](std::uint32_t row) -> Vec3<Real> {
                             return view::change_ahead_to_end(state, row);
                           });
  if (at.cuts.dot(ahead) < 0) return {};
  const PinLimits<Real> pin(tool, blades.toughness[tetrahedron], at.length_m);
  PinLinks<Real> out{link_along(at.cuts, now, ahead, pin.stiffness, pin.cut_n),
                     link_along(at.normal, now, ahead, pin.stiffness, pin.side_n)};
  for (std::uint32_t k = 0; k < 4; ++k) {
    out.cuts.rows[k] = out.sideways.rows[k] = blades.rows[std::size_t{4} * tetrahedron + k];
    out.cuts.weight[k] = out.sideways.weight[k] = weights[k];
  }
  return out;
}

/// Takes the anchor of a blade point to the end of the step: what yields moves through the material.
///
///   force       that the pin exerted on the tissue
///   anchor      where the anchor was when the step ended; written
///   cut_m2      area that the point cut in the step; written
/// Returns the work of fracture in the step [J].
template <class Real>
TM_HOST_DEVICE Real end_pin(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                            const view::BladesView<Real>& blades, const BladePoint<Real>& at, std::uint32_t blade,
                            std::uint32_t point, const Vec3<Real>& force, Vec3<Real>& anchor, Real& cut_m2) {
  using std::abs;
  cut_m2 = 0;
  Real* memory = blades.memory_of(point);
  std::uint32_t tetrahedron = tetrahedron_in(memory, view::kBladeTetrahedron);
  Real* weights = memory + view::kBladeWeights;
  const auto at_end = [&](std::uint32_t row) -> Vec3<Real> { return position_at_end(state, row); };
  anchor = mean_of(blades, tetrahedron, weights, at_end);
  const Vec3<Real> stretch = at.position - anchor;
  const PinLimits<Real> pin(contact.tools[blades.tools[blade]], blades.toughness[tetrahedron], at.length_m);
  const Real forwards = at.cuts.dot(stretch), sideways = at.normal.dot(stretch), retreat = memory[view::kBladeRetreat];
  Vec3<Real> moves = stretch;
  Real dissipated = 0;
  if (retreat > 0 || forwards < 0) {
    const Real left = retreat - forwards;
    memory[view::kBladeRetreat] = maximum(left, Real(0));
    if (left < 0) {
      moves += at.cuts * left;
      memory[view::kBladeEvent] = static_cast<Real>(view::kBladeEntered);
    }
  } else {
    const Real cut = maximum(forwards - pin.cut_n / pin.stiffness, Real(0));
    const Real torn = maximum(abs(sideways) - pin.side_n / pin.stiffness, Real(0));
    const Vec3<Real> side = at.normal * (sideways < 0 ? -torn : torn);
    if (!at.is_past) moves = at.along * at.along.dot(stretch) + at.cuts * cut + side;
    dissipated = force.dot(at.cuts * cut + side);
    cut_m2 = at.length_m * (cut + torn);
    if (at.is_past) {  // it lets go of the spring, too
      const Real left = forwards - cut;
      dissipated += pin.stiffness * left * left / 2;
      cut_m2 += at.length_m * left;
    }
  }
  if (move_anchor(blades, Vec3<Real>(anchor + moves), at_end, tetrahedron, weights) && !at.is_past) {
    memory[view::kBladeTetrahedron] = static_cast<Real>(tetrahedron) + 1;
    return dissipated;
  }
  memory[view::kBladeTetrahedron] = memory[view::kBladeRetreat] = memory[view::kBladeOutside] = 0;
  memory[view::kBladeEvent] = static_cast<Real>(view::kBladeLeft);
  memory[view::kBladeLast] = static_cast<Real>(tetrahedron) + 1;
  return dissipated;
}

/// Returns the force at which a blade point goes on cutting. Zero: it holds nothing, or not before it is back where it
/// was.
template <class Real>
TM_HOST_DEVICE Real holding_force(const physics::PlacedTool<Real>& tool, const view::BladesView<Real>& blades,
                                  const BladePoint<Real>& at, std::uint32_t point) {
  const Real* memory = blades.memory_of(point);
  const std::uint32_t tetrahedron = tetrahedron_in(memory, view::kBladeTetrahedron);
  if (tetrahedron == view::kNoTetrahedron || memory[view::kBladeRetreat] > 0) return 0;
  return PinLimits<Real>(tool, blades.toughness[tetrahedron], at.length_m).cut_n;
}

/// A place of a cut's front, and the tetrahedron whose map from the present to rest holds there.
template <class Real>
struct FrontPoint {
  Vec3<Real> position;
  std::uint32_t tetrahedron = view::kNoTetrahedron;
};

/// Returns the anchor of the point across on the other edge of scissors, if that holds tissue when the step ends.
template <class Real>
TM_HOST_DEVICE FrontPoint<Real> anchor_across(const view::StateView<Real>& state, const view::BladesView<Real>& blades,
                                              std::uint32_t blade, std::uint32_t point) {
  const std::uint32_t other = edge_of(blades, blade) == 0 ? blade + 1 : blade - 1;
  const Real* memory = blades.memory_of(point - blades.first_points[blade] + blades.first_points[other]);
  FrontPoint<Real> out;
  out.tetrahedron = tetrahedron_in(memory, view::kBladeTetrahedron);
  if (out.tetrahedron == view::kNoTetrahedron) return out;
  out.position = mean_of(blades, out.tetrahedron, memory + view::kBladeWeights,
                         [&](std::uint32_t row) -> Vec3<Real> { return position_at_end(state, row); });
  return out;
}

/// Returns up to where a blade point has cut. A cut begins and ends beside the tissue, so that it divides the surface.
/// Where edges pass each other, they cut what they have squeezed between them: up to the anchor on the other edge.
template <class Real>
TM_HOST_DEVICE FrontPoint<Real> front_of(const view::StateView<Real>& state, const view::BladesView<Real>& blades,
                                         const BladePoint<Real>& at, std::uint32_t blade, std::uint32_t point) {
  using std::sqrt;
  const Real* memory = blades.memory_of(point);
  const bool left = has_event(memory, view::kBladeLeft);
  FrontPoint<Real> out;
  out.tetrahedron = tetrahedron_in(memory, left ? view::kBladeLast : view::kBladeTetrahedron);
  if (out.tetrahedron == view::kNoTetrahedron) return out;
  if (memory[view::kBladeRetreat] > 0) {
    out.tetrahedron = view::kNoTetrahedron;
    return out;
  }
  out.position = mean_of(blades, out.tetrahedron, memory + view::kBladeWeights,
                         [&](std::uint32_t row) -> Vec3<Real> { return position_at_end(state, row); });
  if (left && at.is_past) {
    const FrontPoint<Real> across = anchor_across(state, blades, blade, point);
    if (across.tetrahedron != view::kNoTetrahedron) out = across;
  }
  const Real beside = at.length_m + sqrt(at.motion.dot(at.motion));
  if (left) out.position += at.cuts * beside;
  if (has_event(memory, view::kBladeEntered)) out.position -= at.cuts * beside;
  return out;
}

/// Reports the front of a blade point. Beside the last point that is in the tissue, a cut goes on to its neighbour.
template <class Real>
TM_HOST_DEVICE void report_front(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                 const view::BladesView<Real>& blades, std::uint32_t blade, std::uint32_t point) {
  const BladePoint<Real> at = blade_point(contact, blades, blade, point);
  view::BladeReport<Real>& report = blades.reports[point];
  report.tetrahedron = view::kNoTetrahedron;
  FrontPoint<Real> front = front_of(state, blades, at, blade, point);
  const bool is_free = !(blades.memory_of(point)[view::kBladeTetrahedron] > 0);
  for (int side = -1; side <= 1 && is_free && front.tetrahedron == view::kNoTetrahedron; side += 2) {
    const std::uint32_t other = side < 0 ? point - 1 : point + 1;
    if (other < blades.first_points[blade] || other >= blades.first_points[blade + 1]) continue;
    const BladePoint<Real> beside = blade_point(contact, blades, blade, other);
    front = front_of(state, blades, beside, blade, other);
    front.position += at.position - beside.position;
  }
  if (front.tetrahedron == view::kNoTetrahedron) return;
  Real weights[4];
  const auto at_end = [&](std::uint32_t row) -> Vec3<Real> { return position_at_end(state, row); };
  if (!barycentric(blades, front.tetrahedron, front.position, at_end, weights)) return;
  const Vec3<Real> rest = mean_of(blades, front.tetrahedron, weights,
                                  [&](std::uint32_t row) -> Vec3<Real> { return view::load3<Real>(state.rest, row); });
  for (int c = 0; c < 3; ++c) report.rest_m[c] = rest[c];
  report.tetrahedron = front.tetrahedron;
}

/// Looks for the tetrahedra of a patch around free points, kPointsOfPass at a time. Of several the first counts.
template <class Team, class Real>
TM_HOST_DEVICE void search_around(Team& team, const view::StateView<Real>& state,
                                  const view::ContactView<Real>& contact, const view::BladesView<Real>& blades,
                                  std::uint32_t blade, std::uint32_t first) {
  constexpr Real kNone = Real(-1e30);
  const std::uint32_t end = blades.first_points[blade + 1];
  Vec3<Real> points[kPointsOfPass], least = Vec3<Real>::Zero(), most = Vec3<Real>::Zero();
  bool any = false;
  const auto searches = [&](std::size_t i) {
    const std::uint32_t point = first + static_cast<std::uint32_t>(i);
    return point < end && blades.memory_of(point)[view::kBladeSearches] > 0;
  };
  Real found[kPointsOfPass], unused[1] = {0};
  for (std::size_t i = 0; i < kPointsOfPass; ++i) {
    found[i] = kNone;
    points[i] = Vec3<Real>::Zero();
    if (!searches(i)) continue;
    points[i] = blade_point(contact, blades, blade, first + static_cast<std::uint32_t>(i)).position;
    for (int c = 0; c < 3; ++c) {
      least[c] = any ? minimum(least[c], points[i][c]) : points[i][c];
      most[c] = any ? maximum(most[c], points[i][c]) : points[i][c];
    }
    any = true;
  }
  const auto at_end = [&](std::uint32_t row) -> Vec3<Real> { return position_at_end(state, row); };
  if (any) {
    team.for_each(
        blades.patch_tetrahedra[team.patch()], blades.patch_tetrahedra[team.patch() + 1], [&](std::uint32_t i) {
          const std::uint32_t tetrahedron = blades.tetrahedra[i];
          const std::uint32_t* rows = blades.rows + std::size_t{4} * tetrahedron;
          bool below[3] = {true, true, true}, above[3] = {true, true, true};
          for (int k = 0; k < 4; ++k) {
            const Vec3<Real> x = at_end(rows[k]);
            for (int c = 0; c < 3; ++c) {
              below[c] = below[c] && x[c] < least[c];
              above[c] = above[c] && x[c] > most[c];
            }
          }
          if (below[0] || below[1] || below[2] || above[0] || above[1] || above[2]) return;
          for (std::size_t p = 0; p < kPointsOfPass; ++p) {
            Real weights[4];
            if (!searches(p) || !barycentric(blades, tetrahedron, points[p], at_end, weights)) continue;
            const Real least_weight = minimum(minimum(weights[0], weights[1]), minimum(weights[2], weights[3]));
            if (least_weight >= 0) found[p] = maximum(found[p], -static_cast<Real>(tetrahedron) - 1);
          }
        });
    team.patch_reduce(found, unused);
  }
  if (!team.leads_patch()) return;
  for (std::size_t i = 0; i < kPointsOfPass && first + i < end; ++i) {
    const std::uint32_t point = first + static_cast<std::uint32_t>(i);
    const std::size_t place = blades.found_place(point, team.patch());
    if (state.control->saves_checkpoint != 0) blades.checkpoint_memory[place] = blades.memory[place];
    blades.memory[place] = searches(i) && found[i] > kNone ? -found[i] : Real(0);
  }
}

/// After the solve: measures the force of each blade, takes anchors to the end of the step, and reports how far each
/// point has cut. Looks for tissue around free points.
/// Reads links, displacement, velocity, tools; writes memory, its checkpoint, reports, tool_loads.
template <class Team, class Real>
TM_HOST_DEVICE void measure_blades(Team& team, const view::StateView<Real>& state,
                                   const view::ContactView<Real>& contact, const view::LinksView<Real>& links) {
  const view::BladesView<Real>& blades = links.blades;
  for (std::uint32_t blade = 0; blade < blades.blade_count; ++blade) {
    const std::uint32_t begin = blades.first_points[blade], end = blades.first_points[blade + 1];
    if (team.patch() == 0) {
      const std::uint32_t tool = blades.tools[blade];
      const Vec3<Real> origin = contact.tools[tool].position();
      const auto made = [&](std::uint32_t row) { return view::change_made_to_end(state, row); };
      constexpr int kOfJoint = 6;
      Real sums[kOfJoint + 1] = {0, 0, 0, 0, 0, 0, 0};
      team.for_each(begin, end, [&](std::uint32_t point) {
        Real* memory = blades.memory_of(point);
        if (state.control->saves_checkpoint != 0) {
          Real* saved = blades.checkpoint_memory + (memory - blades.memory);
          for (std::uint32_t i = 0; i < view::kBladeMemory; ++i) saved[i] = memory[i];
        }
        view::BladeReport<Real>& report = blades.reports[point];
        report.dissipated_j = report.cut_m2 = report.holds_n = 0;
        if (!(memory[view::kBladeTetrahedron] > 0)) return;
        const view::Link<Real>* pin = links.links + links.first_pin() + std::size_t{view::kPinLinks} * point;
        const Vec3<Real> force = force_after(pin[0], made) + force_after(pin[1], made);
        Vec3<Real> anchor;
        const BladePoint<Real> at = blade_point(contact, blades, blade, point);
        report.dissipated_j = end_pin(state, contact, blades, at, blade, point, force, anchor, report.cut_m2);
        report.holds_n = holding_force(contact.tools[tool], blades, at, point);
        const Vec3<Real> torque = physics::cross<Real>(anchor - origin, force);
        for (int c = 0; c < 3; ++c) {
          sums[c] -= force[c];
          sums[3 + c] -= torque[c];
        }
        sums[kOfJoint] -= at.by_joint.dot(force);
      });
      team.patch_sum(sums);
      if (team.leads_patch()) {
        view::ToolLoad<Real>& load = contact.tool_loads[std::size_t{tool} * blades.patch_count];
        const bool adds = edge_of(blades, blade) > 0;  // to the load of the edge before
        for (int c = 0; c < 3; ++c) {
          load.force_n[c] = adds ? load.force_n[c] + sums[c] : sums[c];
          load.torque_n_m[c] = adds ? load.torque_n_m[c] + sums[3 + c] : sums[3 + c];
        }
        load.joints[0] = adds ? load.joints[0] + sums[kOfJoint] : sums[kOfJoint];
      }
      team.sync();
      team.for_each(begin, end, [&](std::uint32_t point) { report_front(state, contact, blades, blade, point); });
      team.sync();
      team.for_each(begin, end, [&](std::uint32_t point) {
        blades.memory_of(point)[view::kBladeEvent] = blades.memory_of(point)[view::kBladeLast] = 0;
      });
    }
    for (std::uint32_t first = begin; first < end; first += kPointsOfPass) {
      search_around(team, state, contact, blades, blade, first);
    }
  }
}

}  // namespace tensormass::contact
