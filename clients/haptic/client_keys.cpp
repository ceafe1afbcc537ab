#include "haptic/client_keys.h"

#include <sys/stat.h>

#include <cstdint>
#include <ctime>
#include <utility>
#include <vector>

#include <fmt/format.h>
#include <nlohmann/json.hpp>

#include "core/secret_file.h"

namespace tensormass::haptic {
namespace {

/// Keys are valid from so long before they were made, for clocks that differ. As in the SDK.
constexpr std::int64_t kClockSkewS = 24 * 3600;

}  // namespace

Result<ClientKeys> read_client_keys(const std::string& path) {
  const auto refuse = [&](std::string_view what) { return invalid(fmt::format("--keys {}: {}", path, what)); };
  constexpr std::string_view kGet = "get the file that `tensormass keys add` wrote";
  TM_ASSIGN_OR_RETURN(text, read_file_of_owner(path, S_IRWXO, "--keys ", kGet));
  const nlohmann::json content = nlohmann::json::parse(text, nullptr, false);
  if (!content.is_object() || !content.contains("tensormass") || content["tensormass"] != "client keys") {
    return refuse(fmt::format("not a client's keys, or damaged; {}", kGet));
  }
  ClientKeys keys;
  for (auto [name, value] : std::vector<std::pair<const char*, std::string*>>{{"authority", &keys.authority},
                                                                              {"certificate", &keys.certificate},
                                                                              {"private_key", &keys.private_key},
                                                                              {"curve_public", &keys.curve_public},
                                                                              {"curve_secret", &keys.curve_secret},
                                                                              {"curve_server", &keys.curve_server}}) {
    if (!content.contains(name) || !content[name].is_string() || content[name].get<std::string>().empty()) {
      return refuse(fmt::format("lacks {}; {}", name, kGet));
    }
    *value = content[name].get<std::string>();
  }
  for (const char* name : {"made_s", "expires_s"}) {
    if (!content.contains(name) || !content[name].is_number_integer()) {
      return refuse(fmt::format("lacks {}; {}", name, kGet));
    }
  }
  const auto now_s = static_cast<std::int64_t>(std::time(nullptr));
  if (now_s >= content["expires_s"].get<std::int64_t>()) {
    return refuse("has expired; get new keys: tensormass keys renew NAME");
  }
  if (now_s < content["made_s"].get<std::int64_t>() - kClockSkewS) {
    return refuse("made at a time that is in the future; set this machine's clock");
  }
  return keys;
}

}  // namespace tensormass::haptic
