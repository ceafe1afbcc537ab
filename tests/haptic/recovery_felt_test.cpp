// What a hand feels when a step cannot be made: the whole haptic client against a scene whose backend fails as planned,
// in simulated time. Each case prints a row of the table in docs/decisions/haptics.md.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <memory>
#include <optional>
#include <ostream>
#include <string>
#include <vector>

#include <fmt/format.h>
#include <gtest/gtest.h>

#include "fakes.h"
#include "haptic/loop.h"
#include "haptic/run_device.h"
#include "haptic/simulated_device.h"
#include "support/faulty_backend.h"
#include "support/scenes.h"
#include "world/messages.h"
#include "world/world.h"

namespace tensormass::haptic {
namespace {

constexpr std::uint64_t kClientId = 1;
/// The hand approaches for 0.5 s and presses until 1.6 s, 7 mm deep if it were rigid.
constexpr double kScriptPeriodS = 2.0, kHoldEndsS = 1.6;
constexpr double kSurfaceM = 0.06, kPressM = 0.007;
constexpr double kRadiusM = 0.01;  // the probe's
/// The fault comes while the hand holds, and its effects are looked at for this long.
constexpr double kFaultS = 1.0, kAfterS = 0.4;

/// Steps that cannot be made, from the first on.
struct Faulty {
  const char* name;
  double more_s;  ///< for so long after the first step
  /// Solves of a step that fail. With 2 the tools back off, and the third one succeeds.
  std::uint64_t solves;
};
constexpr std::uint64_t kAllSolves = ~std::uint64_t{0};
constexpr Faulty kBackOff{"tools back off in one step", 0, 2};
constexpr Faulty kHeldOnce{"tissue is held for one step", 0, kAllSolves};
constexpr Faulty kHeldLong{"tissue is held for 0.08 s", 0.08, kAllSolves};

/// Rate of the scene, and stiffness of the grip. At 60 Hz a loose grip shakes on this tissue without any fault, as in
/// the stability map.
struct Setting {
  double rate_hz, hand_n_per_m;
};
constexpr Setting kSettings[]{{960, 100}, {960, 800}, {60, 800}};

void PrintTo(const Setting& setting, std::ostream* out) {
  *out << fmt::format("{} Hz, a grip of {} N/m", setting.rate_hz, setting.hand_n_per_m);
}

/// A scene as the server at the other end, without network. It takes the newest pose at the start of each step and
/// answers at its end.
class SceneLink final : public Link {
 public:
  SceneLink(std::unique_ptr<world::World> scene, Clock& clock)
      : scene_(std::move(scene)),
        clock_(clock),
        period_ns_(std::llround(scene_->model().dt_s * kNsPerS)),
        next_step_ns_(clock.now_ns() + period_ns_) {}

  bool send(const OutgoingPose& pose) override {
    step_until(clock_.now_ns() - 1);
    newest_ = pose;
    return true;
  }
  std::optional<Feedback> receive() override {
    step_until(clock_.now_ns());
    return inbox_.take();
  }
  std::uint64_t malformed() const override { return inbox_.malformed(); }

  /// Whether a step failed for good.
  bool stopped() const { return stopped_; }
  std::uint64_t recovering_steps() const { return recovering_steps_; }
  /// Largest distance of the tool from the newest pose of the hand, in steps that recover [m].
  double farthest_m() const { return farthest_m_; }

 private:
  void step_until(std::int64_t now_ns) {
    for (; next_step_ns_ <= now_ns && !stopped_; next_step_ns_ += period_ns_) {
      if (!newest_) continue;
      world::PoseStamp stamp;
      stamp.sequence = newest_->sequence;
      stamp.client_id = newest_->client_id;
      stamp.client_time_ns = static_cast<std::uint64_t>(newest_->client_time_ns);
      scene_->set_tool_target(0, {newest_->pose.position_m, {1, 0, 0, 0}, {}}, stamp);
      stopped_ = !scene_->step(false);
      recovering_steps_ += scene_->recovering();
      if (scene_->recovering()) {
        const double from_hand_m = (scene_->readings()[0].pose.position_m - newest_->pose.position_m).norm();
        farthest_m_ = std::max(farthest_m_, from_hand_m);
      }
      world::fill_feedback(scene_->model(), {.step = scene_->step_count()}, 0, scene_->readings()[0], message_);
      inbox_.offer(message_.SerializeAsString(), next_step_ns_);
    }
  }

  std::unique_ptr<world::World> scene_;
  Clock& clock_;
  const std::int64_t period_ns_;
  std::int64_t next_step_ns_;
  std::optional<OutgoingPose> newest_;
  v1::ToolFeedback message_;
  FeedbackInbox inbox_;
  bool stopped_ = false;
  std::uint64_t recovering_steps_ = 0;
  double farthest_m_ = 0;
};

/// Keeps the force that each tick wrote.
class RecordingDevice final : public Device {
 public:
  RecordingDevice(SimulatedDevice& device, Clock& clock) : device_(device), clock_(clock), start_ns_(clock.now_ns()) {}

  Result<void> open() override { return device_.open(); }
  const DeviceInfo& info() const override { return device_.info(); }
  Result<DevicePose> read() override { return device_.read(); }
  Result<void> write_force(const Eigen::Vector3d& force_n) override { return write({force_n}); }
  Result<void> write(const Wrench& wrench) override {
    times_s.push_back(static_cast<double>(clock_.now_ns() - start_ns_) / kNsPerS);
    forces_n.push_back(wrench.force_n);
    depths_m.push_back(kSurfaceM - device_.read().value().position_m.y());
    return device_.write(wrench);
  }
  void close() noexcept override { device_.close(); }

  std::vector<double> times_s, depths_m;
  std::vector<Eigen::Vector3d> forces_n;

 private:
  SimulatedDevice& device_;
  Clock& clock_;
  std::int64_t start_ns_;
};

/// What the hand felt around the fault.
struct Felt {
  double before_n = 0, least_n = 0, most_n = 0;
  double change_n = 0;  ///< largest from one tick to the next
  double moved_m = 0;   ///< how far the hand went
  double after_n = 0;
  double farthest_m = 0;  ///< see SceneLink
  std::uint64_t recoveries = 0, recovering_steps = 0;
  bool stopped = false;
};

class RecoveryFelt : public tests::OnFaultyBackend {
 protected:
  Felt press(const Faulty& faulty, const Setting& setting) {
    const auto [rate_hz, hand_n_per_m] = setting;
    v1::Scene scene = tests::block_with_probe(false, 6);
    scene.mutable_bodies(0)->mutable_law()->mutable_stable_neo_hookean()->set_young_modulus_pa(1e4);
    scene.mutable_bodies(0)->mutable_law()->mutable_stable_neo_hookean()->set_poisson_ratio(0.4);
    scene.mutable_bodies(0)->set_rayleigh_stiffness_s(0.01);
    scene.mutable_stepping()->set_dt_s(1 / rate_hz);
    const auto first = static_cast<std::uint64_t>(std::llround(kFaultS * rate_hz));
    const std::uint64_t end = first + std::max<std::uint64_t>(1, std::llround(faulty.more_s * rate_hz));
    auto world = start_faulty(scene, [=, solves = faulty.solves](std::uint64_t step, std::uint64_t call) {
      return step >= first && step < end && call < solves ? std::optional(tests::Fault::kNotANumber) : std::nullopt;
    });

    FakeClock clock;
    SimulatedDeviceOptions grip;
    grip.hand_stiffness_n_per_m = hand_n_per_m;
    grip.hand_damping_n_s_per_m = 0.015 * hand_n_per_m;
    HandScriptOptions script;
    script.home_m = {0.05, 0.08, 0.05};
    script.contact_m = {0.05, kSurfaceM - kPressM, 0.05};
    script.direction = -Eigen::Vector3d::UnitY();
    script.depth_m = 0;
    script.circle_radius_m = 0;
    script.period_s = kScriptPeriodS;
    SimulatedDevice simulated(grip, HandScript::create(script).value(), clock);
    RecordingDevice device(simulated, clock);
    EXPECT_TRUE(device.open());
    ForceGuard guard(device, clock, kWatchdogTimeoutS);
    SceneLink link(std::move(world), clock);
    LoopOptions options;
    options.duration_s = kHoldEndsS;
    options.drain_s = 0;
    options.client_id = kClientId;
    const std::atomic<bool> stop = false;
    const LoopReport report = Loop(guard, link, clock, options).run(stop).value();

    Felt felt;
    felt.stopped = link.stopped();
    felt.recoveries = report.recoveries;
    felt.recovering_steps = link.recovering_steps();
    felt.farthest_m = link.farthest_m();
    double depth_m = 0;
    for (std::size_t i = 1; i < device.times_s.size(); ++i) {
      const double time_s = device.times_s[i], force_n = device.forces_n[i].y();
      if (time_s < kFaultS) {
        felt.before_n = felt.least_n = felt.most_n = force_n;
        depth_m = device.depths_m[i];
      } else if (time_s < kFaultS + kAfterS) {
        felt.least_n = std::min(felt.least_n, force_n);
        felt.most_n = std::max(felt.most_n, force_n);
        felt.change_n = std::max(felt.change_n, (device.forces_n[i] - device.forces_n[i - 1]).norm());
        felt.moved_m = std::max(felt.moved_m, std::abs(device.depths_m[i] - depth_m));
        felt.after_n = force_n;
      }
    }
    fmt::print("| {} | {:.0f} | {:.0f} | {:.3f} | {:.3f} to {:.3f} | {:.4f} | {:.2f} | {:.3f} |\n", faulty.name,
               rate_hz, hand_n_per_m, felt.before_n, felt.least_n, felt.most_n, felt.change_n, 1e3 * felt.moved_m,
               felt.after_n);
    return felt;
  }
};

/// A step that is made otherwise, or not at all, is not felt.
TEST_P(RecoveryFelt, AStepThatCannotBeMadeIsNotFelt) {
  for (const Setting& setting : kSettings) {
    for (const Faulty& faulty : {kBackOff, kHeldOnce}) {
      SCOPED_TRACE(faulty.name);
      SCOPED_TRACE(testing::PrintToString(setting));
      const Felt felt = press(faulty, setting);
      ASSERT_GT(felt.before_n, 0.2);
      EXPECT_EQ(felt.recovering_steps, 1u);
      EXPECT_EQ(felt.recoveries, 1u) << "the client counts it";
      EXPECT_GT(felt.least_n, 0.98 * felt.before_n);
      EXPECT_LT(felt.most_n, 1.02 * felt.before_n);
      EXPECT_LT(felt.change_n, 0.01 * felt.before_n);
      EXPECT_LT(felt.moved_m, 1e-4);
    }
  }
}

/// Tissue that stays held lets the tool go after 0.05 s. The force fades, comes back within the device's limits, and is
/// soon that of before.
TEST_P(RecoveryFelt, ALongHoldFadesAndTheForceComesBack) {
  for (const Setting& setting : kSettings) {
    SCOPED_TRACE(testing::PrintToString(setting));
    const Felt felt = press(kHeldLong, setting);
    EXPECT_FALSE(felt.stopped);
    EXPECT_EQ(felt.recoveries, 1u);
    EXPECT_GE(felt.recovering_steps, 4u);
    EXPECT_LE(felt.most_n, 3.0);
    EXPECT_LE(felt.change_n, 0.3 * (1 + 1e-9)) << "300 N/s";
    EXPECT_NEAR(felt.after_n, felt.before_n, 0.1 * felt.before_n);
    EXPECT_GT(felt.farthest_m, kRadiusM) << "the tool backs off while the tissue is held";
    EXPECT_LT(felt.farthest_m, 2 * kRadiusM + kPressM) << "two radii from the hand, and what the hand moves in a step";
  }
}

TM_ON_EACH_BACKEND(RecoveryFelt);

}  // namespace
}  // namespace tensormass::haptic
