#include "haptic/openhaptics_device.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <limits>
#include <string>
#include <thread>

#include "fakes.h"
#include "haptic/run_device.h"
#include "haptic/vendor_library.h"
#include "makers/fake_hd.h"

namespace tensormass::haptic {
namespace {

using Calls = std::vector<std::string>;
using Force = std::array<double, 3>;

constexpr Force kZero{};

FakeHd& fresh_fake() {
  FakeHd* (*make)() = nullptr;
  EXPECT_TRUE(VendorLibrary::open(FAKE_HD, "fake", "")->find("fake_hd", make));
  return *make();
}

OpenHapticsOptions options() {
  OpenHapticsOptions options;
  options.library = FAKE_HD;
  return options;
}

bool has(const Error& error, const std::string& words) { return error.message.find(words) != std::string::npos; }

/// Waits for a pose that `done` accepts; the last one is returned in any case.
DevicePose wait_for_pose(OpenHapticsDevice& device, FakeHd& fake, const std::function<bool(const DevicePose&)>& done) {
  DevicePose pose;
  EXPECT_TRUE(fake.wait_for([&] {
    const Result<DevicePose> read = device.read();
    if (read) pose = *read;
    return !read || done(pose);
  }));
  return pose;
}

TEST(OpenHaptics, OpensAndClosesInTheDocumentedOrderWithoutForce) {
  FakeHd& fake = fresh_fake();
  OpenHapticsDevice device(options());
  ASSERT_TRUE(device.open());
  EXPECT_EQ(device.info().name, "OpenHaptics Fake Touch");
  EXPECT_EQ(fake.name, "(default)");
  ASSERT_TRUE(device.write_force({1, 2, 3}));
  EXPECT_TRUE(fake.wait_for([&] { return fake.forces_n.back() != kZero; }));
  device.close();
  device.close();
  EXPECT_EQ(fake.calls, (Calls{"hdInitDevice", "hdMakeCurrentDevice", "hdEnable", "hdScheduleAsynchronous",
                               "hdStartScheduler", "hdStopScheduler", "hdUnschedule", "hdDisableDevice"}));
  EXPECT_EQ(fake.forces_n.front(), kZero);
  EXPECT_EQ(fake.forces_n.back(), kZero);
  EXPECT_TRUE(fake.misuse.empty()) << fake.misuse.front();
  EXPECT_EQ(device.read().error().code, ErrorCode::kFailedPrecondition);
  EXPECT_EQ(device.write_force({0, 0, 0}).error().code, ErrorCode::kFailedPrecondition);
}

// The maker's x axis points to the right, y up and z to the operator; ours are right, forward, up.
TEST(OpenHaptics, MovesFromTheCentreInTheAxesOfTheWorkspace) {
  OpenHapticsOptions turned = options();
  turned.name = "Left Device";
  turned.workspace = {{1, 2, 3}, rotation_about_axes({0, 0, 90}), 2.0};
  for (const auto& [opts, right, forward] : {std::tuple{options(), Eigen::Vector3d(1, 0, 0), Eigen::Vector3d(0, 1, 0)},
                                             std::tuple{turned, Eigen::Vector3d(0, 1, 0), Eigen::Vector3d(-1, 0, 0)}}) {
    FakeHd& fake = fresh_fake();
    fake.position_mm = {10, 20, 30};
    OpenHapticsDevice device(opts);
    ASSERT_TRUE(device.open());
    EXPECT_EQ(fake.name, opts.name.empty() ? "(default)" : opts.name);
    const Workspace& w = opts.workspace;
    EXPECT_TRUE(device.read()->position_m.isApprox(w.scene_center_m, 1e-12));
    {
      const std::scoped_lock lock(fake.mutex);
      fake.position_mm = {10 + 3, 20 + 5, 30 - 4};  // 3 mm to the right, 5 mm up, 4 mm forward
    }
    const Eigen::Vector3d to =
        w.scene_center_m + w.scale * (0.003 * right + 0.004 * forward + 0.005 * Eigen::Vector3d::UnitZ());
    const DevicePose pose =
        wait_for_pose(device, fake, [&](const DevicePose& p) { return p.position_m.isApprox(to, 1e-12); });
    EXPECT_TRUE(pose.position_m.isApprox(to, 1e-12)) << pose.position_m.transpose();
    // A force to the right, forward and up reaches the maker's axes the other way round, not scaled.
    ASSERT_TRUE(device.write_force(3 * right + 4 * forward + 5 * Eigen::Vector3d::UnitZ()));
    EXPECT_TRUE(fake.wait_for([&] { return fake.forces_n.back() != kZero; }));
    const Force force = fake.forces_n.back();
    EXPECT_NEAR(force[0], 3, 1e-12);
    EXPECT_NEAR(force[1], 5, 1e-12);
    EXPECT_NEAR(force[2], -4, 1e-12);
    device.close();
    EXPECT_TRUE(fake.misuse.empty()) << fake.misuse.front();
  }
}

TEST(OpenHaptics, FollowsARampWithoutGoingBack) {
  FakeHd& fake = fresh_fake();
  fake.step_mm = {0.1, 0, 0};
  OpenHapticsDevice device(options());
  ASSERT_TRUE(device.open());
  double last = -1;
  for (int i = 0; i < 20; ++i) {
    const DevicePose pose = wait_for_pose(device, fake, [&](const DevicePose& p) { return p.position_m.x() > last; });
    ASSERT_GT(pose.position_m.x(), last);
    last = pose.position_m.x();
  }
}

TEST(OpenHaptics, TurnsTheToolWithTheStylus) {
  FakeHd& fake = fresh_fake();
  // In columns: x goes to y, y to −x. A quarter turn about the maker's z, our −y.
  fake.transform = {0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1};
  OpenHapticsDevice device(options());
  ASSERT_TRUE(device.open());
  const Eigen::Quaterniond turned = device.read()->orientation;
  EXPECT_TRUE((turned * Eigen::Vector3d::UnitX()).isApprox(Eigen::Vector3d::UnitZ(), 1e-12));
  EXPECT_TRUE((turned * Eigen::Vector3d::UnitY()).isApprox(Eigen::Vector3d::UnitY(), 1e-12));
}

TEST(OpenHaptics, TheFirstButtonClosesJawsOfAToolThatHasThem) {
  FakeHd& fake = fresh_fake();
  OpenHapticsOptions jaws = options();
  jaws.moves_jaws = true;
  OpenHapticsDevice device(jaws);
  ASSERT_TRUE(device.open());
  EXPECT_DOUBLE_EQ(device.read()->jaw_angle_rad.value(), kButtonJawAngleRad);
  {
    const std::scoped_lock lock(fake.mutex);
    fake.buttons = 3;
  }
  const DevicePose pose = wait_for_pose(device, fake, [](const DevicePose& p) { return p.jaw_angle_rad == 0.0; });
  EXPECT_DOUBLE_EQ(pose.jaw_angle_rad.value(), 0.0);
  OpenHapticsDevice other(options());
  device.close();
  ASSERT_TRUE(other.open());
  EXPECT_FALSE(other.read()->jaw_angle_rad);
}

TEST(OpenHaptics, TakesTheDevicesLimitsWithinItsOwn) {
  struct Limits {
    double force, stiffness, damping;
  };
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto& most = kOpenHapticsBounds;
  for (const auto& [stated, expected] :
       {std::pair{Limits{3.3, 0.5, 0.003}, Limits{3.3, 500, 3}},
        std::pair{Limits{37.5, 3.5, 1},
                  Limits{most.max_force_n, most.max_stiffness_n_per_m, most.max_damping_n_s_per_m}},
        std::pair{Limits{0, -1, nan},
                  Limits{most.max_force_n, most.max_stiffness_n_per_m, most.max_damping_n_s_per_m}}}) {
    FakeHd& fake = fresh_fake();
    fake.max_force_n = stated.force;
    fake.max_stiffness_n_per_mm = stated.stiffness;
    fake.max_damping_n_s_per_mm = stated.damping;
    OpenHapticsOptions scaled = options();
    scaled.workspace.scale = 2;
    OpenHapticsDevice device(scaled);
    ASSERT_TRUE(device.open());
    EXPECT_DOUBLE_EQ(device.info().max_force_n, expected.force);
    EXPECT_DOUBLE_EQ(device.info().max_stiffness_n_per_m, expected.stiffness / 2);
    EXPECT_DOUBLE_EQ(device.info().max_damping_n_s_per_m, expected.damping / 2);
  }
}

TEST(OpenHaptics, EachErrorAtTheStartHasTheMakersWordsAndARemedy) {
  for (unsigned int FakeHd::*error : {&FakeHd::init_error, &FakeHd::schedule_error, &FakeHd::start_error}) {
    FakeHd& fake = fresh_fake();
    fake.*error = 0x0302;
    OpenHapticsDevice device(options());
    const auto opened = device.open();
    ASSERT_FALSE(opened);
    EXPECT_EQ(opened.error().code, ErrorCode::kUnavailable);
    EXPECT_TRUE(has(opened.error(), "error 0x0302: words of the maker, internal 11")) << opened.error().message;
    EXPECT_TRUE(has(opened.error(), "its power and its cable")) << opened.error().message;
    EXPECT_TRUE(fake.forces_n.empty());
    EXPECT_EQ(fake.calls.back(), error == &FakeHd::init_error ? "hdInitDevice" : "hdDisableDevice");
    EXPECT_TRUE(fake.misuse.empty()) << fake.misuse.front();
  }
}

TEST(OpenHaptics, AnErrorInAFrameTakesTheForceOffAndEndsTheLoop) {
  for (const auto& [code, remedy] :
       {std::pair{0x0302u, "its power and its cable"}, std::pair{0x0200u, "--max-force"}}) {
    FakeHd& fake = fresh_fake();
    OpenHapticsDevice device(options());
    ASSERT_TRUE(device.open());
    ASSERT_TRUE(device.write_force({1, 2, 3}));
    EXPECT_TRUE(fake.wait_for([&] { return fake.forces_n.back() != kZero; }));
    {
      const std::scoped_lock lock(fake.mutex);
      fake.frame_error = code;
    }
    EXPECT_TRUE(fake.wait_for([&] { return fake.forces_n.back() == kZero; }));
    const auto pose = device.read();
    ASSERT_FALSE(pose);
    EXPECT_TRUE(has(pose.error(), "cannot make a frame")) << pose.error().message;
    EXPECT_TRUE(has(pose.error(), remedy)) << pose.error().message;
    EXPECT_FALSE(device.write_force({1, 2, 3}));
    device.close();
    EXPECT_EQ(fake.forces_n.back(), kZero);
  }
}

TEST(OpenHaptics, ASchedulerWithoutFramesIsAnError) {
  FakeHd& fake = fresh_fake();
  OpenHapticsDevice device(options());
  ASSERT_TRUE(device.open());
  {
    const std::scoped_lock lock(fake.mutex);
    fake.makes_frames = false;
  }
  Result<DevicePose> pose;
  EXPECT_TRUE(fake.wait_for([&] { return !(pose = device.read()); }));
  EXPECT_TRUE(has(pose.error(), "no frame for 0.25 s")) << pose.error().message;
  device.close();
  EXPECT_EQ(fake.calls.back(), "hdDisableDevice");
  const auto opened = device.open();
  ASSERT_FALSE(opened);
  EXPECT_TRUE(has(opened.error(), "no frame within 3 s")) << opened.error().message;
}

TEST(OpenHaptics, IsCalibratedOrRefused) {
  FakeHd& updated = fresh_fake();
  updated.calibration = 0x5001;
  OpenHapticsDevice device(options());
  ASSERT_TRUE(device.open());
  EXPECT_EQ(updated.updated_style, 4);
  device.close();
  FakeHd& by_hand = fresh_fake();
  by_hand.calibration = 0x5002;
  const auto opened = device.open();
  ASSERT_FALSE(opened);
  EXPECT_TRUE(has(opened.error(), "stylus into the inkwell")) << opened.error().message;
  EXPECT_EQ(by_hand.calls.back(), "hdDisableDevice");
}

TEST(OpenHaptics, RefusesForcesAndWorkspacesWithoutMeaning) {
  fresh_fake();
  OpenHapticsDevice device(options());
  ASSERT_TRUE(device.open());
  EXPECT_FALSE(device.write_force({0, std::numeric_limits<double>::quiet_NaN(), 0}));
  OpenHapticsOptions nowhere = options();
  nowhere.workspace.scene_center_m.x() = std::numeric_limits<double>::infinity();
  EXPECT_EQ(OpenHapticsDevice(nowhere).open().error().code, ErrorCode::kInvalidArgument);
}

TEST(OpenHaptics, WithoutTheLibraryOrAFunctionSaysWhatToInstall) {
  OpenHapticsOptions elsewhere = options();
  elsewhere.library = "/nowhere/libHD.so";
  const auto missing = OpenHapticsDevice(elsewhere).open();
  ASSERT_FALSE(missing);
  EXPECT_EQ(missing.error().code, ErrorCode::kUnavailable);
  for (const char* words :
       {"cannot load /nowhere/libHD.so", "No such file", "install 3D Systems' OpenHaptics", "--device-library"}) {
    EXPECT_TRUE(has(missing.error(), words)) << missing.error().message;
  }
  elsewhere.library = FAKE_HD_OLD;
  const auto old = OpenHapticsDevice(elsewhere).open();
  ASSERT_FALSE(old);
  EXPECT_TRUE(has(old.error(), "has no function hdUpdateCalibration")) << old.error().message;
  EXPECT_TRUE(has(old.error(), "install 3D Systems' OpenHaptics")) << old.error().message;
}

TEST(OpenHaptics, ALoopRendersAForceAndEndsWithoutOne) {
  FakeHd& fake = fresh_fake();
  OpenHapticsDevice device(options());
  FakeLink link;
  link.answer = [](const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, pose.sequence);
    feedback.force_n = Eigen::Vector3d::UnitZ();
    return feedback;
  };
  LoopOptions loop;
  loop.duration_s = 0.2;
  loop.drain_s = 0;
  const auto report = run_device(device, link, loop, false);
  ASSERT_TRUE(report) << report.error().message;
  const auto is_up = [](const Force& force) { return force[1] > 0 && force[0] == 0 && force[2] == 0; };
  EXPECT_TRUE(std::any_of(fake.forces_n.begin(), fake.forces_n.end(), is_up));
  EXPECT_EQ(fake.forces_n.back(), kZero);
  EXPECT_EQ(fake.calls.back(), "hdDisableDevice");
}

TEST(OpenHaptics, TheChosenButtonAloneWorksThePower) {
  for (const int button : {0, 1, 2, 4}) {
    FakeHd& fake = fresh_fake();
    OpenHapticsOptions cautery = options();
    cautery.power_button = button;
    OpenHapticsDevice device(cautery);
    ASSERT_TRUE(device.open());
    EXPECT_FALSE(device.read()->pressed);
    for (int pressed = 1; pressed <= kOpenHapticsButtons; ++pressed) {
      {
        const std::scoped_lock lock(fake.mutex);
        fake.buttons = 1 << (pressed - 1);
        fake.position_mm[0] = pressed;  // says that the frame has come
      }
      const DevicePose pose = wait_for_pose(
          device, fake, [&](const DevicePose& p) { return std::abs(p.position_m.x() - 1e-3 * pressed) < 1e-9; });
      EXPECT_EQ(pose.pressed, pressed == button) << button;
    }
  }
}

TEST(OpenHaptics, TheButtonOfTheJawsDoesNotWorkThePower) {
  fresh_fake();
  OpenHapticsOptions both = options();
  both.moves_jaws = true;
  both.power_button = 1;
  const auto opened = OpenHapticsDevice(both).open();
  ASSERT_FALSE(opened);
  EXPECT_EQ(opened.error().code, ErrorCode::kInvalidArgument);
  EXPECT_TRUE(has(opened.error(), "closes the tool's jaws; give its power another --cautery-button"));
  both.power_button = 5;
  EXPECT_TRUE(has(OpenHapticsDevice(both).open().error(), "--cautery-button 5: choose a button from 1 to 4"));
  both.power_button = 2;
  FakeHd& fake = fresh_fake();
  fake.buttons = 2;
  OpenHapticsDevice device(both);
  ASSERT_TRUE(device.open());
  const DevicePose pose = device.read().value();
  EXPECT_TRUE(pose.pressed);
  EXPECT_DOUBLE_EQ(pose.jaw_angle_rad.value(), kButtonJawAngleRad);
}

}  // namespace
}  // namespace tensormass::haptic
