#include "daemon/vitals.h"

#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <atomic>
#include <cstdlib>
#include <cstring>
#include <string>

#include <gtest/gtest.h>

#include "support/eventually.h"
#include "support/faulty_backend.h"
#include "support/scenes.h"
#include "world/compiled_scene.h"

namespace tensormass::daemon {
namespace {

using namespace std::chrono_literals;

template <class Condition>
bool eventually(const Condition& condition) {
  return tests::eventually(condition, 60s);
}

/// A service manager's socket, with a name that only this process knows.
class FakeManager {
 public:
  FakeManager() {
    socket_ = socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK, 0);
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    const std::string name = "tensormass-test-" + std::to_string(getpid());
    std::memcpy(address.sun_path + 1, name.data(), name.size());
    const auto size = static_cast<socklen_t>(offsetof(sockaddr_un, sun_path) + 1 + name.size());
    if (bind(socket_, reinterpret_cast<const sockaddr*>(&address), size) != 0) throw std::runtime_error("bind");
    setenv("NOTIFY_SOCKET", ("@" + name).c_str(), 1);
    setenv("WATCHDOG_USEC", "400000", 1);
    unsetenv("WATCHDOG_PID");
  }
  ~FakeManager() {
    close(socket_);
    unsetenv("NOTIFY_SOCKET");
    unsetenv("WATCHDOG_USEC");
  }
  /// Takes the messages that have come. Returns their number; `last` is the newest one.
  int take() {
    int count = 0;
    char text[256];
    for (ssize_t size; (size = recv(socket_, text, sizeof(text), 0)) >= 0; ++count) last.assign(text, size);
    return count;
  }
  std::string last;

 private:
  int socket_ = -1;
};

TEST(ServiceManagerTest, TellsTheSocketOfItsEnvironment) {
  FakeManager fake;
  const ServiceManager manager;
  EXPECT_EQ(manager.watchdog(), 400ms);
  manager.tell("READY=1");
  EXPECT_EQ(fake.take(), 1);
  EXPECT_EQ(fake.last, "READY=1");
  for (int i = 0; i < 10'000; ++i) manager.tell("WATCHDOG=1");  // more than the socket holds: none of them blocks
}

TEST(ServiceManagerTest, TellsNobodyWithoutOne) {
  for (const char* path : {"", "relative", std::string(200, '/').c_str()}) {
    setenv("NOTIFY_SOCKET", path, 1);
    setenv("WATCHDOG_USEC", "400000", 1);
    const ServiceManager manager;
    EXPECT_FALSE(manager.watchdog());
    manager.tell("READY=1");
  }
  FakeManager fake;
  setenv("WATCHDOG_PID", "1", 1);  // another process
  EXPECT_FALSE(ServiceManager().watchdog());
  unsetenv("WATCHDOG_PID");
  setenv("WATCHDOG_USEC", "soon", 1);
  EXPECT_FALSE(ServiceManager().watchdog());
}

struct Seen {
  std::atomic<bool> publisher_turns{true};
  std::atomic<int> looks{0}, live{-1}, losses{0};
};

Vitals::Watched watched(const ServiceManager& manager, Seen& seen, std::vector<control::RunnerPtr> scenes = {}) {
  return {.manager = manager,
          .scenes = [scenes = std::move(scenes)] { return scenes; },
          .publisher_turns =
              [&seen] {
                ++seen.looks;
                return seen.publisher_turns.load();
              },
          .on_live = [&seen](bool live) { seen.live = live ? 1 : 0; },
          .on_device_lost = [&seen](const std::string&) { ++seen.losses; }};
}

TEST(VitalsTest, TheWatchdogHearsOfALiveDaemonOnly) {
  FakeManager fake;
  const ServiceManager manager;
  Seen seen;
  Vitals vitals(watched(manager, seen));
  EXPECT_TRUE(eventually([&] { return fake.take() > 0; }));
  EXPECT_TRUE(eventually([&] { return fake.take() > 0; })) << "again and again";
  EXPECT_EQ(fake.last, "WATCHDOG=1");
  EXPECT_EQ(seen.live, 1);

  seen.publisher_turns = false;
  EXPECT_TRUE(eventually([&] { return seen.live == 0; }));
  fake.take();
  const int before = seen.looks;
  EXPECT_TRUE(eventually([&] { return seen.looks >= before + 4; }));
  EXPECT_EQ(fake.take(), 0);

  seen.publisher_turns = true;
  EXPECT_TRUE(eventually([&] { return seen.live == 1; }));
  EXPECT_TRUE(eventually([&] { return fake.take() > 0; }));
}

/// Starts a scene whose steps fail, or take, as planned.
control::RunnerPtr start(tests::FaultPlan plan) {
  auto compiled = world::compile_scene(tests::block_with_probe(false, 4), {world::BackendChoice::kCpu, 1});
  if (!compiled) throw std::runtime_error(compiled.error().message);
  compiled->backend = std::make_unique<tests::FaultyBackend>(std::move(compiled->backend), std::move(plan));
  auto runner = world::Runner::start(std::move(*compiled));
  if (!runner) throw std::runtime_error(runner.error().message);
  return std::move(*runner);
}

TEST(VitalsTest, AStepThatHangsIsNotLive) {
  const ServiceManager manager;
  Seen seen;
  std::atomic<bool> hangs{true};
  const auto runner = start([&](std::uint64_t step, std::uint64_t) -> std::optional<tests::Fault> {
    if (step == 2) eventually([&] { return !hangs; });
    return std::nullopt;
  });
  Vitals vitals(watched(manager, seen, {runner}));
  EXPECT_TRUE(eventually([&] { return seen.live == 1; })) << "a scene that waits is well";
  std::thread caller([&] { (void)runner->step(3); });
  EXPECT_TRUE(eventually([&] { return seen.live == 0; }));
  hangs = false;
  EXPECT_TRUE(eventually([&] { return seen.live == 1; }));
  caller.join();
}

TEST(VitalsTest, ADeviceLossIsToldOnce) {
  const ServiceManager manager;
  Seen seen;
  const auto fails = start([](std::uint64_t step, std::uint64_t) -> std::optional<tests::Fault> {
    return step == 1 ? std::optional(tests::Fault::kDeviceError) : std::nullopt;
  });
  const auto loses = start([](std::uint64_t step, std::uint64_t) -> std::optional<tests::Fault> {
    return step == 2 ? std::optional(tests::Fault::kDeviceLost) : std::nullopt;
  });
  EXPECT_FALSE(fails->step(1));
  ASSERT_TRUE(loses->step(1));
  Vitals vitals(watched(manager, seen, {fails, loses}));
  EXPECT_TRUE(eventually([&] { return seen.looks >= 2; }));
  EXPECT_EQ(seen.losses, 0) << "another failure of a device stops its scene alone";
  EXPECT_FALSE(loses->step(1));
  EXPECT_TRUE(eventually([&] { return seen.losses == 1; }));
  const int before = seen.looks;
  EXPECT_TRUE(eventually([&] { return seen.looks >= before + 2; }));
  EXPECT_EQ(seen.losses, 1);
}

}  // namespace
}  // namespace tensormass::daemon
