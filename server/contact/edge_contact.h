#pragma once

#include <cmath>

#include "contact/body_contact.h"
#include "contact/link.h"
#include "view/scene.h"

/// Contact of a sharp edge of one body with a sharp edge of another. Two ridges that cross touch between their nodes,
/// where no node meets a triangle.
///
///      a ──────P────── b        P, Q   points of the two edges that are closest to each other:
///              ↑ n                     P = (1 − s) a + s b, Q likewise with t on the other edge
///              Q  (the other    n      ± (b − a) × (b' − a'), unit length, in which the edge a b is pushed
///                 edge, across)
///
///   gap = n·(P − Q)             negative if the ridges have passed into each other
///   force = k (r − gap) n       at P; the other edge receives the opposite at Q.  r as in body_contact.h
///
///   k = penalty · √(A A') · share       A, A': a third of the triangles at each edge;  share: 0 to 1, below
///
/// 1. Only edges at which the surface turns by more than 45° and that are convex count (model/links.cpp). A
///    smooth surface has none, and its scene pays nothing.
/// 2. Each pair counts once: the edges of the body with the finer mesh search those of the other, in the boxes that
///    nodes search. An edge touches at most kEdgeSlots others.
/// 3. n has the sign that points out of the other body and into this one. Two edges can only touch along an n that
///    lies between the normals of both edges' triangles, as in the separating axes of convex bodies. Where n leaves
///    that range, a face touches and nodes carry it: the share fades to nothing.
/// 4. The share also fades where the edges become parallel, and over the ends of an edge: to the edge that continues
///    the ridge, which has the rest of it, or to nothing at a corner, whose node touches the other surface.
/// 5. An edge behind another may also be one of the far side of a thin body. A pair touches at first if it is not
///    deeper than half of the smaller edge's width, or if it passes in this step (6.). Then it is remembered, however
///    deep it is pressed.
/// 6. An edge so fast that it would pass by more than kPassInDepths of that depth in a step touches across the gap,
///    where the ways of both edges cross. The force then holds it at the end of the step.
/// 7. Friction is that of nodes. Its stretch belongs to the pair.
namespace tensormass::contact {

/// Width of the fade over an edge's end, as a part of the reach.
inline constexpr double kEndFadeInReaches = 0.05;
/// Sine of the angle between two edges up to which they are parallel, and from which their contact is whole.
inline constexpr double kParallelSine = 0.05, kCrossingSine = 0.15;
/// How far n may leave the range between the normals of the triangles, in cosines, until the share is nothing.
inline constexpr double kRangeFade = 0.1;
/// Depth that a pair may newly have, as a part of the smaller edge's width.
inline constexpr double kNewDepthInWidths = 0.5;
/// Part of that depth by which a pair must pass in a step to touch across the gap.
inline constexpr double kPassInDepths = 0.25;

/// A sharp edge in space.
template <class Real>
struct SharpEdge {
  Vec3<Real> a, b;     // ends
  Vec3<Real> outward;  // mean of the normals of its triangles, unit length
  Real cosine;         // between `outward` and each of these normals

  TM_HOST_DEVICE Vec3<Real> at(Real place) const { return a + (b - a) * place; }
};

/// position(row) -> Vec3 of a row. rows: its entry of EdgesView::rows.
template <class Real, class Position>
TM_HOST_DEVICE SharpEdge<Real> sharp_edge(const std::uint32_t* rows, const Position& position) {
  using std::sqrt;
  SharpEdge<Real> out{position(rows[0]), position(rows[1]), Vec3<Real>::Zero(), 1};
  const Vec3<Real> along = out.b - out.a;
  const Vec3<Real> left = unit<Real>(physics::cross<Real>(along, position(rows[2]) - out.a));
  const Vec3<Real> right = unit<Real>(physics::cross<Real>(position(rows[3]) - out.a, along));
  const Vec3<Real> sum = left + right;
  const Real length = sqrt(sum.dot(sum));
  if (length > 0) {
    out.outward = sum / length;
    out.cosine = length / 2;
  }
  return out;
}

/// Two edges at the points where they are closest, both lines being endless.
template <class Real>
struct Crossing {
  Real share = 0;  // 0 to 1; 0: they do not touch
  Real s = 0, t = 0, gap = 0;
  Vec3<Real> normal = Vec3<Real>::Zero();  // zero: the edges are parallel
};

template <class Real>
TM_HOST_DEVICE Real clamped(Real x) {
  return minimum(maximum(x, Real(0)), Real(1));
}

/// Returns the share of an edge by its ends.
///
///   numbers   of the edge, in EdgesView::numbers
///   place     s or t
///   depth     r − gap [m], not negative
///   fade      width over which the share of an end fades [m]
template <class Real>
TM_HOST_DEVICE Real share_of_ends(const Real* numbers, Real place, Real length, Real depth, Real fade) {
  const auto of_end = [&](Real inside, bool ends) {
    return ends ? clamped<Real>((inside - depth) / (depth + fade)) : clamped<Real>(Real(0.5) + inside / (2 * fade));
  };
  return of_end(place * length, numbers[view::kEdgeFirstEnds] != 0) *
         of_end((1 - place) * length, numbers[view::kEdgeLastEnds] != 0);
}

/// e, f: the edge and the other one. distance: r
template <class Real>
TM_HOST_DEVICE Crossing<Real> crossing_of(const SharpEdge<Real>& e, const SharpEdge<Real>& f, const Real* numbers_e,
                                          const Real* numbers_f, Real distance, Real fade) {
  using std::sqrt;
  Crossing<Real> out;
  const Vec3<Real> u = e.b - e.a, w = f.b - f.a, between = f.a - e.a, across = physics::cross<Real>(u, w);
  const Real squared = across.dot(across), length_e = sqrt(u.dot(u)), length_f = sqrt(w.dot(w));
  const Real sine = sqrt(squared) / (length_e * length_f);
  if (!(sine > Real(kParallelSine))) return out;
  out.s = physics::cross<Real>(between, w).dot(across) / squared;
  out.t = physics::cross<Real>(between, u).dot(across) / squared;
  const Vec3<Real> line = across / sqrt(squared);
  out.normal = line.dot(f.outward - e.outward) < 0 ? Vec3<Real>(-line) : line;
  out.gap = -out.normal.dot(between);
  const auto in_range = [&](Real along, Real cosine) { return clamped<Real>((along - cosine) / Real(kRangeFade) + 1); };
  out.share = in_range(-out.normal.dot(e.outward), e.cosine) * in_range(out.normal.dot(f.outward), f.cosine);
  if (!(out.share > 0)) return out;
  const Real depth = maximum(distance - out.gap, Real(0));
  out.share *= clamped<Real>((sine - Real(kParallelSine)) / Real(kCrossingSine - kParallelSine)) *
               share_of_ends(numbers_e, out.s, length_e, depth, fade) *
               share_of_ends(numbers_f, out.t, length_f, depth, fade);
  return out;
}

/// What an edge touches in this step. Slots without a contact have a share of zero.
template <class Real>
struct EdgeTouches {
  Crossing<Real> crossing[view::kEdgeSlots];
  std::uint32_t other[view::kEdgeSlots] = {view::kNoEntry, view::kNoEntry, view::kNoEntry, view::kNoEntry};

  /// Keeps the largest shares.
  TM_HOST_DEVICE void add(std::uint32_t edge, const Crossing<Real>& found) {
    std::uint32_t least = 0;
    for (std::uint32_t slot = 1; slot < view::kEdgeSlots; ++slot) {
      if (crossing[slot].share < crossing[least].share) least = slot;
    }
    if (!(found.share > crossing[least].share)) return;
    crossing[least] = found;
    other[least] = edge;
  }
};

/// What an edge remembers of the last step, copied.
template <class Real>
class RememberedPairs {
 public:
  TM_HOST_DEVICE RememberedPairs(const view::EdgesView<Real>& edges, std::uint32_t candidate) {
    constexpr std::uint32_t kCount = view::kEdgeSlots * view::kEdgeMemory;
    for (std::uint32_t i = 0; i < kCount; ++i) pairs_[i] = edges.memory[std::size_t{kCount} * candidate + i];
  }
  /// Returns what a slot remembers, as EdgesView::memory.
  TM_HOST_DEVICE const Real* slot(std::uint32_t i) const { return pairs_ + std::size_t{view::kEdgeMemory} * i; }
  /// Returns what the slot of another edge remembers, or zeros.
  TM_HOST_DEVICE const Real* of(std::uint32_t other) const {
    for (std::uint32_t i = 0; i < view::kEdgeSlots; ++i) {
      if (slot(i)[view::kEdgePartner] == static_cast<Real>(other + 1)) return slot(i);
    }
    return none_;
  }
  TM_HOST_DEVICE bool has(std::uint32_t other) const { return of(other) != none_; }

 private:
  Real pairs_[view::kEdgeSlots * view::kEdgeMemory];
  Real none_[view::kEdgeMemory] = {};
};

/// Finds how an edge touches others in this step.
template <class Real>
class EdgeSearch {
 public:
  TM_HOST_DEVICE EdgeSearch(const view::StateView<Real>& state, const view::LinksView<Real>& links,
                            std::uint32_t candidate)
      : state_(state),
        ways_{state},
        links_(links),
        edges_(links.edges),
        edge_(edges_.candidates[std::size_t{2} * candidate]),
        groups_(links.side_groups + std::size_t{3} * edges_.candidates[std::size_t{2} * candidate + 1]),
        side_(links.side_numbers + std::size_t{view::kSideNumbers} * edges_.candidates[std::size_t{2} * candidate + 1]),
        before_(edges_, candidate),
        fade_(Real(kEndFadeInReaches) * side_[view::kSideReach]) {}

  TM_HOST_DEVICE EdgeTouches<Real> find() {
    for (std::uint32_t slot = 0; slot < view::kEdgeSlots; ++slot) {
      const Real partner = before_.slot(slot)[view::kEdgePartner];
      if (partner > 0) consider(static_cast<std::uint32_t>(partner) - 1, true);
    }
    const view::AxisBox<Real> near = ways_.box_of(edges_.rows + std::size_t{4} * edge_, 2, side_[view::kSideReach]);
    const auto is_elsewhere = [&](const view::AxisBox<Real>& box) { return !overlap(box, near); };
    for_each_triangle(links_, groups_, is_elsewhere, [&](std::uint32_t triangle) {
      const std::uint32_t* edges = edges_.triangle_edges + std::size_t{3} * triangle;
      for (int c = 0; c < 3; ++c) {
        if (edges[c] != view::kNoEntry && !before_.has(edges[c])) consider(edges[c], false);
      }
    });
    return touches_;
  }

 private:
  template <class Position>
  TM_HOST_DEVICE Crossing<Real> crossing_at(std::uint32_t other, const Position& position) const {
    return crossing_of(sharp_edge<Real>(edges_.rows + std::size_t{4} * edge_, position),
                       sharp_edge<Real>(edges_.rows + std::size_t{4} * other, position), numbers(edge_), numbers(other),
                       side_[view::kSideDistance], fade_);
  }
  TM_HOST_DEVICE const Real* numbers(std::uint32_t edge) const {
    return edges_.numbers + std::size_t{view::kEdgeNumbers} * edge;
  }

  /// Returns n·Σ weight · (vector of each row).
  template <class OfRow>
  TM_HOST_DEVICE Real along_normal(std::uint32_t other, const Crossing<Real>& at, const OfRow& of_row) const {
    const std::uint32_t *rows = edges_.rows + std::size_t{4} * edge_, *others = edges_.rows + std::size_t{4} * other;
    const Vec3<Real> own = of_row(rows[0]) * (1 - at.s) + of_row(rows[1]) * at.s;
    return at.normal.dot(own - of_row(others[0]) * (1 - at.t) - of_row(others[1]) * at.t);
  }

  TM_HOST_DEVICE void consider(std::uint32_t other, bool remembered) {
    Crossing<Real> now = crossing_at(other, [&](std::uint32_t row) { return view::position(state_, row); });
    if (now.normal.dot(now.normal) == 0) return;
    const Real width = minimum(numbers(edge_)[view::kEdgeWidth], numbers(other)[view::kEdgeWidth]);
    const Real new_depth = Real(kNewDepthInWidths) * width;
    const bool touches = now.share > 0 && now.gap < side_[view::kSideDistance];
    if (touches && (remembered || -now.gap < new_depth)) {
      touches_.add(other, now);
      return;
    }
    Crossing<Real> middle = now;  // rough: a point of both edges
    middle.s = clamped(middle.s);
    middle.t = clamped(middle.t);
    const Real way = along_normal(other, middle, [&](std::uint32_t row) { return view::motion_to_end(state_, row); });
    const Real passed = Real(kPassInDepths) * new_depth;
    if (!(-way > passed)) return;
    const Crossing<Real> before = crossing_at(other, [&](std::uint32_t row) { return ways_.start_of(row); });
    const Crossing<Real> after = crossing_at(other, [&](std::uint32_t row) { return ways_.end_of(row); });
    if (!(before.gap >= 0 && after.gap < -passed)) return;
    if (touches) {
      touches_.add(other, now);
      return;
    }
    const Real part = before.gap / (before.gap - after.gap);
    Crossing<Real> on_the_way = crossing_at(other, [&](std::uint32_t row) {
      const Vec3<Real> from = ways_.start_of(row);
      return Vec3<Real>(from + (ways_.end_of(row) - from) * part);
    });
    if (!(on_the_way.share > 0)) return;
    on_the_way.gap = along_normal(other, on_the_way, [&](std::uint32_t row) { return view::position(state_, row); });
    touches_.add(other, on_the_way);
  }

  const view::StateView<Real>& state_;
  const StepWay<Real> ways_;
  const view::LinksView<Real>& links_;
  const view::EdgesView<Real>& edges_;
  std::uint32_t edge_;
  const std::uint32_t* groups_;
  const Real* side_;
  RememberedPairs<Real> before_;
  Real fade_;
  EdgeTouches<Real> touches_{};
};

/// Returns the link of a slot of an edge. Its stiffness is zero if the slot has no contact.
template <class Real>
TM_HOST_DEVICE view::Link<Real> link_of_touch(const view::StateView<Real>& state, const view::LinksView<Real>& links,
                                              std::uint32_t candidate, const EdgeTouches<Real>& touches,
                                              std::uint32_t slot) {
  using std::sqrt;
  const view::EdgesView<Real>& edges = links.edges;
  const std::uint32_t edge = edges.candidates[std::size_t{2} * candidate], other = touches.other[slot];
  const std::uint32_t side = edges.candidates[std::size_t{2} * candidate + 1];
  const std::uint32_t* rows = edges.rows + std::size_t{4} * edge;
  view::Link<Real> link{{rows[0], rows[1], rows[0], rows[0]}, {0, 0, 0, 0}, {}, {}, 0, 0};
  const Crossing<Real>& at = touches.crossing[slot];
  if (!(at.share > 0)) return link;
  const Real *own = edges.numbers + std::size_t{view::kEdgeNumbers} * edge,
             *others = edges.numbers + std::size_t{view::kEdgeNumbers} * other;
  const Real* numbers = links.side_numbers + std::size_t{view::kSideNumbers} * side;
  const Real softer = minimum(own[view::kEdgeModulus], others[view::kEdgeModulus]);
  link.stiffness = (numbers[view::kSidePenalty] + numbers[view::kSidePenaltyPerM] * softer) *
                   sqrt(own[view::kEdgeArea] * others[view::kEdgeArea]) * at.share;
  link.rows[2] = edges.rows[std::size_t{4} * other];
  link.rows[3] = edges.rows[std::size_t{4} * other + 1];
  const Real weights[4] = {1 - at.s, at.s, at.t - 1, -at.t};
  for (int r = 0; r < 4; ++r) link.weight[r] = weights[r];
  for (int c = 0; c < 3; ++c) {
    link.normal[c] = at.normal[c];
    link.force[c] = link.stiffness * (numbers[view::kSideDistance] - at.gap) * at.normal[c];
  }
  if (numbers[view::kSideFriction] > 0) {
    const RememberedPairs<Real> pairs(edges, candidate);
    add_friction(state, numbers[view::kSideFriction], pairs.of(other), link);
  }
  return link;
}

/// Ends the step of an edge's contacts: takes their springs of friction to its end, and remembers which edges push.
/// Returns the number of those.
///
///   change_made(row) -> Vec3   motion of a row since the links were made
///   count_force(before, after) is called for each pair with its normal forces before and after the step [N]
///   deepest                    grows to the depth of the deepest [m]
template <class Real, class ChangeMade, class CountForce>
TM_HOST_DEVICE Real end_edge_contacts(const view::StateView<Real>& state, const view::LinksView<Real>& links,
                                      std::uint32_t candidate, const ChangeMade& change_made,
                                      const CountForce& count_force, Real& deepest) {
  const view::EdgesView<Real>& edges = links.edges;
  const RememberedPairs<Real> before(edges, candidate);
  const Real friction = friction_of(links, edges.candidates[std::size_t{2} * candidate + 1]);
  Real count = 0;
  for (std::uint32_t slot = 0; slot < view::kEdgeSlots; ++slot) {
    const std::uint32_t place = candidate * view::kEdgeSlots + slot, other = edges.partners[place];
    const view::Link<Real>& link = links.links[links.first_edge_link() + place];
    const Vec3<Real> n(link.normal[0], link.normal[1], link.normal[2]);
    const Real pressure = link.stiffness > 0 ? n.dot(force_after(link, change_made)) : Real(0);
    Real after[view::kEdgeMemory] = {};
    count_force(before.of(other)[view::kEdgeForce], maximum(pressure, Real(0)));  // kNoEntry + 1 is a free slot, 0
    if (pressure > 0) {
      count += 1;
      deepest = maximum(deepest, pressure / link.stiffness);
      for (std::size_t c = 0; c < 4; ++c) after[c] = before.of(other)[c];
      end_contact_friction(state, link, friction, pressure, after, static_cast<Real*>(nullptr));
      after[view::kEdgePartner] = static_cast<Real>(other + 1);
    }
    Real* memory = edges.memory + std::size_t{view::kEdgeMemory} * place;
    Real* checkpoint = edges.checkpoint_memory + std::size_t{view::kEdgeMemory} * place;
    for (std::uint32_t c = 0; c < view::kEdgeMemory; ++c) {
      if (state.control->saves_checkpoint != 0) checkpoint[c] = memory[c];
      memory[c] = after[c];
    }
  }
  return count;
}

}  // namespace tensormass::contact
