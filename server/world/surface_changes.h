#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

#include "mesh/mesh.h"
#include "model/edit.h"
#include "model/model.h"

namespace tensormass::world {

/// What became of a body's visible surface since its Topology. Append-only but for a new Topology. changes.proto is the
/// same on the wire.
struct BodyChanges {
  /// Ascending; numbered in the body: those of the topology, then appended ones.
  std::vector<std::uint32_t> dead_triangles;
  /// Place of each in Frame.positions; at least the topology's vertex count of the whole scene.
  std::vector<std::uint32_t> appended_vertices;
  /// Vertices numbered in the body: those of its topology, then appended_vertices.
  std::vector<mesh::Triangle> appended_triangles;
  /// [appended triangle] v1::BodyChanges::Face: 0 outer surface, 1 cut face, 2 burnt face
  std::vector<std::uint8_t> appended_kinds;
  /// [vertex, appended ones last] v1::BodyChanges::coagulation; empty: all tissue is raw
  std::vector<std::uint8_t> coagulation;
};

struct SurfaceChanges {
  /// 0: as in the topology. Grows by one with each edit that changes the surface, also with a reset. Never falls.
  std::uint32_t revision = 0;
  std::uint32_t appended_vertex_count = 0;  ///< sum over all bodies
  std::vector<BodyChanges> bodies;          ///< [body of the topology]; empty: all are as in the topology
};

/// Shared with the threads that send them, so nobody may change them any more.
using SurfaceChangesPointer = std::shared_ptr<const SurfaceChanges>;

/// Makes the changes of one scene, edit by edit. Keeps as many as readers may hold at once, so that a step in which a
/// tool burns an element away allocates nothing.
class SurfaceChangesMaker {
 public:
  /// Reserves for what the scene's editing allows, up to 65,536 triangles; nothing if it has none.
  explicit SurfaceChangesMaker(const model::Model& model);

  /// Returns the present changes if the surface is not as at the last call, else nullptr.
  SurfaceChangesPointer take(const model::Model& model, const model::Editor& editor);
  /// Gives changes that somebody else made the next revision.
  SurfaceChangesPointer number(std::shared_ptr<SurfaceChanges> changes) {
    changes->revision = ++revision_;
    return changes;
  }

 private:
  /// The newest, and two mailboxes of three slots.
  static constexpr std::size_t kKept = 8;

  std::array<std::shared_ptr<SurfaceChanges>, kKept> kept_;
  std::uint32_t revision_ = 0;
  const model::Editor* editor_ = nullptr;  // whose revision was taken last
  std::uint32_t taken_ = 0;
};

}  // namespace tensormass::world
