#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "model/model.h"
#include "world/guard.h"

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
/// and allocates nothing. A step that leaves the guard's bounds is taken back and done again in smaller steps, then
/// with a safer setting; a world that nothing of it helps stands where the last good step ended.
class World {
 public:
  static Result<std::unique_ptr<World>> create(std::unique_ptr<const model::Model> model,
                                               const backend::Backend& backend);

  const model::Model& model() const { return *model_; }

  void set_tool_target(std::size_t tool, const Pose& pose) { tools_[tool].target = pose; }

  /// False if the guard found no way to make this step: it has not been made.
  bool step(bool gather_visible);
  /// Of a solve, from the next step on; at most the model's. A retry takes all that the model has.
  void set_cg_limit(std::uint32_t cg_max_iterations) { cg_limit_ = cg_max_iterations; }
  /// The last step that left its bounds, if it is the last one that was tried.
  const GuardEvent* guard_event() const { return has_event_ ? &event_ : nullptr; }
  /// Looks at every element; now and then, not every step.
  void diagnose();
  /// Back to the start: displacement, velocity, time, tools.
  void reset();

  std::uint64_t step_count() const { return step_count_; }
  double simulated_time_s() const { return static_cast<double>(step_count_) * model_->dt_s; }
  const solver::StepResult& last() const { return last_; }
  const EnergyBalance& energy() const { return energy_; }
  std::span<const ToolReading> readings() const { return readings_; }
  /// Of the last watch; [group_count].
  std::span<const backend::GroupDiagnostics> diagnostics() const { return diagnostics_; }

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
  double diagnose_elastic_energy();  ///< of all elements, as they are now [J]
  void place_tools();
  void move_tools();
  void read_tools();
  BoundCheck retry(const BoundCheck& first);
  BoundCheck make_step(const Retry& how, std::uint32_t cg_max_iterations, bool saves_checkpoint, bool gather_visible);

  /// A tool where a step begins.
  struct Before {
    Pose pose;
    Vec3<double> center_m = Vec3<double>::Zero(), force_n = Vec3<double>::Zero();
  };
  /// Centre of a tool's sphere, and the force on it there.
  struct Touch {
    Vec3<double> center_m, force_n;
  };

  std::unique_ptr<const model::Model> model_;
  std::unique_ptr<backend::SceneState> state_;
  std::vector<ToolMotion> tools_;
  // Of the step at hand, by tool.
  std::vector<Before> before_;
  std::vector<Vec3<double>> targets_;  // centres at its end
  std::vector<Vec3<double>> centers_;  // at the end of the part of it that is made
  std::vector<Touch> touches_;         // at the end of the part before
  std::vector<backend::ToolForce> forces_;
  std::vector<ToolReading> readings_;
  std::vector<backend::GroupDiagnostics> diagnostics_;
  const Guard guard_;
  EnergyBalance energy_;
  double tools_work_j_ = 0;  // of the step at hand
  GuardEvent event_;
  bool has_event_ = false;
  std::uint32_t cg_limit_;
  solver::StepResult last_;
  std::uint64_t step_count_ = 0;
};

}  // namespace tensormass::world
