#include <algorithm>
#include <array>
#include <cstdlib>
#include <iostream>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "backend/backend.h"
#include "backend/device_faults.h"
#include "backend/devices.h"
#include "support/editing.h"
#include "support/scenes.h"
#include "world/placement.h"
#include "world/runner.h"

/// Scenes on two GPUs of one machine. Skipped with one.
namespace tensormass::world {
namespace {

using RunnerPtr = std::unique_ptr<Runner>;

class TwoDevices : public testing::Test {
 protected:
  void SetUp() override {
    devices_ = backend::list_cuda_devices();
    if (devices_.size() < 2) {
      GTEST_SKIP() << "needs two GPUs of a kind: " << devices_.size() << " here";
    }
  }
  /// Makes the other GPU current, so that a call that relies on the present one goes wrong.
  void mislead(std::uint32_t device) const {
    const std::uint32_t other = device == devices_[0] ? devices_[1] : devices_[0];
    ASSERT_EQ(tests::make_current(static_cast<int>(other)), "no error");
  }
  RunnerPtr load(const v1::Scene& scene, std::uint32_t device) const {
    mislead(device);
    auto runner = Runner::start(scene, {.backend = BackendChoice::kCuda, .device = device});
    if (!runner) throw std::runtime_error(runner.error().message);
    EXPECT_EQ((*runner)->device(), device);
    EXPECT_EQ((*runner)->status().device(), device);
    EXPECT_EQ((*runner)->report().device(), device);
    return std::move(*runner);
  }
  std::vector<std::uint32_t> devices_;
};

/// A beam under a probe that is edited: with cuts, or else with ablations.
v1::Scene scene_of(bool double_precision, bool newton = false, bool cuts = false) {
  v1::Scene scene = tests::edited_beam({.double_precision = double_precision});
  if (cuts) scene.mutable_editing()->mutable_cutting();
  scene.mutable_streams()->set_frame_rate_hz(60);
  if (newton) scene.mutable_solver()->set_newton_max_iterations(4);
  tests::add_probe(scene, "probe", 0.02, 0.15, 0.106, 0.05).set_friction_coefficient(0.3);
  return scene;
}

void step(Runner& runner, std::uint32_t count) {
  const auto status = runner.step(count);
  ASSERT_TRUE(status) << status.error().message;
}
std::string positions(Runner& runner) {
  const auto answer = runner.positions("beam");
  if (!answer) throw std::runtime_error(answer.error().message);
  return answer->positions();
}

/// Runs through every call that reaches the device. Returns the bits after each. cuts: as of scene_of
std::vector<std::string> run_through(Runner& runner, bool cuts, const auto& mislead) {
  std::vector<std::string> bits;
  const auto then = [&](const auto& call) {
    mislead();
    const auto answer = call();
    if (!answer) throw std::runtime_error(answer.error().message);
    mislead();
    EXPECT_TRUE(runner.step(5));
    bits.push_back(positions(runner));
  };
  v1::ToolPose pose;
  tests::set(*pose.mutable_position_m(), 0.15, 0.09, 0.05);
  pose.mutable_orientation()->set_w(1);
  EXPECT_TRUE(runner.submit_pose("probe", pose));
  then([&] { return runner.step(20); });
  then([&] { return runner.frame(); });
  std::string snapshot;
  then([&] {
    auto saved = runner.snapshot();
    if (saved) snapshot = saved->snapshot();
    return saved;
  });
  v1::SceneAdjustments values;
  v1::BodyAdjustment& body = *values.add_bodies();
  body.set_body("beam");
  body.set_stiffness_factor(0.8);
  then([&] { return runner.adjust(values); });
  body.set_stiffness_factor(1);
  then([&] { return runner.adjust(values); });
  then([&] { return runner.restore(snapshot); });
  v1::SceneEdit edit;
  if (cuts) {
    v1::Cut& through = *edit.add_cuts();
    through.set_body("beam");
    for (const double y : {1.0, 0.04}) {
      v1::BladePosition& at = *through.add_blade();
      for (const double value : {0.1, y, -1.0, 0.1, y, 1.0}) at.add_points_m(value);
    }
  } else {
    v1::Ablation& ablated = *edit.add_ablations();
    ablated.set_body("beam");
    for (const std::uint32_t element : {0u, 7u, 20u}) ablated.add_elements(element);
  }
  then([&] { return runner.edit(edit); });
  then([&] { return runner.reset(); });
  return bits;
}

TEST_F(TwoDevices, GiveTheSameBits) {
  for (const bool cuts : {false, true}) {
    for (const auto& [in_double, newton] : {std::pair{false, false}, std::pair{true, false}, std::pair{false, true}}) {
      SCOPED_TRACE(testing::Message() << (in_double ? "double" : "float") << (newton ? ", Newton" : "")
                                      << (cuts ? ", cuts" : ""));
      std::array<std::vector<std::string>, 2> bits;
      for (std::size_t i = 0; i < 2; ++i) {
        const RunnerPtr runner = load(scene_of(in_double, newton, cuts), devices_[i]);
        bits[i] = run_through(*runner, cuts, [&] { mislead(devices_[i]); });
      }
      ASSERT_FALSE(bits[0].empty());
      EXPECT_EQ(bits[0], bits[1]);
    }
  }
}

/// The calls of the test above are good ones, where there are no two GPUs to make them.
TEST(SeveralDevices, TheCallsWorkOnTheCpu) {
  for (const bool cuts : {false, true}) {
    auto runner = Runner::start(scene_of(true, false, cuts), {.backend = BackendChoice::kCpu});
    ASSERT_TRUE(runner) << runner.error().message;
    const std::vector<std::string> bits = run_through(**runner, cuts, [] {});
    EXPECT_EQ(bits.size(), 8u);
    EXPECT_NE(bits.front(), bits.back());
  }
}

/// One thread calls two scenes on two devices, again and again.
TEST_F(TwoDevices, AThreadGoesFromOneToTheOther) {
  const RunnerPtr alone = load(scene_of(false), devices_[0]);
  step(*alone, 40);
  const RunnerPtr a = load(scene_of(false), devices_[0]), b = load(scene_of(false), devices_[1]);
  for (int i = 0; i < 20; ++i) {
    step(*a, 2);
    step(*b, 2);
    ASSERT_TRUE(a->frame());
    ASSERT_TRUE(b->frame());
  }
  EXPECT_EQ(positions(*a), positions(*alone));
  EXPECT_EQ(positions(*b), positions(*alone));
}

TEST_F(TwoDevices, ASnapshotOfOneGoesOnOnTheOther) {
  const RunnerPtr from = load(scene_of(false), devices_[0]), to = load(scene_of(false), devices_[1]);
  step(*from, 30);
  const auto saved = from->snapshot();
  ASSERT_TRUE(saved) << saved.error().message;
  mislead(devices_[1]);
  const auto restored = to->restore(saved->snapshot());
  ASSERT_TRUE(restored) << restored.error().message;
  EXPECT_EQ(positions(*from), positions(*to));
  step(*from, 30);
  step(*to, 30);
  EXPECT_EQ(positions(*from), positions(*to));
}

TEST_F(TwoDevices, ScenesThatLoadTogetherSpreadAndKeepTheirBits) {
  constexpr std::size_t kScenes = 8;
  const RunnerPtr alone = load(scene_of(false), devices_[0]);
  step(*alone, 100);
  const std::string expected = positions(*alone);
  const auto placement = std::make_shared<Placement>(std::vector{devices_[0], devices_[1]});
  std::array<RunnerPtr, kScenes> runners;
  std::array<std::string, kScenes> ends;
  {
    std::vector<std::jthread> threads;
    for (std::size_t i = 0; i < kScenes; ++i) {
      threads.emplace_back([&, i] {
        auto runner = Runner::start(scene_of(false), {.backend = BackendChoice::kCuda, .placement = placement});
        ASSERT_TRUE(runner) << runner.error().message;
        runners[i] = std::move(*runner);
        step(*runners[i], 100);
        ends[i] = positions(*runners[i]);
      });
    }
  }
  std::map<std::uint32_t, int> scenes;
  for (const RunnerPtr& runner : runners) {
    ASSERT_NE(runner, nullptr);
    ++scenes[runner->device()];
  }
  EXPECT_EQ(scenes.size(), 2u);
  EXPECT_GE(scenes[devices_[0]], 3);
  EXPECT_GE(scenes[devices_[1]], 3);
  for (const std::string& end : ends) EXPECT_EQ(end, expected);
}

/// Takes the first device from this process while a scene steps on each. Ends with 0 if both scenes say that their
/// device is lost: CUDA gives up all devices of a process, so the daemon ends and another one starts.
[[noreturn]] void lose_the_first(const std::vector<std::uint32_t>& devices, tests::DeviceFault fault) {
  const auto placement = std::make_shared<Placement>(std::vector{devices[0], devices[1]});
  const RunnerOptions options{.backend = BackendChoice::kCuda, .placement = placement};
  std::array<RunnerPtr, 2> runners;
  for (RunnerPtr& runner : runners) runner = std::move(Runner::start(scene_of(false), options).value());
  const auto ends_unless = [](bool good, const char* what) {
    if (good) return;
    std::cerr << "not so: " << what << '\n';
    std::_Exit(1);
  };
  ends_unless(runners[0]->device() != runners[1]->device(), "one scene on each device");
  for (const RunnerPtr& runner : runners) ends_unless(runner->step(3).has_value(), "both step");
  tests::make_current(static_cast<int>(runners[0]->device()));
  tests::answers_to(fault);
  for (const RunnerPtr& runner : runners) {
    ends_unless(!runner->step(3), "the scene stops");
    ends_unless(runner->device_lost(), "it says that its device is lost");
  }
  v1::SceneAdjustments values;
  values.mutable_gravity_m_per_s2();
  ends_unless(!runners[0]->adjust(values), "no change brings the scene to the CPU");
  ends_unless(!Runner::start(scene_of(false), options), "no scene loads");
  std::cerr << "all devices are lost\n";
  std::_Exit(0);  // CUDA's own end would wait for the lost devices
}

class TwoDevicesOneLost : public TwoDevices, public testing::WithParamInterface<tests::DeviceFault> {};

/// In a process of its own, because CUDA works no more in the one that had the fault.
TEST_P(TwoDevicesOneLost, IsALossOfBoth) {
  GTEST_FLAG_SET(death_test_style, "threadsafe");
  EXPECT_EXIT(lose_the_first(devices_, GetParam()), testing::ExitedWithCode(0), "all devices are lost");
}

INSTANTIATE_TEST_SUITE_P(Faults, TwoDevicesOneLost,
                         testing::Values(tests::DeviceFault::kIllegalAddress, tests::DeviceFault::kMisalignedAddress,
                                         tests::DeviceFault::kAssert, tests::DeviceFault::kTrap));

TEST(Devices, ADeviceThatIsNotThereIsNamed) {
  const auto none = backend::make_cuda_backend(1, 1000);
  ASSERT_FALSE(none);
  EXPECT_EQ(none.error().code, ErrorCode::kUnavailable);
  if (backend::list_cuda_devices().empty()) GTEST_SKIP() << "no GPU here: " << none.error().message;
  EXPECT_NE(none.error().message.find("there is no GPU 1000"), std::string::npos) << none.error().message;
  EXPECT_FALSE(backend::read_cuda_memory(1000));
  const auto memory = backend::read_cuda_memory(backend::list_cuda_devices().front());
  ASSERT_TRUE(memory) << memory.error().message;
  EXPECT_GT(memory->total, memory->free);
}

}  // namespace
}  // namespace tensormass::world
