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
#include "world/runner_options.h"

namespace tensormass::world {

/// A scene's model with the backend it was compiled for.
struct CompiledScene {
  std::unique_ptr<backend::Backend> backend;
  std::unique_ptr<model::Model> model;
  v1::SceneReport report;
  std::uint64_t scene_hash = 0;  ///< hashes.h
};

/// Selects the backend and compiles the scene for it. Errors name the body, the element and the remedy.
/// cuts: of its bodies
Result<CompiledScene> compile_scene(const v1::Scene& scene, const RunnerOptions& options,
                                    const model::Progress& progress = {}, const model::SceneCuts& cuts = {});

}  // namespace tensormass::world
