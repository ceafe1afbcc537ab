#include "core/log.h"

#include <gtest/gtest.h>

namespace tensormass::log {
namespace {

TEST(Log, QuotesTextAsJson) {
  EXPECT_EQ(json_quoted("plain"), "\"plain\"");
  EXPECT_EQ(json_quoted("a\"b\\c"), "\"a\\\"b\\\\c\"");
  EXPECT_EQ(json_quoted("line\nend\x1f"), "\"line\\u000aend\\u001f\"");
  EXPECT_EQ(json_quoted("λ"), "\"λ\"") << "UTF-8 stays as it is";
}

TEST(Log, FieldsKnowTextFromNumbers) {
  EXPECT_TRUE(Field("name", "7").is_text);
  EXPECT_FALSE(Field("count", 7).is_text);
  EXPECT_EQ(Field("count", 7u).value, "7");
}

TEST(LogLimiter, AdmitsTheFirstLineAndSuppressesTheNext) {
  Limiter limiter;
  EXPECT_EQ(limiter.admit(), 0u);
  EXPECT_EQ(limiter.admit(), std::nullopt);
}

}  // namespace
}  // namespace tensormass::log
