#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

#include "core/result.h"
#include "tensormass/v1/adjustment.pb.h"
#include "tensormass/v1/edit.pb.h"
#include "tensormass/v1/recording.pb.h"

/// The edits of a scene: what can be done to it between two steps.
///
///     a call ───────> Runner::Impl::apply ──> the scene, between two steps ──> Recording::take_edit ──> reader
///                            ^                                                                            │
///     ReplayScene ──> read_edit <──────────────────── RecordedEdit ───────────────────────────────────────┘
///
/// This is the one list. Dispatch, recording and replay follow from it. A new edit needs a struct in Edit, its message
/// in RecordedEdit, and a case in Runner::Impl::apply; the compiler names the last two. Ablation, links, tools and cuts
/// come here.
namespace tensormass::world {

/// AdjustScene, a cut, or other tools or attachments. values: all of them, after it.
struct Adjust {
  v1::SceneAdjustments values;
  bool changes_parts = false;  ///< tools or attachments; known once it is done
};
/// RestoreScene. snapshot: as in SnapshotSceneResponse.
struct Restore {
  std::string snapshot;
};
/// ResetScene.
struct Reset {};
/// EditScene.
struct ChangeScene {
  v1::SceneEdit edit;
};

using Edit = std::variant<Adjust, Restore, Reset, ChangeScene>;
/// Shared, because a snapshot is large, and made by the caller, because a command of the loop must not fail without
/// memory.
using EditPointer = std::shared_ptr<const Edit>;

/// An edit that was done.
struct DoneEdit {
  EditPointer edit;
  std::uint64_t step = 0;  ///< steps of the scene after it
};

/// EditScene calls, and changes of tools or attachments, between two steps of a scene that is recorded; a call for more
/// is refused.
inline constexpr std::size_t kMaxChangesOfStep = 64;
/// Number of edits that `add_edit` keeps at most.
inline constexpr std::size_t kMaxEditsOfStep = 3 + kMaxChangesOfStep;

/// Returns how many EditScene calls and changes of tools or attachments are among edits.
std::size_t count_changes(const std::vector<DoneEdit>& edits);

/// Adds an edit to those since the last step, and drops what nothing depends on any more: a state that is replaced, and
/// values that are. Values with other tools or attachments stay: one that was removed and added again is not the one
/// before. So any number of edits between two steps becomes at most kMaxEditsOfStep: values, a state, then values and
/// at most kMaxChangesOfStep calls of EditScene, for which the caller cares.
void add_edit(std::vector<DoneEdit>& edits, DoneEdit next);

/// Bytes of an edit in a recording, about.
std::size_t bytes_of(const Edit& edit);

/// index: of the step that follows.
void write_edit(std::uint64_t index, const DoneEdit& done, v1::RecordedEdit& out);
/// Fails if the message has no edit that this server knows. Who does the edit checks its values.
Result<EditPointer> read_edit(const v1::RecordedEdit& message, std::string_view where);

}  // namespace tensormass::world
