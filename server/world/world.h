#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "core/assert.h"
#include "model/model.h"
#include "world/guard.h"

namespace tensormass::world {

/// Position and orientation of a tool in the scene.
struct Pose {
  Vec3<double> position_m = Vec3<double>::Zero();
  std::array<double, 4> orientation{1, 0, 0, 0};  ///< unit quaternion, w x y z
};

/// A tool between two steps.
struct ToolMotion {
  Pose target;   ///< the newest pose that a client sent
  Pose current;  ///< pose in the simulation: follows `target` at the tool's maximum speed
};

/// Pose, force and stiffness of a tool at the end of a step. A haptic client closes its own loop with them.
struct ToolReading {
  Pose pose;
  Vec3<double> force_n = Vec3<double>::Zero();
  Vec3<double> torque_n_m = Vec3<double>::Zero();  ///< about the tool's position
  Mat3<double> stiffness_n_per_m = Mat3<double>::Zero();
};

/// One scene that steps: its state on a backend, its tools, its time and its guard. Used by one thread; Loop owns it
/// and does everything about other threads. A step allocates nothing:
///
///     move tools towards their targets -> save checkpoint, run the stages on the backend -> guard -> read tools
///                                          ^                                                 |
///                                          +---- restore checkpoint, next retry (guard.h) <--+ a bound was left
///
/// Retries take smaller steps, then fallback settings. If none helps, the world stays at the checkpoint: the end of the
/// last good step.
///
///     dt        length of a step [s]
///     part      one of the equal parts of dt that a retry makes; a step as planned is one part
///     target    pose that a client sent; the tool follows it at its maximum speed
///     center    centre of a tool's sphere [m]; its lever is the vector from the tool's position to it
class World {
 public:
  static Result<std::unique_ptr<World>> create(std::unique_ptr<const model::Model> model,
                                               const backend::Backend& backend);

  const model::Model& model() const { return *model_; }

  void set_tool_target(std::size_t tool, const Pose& pose) {
    TM_ASSERT(tool < tools_.size(), "a pose is for a tool of the scene");
    tools_[tool].target = pose;
  }

  /// Makes a step. Returns false if no retry stayed within the guard's bounds: the world is then as before the call.
  bool step(bool gather_visible);
  /// Limits the iterations of a solve from the next step on, to at most the model's. Retries ignore the limit.
  void set_cg_limit(std::uint32_t cg_max_iterations) {
    TM_ASSERT(cg_max_iterations <= model_->cg_max_iterations, "a budget lowers the model's iterations");
    cg_limit_ = cg_max_iterations;
  }
  /// Event of the last step if it left its bounds, else nullptr.
  const GuardEvent* guard_event() const { return has_event_ ? &event_ : nullptr; }
  /// Computes strains, det F and elastic energy of all elements. Too slow for every step.
  void diagnose();
  /// Back to the start: displacement, velocity, time, tools.
  void reset();

  std::uint64_t step_count() const { return step_count_; }
  double simulated_time_s() const { return static_cast<double>(step_count_) * model_->dt_s; }
  const solver::StepResult& last() const { return last_; }
  const EnergyBalance& energy() const { return energy_; }
  std::span<const ToolReading> readings() const { return readings_; }
  /// Results of the last `diagnose`; [group_count].
  std::span<const backend::GroupDiagnostics> diagnostics() const { return diagnostics_; }

  /// Positions that were last gathered, [visible_count, 3] m.
  std::span<const float> visible_positions() { return state_->visible_positions(); }
  void gather_visible() { state_->gather_visible(); }
  /// All nodes of a body in the order of its mesh, [node_count, 3] m. Allocates; for requests.
  std::vector<double> positions(const model::BodyModel& body);
  /// Displacement, velocity and internal variables. Allocates; for requests.
  backend::RowState state() { return state_->read(); }

 private:
  World(std::unique_ptr<const model::Model> model, std::unique_ptr<backend::SceneState> state);
  void write_start();
  double diagnose_elastic_energy();
  void place_tools();
  void move_tools();
  void read_tools();
  BoundCheck retry(const BoundCheck& first);
  BoundCheck make_step(const Retry& how, std::uint32_t cg_max_iterations, bool saves_checkpoint, bool gather_visible);

  /// A tool at the start of a step.
  struct Before {
    Pose pose;
    Vec3<double> center_m = Vec3<double>::Zero(), force_n = Vec3<double>::Zero();
  };
  /// Centre of a tool's sphere [m] and the force on it [N]. Two of them give the work of the tool in a part.
  struct Touch {
    Vec3<double> center_m, force_n;
  };

  std::unique_ptr<const model::Model> model_;
  std::unique_ptr<backend::SceneState> state_;
  std::vector<ToolMotion> tools_;
  // The current step, [tool].
  std::vector<Before> before_;
  std::vector<Vec3<double>> targets_;  // centres at the end of the step
  std::vector<Vec3<double>> centers_;  // centres at the end of the current part
  std::vector<Touch> touches_;         // at the end of the previous part
  std::vector<backend::ToolForce> forces_;
  std::vector<ToolReading> readings_;
  std::vector<backend::GroupDiagnostics> diagnostics_;
  const Guard guard_;
  EnergyBalance energy_;
  double tools_work_j_ = 0;  // work of the tools in the current step
  GuardEvent event_;
  bool has_event_ = false;
  std::uint32_t cg_limit_;
  solver::StepResult last_;
  std::uint64_t step_count_ = 0;
};

}  // namespace tensormass::world
