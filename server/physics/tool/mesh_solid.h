#pragma once

#include <array>
#include <cmath>

#include "physics/tool/solid.h"

namespace tensormass::physics {

/// Signed distances of a solid on a regular grid in the shape's frame, as model/distance_field.h samples them.
///
///   [count_x, count_y, count_z, spacing, origin_x, origin_y, origin_z | values, x fastest]
struct SampledDistance {
  static constexpr std::size_t kHeader = 7;
  const float* data;

  template <class Real>
  struct Sample {
    Real distance;
    Vec3<Real> gradient;
  };

  /// Interpolates linearly in each direction.
  ///
  /// Outside of the grid it takes √(φ² + d²), with φ at the nearest point of the grid and d the way to there. The true
  /// distance is not smaller, because the solid is inside the grid, whose sides are convex.
  template <class Real>
  TM_HOST_DEVICE Sample<Real> at(const Vec3<Real>& x) const {
    using std::sqrt;
    const Real spacing = data[3];
    std::size_t cell[3];
    Real f[3];
    Vec3<Real> beyond;
    for (int c = 0; c < 3; ++c) {
      const Real place = (x[c] - data[4 + c]) / spacing, last = data[c] - 1;
      const Real inside = minimum(maximum(place, Real(0)), last);
      const Real floor = minimum(static_cast<Real>(static_cast<int>(inside)), last - 1);
      cell[c] = static_cast<std::size_t>(floor);
      f[c] = inside - floor;
      beyond[c] = (place - inside) * spacing;
    }
    const std::size_t row = static_cast<std::size_t>(data[0]), slab = row * static_cast<std::size_t>(data[1]);
    const float* corner = data + kHeader + cell[2] * slab + cell[1] * row + cell[0];
    Sample<Real> out{0, Vec3<Real>::Zero()};
    for (int i = 0; i < 8; ++i) {
      const int high[3] = {i & 1, (i >> 1) & 1, i >> 2};
      const Real value = corner[high[2] * slab + high[1] * row + high[0]];
      Real w[3];
      for (int c = 0; c < 3; ++c) w[c] = high[c] ? f[c] : 1 - f[c];
      out.distance += value * w[0] * w[1] * w[2];
      for (int c = 0; c < 3; ++c) {
        out.gradient[c] += (high[c] ? value : -value) * w[(c + 1) % 3] * w[(c + 2) % 3];
      }
    }
    const Real way = beyond.dot(beyond);
    if (way > 0) {
      const Real distance = sqrt(out.distance * out.distance + way);
      out.gradient = (out.gradient * (out.distance / spacing) + beyond) / distance;
      out.distance = distance;
    }
    return out;
  }
};

/// The inside of a closed triangle surface.
struct MeshSolid : Solid<MeshSolid> {
  static constexpr std::string_view kName = "mesh";
  static constexpr std::array<ToolParameter, 0> kParameters{};

  /// The reader writes both, from the surface.
  static double length_m(const ToolParameters& p) { return p[0]; }
  static double reach_m(const ToolParameters& p) { return p[1]; }

  template <class Real>
  TM_HOST_DEVICE static Real distance(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    return sample(tool, x).distance;
  }
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> gradient(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    using std::sqrt;
    const Vec3<Real> gradient = sample(tool, x).gradient;
    const Real squared = gradient.dot(gradient);
    return squared > 0 ? tool.to_scene(gradient / sqrt(squared)) : Vec3<Real>(Vec3<Real>::Zero());
  }

 private:
  template <class Real>
  TM_HOST_DEVICE static SampledDistance::Sample<Real> sample(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    return SampledDistance{tool.samples}.template at<Real>(tool.to_shape(x - tool.position()));
  }
};

}  // namespace tensormass::physics
