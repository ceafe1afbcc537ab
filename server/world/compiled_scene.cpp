#include "world/compiled_scene.h"

#include <utility>

#include "model/compile.h"
#include "step/plan.h"
#include "world/hashes.h"

namespace tensormass::world {

namespace {

Result<std::unique_ptr<backend::Backend>> make_backend(const RunnerOptions& options) {
  if (options.backend != BackendChoice::kCpu) {
    auto cuda = backend::make_cuda_backend(options.gpu_scenes, options.device);
    if (cuda || options.backend == BackendChoice::kCuda) return cuda;
  }
  return backend::make_cpu_backend(options.cpu_threads);
}

bool places(const RunnerOptions& options) {
  return options.placement != nullptr && options.backend != BackendChoice::kCpu;
}

/// Compiles a scene for any GPU: all of a placement compile it alike.
Result<CompiledScene> compile_somewhere(const v1::Scene& scene, RunnerOptions options,
                                        const model::Progress& progress) {
  if (places(options)) options.device = options.placement->preview({});
  return compile_scene(scene, options, progress);
}

DeviceNeeds needs_of(const CompiledScene& compiled) {
  const model::Model& model = *compiled.model;
  return {compiled.report.bytes_total(),
          share_of_device(model.layout.patch_count, compiled.max_patches, model.lockstep ? 0 : model.rate_hz,
                          1 / compiled.report.expected_rate_hz())};
}

/// Goes to another GPU of the same kind.
Result<void> go_to(std::uint32_t device, CompiledScene& compiled) {
  compiled.report.set_device(device);
  if (device == compiled.options.device) return {};
  compiled.options.device = device;
  TM_ASSIGN_OR_RETURN(backend, make_backend(compiled.options));
  compiled.backend = std::move(backend);
  return {};
}

}  // namespace

Result<CompiledScene> compile_scene(const v1::Scene& scene, const RunnerOptions& options,
                                    const model::Progress& progress, const model::SceneCuts& cuts) {
  TM_ASSIGN_OR_RETURN(backend, make_backend(options));
  const std::uint32_t cpu_threads = model::requested_cpu_threads(scene);
  const model::PatchPolicy policy = backend->patch_policy(cpu_threads);
  TM_ASSIGN_OR_RETURN(model, model::compile(scene, policy, progress, cuts));
  v1::SceneReport report = step::make_report(model, backend->rates(cpu_threads));
  CompiledScene out{std::move(backend), std::make_unique<model::Model>(std::move(model)), std::move(report),
                    hash_of(scene), options};
  out.max_patches = policy.max_patches;
  if (out.backend->name() == "cuda") {
    // A GPU that fails later must not bring the scene to the CPU.
    out.options.backend = BackendChoice::kCuda;
    out.report.set_device(options.device);
  }
  return out;
}

Result<CompiledScene> compile_and_place(const v1::Scene& scene, const RunnerOptions& options,
                                        const model::Progress& progress) {
  TM_ASSIGN_OR_RETURN(compiled, compile_somewhere(scene, options, progress));
  if (!places(options) || compiled.backend->name() != "cuda") return std::move(compiled);
  compiled.place = options.placement->place(needs_of(compiled));
  TM_RETURN_IF_ERROR(go_to(compiled.place->device(), compiled));
  return std::move(compiled);
}

Result<CompiledScene> compile_and_preview(const v1::Scene& scene, const RunnerOptions& options,
                                          const model::Progress& progress) {
  TM_ASSIGN_OR_RETURN(compiled, compile_somewhere(scene, options, progress));
  if (!places(options) || compiled.backend->name() != "cuda") return std::move(compiled);
  compiled.report.set_device(options.placement->preview(needs_of(compiled)));
  return std::move(compiled);
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
