#include "world/compiled_scene.h"

#include "model/compile.h"
#include "step/plan.h"
#include "world/hashes.h"

namespace tensormass::world {

namespace {

Result<std::unique_ptr<backend::Backend>> make_backend(const RunnerOptions& options) {
  if (options.backend != BackendChoice::kCpu) {
    auto cuda = backend::make_cuda_backend(options.gpu_scenes);
    if (cuda || options.backend == BackendChoice::kCuda) return cuda;
  }
  return backend::make_cpu_backend(options.cpu_threads);
}

}  // namespace

Result<CompiledScene> compile_scene(const v1::Scene& scene, const RunnerOptions& options,
                                    const model::Progress& progress, const model::SceneCuts& cuts) {
  TM_ASSIGN_OR_RETURN(backend, make_backend(options));
  const std::uint32_t cpu_threads = model::requested_cpu_threads(scene);
  TM_ASSIGN_OR_RETURN(model, model::compile(scene, backend->patch_policy(cpu_threads), progress, cuts));
  v1::SceneReport report = step::make_report(model, backend->rates(cpu_threads));
  return CompiledScene{std::move(backend), std::make_unique<model::Model>(std::move(model)), std::move(report),
                       hash_of(scene)};
}

Result<BackendDescription> describe_backend(BackendChoice choice) {
  std::string reason = "it was asked for";
  if (choice == BackendChoice::kAuto) {
    const auto cuda = backend::make_cuda_backend();
    reason = cuda ? "a GPU answers" : cuda.error().message;
    choice = cuda ? BackendChoice::kCuda : BackendChoice::kCpu;
  }
  TM_ASSIGN_OR_RETURN(backend, make_backend({.backend = choice}));
  return BackendDescription{backend->name(), backend->device(), std::move(reason)};
}

}  // namespace tensormass::world
