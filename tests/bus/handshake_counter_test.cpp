#include "bus/zeromq/handshake_counter.h"

#include <gtest/gtest.h>

namespace tensormass::bus {
namespace {

using std::chrono::milliseconds;

class HandshakeCounterTest : public testing::Test {
 protected:
  const HandshakeCounter::Time start{};
  HandshakeCounter counter{milliseconds(100)};
};

TEST_F(HandshakeCounterTest, DoesNotCountAPeerThatSucceeds) {
  counter.accepted(5, start);
  EXPECT_EQ(counter.take_refused(start), 0);
  counter.succeeded();
  EXPECT_EQ(counter.take_refused(start + milliseconds(500)), 0);
  counter.disconnected(5);
  EXPECT_EQ(counter.take_refused(start + milliseconds(500)), 0);
  EXPECT_FALSE(counter.is_waiting());
}

TEST_F(HandshakeCounterTest, CountsAPeerThatDisconnectsWithoutSuccessOnceAndImmediately) {
  counter.accepted(5, start);
  counter.disconnected(5);
  EXPECT_EQ(counter.take_refused(start), 1);
  EXPECT_EQ(counter.take_refused(start + milliseconds(500)), 0);
}

TEST_F(HandshakeCounterTest, CountsAPeerThatStaysWithoutSuccessAtTheTimeout) {
  counter.accepted(5, start);
  EXPECT_EQ(counter.take_refused(start + milliseconds(99)), 0);
  EXPECT_TRUE(counter.is_waiting());
  EXPECT_EQ(counter.take_refused(start + milliseconds(100)), 1);
  counter.disconnected(5);
  EXPECT_EQ(counter.take_refused(start + milliseconds(500)), 0);
}

TEST_F(HandshakeCounterTest, AYoungPeerThatSucceededHidesAFailedOneUntilTheTimeout) {
  counter.accepted(5, start);
  counter.accepted(6, start);
  counter.succeeded();  // the event does not say which of the two
  counter.disconnected(6);
  EXPECT_EQ(counter.take_refused(start), 0);
  EXPECT_EQ(counter.take_refused(start + milliseconds(100)), 1);
}

TEST_F(HandshakeCounterTest, AReusedDescriptorIsAnotherPeer) {
  for (int round = 0; round < 3; ++round) {
    counter.accepted(5, start);
    counter.disconnected(5);
  }
  EXPECT_EQ(counter.take_refused(start), 3);
}

}  // namespace
}  // namespace tensormass::bus
