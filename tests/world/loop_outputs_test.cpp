#include "world/loop_outputs.h"

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/scenes.h"

/// Results wait in their mailboxes while the world goes on.
namespace tensormass::world {
namespace {

class Outputs : public tests::OnBackend {};

TEST_P(Outputs, AFrameHasTheTopologyOfItsStep) {
  const auto world = start(tests::block_with_probe());
  world->set_topology_version(7);
  LoopOutputs outputs(*world);
  outputs.gather_frame();
  outputs.publish(true);
  world->set_topology_version(8);  // before the publisher has come to take the frame

  v1::Frame frame;
  ASSERT_TRUE(outputs.take_frame(frame));
  EXPECT_EQ(frame.topology_version(), 7u);

  ASSERT_TRUE(world->step(true));
  outputs.take_step(Clock::now());
  outputs.publish(true);
  ASSERT_TRUE(outputs.take_frame(frame));
  EXPECT_EQ(frame.topology_version(), 8u);
  EXPECT_EQ(outputs.frame().topology_version(), 8u);
}

TM_ON_EACH_BACKEND(Outputs);

}  // namespace
}  // namespace tensormass::world
