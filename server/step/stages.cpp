#include "step/stages.h"

#include <iterator>

namespace tensormass::step {

namespace {

/// The last stages up to kApplyBalance, and how often they run: friction of a body that starts to slide yields contact
/// by contact, and each pass lets those yield that the last one has loaded too much.
constexpr int kStagesOfBalance = 3, kBalancePasses = 3;

StageSizes sizes_of(const model::Model& model, const Stage& stage) {
  return {model, is_of_group(stage.info->scope) ? &model.groups[stage.group] : nullptr};
}

}  // namespace

std::vector<Stage> list_stages(const model::Model& model) {
  std::vector<Stage> stages;
  const auto add_if_needed = [&](const Stage& stage) {
    if (!stage.info->needed(sizes_of(model, stage))) return;
    stages.push_back(stage);
    if (stage.info->kind != StageKind::kApplyBalance) return;
    const std::vector<Stage> pass(stages.end() - kStagesOfBalance, stages.end());
    for (int again = 1; again < kBalancePasses; ++again) stages.insert(stages.end(), pass.begin(), pass.end());
  };
  const StageInfo* const end = std::end(kStages);
  for (const StageInfo* first = std::begin(kStages); first != end;) {
    if (!is_of_group(first->scope)) {
      add_if_needed({first++});
      continue;
    }
    const StageInfo* last = first;
    while (last != end && is_of_group(last->scope) && last->phase == first->phase) ++last;
    for (std::uint32_t group = 0; group < model.groups.size(); ++group) {
      for (const StageInfo* info = first; info != last; ++info) add_if_needed({info, group});
    }
    first = last;
  }
  return stages;
}

Cost cost(const model::Model& model, const Stage& stage) { return stage.info->cost(sizes_of(model, stage)); }

}  // namespace tensormass::step
