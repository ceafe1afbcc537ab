#pragma once

#include <cmath>

#include "contact/balance.h"
#include "contact/carried.h"
#include "contact/friction.h"
#include "contact/line.h"
#include "contact/solid.h"
#include "contact/surface.h"
#include "contact/tilt.h"
#include "contact/touch.h"
#include "physics/lists.h"
#include "view/scene.h"

/// Rigid tools against the tissue's surface: pressure by a penalty, implicit in time, with friction if a tool has it
/// (friction.h).
///
///                   ___
///                 /     \       c     point of the tool's core (physics/tool/tool.h)
///                |   c   |      n     direction in which the tissue is pushed, from c to the contact point
///                 \__│__/       w_a   weight of the contact point at corner a of the triangle
///    tissue ─────── n↓ ──────   d_a   motion of corner a to the end of the step, û + h v − u (view/state.h) [m]
///                               k     stiffness, penalty · area of the triangle [N/m]. Unless the scene gives it,
///                                     the penalty follows from the modulus of the element behind the triangle
///                               depth   radius − distance from c to the contact point [m]
///
/// 1. Each surface triangle has one contact with a thin tool: of the tool's candidates, the one with the greatest
///    depth. The triangle is in contact if that depth is positive. With a solid it has four, without a core (solid.h).
/// 2. The force at the *end* of the step is k (depth − n·Σ w_a d_a) along n, and the forces of tilt (tilt.h). It enters
///    the same linear system as the tissue. Its derivative has three diagonal blocks and the edge tensors between the
///    three corners. The mesh has those edges anyway (assembly.h).
/// 3. Each step decides once for each core point whether it is inside the tissue: at the closest point of the whole
///    surface, by the angle-weighted pseudonormal there (Bærentzen, Aanæs 2005). Between two core points, c is inside
///    up to where the core crosses the surface (CoreDepths).
/// 4. A c inside pushes the tissue back over itself: n is reversed, and the depth grows by twice the depth of c. This
///    concerns only triangles that face away from c. Another body beside the one that contains c is pushed as usual.
/// 5. With the augmented Lagrangian method (Wriggers 2006, section 5.3) a contact keeps its force λ from the end of the
///    last step, and the force is λ + k (depth − n·Σ w_a d_a). It then counts as deeper by λ / k. Tissue at rest has no
///    penetration, because λ carries the load.
/// 6. A contact that pressed when the last step ended still acts across a gap that closes within the step (touch.h).
///
/// Interpolating the distance between core points is not enough. A shaft may lie across a body with both ends beside
/// it. If it sinks in by more than its radius, its middle is inside although both ends are outside. Taken for outside,
/// it would pull the tissue over itself.
namespace tensormass::contact {

/// Finds the triangle of this patch that is closest to a core point, and on which side of it the point lies.
///
///   place    the core point's, among those of all tools
///   slit_m   slit_width of the tool
template <class Team, class Real>
TM_HOST_DEVICE void query_core_point(Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                                     const view::ContactView<Real>& contact, const Vec3<Real>& point,
                                     std::uint32_t place, Real slit_m) {
  struct Offset {
    Vec3<Real> vector;  // from the triangle's closest point to the core point
    physics::TriangleFeature feature;
  };
  const auto offset_from = [&](std::uint32_t triangle) {
    const Corners<Real> corners = corners_of(state, contact, triangle);
    const auto closest = physics::closest_point_on_triangle(point, corners.x[0], corners.x[1], corners.x[2]);
    return Offset{point - corners.at(closest.weights), closest.feature};
  };
  Real best = Real(1e30);
  std::uint32_t best_triangle = view::kNoTriangle;
  for_each_triangle(team, contact, [&](std::uint32_t triangle) {
    if (!stands_open(state, contact, triangle, slit_m)) return;
    const Vec3<Real> offset = offset_from(triangle).vector;
    const Real squared = offset.dot(offset);
    if (squared < best) {
      best = squared;
      best_triangle = triangle;
    }
  });
  team.patch_argmin(best, best_triangle);
  if (!team.leads_patch()) return;
  Real side = 1;
  if (best_triangle != view::kNoTriangle) {
    const Offset offset = offset_from(best_triangle);
    side = pseudonormal(state, contact, best_triangle, offset.feature).dot(offset.vector) < 0 ? Real(-1) : Real(1);
  }
  auto& closest = contact.closest[std::size_t{place} * patches.patch_count + team.patch()];
  closest.distance_squared = best;
  closest.side = side;
  closest.triangle = best_triangle;
}

/// Finds where the triangles of this patch cross the core between a core point and the next.
/// place: the first core point's, among those of all tools. slit_m: as above.
template <class Team, class Real>
TM_HOST_DEVICE void query_crossings(Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                                    const view::ContactView<Real>& contact, const Vec3<Real>& from,
                                    const Vec3<Real>& to, std::uint32_t place, Real slit_m) {
  constexpr Real kSlack = Real(1e-4);
  Real first = 2, last = -1;
  for_each_triangle(team, contact, [&](std::uint32_t triangle) {
    if (!stands_open(state, contact, triangle, slit_m)) return;
    const Corners<Real> corners = corners_of(state, contact, triangle);
    const auto crossing = physics::segment_crosses_triangle(from, to, corners.x[0], corners.x[1], corners.x[2], kSlack);
    if (!crossing.crosses) return;
    first = minimum(first, crossing.fraction);
    last = maximum(last, crossing.fraction);
  });
  first = -team.patch_max(-first);
  last = team.patch_max(last);
  if (!team.leads_patch()) return;
  auto& closest = contact.closest[std::size_t{place} * patches.patch_count + team.patch()];
  closest.first_crossing = first;
  closest.last_crossing = last;
}

/// Does both for the core of one thin tool.
template <class Kind, class Team, class Real>
TM_HOST_DEVICE void query_core(Kind, Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                               const view::ContactView<Real>& contact, const physics::PlacedTool<Real>& tool) {
  const Real slit_m = slit_width(tool);
  for (std::uint32_t i = 0; i < Kind::kCorePoints; ++i) {
    const Vec3<Real> point = Kind::core_point(tool, i);
    const std::uint32_t place = tool.first_core_point + i;
    query_core_point(team, patches, state, contact, point, place, slit_m);
    if (i + 1 == Kind::kCorePoints) break;
    query_crossings(team, patches, state, contact, point, Kind::core_point(tool, i + 1), place, slit_m);
  }
}

/// Stage 1, closest-point query: does this for the core points of all tools. Reads displacement, tools; writes closest.
template <class Team, class Real>
TM_HOST_DEVICE void query_closest(Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                                  const view::ContactView<Real>& contact) {
  for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
    const physics::PlacedTool<Real>& tool = contact.tools[t];
    physics::with_tool(tool.kind, [&](auto kind) {
      using Kind = typename decltype(kind)::Type;
      if constexpr (!Kind::kIsSolid) query_core(Kind{}, team, patches, state, contact, tool);
    });
  }
}

/// How deep the core of one tool is inside the tissue [m]; zero or negative outside. With it, the depth of contact
/// continues radius − distance continuously to the inside.
///
///             ___________________            a, b   depths of two core points, here both negative
///            |  tissue           |           f, l   first and last crossing of the surface in between
///     a -----f-------------------l---- b     inside: between f and l if both ends are outside, else up to f or from l
template <class Kind, class Real>
struct CoreDepths {
  static constexpr std::uint32_t kCount = Kind::kCorePoints;
  Real values[kCount];
  Real first[kCount], last[kCount];  // crossings between core point i and the next
  Real length[kCount];               // between them [m]
  Real radius;

  TM_HOST_DEVICE CoreDepths(const view::PatchesView& patches, const view::ContactView<Real>& contact,
                            const physics::PlacedTool<Real>& tool)
      : radius(tool.radius_m) {
    using std::sqrt;
    for (std::uint32_t i = 0; i < kCount; ++i) {
      const auto* of_patches = contact.closest + std::size_t{tool.first_core_point + i} * patches.patch_count;
      view::ClosestTriangle<Real> nearest = of_patches[0];
      first[i] = nearest.first_crossing;
      last[i] = nearest.last_crossing;
      for (std::uint32_t patch = 1; patch < patches.patch_count; ++patch) {
        const view::ClosestTriangle<Real> other = of_patches[patch];
        if (other.distance_squared < nearest.distance_squared) nearest = other;
        first[i] = minimum(first[i], other.first_crossing);
        last[i] = maximum(last[i], other.last_crossing);
      }
      values[i] = -nearest.side * sqrt(nearest.distance_squared);
      length[i] = 0;
      if (i + 1 == kCount) continue;
      const Vec3<Real> way = Kind::core_point(tool, i + 1) - Kind::core_point(tool, i);
      length[i] = sqrt(way.dot(way));
    }
  }

  /// Returns the depth of a point of the core.
  TM_HOST_DEVICE Real at(Real place) const {
    std::uint32_t i = 0;
    while (i + 2 < kCount && place > static_cast<Real>(i + 1)) ++i;
    if (i + 1 >= kCount) return values[0];
    const Real x = place - static_cast<Real>(i), a = values[i], b = values[i + 1];
    if (x <= 0) return a;
    if (x >= 1) return b;
    const Real f = first[i], l = last[i];
    if (!(f <= l)) return a + (b - a) * x;  // no crossing
    if (a > 0 && x < f) return b > 0 ? minimum(a + (b - a) * x, (f - x) * length[i]) : a * (1 - x / f);
    if (b > 0 && x > l) return a > 0 ? minimum(a + (b - a) * x, (x - l) * length[i]) : b * (x - l) / (1 - l);
    // The depth between two crossings is unknown. It is at most the way to the nearer one; the radius pushes the shaft
    // out as long as it is not far inside.
    if (a <= 0 && b <= 0) return minimum(radius, minimum(x - f, l - x) * length[i]);
    return 0;
  }
};

/// Returns where a triangle touches a thin tool.
/// If the contact has pressed, depth_m may be negative.
template <class Kind, class Real>
TM_HOST_DEVICE Touch<Real> touch_of_thin(const physics::PlacedTool<Real>& tool,
                                         const CoreDepths<Kind, Real>& core_depths, const Corners<Real>& corners,
                                         const Remembered<Real>& last, Real ahead) {
  using std::sqrt;
  Touch<Real> deepest;
  Real place = 0;
  const Real kept_m = last.depth_m;
  if (last.pressed_n > 0) deepest.depth_m = -(kept_m > 0 ? Real(1) : Real(kWidestGap)) * tool.radius_m;
  const auto consider = [&](const Vec3<Real>& candidate, const physics::CorePoint<Real>& core) {
    const Vec3<Real> away = corners.at(candidate) - core.position;
    const Real distance = sqrt(away.dot(away));
    // No point of the core is deeper than its distance to any triangle.
    const Real inside = minimum(core_depths.at(core.place), distance);
    const bool behind = inside > 0 && corners.normal().dot(away) > 0;
    const Real depth = tool.radius_m + (behind ? 2 * inside : Real(0)) - distance + kept_m;
    if (!(depth > deepest.depth_m)) return;
    deepest.depth_m = depth;
    place = core.place;
    deepest.lever_m = behind ? Real(0) : distance;
    deepest.weights = candidate;
    deepest.normal = distance > Real(1e-6) * tool.radius_m ? Vec3<Real>(away * ((behind ? -1 : 1) / distance))
                                                           : Vec3<Real>(-unit<Real>(corners.normal()));
  };
  Kind::for_each_candidate(tool, corners.x[0], corners.x[1], corners.x[2], consider);
  const bool has_gap = last.pressed_n > 0 && !(deepest.depth_m > 0);
  if (has_gap && !(deepest.normal.dot(unit<Real>(corners.normal())) < Real(kTurnedAway))) return {};
  if constexpr (Kind::kCorePoints > 1) {
    // Across a gap the line is that of the depth at which the contact pressed.
    const Real across = has_gap ? last.loaded_m - deepest.depth_m : Real(0);
    if (deepest.depth_m + across > 0 && deepest.lever_m > 0) {
      deepest.depth_m += across;
      Touch<Real> out = along_line<Kind>(tool, corners, deepest, place, Real(kept_m + across), ahead);
      out.depth_m -= across / out.share;
      return out;
    }
  }
  return deepest;
}

/// Returns where a thin tool touches with the pressure k (p(depth) + kept) in place of k (depth + kept), as its
/// tangent: k is p' times as large, and the depth is that at which a spring of this k has the pressure.
///
///   p = depth + (R − d0) x² / (1 − x),   x = (depth − d0) / (R − d0) from d0 = R / 4 on
///
/// p grows without bound where the surface comes to the core, so tissue that stretches over the tool hardly lets it
/// through. From x = PlacedTool::steepest on p is continued by its tangent.
/// kept: depth by which the contact counts as deeper than it is, contained in touch.depth_m [m].
template <class Real>
TM_HOST_DEVICE Touch<Real> hardened(Touch<Real> touch, Real kept, const physics::PlacedTool<Real>& tool) {
  if (!(touch.depth_m > 0)) return touch;
  constexpr Real kBegins = Real(physics::kHardeningBegins);
  const Real depth = touch.depth_m - kept, length = tool.radius_m * (1 - kBegins);
  const Real beyond = maximum(Real((depth - kBegins * tool.radius_m) / length), Real(0));
  const Real x = minimum(beyond, tool.steepest), left = 1 - x;
  const Real steeper = x * (2 - x) / (left * left), slope = 1 + steeper;
  const Real pressure = depth + length * (x * x / left + steeper * (beyond - x));
  touch.depth_m = (pressure + kept) / slope;
  touch.share *= slope;
  touch.line_share *= slope;
  return touch;
}

/// Returns the stiffness of a contact that keeps its force, at least `least`, and changes the depth so that it keeps
/// the same force. A kept force does not depend on the stiffness, but its update once a step is stable only if the
/// spring is stiffer than the mass in front of it.
template <class Real>
TM_HOST_DEVICE Real stiffened(Touch<Real>& touch, Real stiffness, Real kept_n, Real least) {
  if (!(stiffness > 0 && stiffness < least)) return stiffness;
  if (kept_n > 0) touch.depth_m += kept_n / least - kept_n / stiffness;
  return least;
}

/// Returns how many times stiffer than at its surface the contact of a solid may become with depth: 1 if the scene
/// gives its stiffness, or the contact keeps its force.
template <class Real>
TM_HOST_DEVICE Real steepest_slope(const view::ContactView<Real>& contact, const physics::PlacedTool<Real>& tool,
                                   std::uint32_t triangle) {
  const Real whole = whole_stiffness(contact, tool, triangle);
  if (tool.keeps_force != 0 || !(tool.penalty_per_m > 0 && whole > 0)) return 1;
  return maximum(Real(kStiffest) * element_stiffness(contact, triangle) / whole, Real(1));
}

/// Returns the least stiffness of a contact that keeps its force [N/m]. A softer spring would not follow the mass in
/// front of it, and under the edge of a box or a mesh not the element.
template <class Kind, class Real>
TM_HOST_DEVICE Real least_stiffness(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                    const physics::PlacedTool<Real>& tool, std::uint32_t triangle,
                                    const Touch<Real>& touch) {
  const Real inertial = inertial_stiffness(state, contact, triangle, touch.weights);
  if constexpr (Kind::kIsSolid) {
    if (!(Kind::middle_m(tool) > 0)) return inertial;
    const Real elastic = Real(kKeptStiffness) * element_stiffness(contact, triangle);
    return maximum(inertial, tool.presence * touch.share * elastic);
  } else {
    return inertial;
  }
}

/// Computes each triangle's contacts with one tool.
template <class Kind, class Team, class Real>
TM_HOST_DEVICE void generate_contacts_with(const Team& team, const view::PatchesView& patches,
                                           const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                           const physics::PlacedTool<Real>& tool) {
  const auto store = [&](std::uint32_t triangle, std::uint32_t point, const Corners<Real>& corners, Touch<Real> touch) {
    const std::size_t place = contact_place(contact, tool, point, triangle);
    view::TriangleContact<Real>& out = contact.contacts[place];
    Real stiffness = whole_stiffness(contact, tool, triangle) * touch.share;
    if (tool.keeps_force != 0) {
      stiffness = stiffened(touch, stiffness, tool.presence * contact.slips[4 * place + 3],
                            least_stiffness<Kind>(state, contact, tool, triangle, touch));
    }
    out.depth_m = touch.depth_m;
    out.stiffness = 0;
    Real loaded_m = touch.depth_m;
    if (!(touch.depth_m > 0)) {
      const Remembered<Real> last = remembered(state, contact, tool, point, triangle);
      if (!closes(state, contact, triangle, touch, last.pressed_n)) return;
      loaded_m = last.loaded_m / touch.share;
    }
    for (int c = 0; c < 3; ++c) {
      out.weight[c] = touch.weights[c];
      out.normal[c] = touch.normal[c];
    }
    out.stiffness = stiffness;
    out.loaded_m = loaded_m;
    out.lever_m = touch.lever_m;
    out.line_stiffness = whole_stiffness(contact, tool, triangle) * touch.line_share;
    for (int c = 0; c < 3; ++c) out.line[c] = touch.line[c];
    if (!(tool.friction > 0)) return;
    const ContactPoint<Real> at(state, contact, triangle, out);
    const Real pressure = maximum(at.pressure_after(at.change_ahead()), Real(0));
    const Vec3<Real> x = corners.at(touch.weights);
    const Vec3<Real> tool_motion = physics::motion_with_joints<Kind, Real>(tool, x - touch.normal * touch.lever_m, x);
    contact.frictions[place] = predict_friction(at, tool, tool_motion, pressure, contact.slips + 4 * place);
  };
  if constexpr (Kind::kIsSolid) {
    for_each_triangle(team, contact, [&](std::uint32_t triangle) {
      const Corners<Real> corners = corners_of(state, contact, triangle);
      const Real area = contact.triangle_area[triangle], open = openness(state, contact, triangle, slit_width(area));
      if (!(open > 0)) {
        for (std::uint32_t point = 0; point != Kind::kContactPoints; ++point) store(triangle, point, corners, {});
        return;
      }
      const auto last = [&](std::uint32_t point) {
        Remembered<Real> of_point = remembered(state, contact, tool, point, triangle);
        of_point.depth_m /= open;
        return of_point;
      };
      const Corners<Real> ahead = motion_ahead(state, contact, triangle);
      const Real steepest = steepest_slope(contact, tool, triangle);
      for_each_touch_of_solid<Kind>(tool, corners, ahead, area, last, [&](std::uint32_t point, Touch<Real> touch) {
        touch.share *= open;
        store(triangle, point, corners, hardened_solid<Kind>(touch, tool, steepest));
      });
    });
  } else {
    const CoreDepths<Kind, Real> core_depths(patches, contact, tool);
    const Real ahead = Real(state.iterates != 0 ? kLineWidth : kLineAhead);
    for_each_triangle(team, contact, [&](std::uint32_t triangle) {
      const Corners<Real> corners = corners_of(state, contact, triangle);
      const Real open = openness(state, contact, triangle, slit_width(tool));
      if (!(open > 0)) return store(triangle, 0, corners, {});
      const Remembered<Real> last = remembered(state, contact, tool, 0, triangle);
      Touch<Real> touch = touch_of_thin(tool, core_depths, corners, last, ahead);
      if (is_face_of_cut(contact, triangle)) touch = turned_to_tool(touch, corners, last.depth_m, open);
      store(triangle, 0, corners, hardened(touch, last.depth_m / touch.share, tool));
    });
  }
}

/// Stage 2, contact generation: does this for all tools.
/// Reads displacement, velocity, tools, closest, slips; writes contacts, frictions.
template <class Team, class Real>
TM_HOST_DEVICE void generate_contacts(const Team& team, const view::PatchesView& patches,
                                      const view::StateView<Real>& state, const view::ContactView<Real>& contact) {
  for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
    const physics::PlacedTool<Real> tool = contact.tools[t];
    physics::with_tool(tool.kind, [&](auto kind) {
      using Kind = typename decltype(kind)::Type;
      if constexpr (Kind::kContactPoints > 0) generate_contacts_with<Kind>(team, patches, state, contact, tool);
    });
  }
}

/// Measures the load on tool t, and takes what its contacts remember to the end of the step.
template <class Kind, class Team, class Real>
TM_HOST_DEVICE void measure_load_on(Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                                    const view::ContactView<Real>& contact, const view::BalanceView<Real>& balance,
                                    std::uint32_t t) {
  const physics::PlacedTool<Real> tool = contact.tools[t];
  const bool has_friction = tool.friction > 0, remembers = tool.remembers != 0;
  // Force, torque, friction, pressure, pressure times moduli, joints. Summed over the patch together.
  constexpr std::size_t kPressed = 9, kOfJoints = 12, kJoints = Kind::kJoints.size();
  Real sums[kOfJoints + kJoints]{};
  Vec3<Real> force = Vec3<Real>::Zero(), torque = Vec3<Real>::Zero(), friction = Vec3<Real>::Zero();
  const auto add = [&](std::uint32_t triangle, std::uint32_t contact_point) {
    const std::size_t place = contact_place(contact, tool, contact_point, triangle);
    const view::TriangleContact<Real>& touch = contact.contacts[place];
    const bool acts = touches(touch);
    if (!acts && !remembers) return;
    const ContactPoint<Real> at(state, contact, triangle, touch);
    Real pressure = 0;
    Vec3<Real> stretch = Vec3<Real>::Zero();
    if (acts) {
      // Forces act where the contact was generated: tissue that slides exerts no torque on a sphere.
      const Corners<Real> corners = at.corners_before(), change = at.change_made();
      // The tissue received these forces in the solve, so they are reported even where they pull: a contact is
      // decided before the solve, and holds back a point that leaves the tool within the step.
      pressure = at.pressure_after(change);
      Vec3<Real> push = at.normal() * pressure;  // on the tissue
      if (has_friction) {
        stretch = stretch_of(at, contact.frictions[place]);
        Vec3<Real> drag = stretch * contact.frictions[place].stiffness;
        const std::uint32_t body = balance.row_body == nullptr
                                       ? view::kNoBody
                                       : balance.row_body[TriangleRows<Real>(contact, triangle).rows[0]];
        if (body != view::kNoBody) {
          const Vec3<Real> x = corners_of(state, contact, triangle).at(at.weights());
          drag = balanced_friction(at, balance.corrections[body], tool.friction, stretch, pressure, x);
          stretch = drag / touch.stiffness;
        }
        push += drag;
        friction -= drag;
      }
      const Tilt<Real> tilt(corners, touch);
      const Vec3<Real> aside = tilt.total_force(tilt.of(change));
      const Vec3<Real> point = corners.at(at.weights()), core = point - at.normal() * touch.lever_m;
      const LineTilt<Real> line(touch);
      const Real along = line.of(change);
      for (int c = 0; c < 3; ++c) {
        const Vec3<Real> on_corner = line.force(c, along);
        force -= on_corner;
        torque -= physics::cross<Real>(corners.x[c] - tool.position(), on_corner);
        for (std::size_t j = 0; j < kJoints; ++j) {
          sums[kOfJoints + j] -= Kind::joint_motion(tool, j, core, corners.x[c]).dot(on_corner);
        }
      }
      force -= push + aside;
      torque -= physics::cross<Real>(point - tool.position(), push);
      torque -= physics::cross<Real>(core - tool.position(), aside);
      for (std::size_t j = 0; j < kJoints; ++j) {
        sums[kOfJoints + j] -= Kind::joint_motion(tool, j, core, point).dot(push);
        sums[kOfJoints + j] -= Kind::joint_motion(tool, j, core, core).dot(aside);
      }
      if (pressure > 0) {
        sums[kPressed] += pressure;
        for (std::size_t i = 0; i < 2; ++i) {
          sums[kPressed + 1 + i] += pressure * contact.triangle_moduli[std::size_t{2} * triangle + i];
        }
      }
    }
    if (remembers) end_contact(at, contact, tool, stretch, maximum(pressure, Real(0)), place);
  };
  for_each_triangle(team, contact, [&](std::uint32_t triangle) {
    for (std::uint32_t i = 0; i != Kind::kContactPoints; ++i) add(triangle, i);
  });
  for (int c = 0; c < 3; ++c) {
    sums[c] = force[c];
    sums[3 + c] = torque[c];
    sums[6 + c] = friction[c];
  }
  team.patch_sum(sums);
  if (team.leads_patch()) {
    auto& load = contact.tool_loads[std::size_t{t} * patches.patch_count + team.patch()];
    load = {{sums[0], sums[1], sums[2]}, {sums[3], sums[4], sums[5]}, {sums[6], sums[7], sums[8]}, {}, 0, {}, {}};
    load.pressed_n = sums[kPressed];
    for (std::size_t j = 0; j < kJoints; ++j) load.joints[j] = sums[kOfJoints + j];
    for (std::size_t i = 0; i < 2; ++i) load.pressed_moduli[i] = sums[kPressed + 1 + i];
    load.tip.triangle = view::kNoTriangle;
    if constexpr (Kind::kCorePoints > 0)
      load.tip = contact.closest[std::size_t{tool.first_core_point} * patches.patch_count + team.patch()];
  }
}

/// Stage 4, after the solve: measures the load of the tissue on each tool at the end of the step, and takes to it what
/// contacts remember: springs of friction and kept forces.
/// Reads contacts, frictions, corrections, displacement, velocity; writes tool_loads, slips, checkpoint_slips.
template <class Team, class Real>
TM_HOST_DEVICE void measure(Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                            const view::ContactView<Real>& contact, const view::BalanceView<Real>& balance) {
  for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
    physics::with_tool(contact.tools[t].kind, [&](auto kind) {
      measure_load_on<typename decltype(kind)::Type>(team, patches, state, contact, balance, t);
    });
  }
}

}  // namespace tensormass::contact
