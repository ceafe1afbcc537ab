#pragma once

#include <concepts>

#include "physics/tool/tool.h"

/// The interface of a blade's kind, beyond that of a tool: straight edges with points that cut (contact/blades.h).
///
/// Parameters 0 to 2 of each kind: length of an edge [m], thickness of the blade [m], distance between points [m].
///
///   kEdges                    number of its edges
///   edge_points(parameters)   returns the number of points of each edge, both ends included
///   edge_point(tool, edge, i, last)
///                             returns point i of an edge of a placed tool; last: the number of its last point
///
/// One with a joint also has:
///
///   motion_of_edge(tool, edge, x)
///                             returns the derivative by the joint of the point of an edge that is at x
namespace tensormass::physics {

/// A point of an edge in the scene.
template <class Real>
struct EdgePoint {
  Vec3<Real> position;
  Vec3<Real> cuts;   // unit vector: direction in which the edge cuts
  Vec3<Real> along;  // unit vector along the edge
  bool is_past;      // the other edge has passed it, so that it cuts nothing
};

/// Returns the number of points on an edge, at most `spacing` apart.
inline std::uint32_t points_of_edge(const ToolParameters& parameters) {
  return static_cast<std::uint32_t>(std::ceil(parameters[0] / parameters[2] - 1e-9)) + 1;
}

template <class T>
concept BladeTool = Tool<T> && requires(const PlacedTool<double>& tool, const ToolParameters& parameters) {
  requires T::kContactPoints == 0 && T::kJoints.size() <= 1;
  { T::kEdges } -> std::convertible_to<std::uint32_t>;
  { T::edge_points(parameters) } -> std::same_as<std::uint32_t>;
  { T::edge_point(tool, 0, 0, 1) } -> std::same_as<EdgePoint<double>>;
};

}  // namespace tensormass::physics
