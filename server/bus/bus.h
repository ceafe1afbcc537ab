#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include <google/protobuf/message_lite.h>

#include "bus/pose_input.h"
#include "bus/transport.h"
#include "core/result.h"

namespace tensormass::bus {

struct BusOptions {
  /// <server> in the keys.
  std::string server;
  /// Both or neither; empty: ZeroMQ is off.
  std::string zeromq_publish_endpoint;
  std::string zeromq_pose_endpoint;
  /// Empty: zenoh is off.
  std::string zenoh_listen;
  PoseHandler on_pose = [](auto&&...) {};
  MalformedHandler on_malformed = [](auto&&...) {};
  /// Warnings and errors of the transport libraries; from any thread. zenoh's go to the first bus of the process.
  std::function<void(bool is_error, std::string_view message)> on_log = [](auto&&...) {};
};

/// What clients connect to; empty where a transport is off.
struct Endpoints {
  std::string zeromq_publish;
  std::string zeromq_pose;
  std::string zenoh_locator;
};

/// The data plane: one message, the same key and bytes on every transport that is on.
class Bus {
 public:
  /// kInvalidArgument for a wrong name or half of ZeroMQ's endpoints, kUnavailable for an endpoint that is taken.
  static Result<std::unique_ptr<Bus>> open(const BusOptions& options);
  ~Bus();

  /// From any thread. Never waits for a reader.
  void publish(std::string_view key, const google::protobuf::MessageLite& content, PublishOptions options = {});
  /// Ends the retention of a key's message.
  void forget(std::string_view key);

  const Endpoints& endpoints() const { return endpoints_; }
  /// Messages from clients that were refused, and connections that did not speak the transport's language.
  std::uint64_t malformed_count() const;

 private:
  explicit Bus(const BusOptions& options);

  PoseInput input_;
  std::uint64_t failed_handshakes_before_;
  Endpoints endpoints_;
  // Last: transports call `input_` until they are gone.
  std::vector<std::unique_ptr<Transport>> transports_;
};

}  // namespace tensormass::bus
