#include "world/attachment_changes.h"

#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/attachment_limits.h"
#include "core/limits.h"
#include "core/names.h"
#include "model/edit_tables.h"
#include "model/scene_input.h"
#include "world/guard.h"

namespace tensormass::world {

namespace {

using Attachments = google::protobuf::RepeatedPtrField<v1::Attachment>;

bool has(const Attachments& attachments, std::string_view name) {
  return std::any_of(attachments.begin(), attachments.end(),
                     [&](const v1::Attachment& attachment) { return attachment.name() == name; });
}

/// Reads the names that an edit removes.
Result<std::set<std::string_view>> read_removed(const v1::Scene& loaded, const v1::SceneAttachments& present,
                                                const v1::SceneEdit& edit) {
  std::set<std::string_view> out;
  for (int i = 0; i < edit.remove_attachments_size(); ++i) {
    const std::string& name = edit.remove_attachments(i);
    const std::string where = fmt::format("edit.remove_attachments[{}]", i);
    if (has(loaded.attachments(), name)) {
      return fail(ErrorCode::kFailedPrecondition,
                  fmt::format("{}: attachment '{}' was loaded with the scene; sever its springs instead", where, name));
    }
    if (!has(present.attachments(), name)) {
      return fail(ErrorCode::kNotFound,
                  fmt::format("{}: no attachment '{}' was added to the scene; these were: {}", where, name,
                              list_names(present.attachments(), [](const v1::Attachment& one) { return one.name(); })));
    }
    if (!out.insert(name).second) {
      return invalid(fmt::format("{}: attachment '{}' is named twice; name it once", where, name));
    }
  }
  return out;
}

/// Which nodes edits have left without material, by the row of a layout.
class Material {
 public:
  Material(const model::Model& model, const model::Editor::Shares& shares) : tables_(model.edit_tables.get()) {
    if (tables_ == nullptr || shares.ablations.empty()) return;
    gone_.resize(tables_->rows.begin.size() - 1, false);
    for (const model::Ablation& one : shares.ablations) gone_[one.element] = !(one.kept > 0);
  }
  bool is_left(std::uint32_t row) const {
    if (gone_.empty()) return true;
    const std::span<const model::EditTables::Corner> corners = tables_->corners[row];
    return std::any_of(corners.begin(), corners.end(), [&](const auto& corner) { return !gone_[corner.item]; });
  }

 private:
  const model::EditTables* tables_;
  std::vector<bool> gone_;  // [element] empty: none is
};

std::size_t attachment_count(const model::Model& model) {
  return model.links.attachment_begin.empty() ? 0 : model.links.attachment_begin.size() - 1;
}

/// Returns the rows at the ends of a spring. spring: in the order of the scene
std::array<std::uint32_t, 2> rows_of(const model::Model& model, std::uint32_t spring) {
  const std::size_t place = 2 * std::size_t{model.links.spring_places[spring]};
  return {model.links.spring_rows[place], model.links.spring_rows[place + 1]};
}

/// Returns the distance of the ends of a spring in a state [m]; where the next scene is cut further, at rest.
double distance_m(const model::Model& present, const backend::RowState& state, const model::Model& next,
                  std::uint32_t spring) {
  const bool same_nodes = present.layout.row_of_node.size() == next.layout.row_of_node.size();
  std::array<Vec3<double>, 2> ends;
  for (std::size_t end = 0; end < 2; ++end) {
    const std::uint32_t row = rows_of(next, spring)[end], node = next.layout.node_of_row[row];
    const std::size_t at = same_nodes ? 4 * std::size_t{present.layout.row_of_node[node]} : 0;
    for (std::size_t c = 0; c < 3; ++c) {
      const double moved = same_nodes ? state.displacement[at + c] : 0;
      ends[end][static_cast<int>(c)] = next.rest[4 * std::size_t{row} + c] + moved;
    }
  }
  return (ends[0] - ends[1]).norm();
}

}  // namespace

Result<v1::SceneAttachments> edited_attachments(const v1::Scene& loaded, const v1::SceneAttachments& present,
                                                const v1::SceneEdit& edit) {
  if (!edit.ablations().empty() || !edit.severings().empty() || !edit.cuts().empty() || !edit.add_tools().empty() ||
      !edit.remove_tools().empty()) {
    return invalid("edit: adds or removes attachments and changes something else; make two edits of it");
  }
  if (!loaded.has_editing()) {
    return fail(ErrorCode::kFailedPrecondition,
                "edit: the scene has no room for attachments; load it with scene.editing, an empty message is enough");
  }
  TM_ASSIGN_OR_RETURN(gone, read_removed(loaded, present, edit));
  v1::SceneAttachments out;
  for (int i = 0; i < present.attachments_size(); ++i) {
    if (gone.contains(present.attachments(i).name())) continue;
    *out.add_attachments() = present.attachments(i);
    out.add_energies_j(i < present.energies_j_size() ? present.energies_j(i) : 0);
  }
  for (int i = 0; i < edit.add_attachments_size(); ++i) {
    const v1::Attachment& attachment = edit.add_attachments(i);
    const std::string where = fmt::format("edit.add_attachments[{}]", i);
    TM_RETURN_IF_ERROR(model::check_name(attachment.name(), where + ".name"));
    if (gone.contains(attachment.name())) {
      return invalid(fmt::format("{}: the edit removes an attachment '{}', too; remove it first, by an edit of its own",
                                 where, attachment.name()));
    }
    if (has(loaded.attachments(), attachment.name()) || has(out.attachments(), attachment.name())) {
      return fail(
          ErrorCode::kAlreadyExists,
          fmt::format("{}: the scene has an attachment '{}' already; take another name", where, attachment.name()));
    }
    *out.add_attachments() = attachment;
  }
  const auto count = static_cast<std::size_t>(loaded.attachments_size() + out.attachments_size());
  if (count > limits::kMaxAttachments && !edit.add_attachments().empty()) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("edit.add_attachments: the scene would have {} attachments, more than "
                            "limits::kMaxAttachments = {}; remove some first",
                            count, limits::kMaxAttachments));
  }
  return out;
}

Result<void> state_rest_lengths(const model::Model& present, const World::Copied& state, model::Model& next,
                                v1::SceneAttachments& attachments, std::size_t new_count) {
  const std::size_t count = attachment_count(next);
  const auto added = static_cast<std::size_t>(attachments.attachments_size());
  TM_ASSERT(added <= count, "the model has them");
  if (added == 0) return {};
  const std::vector<std::uint32_t>& begin = next.links.attachment_begin;
  if (const std::uint32_t springs = begin[count] - begin[count - added]; springs > limits::kMaxAddedSprings) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("edit.add_attachments: the added attachments would have {} springs, more than "
                            "limits::kMaxAddedSprings = {}; choose fewer nodes, or remove some first",
                            springs, limits::kMaxAddedSprings));
  }
  const Material material(next, state.shares);
  for (std::size_t i = 0; i < added; ++i) {
    v1::Attachment& attachment = *attachments.mutable_attachments(static_cast<int>(i));
    const std::size_t place = count - added + i;
    const bool is_new = i + new_count >= added, is_open = attachment.rest_lengths_m().empty();
    double energy_j = 0;
    for (std::uint32_t spring = begin[place]; spring < begin[place + 1]; ++spring) {
      for (const std::uint32_t row : rows_of(next, spring)) {
        if (!is_new || material.is_left(row)) continue;
        const std::uint32_t node = next.layout.node_of_row[row];
        const model::BodyModel& body = next.bodies[next.body_of_node(node)];
        return fail(ErrorCode::kFailedPrecondition,
                    fmt::format("attachment '{}': node {} of body '{}' has no material any more; choose nodes of "
                                "what is left",
                                attachment.name(), node - body.node_begin, body.name));
      }
      const double length_m = distance_m(present, state.tissue.rows, next, spring);
      double* numbers = next.links.spring_numbers.data() + 3 * std::size_t{next.links.spring_places[spring]};
      if (!is_open) {
        energy_j += spring_energy_j(numbers, length_m);
        continue;
      }
      attachment.add_rest_lengths_m(length_m);
      numbers[1] = length_m;
      if (!next.attachments.empty()) {
        next.attachments[place].rest_lengths_m[spring - begin[place]] = static_cast<float>(length_m);
      }
    }
    if (!is_new) continue;
    if (energy_j > limits::kMaxAttachmentEnergyJ) {
      return fail(ErrorCode::kFailedPrecondition,
                  fmt::format("attachment '{}': its springs would come with {:.3g} J, more than "
                              "limits::kMaxAttachmentEnergyJ = {}; give larger rest_lengths_m or less stiffness",
                              attachment.name(), energy_j, limits::kMaxAttachmentEnergyJ));
    }
    attachments.add_energies_j(energy_j);
  }
  return {};
}

AttachmentChange change_of(const model::Model& present, const v1::SceneAttachments& present_added,
                           const model::Model& next, const v1::SceneAttachments& next_added, std::size_t loaded_count) {
  AttachmentChange out;
  for (std::size_t i = 0; i < loaded_count; ++i) out.places.push_back(i);
  const auto springs_of = [](const model::Model& model, std::size_t place) {
    return std::size_t{model.links.attachment_begin[place + 1] - model.links.attachment_begin[place]};
  };
  const auto find = [](const v1::SceneAttachments& among, const v1::Attachment& attachment) {
    const Attachments& all = among.attachments();
    const auto same = std::find_if(all.begin(), all.end(), [&](const v1::Attachment& one) {
      return one.name() == attachment.name() && one.SerializeAsString() == attachment.SerializeAsString();
    });
    return same == all.end() ? kNewAttachment : static_cast<std::size_t>(same - all.begin());
  };
  for (int i = 0; i < present_added.attachments_size(); ++i) {
    const v1::Attachment& attachment = present_added.attachments(i);
    if (find(next_added, attachment) != kNewAttachment) continue;
    const std::size_t springs = springs_of(present, loaded_count + static_cast<std::size_t>(i));
    out.told.push_back({FixedName(attachment.name()), false, springs});
  }
  for (int i = 0; i < next_added.attachments_size(); ++i) {
    const v1::Attachment& attachment = next_added.attachments(i);
    const std::size_t place = find(present_added, attachment);
    out.places.push_back(place == kNewAttachment ? kNewAttachment : loaded_count + place);
    if (place != kNewAttachment) continue;
    const std::size_t springs = springs_of(next, loaded_count + static_cast<std::size_t>(i));
    out.told.push_back({FixedName(attachment.name()), true, springs});
  }
  return out;
}

NodeState with_attachments(const model::Model& present, const model::Model& next, const World::Saved& saved,
                           std::span<const std::size_t> places) {
  TM_ASSERT(places.size() == attachment_count(next), "a place for each attachment");
  NodeState out = saved.tissue;
  out.broken.assign(sizes_of(next).broken, 0);
  std::optional<Material> material;
  for (std::size_t i = 0; i < places.size(); ++i) {
    const std::uint32_t begin = next.links.attachment_begin[i], end = next.links.attachment_begin[i + 1];
    if (places[i] != kNewAttachment) {
      const std::uint32_t before = present.links.attachment_begin[places[i]];
      std::copy_n(saved.tissue.broken.begin() + before, end - begin, out.broken.begin() + begin);
      continue;
    }
    if (!material) material.emplace(next, saved.shares);
    for (std::uint32_t spring = begin; spring < end; ++spring) {
      const auto [row, other] = rows_of(next, spring);
      out.broken[spring] = material->is_left(row) && material->is_left(other) ? 0 : 1;
    }
  }
  return out;
}

}  // namespace tensormass::world
