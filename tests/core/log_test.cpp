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

TEST(Log, ValuesForgeNoLineOfText) {
  const auto text = [](std::string_view value) { return line_of(Format::kText, "event", {{"key", value}}); };
  EXPECT_EQ(text("plain"), "event key=plain");
  EXPECT_EQ(text("λ"), "event key=λ");
  EXPECT_EQ(text(""), "event key=\"\"");
  EXPECT_EQ(text("two words"), "event key=\"two words\"");
  EXPECT_EQ(text("a\nerror"), "event key=\"a\\u000aerror\"");
  EXPECT_EQ(text("\x1b[2K"), "event key=\"\\u001b[2K\"");
  EXPECT_EQ(text("\x7f"), "event key=\"\\u007f\"");
  EXPECT_EQ(text("\tother=1"), "event key=\"\\u0009other=1\"");
  EXPECT_EQ(text("\"quoted\""), "event key=\"\\\"quoted\\\"\"");
  EXPECT_EQ(line_of(Format::kText, "event", {{"count", 7}}), "event count=7");
}

TEST(LogLimiter, AdmitsTheFirstLineAndSuppressesTheNext) {
  Limiter limiter;
  EXPECT_EQ(limiter.admit(), 0u);
  EXPECT_EQ(limiter.admit(), std::nullopt);
}

}  // namespace
}  // namespace tensormass::log
