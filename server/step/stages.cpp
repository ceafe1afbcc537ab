#include "step/stages.h"

#include <iterator>

namespace tensormass::step {

namespace {

StageSizes sizes_of(const model::Model& model, const Stage& stage) {
  return {model, is_of_group(stage.info->scope) ? &model.groups[stage.group] : nullptr};
}

}  // namespace

std::vector<Stage> list_stages(const model::Model& model) {
  std::vector<Stage> stages;
  const auto add_if_needed = [&](const Stage& stage) {
    if (stage.info->needed(sizes_of(model, stage))) stages.push_back(stage);
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
