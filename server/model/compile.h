#pragma once

#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <vector>

#include "core/result.h"
#include "model/model.h"
#include "model/progress.h"

namespace tensormass::v1 {
class Scene;
}

namespace tensormass::model {

class BodyCut;
/// The cuts of a scene (cut_bodies.h): [body]; nullptr: the body is whole. Empty: all are.
using SceneCuts = std::vector<std::shared_ptr<const BodyCut>>;

/// How a backend wants the mesh cut. A patch is one CPU thread or one GPU thread block.
struct PatchPolicy {
  std::uint32_t max_patches = 1;
  std::uint32_t min_nodes_per_patch = 1;  ///< fewer patches rather than smaller ones
  matrix::Storage storage = matrix::Storage::kRows;
  /// Patches to make where the limits on nodes leave a choice.
  std::uint32_t usual_patches = std::numeric_limits<std::uint32_t>::max();
  std::uint32_t max_nodes_per_patch = std::numeric_limits<std::uint32_t>::max();
  /// Patches with more nodes than this store tiles (kTiles) instead of rows (kRows).
  std::uint32_t tiles_beyond_nodes = std::numeric_limits<std::uint32_t>::max();
  /// A solve in single precision keeps its vectors in shared memory if no patch has more rows than this, halo included.
  /// Such a solve can also check the volume of tetrahedra.
  std::uint32_t solve_keeps_rows = 0;
  /// solve_of(layout): is called once, for single precision without kEdges. Returns who runs the solve. Empty: stages
  /// do.
  std::function<SolveKind(const matrix::Layout&)> solve_of = {};

  /// Returns how the matrix of a scene with so many nodes is stored.
  matrix::Storage storage_of(std::uint32_t node_count) const;
  /// Returns how many patches such a scene gets. Needs node_count ≥ 1.
  std::uint32_t count(std::uint32_t node_count) const;
};

/// Checks the whole scene and compiles it to a model that stages can trust.
///
/// Errors name the place in the scene, the element or node, and the remedy. kCancelled if `progress` says so. Asserts
/// the invariants of the model (check.h) once, so that steps need not.
///
/// cuts: of the bodies of this scene; empty: all are whole
Result<Model> compile(const v1::Scene& scene, const PatchPolicy& policy, const Progress& progress = {},
                      const SceneCuts& cuts = {});

/// Returns how many CPU threads the scene asks for; 0 if it does not say.
std::uint32_t requested_cpu_threads(const v1::Scene& scene);

}  // namespace tensormass::model
