#include "model/distance_field.h"

#include <array>
#include <cmath>

#include <fmt/format.h>

#include "mesh/adjacency.h"
#include "model/signed_distance.h"
#include "physics/tool/mesh_solid.h"

namespace tensormass::model {
namespace {

using Eigen::Vector3d;
using mesh::Triangle;

/// A surface that encloses less, relative to the cube of its diagonal, is flat.
constexpr double kLeastRelativeVolume = 1e-9;

double volume_of(std::span<const Vector3d> vertices, std::span<const Triangle> triangles) {
  double six_volumes = 0;
  for (const Triangle& t : triangles) six_volumes += vertices[t[0]].dot(vertices[t[1]].cross(vertices[t[2]]));
  return six_volumes / 6;
}

}  // namespace

Result<DistanceField> sample_distance(std::span<const Vector3d> vertices, std::span<const Triangle> triangles,
                                      std::string_view what) {
  TM_ASSIGN_OR_RETURN(neighbours, mesh::triangle_neighbours(triangles, what));
  DistanceField out;
  for (const Triangle& triangle : triangles) {
    for (const std::uint32_t vertex : triangle) {
      out.box.extend(vertices[vertex]);
      out.reach_m = std::max(out.reach_m, vertices[vertex].norm());
    }
  }
  const double volume_m3 = volume_of(vertices, triangles);
  if (!(volume_m3 > kLeastRelativeVolume * std::pow(out.box.diagonal().norm(), 3))) {
    return invalid(
        fmt::format("{}: the surface encloses {:.3g} m³; it must not be flat, and its triangles must be "
                    "counter-clockwise seen from outside",
                    what, volume_m3));
  }
  const double spacing = out.box.sizes().maxCoeff() / kDistanceCubes;
  const Vector3d origin = out.box.min() - Vector3d::Constant(kDistanceMargin * spacing);
  std::array<std::uint32_t, 3> counts;
  for (int c = 0; c < 3; ++c) {
    const double cubes = std::ceil(out.box.sizes()[c] / spacing) + 2 * kDistanceMargin;
    counts[static_cast<std::size_t>(c)] = static_cast<std::uint32_t>(cubes) + 1;
  }
  const SignedDistance distance(vertices, triangles, neighbours);
  out.samples.reserve(physics::SampledDistance::kHeader + std::size_t{counts[0]} * counts[1] * counts[2]);
  for (const std::uint32_t count : counts) out.samples.push_back(static_cast<float>(count));
  for (const double header : {spacing, origin.x(), origin.y(), origin.z()}) {
    out.samples.push_back(static_cast<float>(header));
  }
  for (std::uint32_t k = 0; k < counts[2]; ++k) {
    for (std::uint32_t j = 0; j < counts[1]; ++j) {
      for (std::uint32_t i = 0; i < counts[0]; ++i) {
        out.samples.push_back(static_cast<float>(distance.at(origin + spacing * Vector3d(i, j, k))));
      }
    }
  }
  return out;
}

}  // namespace tensormass::model
