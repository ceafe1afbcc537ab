#include <algorithm>
#include <cmath>
#include <memory>
#include <numeric>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "core/attachment_limits.h"
#include "core/log.h"
#include "core/parallel.h"
#include "model/scene_input.h"
#include "model/values.h"
#include "world/cuts.h"
#include "world/hashes.h"
#include "world/runner_impl.h"
#include "world/snapshot.h"
#include "world/tool_changes.h"

/// How a runner does the edits of edits.h: in place, or by a world that takes the place of the present one.
namespace tensormass::world {

namespace {

/// Simulated time between two cuts of what blades sweep in a scene that steps by hand.
constexpr double kBetweenCutsS = 0.1;

/// Returns a generation with inboxes for new tools, and with the topology of other tools and attachments. places: as of
/// places_before
GenerationPointer with_parts_of(const Generation& next, std::span<const std::size_t> places) {
  Generation out = next;
  out.inboxes = new_inboxes(places.size());
  for (std::size_t i = 0; i < places.size(); ++i) {
    if (places[i] != kNewTool) out.inboxes[i] = next.inboxes[places[i]];
  }
  v1::Topology topology = *next.topology;
  topology.set_version(new_topology_version());
  fill_parts(*next.model, topology);
  out.topology = std::make_shared<const v1::Topology>(std::move(topology));
  return std::make_shared<const Generation>(std::move(out));
}

/// Returns the findings of a compile that concern new tools.
std::vector<v1::Finding> findings_of(const v1::SceneReport& report, const model::Model& model,
                                     std::span<const std::size_t> places) {
  std::vector<v1::Finding> out;
  for (const v1::Finding& finding : report.findings()) {
    for (std::size_t i = 0; i < places.size(); ++i) {
      if (places[i] == kNewTool && finding.tool() == model.tools[i].name) out.push_back(finding);
    }
  }
  return out;
}

}  // namespace

Result<v1::SceneStatus> Runner::Impl::apply(const EditPointer& edit) {
  return std::visit([&](const auto& kind) { return apply(kind, edit); }, *edit);
}

/// Adjusts also to the values that the scene has: a replay needs what that does to the energy balance.
Result<v1::SceneStatus> Runner::Impl::apply(const Adjust& adjust, const EditPointer&) {
  if (!source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(adjusting);
  TM_ASSIGN_OR_RETURN(wanted, with_changes(loop->generation()->adjustments, adjust.values));
  TM_RETURN_IF_ERROR(take_values(std::move(wanted)));
  forget_parts();
  return loop->status().make();
}

/// Changes values at once, or, where a tool touches tissue whose stiffness changes much, from part to part. Each part
/// is an adjustment of its own, so a recording has it and a snapshot names its values. Needs `adjusting`.
Result<void> Runner::Impl::change_values(v1::SceneAdjustments wanted) {
  // Refuses bad values before the first part.
  const v1::SceneAdjustments present = loop->generation()->adjustments;
  const bool in_parts =
      next_part(present, wanted).SerializeAsString() != with_edits_of(present, wanted).SerializeAsString();
  TM_ASSIGN_OR_RETURN(touching, loop->call([&] { return loop->do_touching(); }));
  if (!in_parts || !touching) {
    TM_RETURN_IF_ERROR(take_values(std::move(wanted)));
    forget_parts();
    return {};
  }
  // Cuts, tools and attachments have no parts.
  v1::SceneAdjustments edited = with_edits_of(wanted, present);
  if (edited.SerializeAsString() != present.SerializeAsString()) TM_RETURN_IF_ERROR(take_values(std::move(edited)));
  TM_RETURN_IF_ERROR(model::with_values(*loop->generation()->model, adjusted(source->scene, wanted), spare));
  coming = Coming{std::move(wanted), 0};
  const auto taken = take_next_part();
  if (!taken) forget_parts();
  return taken;
}

/// Takes the next part of the change that comes. Without a tool that touches it is the last one. Needs `adjusting`.
Result<void> Runner::Impl::take_next_part() {
  const GenerationPointer present = loop->generation();
  TM_ASSIGN_OR_RETURN(touching, loop->call([&] { return loop->do_touching(); }));
  v1::SceneAdjustments part = next_part(present->adjustments, coming->wanted);
  v1::SceneAdjustments last = with_edits_of(present->adjustments, coming->wanted);
  const bool ends = !touching || part.SerializeAsString() == last.SerializeAsString();
  TM_RETURN_IF_ERROR(take_values(ends ? std::move(last) : std::move(part)));
  if (ends) {
    forget_parts();
    return {};
  }
  const auto steps = std::max(1L, std::lround(kBetweenPartsS / present->model->dt_s));
  coming->step = loop->status().make().step() + static_cast<std::uint64_t>(steps);
  comes = true;
  loop->wake_at(coming->step);
  if (!present->model->lockstep) changer.start(*this);
  return {};
}

/// Takes the next part if its step is done.
Result<void> Runner::Impl::take_due_part() {
  const std::lock_guard lock(adjusting);
  if (!coming || loop->status().make().step() < coming->step) return {};
  const auto taken = take_next_part();
  if (!taken) forget_parts();
  return taken;
}

/// Takes what is left of a change at once: nothing touches after a reset. Needs `adjusting`.
Result<void> Runner::Impl::take_last_part() {
  if (!coming) return {};
  TM_RETURN_IF_ERROR(take_values(with_edits_of(loop->generation()->adjustments, coming->wanted)));
  forget_parts();
  return {};
}

/// Gives the scene other values and cuts: in place if only numbers change, else by another world. Needs `adjusting`.
Result<void> Runner::Impl::take_values(v1::SceneAdjustments wanted) {
  const GenerationPointer present = loop->generation();
  TM_ASSIGN_OR_RETURN(cuts, read_cuts(source->scene, wanted, present->cuts));
  if (cuts == present->cuts && same_parts(wanted, present->adjustments)) {
    const v1::Scene scene = adjusted(source->scene, wanted);
    // The hash reads all meshes, which takes as long as the values do.
    std::uint64_t scene_hash = 0;
    Result<std::shared_ptr<const model::Model>> made;
    parallel_for(2, [&](std::size_t i) {
      if (i == 0) {
        made = model::with_values(*present->model, scene, spare);
      } else {
        scene_hash = hash_of(scene);
      }
    });
    TM_ASSIGN_OR_RETURN(model, std::move(made));
    if (model != nullptr) return write_values(scene_hash, std::move(wanted), std::move(model));
  }
  return swap_world(std::move(wanted), std::move(cuts));
}

/// Gives the world other values in place. Needs `adjusting`. scene_hash: with the values; model: likewise
Result<void> Runner::Impl::write_values(std::uint64_t scene_hash, v1::SceneAdjustments wanted,
                                        std::shared_ptr<const model::Model> model) {
  const GenerationPointer present = loop->generation();
  const auto edit = std::make_shared<const Edit>(Adjust{wanted});
  TM_ASSIGN_OR_RETURN(values, loop->prepare_values(model));
  auto next = next_generation(*present, std::move(model), scene_hash, std::move(wanted), present->cuts);
  Loop::NewValues all{std::move(values), std::move(next), edit};
  return loop->call([&] { return loop->do_take_values(all); });
}

/// scene_hash: of the values without the cuts
GenerationPointer Runner::Impl::next_generation(const Generation& present, std::shared_ptr<const model::Model> model,
                                                std::uint64_t scene_hash, v1::SceneAdjustments wanted,
                                                model::SceneCuts cuts) const {
  const bool is_adjusted = wanted.SerializeAsString() != adjustments_of(source->scene).SerializeAsString();
  if (!cuts.empty()) scene_hash = hash_of_cut(scene_hash, wanted);
  return std::make_shared<const Generation>(Generation{present.number + 1, std::move(model), scene_hash,
                                                       std::move(wanted), is_adjusted, std::move(cuts), present.inboxes,
                                                       present.topology});
}

/// A cut is an adjustment of the values, so that recordings and snapshots have it.
Result<v1::SceneStatus> Runner::Impl::cut(const v1::SceneEdit& edit) {
  if (!source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(adjusting);
  const GenerationPointer present = loop->generation();
  TM_ASSIGN_OR_RETURN(cuts, cut_edges(source->scene, edit, present->cuts));
  TM_RETURN_IF_ERROR(take_cuts(std::move(cuts)));
  return loop->status().make();
}

/// Tools are values of the scene, as cuts are.
Result<v1::SceneStatus> Runner::Impl::change_tools(const v1::SceneEdit& edit, std::vector<v1::Finding>* findings) {
  if (!source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(adjusting);
  TM_RETURN_IF_ERROR(loop->status().require_not_faulted());
  const GenerationPointer present = loop->generation();
  v1::SceneAdjustments wanted = present->adjustments;
  TM_ASSIGN_OR_RETURN(tools, edited_tools(wanted.has_tools() ? wanted.tools().tools() : source->scene.tools(), edit));
  *wanted.mutable_tools() = tools;
  TM_RETURN_IF_ERROR(swap_world(std::move(wanted), present->cuts, nullptr, findings));
  if (coming) *coming->wanted.mutable_tools() = std::move(tools);
  return loop->status().make();
}

/// Attachments that are added are values of the scene, as tools are.
Result<v1::SceneStatus> Runner::Impl::change_attachments(const v1::SceneEdit& edit) {
  if (!source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(adjusting);
  TM_RETURN_IF_ERROR(loop->status().require_not_faulted());
  const GenerationPointer present = loop->generation();
  v1::SceneAdjustments wanted = present->adjustments;
  TM_ASSIGN_OR_RETURN(attachments, edited_attachments(source->scene, wanted.attachments(), edit));
  *wanted.mutable_attachments() = std::move(attachments);
  TM_RETURN_IF_ERROR(swap_world(std::move(wanted), present->cuts, nullptr, nullptr,
                                static_cast<std::size_t>(edit.add_attachments_size())));
  if (coming) *coming->wanted.mutable_attachments() = loop->generation()->adjustments.attachments();
  return loop->status().make();
}

/// Refuses attachments beside those of the load in a scene that may not have them.
Result<void> Runner::Impl::check_attachments(const v1::SceneAdjustments& wanted) const {
  const v1::SceneAttachments& attachments = wanted.attachments();
  for (int i = 0; i < attachments.energies_j_size(); ++i) {
    TM_RETURN_IF_ERROR(model::read_number(attachments.energies_j(i), 0, limits::kMaxAttachmentEnergyJ,
                                          fmt::format("changes.attachments.energies_j[{}]", i)));
  }
  if (attachments.attachments().empty() || source->scene.has_editing()) return {};
  return fail(
      ErrorCode::kFailedPrecondition,
      "changes.attachments: the scene has no room for attachments; load it with scene.editing, an empty message "
      "is enough");
}

/// Goes on with the scene cut. Needs `adjusting`.
Result<void> Runner::Impl::take_cuts(model::SceneCuts cuts) {
  v1::SceneAdjustments wanted = loop->generation()->adjustments;
  write_cuts(cuts, wanted);
  return swap_world(std::move(wanted), std::move(cuts));
}

/// Says why tissue stays whole although a blade went through, or keeps its values. The scene goes on.
void Runner::Impl::refuse(std::string_view what, const Error& error) const {
  log::warn(fmt::format("{} refused", what), {{"scene", name}, {"reason", error.message}});
}

/// Makes steps by hand. Cuts what was swept, and takes parts of a change of values, where the number of steps says so,
/// so that a run repeats.
Result<v1::SceneStatus> Runner::Impl::step_in_parts(std::uint32_t count) {
  const auto steps =
      static_cast<std::uint64_t>(std::max(1L, std::lround(kBetweenCutsS / loop->generation()->model->dt_s)));
  for (;;) {
    const std::uint64_t made = loop->status().make().step();
    std::uint64_t part = has_blades() ? std::min<std::uint64_t>(count, steps - made % steps) : count;
    {
      const std::lock_guard lock(adjusting);
      if (coming && coming->step > made) part = std::min(part, coming->step - made);
    }
    TM_ASSIGN_OR_RETURN(status, call([&](Loop& of) { return of.do_step(static_cast<std::uint32_t>(part)); }));
    if (const auto taken = take_due_part(); !taken) refuse("values", taken.error());
    if (has_blades() && status.step() % steps == 0) {
      if (const auto cut = cut_what_was_swept(); !cut) refuse("cut", cut.error());
    }
    if (count == part) return loop->status().make();
    count -= static_cast<std::uint32_t>(part);
  }
}

/// Cuts what blades have swept since the last call.
Result<void> Runner::Impl::cut_what_was_swept() {
  const std::lock_guard lock(adjusting);
  TM_ASSIGN_OR_RETURN(ways, loop->call([&] { return loop->do_take_ways(); }));
  if (ways.empty()) return {};
  const GenerationPointer present = loop->generation();
  TM_ASSIGN_OR_RETURN(cuts, cut_along(source->scene, ways, present->cuts));
  return cuts == present->cuts ? Result<void>{} : take_cuts(std::move(cuts));
}

Result<v1::SceneStatus> Runner::Impl::apply(const Restore& restore, const EditPointer& edit) {
  for (;;) {
    const GenerationPointer present = loop->generation();
    TM_ASSIGN_OR_RETURN(state, read_snapshot(*present->model, present->scene_hash, restore.snapshot));
    const LoopCopy copy = in_layout(*present->model, state);
    auto restored = loop->call([&] { return loop->do_restore(copy, edit, present); });
    // Adjusted since: the snapshot is read again, and refused with the reason.
    if (restored || loop->generation() == present) return restored;
  }
}

/// A reset heals cuts and takes added attachments out: the scene is the one that was loaded again.
Result<v1::SceneStatus> Runner::Impl::apply(const Reset&, const EditPointer& edit) {
  if (source) {
    const std::lock_guard lock(adjusting);
    TM_RETURN_IF_ERROR(take_last_part());
    if (const GenerationPointer present = loop->generation(); present->was_altered()) {
      v1::SceneAdjustments wanted = present->adjustments;
      if (!present->cuts.empty()) write_cuts({}, wanted);
      if (wanted.has_attachments()) wanted.mutable_attachments()->clear_attachments();
      TM_RETURN_IF_ERROR(swap_world(std::move(wanted), {}, edit));
      return loop->status().make();
    }
  }
  return loop->call([&] { return loop->do_reset(edit); });
}

Result<v1::SceneStatus> Runner::Impl::apply(const ChangeScene& change, const EditPointer& edit) {
  return loop->call([&] { return loop->do_edit(change.edit, edit); });
}

/// Compiles the adjusted scene while the present world steps. Then swaps the two. Needs `adjusting`.
/// cuts: those of `wanted`. reset: the edit that takes the scene to its start; nullptr: it goes on from its state.
/// findings: takes those of new tools. new_attachments: how many of the last attachments an edit adds
Result<void> Runner::Impl::swap_world(v1::SceneAdjustments wanted, model::SceneCuts cuts, const EditPointer& reset,
                                      std::vector<v1::Finding>* findings, std::size_t new_attachments) {
  TM_RETURN_IF_ERROR(check_attachments(wanted));
  const GenerationPointer present = loop->generation();
  const bool same_cuts = cuts == present->cuts;
  const bool same_values =
      same_cuts && wanted.SerializeAsString() != present->adjustments.SerializeAsString() &&
      with_edits_of(wanted, present->adjustments).SerializeAsString() == wanted.SerializeAsString();
  TM_ASSIGN_OR_RETURN(compiled, compile_scene(adjusted(source->scene, wanted), source->options, {}, cuts));
  if (!wanted.attachments().attachments().empty()) {
    TM_ASSIGN_OR_RETURN(now, loop->read([&] { return loop->do_copy(); }));
    TM_RETURN_IF_ERROR(
        state_rest_lengths(*present->model, now, *compiled.model, *wanted.mutable_attachments(), new_attachments));
    compiled.scene_hash = hash_of(adjusted(source->scene, wanted));
  }
  TM_ASSIGN_OR_RETURN(world, World::create(std::move(compiled.model), *compiled.backend));
  TM_ASSERT(!same_cuts || hash_of_layout(world->model()) == hash_of_layout(*present->model),
            "values do not change the order of nodes");
  std::vector<std::size_t> places = places_before(*present->model, world->model());
  const bool same_tools = stay(places, present->model->tools.size());
  AttachmentChange attachments =
      change_of(*present->model, present->adjustments.attachments(), world->model(), wanted.attachments(),
                static_cast<std::size_t>(source->scene.attachments_size()));
  const std::vector<std::uint32_t>& springs = present->model->links.attachment_begin;
  const bool same_attachments = stay(attachments.places, springs.empty() ? 0 : springs.size() - 1);
  const bool changes_parts = !same_tools || !same_attachments;
  const auto edit = std::make_shared<const Edit>(Adjust{wanted, changes_parts});
  const bool has_frames = world->model().visible.count() > 0;
  std::shared_ptr<SurfaceChanges> surface = same_cuts || !has_frames ? nullptr : changes_of(world->model(), cuts);
  auto next = next_generation(*present, world->shared_model(), compiled.scene_hash, std::move(wanted), std::move(cuts));
  if (changes_parts) next = with_parts_of(*next, places);
  world->set_topology_version(next->topology->version());
  const auto& energies_j = next->adjustments.attachments().energies_j();
  world->allow_springs(std::accumulate(energies_j.begin(), energies_j.end(), 0.0));
  std::vector<v1::Finding> found = findings_of(compiled.report, world->model(), places);
  Loop::Swap swap{std::move(world), next, reset == nullptr ? edit : nullptr, std::move(surface), reset == nullptr};
  if (!same_tools) swap.places = std::move(places);
  if (!same_attachments) swap.attachments = std::move(attachments);
  swap.same_values = same_values;
  const auto swapped = loop->call([&]() -> Result<void> {
    TM_RETURN_IF_ERROR(loop->do_swap(swap));
    if (reset != nullptr) TM_RETURN_IF_ERROR(loop->do_reset(reset));
    return {};
  });
  if (!swapped) return swapped;
  if (findings != nullptr) *findings = std::move(found);
  if (has_blades() && !next->model->lockstep) changer.start(*this);
  return {};
}

}  // namespace tensormass::world
