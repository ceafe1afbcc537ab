#include "bus/zeromq/connections.h"

#include <set>

#include <gtest/gtest.h>

namespace tensormass::bus {
namespace {

using std::chrono::milliseconds;

class ConnectionsTest : public testing::Test {
 protected:
  std::optional<int> accept(int descriptor) {
    now_ += milliseconds(1);
    return connections_.accepted(descriptor, now_, [this](int each) {
      ++looked_at_;
      return !gone_.contains(each);
    });
  }

  Connections connections_{3};
  Connections::Time now_{std::chrono::hours(1)};
  std::set<int> gone_;
  int looked_at_ = 0;
};

TEST_F(ConnectionsTest, TheOldestThatIsOfNoUseMakesRoom) {
  for (const int descriptor : {7, 5, 6}) EXPECT_EQ(accept(descriptor), std::nullopt);
  connections_.used(7);
  EXPECT_EQ(accept(8), 5);
  connections_.used(8);
  EXPECT_EQ(accept(9), 6);
  connections_.used(9);
  EXPECT_EQ(accept(10), 10) << "the others are used";
  connections_.disconnected(8);
  EXPECT_EQ(accept(11), std::nullopt);
}

TEST_F(ConnectionsTest, WhatEndedWithoutAWordDoesNotCount) {
  for (const int descriptor : {1, 2, 3}) EXPECT_EQ(accept(descriptor), std::nullopt);
  gone_ = {1, 2};
  EXPECT_EQ(accept(4), std::nullopt);
  EXPECT_EQ(connections_.count(), 2u);
  EXPECT_EQ(accept(4), std::nullopt) << "another peer under its descriptor";
  EXPECT_EQ(connections_.count(), 2u);
}

TEST_F(ConnectionsTest, AFloodDoesNotLookAtAllAgainAndAgain) {
  for (int descriptor = 0; descriptor < 50; ++descriptor) accept(descriptor);
  EXPECT_EQ(looked_at_, 4);
  now_ += milliseconds(100);
  accept(50);
  EXPECT_EQ(looked_at_, 8);
}

}  // namespace
}  // namespace tensormass::bus
