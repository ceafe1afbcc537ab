#pragma once

#include <cstddef>
#include <limits>
#include <span>
#include <vector>

#include "core/result.h"
#include "model/model.h"
#include "tensormass/v1/adjustment.pb.h"
#include "tensormass/v1/scene.pb.h"
#include "world/world.h"

/// Tools that are added to a scene that steps, and removed from it. They are values of it, as cuts are (cuts.h): the
/// scene is compiled again with other tools, and takes the place of the present one between two steps (Loop::do_swap).
///
///   EditScene ──edited_tools──┐
///   a recording, AdjustScene ─┴─> SceneAdjustments.tools ──compile──> World, with_tools of the present state
///
/// A tool goes on if the next scene has one of its name with the same description. All others are new: they fade into
/// contact within ToolMotion::kFadeS, so that they do not strike tissue that has moved to where they appear.
namespace tensormass::world {

/// Place of a tool that the present scene does not have.
inline constexpr std::size_t kNewTool = std::numeric_limits<std::size_t>::max();

/// Returns, for each tool of the next model, its place among the present tools, or kNewTool.
std::vector<std::size_t> places_before(const model::Model& present, const model::Model& next);
/// Returns whether nothing changes: each tool goes on at its place.
bool stay(std::span<const std::size_t> places, std::size_t present_count);

/// Returns the tools of a scene after an edit. present: those that it has. Fails if the edit has something else, names
/// a tool twice, or removes one that the scene does not have. A compile checks the rest.
Result<v1::SceneTools> edited_tools(const google::protobuf::RepeatedPtrField<v1::Tool>& present,
                                    const v1::SceneEdit& edit);

/// Returns a state for a scene that differs by its tools. What the tissue remembers of tools that are gone is gone.
///
///   present   has the tools of the state; the tissue is that of `next` (cut_state.h)
///   places    of places_before
World::Saved with_tools(const model::Model& present, const model::Model& next, const World::Saved& saved,
                        std::span<const std::size_t> places);

}  // namespace tensormass::world
