#include "world/snapshot.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <vector>

#include <fmt/format.h>

#include "core/limits.h"
#include "model/scene_input.h"
#include "tensormass/v1/recording.pb.h"
#include "world/guard.h"
#include "world/hashes.h"
#include "world/recording.h"
#include "world/scene_edit.h"

namespace tensormass::world {

namespace {

/// The first byte is not text, and a transfer that changes ends of lines damages the last one.
constexpr std::array<char, 8> kMagic{'\x89', 'T', 'M', 'S', 'N', 'A', 'P', '\n'};
/// Version 1 had the tissue in the order of a layout.
constexpr std::uint32_t kVersion = 2;
/// Largest number of a snapshot, because a scene of single precision stores it as a float.
constexpr double kMaxReal = std::numeric_limits<float>::max();
/// Allowed excess over a bound that a step was checked with in single precision.
constexpr double kRounding = 1 + 1e-6;

struct Header {
  std::array<char, 8> magic = kMagic;
  std::uint32_t version = kVersion;
  std::uint32_t reserved = 0;
  std::uint64_t size = 0;
  std::uint64_t checksum = 0;
};
static_assert(sizeof(Header) == 32, "recording.proto states the header");

std::uint64_t checksum_of(std::string_view bytes) {
  Hash hash;
  hash.add(bytes);
  return hash.value();
}

/// Leaves out an array of zeros: packed in a file, it would look like one that is made to fill a reader's memory.
void write_doubles(const std::vector<double>& values, std::string& out) {
  const auto is_zero = [](double value) { return value == 0 && !std::signbit(value); };
  if (std::all_of(values.begin(), values.end(), is_zero)) return;
  out.assign(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(double));
}

void write_vector(const Vec3<double>& vector, v1::Vector3& out) {
  out.set_x(vector[0]);
  out.set_y(vector[1]);
  out.set_z(vector[2]);
}

/// Reads `count` finite numbers, none beyond `largest`. No bytes: all are zero.
Result<std::vector<double>> read_doubles(const std::string& bytes, std::size_t count, std::string_view where,
                                         double largest = kMaxReal) {
  if (bytes.empty()) return std::vector<double>(count, 0.0);
  if (bytes.size() != count * sizeof(double)) {
    return invalid(
        fmt::format("snapshot.{}: {} bytes, but this scene has {}", where, bytes.size(), count * sizeof(double)));
  }
  std::vector<double> out(count);
  std::memcpy(out.data(), bytes.data(), bytes.size());
  if (!std::all_of(out.begin(), out.end(), [](double value) { return std::isfinite(value); })) {
    return invalid(fmt::format("snapshot.{}: has numbers that are not finite", where));
  }
  const auto beyond =
      std::find_if(out.begin(), out.end(), [largest](double value) { return std::abs(value) > largest; });
  if (beyond != out.end()) {
    return invalid(
        fmt::format("snapshot.{}: has {:g}, beyond {:g}; no step of a scene gets there", where, *beyond, largest));
  }
  return out;
}

/// Reads the displacement of each node, as far from rest as a step may end. displacement: [node_count, 3] m
Result<std::vector<double>> read_displacement(const std::string& bytes, const model::Model& model) {
  const std::size_t count = sizes_of(model).nodes;
  TM_ASSIGN_OR_RETURN(out, read_doubles(bytes, count, "displacement", limits::kMaxLength));
  const double bound = kRounding * max_distance_m(model);
  for (std::size_t i = 0; i < count; i += 3) {
    const double distance = Vec3<double>(out[i], out[i + 1], out[i + 2]).norm();
    if (distance > bound) {
      return invalid(
          fmt::format("snapshot.displacement: a node is {:.3g} m from its rest position, farther than {:.3g} "
                      "m; no step of this scene ends there",
                      distance, bound));
    }
  }
  return std::move(out);
}

Result<double> read_finite(double value, std::string_view where) {
  if (!std::isfinite(value)) return invalid(fmt::format("snapshot.{}: is not finite", where));
  if (std::abs(value) > kMaxReal)
    return invalid(fmt::format("snapshot.{}: {:g} is beyond {:g}", where, value, kMaxReal));
  return value;
}

void write_tool(const World::Saved::Tool& tool, const model::ToolModel& model, v1::SnapshotTool& out) {
  const ToolMotion::Saved& motion = tool.motion;
  write_pose(model.name, {motion.pose, true, {}, kUntilTheNext}, model.joints.size(), *out.mutable_pose());
  write_pose(model.name, {motion.target, true, tool.newest, motion.valid_for_s, motion.level}, model.joints.size(),
             *out.mutable_target());
  out.set_fade(motion.fade);
  out.set_leaves(motion.leaves);
  out.set_comes_back(motion.comes_back);
  out.set_target_age_s(motion.target_age_s);
  write_vector(tool.force.force_n, *out.mutable_force_n());
  write_vector(tool.force.torque_n_m, *out.mutable_torque_n_m());
  write_vector(tool.force.friction_n, *out.mutable_friction_n());
  out.set_young_modulus_pa(tool.force.young_modulus_pa);
  out.set_plane_strain_modulus_pa(tool.force.plane_strain_modulus_pa);
  for (std::size_t i = 0; i < model.joints.size(); ++i) out.add_joint_loads(tool.force.joints[i]);
  for (std::size_t f = 0; f < Hold::freedoms(model); ++f) out.add_shown_stiffness(motion.hold.stiffness[f]);
  out.set_reach_m(motion.hold.reach_m);
  out.set_unspent_j(tool.unspent_j);
  if (!(model.mass_kg > 0)) return;
  write_vector(motion.hand_m, *out.mutable_hand_m());
  write_vector(motion.hand_m_per_s, *out.mutable_hand_m_per_s());
  write_vector(motion.velocity_m_per_s, *out.mutable_velocity_m_per_s());
  write_vector(motion.felt.position_m, *out.mutable_felt_position_m());
  write_vector(motion.felt.force_n, *out.mutable_felt_force_n());
  for (int i = 0; i < 9; ++i) {
    out.add_felt_stiffness_n_per_m(motion.felt.stiffness_n_per_m(i / 3, i % 3));
    out.add_shown_stiffness_n_per_m(motion.felt.shown_n_per_m(i / 3, i % 3));
  }
}

/// Reads a matrix of nine finite numbers, row by row.
Result<Mat3<double>> read_matrix(const google::protobuf::RepeatedField<double>& values, const std::string& where) {
  if (values.size() != 9) return invalid(fmt::format("{}: {} values, not 9", where, values.size()));
  Mat3<double> out;
  for (int i = 0; i < 9; ++i) {
    TM_ASSIGN_OR_RETURN(value, read_finite(values[i], where));
    out(i / 3, i % 3) = value;
  }
  return out;
}

/// Reads what a snapshot has of a tool with a mass only.
Result<void> read_coupling(const v1::SnapshotTool& message, const std::string& where, ToolMotion::Saved& out) {
  TM_ASSIGN_OR_RETURN(hand, model::read_vector(message.hand_m(), where + ".hand_m"));
  TM_ASSIGN_OR_RETURN(hand_speed, model::read_vector(message.hand_m_per_s(), where + ".hand_m_per_s"));
  TM_ASSIGN_OR_RETURN(speed, model::read_vector(message.velocity_m_per_s(), where + ".velocity_m_per_s"));
  TM_ASSIGN_OR_RETURN(position, model::read_vector(message.felt_position_m(), where + ".felt_position_m"));
  TM_ASSIGN_OR_RETURN(force, model::read_vector(message.felt_force_n(), where + ".felt_force_n", limits::kMaxForceN));
  TM_ASSIGN_OR_RETURN(stiffness, read_matrix(message.felt_stiffness_n_per_m(), where + ".felt_stiffness_n_per_m"));
  TM_ASSIGN_OR_RETURN(shown, read_matrix(message.shown_stiffness_n_per_m(), where + ".shown_stiffness_n_per_m"));
  out.hand_m = hand;
  out.hand_m_per_s = hand_speed;
  out.velocity_m_per_s = speed;
  out.felt = {position, force, stiffness, shown};
  return {};
}

Result<World::Saved::Tool> read_tool(const v1::SnapshotTool& message, const model::ToolModel& model) {
  const std::string where = fmt::format("snapshot.tools ({})", model.name);
  for (const std::string& tool : {message.pose().tool(), message.target().tool()}) {
    if (tool != model.name) return invalid(fmt::format("{}: the snapshot has tool '{}' in this place", where, tool));
  }
  TM_ASSIGN_OR_RETURN(pose, read_pose(message.pose(), model, where + ".pose"));
  TM_ASSIGN_OR_RETURN(target, read_pose(message.target(), model, where + ".target"));
  World::Saved::Tool out;
  out.newest = target.stamp;
  out.motion.pose = pose.pose;
  out.motion.target = target.pose;
  out.motion.valid_for_s = target.valid_for_s;
  out.motion.level = target.level;
  out.motion.hand_m = pose.pose.position_m;
  out.motion.felt.position_m = pose.pose.position_m;
  if (model.mass_kg > 0) TM_RETURN_IF_ERROR(read_coupling(message, where, out.motion));
  TM_ASSIGN_OR_RETURN(fade, model::read_number(message.fade(), 0, 1, where + ".fade"));
  out.motion.fade = fade;
  out.motion.leaves = message.leaves();
  out.motion.comes_back = message.comes_back();
  TM_ASSIGN_OR_RETURN(age, read_finite(message.target_age_s(), where + ".target_age_s"));
  out.motion.target_age_s = age;
  TM_ASSIGN_OR_RETURN(force, model::read_vector(message.force_n(), where + ".force_n", limits::kMaxForceN));
  TM_ASSIGN_OR_RETURN(torque, model::read_vector(message.torque_n_m(), where + ".torque_n_m", limits::kMaxForceN));
  TM_ASSIGN_OR_RETURN(friction, model::read_vector(message.friction_n(), where + ".friction_n", limits::kMaxForceN));
  TM_ASSIGN_OR_RETURN(young, model::read_number(message.young_modulus_pa(), 0, kMaxReal, where + ".young_modulus_pa"));
  TM_ASSIGN_OR_RETURN(plane_strain, model::read_number(message.plane_strain_modulus_pa(), 0, kMaxReal,
                                                       where + ".plane_strain_modulus_pa"));
  out.force = {force, torque, friction, {}, young, plane_strain};
  if (static_cast<std::size_t>(message.joint_loads_size()) != model.joints.size()) {
    return invalid(fmt::format("{}.joint_loads: {} values", where, message.joint_loads_size()));
  }
  for (std::size_t i = 0; i < model.joints.size(); ++i) {
    TM_ASSIGN_OR_RETURN(load, read_finite(message.joint_loads(static_cast<int>(i)), where + ".joint_loads"));
    out.force.joints[i] = load;
  }
  if (message.shown_stiffness_size() > 0 &&
      static_cast<std::size_t>(message.shown_stiffness_size()) != Hold::freedoms(model)) {
    return invalid(fmt::format("{}.shown_stiffness: {} values", where, message.shown_stiffness_size()));
  }
  for (int f = 0; f < message.shown_stiffness_size(); ++f) {
    TM_ASSIGN_OR_RETURN(stiffness,
                        model::read_number(message.shown_stiffness(f), 0, kMaxReal, where + ".shown_stiffness"));
    out.motion.hold.stiffness[static_cast<std::size_t>(f)] = stiffness;
  }
  TM_ASSIGN_OR_RETURN(reach, model::read_number(message.reach_m(), 0, kMaxReal, where + ".reach_m"));
  out.motion.hold.reach_m = reach;
  TM_ASSIGN_OR_RETURN(unspent, model::read_number(message.unspent_j(), 0, kMaxReal, where + ".unspent_j"));
  out.unspent_j = unspent;
  return out;
}

void write_broken(const std::vector<std::uint8_t>& broken, std::string& out) {
  if (std::any_of(broken.begin(), broken.end(), [](std::uint8_t one) { return one != 0; })) {
    out.assign(broken.begin(), broken.end());
  }
}

/// Reads which of `count` springs are broken. No bytes: none is.
Result<std::vector<std::uint8_t>> read_broken(const std::string& bytes, std::size_t count) {
  if (bytes.empty()) return std::vector<std::uint8_t>(count, 0);
  if (bytes.size() != count) {
    return invalid(fmt::format("snapshot.broken_springs: {} bytes, but this scene has {}", bytes.size(), count));
  }
  if (std::any_of(bytes.begin(), bytes.end(), [](char one) { return one != 0 && one != 1; })) {
    return invalid("snapshot.broken_springs: a spring is broken (1) or not (0), nothing else");
  }
  return std::vector<std::uint8_t>(bytes.begin(), bytes.end());
}

void write_edge_pair(const EdgePair& pair, v1::SnapshotEdgePair& out) {
  out.set_contact(pair.contact);
  for (const std::uint32_t node : {pair.edge[0], pair.edge[1], pair.other[0], pair.other[1]}) out.add_nodes(node);
  out.set_slot(pair.slot);
  write_vector({pair.stretch_m[0], pair.stretch_m[1], pair.stretch_m[2]}, *out.mutable_stretch_m());
  out.set_force_n(pair.force_n);
}

Result<std::vector<EdgePair>> read_edge_pairs(const v1::SnapshotState& message, const model::Model& model) {
  std::vector<EdgePair> out;
  for (const v1::SnapshotEdgePair& pair : message.edge_pairs()) {
    const std::string where = fmt::format("snapshot.edge_pairs[{}]", out.size());
    if (pair.nodes_size() != 4) return invalid(fmt::format("{}.nodes: {}, not 4", where, pair.nodes_size()));
    TM_ASSIGN_OR_RETURN(stretch, model::read_vector(pair.stretch_m(), where + ".stretch_m"));
    TM_ASSIGN_OR_RETURN(force, model::read_number(pair.force_n(), 0, kMaxReal, where + ".force_n"));
    out.push_back({pair.contact(),
                   {pair.nodes(0), pair.nodes(1)},
                   {pair.nodes(2), pair.nodes(3)},
                   pair.slot(),
                   {stretch[0], stretch[1], stretch[2]},
                   force});
  }
  TM_RETURN_IF_ERROR(check_edge_pairs(model, out));
  return out;
}

/// Reads what blade points hold: elements of the scene, and places in them.
Result<std::vector<double>> read_blade_points(const std::string& bytes, const model::Model& model) {
  constexpr double kBeside = 1e-3;  // anchors are inside, but for rounding
  TM_ASSIGN_OR_RETURN(out, read_doubles(bytes, sizes_of(model).blade_points, "blade_points"));
  const auto is_element = [&](double value) {
    return value == std::floor(value) && value >= 0 && value <= model.links.blades.tetrahedron_count();
  };
  for (std::size_t point = 0; point < out.size(); point += kBladeReals) {
    const double* memory = out.data() + point;
    const double* weights = memory + view::kBladeWeights;
    const auto is_weight = [](double weight) { return weight >= -kBeside && weight <= 1 + kBeside; };
    const bool holds = memory[view::kBladeTetrahedron] > 0;
    const double sum = weights[0] + weights[1] + weights[2] + weights[3];
    if (!is_element(memory[view::kBladeTetrahedron]) || !is_element(memory[view::kBladeMemory]) ||
        (holds && (!std::all_of(weights, weights + 4, is_weight) || std::abs(sum - 1) > kBeside)) ||
        !(memory[view::kBladeRetreat] >= 0) || memory[view::kBladeEvent] != 0 || memory[view::kBladeLast] != 0) {
      return invalid(fmt::format("snapshot.blade_points: point {} holds no place in an element of this scene",
                                 point / kBladeReals));
    }
  }
  return std::move(out);
}

void write_tissue(const NodeState& tissue, v1::SnapshotState& out) {
  write_doubles(tissue.displacement, *out.mutable_displacement());
  write_doubles(tissue.velocity, *out.mutable_velocity());
  write_doubles(tissue.internal_variables, *out.mutable_internal_variables());
  out.set_internal_dt_s(tissue.internal_dt_s);
  write_doubles(tissue.previous_displacement, *out.mutable_previous_displacement());
  write_doubles(tissue.previous_velocity, *out.mutable_previous_velocity());
  write_doubles(tissue.slips, *out.mutable_slips());
  write_doubles(tissue.link_slips, *out.mutable_link_slips());
  write_broken(tissue.broken, *out.mutable_broken_springs());
  write_doubles(tissue.blade_points, *out.mutable_blade_points());
  for (const EdgePair& pair : tissue.edge_pairs) write_edge_pair(pair, *out.add_edge_pairs());
  write_doubles(tissue.solution, *out.mutable_solution());
  out.set_last_dt_s(tissue.last_dt_s);
  out.set_largest_force_squared(tissue.largest_force_squared);
  out.set_coarse_solves(tissue.coarse_solves);
}

Result<NodeState> read_tissue(const v1::SnapshotState& message, const model::Model& model) {
  const NodeStateSizes sizes = sizes_of(model);
  NodeState out;
  TM_ASSIGN_OR_RETURN(displacement, read_displacement(message.displacement(), model));
  TM_ASSIGN_OR_RETURN(velocity, read_doubles(message.velocity(), sizes.nodes, "velocity", limits::kMaxLength));
  TM_ASSIGN_OR_RETURN(internal,
                      read_doubles(message.internal_variables(), sizes.internal_variables, "internal_variables"));
  TM_ASSIGN_OR_RETURN(internal_dt_s, read_finite(message.internal_dt_s(), "internal_dt_s"));
  TM_ASSIGN_OR_RETURN(before, read_doubles(message.previous_displacement(), sizes.previous, "previous_displacement",
                                           limits::kMaxLength));
  TM_ASSIGN_OR_RETURN(velocity_before, read_doubles(message.previous_velocity(), sizes.previous, "previous_velocity",
                                                    limits::kMaxLength));
  TM_ASSIGN_OR_RETURN(slips, read_doubles(message.slips(), sizes.slips, "slips"));
  TM_ASSIGN_OR_RETURN(link_slips, read_doubles(message.link_slips(), sizes.link_slips, "link_slips"));
  TM_ASSIGN_OR_RETURN(broken, read_broken(message.broken_springs(), sizes.broken));
  TM_ASSIGN_OR_RETURN(blade_points, read_blade_points(message.blade_points(), model));
  TM_ASSIGN_OR_RETURN(pairs, read_edge_pairs(message, model));
  TM_ASSIGN_OR_RETURN(solution, read_doubles(message.solution(), sizes.solution, "solution"));
  TM_ASSIGN_OR_RETURN(last_dt_s, read_finite(message.last_dt_s(), "last_dt_s"));
  TM_ASSIGN_OR_RETURN(largest, read_finite(message.largest_force_squared(), "largest_force_squared"));
  out.displacement = std::move(displacement);
  out.velocity = std::move(velocity);
  out.previous_displacement = std::move(before);
  out.previous_velocity = std::move(velocity_before);
  out.solution = std::move(solution);
  out.internal_variables = std::move(internal);
  out.slips = std::move(slips);
  out.link_slips = std::move(link_slips);
  out.broken = std::move(broken);
  out.blade_points = std::move(blade_points);
  out.edge_pairs = std::move(pairs);
  out.internal_dt_s = internal_dt_s;
  out.last_dt_s = last_dt_s;
  out.largest_force_squared = largest;
  out.coarse_solves = message.coarse_solves();
  return out;
}

/// Checks the header and returns the bytes behind it.
Result<std::string_view> open_snapshot(std::string_view bytes) {
  Header header;
  if (bytes.size() < sizeof(header)) {
    return invalid(fmt::format("snapshot: {} bytes are too few; it is cut off, or no snapshot", bytes.size()));
  }
  std::memcpy(&header, bytes.data(), sizeof(header));
  if (header.magic != kMagic) return invalid("snapshot: these bytes are not a snapshot of a scene");
  if (header.version != kVersion) {
    return invalid(fmt::format("snapshot: version {}, but this server reads version {}; take it again with this server",
                               header.version, kVersion));
  }
  bytes.remove_prefix(sizeof(header));
  if (bytes.size() != header.size) {
    return invalid(fmt::format("snapshot: {} bytes of {}; it is cut off or damaged", bytes.size(), header.size));
  }
  if (checksum_of(bytes) != header.checksum) return invalid("snapshot: its checksum is wrong; it is damaged");
  return bytes;
}

/// Returns SnapshotState.slips_layout_hash of a snapshot: 0 if no contact remembers anything.
std::uint64_t layout_of_slips(const model::Model& model, const v1::SnapshotState& message) {
  return model.edit_tables && !message.slips().empty() ? hash_of_layout(model) : 0;
}

}  // namespace

std::string seal_snapshot(const std::string& content) {
  const Header header{.size = content.size(), .checksum = checksum_of(content)};
  std::string out(reinterpret_cast<const char*>(&header), sizeof(header));
  return out += content;
}

std::string write_snapshot(const model::Model& model, std::uint64_t scene_hash, const LoopState& state) {
  const World::Saved& world = state.world;
  v1::SnapshotState message;
  message.set_scene(model.name);
  message.set_scene_hash(scene_hash);
  message.set_step(world.step_count);
  write_tissue(world.tissue, message);
  for (std::size_t i = 0; i < world.tools.size(); ++i) {
    write_tool(world.tools[i], model.tools[i], *message.add_tools());
  }
  message.set_kinetic_energy_j(world.energy.kinetic_j);
  message.set_elastic_energy_j(world.energy.elastic_j);
  message.set_work_j(world.energy.work_j);
  message.set_dissipated_energy_j(world.energy.dissipated_j);
  message.set_available_energy_j(world.energy.available_j);
  message.set_projection_left(world.projection_left);
  message.set_projection_length(world.projection_length);
  message.set_projection_good(world.projection_good);
  message.set_cg_iteration_limit(world.cg_limit);
  message.set_held_steps(world.held_steps);
  message.set_recovering(world.recovering);
  message.set_stuck_s(world.stuck_s);
  message.set_bodies_touch(world.bodies_touch);
  message.set_next_diagnostics(state.next_diagnostics);
  write_shares(world.shares, message);
  message.set_slips_layout_hash(layout_of_slips(model, message));
  return seal_snapshot(message.SerializeAsString());
}

Result<LoopState> read_snapshot(const model::Model& model, std::uint64_t scene_hash, std::string_view bytes) {
  TM_ASSIGN_OR_RETURN(content, open_snapshot(bytes));
  v1::SnapshotState message;
  if (content.size() > limits::kMaxControlMessageBytes ||
      !message.ParseFromArray(content.data(), static_cast<int>(content.size()))) {
    return invalid("snapshot: its content cannot be read");
  }
  if (message.scene_hash() != scene_hash) {
    return fail(
        ErrorCode::kFailedPrecondition,
        fmt::format("snapshot: it is of another scene ('{}') than the loaded '{}', or of other values; load that "
                    "scene first, or adjust it as it was",
                    message.scene(), model.name));
  }
  if (const std::uint64_t own = layout_of_slips(model, message); own != 0 && message.slips_layout_hash() != own) {
    return fail(
        ErrorCode::kFailedPrecondition,
        "snapshot: the scene has editing and contacts that remember something, and was split otherwise; load it "
        "on the same kind of backend with the same number of threads");
  }
  LoopState out;
  World::Saved& world = out.world;
  world.step_count = message.step();
  TM_ASSIGN_OR_RETURN(tissue, read_tissue(message, model));
  world.tissue = std::move(tissue);
  if (static_cast<std::size_t>(message.tools_size()) != model.tools.size()) {
    return invalid(
        fmt::format("snapshot.tools: {} tools, but this scene has {}", message.tools_size(), model.tools.size()));
  }
  for (std::size_t i = 0; i < model.tools.size(); ++i) {
    TM_ASSIGN_OR_RETURN(tool, read_tool(message.tools(static_cast<int>(i)), model.tools[i]));
    world.tools.push_back(tool);
  }
  for (const double energy : {message.kinetic_energy_j(), message.elastic_energy_j(), message.work_j(),
                              message.dissipated_energy_j(), message.available_energy_j()}) {
    TM_RETURN_IF_ERROR(read_finite(energy, "energies"));
  }
  world.energy = {message.kinetic_energy_j(), message.elastic_energy_j(), message.work_j(),
                  message.dissipated_energy_j(), message.available_energy_j()};
  world.projection_left = message.projection_left();
  world.projection_length = message.projection_length();
  world.projection_good = message.projection_good();
  TM_ASSIGN_OR_RETURN(limit, model::read_number(message.cg_iteration_limit(), std::max(model.floor_cg_iterations, 1u),
                                                model.cg_max_iterations, "snapshot.cg_iteration_limit"));
  world.cg_limit = static_cast<std::uint32_t>(limit);
  world.held_steps = message.held_steps();
  world.recovering = message.recovering();
  TM_ASSIGN_OR_RETURN(stuck, model::read_number(message.stuck_s(), 0, kMaxReal, "snapshot.stuck_s"));
  world.stuck_s = stuck;
  world.bodies_touch = message.bodies_touch();
  out.next_diagnostics = message.next_diagnostics();
  TM_ASSIGN_OR_RETURN(shares, read_shares(model, message));
  world.shares = std::move(shares);
  return out;
}

}  // namespace tensormass::world
