#pragma once

#include <cstdint>
#include <limits>

#include "core/result.h"
#include "model/model.h"
#include "model/progress.h"
#include "tensormass/v1/scene.pb.h"

namespace tensormass::model {

/// How a backend wants the mesh cut. A patch is one CPU thread or one GPU thread block.
struct PatchPolicy {
  std::uint32_t max_patches = 1;
  std::uint32_t min_nodes_per_patch = 1;
  tensor::Storage storage = tensor::Storage::kRows;
  /// As many as are wanted where the numbers of nodes leave a choice.
  std::uint32_t usual_patches = std::numeric_limits<std::uint32_t>::max();
  std::uint32_t max_nodes_per_patch = std::numeric_limits<std::uint32_t>::max();
  /// Patches of more nodes than this are kTiles in place of kRows.
  std::uint32_t tiles_beyond_nodes = std::numeric_limits<std::uint32_t>::max();
  /// In single precision a solve has its vectors near, in no buffer of the scene, and can check the volume of
  /// tetrahedra, if no patch has more rows than this, those of its halo included.
  std::uint32_t solve_keeps_rows = 0;
  tensor::Storage storage_of(std::uint32_t node_count) const;
  std::uint32_t count(std::uint32_t node_count) const;
};

/// Checks the whole scene and compiles it. Errors name the place in the scene, the element or node, and the remedy;
/// kCancelled if `progress` says so.
Result<Model> compile(const v1::Scene& scene, const PatchPolicy& policy, const Progress& progress = {});

/// Threads that the scene asks for on a CPU; `otherwise` if it does not say.
std::uint32_t requested_cpu_threads(const v1::Scene& scene, std::uint32_t otherwise);

}  // namespace tensormass::model
