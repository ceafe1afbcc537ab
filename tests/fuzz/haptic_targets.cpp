#include <stdlib.h>

#include <cmath>
#include <filesystem>
#include <fstream>

#include <gtest/gtest.h>

#include "fuzz/target.h"
#include "haptic/client_keys.h"
#include "haptic/feedback.h"
#include "haptic/haply_protocol.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::fuzz {
namespace {

namespace fs = std::filesystem;

/// What a hand feels: everything that is taken is finite, and no stiffness pushes.
class FeedbackTarget final : public MessageTarget<v1::ToolFeedback> {
 public:
  FeedbackTarget() {
    v1::ToolFeedback& feedback = seeds_.emplace_back();
    feedback.set_step(3);
    feedback.set_pose_sequence(7);
    feedback.mutable_position_m()->set_z(0.1);
    feedback.mutable_force_n()->set_z(-0.4);
    feedback.mutable_torque_n_m()->set_x(0.01);
    feedback.mutable_orientation()->set_w(1);
    feedback.add_joint_loads(0.02);
    v1::LocalModel& model = *feedback.mutable_local_model();
    model.set_valid_for_s(0.1);
    for (const double k : {100.0, 1.0, 0.0, 1.0, 80.0, 2.0, 0.0, 2.0, 90.0}) model.add_stiffness_n_per_m(k);
  }
  void run(const std::string& input) override {
    const auto feedback = haptic::decode_feedback(input, 0);
    if (!feedback) {
      EXPECT_FALSE(feedback.error().message.empty());
      return;
    }
    EXPECT_TRUE(feedback->position_m.allFinite() && feedback->force_n.allFinite() && feedback->torque_n_m.allFinite());
    EXPECT_TRUE(feedback->stiffness_n_per_m.allFinite() && feedback->orientation.coeffs().allFinite());
    EXPECT_TRUE(std::isfinite(feedback->jaw_torque_n_m) && std::isfinite(feedback->largest_stiffness_n_per_m));
    EXPECT_GE(feedback->valid_for_s, 0);
    for (const std::int64_t ns : {feedback->waited_ns, feedback->step_ns, feedback->published_after_ns}) {
      EXPECT_GE(ns, 0);
    }
    // Along any direction the force does not grow with the way, up to rounding.
    const Eigen::Matrix3d& k = feedback->stiffness_n_per_m;
    for (const Eigen::Vector3d& way : {Eigen::Vector3d(1, 0, 0), Eigen::Vector3d(1, -2, 3), Eigen::Vector3d(0, 1, 1)}) {
      EXPECT_GE(way.normalized().dot(k * way.normalized()), -3e-3 * k.cwiseAbs().maxCoeff());
    }
  }

 private:
  void take(v1::ToolFeedback&) override {}
};

/// What Haply's service sends: the first message and later ones.
class HaplyTarget final : public Target {
 public:
  std::string mutated(Random& random) const override {
    static const std::string kMessage =
        R"({"inverse3": [{"device_id": "049D", "config": {"preset": {}}, "state": {"cursor_position": )"
        R"({"x": 0.01, "y": -0.1, "z": 0.2}}, "status": {"calibrated": true, "power_supply": true}}], )"
        R"("wireless_verse_grip": [{"device_id": "61576", "state": {"orientation": )"
        R"({"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}}]})";
    return changed(kMessage, random);
  }
  void run(const std::string& input) override {
    const auto devices = haptic::parse_haply_snapshot(input, {});
    EXPECT_TRUE(devices || !devices.error().message.empty());
    const haptic::HaplyDevices known{.inverse_id = "049D", .grip_id = "61576"};
    const auto pose = haptic::parse_haply_state(input, devices ? *devices : known);
    if (!pose) {
      EXPECT_FALSE(pose.error().message.empty());
      return;
    }
    EXPECT_TRUE(pose->position_m.allFinite() && pose->orientation.coeffs().allFinite());
    EXPECT_FALSE(haptic::haply_force_command(known, {0, 0, 1}).empty());
  }
};

/// The key file that `tensormass keys add` writes.
class KeyFileTarget final : public Target {
 public:
  KeyFileTarget() {
    std::string path = (fs::temp_directory_path() / "tensormass-fuzz-XXXXXX").string();
    const int descriptor = mkstemp(path.data());  // for its owner alone, as a key file must be
    if (descriptor < 0) std::abort();
    close(descriptor);
    path_ = path;
  }
  ~KeyFileTarget() override {
    std::error_code none;
    fs::remove(path_, none);
  }
  std::string mutated(Random& random) const override {
    return changed(R"({"tensormass": "client keys", "authority": "a", "certificate": "b", "private_key": "c", )"
                   R"("curve_public": "d", "curve_secret": "e", "curve_server": "f", "made_s": 0, )"
                   R"("expires_s": 99999999999})",
                   random);
  }
  void run(const std::string& input) override {
    std::ofstream(path_, std::ios::binary | std::ios::trunc) << input;
    const auto keys = haptic::read_client_keys(path_.string());
    EXPECT_TRUE(keys ? !keys->certificate.empty() : keys.error().message.find(path_.string()) != std::string::npos);
  }

 private:
  fs::path path_;
};

}  // namespace

std::vector<Case> haptic_cases() {
  return {of<FeedbackTarget>("haptic-feedback", 20'000), of<HaplyTarget>("haptic-haply", 5000),
          of<KeyFileTarget>("haptic-keys", 300)};
}

}  // namespace tensormass::fuzz
