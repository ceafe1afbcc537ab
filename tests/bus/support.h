#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include <gtest/gtest.h>
#include <zmq.hpp>

#include "bus/bus.h"
#include "bus/keys.h"
#include "bus/zenoh/session.h"
#include "support/eventually.h"

/// Helpers for the tests of the bus: servers on free ports, and clients that use no code of the server.
namespace tensormass::bus::test {

inline constexpr std::chrono::seconds kDeadline{20};
inline constexpr const char* kServer = "test";

/// A list that other threads append to and a test waits for.
template <class T>
class Collected {
 public:
  void add(T value) {
    const std::lock_guard lock(mutex_);
    values_.push_back(std::move(value));
    changed_.notify_all();
  }
  /// Returns the values once `condition(values)` is true, or at the deadline.
  template <class Condition>
  std::vector<T> wait_until(Condition condition) {
    std::unique_lock lock(mutex_);
    changed_.wait_for(lock, kDeadline, [&] { return condition(values_); });
    return values_;
  }
  /// Returns the values once there are `count`, or at the deadline.
  std::vector<T> wait_for(std::size_t count) {
    return wait_until([count](const auto& values) { return values.size() >= count; });
  }
  std::size_t size() {
    const std::lock_guard lock(mutex_);
    return values_.size();
  }

 private:
  std::mutex mutex_;
  std::condition_variable changed_;
  std::vector<T> values_;
};

struct ReceivedPose {
  std::string scene;
  std::string tool;
  v1::ToolPose pose;
};

/// A bus on free ports that collects its input.
class BusOnFreePorts {
 public:
  explicit BusOnFreePorts(bool zeromq = true, bool zenoh = true) {
    BusOptions options;
    options.server = kServer;
    if (zeromq) options.zeromq_publish_endpoint = options.zeromq_pose_endpoint = "tcp://127.0.0.1:*";
    if (zenoh) options.zenoh_listen = "tcp/127.0.0.1:0";
    options.on_pose = [this](std::string_view scene, std::string_view tool, const v1::ToolPose& pose, const Sender&) {
      poses.add({std::string(scene), std::string(tool), pose});
    };
    options.on_malformed = [this](const Refused& refused) { malformed.add(std::string(refused.scene)); };
    auto opened = Bus::open(options);
    if (!opened) throw std::runtime_error(opened.error().message);
    bus = std::move(*opened);
  }

  Collected<ReceivedPose> poses;
  /// The scene that each refused message named, or "".
  Collected<std::string> malformed;
  std::unique_ptr<Bus> bus;
};

template <class Condition>
bool eventually(const Condition& condition) {
  return tests::eventually(condition, kDeadline);
}

inline v1::ToolPose make_pose(std::uint64_t sequence) {
  v1::ToolPose pose;
  pose.set_sequence(sequence);
  pose.mutable_position_m()->set_x(0.5);
  return pose;
}

/// A client that subscribes to one key over ZeroMQ. `conflate`: ZeroMQ keeps only the newest message.
class ZeroMqReader {
 public:
  ZeroMqReader(const std::string& endpoint, const std::string& key, bool conflate = true) : key_(key) {
    socket_.set(zmq::sockopt::conflate, conflate);
    socket_.set(zmq::sockopt::linger, 0);
    socket_.set(zmq::sockopt::rcvtimeo, static_cast<int>(std::chrono::milliseconds(kDeadline).count()));
    socket_.set(zmq::sockopt::subscribe, key + '\0');
    socket_.connect(endpoint);
  }
  /// Returns the payload of the next message; throws at the deadline.
  std::string read() {
    zmq::message_t message;
    if (!socket_.recv(message)) throw std::runtime_error("no message arrived under " + key_);
    const std::string bytes = message.to_string();
    EXPECT_EQ(bytes.substr(0, key_.size() + 1), key_ + '\0');
    EXPECT_FALSE(message.more());
    return bytes.substr(key_.size() + 1);
  }
  bool try_read(std::string& payload) { return read_within(std::chrono::milliseconds(0), payload); }
  /// Returns false if no message arrives within `time`.
  bool read_within(std::chrono::milliseconds time, std::string& payload) {
    zmq::message_t message;
    zmq::pollitem_t item{socket_.handle(), 0, ZMQ_POLLIN, 0};
    if (zmq::poll(&item, 1, time) == 0 || !socket_.recv(message, zmq::recv_flags::dontwait)) return false;
    payload = message.to_string().substr(key_.size() + 1);
    return true;
  }

 private:
  std::string key_;
  zmq::context_t context_{1};
  zmq::socket_t socket_{context_, zmq::socket_type::sub};
};

/// A client that pushes raw messages to the pose endpoint.
class ZeroMqPoseWriter {
 public:
  explicit ZeroMqPoseWriter(const std::string& endpoint) {
    socket_.set(zmq::sockopt::linger, 1000);
    socket_.set(zmq::sockopt::sndtimeo, static_cast<int>(std::chrono::milliseconds(kDeadline).count()));
    socket_.connect(endpoint);
  }
  void send(std::string_view bytes, bool more = false) {
    const auto flags = more ? zmq::send_flags::sndmore : zmq::send_flags::none;
    EXPECT_TRUE(socket_.send(zmq::buffer(bytes), flags));
  }

 private:
  zmq::context_t context_{1};
  zmq::socket_t socket_{context_, zmq::socket_type::push};
};

}  // namespace tensormass::bus::test
