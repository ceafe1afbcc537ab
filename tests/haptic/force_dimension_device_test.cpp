#include "haptic/force_dimension_device.h"

#include <gtest/gtest.h>

#include <limits>
#include <string>

#include "fakes.h"
#include "haptic/run_device.h"
#include "haptic/vendor_library.h"
#include "makers/fake_dhd.h"

namespace tensormass::haptic {
namespace {

using Calls = std::vector<std::string>;

FakeDhd& fresh_fake() {
  FakeDhd* (*make)() = nullptr;
  EXPECT_TRUE(VendorLibrary::open(FAKE_DHD, "fake", "")->find("fake_dhd", make));
  return *make();
}

ForceDimensionOptions options() {
  ForceDimensionOptions options;
  options.library = FAKE_DHD;
  return options;
}

bool has(const Error& error, const std::string& words) { return error.message.find(words) != std::string::npos; }

TEST(ForceDimension, OpensWithoutForceAndClosesWithoutForce) {
  FakeDhd& fake = fresh_fake();
  ForceDimensionDevice device(options());
  ASSERT_TRUE(device.open());
  EXPECT_EQ(device.info().name, "Force Dimension omega.7 fake");
  ASSERT_TRUE(device.write_force({1, 2, 3}));
  device.close();
  device.close();
  EXPECT_EQ(fake.calls, (Calls{"dhdOpen", "zero", "forces on", "force", "zero", "forces off", "dhdClose"}));
  EXPECT_TRUE(fake.misuse.empty()) << fake.misuse.front();
  EXPECT_EQ(device.read().error().code, ErrorCode::kFailedPrecondition);
  EXPECT_EQ(device.write_force({0, 0, 0}).error().code, ErrorCode::kFailedPrecondition);
}

// The maker's x axis points to the operator, y to the right, z up; ours are right, forward, up.
TEST(ForceDimension, MovesFromTheCentreInTheAxesOfTheWorkspace) {
  FakeDhd& fake = fresh_fake();
  fake.position_m = {0.01, 0.02, 0.03};
  ForceDimensionOptions turned = options();
  turned.workspace = {{1, 2, 3}, rotation_about_axes({0, 0, 90}), 2.0};
  for (const auto& [opts, right, forward] : {std::tuple{options(), Eigen::Vector3d(1, 0, 0), Eigen::Vector3d(0, 1, 0)},
                                             std::tuple{turned, Eigen::Vector3d(0, 1, 0), Eigen::Vector3d(-1, 0, 0)}}) {
    fake.position_m = {0.01, 0.02, 0.03};
    ForceDimensionDevice device(opts);
    ASSERT_TRUE(device.open());
    const Workspace& w = opts.workspace;
    EXPECT_TRUE(device.read()->position_m.isApprox(w.scene_center_m, 1e-12));
    fake.position_m = {0.01 - 0.004, 0.02 + 0.003, 0.03 + 0.005};  // 4 mm forward, 3 mm to the right, 5 mm up
    const Eigen::Vector3d moved = 0.003 * right + 0.004 * forward + 0.005 * Eigen::Vector3d::UnitZ();
    EXPECT_TRUE(device.read()->position_m.isApprox(w.scene_center_m + w.scale * moved, 1e-12));
    // A force to the right, forward and up reaches the maker's axes the other way round, not scaled.
    ASSERT_TRUE(device.write_force(3 * right + 4 * forward + 5 * Eigen::Vector3d::UnitZ()));
    EXPECT_NEAR(fake.force_n[0], -4, 1e-12);
    EXPECT_NEAR(fake.force_n[1], 3, 1e-12);
    EXPECT_NEAR(fake.force_n[2], 5, 1e-12);
    EXPECT_DOUBLE_EQ(device.info().max_stiffness_n_per_m, kForceDimensionLimits.max_stiffness_n_per_m / w.scale);
  }
}

TEST(ForceDimension, TurnsTheToolWithTheWrist) {
  FakeDhd& fake = fresh_fake();
  ForceDimensionDevice device(options());
  ASSERT_TRUE(device.open());
  EXPECT_NEAR(device.read()->orientation.angularDistance(Eigen::Quaterniond::Identity()), 0, 1e-12);
  // A quarter turn about the maker's y, our x: the maker's z goes to its x, ours from up to backward.
  const double quarter[3][3] = {{0, 0, 1}, {0, 1, 0}, {-1, 0, 0}};
  for (int i = 0; i < 9; ++i) fake.rotation[i / 3][i % 3] = quarter[i / 3][i % 3];
  const Eigen::Quaterniond turned = device.read()->orientation;
  EXPECT_TRUE((turned * Eigen::Vector3d::UnitZ()).isApprox(-Eigen::Vector3d::UnitY(), 1e-12));
  EXPECT_TRUE((turned * Eigen::Vector3d::UnitX()).isApprox(Eigen::Vector3d::UnitX(), 1e-12));
}

TEST(ForceDimension, TheGripperMovesJawsOnlyOfAToolThatHasThem) {
  FakeDhd& fake = fresh_fake();
  fake.gripper_angle_rad = 0.4;
  ForceDimensionOptions jaws = options();
  jaws.moves_jaws = true;
  ForceDimensionDevice with(jaws), without(options());
  ASSERT_TRUE(with.open());
  EXPECT_DOUBLE_EQ(with.read()->jaw_angle_rad.value(), 0.4);
  fake.gripper_angle_rad = -0.01;  // a gripper that is pressed beyond its zero
  EXPECT_DOUBLE_EQ(with.read()->jaw_angle_rad.value(), 0.0);
  with.close();
  ASSERT_TRUE(without.open());
  EXPECT_FALSE(without.read()->jaw_angle_rad);
  fake.has_gripper = false;
  ASSERT_TRUE(with.open());
  EXPECT_FALSE(with.read()->jaw_angle_rad);
}

TEST(ForceDimension, TorqueAndGripGoWithTheForceInTheSameAxes) {
  ForceDimensionOptions turned = options();
  turned.workspace = {{1, 2, 3}, rotation_about_axes({0, 0, 90}), 2.0};
  for (const auto& [opts, right, forward] : {std::tuple{options(), Eigen::Vector3d(1, 0, 0), Eigen::Vector3d(0, 1, 0)},
                                             std::tuple{turned, Eigen::Vector3d(0, 1, 0), Eigen::Vector3d(-1, 0, 0)}}) {
    FakeDhd& fake = fresh_fake();
    ForceDimensionOptions jaws = opts;
    jaws.moves_jaws = true;
    ForceDimensionDevice device(jaws);
    ASSERT_TRUE(device.open());
    EXPECT_EQ(device.info().max_torque_n_m, kForceDimensionLimits.max_torque_n_m);
    EXPECT_EQ(device.info().max_jaw_torque_n_m, kForceDimensionLimits.max_jaw_torque_n_m);
    EXPECT_EQ(device.info().max_angular_stiffness_n_m_per_rad, kForceDimensionLimits.max_angular_stiffness_n_m_per_rad);
    const Eigen::Vector3d torque = 0.03 * right + 0.04 * forward + 0.05 * Eigen::Vector3d::UnitZ();
    ASSERT_TRUE(device.write({Eigen::Vector3d(1, 0, 0), torque, 0.1}));
    EXPECT_NEAR(fake.torque_n_m[0], -0.04, 1e-12);
    EXPECT_NEAR(fake.torque_n_m[1], 0.03, 1e-12);
    EXPECT_NEAR(fake.torque_n_m[2], 0.05, 1e-12);
    EXPECT_DOUBLE_EQ(fake.grip_n, 0.1 / kForceDimensionGripperLeverM);
    device.close();
    EXPECT_EQ(fake.torque_n_m, (std::array<double, 3>{}));
    EXPECT_EQ(fake.grip_n, 0.0);
    EXPECT_EQ(fake.calls, (Calls{"dhdOpen", "zero", "forces on", "force", "zero", "forces off", "dhdClose"}));
  }
}

// A torque turns a wrist the way in which the wrist's own orientation is read: the work of the loop is that of the
// device.
TEST(ForceDimension, ATorqueTurnsTheToolTheWayTheWristIsRead) {
  FakeDhd& fake = fresh_fake();
  ForceDimensionDevice device(options());
  ASSERT_TRUE(device.open());
  const Eigen::Vector3d axis = Eigen::Vector3d(1, -2, 3).normalized();
  ASSERT_TRUE(device.write({Eigen::Vector3d::Zero(), 0.1 * axis}));
  const Eigen::Vector3d maker(fake.torque_n_m[0], fake.torque_n_m[1], fake.torque_n_m[2]);
  const Eigen::Matrix3d turn = Eigen::AngleAxisd(0.2, maker.normalized()).toRotationMatrix();
  for (int i = 0; i < 9; ++i) fake.rotation[i / 3][i % 3] = turn(i / 3, i % 3);
  const Eigen::AngleAxisd read(device.read()->orientation);
  EXPECT_TRUE((read.angle() * read.axis()).isApprox(0.2 * axis, 1e-9));
}

TEST(ForceDimension, APassiveWristOrGripperGetsForcesOnly) {
  const auto torques_of = [](const std::string& library, FakeDhd& fake, bool moves_jaws) {
    ForceDimensionOptions passive = options();
    passive.library = library;
    passive.moves_jaws = moves_jaws;
    ForceDimensionDevice device(passive);
    EXPECT_TRUE(device.open());
    EXPECT_TRUE(device.write({Eigen::Vector3d(1, 2, 3), Eigen::Vector3d(0.1, 0.1, 0.1), 0.1}));
    EXPECT_TRUE(fake.misuse.empty()) << fake.misuse.front();
    EXPECT_EQ(fake.force_n, (std::array<double, 3>{-2, 1, 3}));
    return std::array{device.info().max_torque_n_m > 0, device.info().max_jaw_torque_n_m > 0};
  };
  FakeDhd& omega3 = fresh_fake();
  omega3.has_active_wrist = omega3.has_active_gripper = omega3.has_gripper = false;
  EXPECT_EQ(torques_of(FAKE_DHD, omega3, true), (std::array{false, false}));
  FakeDhd& omega7 = fresh_fake();
  omega7.has_active_wrist = false;
  EXPECT_EQ(torques_of(FAKE_DHD, omega7, true), (std::array{false, true}));
  FakeDhd& without_jaws = fresh_fake();
  EXPECT_EQ(torques_of(FAKE_DHD, without_jaws, false), (std::array{true, false})) << "a tool without jaws";
  EXPECT_EQ(without_jaws.grip_n, 0.0);
  FakeDhd* (*make)() = nullptr;
  ASSERT_TRUE(VendorLibrary::open(FAKE_DHD_PASSIVE, "fake", "")->find("fake_dhd", make));
  EXPECT_EQ(torques_of(FAKE_DHD_PASSIVE, *make(), true), (std::array{false, false})) << "a library that cannot say";
}

TEST(ForceDimension, IsChosenByItsSerialNumber) {
  FakeDhd& fake = fresh_fake();
  ForceDimensionOptions chosen = options();
  chosen.serial = "1234";
  ASSERT_TRUE(ForceDimensionDevice(chosen).open());
  EXPECT_EQ(fake.serial, 1234);
  for (const char* wrong : {"omega", "12 34", "-1", "99999999999"}) {
    chosen.serial = wrong;
    const auto opened = ForceDimensionDevice(chosen).open();
    ASSERT_FALSE(opened) << wrong;
    EXPECT_EQ(opened.error().code, ErrorCode::kInvalidArgument);
  }
}

TEST(ForceDimension, EachFailureHasTheMakersWordsAndARemedy) {
  for (const char* function :
       {"dhdOpen", "forces on", "dhdGetPosition", "dhdGetOrientationFrame", "dhdSetForceAndTorqueAndGripperForce"}) {
    FakeDhd& fake = fresh_fake();
    fake.results[function] = -1;
    ForceDimensionDevice device(options());
    const auto opened = device.open();
    ASSERT_FALSE(opened) << function;
    EXPECT_TRUE(has(opened.error(), "words of the maker")) << opened.error().message;
    EXPECT_TRUE(has(opened.error(), "its power and its cable")) << opened.error().message;
    // An open device is given back.
    EXPECT_EQ(fake.calls.back(), std::string(function) == "dhdOpen" ? "dhdOpen" : "dhdClose");
  }
}

TEST(ForceDimension, GoesOnAfterARemark) {
  FakeDhd& fake = fresh_fake();
  fake.results = {{"dhdGetPosition", 1}, {"dhdSetForceAndTorqueAndGripperForce", 2}};  // time guard, motor saturated
  ForceDimensionDevice device(options());
  ASSERT_TRUE(device.open());
  EXPECT_TRUE(device.read());
  EXPECT_TRUE(device.write_force({1, 0, 0}));
}

TEST(ForceDimension, RefusesForcesAndWorkspacesWithoutMeaning) {
  FakeDhd& fake = fresh_fake();
  ForceDimensionDevice device(options());
  ASSERT_TRUE(device.open());
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  EXPECT_FALSE(device.write_force({0, kNan, 0}));
  EXPECT_FALSE(device.write({Eigen::Vector3d::Zero(), Eigen::Vector3d(0, kNan, 0)}));
  EXPECT_FALSE(device.write({Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero(), kNan}));
  EXPECT_EQ(fake.calls.back(), "forces on") << "nothing reaches the device";
  ForceDimensionOptions flat = options();
  flat.workspace.scale = 0;
  EXPECT_EQ(ForceDimensionDevice(flat).open().error().code, ErrorCode::kInvalidArgument);
}

TEST(ForceDimension, WithoutTheLibraryOrAFunctionSaysWhatToInstall) {
  ForceDimensionOptions elsewhere = options();
  elsewhere.library = "/nowhere/libdhd.so.3";
  const auto missing = ForceDimensionDevice(elsewhere).open();
  ASSERT_FALSE(missing);
  EXPECT_EQ(missing.error().code, ErrorCode::kUnavailable);
  for (const char* words :
       {"cannot load /nowhere/libdhd.so.3", "No such file", "install Force Dimension's SDK", "--device-library"}) {
    EXPECT_TRUE(has(missing.error(), words)) << missing.error().message;
  }
  elsewhere.library = FAKE_DHD_OLD;
  const auto old = ForceDimensionDevice(elsewhere).open();
  ASSERT_FALSE(old);
  EXPECT_TRUE(has(old.error(), "has no function dhdErrorGetLastStr")) << old.error().message;
  EXPECT_TRUE(has(old.error(), "install Force Dimension's SDK")) << old.error().message;
}

TEST(ForceDimension, ALoopEndsWithoutForceEvenIfTheDeviceFails) {
  FakeDhd& fake = fresh_fake();
  ForceDimensionDevice device(options());
  FakeLink link;
  std::uint64_t poses = 0;
  link.answer = [&](const OutgoingPose& pose) {
    if (++poses == 100) fake.results["dhdGetPosition"] = -1;
    Feedback feedback = answer_to(pose, pose.sequence);
    feedback.force_n = Eigen::Vector3d::UnitZ();
    return feedback;
  };
  const auto report = run_device(device, link, {}, false);
  ASSERT_FALSE(report);
  EXPECT_TRUE(has(report.error(), "cannot read its position (words of the maker)")) << report.error().message;
  EXPECT_NE(std::find(fake.calls.begin(), fake.calls.end(), "force"), fake.calls.end());
  const Calls last(fake.calls.end() - 3, fake.calls.end());
  EXPECT_EQ(last, (Calls{"zero", "forces off", "dhdClose"}));
}

TEST(ForceDimension, TheChosenButtonAloneWorksThePower) {
  for (const int button : {0, 1, 3, kForceDimensionButtons}) {
    FakeDhd& fake = fresh_fake();
    ForceDimensionOptions cautery = options();
    cautery.power_button = button;
    ForceDimensionDevice device(cautery);
    ASSERT_TRUE(device.open());
    for (int pressed = 0; pressed <= kForceDimensionButtons; ++pressed) {
      fake.buttons = pressed == 0 ? 0 : 1u << (pressed - 1);
      EXPECT_EQ(device.read()->pressed, button > 0 && pressed == button) << button << " " << pressed;
    }
    EXPECT_TRUE(fake.misuse.empty()) << fake.misuse.front();
  }
}

TEST(ForceDimension, AButtonThatCannotBeReadEndsTheLoopAndIsNotDown) {
  FakeDhd& fake = fresh_fake();
  ForceDimensionOptions cautery = options();
  cautery.power_button = 1;
  ForceDimensionDevice device(cautery);
  ASSERT_TRUE(device.open());
  fake.results["dhdGetButton"] = -1;
  const auto pose = device.read();
  ASSERT_FALSE(pose);
  EXPECT_TRUE(has(pose.error(), "cannot read its button (words of the maker)")) << pose.error().message;
  cautery.power_button = kForceDimensionButtons + 1;
  EXPECT_TRUE(has(ForceDimensionDevice(cautery).open().error(), "--cautery-button 9: choose a button from 1 to 8"));
  // A library without buttons is enough until one is asked for.
  FakeDhd* (*make)() = nullptr;
  ASSERT_TRUE(VendorLibrary::open(FAKE_DHD_PASSIVE, "fake", "")->find("fake_dhd", make));
  make()->has_active_wrist = make()->has_active_gripper = false;
  cautery.library = FAKE_DHD_PASSIVE;
  cautery.power_button = 1;
  EXPECT_TRUE(has(ForceDimensionDevice(cautery).open().error(), "has no function dhdGetButton"));
  cautery.power_button = 0;
  EXPECT_TRUE(ForceDimensionDevice(cautery).open());
}

}  // namespace
}  // namespace tensormass::haptic
