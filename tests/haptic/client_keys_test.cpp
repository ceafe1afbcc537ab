#include "haptic/client_keys.h"

#include <sys/stat.h>
#include <unistd.h>

#include <cstdio>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <string>

#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "support/refused.h"

namespace tensormass::haptic {
namespace {

class ClientKeysTest : public testing::Test {
 protected:
  ClientKeysTest() : path_(testing::TempDir() + "tensormass-client-keys-" + std::to_string(getpid()) + ".json") {
    const std::int64_t now_s = std::time(nullptr);
    content_ = {{"tensormass", "client keys"}, {"made_s", now_s - 60}, {"expires_s", now_s + 3600}};
    for (const char* name :
         {"authority", "certificate", "private_key", "curve_public", "curve_secret", "curve_server"}) {
      content_[name] = name;
    }
  }
  ~ClientKeysTest() override { std::filesystem::remove(path_); }

  Result<ClientKeys> read(const std::string& text, mode_t mode = 0600) {
    std::ofstream(path_) << text;
    chmod(path_.c_str(), mode);
    return read_client_keys(path_);
  }
  /// Reads the keys with another value of a field. null: without it.
  Result<ClientKeys> read_with(const std::string& field, const nlohmann::json& value) {
    nlohmann::json content = content_;
    content.erase(field);
    if (!value.is_null()) content[field] = value;
    return read(content.dump());
  }
  void expect_refused(const Result<ClientKeys>& keys, const std::string& why) const {
    EXPECT_REFUSED(keys, ErrorCode::kInvalidArgument, why);
    EXPECT_REFUSED(keys, ErrorCode::kInvalidArgument, "--keys " + path_);
  }

  const std::string path_;
  nlohmann::json content_;
};

TEST_F(ClientKeysTest, HaveWhatEachTransportTakes) {
  const auto keys = read(content_.dump());
  ASSERT_TRUE(keys) << keys.error().message;
  EXPECT_EQ(keys->authority, "authority");
  EXPECT_EQ(keys->curve_server, "curve_server");
  EXPECT_TRUE(read(content_.dump(), 0640)) << "as Kubernetes mounts a Secret";
}

TEST_F(ClientKeysTest, AreRefusedByFileAndRemedy) {
  const std::string get = "get the file that `tensormass keys add` wrote";
  expect_refused(read_client_keys(path_), "cannot be read: No such file or directory; " + get);
  expect_refused(read("{"), "not a client's keys, or damaged; " + get);
  expect_refused(read("[]"), "not a client's keys");
  expect_refused(read_with("tensormass", "daemon keys"), "not a client's keys");
  for (const char* field : {"authority", "certificate", "private_key", "curve_public", "curve_secret", "curve_server",
                            "made_s", "expires_s"}) {
    expect_refused(read_with(field, nullptr), std::string("lacks ") + field + "; " + get);
  }
  expect_refused(read_with("private_key", ""), "lacks private_key");
  expect_refused(read_with("expires_s", "soon"), "lacks expires_s");
  expect_refused(read(content_.dump(), 0644), "every user of this machine can use it");
}

TEST_F(ClientKeysTest, AreRefusedByTheClock) {
  const std::int64_t now_s = std::time(nullptr);
  expect_refused(read_with("expires_s", now_s - 1), "has expired; get new keys: tensormass keys renew");
  EXPECT_TRUE(read_with("made_s", now_s + 3600)) << "clocks may differ by a day";
  expect_refused(read_with("made_s", now_s + 2 * 24 * 3600), "in the future; set this machine's clock");
}

}  // namespace
}  // namespace tensormass::haptic
