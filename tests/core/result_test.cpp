#include "core/result.h"

#include <gtest/gtest.h>

namespace tensormass {
namespace {

Result<int> positive(int value) {
  if (value <= 0) return invalid("value: must be positive");
  return value;
}
Result<int> doubled(int value, int& calls) {
  TM_ASSIGN_OR_RETURN(number, positive((++calls, value)));
  number *= 2;  // a reference to the value
  return number;
}
Result<void> checked(int value, int& calls) {
  TM_RETURN_IF_ERROR(positive((++calls, value)));
  ++calls;
  return {};
}

TEST(Result, PassesTheErrorOnUnchanged) {
  int calls = 0;
  for (const Error& error : {doubled(-1, calls).error(), checked(-1, calls).error()}) {
    EXPECT_EQ(error.code, ErrorCode::kInvalidArgument);
    EXPECT_EQ(error.message, "value: must be positive");
  }
  EXPECT_EQ(calls, 2) << "each expression is evaluated once, and nothing after it";
}

TEST(Result, GoesOnWithTheValue) {
  int calls = 0;
  EXPECT_EQ(doubled(21, calls), 42);
  EXPECT_TRUE(checked(1, calls));
  EXPECT_EQ(calls, 3);
}

TEST(Result, FailsWithTheCodeThatIsGiven) {
  const Result<int> failed = fail(ErrorCode::kNotFound, "no such scene");
  ASSERT_FALSE(failed);
  EXPECT_EQ(failed.error().code, ErrorCode::kNotFound);
  EXPECT_EQ(failed.error().message, "no such scene");
}

}  // namespace
}  // namespace tensormass
