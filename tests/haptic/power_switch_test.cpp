#include "haptic/power_switch.h"

#include <gtest/gtest.h>

#include <atomic>
#include <functional>
#include <limits>
#include <optional>
#include <vector>

#include "fakes.h"
#include "haptic/loop.h"

namespace tensormass::haptic {
namespace {

constexpr std::uint64_t kClientId = 42, kAnother = 7;

TEST(PowerSwitch, GivesPowerWhileTheButtonIsDown) {
  PowerSwitch power(0.4);
  for (const bool pressed : {false, true, true, false, true})
    EXPECT_EQ(power.level(pressed, true), pressed ? 0.4 : 0.0);
}

TEST(PowerSwitch, AButtonThatIsDownFromTheStartGivesNone) {
  PowerSwitch power(1.0);
  EXPECT_EQ(power.level(true, true), 0.0);
  EXPECT_EQ(power.level(false, false), 0.0) << "up while the tool is not ours: that does not count";
  EXPECT_EQ(power.level(true, true), 0.0);
  EXPECT_EQ(power.level(false, true), 0.0);
  EXPECT_EQ(power.level(true, true), 1.0);
}

TEST(PowerSwitch, IsLockedUntilTheButtonWasUpAgain) {
  PowerSwitch power(1.0);
  power.level(false, true);
  EXPECT_EQ(power.level(true, false), 0.0);
  EXPECT_EQ(power.level(true, true), 0.0);
  power.level(false, true);
  power.lock();
  EXPECT_EQ(power.level(true, true), 0.0);
}

/// A loop of `ticks` whose device does what `script` says in each of them, from 1.
struct Bench {
  FakeClock clock;
  FakeDevice device;
  FakeLink link;
  ForceGuard guard{device, clock, 0.05};
  std::atomic<bool> stop = false;
  std::uint64_t tick = 0, step = 0;

  Bench() {
    link.answer = [this](const OutgoingPose& pose) { return std::optional(answer_to(pose, ++step)); };
  }

  std::vector<double> run(std::uint64_t ticks, const std::function<void()>& script, double power_level = 0.5) {
    LoopOptions options;
    options.duration_s = 1e-3 * static_cast<double>(ticks);
    options.drain_s = 0.0;
    options.client_id = kClientId;
    options.power_level = power_level;
    device.on_read = [this, script] {
      ++tick;
      script();
    };
    report = Loop(guard, link, clock, options).run(stop);
    std::vector<double> levels;
    for (const OutgoingPose& pose : link.sent) levels.push_back(pose.level);
    return levels;
  }
  /// Levels of the poses `from` to `to`, the first one is 1.
  static std::vector<double> part(const std::vector<double>& levels, std::size_t from, std::size_t to) {
    return {levels.begin() + static_cast<std::ptrdiff_t>(from) - 1, levels.begin() + static_cast<std::ptrdiff_t>(to)};
  }

  Result<LoopReport> report;
};

using Levels = std::vector<double>;

TEST(PowerInTheLoop, FollowsTheButtonAndIsOffInTheLastPose) {
  Bench bench;
  const Levels levels = bench.run(8, [&] { bench.device.pose.pressed = bench.tick == 4 || bench.tick >= 7; });
  EXPECT_EQ(levels, (Levels{0, 0, 0, 0.5, 0, 0, 0.5, 0.5, 0})) << "one pose more than ticks";
  EXPECT_EQ(bench.report->poses_with_power, 3u);
  EXPECT_EQ(bench.link.sent.back().sequence, 9u);
}

TEST(PowerInTheLoop, WithoutAPressNoPoseIsAdded) {
  Bench bench;
  EXPECT_EQ(bench.run(5, [] {}), Levels(5, 0.0));
}

TEST(PowerInTheLoop, ALevelOutsideOfItsRangeIsZero) {
  for (const double wrong : {-0.1, 1.5, std::numeric_limits<double>::quiet_NaN()}) {
    Bench bench;
    EXPECT_EQ(bench.run(
                  5, [&] { bench.device.pose.pressed = bench.tick > 2; }, wrong),
              Levels(5, 0.0));
  }
}

TEST(PowerInTheLoop, ADeviceThatFailsHasItsPowerTakenOff) {
  Bench bench;
  const Levels levels = bench.run(20, [&] {
    bench.device.pose.pressed = bench.tick >= 4;
    bench.device.broken = bench.tick == 6;
  });
  EXPECT_EQ(levels, (Levels{0, 0, 0, 0.5, 0.5, 0.5, 0}));
  EXPECT_FALSE(bench.report);
}

TEST(PowerInTheLoop, AnInvalidPoseTakesThePowerOffAtOnce) {
  Bench bench;
  const Levels levels = bench.run(10, [&] {
    bench.device.pose.pressed = bench.tick >= 4;
    bench.device.pose.position_m.x() = bench.tick == 6 ? std::numeric_limits<double>::infinity() : 0.0;
  });
  // The sixth pose is the fifth once more, without power. The button must come up before there is power again.
  EXPECT_EQ(levels, (Levels{0, 0, 0, 0.5, 0.5, 0, 0, 0, 0, 0}));
}

TEST(PowerInTheLoop, AnotherClientsClaimTakesThePowerOff) {
  Bench bench;
  bench.link.answer = [&](const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, ++bench.step);
    if (bench.tick == 6) {
      feedback.client_id = kAnother;
      feedback.claimed = true;
    }
    return std::optional(feedback);
  };
  const Levels levels = bench.run(12, [&] { bench.device.pose.pressed = bench.tick >= 4 && bench.tick != 10; });
  EXPECT_EQ(levels, (Levels{0, 0, 0, 0.5, 0.5, 0.5, 0, 0, 0, 0, 0.5, 0.5, 0}));
}

TEST(PowerInTheLoop, ARemovedToolOrASilentServerTakesThePowerOff) {
  for (const bool removed : {true, false}) {
    Bench bench;
    bench.link.answer = [&](const OutgoingPose& pose) -> std::optional<Feedback> {
      // An answer is valid for 20 ms, and the force then fades in 50 ms.
      if (!removed && bench.tick >= 6 && bench.tick < 100) return std::nullopt;
      Feedback feedback = answer_to(pose, ++bench.step);
      feedback.removed = removed && bench.tick == 6;
      return feedback;
    };
    const Levels levels = bench.run(130, [&] { bench.device.pose.pressed = bench.tick >= 4 && bench.tick != 120; });
    EXPECT_EQ(Bench::part(levels, 1, 6), (Levels{0, 0, 0, 0.5, 0.5, 0.5}));
    EXPECT_EQ(Bench::part(levels, 30, 120), Levels(91, 0.0));
    EXPECT_EQ(Bench::part(levels, 121, 130), Levels(10, 0.5));
    EXPECT_EQ(levels.back(), 0.0);
    EXPECT_EQ(levels.at(6), removed ? 0.0 : 0.5);
  }
}

}  // namespace
}  // namespace tensormass::haptic
