#include "world/scene_edit.h"

#include <algorithm>
#include <cstring>
#include <numeric>
#include <string>
#include <string_view>

#include <fmt/format.h>

#include "core/limits.h"
#include "core/names.h"

namespace tensormass::world {

namespace {

Result<void> add_ablation(const model::Model& model, const v1::Ablation& message, std::string_view where,
                          std::vector<model::Ablation>& out) {
  const auto body = std::find_if(model.bodies.begin(), model.bodies.end(),
                                 [&](const model::BodyModel& one) { return one.name == message.body(); });
  if (body == model.bodies.end()) {
    return fail(ErrorCode::kNotFound,
                fmt::format("{}.body: the scene has no body '{}'; it has: {}", where, message.body(),
                            list_names(model.bodies, [](const auto& one) { return one.name; })));
  }
  const int count = message.elements_size(), shares = message.kept_size();
  if (shares > 1 && shares != count) {
    return invalid(fmt::format("{}.kept: {} shares for {} elements; give one for each, one for all, or none", where,
                               shares, count));
  }
  for (int i = 0; i < count; ++i) {
    const std::uint32_t element = message.elements(i);
    if (element >= body->element_count) {
      return fail(ErrorCode::kNotFound, fmt::format("{}.elements[{}]: body '{}' has {} elements, from 0 on, and not {}",
                                                    where, i, body->name, body->element_count, element));
    }
    out.push_back({body->element_begin + element, shares == 0 ? 0 : message.kept(shares == 1 ? 0 : i)});
  }
  return {};
}

Result<void> add_severing(const model::Model& model, const v1::Severing& message, std::string_view where,
                          std::span<const std::uint8_t> broken, std::vector<std::uint32_t>& out) {
  std::uint32_t first = 0;
  for (const model::VisibleAttachment& attachment : model.attachments) {
    const auto count = static_cast<std::uint32_t>(attachment.springs.size());
    if (attachment.name != message.attachment()) {
      first += count;
      continue;
    }
    for (std::uint32_t i = 0; message.springs().empty() && i < count; ++i) {
      if ((broken[(first + i) / 8] >> (first + i) % 8 & 1) == 0) out.push_back(first + i);
    }
    for (int i = 0; i < message.springs_size(); ++i) {
      if (message.springs(i) >= count) {
        return fail(ErrorCode::kNotFound,
                    fmt::format("{}.springs[{}]: attachment '{}' has {} springs, from 0 on, and not {}", where, i,
                                attachment.name, count, message.springs(i)));
      }
      out.push_back(first + message.springs(i));
    }
    return {};
  }
  if (model.attachments.empty() && model.links.spring_count() > 0) {
    return fail(
        ErrorCode::kFailedPrecondition,
        fmt::format("{}: a scene without frames does not name its attachments; set streams.frame_rate_hz", where));
  }
  return fail(ErrorCode::kNotFound,
              fmt::format("{}.attachment: the scene has no attachment '{}'; it has: {}", where, message.attachment(),
                          list_names(model.attachments, [](const auto& one) { return one.name; })));
}

template <class T>
void write_items(const std::vector<T>& items, std::string& out) {
  out.assign(reinterpret_cast<const char*>(items.data()), items.size() * sizeof(T));
}

template <class T>
Result<std::vector<T>> read_items(const std::string& bytes, std::size_t most, std::string_view where) {
  if (bytes.size() % sizeof(T) != 0 || bytes.size() / sizeof(T) > most) {
    return invalid(fmt::format("snapshot.{}: {} bytes do not fit the elements of this scene", where, bytes.size()));
  }
  std::vector<T> out(bytes.size() / sizeof(T));
  if (!out.empty()) std::memcpy(out.data(), bytes.data(), bytes.size());
  return out;
}

}  // namespace

Result<ModelChange> read_scene_edit(const model::Model& model, const v1::SceneEdit& edit,
                                    std::span<const std::uint8_t> broken) {
  if (edit.ablations().empty() && edit.severings().empty()) {
    return invalid("edit: is empty; give ablations, severings, cuts, tools or attachments");
  }
  std::size_t elements = 0;
  for (const v1::Ablation& ablation : edit.ablations()) elements += static_cast<std::size_t>(ablation.elements_size());
  if (elements > limits::kMaxElementsOfEdit) {
    return fail(
        ErrorCode::kResourceExhausted,
        fmt::format("edit.ablations: {} elements, more than limits::kMaxElementsOfEdit = {}; make several edits",
                    elements, limits::kMaxElementsOfEdit));
  }
  ModelChange out;
  for (int i = 0; i < edit.ablations_size(); ++i) {
    TM_RETURN_IF_ERROR(add_ablation(model, edit.ablations(i), fmt::format("edit.ablations[{}]", i), out.ablations));
  }
  for (int i = 0; i < edit.severings_size(); ++i) {
    TM_RETURN_IF_ERROR(
        add_severing(model, edit.severings(i), fmt::format("edit.severings[{}]", i), broken, out.springs));
  }
  return out;
}

void write_shares(const model::Editor::Shares& shares, v1::SnapshotState& out) {
  std::vector<std::uint32_t> elements;
  std::vector<double> kept;
  for (const model::Ablation& one : shares.ablations) {
    elements.push_back(one.element);
    kept.push_back(one.kept);
  }
  write_items(elements, *out.mutable_ablated_elements());
  write_items(kept, *out.mutable_ablated_kept());
  write_items(shares.batches, *out.mutable_ablated_batches());
}

Result<model::Editor::Shares> read_shares(const model::Model& model, const v1::SnapshotState& message) {
  const std::size_t most =
      model.edit_tables == nullptr ? 0 : model.bodies.back().element_begin + model.bodies.back().element_count;
  TM_ASSIGN_OR_RETURN(elements, read_items<std::uint32_t>(message.ablated_elements(), most, "ablated_elements"));
  TM_ASSIGN_OR_RETURN(kept, read_items<double>(message.ablated_kept(), most, "ablated_kept"));
  TM_ASSIGN_OR_RETURN(batches, read_items<std::uint32_t>(message.ablated_batches(), most, "ablated_batches"));
  std::size_t gone = 0;
  for (const std::uint32_t count : batches) {
    if (count == 0 || count > limits::kMaxElementsOfEdit) {
      return invalid("snapshot.ablated_batches: no edit takes so many elements");
    }
    gone += count;
  }
  if (kept.size() != elements.size() || gone > elements.size()) {
    return invalid("snapshot.ablated_elements: the lists of ablated elements have unequal lengths");
  }
  model::Editor::Shares out;
  out.batches = std::move(batches);
  for (std::size_t i = 0; i < elements.size(); ++i) {
    if ((kept[i] > 0) == (i < gone)) {
      return invalid("snapshot.ablated_kept: elements that are gone come first, with a share of 0");
    }
    out.ablations.push_back({elements[i], kept[i]});
  }
  return out;
}

}  // namespace tensormass::world
