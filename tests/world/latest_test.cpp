#include "world/latest.h"

#include <cstdint>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

namespace tensormass::world {
namespace {

void put(Latest<int>& box, int value) {
  box.writing() = value;
  box.publish();
}

TEST(Latest, GivesTheNewestOnce) {
  Latest<int> box;
  EXPECT_EQ(box.take(), nullptr);
  put(box, 1);
  put(box, 2);
  put(box, 3);
  const int* taken = box.take();
  ASSERT_NE(taken, nullptr);
  EXPECT_EQ(*taken, 3);
  EXPECT_EQ(box.take(), nullptr);
  put(box, 4);
  EXPECT_EQ(*taken, 3) << "stays valid until the next take";
  EXPECT_EQ(*box.take(), 4);
}

TEST(Latest, SaysIfItDropsAValueThatNobodyTook) {
  Latest<int> box;
  box.writing() = 1;
  EXPECT_FALSE(box.publish());
  box.writing() = 2;
  EXPECT_TRUE(box.publish());
  box.take();
  box.writing() = 3;
  EXPECT_FALSE(box.publish());
}

/// A value is never torn, never older than one already seen, and the last one arrives.
TEST(Latest, KeepsValuesWholeAndInOrderBetweenTwoThreads) {
  constexpr std::uint64_t kLast = 200'000;
  Latest<std::vector<std::uint64_t>> box(std::vector<std::uint64_t>(8, 0));
  std::thread writer([&] {
    for (std::uint64_t value = 1; value <= kLast; ++value) {
      for (std::uint64_t& item : box.writing()) item = value;
      box.publish();
    }
  });
  std::uint64_t seen = 0;
  bool whole = true, in_order = true;
  while (seen < kLast) {
    const auto* taken = box.take();
    if (taken == nullptr) {
      std::this_thread::yield();
      continue;
    }
    for (const std::uint64_t item : *taken) whole = whole && item == taken->front();
    in_order = in_order && taken->front() > seen;
    seen = taken->front();
    if (!whole || !in_order) break;
  }
  writer.join();
  EXPECT_TRUE(whole);
  EXPECT_TRUE(in_order);
}

}  // namespace
}  // namespace tensormass::world
