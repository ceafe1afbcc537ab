#pragma once

#include <cstdint>
#include <memory>

#include "backend/backend.h"
#include "core/result.h"
#include "model/compile.h"
#include "model/model.h"
#include "model/progress.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/scene.pb.h"
#include "world/placement.h"
#include "world/runner_options.h"

namespace tensormass::world {

/// A scene's model with the backend it was compiled for.
struct CompiledScene {
  std::unique_ptr<backend::Backend> backend;
  std::unique_ptr<model::Model> model;
  v1::SceneReport report;
  std::uint64_t scene_hash = 0;                       ///< hashes.h
  RunnerOptions options = {};                         ///< with which the scene is compiled again
  std::uint32_t max_patches = 1;                      ///< multiprocessors of a GPU
  std::unique_ptr<Placement::Place> place = nullptr;  ///< nullptr: nobody places it
};

/// Selects the backend and compiles the scene for it, on options.device. Errors name the body, the element and the
/// remedy.
/// cuts: of its bodies
Result<CompiledScene> compile_scene(const v1::Scene& scene, const RunnerOptions& options,
                                    const model::Progress& progress = {}, const model::SceneCuts& cuts = {});

/// Compiles the scene and takes a place for it, if there is a placement and it has GPUs.
Result<CompiledScene> compile_and_place(const v1::Scene& scene, const RunnerOptions& options,
                                        const model::Progress& progress = {});
/// The same without a place: on the GPU that the scene would get now.
Result<CompiledScene> compile_and_preview(const v1::Scene& scene, const RunnerOptions& options,
                                          const model::Progress& progress = {});

}  // namespace tensormass::world
