#include <gtest/gtest.h>
#include <stdlib.h>

#include <filesystem>
#include <fstream>
#include <sstream>

#include "haptic/report_file.h"

namespace tensormass::haptic {
namespace {

class ReportFileTest : public testing::Test {
 protected:
  ReportFileTest() : folder_(testing::TempDir() + "tensormass-XXXXXX") {
    if (mkdtemp(folder_.data()) == nullptr) throw std::runtime_error("no temporary folder");
  }
  ~ReportFileTest() override { std::filesystem::remove_all(folder_); }

  std::string path() const { return folder_ + "/report.json"; }
  std::string text() const {
    std::ostringstream all;
    all << std::ifstream(path()).rdbuf();
    return all.str();
  }

  std::string folder_;
};

TEST_F(ReportFileTest, ReplacesTheWholeOlderReport) {
  std::ofstream(path()) << "an older and longer one";
  ReportFile file;
  ASSERT_TRUE(file.open(path()));
  EXPECT_EQ(text(), "an older and longer one") << "until there is a new one";
  ASSERT_TRUE(file.write("new"));
  EXPECT_EQ(text(), "new");
}

TEST_F(ReportFileTest, LeavesNoFileIfNothingWasWritten) {
  {
    ReportFile file;
    ASSERT_TRUE(file.open(path()));
  }
  EXPECT_FALSE(std::filesystem::exists(path()));
  std::ofstream(path()) << "old";
  {
    ReportFile file;
    ASSERT_TRUE(file.open(path()));
  }
  EXPECT_EQ(text(), "old");
}

TEST_F(ReportFileTest, APathThatCannotBeWrittenIsAnInvalidArgument) {
  for (const std::string& wrong : {folder_, folder_ + "/missing/report.json"}) {
    ReportFile file;
    const auto opened = file.open(wrong);
    ASSERT_FALSE(opened);
    EXPECT_EQ(opened.error().code, ErrorCode::kInvalidArgument);
    EXPECT_NE(opened.error().message.find(wrong), std::string::npos);
  }
}

TEST_F(ReportFileTest, ALaterWriteErrorIsNotAnInvalidArgument) {
  ReportFile file;
  ASSERT_TRUE(file.open("/dev/full"));
  const auto written = file.write("report");
  ASSERT_FALSE(written);
  EXPECT_EQ(written.error().code, ErrorCode::kUnavailable);
  EXPECT_NE(written.error().message.find("/dev/full: No space left"), std::string::npos) << written.error().message;
}

TEST_F(ReportFileTest, AnEmptyPathWritesNoReport) {
  ReportFile file;
  EXPECT_TRUE(file.open(""));
  EXPECT_TRUE(file.write("report"));
}

}  // namespace
}  // namespace tensormass::haptic
