#include "closed_loop.h"

#include <algorithm>
#include <cmath>
#include <deque>
#include <limits>
#include <optional>
#include <random>
#include <vector>

#include "fakes.h"
#include "haptic/loop.h"
#include "haptic/run_device.h"
#include "haptic/simulated_device.h"
#include "world/coupling.h"

namespace tensormass::haptic {
namespace {

constexpr std::uint64_t kClientId = 1;
// Device and hand together.
constexpr double kMassKg = 0.1;

// A script without circles approaches for a quarter of its period and holds until 80 % of it.
constexpr double kScriptPeriodS = 4.0;
constexpr double kHoldEndsS = 0.8 * kScriptPeriodS;
constexpr double kHomeM = 0.02;
// The hand's target inside the wall. A firm grip on the stiffest wall then stays below the loop's 3 N.
constexpr double kPressM = 0.004;
// A free mass starts here and is pushed by a spring so soft and long that its force is constant.
constexpr double kFreeHomeM = 0.01;
constexpr double kFreePushN = 0.5;
constexpr double kFreeStiffness = 1.0;
// The organ is a standard linear solid: a spring beside a spring and damper in series, which relaxes in kRelaxS.
constexpr double kRelaxingShare = 0.5;
constexpr double kRelaxS = 0.2;
// Hertz's tangent over the organ's own stiffness. Three times too soft, as for a thin organ.
constexpr double kReportedShare = 1.0 / 3.0;
// Share of the force by which an iterative solver's answer scatters.
constexpr double kNoise = 0.01;
// As local_model_validity_s() of the server.
constexpr double kValidSteps = 3.0;
constexpr double kMinValidForS = 0.02;
// Force at which tissue parts under a blade. Hands push harder, the free mass less: it would fall through the tissue.
constexpr double kCutN = 0.25, kCutFreeN = 1.0;
// The last third must exceed the first by this factor, so that equal oscillations do not count as growth.
constexpr double kGrowth = 1.1;

std::int64_t to_ns(double seconds) { return static_cast<std::int64_t>(std::llround(seconds * kNsPerS)); }

SimulatedDeviceOptions device_of(Hand hand) {
  SimulatedDeviceOptions options;
  options.mass_kg = kMassKg;
  switch (hand) {
    case Hand::kSoft:
      options.hand_stiffness_n_per_m = 100.0;
      options.hand_damping_n_s_per_m = 1.5;
      break;
    case Hand::kStiff:
      options.hand_stiffness_n_per_m = 800.0;
      options.hand_damping_n_s_per_m = 12.0;
      break;
    case Hand::kNone:
      options.hand_stiffness_n_per_m = kFreeStiffness;
      options.hand_damping_n_s_per_m = 0.0;
      break;
  }
  return options;
}

HandScript script_of(Hand hand) {
  const bool free = hand == Hand::kNone;
  HandScriptOptions options;
  options.home_m.z() = free ? kFreeHomeM : kHomeM;
  options.contact_m.z() = free ? -kFreePushN / kFreeStiffness : -kPressM;
  options.depth_m = 0.0;
  options.circle_radius_m = 0.0;
  options.period_s = kScriptPeriodS;
  return HandScript::create(options).value();
}

/// Messages on their way in one direction. Keeps their order.
template <class Message>
class Wire {
 public:
  Wire(const Case& c, std::mt19937& random) : case_(c), random_(random) {}

  void send(const Message& message, std::int64_t now_ns) {
    std::uniform_real_distribution<double> uniform(0.0, 1.0);
    const double jitter_s = case_.jitter_s * uniform(random_);
    if (uniform(random_) < case_.loss) return;
    last_arrival_ns_ = std::max(last_arrival_ns_, now_ns + to_ns(case_.delay_s + jitter_s));
    messages_.push_back({last_arrival_ns_, message});
  }

  struct Arrived {
    std::int64_t arrival_ns;
    Message message;
  };
  /// The newest message that has arrived by `now_ns`. Older ones are dropped.
  std::optional<Arrived> newest(std::int64_t now_ns) {
    std::optional<Arrived> found;
    for (; !messages_.empty() && messages_.front().arrival_ns <= now_ns; messages_.pop_front()) {
      found = messages_.front();
    }
    return found;
  }

 private:
  const Case& case_;
  std::mt19937& random_;
  std::int64_t last_arrival_ns_ = 0;
  std::deque<Arrived> messages_;
};

/// Network and server. The server takes the newest pose at the start of each step and answers at its end, as a server
/// whose step takes its whole period.
class SimulatedServer final : public Link {
 public:
  SimulatedServer(const Case& c, bool sends_stiffness, Clock& clock)
      : case_(c),
        sends_stiffness_(sends_stiffness),
        clock_(clock),
        random_(c.seed),
        period_s_(1.0 / c.server_rate_hz),
        period_ns_(to_ns(period_s_)),
        next_step_ns_(clock.now_ns() + period_ns_) {}

  bool send(const OutgoingPose& pose) override {
    // A step at this very time waits for receive(), so that it takes this pose if the network has no delay.
    step_until(clock_.now_ns() - 1);
    poses_.send(pose, clock_.now_ns());
    return true;
  }

  std::optional<Feedback> receive() override {
    step_until(clock_.now_ns());
    auto arrived = feedback_.newest(clock_.now_ns());
    if (!arrived) return std::nullopt;
    arrived->message.arrival_ns = arrived->arrival_ns;
    return arrived->message;
  }

  std::uint64_t malformed() const override { return 0; }

 private:
  void step_until(std::int64_t now_ns) {
    for (; next_step_ns_ <= now_ns; next_step_ns_ += period_ns_) {
      // The answer of the step that ends now, to the pose that it took at its start.
      if (taken_) feedback_.send(answer(*taken_), next_step_ns_);
      if (const auto pose = poses_.newest(next_step_ns_)) taken_ = pose->message;
    }
  }

  Feedback answer(const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, ++step_);
    feedback.valid_for_s = std::max(kValidSteps * period_s_, kMinValidForS);
    if (case_.tool_mass_kg > 0.0) {
      move_tool(pose.pose.position_m);
      feedback.force_n = tool_.force_n;
      if (sends_stiffness_) set_stiffness(feedback, tool_.stiffness_n_per_m);
      return feedback;
    }
    const world::FeltContact contact = touch(pose.pose.position_m);
    feedback.force_n = contact.force_n;
    if (!sends_stiffness_) return feedback;
    if (case_.tissue != Tissue::kCut) {
      set_stiffness(feedback, contact.stiffness_n_per_m);
    } else if (contact.force_n.z() > 0.0) {  // a blade that went back holds nothing
      feedback.yielding = {-Eigen::Vector3d::UnitZ(), case_.stiffness_n_per_m, cut_n()};
    }
    return feedback;
  }

  double cut_n() const { return case_.hand == Hand::kNone ? kCutFreeN : kCutN; }

  static void set_stiffness(Feedback& feedback, const Eigen::Matrix3d& stiffness_n_per_m) {
    feedback.stiffness_n_per_m = stiffness_n_per_m;
    feedback.largest_stiffness_n_per_m = stiffness_n_per_m(2, 2);
  }

  /// Steps the tissue with a tool at this place. Returns its force, and the stiffness that the server knows of it.
  world::FeltContact touch(const Eigen::Vector3d& tool_m) {
    world::FeltContact contact{.position_m = tool_m};
    const double force_n = force_at(std::max(-tool_m.z(), 0.0));
    if (tool_m.z() >= 0.0 || force_n <= 0.0) return contact;
    contact.force_n.z() = force_n;
    contact.stiffness_n_per_m(2, 2) = (case_.tissue == Tissue::kOrgan ? kReportedShare : 1.0) * case_.stiffness_n_per_m;
    return contact;
  }

  /// Steps the tool with a mass and its coupling to the hand's new place, as the server does.
  void move_tool(const Eigen::Vector3d& hand_m) {
    const double k = case_.coupling_n_per_m;
    const world::Coupling coupling{case_.tool_mass_kg, k, 2.0 * std::sqrt(k * case_.tool_mass_kg)};
    if (step_ == 1) felt_.position_m = hand_m_ = hand_m;
    const Eigen::Vector3d hand_m_per_s = (hand_m - hand_m_) / period_s_;
    hand_m_ = hand_m;
    tool_m_per_s_ =
        world::coupled_velocity(coupling, felt_.position_m, tool_m_per_s_, hand_m, hand_m_per_s, felt_, period_s_);
    const world::FeltContact touched = touch(felt_.position_m + period_s_ * tool_m_per_s_);
    felt_ = world::feel(felt_, touched.position_m, touched.force_n, touched.stiffness_n_per_m,
                        std::numeric_limits<double>::infinity());
    tool_.force_n = k * (felt_.position_m - hand_m) + coupling.damping_n_s_per_m * (tool_m_per_s_ - hand_m_per_s);
    tool_.stiffness_n_per_m = world::in_series(k, touched.stiffness_n_per_m);
  }

  /// Steps the tissue to a depth.
  double force_at(double depth_m) {
    const double elastic_n = case_.stiffness_n_per_m * depth_m;
    if (case_.tissue == Tissue::kWall) return elastic_n;
    if (case_.tissue == Tissue::kCut) {
      cut_m_ = std::max(cut_m_, depth_m - cut_n() / case_.stiffness_n_per_m);
      const double noise = 1.0 + kNoise * std::uniform_real_distribution<double>(-1.0, 1.0)(random_);
      return case_.stiffness_n_per_m * std::max(depth_m - cut_m_, 0.0) * noise;
    }
    // The damper's length q follows the depth: q' = (depth − q) / kRelaxS, by implicit Euler.
    relaxed_m_ += period_s_ / (period_s_ + kRelaxS) * (depth_m - relaxed_m_);
    const double viscous_n = kRelaxingShare * case_.stiffness_n_per_m * (depth_m - relaxed_m_);
    return (elastic_n + viscous_n) * (1.0 + kNoise * std::uniform_real_distribution<double>(-1.0, 1.0)(random_));
  }

  const Case case_;
  const bool sends_stiffness_;
  Clock& clock_;
  std::mt19937 random_;
  Wire<OutgoingPose> poses_{case_, random_};
  Wire<Feedback> feedback_{case_, random_};
  const double period_s_;
  const std::int64_t period_ns_;
  std::int64_t next_step_ns_;
  std::uint64_t step_ = 0;
  std::optional<OutgoingPose> taken_;
  double relaxed_m_ = 0.0;
  double cut_m_ = 0.0;  // how deep the tissue is cut
  // Only for a tool with a mass.
  Eigen::Vector3d hand_m_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d tool_m_per_s_ = Eigen::Vector3d::Zero();
  world::FeltContact felt_;  // at the tool's place
  world::FeltContact tool_;  // what the hand feels
};

/// Passes everything on to a device and records its motion.
class RecordingDevice final : public Device {
 public:
  struct Sample {
    double time_s;
    double position_m;
    double speed_m_per_s;
  };

  RecordingDevice(SimulatedDevice& device, Clock& clock) : device_(device), clock_(clock), start_ns_(clock.now_ns()) {}

  Result<void> open() override { return device_.open(); }
  const DeviceInfo& info() const override { return device_.info(); }
  Result<DevicePose> read() override {
    Result<DevicePose> pose = device_.read();
    const double z_m = pose.value().position_m.z();
    if (!samples_.empty()) work_j_ += device_.held_force_n().z() * (z_m - samples_.back().position_m);
    generated_energy_j_ = std::max(generated_energy_j_, work_j_);
    samples_.push_back(
        {static_cast<double>(clock_.now_ns() - start_ns_) / kNsPerS, z_m, std::abs(device_.velocity_m_per_s().z())});
    return pose;
  }
  Result<void> write_force(const Eigen::Vector3d& force_n) override { return device_.write_force(force_n); }
  void close() noexcept override { device_.close(); }

  const std::vector<Sample>& samples() const { return samples_; }
  double generated_energy_j() const { return generated_energy_j_; }

 private:
  SimulatedDevice& device_;
  Clock& clock_;
  std::int64_t start_ns_;
  std::vector<Sample> samples_;
  double work_j_ = 0.0;
  double generated_energy_j_ = 0.0;
};

Motion motion_of(const std::array<double, 3>& kinetic_energy_j) {
  constexpr double kRestEnergyJ = 0.5 * kMassKg * kRestSpeedMPerS * kRestSpeedMPerS;
  if (kinetic_energy_j[2] < kRestEnergyJ) return Motion::kRests;
  return kinetic_energy_j[2] > kGrowth * kinetic_energy_j[0] ? Motion::kGrows : Motion::kShakes;
}

}  // namespace

std::string_view name_of(Hand hand) {
  constexpr std::array<std::string_view, 3> kNames{"soft", "stiff", "none"};
  return kNames[static_cast<std::size_t>(hand)];
}

std::string_view name_of(Tissue tissue) {
  constexpr std::array<std::string_view, 3> kNames{"wall", "organ", "cut"};
  return kNames[static_cast<std::size_t>(tissue)];
}

std::string_view name_of(Chain chain) {
  constexpr std::array<std::string_view, kChainCount> kNames{"full", "no secant", "no controller",
                                                             "transmitted with controller", "transmitted"};
  return kNames[static_cast<std::size_t>(chain)];
}

std::string_view name_of(Motion motion) {
  constexpr std::array<std::string_view, 3> kNames{"rests", "shakes", "grows"};
  return kNames[static_cast<std::size_t>(motion)];
}

Outcome run_case(const Case& c, Chain chain) {
  const bool transmits = chain == Chain::kTransmitted || chain == Chain::kTransmittedWithController;
  FakeClock clock;
  SimulatedDevice simulated(device_of(c.hand), script_of(c.hand), clock);
  RecordingDevice device(simulated, clock);
  static_cast<void>(device.open());  // fails only on options without meaning
  ForceGuard guard(device, clock, kWatchdogTimeoutS);
  SimulatedServer server(c, !transmits, clock);
  LoopOptions loop;
  loop.duration_s = kHoldEndsS;
  loop.drain_s = 0.0;
  loop.client_id = kClientId;
  if (chain == Chain::kNoController || chain == Chain::kTransmitted) loop.passivity.max_damping = 0.0;
  if (chain == Chain::kNoSecant || transmits) {
    loop.renderer.min_secant_move_m = std::numeric_limits<double>::infinity();
  }
  const std::atomic<bool> stop = false;
  const LoopReport report = Loop(guard, server, clock, loop).run(stop).value();

  Outcome outcome;
  outcome.generated_energy_j = device.generated_energy_j();
  outcome.min_observer_energy_j = report.min_energy_j;
  outcome.max_force_n = report.max_force_n;
  const auto& samples = device.samples();
  const auto contact = std::find_if(samples.begin(), samples.end(), [](const auto& s) { return s.position_m < 0.0; });
  double lowest_m = 0.0, highest_m = 0.0;
  const double contact_s = contact == samples.end() ? kHoldEndsS : contact->time_s;
  for (auto sample = contact; sample != samples.end(); ++sample) {
    const double progress = (sample->time_s - contact_s) / (kHoldEndsS - contact_s);
    const auto third = std::min<std::size_t>(static_cast<std::size_t>(3.0 * progress), 2);
    double& peak_j = outcome.kinetic_energy_j[third];
    if (third == 2 && peak_j == 0.0) lowest_m = highest_m = sample->position_m;
    peak_j = std::max(peak_j, 0.5 * kMassKg * sample->speed_m_per_s * sample->speed_m_per_s);
    if (third == 2) {
      lowest_m = std::min(lowest_m, sample->position_m);
      highest_m = std::max(highest_m, sample->position_m);
    }
  }
  outcome.amplitude_m = highest_m - lowest_m;
  outcome.motion = motion_of(outcome.kinetic_energy_j);
  return outcome;
}

Outcome run_seeds(const Case& c, Chain chain, std::uint32_t count) {
  Outcome all;
  for (std::uint32_t i = 0; i < count; ++i) {
    Case seeded = c;
    seeded.seed += i;
    const Outcome one = run_case(seeded, chain);
    for (std::size_t third = 0; third < all.kinetic_energy_j.size(); ++third) {
      all.kinetic_energy_j[third] += one.kinetic_energy_j[third] / count;
    }
    all.amplitude_m = std::max(all.amplitude_m, one.amplitude_m);
    all.generated_energy_j = std::max(all.generated_energy_j, one.generated_energy_j);
    all.min_observer_energy_j = std::min(all.min_observer_energy_j, one.min_observer_energy_j);
    all.max_force_n = std::max(all.max_force_n, one.max_force_n);
  }
  all.motion = motion_of(all.kinetic_energy_j);
  return all;
}

}  // namespace tensormass::haptic
