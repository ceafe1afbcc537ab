#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>

#include "backend/backend.h"
#include "model/model.h"
#include "physics/tool/pose.h"

/// How a hand holds a tool: rigidly below the tool's largest load, and giving way above it, as a held instrument does.
///
/// The tool is where the hand is, so that the hold costs nothing of the force. A step whose load is too large is made
/// again, with the tool moved back along that load:
///
///     trial 0   the tool where the hand has it     load Q0 > Q
///     trial 1   moved back by (Q0 − Q) / k         load Q1
///     trial 2   moved back by (Q1 − Q) / k         k: slope between the two trials
///     ...       until no load exceeds its largest; a trial that went back much too far is followed by one half as far
///
/// The next step begins with k: the tool advances only by what the tissue is expected to bear, so that a hand that
/// keeps pushing mostly costs one trial a step. The tool follows the hand again once the load has fallen.
///
/// No hand is stiff enough to bring a load from nothing to its largest at once, so Q also bounds how fast a load rises:
/// the first trials aim at a rise of kLargestRisePerS · dt of the largest in a step. The others bear half as much more.
/// A tool moves back by at most kFastestBack times what its largest speed allows.
///
/// Where a step cannot be made at all, the tool backs off instead. It then advances cautiously: by little at first, and
/// twice as far after each step that could be made.
///
///     freedom     load                      largest                      moved by
///     0           force                     max_force_n                  position_m
///     1           torque about position_m   max_torque_n_m               orientation
///     2 + j       load of joint j           max_joint_load               joint_values[j]
namespace tensormass::world {

class Hold {
 public:
  using Pose = physics::Pose;
  /// Load on the hand: its torque is about the tool's position.
  using Load = backend::ToolForce;
  static constexpr std::size_t kFreedoms = 2 + limits::kMaxToolJoints;
  static std::size_t freedoms(const model::ToolModel& tool) { return 2 + tool.joints.size(); }

  /// Rise of a load in shares of its largest [1/s]: 10 % in a step at 960 Hz.
  static constexpr double kLargestRisePerS = 96;

  explicit Hold(const model::ToolModel& tool) : tool_(&tool) {}

  /// How fast a load may rise in a step, in kLargestRisePerS. Above all, it may not exceed the largest.
  static constexpr double kAims = 1, kBears = 1.5, kAtOnce = std::numeric_limits<double>::infinity();
  /// Returns the largest load as a share of what the tool bears. Above 1 the tool must give way.
  double share(const Load& load, double rise) const;
  /// Whether the tool has moved back in this step by much more than it must, so that little of its load is left.
  bool too_far_back(const Load& load) const;
  /// Starts a step. Returns the pose for its first trial.
  /// start, load: of the tool at the start. wanted: the pose to which the hand moves it.
  Pose begin(const Pose& start, const Load& load, const Pose& wanted, double dt_s);
  /// Returns the pose for the next trial of the step, after one whose load is too large or `too_far_back`.
  Pose give_way(const Pose& tried, const Load& load);
  /// Returns the pose for the next trial of the step, after one that could not be made: where the step began, and from
  /// there out of the tissue, by a distance in units of the way that the largest speed allows in a step.
  /// tried: load of that trial; it shows the way out for a tool that felt nothing before.
  /// hand_m: where the client has the hand; the tool stays near to it.
  Pose back_off(double distance, const Load& tried, const Vec3<double>& hand_m);
  /// Keeps the tool where it is for about a time, after which it follows the hand again.
  void wait(double time_s, double dt_s);
  /// Ends a step that was made: caution fades.
  void end_step();

  /// Whether the tool is not where the hand has moved it in this step.
  bool gives_way() const { return gives_way_; }

  /// What the next step depends on.
  struct Saved {
    /// Stiffness that trials have shown in each freedom [N/m, N m, or the joint's]; 0: the tool follows the hand there.
    std::array<double, kFreedoms> stiffness{};
    double reach_m = 0;  ///< largest advance in a step after the tool backed off; 0: no bound
  };
  const Saved& saved() const { return state_; }
  void restore(const Saved& saved) {
    state_ = saved;
    gives_way_ = false;
  }

 private:
  struct Trial {
    Pose pose;
    Load load;
  };
  std::size_t freedoms() const { return freedoms(*tool_); }
  double largest(std::size_t freedom) const;
  double bearable(std::size_t freedom, double rise) const;
  double stiffest(std::size_t freedom, const Load& load) const;
  double arm_m() const { return std::max(tool_->radius_m, tool_->reach_m); }
  double way_in(double dt_s) const;
  double way_of_step(std::size_t freedom) const;
  Pose within_reach(Pose pose) const;

  const model::ToolModel* tool_;
  Saved state_;
  Trial start_, last_;  // at the start of the step, and at the last trial
  Pose over_;           // that of the last trial whose load was too large
  bool has_over_ = false;
  Pose wanted_;
  double dt_s_ = 0;
  double way_m_ = 0;  // that the largest speed allows in this step
  bool gives_way_ = false;
};

}  // namespace tensormass::world
