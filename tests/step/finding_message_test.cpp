#include "step/finding_message.h"

#include <algorithm>
#include <cmath>
#include <fstream>
#include <set>
#include <sstream>
#include <string>

#include <fmt/format.h>
#include <gtest/gtest.h>

#include "core/finding_kinds.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/finding.pb.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::step {
namespace {

TEST(FindingKinds, AreThoseOfTheProtocol) {
  const google::protobuf::EnumDescriptor& codes = *v1::FindingCode_descriptor();
  ASSERT_EQ(codes.value_count(), static_cast<int>(kFindingKinds.size()) + 1) << "and the unspecified one";
  std::set<std::string_view> names;
  for (const FindingKind& kind : kFindingKinds) {
    std::string name = "FINDING_CODE_" + std::string(kind.name);
    std::transform(name.begin(), name.end(), name.begin(), [](unsigned char c) { return std::toupper(c); });
    EXPECT_EQ(v1::FindingCode_Name(static_cast<int>(kind.code)), name);
    EXPECT_EQ(kind.at_load, static_cast<int>(kind.code) < static_cast<int>(FindingCode::kSolveAboveTolerance));
    EXPECT_EQ(&kind_of(kind.code), &kind);
    EXPECT_TRUE(names.insert(kind.name).second);
  }
}

/// Returns the row of a kind in docs/findings.md.
std::string row_of(const FindingKind& kind) {
  std::string limit = "see right";
  if (!std::isnan(kind.limit)) {
    limit = fmt::format("{} {}{}{}", kind.shown == FindingKind::Shown::kAbove ? "above" : "below", kind.limit,
                        kind.unit.empty() ? "" : " ", kind.unit);
  }
  return fmt::format("| `{}` | {} | {} | {} |", kind.name, kind.value, limit, kind.limit_is);
}

TEST(FindingKinds, AreInTheDocument) {
  std::ifstream file(TENSORMASS_SOURCE_DIR "/docs/findings.md");
  ASSERT_TRUE(file);
  std::set<std::string> rows;
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with("| `")) {
      EXPECT_TRUE(rows.insert(line).second) << line;
    }
  }
  for (const FindingKind& kind : kFindingKinds) {
    EXPECT_EQ(rows.erase(row_of(kind)), 1u) << "docs/findings.md needs this row:\n" << row_of(kind);
  }
  for (const std::string& row : rows) ADD_FAILURE() << "no kind has this row: " << row;
}

TEST(FindingMessage, HasEverythingOfAFinding) {
  const Finding finding{.code = FindingCode::kOverlap,
                        .value = 0.005,
                        .limit = 0.001,
                        .place = "body 'b'.mesh",
                        .body = "a",
                        .other = "b",
                        .tool = "t",
                        .message = "they overlap",
                        .remedy = "move one",
                        .accepted = ""};
  v1::SceneReport report;
  add(finding, report);
  ASSERT_EQ(report.findings_size(), 1);
  EXPECT_EQ(report.findings(0).ShortDebugString(),
            "code: FINDING_CODE_OVERLAP value: 0.005 limit: 0.001 unit: \"m\" place: \"body \\'b\\'.mesh\" body: \"a\" "
            "other: \"b\" tool: \"t\" message: \"they overlap\" remedy: \"move one\"");
  ASSERT_EQ(report.warnings_size(), 1);
  EXPECT_EQ(report.warnings(0), "they overlap; move one");
  EXPECT_EQ(name_of(report.findings(0)), "overlap");
}

TEST(FindingMessage, OfAnAcceptedFindingGivesNoWarning) {
  Finding finding{.code = FindingCode::kOverlap, .body = "a", .other = "b"};
  accept(finding, {{FindingCode::kLocking, "", "", "no"}, {FindingCode::kOverlap, "c", "", "no"}});
  EXPECT_EQ(finding.accepted, "");
  accept(finding, {{FindingCode::kOverlap, "b", "", "they are one organ"}});
  v1::SceneStatus status;
  add(finding, status);
  EXPECT_EQ(status.findings(0).accepted(), "they are one organ");
  EXPECT_EQ(status.warnings_size(), 0);
}

}  // namespace
}  // namespace tensormass::step
