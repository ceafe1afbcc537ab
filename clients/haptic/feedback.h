#pragma once

// The two messages of a haptic client, checked, and the mailbox between the transport's thread and the loop.
//
// Units: m, N, N/m, N m, s; times in ns on this client's monotonic clock. FeedbackInbox may be used by any thread; the
// functions are pure. A message that does not parse or is not finite is an error, never a force.

#include <cstdint>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "core/result.h"
#include "haptic/device.h"

namespace tensormass::haptic {

/// Time for which a pose holds without a newer one [s]. If this program dies, the server then lets the tool go. Longer
/// than any pause of a healthy network or machine.
inline constexpr double kPoseValidForS = 0.5;

/// A pose for the server, with what the server echoes in its feedback: sequence, client and time.
struct OutgoingPose {
  std::uint64_t sequence = 0;
  std::uint64_t client_id = 0;
  std::int64_t client_time_ns = 0;
  DevicePose pose;
  /// Not echoed: nobody else may learn it. Its poses claim the tool.
  std::uint64_t session = 0;
  /// Share of the power of a tool with Tool.cautery, 0 to 1. The server refuses it for other tools.
  double level = 0.0;
};

/// What holds a blade along the direction in which it cuts (SlippingSpring). limit_n is 0: nothing does.
struct YieldingModel {
  Eigen::Vector3d direction = Eigen::Vector3d::Zero();
  double stiffness_n_per_m = 0.0;
  double limit_n = 0.0;
};

/// A checked ToolFeedback: every value is finite and the stiffness is symmetric positive semi-definite.
struct Feedback {
  std::uint64_t step = 0;
  /// Echo of the pose that this feedback answers.
  std::uint64_t pose_sequence = 0;
  std::uint64_t client_id = 0;
  std::int64_t client_time_ns = 0;
  /// That client claims the tool, and the server refuses the poses of others.
  bool claimed = false;
  /// Time of arrival on this client's clock.
  std::int64_t arrival_ns = 0;
  /// Local model: force(p) = force_n − stiffness_n_per_m (p − position_m).
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Vector3d force_n = Eigen::Vector3d::Zero();
  Eigen::Matrix3d stiffness_n_per_m = Eigen::Matrix3d::Zero();
  /// Largest eigenvalue of the stiffness.
  double largest_stiffness_n_per_m = 0.0;
  YieldingModel yielding;
  double valid_for_s = 0.0;
  /// Torque on the tool about its own place, at this orientation.
  Eigen::Vector3d torque_n_m = Eigen::Vector3d::Zero();
  Eigen::Quaterniond orientation = Eigen::Quaterniond::Identity();
  /// Load of the tool's jaws; a positive one opens them. Zero for a tool without jaws.
  double jaw_torque_n_m = 0.0;
  /// The step could not be made as planned, so the force may have jumped.
  bool recovering = false;
  /// The scene has the tool no more. This feedback has no force.
  bool removed = false;
  /// Parts of the time that the server took [ns]: the pose's wait for the step, the step, and until the message was
  /// written.
  std::int64_t waited_ns = 0;
  std::int64_t step_ns = 0;
  std::int64_t published_after_ns = 0;
};

/// Serializes a v1::ToolPose into `out`, and reuses the string's capacity.
void encode_pose(const OutgoingPose& pose, std::string& out);

/// Parses and checks a v1::ToolFeedback. Fails if it does not parse, a value is not finite, the stiffness is not 3×3,
/// symmetric and positive semi-definite, or a yielding spring has no unit direction, no stiffness or no limit. Such a
/// model could push the hand without bound.
Result<Feedback> decode_feedback(std::string_view payload, std::int64_t arrival_ns);

/// Mailbox of one message: a transport's thread offers, the loop takes the newest. The lock is held for a copy of a few
/// hundred bytes; decoding happens outside the lock.
class FeedbackInbox {
 public:
  /// Decodes the message and replaces the newest. A malformed message is only counted. A message that replaces one of a
  /// recovery counts as recovering too, because the force jumps between the last one taken and this one.
  void offer(std::string_view payload, std::int64_t arrival_ns);
  void count_malformed();

  /// The newest message since the last call, if one came.
  std::optional<Feedback> take();
  std::uint64_t malformed() const;

 private:
  mutable std::mutex mutex_;
  std::optional<Feedback> newest_;
  std::uint64_t malformed_ = 0;
};

}  // namespace tensormass::haptic
