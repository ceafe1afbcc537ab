#include "haptic/feedback.h"

#include <cmath>
#include <limits>
#include <utility>

#include <Eigen/Eigenvalues>

#include "haptic/checks.h"
#include "haptic/clock.h"
#include "haptic/vector.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::haptic {
namespace {

// Relative. The server works in single precision by default, so its stiffness is symmetric only up to rounding.
constexpr double kStiffnessTolerance = 1e-3;
// A scene may be paused for days between a pose and the next step.
constexpr double kMaxServerTimeS = 1e9;

void to_proto(const Eigen::Vector3d& v, v1::Vector3& out) {
  out.set_x(v.x());
  out.set_y(v.y());
  out.set_z(v.z());
}

Result<void> read_stiffness(const v1::LocalModel& model, Feedback& feedback) {
  if (model.stiffness_n_per_m_size() != 9) return invalid("feedback: the local model's stiffness is not 3×3");
  Eigen::Matrix3d k;
  for (int i = 0; i < 9; ++i) k(i / 3, i % 3) = model.stiffness_n_per_m(i);
  if (!k.allFinite()) return invalid("feedback: the local model's stiffness is not finite");
  const double scale = k.cwiseAbs().maxCoeff();
  if ((k - k.transpose()).cwiseAbs().maxCoeff() > kStiffnessTolerance * scale) {
    return invalid("feedback: the local model's stiffness is not symmetric");
  }
  k = (0.5 * k + 0.5 * k.transpose()).eval();  // the sum of two large values may be infinite
  const Eigen::Vector3d eigenvalues =
      Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(k, Eigen::EigenvaluesOnly).eigenvalues();
  if (!eigenvalues.allFinite()) return invalid("feedback: the local model's stiffness is too large");
  if (eigenvalues(0) < -kStiffnessTolerance * scale) {
    return invalid("feedback: the local model's stiffness is not positive semi-definite");
  }
  feedback.stiffness_n_per_m = k;
  feedback.largest_stiffness_n_per_m = eigenvalues(2);
  return {};
}

Result<void> read_yielding(const v1::YieldingSpring& spring, Feedback& feedback) {
  constexpr double kUnit = 1e-3;
  YieldingModel& out = feedback.yielding;
  out = {to_eigen(spring.direction()), spring.stiffness_n_per_m(), spring.limit_n()};
  if (!(std::abs(out.direction.norm() - 1.0) < kUnit)) {
    return invalid("feedback: the direction of the yielding spring is not a unit vector");
  }
  if (!is_positive(out.stiffness_n_per_m) || !is_positive(out.limit_n)) {
    return invalid("feedback: stiffness and limit of the yielding spring must be positive and finite");
  }
  return {};
}

}  // namespace

void encode_pose(const OutgoingPose& pose, std::string& out) {
  v1::ToolPose message;
  message.set_sequence(pose.sequence);
  message.set_client_id(pose.client_id);
  message.set_session(pose.session);
  message.set_client_time_ns(static_cast<std::uint64_t>(pose.client_time_ns));
  to_proto(pose.pose.position_m, *message.mutable_position_m());
  v1::Quaternion& q = *message.mutable_orientation();
  q.set_w(pose.pose.orientation.w());
  q.set_x(pose.pose.orientation.x());
  q.set_y(pose.pose.orientation.y());
  q.set_z(pose.pose.orientation.z());
  if (pose.pose.jaw_angle_rad) message.add_joint_values(*pose.pose.jaw_angle_rad);
  message.set_valid_for_s(kPoseValidForS);
  message.set_level(pose.level);
  message.SerializeToString(&out);
}

Result<Feedback> decode_feedback(std::string_view payload, std::int64_t arrival_ns) {
  v1::ToolFeedback message;
  if (payload.size() > std::numeric_limits<int>::max() ||
      !message.ParseFromArray(payload.data(), static_cast<int>(payload.size()))) {
    return invalid("feedback: not a ToolFeedback message");
  }
  Feedback feedback;
  feedback.step = message.step();
  feedback.pose_sequence = message.pose_sequence();
  feedback.client_id = message.client_id();
  feedback.claimed = message.claimed();
  feedback.removed = message.removed();
  feedback.client_time_ns = static_cast<std::int64_t>(message.client_time_ns());
  feedback.arrival_ns = arrival_ns;
  // A tool that has a mass or gives way lags behind the hand, and the model belongs to the hand's place.
  feedback.position_m =
      to_eigen(message.local_model().has_anchor_m() ? message.local_model().anchor_m() : message.position_m());
  feedback.force_n = to_eigen(message.force_n());
  if (!is_position(feedback.position_m)) {
    return invalid("feedback: the position is not finite or beyond the largest length");
  }
  if (!feedback.force_n.allFinite()) return invalid("feedback: the force is not finite");
  feedback.torque_n_m = to_eigen(message.torque_n_m());
  // All four zero means no rotation, as in a pose.
  const v1::Quaternion& q = message.orientation();
  const Eigen::Quaterniond orientation(q.w(), q.x(), q.y(), q.z());
  if (!orientation.coeffs().isZero(0.0)) feedback.orientation = orientation;
  if (!is_rotation(feedback.orientation)) return invalid("feedback: the orientation is not a rotation");
  if (message.joint_loads_size() == 1) feedback.jaw_torque_n_m = message.joint_loads(0);
  if (!feedback.torque_n_m.allFinite() || !std::isfinite(feedback.jaw_torque_n_m)) {
    return invalid("feedback: the torque or the jaws' load is not finite");
  }
  if (message.has_local_model()) {
    feedback.valid_for_s = message.local_model().valid_for_s();
    if (!is_not_negative(feedback.valid_for_s)) return invalid("feedback: valid_for_s is negative or not finite");
    if (auto read = read_stiffness(message.local_model(), feedback); !read) {
      return tl::make_unexpected(std::move(read.error()));
    }
    if (message.local_model().has_yielding()) {
      if (auto read = read_yielding(message.local_model().yielding(), feedback); !read) {
        return tl::make_unexpected(std::move(read.error()));
      }
    }
  }
  feedback.recovering = message.recovering();
  for (const auto& [seconds, ns] :
       {std::pair{message.pose_waited_s(), &feedback.waited_ns}, std::pair{message.step_s(), &feedback.step_ns},
        std::pair{message.published_after_s(), &feedback.published_after_ns}}) {
    if (!(seconds >= 0 && seconds < kMaxServerTimeS)) return invalid("feedback: a time of the server is out of range");
    *ns = static_cast<std::int64_t>(seconds * kNsPerS);
  }
  return feedback;
}

void FeedbackInbox::offer(std::string_view payload, std::int64_t arrival_ns) {
  Result<Feedback> feedback = decode_feedback(payload, arrival_ns);
  const std::scoped_lock lock(mutex_);
  if (feedback) {
    feedback->recovering |= newest_ && newest_->recovering;
    newest_ = *feedback;
  } else {
    ++malformed_;
  }
}

void FeedbackInbox::count_malformed() {
  const std::scoped_lock lock(mutex_);
  ++malformed_;
}

std::optional<Feedback> FeedbackInbox::take() {
  const std::scoped_lock lock(mutex_);
  return std::exchange(newest_, std::nullopt);
}

std::uint64_t FeedbackInbox::malformed() const {
  const std::scoped_lock lock(mutex_);
  return malformed_;
}

}  // namespace tensormass::haptic
