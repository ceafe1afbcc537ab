#include "world/adjustments.h"

#include <algorithm>
#include <cstring>
#include <set>
#include <string>
#include <string_view>

#include <fmt/format.h>

#include "core/names.h"
#include "model/scene_input.h"

namespace tensormass::world {

namespace {

/// Multiplies every modulus of a law. Moduli are the constants in pascal, by the names of their fields.
void scale(v1::Law& law, double factor) {
  const google::protobuf::OneofDescriptor* kinds = law.GetDescriptor()->FindOneofByName("kind");
  const google::protobuf::FieldDescriptor* kind = law.GetReflection()->GetOneofFieldDescriptor(law, kinds);
  if (kind == nullptr) return;
  google::protobuf::Message& constants = *law.GetReflection()->MutableMessage(&law, kind);
  const google::protobuf::Reflection& reflection = *constants.GetReflection();
  for (int i = 0; i < constants.GetDescriptor()->field_count(); ++i) {
    const google::protobuf::FieldDescriptor* field = constants.GetDescriptor()->field(i);
    if (!std::string_view(field->name()).ends_with("_pa")) continue;
    reflection.SetDouble(&constants, field, factor * reflection.GetDouble(constants, field));
  }
}

/// Multiplies packed numbers.
void scale(std::string& packed, double factor) {
  for (std::size_t at = 0; at + sizeof(double) <= packed.size(); at += sizeof(double)) {
    double value;
    std::memcpy(&value, packed.data() + at, sizeof(value));
    value *= factor;
    std::memcpy(packed.data() + at, &value, sizeof(value));
  }
}

}  // namespace

v1::SceneAdjustments adjustments_of(const v1::Scene& loaded) {
  v1::SceneAdjustments out;
  *out.mutable_gravity_m_per_s2() = loaded.gravity_m_per_s2();
  if (loaded.has_editing()) out.mutable_attachments();
  for (const v1::Body& body : loaded.bodies()) {
    v1::BodyAdjustment& adjustment = *out.add_bodies();
    adjustment.set_body(body.name());
    adjustment.set_stiffness_factor(1);
    adjustment.set_rayleigh_mass_per_s(body.rayleigh_mass_per_s());
    adjustment.set_rayleigh_stiffness_s(body.rayleigh_stiffness_s());
    if (loaded.editing().has_cutting()) adjustment.mutable_cuts();
  }
  return out;
}

Result<v1::SceneAdjustments> with_changes(v1::SceneAdjustments present, const v1::SceneAdjustments& changes) {
  if (changes.has_gravity_m_per_s2()) *present.mutable_gravity_m_per_s2() = changes.gravity_m_per_s2();
  if (changes.has_tools()) *present.mutable_tools() = changes.tools();
  if (changes.has_attachments()) *present.mutable_attachments() = changes.attachments();
  std::set<std::string_view> named;
  for (const v1::BodyAdjustment& change : changes.bodies()) {
    const auto found =
        std::find_if(present.mutable_bodies()->begin(), present.mutable_bodies()->end(),
                     [&](const v1::BodyAdjustment& adjustment) { return adjustment.body() == change.body(); });
    if (found == present.mutable_bodies()->end()) {
      return fail(
          ErrorCode::kNotFound,
          fmt::format("changes.bodies: the scene has no body '{}'; it has: {}", change.body(),
                      list_names(present.bodies(), [](const v1::BodyAdjustment& body) { return body.body(); })));
    }
    if (!named.insert(change.body()).second) {
      return invalid(fmt::format("changes.bodies: body '{}' is named twice", change.body()));
    }
    if (change.has_stiffness_factor()) {
      TM_RETURN_IF_ERROR(model::read_number(change.stiffness_factor(), kMinStiffnessFactor, kMaxStiffnessFactor,
                                            fmt::format("changes.bodies ('{}').stiffness_factor", change.body())));
    }
    if (change.has_cuts()) found->clear_cuts();
    found->MergeFrom(change);
  }
  return present;
}

v1::SceneAdjustments with_edits_of(const v1::SceneAdjustments& present, v1::SceneAdjustments wanted) {
  wanted.clear_tools();
  if (present.has_tools()) *wanted.mutable_tools() = present.tools();
  wanted.clear_attachments();
  if (present.has_attachments()) *wanted.mutable_attachments() = present.attachments();
  for (int i = 0; i < wanted.bodies_size(); ++i) {
    wanted.mutable_bodies(i)->clear_cuts();
    if (present.bodies(i).has_cuts()) *wanted.mutable_bodies(i)->mutable_cuts() = present.bodies(i).cuts();
  }
  return wanted;
}

v1::SceneAdjustments next_part(const v1::SceneAdjustments& present, const v1::SceneAdjustments& wanted) {
  v1::SceneAdjustments out = with_edits_of(present, wanted);
  for (int i = 0; i < out.bodies_size(); ++i) {
    v1::BodyAdjustment& body = *out.mutable_bodies(i);
    const double factor = present.bodies(i).stiffness_factor();
    body.set_stiffness_factor(
        std::clamp(body.stiffness_factor(), factor / kMaxStiffnessFactorOfPart, factor * kMaxStiffnessFactorOfPart));
  }
  return out;
}

bool same_parts(const v1::SceneAdjustments& one, const v1::SceneAdjustments& other) {
  return one.has_tools() == other.has_tools() && one.tools().SerializeAsString() == other.tools().SerializeAsString() &&
         one.attachments().SerializeAsString() == other.attachments().SerializeAsString();
}

v1::Scene adjusted(const v1::Scene& loaded, const v1::SceneAdjustments& adjustments) {
  v1::Scene out = loaded;
  if (adjustments.has_tools()) *out.mutable_tools() = adjustments.tools().tools();
  out.mutable_attachments()->MergeFrom(adjustments.attachments().attachments());
  const v1::Vector3& gravity = adjustments.gravity_m_per_s2();
  if (out.has_gravity_m_per_s2() || gravity.x() != 0 || gravity.y() != 0 || gravity.z() != 0) {
    *out.mutable_gravity_m_per_s2() = gravity;
  }
  for (int i = 0; i < out.bodies_size(); ++i) {
    v1::Body& body = *out.mutable_bodies(i);
    const v1::BodyAdjustment& adjustment = adjustments.bodies(i);
    body.set_rayleigh_mass_per_s(adjustment.rayleigh_mass_per_s());
    body.set_rayleigh_stiffness_s(adjustment.rayleigh_stiffness_s());
    const double factor = adjustment.stiffness_factor();
    if (factor == 1) continue;
    scale(*body.mutable_law(), factor);
    for (v1::LawRegion& region : *body.mutable_law_regions()) scale(*region.mutable_law(), factor);
    if (body.has_element_fields()) scale(*body.mutable_element_fields()->mutable_young_modulus_pa(), factor);
  }
  return out;
}

}  // namespace tensormass::world
