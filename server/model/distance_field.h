#pragma once

#include <span>
#include <string_view>
#include <vector>

#include <Eigen/Geometry>

#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::model {

/// The inside of a closed triangle surface, as contact reads it.
struct DistanceField {
  std::vector<float> samples;  ///< as physics::SampledDistance lays them out
  Eigen::AlignedBox3d box;     ///< around the surface [m]
  double reach_m = 0;          ///< largest distance of a vertex from the origin
};

/// Cubes along the longest side of the surface, and beyond it on each side.
inline constexpr int kDistanceCubes = 48, kDistanceMargin = 2;

/// Samples the signed distance of a surface (signed_distance.h) on a grid of cubes.
///
/// The surface must have passed mesh::admit_skin; `what` names it in messages. Errors: it has an edge that does not
/// belong to exactly two triangles in opposite directions; it encloses no volume, or its triangles face inwards.
Result<DistanceField> sample_distance(std::span<const Eigen::Vector3d> vertices,
                                      std::span<const mesh::Triangle> triangles, std::string_view what);

}  // namespace tensormass::model
