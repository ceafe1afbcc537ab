#pragma once

#include <array>

#include "physics/tool/bent_line.h"

namespace tensormass::physics {

/// A round bar bent at a right angle: its blade holds tissue aside, its shaft leads to the hand.
///
///          2           0   toe, at the origin of the shape's frame
///     z    │ shaft     1   heel, at (blade_length_m, 0, 0)
///     ↑    │           2   end of the shaft, at (blade_length_m, 0, shaft_length_m)
///     0────1
///      blade
struct Retractor : BentLine<Retractor> {
  static constexpr std::string_view kName = "retractor";
  static constexpr std::array<ToolParameter, 2> kParameters{
      {{"blade_length_m", 1e-6, 1e3}, {"shaft_length_m", 1e-6, 1e3}}};
  static constexpr std::uint32_t kCorePoints = 3;

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> core_point(const PlacedTool<Real>& tool, std::uint32_t i) {
    const Real x = i > 0 ? tool.parameters[0] : Real(0), z = i > 1 ? tool.parameters[1] : Real(0);
    return tool.position() + tool.axis(0) * x + tool.axis(2) * z;
  }
};

}  // namespace tensormass::physics
