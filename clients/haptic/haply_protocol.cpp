#include "haptic/haply_protocol.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include <spdlog/fmt/fmt.h>
#include <nlohmann/json.hpp>

#include "core/assert.h"
#include "core/log.h"

namespace tensormass::haptic {
namespace {

using nlohmann::json;

constexpr const char* kRestart = "restart the Inverse service, or update it in Haply Hub";
/// Longest id and largest number of ids in a message to the user.
constexpr std::size_t kMaxShownIdLength = 64;
constexpr std::size_t kMaxShownIds = 8;
/// The service lists each kind of grip separately. A custom grip may also stand in the list of the wireless ones.
constexpr std::array<const char*, 3> kGripLists = {"verse_grip", "wireless_verse_grip", "custom_verse_grip"};
/// Parts of a device's configuration that only service 3.5 sends.
constexpr std::array<const char*, 4> kSince35 = {"preset", "mount", "filters", "home_return"};

/// Returns the member, or nullptr if `object` is not an object or lacks it.
const json* member(const json& object, const char* name) {
  if (!object.is_object()) return nullptr;
  const auto found = object.find(name);
  return found == object.end() ? nullptr : &*found;
}

/// Parses a message as a JSON object. The error says that `who` sent it.
Result<json> parse(std::string_view message, const std::string& who) {
  // Without exceptions: a text that is not JSON, also one with NaN or a number beyond double, is then "discarded".
  json parsed = json::parse(message, nullptr, false);
  if (parsed.is_object()) return parsed;
  return fail(ErrorCode::kUnavailable,
              fmt::format("{}: a message of {} bytes is not a JSON object, or has a number that is not finite; check "
                          "that --device-url leads to the Inverse service, {}",
                          who, message.size(), kRestart));
}

/// A device of the service's lists.
struct Listed {
  std::string id;
  const json* device;
};

/// Returns the devices of one list. A missing list is an empty one.
Result<std::vector<Listed>> devices_in(const json& message, const char* list) {
  const json* devices = member(message, list);
  if (devices == nullptr) return std::vector<Listed>{};
  if (devices->is_object()) {
    return fail(
        ErrorCode::kUnavailable,
        fmt::format("Haply Inverse service: {} is an object, as in the format 3.0 of port 10000; connect to the "
                    "port of format 3.1 and later, by default 10001",
                    list));
  }
  if (!devices->is_array()) {
    return fail(ErrorCode::kUnavailable,
                fmt::format("Haply Inverse service: {} is {}, not a list; {}", list, devices->type_name(), kRestart));
  }
  std::vector<Listed> listed;
  for (const json& device : *devices) {
    const json* id = member(device, "device_id");
    if (id == nullptr || !id->is_string()) {
      return fail(ErrorCode::kUnavailable,
                  fmt::format("Haply Inverse service: a device in {} has no device_id; {}", list, kRestart));
    }
    listed.push_back({id->get<std::string>(), &device});
  }
  return listed;
}

Result<std::vector<Listed>> grips_in(const json& message) {
  std::vector<Listed> grips;
  for (const char* list : kGripLists) {
    TM_ASSIGN_OR_RETURN(more, devices_in(message, list));
    for (const Listed& grip : more) {
      const auto same = [&](const Listed& other) { return other.id == grip.id; };
      if (std::none_of(grips.begin(), grips.end(), same)) grips.push_back(grip);
    }
  }
  return grips;
}

std::string ids_of(const std::vector<Listed>& listed) {
  std::string ids;
  for (std::size_t i = 0; i < std::min(listed.size(), kMaxShownIds); ++i) {
    ids += (i == 0 ? "" : ", ") + shown_haply_id(listed[i].id);
  }
  return listed.size() > kMaxShownIds ? ids + ", ..." : ids;
}

const Listed* find(const std::vector<Listed>& listed, const std::string& id) {
  const auto found = std::find_if(listed.begin(), listed.end(), [&](const Listed& one) { return one.id == id; });
  return found == listed.end() ? nullptr : &*found;
}

/// Returns the device with this id. If `id` is empty, returns the only device of the list, or nullptr if the list is
/// empty; several devices are then an error. The errors name the kind of device and the option that gives the id.
Result<const Listed*> choose(const std::vector<Listed>& listed, const std::string& id, const char* kind,
                             const char* option) {
  if (!id.empty()) {
    const Listed* chosen = find(listed, id);
    if (chosen != nullptr) return chosen;
    const std::string others = listed.empty() ? "no other one" : ids_of(listed);
    return fail(ErrorCode::kNotFound,
                fmt::format("Haply {} {} is not connected; the Inverse service has {}; connect it "
                            "or change {}",
                            kind, shown_haply_id(id), others, option));
  }
  if (listed.size() > 1) {
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("{} devices of the kind Haply {} are connected: {}; choose one with {}", listed.size(),
                            kind, ids_of(listed), option));
  }
  return listed.empty() ? nullptr : &listed.front();
}

/// Fails if the device says that it is not fit for use. A service that does not send a flag is believed.
Result<void> check_status(const Listed& inverse) {
  const json* status = member(*inverse.device, "status");
  if (status == nullptr) return {};
  const auto is_false = [&](const char* name) {
    const json* flag = member(*status, name);
    return flag != nullptr && *flag == false;
  };
  if (is_false("power_supply")) {
    return fail(ErrorCode::kUnavailable,
                fmt::format("Haply Inverse3 {}: no power, so it renders no force; plug in its power supply",
                            shown_haply_id(inverse.id)));
  }
  if (is_false("calibrated")) {
    return fail(ErrorCode::kUnavailable,
                fmt::format("Haply Inverse3 {}: not calibrated, so its position is wrong; calibrate it in Haply Hub",
                            shown_haply_id(inverse.id)));
  }
  return {};
}

/// Reads the numbers `names` of `state.<field>` into `out`.
template <std::size_t N>
Result<void> read_numbers(const Listed& device, const char* kind, const char* field,
                          const std::array<const char*, N>& names, std::array<double, N>& out) {
  const json* state = member(*device.device, "state");
  const json* value = state == nullptr ? nullptr : member(*state, field);
  for (std::size_t i = 0; i < N; ++i) {
    const json* number = value == nullptr ? nullptr : member(*value, names[i]);
    const bool is_number = number != nullptr && number->is_number();
    out[i] = is_number ? number->get<double>() : 0.0;
    if (is_number && std::isfinite(out[i])) continue;
    return fail(ErrorCode::kUnavailable,
                fmt::format("Haply {} {}: state.{}.{} is {}; {}", kind, shown_haply_id(device.id), field, names[i],
                            number == nullptr ? "missing" : (is_number ? "not finite" : "not a number"), kRestart));
  }
  return {};
}

/// Reads a button of a grip, 1 to kHaplyButtons: `state.buttons.a`, `b` and `c`, or the only `state.button`.
Result<bool> read_button(const Listed& grip, int number) {
  constexpr std::array<const char*, kHaplyButtons> kNames = {"a", "b", "c"};
  const json* state = member(*grip.device, "state");
  const json* buttons = state == nullptr ? nullptr : member(*state, "buttons");
  const json* button = buttons == nullptr ? nullptr : member(*buttons, kNames.at(static_cast<std::size_t>(number - 1)));
  if (button == nullptr && state != nullptr && number == 1) button = member(*state, "button");
  if (button != nullptr && button->is_boolean()) return button->get<bool>();
  return fail(
      ErrorCode::kUnavailable,
      fmt::format("Haply VerseGrip {}: its button {} is {}; choose another one with --cautery-button, or {}",
                  shown_haply_id(grip.id), number, button == nullptr ? "missing" : "neither up nor down", kRestart));
}

tl::unexpected<Error> gone(const char* kind, const std::string& id) {
  return fail(ErrorCode::kUnavailable, fmt::format("Haply {} {} is gone: the Inverse service no longer lists it; check "
                                                   "its cable, its power and its radio link",
                                                   kind, shown_haply_id(id)));
}

}  // namespace

std::string shown_haply_id(std::string_view id) { return log::json_quoted(id.substr(0, kMaxShownIdLength)); }

Result<HaplyDevices> parse_haply_snapshot(std::string_view message, const HaplyChoice& choice) {
  TM_ASSIGN_OR_RETURN(snapshot, parse(message, "Haply Inverse service"));
  TM_ASSIGN_OR_RETURN(inverses, devices_in(snapshot, "inverse3"));
  TM_ASSIGN_OR_RETURN(inverse, choose(inverses, choice.device_id, "Inverse3", "--device-id"));
  if (inverse == nullptr) {
    return fail(ErrorCode::kNotFound,
                "no Haply Inverse3 is connected to the Inverse service; check its cable, its power and Haply Hub");
  }
  TM_RETURN_IF_ERROR(check_status(*inverse));
  TM_ASSIGN_OR_RETURN(grips, grips_in(snapshot));
  TM_ASSIGN_OR_RETURN(grip, choose(grips, choice.grip_id, "VerseGrip", "--grip-id"));

  if (choice.power_button > 0 && grip == nullptr) {
    return fail(
        ErrorCode::kNotFound,
        "no Haply VerseGrip is connected, whose button works the tool's power; connect one and pair it in Haply "
        "Hub, or pass --cautery-button 0");
  }

  const json* config = member(*inverse->device, "config");
  const bool is_35 = config != nullptr && std::any_of(kSince35.begin(), kSince35.end(), [&](const char* name) {
                       return member(*config, name) != nullptr;
                     });
  return HaplyDevices{inverse->id, grip == nullptr ? "" : grip->id,
                      is_35 ? HaplyForceField::kVector : HaplyForceField::kValues, choice.power_button};
}

Result<DevicePose> parse_haply_state(std::string_view message, const HaplyDevices& devices) {
  TM_ASSIGN_OR_RETURN(state, parse(message, "Haply Inverse3 " + shown_haply_id(devices.inverse_id)));
  TM_ASSIGN_OR_RETURN(inverses, devices_in(state, "inverse3"));
  const Listed* inverse = find(inverses, devices.inverse_id);
  if (inverse == nullptr) return gone("Inverse3", devices.inverse_id);
  std::array<double, 3> p{};
  TM_RETURN_IF_ERROR(read_numbers(*inverse, "Inverse3", "cursor_position", {"x", "y", "z"}, p));
  DevicePose pose;
  pose.position_m = {p[0], p[1], p[2]};
  if (devices.grip_id.empty()) return pose;

  TM_ASSIGN_OR_RETURN(grips, grips_in(state));
  const Listed* grip = find(grips, devices.grip_id);
  if (grip == nullptr) return gone("VerseGrip", devices.grip_id);
  std::array<double, 4> q{};
  TM_RETURN_IF_ERROR(read_numbers(*grip, "VerseGrip", "orientation", {"w", "x", "y", "z"}, q));
  pose.orientation = Eigen::Quaterniond(q[0], q[1], q[2], q[3]);
  if (devices.power_button > 0) {
    TM_ASSIGN_OR_RETURN(pressed, read_button(*grip, devices.power_button));
    pose.pressed = pressed;
  }
  return pose;
}

std::string haply_force_command(const HaplyDevices& devices, const Eigen::Vector3d& force_n) {
  TM_ASSERT(force_n.allFinite(), "JSON has no NaN");
  const char* field = devices.force_field == HaplyForceField::kVector ? "vector" : "values";
  const json vector = {{"x", force_n.x()}, {"y", force_n.y()}, {"z", force_n.z()}};
  const json command = {{"set_cursor_force", {{field, vector}}}};
  const json device = {{"device_id", devices.inverse_id}, {"commands", command}};
  return json{{"inverse3", json::array({device})}}.dump();
}

}  // namespace tensormass::haptic
