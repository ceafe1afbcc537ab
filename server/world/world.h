#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "model/model.h"

namespace tensormass::world {

/// Where a tool is asked to be, in its own frame's terms.
struct Pose {
  Vec3<double> position_m = Vec3<double>::Zero();
  std::array<double, 4> orientation{1, 0, 0, 0};  ///< unit quaternion, w x y z
};

/// A tool between two steps.
struct ToolMotion {
  Pose target;   ///< the newest that was asked for
  Pose current;  ///< where the simulation has it: `target`, approached at the tool's maximum speed
};

/// What a client needs to close its own loop, at the end of a step.
struct ToolReading {
  Pose pose;
  Vec3<double> force_n = Vec3<double>::Zero();
  Vec3<double> torque_n_m = Vec3<double>::Zero();  ///< about the tool's position
  Mat3<double> stiffness_n_per_m = Mat3<double>::Zero();
};

/// One stepping scene: state, tools, time. Used by one thread. A step is
///
///   tools move towards their targets -> the model's stages on the backend -> guard -> readings
///
/// and allocates nothing.
class World {
 public:
  static Result<std::unique_ptr<World>> create(std::unique_ptr<const model::Model> model,
                                               const backend::Backend& backend);

  const model::Model& model() const { return *model_; }

  void set_tool_target(std::size_t tool, const Pose& pose) { tools_[tool].target = pose; }

  /// False if the guard stopped the scene: the state is no number any more and nothing of this step may be published.
  bool step(bool gather_visible);
  /// Looks at every element; now and then, not every step.
  void watch();
  /// Back to the start: displacement, velocity, time, tools.
  void reset();

  std::uint64_t step_count() const { return step_count_; }
  double simulated_time_s() const { return static_cast<double>(step_count_) * model_->dt_s; }
  const backend::StepResult& last() const { return last_; }
  std::span<const ToolReading> readings() const { return readings_; }
  /// Of the last watch; [group_count].
  std::span<const backend::GroupWatch> watched() const { return watched_; }

  /// [visible_count, 3] m, of the last step that gathered.
  std::span<const float> visible_positions() { return state_->visible_positions(); }
  void gather_visible() { state_->gather_visible(); }
  /// All nodes of a body in the order of its mesh, [node_count, 3] m. Allocates; for requests.
  std::vector<double> positions(const model::BodyModel& body);
  /// Everything that moves, for requests.
  backend::RowState state() { return state_->read(); }

 private:
  World(std::unique_ptr<const model::Model> model, std::unique_ptr<backend::SceneState> state);
  void write_start();
  void place_tools();
  void move_tools();
  void read_tools();

  std::unique_ptr<const model::Model> model_;
  std::unique_ptr<backend::SceneState> state_;
  std::vector<ToolMotion> tools_;
  std::vector<Vec3<double>> centers_;
  std::vector<backend::ToolForce> forces_;
  std::vector<ToolReading> readings_;
  std::vector<backend::GroupWatch> watched_;
  backend::StepResult last_;
  std::uint64_t step_count_ = 0;
};

}  // namespace tensormass::world
