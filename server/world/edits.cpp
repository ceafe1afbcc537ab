#include "world/edits.h"

#include <algorithm>
#include <type_traits>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"

namespace tensormass::world {

namespace {

bool adjusts(const DoneEdit& done) { return std::holds_alternative<Adjust>(*done.edit); }

}  // namespace

void add_edit(std::vector<DoneEdit>& edits, DoneEdit next) {
  if (!adjusts(next)) {
    // The state becomes another one, whatever it was. Values stay as they are.
    std::erase_if(edits, [](const DoneEdit& done) { return !adjusts(done); });
    if (edits.size() > 1) edits.erase(edits.begin(), edits.end() - 1);
  } else if (!edits.empty() && adjusts(edits.back())) {
    edits.pop_back();
  }
  edits.push_back(std::move(next));
  TM_ASSERT(edits.size() <= kMaxEditsOfStep, "values, a state, values");
}

std::size_t bytes_of(const Edit& edit) {
  if (const auto* adjust = std::get_if<Adjust>(&edit)) return adjust->values.ByteSizeLong();
  if (const auto* restore = std::get_if<Restore>(&edit)) return restore->snapshot.size();
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
    case v1::RecordedEdit::EDIT_NOT_SET:
      break;
  }
  return invalid(
      fmt::format("{}: has no edit that this server knows; replay it with the server that recorded it, or a "
                  "newer one",
                  where));
}

}  // namespace tensormass::world
