#pragma once

#include <cstdint>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>

#include <Eigen/Core>

#include "core/result.h"
#include "haptic/device.h"

namespace tensormass::haptic {

/// A pose on its way to the server.
struct OutgoingPose {
  std::uint64_t sequence = 0;
  std::uint64_t client_id = 0;
  std::int64_t client_time_ns = 0;
  DevicePose pose;
};

/// A ToolFeedback that was checked: everything in it is finite and the stiffness is symmetric positive semi-definite.
struct Feedback {
  std::uint64_t step = 0;
  std::uint64_t pose_sequence = 0;
  std::uint64_t client_id = 0;
  std::int64_t client_time_ns = 0;
  /// On this client's clock.
  std::int64_t arrival_ns = 0;
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Vector3d force_n = Eigen::Vector3d::Zero();
  Eigen::Matrix3d stiffness_n_per_m = Eigen::Matrix3d::Zero();
  /// Its largest eigenvalue.
  double largest_stiffness_n_per_m = 0.0;
  double valid_for_s = 0.0;
};

/// The bytes of a v1::ToolPose, into `out` (whose capacity is reused).
void encode_pose(const OutgoingPose& pose, std::string& out);

/// Parses and checks a v1::ToolFeedback. Refuses what does not parse, is not finite, or has a stiffness that is not
/// 3×3, symmetric and positive semi-definite: a force from it could push without bound.
Result<Feedback> decode_feedback(std::string_view payload, std::int64_t arrival_ns);

/// Where a transport's thread leaves what it receives and the loop picks up the newest. The lock is held for a copy
/// of a few hundred bytes; decoding happens outside of it.
class FeedbackInbox {
 public:
  /// Decodes and keeps; a malformed message is counted and changes nothing else.
  void offer(std::string_view payload, std::int64_t arrival_ns);
  void count_malformed();

  /// The newest since the last call.
  std::optional<Feedback> take();
  std::uint64_t malformed() const;

 private:
  mutable std::mutex mutex_;
  std::optional<Feedback> newest_;
  std::uint64_t malformed_ = 0;
};

}  // namespace tensormass::haptic
