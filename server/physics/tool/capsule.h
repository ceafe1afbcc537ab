#pragma once

#include <array>

#include "physics/tool/bent_line.h"

namespace tensormass::physics {

/// A cylinder with round ends: the shaft of an instrument. Its core is a segment from the tip, at the origin of the
/// shape's frame, along that frame's z axis.
struct Capsule : BentLine<Capsule> {
  static constexpr std::string_view kName = "capsule";
  static constexpr std::array<ToolParameter, 1> kParameters{{{"length_m", 1e-6, 1e3}}};  // between the ends' centres
  static constexpr std::uint32_t kCorePoints = 2;

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> core_point(const PlacedTool<Real>& tool, std::uint32_t i) {
    return tool.position() + tool.axis(2) * (tool.parameters[0] * static_cast<Real>(i));
  }
};

}  // namespace tensormass::physics
