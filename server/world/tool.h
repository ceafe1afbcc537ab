#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <span>

#include "core/assert.h"
#include "core/limits.h"
#include "core/scalar.h"
#include "model/model.h"
#include "physics/tool/pose.h"
#include "world/coupling.h"
#include "world/hold.h"
#include "world/step_clock.h"

/// A tool of a stepping scene: how it follows the poses of a client, and what a client gets back.
///
///     client ──ReceivedPose──> inbox ──> ToolMotion ──shape's pose──> step ──ToolForce──> ToolReading ──> client
///
///     hand's pose      follows the client's poses at the tool's maximum speed
///     tool's frame     the hand's pose; a tool with a mass is pulled to the hand's place instead (coupling.h)
///     shape's frame    the tool's frame moved by tip_offset_m; contact is computed there (physics/tool/tool.h)
///
/// The tool stays behind the hand where its load would exceed the largest that it bears, and where a step cannot be
/// made (hold.h).
namespace tensormass::world {

using physics::Pose;

/// The numbers of a pose's message, and when it came. Feedback repeats them, so that a client can measure its delay.
struct PoseStamp {
  std::uint64_t sequence = 0;
  std::uint64_t client_time_ns = 0;
  std::uint64_t client_id = 0;
  Clock::time_point arrived{};  ///< at the server
  bool claims = false;          ///< its client claims the tool (pose_inbox.h)
};

/// valid_for_s of a pose that holds until the next one, and of one that has expired.
inline constexpr double kUntilTheNext = std::numeric_limits<double>::infinity(), kExpired = 0;

struct ReceivedPose {
  Pose pose;
  bool has_joints = true;  ///< else the joints stay as they are
  PoseStamp stamp;
  double valid_for_s = kUntilTheNext;  ///< in the time of the simulation
  double level = 0;                    ///< share of its power that the tool uses, 0 to 1
};

/// What holds a blade along the direction in which it cuts (v1::YieldingSpring). limit_n is 0: nothing does.
struct YieldingSpring {
  Vec3<double> direction = Vec3<double>::Zero();
  double stiffness_n_per_m = 0, limit_n = 0;
};

/// A tool at the end of a step. Feedback, frames and the status all carry this.
struct ToolReading {
  Pose pose;
  /// Place of the hand for which force_n holds; that of the pose, unless the tool has a mass or gives way.
  Vec3<double> hand_m = Vec3<double>::Zero();
  PoseStamp newest;  ///< stamp of the newest pose that the step used; all zero before the first
  Vec3<double> force_n = Vec3<double>::Zero();     ///< on the hand: that of the coupling, if the tool has a mass
  Vec3<double> torque_n_m = Vec3<double>::Zero();  ///< about the tool's position
  Vec3<double> friction_n = Vec3<double>::Zero();  ///< the part of force_n that is friction
  /// Force of the tissue along each joint [N m or N].
  std::array<double, limits::kMaxToolJoints> joint_loads{};
  /// A haptic client closes its own loop with these.
  Mat3<double> stiffness_n_per_m = Mat3<double>::Zero();
  YieldingSpring yielding;
  bool touching = false;    ///< it touched tissue in this step
  bool retired = false;     ///< it touches nothing, because its newest pose has expired
  bool gives_way = false;   ///< it is not where the hand has moved it (hold.h)
  bool recovering = false;  ///< see World::recovering; or the tool comes back into contact after it
  double level = 0;         ///< share of its power that it used in this step, 0 to 1
};

/// Readings of all tools of a scene. A value with room for as many as a scene may have: to change their number
/// allocates nothing, and a copy takes those that there are.
class ToolReadings {
 public:
  ToolReadings() = default;
  explicit ToolReadings(std::span<const ToolReading> readings) { *this = readings; }
  ToolReadings(const ToolReadings& other) { *this = other.all(); }
  ToolReadings& operator=(const ToolReadings& other) { return *this = other.all(); }
  ToolReadings& operator=(std::span<const ToolReading> readings) {
    TM_ASSERT(readings.size() <= room_.size(), "a scene has no more tools");
    std::copy(readings.begin(), readings.end(), room_.begin());
    size_ = readings.size();
    return *this;
  }

  std::span<const ToolReading> all() const { return {room_.data(), size_}; }
  std::size_t size() const { return size_; }
  bool empty() const { return size_ == 0; }
  const ToolReading& operator[](std::size_t tool) const { return room_[tool]; }
  ToolReading* begin() { return room_.data(); }
  ToolReading* end() { return room_.data() + size_; }

 private:
  std::array<ToolReading, limits::kMaxTools> room_{};
  std::size_t size_ = 0;
};

/// The motion of one tool, step by step.
///
/// A pose may expire: its client has died, or the network has. The tool then stays where it is, and its *presence*, the
/// share of its contact stiffness, falls to zero within kFadeS: the tool is retired. With its next pose it appears
/// there, and its presence rises again. Tissue is thus neither held for ever nor struck. The presence is the fourth
/// power of a ramp: contact is much stiffer than tissue, so that most of the force is there at a few percent of it.
class ToolMotion {
 public:
  /// Time in which a tool fades out of contact, and into it again [s].
  static constexpr double kFadeS = 0.1;

  explicit ToolMotion(const model::ToolModel& tool) : tool_(&tool), hold_(tool) { place(); }

  /// Puts the tool at its initial pose, where it stays until the next target.
  void place() {
    current_ = {
        tool_->initial_pose, tool_->initial_pose.position_m, Vec3<double>::Zero(), Vec3<double>::Zero(), 1, 0, false};
    felt_ = {};
    felt_.position_m = tool_->initial_pose.position_m;
    hold_.restore({});
    comes_back_ = false;
    set_target(tool_->initial_pose, kUntilTheNext);
  }
  /// level: share of its power that the tool uses while the target is valid, 0 to 1.
  void set_target(const Pose& target, double valid_for_s, double level = 0) {
    target_ = target;
    valid_for_s_ = valid_for_s;
    level_ = level;
    current_.target_age_s = 0;
  }
  /// Starts a step of length dt_s: moves the tool towards its target, at most at its maximum speed.
  /// load: of the tissue at the end of the last step.
  void move(double dt_s, const backend::ToolForce& load);
  /// Returns Hold::share of a load at the end of the step; 0 for a fixed tool.
  double share(const backend::ToolForce& load, double rise) const {
    return tool_->fixed ? 0 : hold_.share(on_hand(load), rise);
  }
  /// Returns Hold::too_far_back of a load at the end of the step.
  bool too_far_back(const backend::ToolForce& load) const { return !tool_->fixed && hold_.too_far_back(on_hand(load)); }
  /// Moves the end of the step, because a trial of the step left this load.
  void give_way(const backend::ToolForce& load);
  /// Moves the end of the step out of the tissue, because the step could not be made. tried: load of its last trial.
  void back_off(double distance, const backend::ToolForce& tried);
  /// Lets go of the tissue: the presence is almost zero, and rises again in kFadeS. The tool waits for that where it
  /// is.
  void let_go() {
    current_.fade = std::min(current_.fade, kLetGo);
    comes_back_ = true;
    hold_.wait(kFadeS, dt_s_);
  }
  /// Begins to leave tissue that encloses the tool: it waits while its presence falls to zero within kFadeS.
  void leave(double dt_s);
  bool leaves() const { return current_.leaves; }
  /// Puts a tool that touches nothing at a pose. It waits there while its presence rises.
  void come_out(const Pose& pose, double dt_s);
  /// Share of its power that the tool uses, 0 to 1. None once its pose has expired: a dead client must not burn tissue.
  /// None either while it fades out of tissue or back into it, which is not where the hand is.
  double level() const { return present() && !leaves() ? level_ : 0; }
  /// Whether all of its contact stiffness is there.
  bool present() const { return current_.fade == 1; }
  /// Whether a recovery took the tool out of contact, and its contact stiffness still rises.
  bool comes_back() const { return comes_back_; }
  /// Whether the tool is not where the hand has moved it.
  bool gives_way() const { return hold_.gives_way(); }
  /// Ends a step that was made.
  void end_step() { hold_.end_step(); }
  /// Ends a step: takes the contact that the tool felt, for the next move of a tool with a mass.
  void feel(const Vec3<double>& force_n, const Mat3<double>& stiffness_n_per_m, double modulus_pa);
  /// Takes the last `move` back: its step failed.
  void take_back() { current_ = before_; }

  /// The motion between two steps.
  struct Saved {
    Pose pose, target;
    double valid_for_s = kUntilTheNext;
    double fade = 1;          ///< fourth root of the presence
    double target_age_s = 0;  ///< time since the target was set
    double level = 0;         ///< as of ReceivedPose
    bool leaves = false;      ///< see ToolMotion::leave
    bool comes_back = false;  ///< see ToolMotion::comes_back
    // Only for a tool with a mass.
    Vec3<double> hand_m = Vec3<double>::Zero();
    Vec3<double> hand_m_per_s = Vec3<double>::Zero();
    Vec3<double> velocity_m_per_s = Vec3<double>::Zero();
    FeltContact felt;
    Hold::Saved hold;
  };
  Saved save() const {
    return {current_.pose,   target_,     valid_for_s_,    current_.fade,         current_.target_age_s,     level_,
            current_.leaves, comes_back_, current_.hand_m, current_.hand_m_per_s, current_.velocity_m_per_s, felt_,
            hold_.saved()};
  }
  void restore(const Saved& saved) {
    target_ = saved.target;
    valid_for_s_ = saved.valid_for_s;
    level_ = saved.level;
    current_ = {saved.pose, saved.hand_m,       saved.hand_m_per_s, saved.velocity_m_per_s,
                saved.fade, saved.target_age_s, saved.leaves};
    felt_ = saved.felt;
    hold_.restore(saved.hold);
    comes_back_ = saved.comes_back;
  }

  const Pose& pose() const { return current_.pose; }
  bool has_mass() const { return tool_->mass_kg > 0; }
  const Vec3<double>& hand_m() const { return current_.hand_m; }
  /// Returns the force of the coupling on the hand [N].
  Vec3<double> force_on_hand_n() const {
    return tool_->coupling_stiffness_n_per_m * (current_.pose.position_m - current_.hand_m) +
           tool_->coupling_damping_n_s_per_m * (current_.velocity_m_per_s - current_.hand_m_per_s);
  }
  const Pose& target() const { return target_; }
  bool retired() const { return current_.fade == 0; }
  /// Pose of the shape of a tool that is at a pose.
  Pose shape_of(const Pose& pose) const { return {pose.position_m + lever(pose), pose.orientation, pose.joint_values}; }
  /// Pose of the shape at a fraction of the step: 0 is its start, 1 its end.
  Pose shape_at(double fraction) const { return physics::between(to_, from_, 1 - fraction); }
  /// Share of its contact stiffness at a fraction of the step.
  double presence_at(double fraction) const {
    const double fade = before_.fade + fraction * (current_.fade - before_.fade);
    return fade * fade * fade * fade;
  }
  /// Vector from the tool's position to the origin of its shape's frame [m].
  Vec3<double> lever() const { return lever(current_.pose); }

 private:
  static constexpr double kLetGo = 1e-3;  // fade of a tool that lets go; it is not retired, so it does not jump

  Vec3<double> lever(const Pose& pose) const { return physics::rotation(pose) * tool_->tip_offset_m; }
  double longest_way(const Pose& from, const Pose& to) const;
  Pose approach(const Pose& from, const Pose& to, double reach_m);
  void jump(const Pose& pose);
  void pull(const Pose& hand, double dt_s);
  void slip();
  void end_at(const Pose& pose);
  backend::ToolForce on_hand(const backend::ToolForce& load) const;

  struct State {
    Pose pose;  // in the simulation
    // Only for a tool with a mass, whose pose has the orientation and the joints of the hand.
    Vec3<double> hand_m = Vec3<double>::Zero();
    Vec3<double> hand_m_per_s = Vec3<double>::Zero();
    Vec3<double> velocity_m_per_s = Vec3<double>::Zero();
    double fade = 1;          // fourth root of the presence: it changes at a constant rate
    double target_age_s = 0;  // time since the target was set
    bool leaves = false;
  };

  const model::ToolModel* tool_;
  Pose target_;  // the newest pose that a client sent
  double valid_for_s_ = kUntilTheNext;
  double level_ = 0;
  State current_;
  State before_;             // at the start of the step
  FeltContact felt_;         // at the end of the last step
  Pose from_, to_;           // poses of the shape at the start and the end of the step
  double dt_s_ = 0;          // length of the step
  double planned_fade_ = 1;  // at the end of the step, unless the tool lets go
  bool comes_back_ = false;
  Hold hold_;
};

}  // namespace tensormass::world
