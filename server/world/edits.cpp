#include "world/edits.h"

#include <algorithm>
#include <type_traits>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"

namespace tensormass::world {

namespace {

bool adjusts(const DoneEdit& done) { return std::holds_alternative<Adjust>(*done.edit); }
/// Whether the present state becomes another one, by an edit that counts.
bool changes(const DoneEdit& done) {
  const Adjust* adjust = std::get_if<Adjust>(done.edit.get());
  return std::holds_alternative<ChangeScene>(*done.edit) || (adjust != nullptr && adjust->changes_parts);
}
/// Whether the state becomes another one, whatever it was.
bool replaces_state(const DoneEdit& done) { return !adjusts(done) && !std::holds_alternative<ChangeScene>(*done.edit); }

}  // namespace

std::size_t count_changes(const std::vector<DoneEdit>& edits) {
  return static_cast<std::size_t>(std::count_if(edits.begin(), edits.end(), changes));
}

void add_edit(std::vector<DoneEdit>& edits, DoneEdit next) {
  if (replaces_state(next)) {
    std::erase_if(edits, [](const DoneEdit& done) { return !adjusts(done); });  // values stay as they are
    if (edits.size() > 1) edits.erase(edits.begin(), edits.end() - 1);
  } else if (adjusts(next)) {
    const auto state = std::find_if(edits.begin(), edits.end(), replaces_state);
    const auto is_replaced = [](const DoneEdit& done) { return adjusts(done) && !changes(done); };
    edits.erase(std::remove_if(state == edits.end() ? edits.begin() : state, edits.end(), is_replaced), edits.end());
  }
  edits.push_back(std::move(next));
  TM_ASSERT(edits.size() <= kMaxEditsOfStep, "values, a state, values, and as many changes as a step may have");
}

std::size_t bytes_of(const Edit& edit) {
  if (const auto* adjust = std::get_if<Adjust>(&edit)) return adjust->values.ByteSizeLong();
  if (const auto* restore = std::get_if<Restore>(&edit)) return restore->snapshot.size();
  if (const auto* change = std::get_if<ChangeScene>(&edit)) return change->edit.ByteSizeLong();
  return 0;
}

void write_edit(std::uint64_t index, const DoneEdit& done, v1::RecordedEdit& out) {
  out.set_index(index);
  out.set_step(done.step);
  std::visit(
      [&out](const auto& edit) {
        using Kind = std::decay_t<decltype(edit)>;
        if constexpr (std::is_same_v<Kind, Adjust>) {
          *out.mutable_adjust() = edit.values;
        } else if constexpr (std::is_same_v<Kind, Restore>) {
          out.set_restore(edit.snapshot);
        } else if constexpr (std::is_same_v<Kind, ChangeScene>) {
          *out.mutable_scene_edit() = edit.edit;
        } else {
          static_assert(std::is_same_v<Kind, Reset>, "an edit of the list has a message");
          out.mutable_reset();
        }
      },
      *done.edit);
}

Result<EditPointer> read_edit(const v1::RecordedEdit& message, std::string_view where) {
  switch (message.edit_case()) {
    case v1::RecordedEdit::kAdjust:
      return std::make_shared<const Edit>(Adjust{message.adjust()});
    case v1::RecordedEdit::kRestore:
      return std::make_shared<const Edit>(Restore{message.restore()});
    case v1::RecordedEdit::kReset:
      return std::make_shared<const Edit>(Reset{});
    case v1::RecordedEdit::kSceneEdit:
      return std::make_shared<const Edit>(ChangeScene{message.scene_edit()});
    case v1::RecordedEdit::EDIT_NOT_SET:
      break;
  }
  return invalid(
      fmt::format("{}: has no edit that this server knows; replay it with the server that recorded it, or a "
                  "newer one",
                  where));
}

}  // namespace tensormass::world
