#include "access/client_list.h"

#include <gtest/gtest.h>

#include "support/refused.h"

namespace tensormass::access {
namespace {

const std::string kCurve(40, 'x');

std::string list_of(const std::string& entries) {
  return R"({"tensormass": "client list", "clients": [)" + entries + "]}";
}
std::string entry(const std::string& id, const std::string& role, const std::string& more = "") {
  return R"({"id": ")" + id + R"(", "role": ")" + role + R"(", "curve_public": ")" + kCurve + R"(", "expires_s": 9)" +
         more + "}";
}
constexpr const char* kOf = R"(, "scene": "demo", "tool": "probe")";

TEST(ClientList, HasRolesScenesAndTools) {
  const auto list =
      read_client_list(list_of(entry("alice.0123abcd", "viewer") + "," + entry("h.00000000", "hand", kOf)), "f");
  ASSERT_TRUE(list) << list.error().message;
  ASSERT_EQ(list->size(), 2u);
  EXPECT_EQ(list->at("alice.0123abcd")->role, Role::kViewer);
  const Client& hand = *list->at("h.00000000");
  EXPECT_EQ(hand.subject().scene, "demo");
  EXPECT_EQ(hand.subject().tool, "probe");
  EXPECT_EQ(hand.expires_s, 9);
  EXPECT_TRUE(read_client_list(list_of(""), "f")->empty());
}

TEST(ClientList, NamesFileAndRemedyOfWhatItRefuses) {
  const auto refuse = [](const std::string& text, const std::string& what) {
    EXPECT_REFUSED(read_client_list(text, "keys/clients.json"), ErrorCode::kInvalidArgument,
                   "keys/clients.json: " + what);
    EXPECT_REFUSED(read_client_list(text, "keys/clients.json"), ErrorCode::kInvalidArgument, "`tensormass keys`");
  };
  refuse("", "not JSON");
  refuse("{", "not JSON");
  refuse("[]", "not a list of clients");
  refuse("{}", "not a list of clients");
  refuse(list_of("3"), "a client lacks id");
  refuse(list_of(entry("alice", "viewer")), "'alice' is not an id");
  refuse(list_of(entry("al ice.0123abcd", "viewer")), "'al ice.0123abcd' is not an id");
  refuse(list_of(entry("alice.0123ABCD", "viewer")), "'alice.0123ABCD' is not an id");
  refuse(list_of(entry("a.0123abcd", "king")), "client a.0123abcd: unknown role");
  refuse(list_of(entry("a.0123abcd", "hand")), "client a.0123abcd: a hand needs a scene and a tool");
  refuse(list_of(entry("a.0123abcd", "viewer") + "," + entry("a.0123abcd", "operator")),
         "client a.0123abcd is there twice");
  refuse(list_of(R"({"id": "a.0123abcd", "role": "viewer", "curve_public": "x", "expires_s": 1})"),
         "client a.0123abcd: curve_public is not 40 characters");
  refuse(list_of(R"({"id": "a.0123abcd", "role": 3})"), "a client lacks id");
}

}  // namespace
}  // namespace tensormass::access
