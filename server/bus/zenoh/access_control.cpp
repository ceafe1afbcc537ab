#include "bus/zenoh/access_control.h"

#include <nlohmann/json.hpp>

#include "bus/keys.h"

namespace tensormass::bus {
namespace {

using nlohmann::json;

/// The keys of a row of the table that a client has a right to, as a key expression; empty: it has none.
std::string keys_of(const std::string& server, const access::Rule& rule, const access::Client& client) {
  const auto with = [&](std::string_view scene, std::string_view tool) {
    std::string what(rule.what);
    if (const std::size_t star = what.find('*'); star != std::string::npos) what.replace(star, 1, tool);
    return scene_key(server, scene, what);
  };
  switch (rule.reach[static_cast<std::size_t>(client.role)]) {
    case access::Reach::kAll:
      return with("*", "*");
    case access::Reach::kOwnScene:
      return client.role == access::Role::kHand ? with(client.scene, "*") : std::string();
    case access::Reach::kOwnTool:
      return client.role == access::Role::kHand ? with(client.scene, client.tool) : std::string();
    case access::Reach::kNone:
      break;
  }
  return {};
}

template <std::size_t kCount>
json keys_of(const std::string& server, const std::array<access::Rule, kCount>& rules, const access::Client& client) {
  json keys = json::array();
  for (const access::Rule& rule : rules) {
    if (std::string key = keys_of(server, rule, client); !key.empty()) keys.push_back(std::move(key));
  }
  return keys;
}

}  // namespace

std::string zenoh_access_control(const std::string& server, const std::vector<access::ClientPtr>& clients) {
  json rules = json::array(), subjects = json::array(), policies = json::array();
  for (const access::ClientPtr& client : clients) {
    json of_client = json::array();
    const auto allow = [&](const char* what, const char* flow, json messages, json keys) {
      if (keys.empty()) return;
      const std::string id = client->id + "/" + what;
      rules.push_back({{"id", id},
                       {"permission", "allow"},
                       {"flows", {flow}},
                       {"messages", std::move(messages)},
                       {"key_exprs", std::move(keys)}});
      of_client.push_back(id);
    };
    const json streams = keys_of(server, access::kStreams, *client), puts = keys_of(server, access::kPuts, *client);
    allow("put", "ingress", {"put"}, puts);
    // The server's subscriber is that of all poses; a client sends puts only to who has told that it takes them.
    if (!puts.empty()) allow("take", "egress", {"declare_subscriber"}, {pose_key(server, "*", "*")});
    if (!streams.empty()) {
      allow("ask", "ingress", {"declare_subscriber", "query"}, {"**"});
      allow("serve", "egress", {"declare_queryable"}, {std::string(kKeyRoot) + "/" + server + "/**"});
    }
    allow("answer", "egress", {"put", "reply"}, streams);
    if (of_client.empty()) continue;
    subjects.push_back({{"id", client->id}, {"cert_common_names", {client->id}}});
    policies.push_back({{"rules", std::move(of_client)}, {"subjects", {client->id}}});
  }
  return json{{"enabled", true},
              {"default_permission", "deny"},
              {"rules", std::move(rules)},
              {"subjects", std::move(subjects)},
              {"policies", std::move(policies)}}
      .dump();
}

}  // namespace tensormass::bus
