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
