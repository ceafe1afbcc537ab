#include "core/secret_file.h"

#include <gtest/gtest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <string>

namespace tensormass {
namespace {

class SecretFileTest : public ::testing::Test {
 protected:
  void TearDown() override { std::filesystem::remove(path_); }

  std::string error_with(mode_t mode, mode_t forbidden) const {
    chmod(path_.c_str(), mode);
    const auto text = read_file_of_owner(path_, forbidden, "--keys: ", "make another");
    if (!text) return text.error().message;
    EXPECT_EQ(*text, content_);
    return {};
  }

  // Longer than one part that is read, and with a zero byte.
  const std::string content_ = std::string(10'000, 'a') + '\0' + "b";
  const std::string path_ = [this] {
    const ::testing::TestInfo& test = *::testing::UnitTest::GetInstance()->current_test_info();
    std::string path =
        (std::filesystem::temp_directory_path() / (std::string(test.name()) + std::to_string(getpid()))).string();
    std::ofstream(path, std::ios::binary) << content_;
    return path;
  }();
};

TEST_F(SecretFileTest, OwnerAndGroupMayUseIt) {
  for (const mode_t mode : {0600u, 0640u, 0660u}) EXPECT_EQ(error_with(mode, S_IRWXO), "");
}

TEST_F(SecretFileTest, OthersMayNot) {
  for (const mode_t mode : {0604u, 0602u, 0601u, 0777u}) {
    EXPECT_EQ(error_with(mode, S_IRWXO),
              "--keys: " + path_ +
                  ": every user of this machine can use it; renew the keys if a stranger may have read it, else: chmod "
                  "o-rwx " +
                  path_);
  }
  EXPECT_EQ(error_with(0644, S_IWOTH), "");
  EXPECT_NE(error_with(0646, S_IWOTH), "");
}

TEST_F(SecretFileTest, AnotherUserMayNotOwnIt) {
  constexpr uid_t kOther = 12345;
  if (chown(path_.c_str(), kOther, static_cast<gid_t>(-1)) != 0) GTEST_SKIP() << "only root gives files away";
  const std::string refusal = "--keys: " + path_ +
                              ": user 12345 owns it, who is neither the user of this program, 0, nor root; run it as "
                              "user 12345, or: chown 0 " +
                              path_;
  EXPECT_EQ(error_with(0600, S_IRWXO), refusal);
  EXPECT_EQ(error_with(0644, S_IWOTH), refusal) << "who owns the list of clients can change it";
  ASSERT_EQ(seteuid(kOther), 0);
  const std::string as_owner = error_with(0600, S_IRWXO);
  ASSERT_EQ(seteuid(0), 0);
  EXPECT_EQ(as_owner, "");
}

TEST_F(SecretFileTest, RootMayOwnIt) {
  // As Kubernetes mounts a Secret with defaultMode 0440 and an fsGroup.
  constexpr uid_t kOther = 12345;
  constexpr gid_t kGroup = 54321;
  if (geteuid() != 0 || chown(path_.c_str(), 0, kGroup) != 0) GTEST_SKIP() << "only root gives files away";
  chmod(path_.c_str(), 0440);
  const gid_t own_group = getegid();
  ASSERT_EQ(setegid(kGroup), 0);
  ASSERT_EQ(seteuid(kOther), 0);
  const auto text = read_file_of_owner(path_, S_IRWXO, "--keys: ", "make another");
  ASSERT_EQ(seteuid(0), 0);
  ASSERT_EQ(setegid(own_group), 0);
  ASSERT_TRUE(text) << text.error().message;
  EXPECT_EQ(*text, content_);
}

TEST_F(SecretFileTest, WhatIsNotAFileIsRefusedAtOnce) {
  std::filesystem::remove(path_);
  EXPECT_EQ(error_with(0600, S_IRWXO),
            "--keys: " + path_ + ": cannot be read: No such file or directory; make another");
  ASSERT_EQ(mkfifo(path_.c_str(), 0600), 0);
  EXPECT_EQ(error_with(0600, S_IRWXO), "--keys: " + path_ + ": not a file; make another");
  std::filesystem::remove(path_);
  std::filesystem::create_directory(path_);
  EXPECT_EQ(error_with(0700, S_IRWXO), "--keys: " + path_ + ": not a file; make another");
}

}  // namespace
}  // namespace tensormass
