#include "step/stages.h"

#include <fstream>
#include <set>
#include <sstream>
#include <string>

#include <fmt/format.h>
#include <gtest/gtest.h>

namespace tensormass::step {
namespace {

TEST(StageTable, EachPhaseIsOneRunOfRows) {
  std::set<Phase> ended;
  for (std::size_t i = 1; i < std::size(kStages); ++i) {
    if (kStages[i].phase == kStages[i - 1].phase) continue;
    ended.insert(kStages[i - 1].phase);
    EXPECT_FALSE(ended.contains(kStages[i].phase)) << kStages[i].name;
  }
}

TEST(StageTable, RowsOfOneKindAgreeButForPhaseAndCondition) {
  for (const StageInfo& row : kStages) {
    const StageInfo& first = info(row.kind);
    EXPECT_EQ(row.name, first.name);
    EXPECT_EQ(row.scope, first.scope) << row.name;
    EXPECT_EQ(row.communication, first.communication) << row.name;
    EXPECT_EQ(row.reads, first.reads) << row.name;
    EXPECT_EQ(row.writes, first.writes) << row.name;
  }
}

/// The document shows exactly this table. On a failure the message holds the rows to paste.
TEST(StageTable, StandsInTheArchitectureDocument) {
  std::ifstream file("docs/architecture.md");
  ASSERT_TRUE(file.good()) << "tests run in the repository's root";
  std::stringstream text;
  text << file.rdbuf();
  std::string rows;
  for (const StageInfo& row : kStages) {
    rows += fmt::format("| {} | {} | {} | {} |\n", row.name, row.reads, row.writes, row.when);
  }
  EXPECT_NE(text.str().find("| stage | reads | writes | when |\n|---|---|---|---|\n" + rows), std::string::npos)
      << rows;
}

}  // namespace
}  // namespace tensormass::step
