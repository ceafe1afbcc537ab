#include "bus/zeromq/handshake_watch.h"

#include <gtest/gtest.h>

namespace tensormass::bus {
namespace {

using std::chrono::milliseconds;

class HandshakeWatchTest : public testing::Test {
 protected:
  const HandshakeWatch::Time start{};
  HandshakeWatch watch{milliseconds(100)};
};

TEST_F(HandshakeWatchTest, WhoSucceedsIsNeverCounted) {
  watch.accepted(5, start);
  EXPECT_EQ(watch.take_refused(start), 0);
  watch.succeeded();
  EXPECT_EQ(watch.take_refused(start + milliseconds(500)), 0);
  watch.disconnected(5);
  EXPECT_EQ(watch.take_refused(start + milliseconds(500)), 0);
  EXPECT_FALSE(watch.is_waiting());
}

TEST_F(HandshakeWatchTest, WhoGoesWithoutSuccessIsCountedOnceAndAtOnce) {
  watch.accepted(5, start);
  watch.disconnected(5);
  EXPECT_EQ(watch.take_refused(start), 1);
  EXPECT_EQ(watch.take_refused(start + milliseconds(500)), 0);
}

TEST_F(HandshakeWatchTest, WhoStaysWithoutSuccessIsCountedInTime) {
  watch.accepted(5, start);
  EXPECT_EQ(watch.take_refused(start + milliseconds(99)), 0);
  EXPECT_TRUE(watch.is_waiting());
  EXPECT_EQ(watch.take_refused(start + milliseconds(100)), 1);
  watch.disconnected(5);
  EXPECT_EQ(watch.take_refused(start + milliseconds(500)), 0);
}

TEST_F(HandshakeWatchTest, AGoodPeerHidesABadOneOnlyWhileItIsYoung) {
  watch.accepted(5, start);
  watch.accepted(6, start);
  watch.succeeded();  // one of them; which is not said
  watch.disconnected(6);
  EXPECT_EQ(watch.take_refused(start), 0);
  EXPECT_EQ(watch.take_refused(start + milliseconds(100)), 1);
}

TEST_F(HandshakeWatchTest, ADescriptorThatIsUsedAgainIsAnotherPeer) {
  for (int round = 0; round < 3; ++round) {
    watch.accepted(5, start);
    watch.disconnected(5);
  }
  EXPECT_EQ(watch.take_refused(start), 3);
}

}  // namespace
}  // namespace tensormass::bus
