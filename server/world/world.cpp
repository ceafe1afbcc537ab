#include "world/world.h"

#include <algorithm>

#include <Eigen/Geometry>

#include "physics/contact/hertz.h"

namespace tensormass::world {

namespace {

Eigen::Quaterniond rotation(const Pose& pose) {
  return {pose.orientation[0], pose.orientation[1], pose.orientation[2], pose.orientation[3]};
}

/// Lever from the tool's position to the centre of its sphere.
Vec3<double> lever(const model::ToolModel& tool, const Pose& pose) { return rotation(pose) * tool.tip_offset_m; }

}  // namespace

Result<std::unique_ptr<World>> World::create(std::unique_ptr<const model::Model> model,
                                             const backend::Backend& backend) {
  TM_TRY(state, backend.create(*model));
  return std::unique_ptr<World>(new World(std::move(model), std::move(state)));
}

World::World(std::unique_ptr<const model::Model> model, std::unique_ptr<backend::SceneState> state)
    : model_(std::move(model)),
      state_(std::move(state)),
      tools_(model_->tools.size()),
      centers_(model_->tools.size()),
      forces_(model_->tools.size()),
      readings_(model_->tools.size()),
      watched_(model_->groups.size()) {
  if (!model_->initial_displacement.empty() || !model_->initial_velocity.empty()) write_start();
  place_tools();
  if (model_->visible.count() > 0) state_->gather_visible();
}

void World::write_start() {
  const std::vector<double> rest(4 * std::size_t{model_->layout.row_count}, 0.0);
  std::size_t histories = 0;
  for (const model::ElementGroup& group : model_->groups) histories += group.history_reals();
  const auto or_rest = [&](const std::vector<double>& start) { return start.empty() ? rest : start; };
  state_->write({or_rest(model_->initial_displacement), or_rest(model_->initial_velocity),
                 std::vector<double>(histories, 0.0)});
}

void World::place_tools() {
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    const model::ToolModel& tool = model_->tools[i];
    tools_[i].target = tools_[i].current = {tool.initial_position_m, tool.initial_orientation};
    readings_[i] = {};
    readings_[i].pose = tools_[i].current;
  }
}

void World::move_tools() {
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    const model::ToolModel& tool = model_->tools[i];
    ToolMotion& motion = tools_[i];
    // The sphere is what must not jump through tissue: its centre is limited, however the pose moves it.
    const Vec3<double> from = motion.current.position_m + lever(tool, motion.current);
    const Vec3<double> to = motion.target.position_m + lever(tool, motion.target);
    const double distance = (to - from).norm();
    const double reach = tool.max_speed_m_per_s * model_->dt_s;
    const double share = distance > reach ? reach / distance : 1.0;
    if (share < 1) {
      const Eigen::Quaterniond turned = rotation(motion.current).slerp(share, rotation(motion.target));
      motion.current.orientation = {turned.w(), turned.x(), turned.y(), turned.z()};
      centers_[i] = from + share * (to - from);
      motion.current.position_m = centers_[i] - lever(tool, motion.current);
    } else {
      motion.current = motion.target;
      centers_[i] = to;
    }
  }
}

void World::read_tools() {
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    const model::ToolModel& tool = model_->tools[i];
    ToolReading& reading = readings_[i];
    reading.pose = tools_[i].current;
    reading.force_n = forces_[i].force_n;
    reading.torque_n_m = forces_[i].torque_n_m + lever(tool, reading.pose).cross(forces_[i].force_n);
    const double force = reading.force_n.norm();
    reading.stiffness_n_per_m.setZero();
    if (force > 0) {
      const Vec3<double> normal = reading.force_n / force;
      reading.stiffness_n_per_m = physics::hertz_tangent_stiffness(force, tool.plane_strain_modulus_pa, tool.radius_m) *
                                  normal * normal.transpose();
    }
  }
}

bool World::step(bool gather_visible) {
  move_tools();
  last_ = state_->step({centers_, simulated_time_s() + model_->dt_s, gather_visible}, forces_);
  ++step_count_;
  if (!last_.finite) return false;
  read_tools();
  return true;
}

void World::watch() { state_->watch(watched_); }

void World::reset() {
  write_start();
  std::fill(watched_.begin(), watched_.end(), backend::GroupWatch{});
  step_count_ = 0;
  last_ = {};
  place_tools();
  if (model_->visible.count() > 0) state_->gather_visible();
}

std::vector<double> World::positions(const model::BodyModel& body) {
  const backend::RowState state = state_->read();
  std::vector<double> out(3 * std::size_t{body.node_count});
  for (std::uint32_t node = 0; node < body.node_count; ++node) {
    const std::size_t row = model_->layout.row_of_node[body.node_begin + node];
    for (std::size_t c = 0; c < 3; ++c) out[3 * node + c] = model_->rest[4 * row + c] + state.displacement[4 * row + c];
  }
  return out;
}

}  // namespace tensormass::world
