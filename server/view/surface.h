#pragma once

#include <cstdint>

/// The visible surface: the vertices that clients see. Their positions are gathered only when a frame is due
/// (step/visible_surface.h).
namespace tensormass::view {

template <class Real>
struct SurfaceView {
  std::uint32_t vertex_count;
  const std::uint32_t* rows;  // [vertex_count, 4] rows of the element that carries the vertex
  const Real* weights;        // [vertex_count, 4]
  float* positions;           // [vertex_count, 3] m
};

}  // namespace tensormass::view
