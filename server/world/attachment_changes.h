#pragma once

#include <cstddef>
#include <limits>
#include <span>
#include <vector>

#include "core/result.h"
#include "model/model.h"
#include "tensormass/v1/adjustment.pb.h"
#include "tensormass/v1/scene.pb.h"
#include "world/fixed_name.h"
#include "world/world.h"

/// Attachments that are added to a scene that steps, such as clips, and removed from it. They are values of it, as
/// tools are (tool_changes.h): the scene is compiled again with other springs, and takes the place of the present one
/// between two steps (Loop::do_swap).
///
///   EditScene ──edited_attachments──> compile ──state_rest_lengths──┐
///   a recording, AdjustScene ───────────────────────────────────────┴─> SceneAdjustments.attachments, World
///
/// The lengths at rest are stated as late as possible, because tissue moves while the scene is compiled. Once they are,
/// a replay and a snapshot have them to the last bit.
namespace tensormass::world {

/// Place of an attachment that the present scene does not have.
inline constexpr std::size_t kNewAttachment = std::numeric_limits<std::size_t>::max();

/// How the attachments of two generations of a scene differ.
struct AttachmentChange {
  /// One that comes or goes, for an event.
  struct Told {
    FixedName name;
    bool added;
    std::size_t springs;
  };

  std::vector<std::size_t> places;  ///< [attachment of the next scene] its place in the present one, or kNewAttachment
  std::vector<Told> told;
};

/// Returns the attachments beside those that were loaded, after an edit. present: those before it. Fails if the edit
/// has something else, names one twice, takes a name that is taken, or removes one that was not added. A compile checks
/// the rest.
Result<v1::SceneAttachments> edited_attachments(const v1::Scene& loaded, const v1::SceneAttachments& present,
                                                const v1::SceneEdit& edit);

/// States the lengths at rest of attachments that leave them open: the present distances. Fails if they have too many
/// springs, or if a new one has too much energy, or a spring at a node without material.
///
///   present       has the layout of the state; the bodies are those of `next`
///   next          a model with the attachments, loaded ones first; gets the lengths
///   attachments   those beside the loaded ones; gets the lengths, and the energies of new ones
///   new_count     how many of them an edit adds, the last ones
Result<void> state_rest_lengths(const model::Model& present, const World::Copied& state, model::Model& next,
                                v1::SceneAttachments& attachments, std::size_t new_count);

/// Returns how attachments differ. An attachment goes on if the next scene has one of its name with the same
/// description. loaded_count: attachments of the scene as loaded, which go on
AttachmentChange change_of(const model::Model& present, const v1::SceneAttachments& present_added,
                           const model::Model& next, const v1::SceneAttachments& next_added, std::size_t loaded_count);

/// Returns a state for a scene that differs by its attachments. New springs are whole, unless they hang on a node that
/// has lost its material by now.
NodeState with_attachments(const model::Model& present, const model::Model& next, const World::Saved& saved,
                           std::span<const std::size_t> places);

}  // namespace tensormass::world
