#pragma once

#include <cmath>

#include "physics/contact/closest_point.h"
#include "physics/lists.h"
#include "view/scene.h"

/// Blunt dissection: tools that sever springs of attachments within reach of their tip.
///
///        a ·                 ab     the spring at the end of a step
///           \   reach        c0     tip; the core runs on to c1
///            \ ◀────▶ __     r      radius
///             \      /c0\___________
///              \    | ══▪─────────── c1      ══▪ the part of the core that severs, of a given length from the tip on
///               · b  \__/___________
///
/// A spring is severed if its distance from that part is at most r + reach, both taken where a step ends. Unless the
/// scene says otherwise, a tool moves by at most r / 2 in a step, so it passes no spring unseen.
namespace tensormass::contact {

inline constexpr std::uint32_t kNoTool = 0xFFFFFFFFu;

/// Returns whether the segment ab is within PlacedTool::severs_m of the part of a core that severs.
///
///   first, step   the part starts at this core point and goes on to those at first + step, ...
template <class Kind, class Real>
TM_HOST_DEVICE bool severs_from(const physics::PlacedTool<Real>& tool, int first, int step, const Vec3<Real>& a,
                                const Vec3<Real>& b) {
  using std::sqrt;
  Real left = tool.severing_length_m;
  Vec3<Real> start = Kind::core_point(tool, static_cast<std::uint32_t>(first));
  for (int i = first;;) {
    i += step;
    const bool ends = i < 0 || i >= static_cast<int>(Kind::kCorePoints);
    const Vec3<Real> piece = ends ? Vec3<Real>(Vec3<Real>::Zero())
                                  : Vec3<Real>(Kind::core_point(tool, static_cast<std::uint32_t>(i)) - start);
    const Real length = sqrt(piece.dot(piece)), share = length > left ? left / length : Real(1);
    const Vec3<Real> end = start + piece * share;
    const physics::SegmentPair<Real> at = physics::closest_on_segments(a, b, start, end);
    const Vec3<Real> apart = a + (b - a) * at.first - start - (end - start) * at.second;
    if (apart.dot(apart) <= tool.severs_m * tool.severs_m) return true;
    left -= length;
    if (ends || !(left > 0)) return false;
    start = end;
  }
}

/// Returns whether a tool severs the segment ab. Jaws sever only while they are shut: their round tips touch.
template <class Kind, class Real>
TM_HOST_DEVICE bool severs(const physics::PlacedTool<Real>& tool, const Vec3<Real>& a, const Vec3<Real>& b) {
  if constexpr (Kind::kIsSolid) {
    return false;
  } else if constexpr (Kind::kJoints.size() == 0) {
    return severs_from<Kind>(tool, 0, 1, a, b);
  } else {
    constexpr int kLast = static_cast<int>(Kind::kCorePoints) - 1;
    const Vec3<Real> gap = Kind::core_point(tool, 0) - Kind::core_point(tool, kLast);
    if (gap.dot(gap) > 4 * tool.radius_m * tool.radius_m) return false;
    return severs_from<Kind>(tool, 0, 1, a, b) || severs_from<Kind>(tool, kLast, -1, a, b);
  }
}

/// Returns the first tool that severs a spring where the step ends, or kNoTool.
template <class Real>
TM_HOST_DEVICE std::uint32_t tool_that_severs(const view::StateView<Real>& state,
                                              const view::ContactView<Real>& contact,
                                              const std::uint32_t* spring_rows) {
  for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
    const physics::PlacedTool<Real>& tool = contact.tools[t];
    if (!(tool.severs_m > 0)) continue;
    const auto end_of = [&](std::uint32_t row) -> Vec3<Real> {
      return view::position(state, row) + view::beyond(state, row);
    };
    const Vec3<Real> a = end_of(spring_rows[0]), b = end_of(spring_rows[1]);
    bool cuts = false;
    physics::with_tool(tool.kind, [&](auto kind) { cuts = severs<typename decltype(kind)::Type>(tool, a, b); });
    if (cuts) return t;
  }
  return kNoTool;
}

}  // namespace tensormass::contact
