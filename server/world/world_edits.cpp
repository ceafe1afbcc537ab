#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "model/values.h"
#include "world/world.h"

/// Edits of a world between two steps.
namespace tensormass::world {

namespace {
/// A tool touches with its tip if the closest triangle is this near to the tip's centre where the step began. Its shaft
/// may touch elsewhere.
constexpr double kTipReachRadii = 1.25;
}  // namespace

Result<void> World::check_springs(std::span<const std::uint32_t> springs) const {
  std::vector<bool> named(broken_.size(), false);
  for (const std::uint32_t spring : springs) {
    if (spring >= broken_.size()) {
      return fail(ErrorCode::kNotFound,
                  fmt::format("spring {} does not exist; the scene has {} springs, from 0 on", spring, broken_.size()));
    }
    if (named[spring]) return invalid(fmt::format("spring {} is named twice; name it once", spring));
    named[spring] = true;
    if ((broken_bits_[spring / 8] >> spring % 8 & 1) != 0) {
      return fail(ErrorCode::kFailedPrecondition,
                  fmt::format("spring {} is broken already; only a reset mends it", spring));
    }
  }
  return {};
}

Result<void> World::edit(std::span<const model::Ablation> ablations, std::span<const std::uint32_t> springs) {
  if (!editor_ && model_->editing && !ablations.empty()) {
    return fail(ErrorCode::kFailedPrecondition, "a scene with editing.cutting cannot ablate yet; leave cutting out");
  }
  if (!editor_ && !ablations.empty()) {
    return fail(ErrorCode::kFailedPrecondition,
                "the scene has no room for ablation; load it with scene.editing, an empty message is enough");
  }
  if (editor_) TM_RETURN_IF_ERROR(editor_->check(*model_, ablations));
  TM_RETURN_IF_ERROR(check_springs(springs));
  newly_broken_.clear();
  severed_.clear();
  for (const std::uint32_t spring : springs) severed_.severed.push_back(model_->links.spring_places[spring]);
  if (!springs.empty()) {
    state_->apply(severed_);
    read_broken();
    for (BrokenSprings& one : newly_broken_) one.severed = true;
  }
  if (!ablations.empty()) {
    apply(ablations);
    if (!broken_.empty()) read_broken();
  }
  last_.broken_springs = broken_count_;
  return {};
}

/// Ablates elements; the editor has checked them. tool: the one that burns them; kNone: an edit.
void World::apply(std::span<const model::Ablation> ablations, std::uint32_t tool) {
  for (const model::Ablation& one : ablations) {
    RemovedTissue& removed = removed_[model_->body_of_element(one.element)];
    removed.volume_m3 += (editor_->kept(one.element) - one.kept) * editor_->volume_m3(one.element);
    removed.tool = tool;
    removed.position_m.reset();
    if (tool != SceneEvent::kNone) removed.position_m = tip_m(tool);
  }
  const std::uint32_t revision = editor_->shape_revision();
  state_->apply(editor_->ablate(*edited_, ablations));
  if (editor_->shape_revision() != revision) take_edited_surfaces();
}

/// Lets tools with power burn the element at their tip, at the end of a step: the next one has less of it.
///
///   energy     level · power · efficiency · dt, and what the element before it did not take
///   share      falls by energy / (ablation_j_per_m3 · volume)
///
/// So the volume that is burnt away is the energy over ablation_j_per_m3, to within one element. An element that may
/// not go, as the last one of its body, is spared.
void World::burn() {
  if (!editor_) return;
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    const model::ToolModel& tool = model_->tools[i];
    const double power_w = tool.cautery_w * readings_[i].level;
    if (!(power_w > 0)) {
      unspent_j_[i] = 0;
      continue;
    }
    const backend::ToolForce& felt = forces_[i];
    if (!readings_[i].touching || !(felt.tip_distance_m <= kTipReachRadii * tool.radius_m)) continue;
    const std::uint32_t element = editor_->element_behind(felt.tip_triangle);
    if (element == mesh::kNone || element == spared_[i]) continue;
    const model::BodyModel& body = model_->bodies[model_->body_of_element(element)];
    const double whole_j = body.ablation_j_per_m3 * editor_->volume_m3(element);
    const double left = editor_->kept(element) - (unspent_j_[i] + power_w * model_->dt_s) / whole_j;
    const model::Ablation burnt{element, std::max(left, 0.0)};
    if (!editor_->check(*model_, {&burnt, 1})) {
      spared_[i] = element;
      unspent_j_[i] = 0;
      continue;
    }
    apply({&burnt, 1}, static_cast<std::uint32_t>(i));
    unspent_j_[i] = std::clamp(-left, 0.0, 1.0) * whole_j;
  }
}

/// Takes over a visible surface that an edit has changed.
void World::take_edited_surfaces() {
  enclosure_.take(*model_, *editor_);
  if (model_->visible.count() > 0) state_->gather_visible();
}

/// Makes the scene what edits have left elsewhere.
void World::take_shares(const model::Editor::Shares& shares) {
  if (!editor_) return;
  editor_->take(*edited_, shares, [&](const model::ModelEdit& edit) { state_->apply(edit); });
  enclosure_.take(*model_, *editor_);
  std::fill(removed_.begin(), removed_.end(), RemovedTissue{});
  for (const model::Ablation& one : shares.ablations) {
    removed_[model_->body_of_element(one.element)].volume_m3 += (1 - one.kept) * editor_->volume_m3(one.element);
  }
}

Result<void> World::check_shares(const SavedBesideTissue& saved) const {
  if (!editor_ || saved.shares.ablations.empty()) return {};
  return editor_->check_shares(*model_, saved.shares);
}

World::Values World::prepare_values(std::shared_ptr<const model::Model> next) const {
  auto buffers = state_->prepare(*next, model::changed(*loaded_, *next));
  Guard guard(*next);
  std::optional<model::EditedValues> edited;
  if (edited_ != nullptr) edited.emplace(*next);
  return {std::move(next), std::move(buffers), std::move(guard), std::move(edited)};
}

void World::take_values(Values& values) {
  state_->apply(*values.buffers);
  if (editor_) {
    state_->apply(editor_->take_values(*edited_, *values.model, *values.edited));
  } else {
    model_ = values.model.get();
  }
  loaded_.swap(values.model);
  values.guard.allow_springs(guard_.added_springs_j());
  guard_ = values.guard;
  energy_.start(energy_.kinetic_j(), diagnose_elastic_energy());
}

}  // namespace tensormass::world
