#include "world/messages.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>

#include <fmt/format.h>

#include "core/assert.h"

namespace tensormass::world {

namespace {

void fill(const Vec3<double>& from, v1::Vector3& to) {
  to.set_x(from[0]);
  to.set_y(from[1]);
  to.set_z(from[2]);
}

template <class Item>
std::string packed(std::span<const Item> items) {
  return {reinterpret_cast<const char*>(items.data()), items.size_bytes()};
}

/// Returns the vertices of a body whose node is held or prescribed in some direction; none if it has a skin.
std::vector<std::uint32_t> fixed_vertices(const model::Model& model, const model::BodyModel& body) {
  constexpr std::uint32_t kAllFree = 7;
  std::vector<std::uint32_t> fixed;
  for (std::size_t vertex = 0; vertex < body.vertex_nodes.size(); ++vertex) {
    const std::size_t row = model.layout.row_of_node[body.node_begin + body.vertex_nodes[vertex]];
    if (static_cast<std::uint32_t>(model.rest[4 * row + 3]) != kAllFree) {
      fixed.push_back(static_cast<std::uint32_t>(vertex));
    }
  }
  return fixed;
}

/// "3 springs of attachment 'ligament'"
std::string springs_of(const SceneEvent& event, const std::string& attachment) {
  const std::string of = attachment.empty() ? std::string() : fmt::format(" of attachment '{}'", attachment);
  return fmt::format("{:.0f} spring{}{}", event.value, event.value == 1 ? "" : "s", of);
}

/// What happened, in words. Names in `named` are those of the event.
std::string text_of(const model::Model& model, const SceneEvent& event, const v1::SceneEvent& named) {
  constexpr double kMm2 = 1e6, kMm3 = 1e9, kMillijoules = 1e3;  // in a square, in a cubic metre, in a joule
  const std::string of_body = named.body().empty() ? std::string() : fmt::format(" of body '{}'", named.body());
  const std::string by_tool = named.tool().empty() ? std::string() : fmt::format(" by '{}'", named.tool());
  switch (event.kind) {
    case EventKind::kAblated:
      return fmt::format("{:.3g} mm³{} burnt away{}", kMm3 * event.value, of_body, by_tool);
    case EventKind::kPieceFree:
      return fmt::format("a piece of {:.3g} mm³{} is free", kMm3 * event.value, of_body);
    case EventKind::kSevered:
      return fmt::format("{} severed{}", springs_of(event, named.attachment()), by_tool);
    case EventKind::kCut:
      return fmt::format("a cut of {:.3g} mm²{}", kMm2 * event.value, of_body);
    case EventKind::kCutBegun:
      return fmt::format("a cut{}{} begins", of_body, by_tool);
    case EventKind::kCutEnded:
      return fmt::format("a cut{}{} ends: {:.3g} mm² and {:.3g} mJ", of_body, by_tool, kMm2 * event.value,
                         kMillijoules * event.work_j);
    case EventKind::kAdjusted:
      return "values of the scene were adjusted";
    case EventKind::kReset:
      return "the scene was reset";
    case EventKind::kRestored:
      return fmt::format("the scene goes on from a snapshot after step {}", event.step);
    case EventKind::kGuard:
    case EventKind::kHeld:
      return to_text(event.guard, model);
    case EventKind::kToolAdded:
      return fmt::format("tool '{}' was added", named.tool());
    case EventKind::kToolRemoved:
      return fmt::format("tool '{}' was removed", named.tool());
    case EventKind::kAttachmentAdded:
      return fmt::format("attachment '{}' was added: {}", named.attachment(), springs_of(event, {}));
    case EventKind::kAttachmentRemoved:
      return fmt::format("attachment '{}' was removed: {}", named.attachment(), springs_of(event, {}));
    case EventKind::kBroken:
      return fmt::format("{} broke", springs_of(event, named.attachment()));
  }
  return {};
}

}  // namespace

std::uint64_t unix_time_ns() {
  return static_cast<std::uint64_t>(
      std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::system_clock::now().time_since_epoch())
          .count());
}

std::uint64_t new_topology_version() {
  static std::atomic<std::uint64_t> last{0};
  std::uint64_t before = last.load();
  std::uint64_t next = 0;
  do {
    next = std::max(unix_time_ns(), before + 1);
  } while (!last.compare_exchange_weak(before, next));
  return next;
}

v1::Topology make_topology(const model::Model& model, std::uint64_t version) {
  v1::Topology topology;
  topology.set_scene(model.name);
  topology.set_version(version);
  if (!model.gravity_m_per_s2.isZero(0)) fill(model.gravity_m_per_s2, *topology.mutable_gravity_m_per_s2());
  for (const model::BodyModel& body : model.bodies) {
    v1::BodySurface& out = *topology.add_bodies();
    out.set_name(body.name);
    out.set_first_vertex(body.vertex_begin);
    out.set_vertex_count(body.vertex_count);
    out.set_triangles(packed(std::span<const mesh::Triangle>(body.triangles)));
    out.set_nodes(packed(std::span<const std::uint32_t>(body.vertex_nodes)));
    out.set_fixed_vertices(packed(std::span<const std::uint32_t>(fixed_vertices(model, body))));
    if (body.has_color) fill(body.color_srgb, *out.mutable_color_srgb());
    out.set_texture_image(body.texture.image);
    out.set_texture_coordinates(body.texture.coordinates);
  }
  fill_parts(model, topology);
  return topology;
}

void fill_parts(const model::Model& model, v1::Topology& out) {
  out.clear_tools();
  for (const model::ToolModel& tool : model.tools) fill_shape(tool, *out.add_tools());
  out.set_attachment_point_count(model.visible.attachment_point_count());
  out.clear_attachments();
  for (const model::VisibleAttachment& attachment : model.attachments) {
    v1::AttachmentSprings& springs = *out.add_attachments();
    springs.set_name(attachment.name);
    springs.set_springs(packed(std::span<const std::array<std::uint32_t, 2>>(attachment.springs)));
    springs.set_rest_lengths_m(packed(std::span<const float>(attachment.rest_lengths_m)));
    springs.set_stiffness_n_per_m(attachment.stiffness_n_per_m);
    if (std::isfinite(attachment.breaking_force_n)) springs.set_breaking_force_n(attachment.breaking_force_n);
  }
}

void fill_shape(const model::ToolModel& tool, v1::ToolShape& out) {
  out.set_name(tool.name);
  out.set_radius_m(tool.radius_m);
  fill(tool.tip_offset_m, *out.mutable_tip_offset_m());
  *out.mutable_tool() = *tool.description;
}

double local_model_validity_s(const model::Model& model) { return std::max(3 / model.rate_hz, 0.02); }

void fill_feedback(const model::Model& model, const StepStamp& stamp, std::size_t tool, const ToolReading& reading,
                   v1::ToolFeedback& out) {
  out.set_tool(model.tools[tool].name);
  out.set_step(stamp.step);
  out.set_server_time_ns(stamp.server_time_ns);
  out.set_pose_sequence(reading.newest.sequence);
  out.set_client_time_ns(reading.newest.client_time_ns);
  out.set_client_id(reading.newest.client_id);
  const auto seconds = [](Clock::duration time) { return std::chrono::duration<double>(time).count(); };
  const bool has_pose = reading.newest.arrived != Clock::time_point{};
  out.set_pose_waited_s(has_pose ? seconds(stamp.began - reading.newest.arrived) : 0);
  out.set_step_s(seconds(stamp.ended - stamp.began));
  out.set_published_after_s(seconds(Clock::now() - stamp.ended));
  fill(reading.pose.position_m, *out.mutable_position_m());
  const auto& q = reading.pose.orientation;
  out.mutable_orientation()->set_w(q[0]);
  out.mutable_orientation()->set_x(q[1]);
  out.mutable_orientation()->set_y(q[2]);
  out.mutable_orientation()->set_z(q[3]);
  out.set_retired(reading.retired);
  out.set_claimed(reading.newest.claims && !reading.retired);
  out.set_touching(reading.touching);
  out.set_gives_way(reading.gives_way);
  out.set_level(reading.level);
  out.set_recovering(reading.recovering);
  fill(reading.force_n, *out.mutable_force_n());
  fill(reading.torque_n_m, *out.mutable_torque_n_m());
  fill(reading.friction_n, *out.mutable_friction_n());
  out.clear_joint_values();
  out.clear_joint_loads();
  for (std::size_t i = 0; i < model.tools[tool].joints.size(); ++i) {
    out.add_joint_values(reading.pose.joint_values[i]);
    out.add_joint_loads(reading.joint_loads[i]);
  }
  v1::LocalModel& local = *out.mutable_local_model();
  local.clear_stiffness_n_per_m();
  for (int i = 0; i < 9; ++i) local.add_stiffness_n_per_m(reading.stiffness_n_per_m(i / 3, i % 3));
  local.set_valid_for_s(local_model_validity_s(model));
  local.clear_anchor_m();
  if (model.tools[tool].mass_kg > 0 || reading.gives_way) fill(reading.hand_m, *local.mutable_anchor_m());
  local.clear_yielding();
  if (!(reading.yielding.limit_n > 0)) return;
  fill(reading.yielding.direction, *local.mutable_yielding()->mutable_direction());
  local.mutable_yielding()->set_stiffness_n_per_m(reading.yielding.stiffness_n_per_m);
  local.mutable_yielding()->set_limit_n(reading.yielding.limit_n);
}

void fill_frame(const model::Model& model, const StepStamp& stamp, std::span<const float> positions,
                std::span<const ToolReading> tools, std::span<const std::uint8_t> broken_springs, v1::Frame& out) {
  const std::size_t points = 3 * std::size_t{model.visible.count()},
                    vertices = 3 * std::size_t{model.visible.vertex_count},
                    appended = 3 * std::size_t{stamp.appended_vertex_count};
  TM_ASSERT(positions.size() >= points + appended, "positions of all visible points and appended vertices");
  out.set_topology_version(stamp.topology_version);
  out.set_step(stamp.step);
  out.set_simulated_time_s(stamp.simulated_time_s);
  out.set_server_time_ns(stamp.server_time_ns);
  out.set_revision(stamp.revision);
  std::string& packed_positions = *out.mutable_positions();
  packed_positions = packed(positions.first(vertices));
  packed_positions += packed(positions.subspan(points, appended));
  out.clear_tools();
  for (std::size_t i = 0; i < tools.size(); ++i) fill_feedback(model, stamp, i, tools[i], *out.add_tools());
  out.set_attachment_points(packed(positions.subspan(vertices, points - vertices)));
  const bool any =
      std::any_of(broken_springs.begin(), broken_springs.end(), [](std::uint8_t bits) { return bits != 0; });
  out.set_broken_springs(any ? packed(broken_springs) : std::string());
}

void fill_changes(const ChangesSlot& slot, v1::SurfaceChanges& out) {
  TM_ASSERT(slot.changes != nullptr, "there are changes to write");
  const SurfaceChanges& changes = *slot.changes;
  out.Clear();
  out.set_topology_version(slot.topology_version);
  out.set_revision(changes.revision);
  out.set_appended_vertex_count(changes.appended_vertex_count);
  for (const BodyChanges& body : changes.bodies) {
    TM_ASSERT(body.appended_kinds.size() == body.appended_triangles.size(), "a kind for each appended triangle");
    v1::BodyChanges& to = *out.add_bodies();
    to.set_dead_triangles(packed(std::span<const std::uint32_t>(body.dead_triangles)));
    to.set_appended_vertices(packed(std::span<const std::uint32_t>(body.appended_vertices)));
    to.set_appended_triangles(packed(std::span<const mesh::Triangle>(body.appended_triangles)));
    to.set_appended_kinds(packed(std::span<const std::uint8_t>(body.appended_kinds)));
    to.set_coagulation(packed(std::span<const std::uint8_t>(body.coagulation)));
  }
}

void fill_events(const model::Model& model, const EventsSlot& slot, v1::SceneEvents& out) {
  out.Clear();
  out.set_topology_version(slot.topology_version);
  for (std::size_t i = 0; i < slot.log.size(); ++i) {
    const SceneEvent& event = slot.log[i];
    v1::SceneEvent& to = *out.add_events();
    to.set_sequence(event.sequence);
    to.set_step(event.step);
    to.set_server_time_ns(event.server_time_ns);
    to.set_kind(static_cast<v1::SceneEvent::Kind>(event.kind));
    if (event.body != SceneEvent::kNone) to.set_body(model.bodies[event.body].name);
    to.set_attachment(std::string(event.attachment_name.view()));
    to.set_tool(std::string(event.tool_name.view()));
    to.set_value(event.value);
    to.set_work_j(event.work_j);
    if (event.position_m) fill(*event.position_m, *to.mutable_position_m());
    to.set_text(text_of(model, event, to));
  }
}

}  // namespace tensormass::world
