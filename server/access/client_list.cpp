#include "access/client_list.h"

#include <algorithm>
#include <optional>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "core/names.h"

namespace tensormass::access {
namespace {

constexpr std::size_t kKeyCharacters = 8;

std::optional<Role> role_of(std::string_view name) {
  const auto found = std::find(kRoleNames.begin(), kRoleNames.end(), name);
  if (found == kRoleNames.end()) return std::nullopt;
  return static_cast<Role>(found - kRoleNames.begin());
}

/// NAME.KEY, where KEY has 8 hexadecimal digits.
bool is_id(std::string_view id) {
  const std::size_t dot = id.rfind('.');
  if (dot == std::string_view::npos || !is_valid_name(id.substr(0, dot))) return false;
  const std::string_view key = id.substr(dot + 1);
  return key.size() == kKeyCharacters && key.find_first_not_of("0123456789abcdef") == std::string_view::npos;
}

}  // namespace

bool is_curve_key(std::string_view text) {
  constexpr std::string_view kDigits =
      "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#";
  return text.size() == kCurveCharacters && text.find_first_not_of(kDigits) == std::string_view::npos;
}

Result<ClientList> read_client_list(std::string_view text, const std::string& path) {
  const auto wrong = [&](std::string_view what) {
    return invalid(fmt::format("{}: {}; write it with `tensormass keys`, never by hand", path, what));
  };
  const nlohmann::json file = nlohmann::json::parse(text, nullptr, false);
  if (file.is_discarded()) return wrong("not JSON");
  if (!file.is_object() || !file.contains("tensormass") || file["tensormass"] != "client list" ||
      !file.contains("clients") || !file["clients"].is_array()) {
    return wrong("not a list of clients");
  }
  ClientList list;
  for (const nlohmann::json& entry : file["clients"]) try {
      Client client;
      client.id = entry.at("id").get<std::string>();
      if (!is_id(client.id)) return wrong(fmt::format("'{}' is not an id", client.id.substr(0, 80)));
      const auto role = role_of(entry.at("role").get<std::string>());
      if (!role) return wrong(fmt::format("client {}: unknown role", client.id));
      client.role = *role;
      client.scene = entry.value("scene", "");
      client.tool = entry.value("tool", "");
      if (*role == Role::kHand && (!is_valid_name(client.scene) || !is_valid_name(client.tool))) {
        return wrong(fmt::format("client {}: a hand needs a scene and a tool", client.id));
      }
      client.curve_public = entry.at("curve_public").get<std::string>();
      if (!is_curve_key(client.curve_public)) {
        return wrong(fmt::format("client {}: curve_public is not {} characters of Z85", client.id, kCurveCharacters));
      }
      client.expires_s = entry.at("expires_s").get<std::int64_t>();
      const std::string id = client.id;
      if (!list.emplace(id, std::make_shared<const Client>(std::move(client))).second) {
        return wrong(fmt::format("client {} is there twice", id));
      }
    } catch (const nlohmann::json::exception&) {
      return wrong("a client lacks id, role, curve_public or expires_s");
    }
  return list;
}

}  // namespace tensormass::access
