#include "core/names.h"

#include <string>

#include <gtest/gtest.h>

namespace tensormass {
namespace {

TEST(Names, HaveLettersDigitsUnderscoresAndHyphens) {
  for (int c = 0; c < 256; ++c) {
    const bool letter = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
    const bool expected = letter || (c >= '0' && c <= '9') || c == '_' || c == '-';
    const char name[] = {'a', static_cast<char>(c), 'b'};
    EXPECT_EQ(is_valid_name({name, sizeof name}), expected) << "character " << c;
  }
}

TEST(Names, AreNeitherEmptyNorLongerThanTheLimit) {
  EXPECT_FALSE(is_valid_name(""));
  EXPECT_TRUE(is_valid_name("x"));
  EXPECT_TRUE(is_valid_name(std::string(limits::kMaxNameLength, 'x')));
  EXPECT_FALSE(is_valid_name(std::string(limits::kMaxNameLength + 1, 'x')));
}

}  // namespace
}  // namespace tensormass
