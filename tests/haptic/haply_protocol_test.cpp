#include "haptic/haply_protocol.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <string>

#include <spdlog/fmt/fmt.h>

namespace tensormass::haptic {
namespace {

// Written by hand after docs.haply.co, Inverse SDK 3.5, "WebSocket Protocol": the snapshot of one device.
constexpr const char* kSnapshot35 = R"({
  "session_id": 12,
  "inverse3": [{
    "device_id": "0A1B",
    "config": {
      "type": "inverse3", "port": "COM4", "handedness": "left", "streaming_mode": "USB",
      "device_info": {"major_version": 7, "minor_version": 4, "id": "0A1B", "device_type": 4, "uuid": "0"},
      "gravity_compensation": {"enabled": true, "scaling_factor": 1.0}, "torque_scaling": {"enabled": true},
      "home_return": {"enabled": false}, "preset": "defaults", "basis": {"permutation": "XYZ"},
      "mount": {"position": {"x": 0, "y": 0, "z": 0}, "rotation": {"w": 1, "x": 0, "y": 0, "z": 0},
                "scale": {"x": 1, "y": 1, "z": 1}},
      "filters": {"force_gate": {"gain": 0.3}, "damping": {"scalar": 0.0}}
    },
    "state": {"cursor_position": {"x": 0.01, "y": -0.11, "z": 0.16}, "control_domain": "cartesian"},
    "status": {"calibrated": true, "in_use": false, "power_supply": true, "ready": true, "started": true}
  }],
  "verse_grip": [], "wireless_verse_grip": [], "custom_verse_grip": []
})";

// After "Simulation Channel" of 3.4, which has a wired grip.
constexpr const char* kSnapshot34 = R"({
  "inverse3": [{
    "device_id": "0C2D",
    "config": {
      "type": "inverse3", "port": "COM7", "handedness": "right",
      "device_info": {"minor_version": 1, "major_version": 7, "id": "0C2D", "model": 4, "uuid": "0"},
      "gravity_compensation": {"enabled": true, "scaling_factor": 1}, "torque_scaling": {"enabled": true}
    },
    "state": {"cursor_position": {"x": 0.07, "y": -0.14, "z": 0.14}, "mode": "idle"},
    "status": {"calibrated": true, "in_use": false, "power_supply": true, "ready": true, "started": true}
  }],
  "verse_grip": [{
    "device_id": "70001", "config": {"port": "COM3", "type": "verse_grip"},
    "state": {"button": false, "hall": 0, "orientation": {"x": 0.0, "y": 0.6, "z": 0.0, "w": 0.8}},
    "status": {"error": 0, "ready": true}
  }],
  "wireless_verse_grip": []
})";

const HaplyDevices kDevices{"0A1B", "", HaplyForceField::kVector};
const HaplyDevices kWithGrip{"0C2D", "70001", HaplyForceField::kValues};

std::string state_of(const std::string& inverse3) { return R"({"inverse3": [)" + inverse3 + "]}"; }

std::string state_with(const std::string& x) {
  return state_of(R"({"device_id": "0A1B", "state": {"cursor_position": {"x": )" + x + R"(, "y": 0.2, "z": 0.3}}})");
}

template <class T>
void expect_error(const Result<T>& result, ErrorCode code, std::initializer_list<const char*> words) {
  ASSERT_FALSE(result) << "expected an error with " << *words.begin();
  EXPECT_EQ(result.error().code, code) << result.error().message;
  for (const char* word : words) {
    EXPECT_NE(result.error().message.find(word), std::string::npos) << word << ": " << result.error().message;
  }
}

// --- snapshot ---

TEST(HaplySnapshot, Of35SpeaksOfVectors) {
  const auto devices = parse_haply_snapshot(kSnapshot35, {});
  ASSERT_TRUE(devices) << devices.error().message;
  EXPECT_EQ(devices->inverse_id, "0A1B");
  EXPECT_EQ(devices->grip_id, "");
  EXPECT_EQ(devices->force_field, HaplyForceField::kVector);
}

TEST(HaplySnapshot, OfOlderServicesSpeaksOfValuesAndItsOnlyGripIsTaken) {
  const auto devices = parse_haply_snapshot(kSnapshot34, {});
  ASSERT_TRUE(devices) << devices.error().message;
  EXPECT_EQ(devices->inverse_id, "0C2D");
  EXPECT_EQ(devices->grip_id, "70001");
  EXPECT_EQ(devices->force_field, HaplyForceField::kValues);
}

TEST(HaplySnapshot, TwoDevicesNeedAChoice) {
  const std::string two = R"({"inverse3": [{"device_id": "A"}, {"device_id": "B"}],
                              "verse_grip": [{"device_id": "1"}], "wireless_verse_grip": [{"device_id": "2"}]})";
  expect_error(parse_haply_snapshot(two, {}), ErrorCode::kFailedPrecondition,
               {"2 devices", R"("A", "B")", "--device-id"});
  expect_error(parse_haply_snapshot(two, {"B", ""}), ErrorCode::kFailedPrecondition, {R"("1", "2")", "--grip-id"});
  const auto devices = parse_haply_snapshot(two, {"B", "2"});
  ASSERT_TRUE(devices) << devices.error().message;
  EXPECT_EQ(devices->inverse_id, "B");
  EXPECT_EQ(devices->grip_id, "2");
}

TEST(HaplySnapshot, ACustomGripThatIsAlsoListedAsWirelessIsOneGrip) {
  const auto devices = parse_haply_snapshot(R"({"inverse3": [{"device_id": "A"}],
      "wireless_verse_grip": [{"device_id": "1412"}], "custom_verse_grip": [{"device_id": "1412"}]})",
                                            {});
  ASSERT_TRUE(devices) << devices.error().message;
  EXPECT_EQ(devices->grip_id, "1412");
}

TEST(HaplySnapshot, NamesWhatIsMissing) {
  expect_error(parse_haply_snapshot(R"({"inverse3": []})", {}), ErrorCode::kNotFound, {"no Haply Inverse3", "cable"});
  expect_error(parse_haply_snapshot("{}", {}), ErrorCode::kNotFound, {"no Haply Inverse3"});
  expect_error(parse_haply_snapshot(kSnapshot35, {"FFFF", ""}), ErrorCode::kNotFound,
               {R"("FFFF")", R"("0A1B")", "--device-id"});
  expect_error(parse_haply_snapshot(kSnapshot35, {"", "7"}), ErrorCode::kNotFound, {R"("7")", "--grip-id"});
}

TEST(HaplySnapshot, RefusesADeviceWithoutPowerOrCalibration) {
  const auto with_status = [](const char* status) {
    return R"({"inverse3": [{"device_id": "A", "status": {)" + std::string(status) + "}}]}";
  };
  expect_error(parse_haply_snapshot(with_status(R"("power_supply": false)"), {}), ErrorCode::kUnavailable,
               {R"("A")", "no power"});
  expect_error(parse_haply_snapshot(with_status(R"("calibrated": false)"), {}), ErrorCode::kUnavailable,
               {R"("A")", "not calibrated", "Haply Hub"});
  EXPECT_TRUE(parse_haply_snapshot(with_status(R"("calibrated": true, "power_supply": true)"), {}));
}

TEST(HaplySnapshot, RefusesOtherFormats) {
  for (const char* text : {"", "hello", "[]", "7", R"({"inverse3": )"}) {
    expect_error(parse_haply_snapshot(text, {}), ErrorCode::kUnavailable, {"not a JSON object"});
  }
  expect_error(parse_haply_snapshot(R"({"inverse3": {"049D": {}}})", {}), ErrorCode::kUnavailable,
               {"port 10000", "10001"});
  expect_error(parse_haply_snapshot(R"({"inverse3": 3})", {}), ErrorCode::kUnavailable, {"inverse3 is number"});
  expect_error(parse_haply_snapshot(R"({"inverse3": [3]})", {}), ErrorCode::kUnavailable, {"no device_id"});
  expect_error(parse_haply_snapshot(R"({"inverse3": [{"device_id": 3}]})", {}), ErrorCode::kUnavailable,
               {"no device_id"});
  EXPECT_FALSE(parse_haply_snapshot(std::string(200'000, '['), {}));
}

TEST(HaplySnapshot, ALongOrUnprintableIdDoesNotFloodTheMessage) {
  std::string id(100'000, 'x');
  id += "\\u001b";
  const std::string two = R"({"inverse3": [{"device_id": ")" + id + R"("}, {"device_id": "\u001b[2J"}]})";
  const auto devices = parse_haply_snapshot(two, {});
  ASSERT_FALSE(devices);
  EXPECT_LT(devices.error().message.size(), 400u);
  EXPECT_EQ(devices.error().message.find('\x1b'), std::string::npos);
}

// --- state ---

TEST(HaplyState, GivesThePositionAndTheIdentityWithoutAGrip) {
  const auto pose = parse_haply_state(kSnapshot35, kDevices);
  ASSERT_TRUE(pose) << pose.error().message;
  EXPECT_EQ(pose->position_m, Eigen::Vector3d(0.01, -0.11, 0.16));
  EXPECT_EQ(pose->orientation.coeffs(), Eigen::Quaterniond::Identity().coeffs());
}

TEST(HaplyState, TakesTheOrientationFromTheGrip) {
  const auto pose = parse_haply_state(kSnapshot34, kWithGrip);
  ASSERT_TRUE(pose) << pose.error().message;
  EXPECT_EQ(pose->position_m, Eigen::Vector3d(0.07, -0.14, 0.14));
  EXPECT_EQ(pose->orientation.w(), 0.8);
  EXPECT_EQ(pose->orientation.vec(), Eigen::Vector3d(0.0, 0.6, 0.0));
}

TEST(HaplyState, ReadsItsOwnDeviceAmongOthers) {
  const auto pose = parse_haply_state(R"({"inverse3": [
      {"device_id": "Z", "state": {"cursor_position": {"x": 9, "y": 9, "z": 9}}},
      {"device_id": "0A1B", "state": {"cursor_position": {"x": 1, "y": 2, "z": 3}}}]})",
                                      kDevices);
  ASSERT_TRUE(pose) << pose.error().message;
  EXPECT_EQ(pose->position_m, Eigen::Vector3d(1, 2, 3));
}

TEST(HaplyState, RefusesWhatIsNotAFiniteNumber) {
  for (const char* x : {"null", R"("0.1")", "true", "[1]", "{}"}) {
    expect_error(parse_haply_state(state_with(x), kDevices), ErrorCode::kUnavailable,
                 {R"("0A1B")", "cursor_position.x is not a number", "restart"});
  }
  // JSON has neither, and a number beyond double is not finite.
  for (const char* x : {"NaN", "Infinity", "1e999"}) {
    expect_error(parse_haply_state(state_with(x), kDevices), ErrorCode::kUnavailable,
                 {R"("0A1B")", "not a JSON object", "not finite"});
  }
}

TEST(HaplyState, NamesTheMissingField) {
  for (const char* device :
       {R"({"device_id": "0A1B"})", R"({"device_id": "0A1B", "state": 1})", R"({"device_id": "0A1B", "state": {}})",
        R"({"device_id": "0A1B", "state": {"cursor_position": [1, 2, 3]}})"}) {
    expect_error(parse_haply_state(state_of(device), kDevices), ErrorCode::kUnavailable,
                 {R"("0A1B")", "cursor_position.x is missing"});
  }
}

TEST(HaplyState, ADeviceThatDisappearsIsAnError) {
  expect_error(parse_haply_state(state_of(""), kDevices), ErrorCode::kUnavailable,
               {R"(Inverse3 "0A1B" is gone)", "cable"});
  expect_error(parse_haply_state(kSnapshot34, {"0C2D", "1", HaplyForceField::kValues}), ErrorCode::kUnavailable,
               {R"(VerseGrip "1" is gone)"});
}

// --- force ---

TEST(HaplyForce, IsAVectorSince35) {
  EXPECT_EQ(haply_force_command({"049D", "", HaplyForceField::kVector}, {0.5, -1.0, 2.25}),
            R"({"inverse3":[{"commands":{"set_cursor_force":{"vector":{"x":0.5,"y":-1.0,"z":2.25}}},)"
            R"("device_id":"049D"}]})");
}

TEST(HaplyForce, IsCalledValuesBefore) {
  EXPECT_EQ(haply_force_command({"04BA", "", HaplyForceField::kValues}, Eigen::Vector3d::Zero()),
            R"({"inverse3":[{"commands":{"set_cursor_force":{"values":{"x":0.0,"y":0.0,"z":0.0}}},)"
            R"("device_id":"04BA"}]})");
}

TEST(HaplyForce, AnIdCannotBreakOutOfItsString) {
  const std::string text = haply_force_command({R"(a"}]})", "", HaplyForceField::kVector}, Eigen::Vector3d::Zero());
  EXPECT_NE(text.find(R"("device_id":"a\"}]}")"), std::string::npos) << text;
}

// --- buttons ---

/// A state of the devices kWithGrip: `buttons` are members of the grip's state.
std::string state_with_buttons(const std::string& buttons) {
  return R"({"inverse3": [{"device_id": "0C2D", "state": {"cursor_position": {"x": 0, "y": 0, "z": 0}}}],)"
         R"("wireless_verse_grip": [{"device_id": "70001", "state": {"orientation": {"w": 1, "x": 0, "y": 0, "z": 0},)" +
         buttons + "}}]}";
}

TEST(HaplyButtons, TheChosenOneAloneWorksThePower) {
  HaplyDevices devices = kWithGrip;
  const std::array<std::string, 4> states = {
      R"("buttons": {"a": false, "b": false, "c": false})", R"("buttons": {"a": true, "b": false, "c": false})",
      R"("buttons": {"a": false, "b": true, "c": false})", R"("buttons": {"a": false, "b": false, "c": true})"};
  for (int button = 0; button <= kHaplyButtons; ++button) {
    devices.power_button = button;
    for (int pressed = 0; pressed <= kHaplyButtons; ++pressed) {
      const auto pose = parse_haply_state(state_with_buttons(states.at(static_cast<std::size_t>(pressed))), devices);
      ASSERT_TRUE(pose) << pose.error().message;
      EXPECT_EQ(pose->pressed, button > 0 && pressed == button) << button << " " << pressed;
    }
  }
  devices.power_button = 1;
  EXPECT_TRUE(parse_haply_state(state_with_buttons(R"("button": true)"), devices)->pressed) << "a wired grip";
  EXPECT_FALSE(parse_haply_state(state_with_buttons(R"("button": false)"), devices)->pressed);
}

TEST(HaplyButtons, OneThatIsMissingOrNoButtonIsAnErrorAndNeverDown) {
  HaplyDevices devices = kWithGrip;
  devices.power_button = 2;
  expect_error(parse_haply_state(state_with_buttons(R"("button": true)"), devices), ErrorCode::kUnavailable,
               {R"(VerseGrip "70001": its button 2 is missing)", "--cautery-button"});
  for (const char* wrong : {"1", "null", R"("true")", "{}", "[true]"}) {
    const std::string buttons = fmt::format(R"("buttons": {{"a": true, "b": {}, "c": true}})", wrong);
    expect_error(parse_haply_state(state_with_buttons(buttons), devices), ErrorCode::kUnavailable,
                 {"its button 2 is neither up nor down"});
  }
}

TEST(HaplyButtons, NeedAGrip) {
  expect_error(parse_haply_snapshot(kSnapshot35, {"", "", 1}), ErrorCode::kNotFound,
               {"no Haply VerseGrip", "--cautery-button 0"});
  const auto devices = parse_haply_snapshot(kSnapshot34, {"", "", 1});
  ASSERT_TRUE(devices) << devices.error().message;
  EXPECT_EQ(devices->power_button, 1);
}

}  // namespace
}  // namespace tensormass::haptic
