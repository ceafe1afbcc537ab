#include "bus/zenoh/zenoh_transport.h"

#include <atomic>
#include <memory>

#include <gtest/gtest.h>

#include "access/key_ring.h"
#include "support.h"
#include "support/key_folder.h"
#include "support/no_descriptors.h"

namespace tensormass::bus {
namespace {

TEST(ZenohKeys, ASessionThatCannotOpenIsTriedAgain) {
  const tests::KeyFolder folder(tests::KeyFolder::client("alice.01234567"));
  folder.write("without.json", tests::KeyFolder::list_of(""));
  auto keys = access::KeyRing::open(folder.path());
  ASSERT_TRUE(keys) << keys.error().message;
  BusCounters counters;
  PoseInput input(
      test::kServer, [](auto&&...) {}, [](auto&&...) {}, counters, keys->get());
  auto transport = ZenohTransport::open({.server = test::kServer, .listen = "tcp/127.0.0.1:0", .keys = keys->get()},
                                        input, counters);
  ASSERT_TRUE(transport) << transport.error().message;
  std::atomic<int> calls = 0, done = 0;
  (*keys)->follow([&] {
    std::unique_ptr<tests::NoDescriptors> none;
    if (calls == 0) none = std::make_unique<tests::NoDescriptors>();
    const bool opened = (*transport)->keys_changed();
    done += opened;
    ++calls;
    return opened;
  });
  folder.rename("without.json", "clients.json");
  EXPECT_TRUE(test::eventually([&] { return done == 1; }));
  EXPECT_GT(calls, 1) << "the first attempt has no descriptor, and ends at once";
  (*keys)->stop();
}

}  // namespace
}  // namespace tensormass::bus
