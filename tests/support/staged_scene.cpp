#include "support/staged_scene.h"

#include <thread>

#include "backend/cpu/elements.h"
#include "backend/stages.h"
#include "support/host_rows.h"

// TM_REAL, float or double, comes from the build.
namespace tensormass::tests {

template <class Real>
void StagedScene<Real>::run(const model::Stage& stage) {
  const tensor::ElementView<Real>& elements = groups_[stage.group];
  const auto on_each_patch = [&](const auto& run_stage) {
    backend::cpu::Barrier barrier(view.patch_count);
    std::vector<std::thread> threads;
    for (std::uint32_t patch = 0; patch < view.patch_count; ++patch) {
      threads.emplace_back([&, patch] {
        backend::cpu::Team team(patch, view.patch_count, barrier);
        run_stage(team);
      });
    }
    for (std::thread& thread : threads) thread.join();
  };
  if (model.layout.storage == tensor::Storage::kRows) {  // a GPU has its own version of this stage
    constexpr std::uint32_t kCapacity = 20;              // columns: most rows fit, some need several passes
    if (stage.kind == model::StageKind::kElements) {
      const model::ElementGroup& group = model.groups[stage.group];
      return assemble_rows(group.shape, group.law, view, elements, kCapacity);
    }
    if (stage.kind == model::StageKind::kAssemble) return finish_rows(!model.constant_edges.empty(), view);
  }
  if (stage.kind == model::StageKind::kElements) {
    const model::ElementGroup& group = model.groups[stage.group];
    const auto pass = backend::cpu::element_passes<Real>(group.shape, group.law).tensors;
    on_each_patch([&](backend::cpu::Team& team) { pass(team, view, elements); });
  }
  backend::with_stage(model, stage, [&](auto type) {
    on_each_patch([&](backend::cpu::Team& team) { decltype(type)::run(team, view, elements); });
  });
}

template void StagedScene<TM_REAL>::run(const model::Stage&);

}  // namespace tensormass::tests
