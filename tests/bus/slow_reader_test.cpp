#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <csignal>

#include "support.h"

namespace tensormass::bus {
namespace {

using namespace test;
using Clock = std::chrono::steady_clock;

v1::Frame make_frame(std::uint64_t sequence) {
  v1::Frame frame;
  frame.set_sequence(sequence);
  frame.set_positions(std::string(240'000, 'p'));
  return frame;
}

std::uint64_t sequence_of(const std::string& payload) {
  v1::Frame frame;
  EXPECT_TRUE(frame.ParseFromString(payload));
  return frame.sequence();
}

TEST(SlowReader, GetsTheNewestFrameOverZeroMq) {
  BusOnFreePorts server(true, false);
  const std::string key = frame_key(kServer, "demo");
  ZeroMqReader slow(server.bus->endpoints().zeromq_publish, key);
  ZeroMqReader witness(server.bus->endpoints().zeromq_publish, key);
  std::uint64_t sequence = 0;
  int reads = 0;
  std::string payload;
  // Publishes new frames until the reader has the newest. A burst may overflow the queue to a subscriber, which then
  // drops frames.
  const auto deliver_to = [&](ZeroMqReader& reader) {
    return eventually([&] {
      server.bus->publish(key, make_frame(++sequence));
      while (reader.read_within(std::chrono::milliseconds(200), payload)) {
        ++reads;
        if (sequence_of(payload) == sequence) return true;
      }
      return false;
    });
  };
  // Both are subscribed once each has read a frame.
  for (ZeroMqReader* reader : {&slow, &witness}) ASSERT_TRUE(deliver_to(*reader));
  // The slow reader reads nothing during 200 frames. The witness reads each frame before the next is published.
  for (int frames = 0; frames < 200; ++frames) ASSERT_TRUE(deliver_to(witness));
  // The slow reader may get messages that are still in transit, but not the old ones. The last of them may have been
  // dropped, if the queue to it was full.
  reads = 0;
  ASSERT_TRUE(deliver_to(slow));
  EXPECT_LE(reads, 20);
}

/// A process that subscribes to a key over both transports (subscriber_main.cpp), and that a test can stop.
class StoppedSubscriber {
 public:
  StoppedSubscriber(const Endpoints& endpoints, const std::string& key) {
    int ready[2];
    if (pipe(ready) != 0) throw std::runtime_error("pipe");
    child_ = fork();
    if (child_ == 0) {
      dup2(ready[1], STDOUT_FILENO);
      execl(BUS_SUBSCRIBER, BUS_SUBSCRIBER, endpoints.zeromq_publish.c_str(), endpoints.zenoh_locator.c_str(),
            key.c_str(), nullptr);
      _exit(127);
    }
    close(ready[1]);
    ready_ = ready[0];
  }
  ~StoppedSubscriber() {
    kill(child_, SIGKILL);
    waitpid(child_, nullptr, 0);
    close(ready_);
  }
  /// Waits until the process has received a message over each transport.
  bool wait_until_receiving() {
    char byte;
    return read(ready_, &byte, 1) == 1;
  }
  void stop() {
    kill(child_, SIGSTOP);
    waitpid(child_, nullptr, WUNTRACED);
  }

 private:
  pid_t child_ = -1;
  int ready_ = -1;
};

TEST(StoppedReader, DelaysNeitherThePublisherNorOtherReaders) {
  BusOnFreePorts server;
  const std::string key = frame_key(kServer, "demo");
  StoppedSubscriber stopped(server.bus->endpoints(), key);
  std::atomic<bool> receiving{false};
  std::thread waiting([&] { receiving = stopped.wait_until_receiving(); });
  std::uint64_t sequence = 0;
  EXPECT_TRUE(eventually([&] {
    server.bus->publish(key, make_frame(++sequence));
    return receiving.load();
  }));
  waiting.join();
  ASSERT_TRUE(receiving);
  stopped.stop();

  ZeroMqReader reader(server.bus->endpoints().zeromq_publish, key);
  std::string payload;
  ASSERT_TRUE(eventually([&] {
    server.bus->publish(key, make_frame(++sequence));
    return reader.try_read(payload);
  }));
  Clock::duration longest{};
  // 96 MB, far more than all queues and buffers between publisher and reader hold.
  for (int count = 0; count < 400; ++count) {
    const auto start = Clock::now();
    server.bus->publish(key, make_frame(++sequence));
    longest = std::max(longest, Clock::now() - start);
  }
  // A blocking send would take seconds (zenoh) or never return (ZeroMQ). The bound leaves room for a busy machine.
  EXPECT_LT(longest, std::chrono::milliseconds(500));
  RecordProperty("longest_publish_us", static_cast<int>(longest / std::chrono::microseconds(1)));
  const BusCounts counts = server.bus->counts();
  constexpr std::size_t kFrame = 1;
  static_assert(kStreamNames[kFrame] == "frame");
  for (const Carrier carrier : {Carrier::kZeroMq, Carrier::kZenoh}) {
    const auto& full = counts.full_queues[static_cast<std::size_t>(carrier)];
    EXPECT_GT(full[kFrame], 0u) << kCarrierNames[static_cast<std::size_t>(carrier)];
    EXPECT_LE(full[kFrame], 400u);
    EXPECT_EQ(full[0] + full[2] + full[3], 0u);
  }
  // During such a burst ZeroMQ may drop frames for running readers too. Frames after the burst must arrive.
  const std::uint64_t burst = sequence;
  EXPECT_TRUE(eventually([&] {
    server.bus->publish(key, make_frame(++sequence));
    return reader.try_read(payload) && sequence_of(payload) > burst;
  }));
}

}  // namespace
}  // namespace tensormass::bus
