#pragma once

#include <string>

#include <gtest/gtest.h>

/// Expects that an expression of type Result is an error of a code, with `part` in its message.
#define EXPECT_REFUSED(expression, expected_code, part)                                          \
  do {                                                                                           \
    const auto refused = (expression);                                                           \
    ASSERT_FALSE(refused);                                                                       \
    EXPECT_EQ(refused.error().code, expected_code);                                              \
    EXPECT_NE(refused.error().message.find(part), std::string::npos) << refused.error().message; \
  } while (false)
