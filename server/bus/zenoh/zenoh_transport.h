#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <string_view>

#include "bus/pose_input.h"
#include "bus/transport.h"
#include "bus/zenoh/session.h"
#include "core/result.h"

namespace tensormass::bus {

struct ZenohOptions {
  std::string server;
  /// "tcp/127.0.0.1:7447"; port 0 for a free one.
  std::string listen;
};

/// The same keys and bytes over zenoh. Who joins late gets what is retained by a `get` of its key.
class ZenohTransport final : public Transport {
 public:
  /// `input` outlives the transport.
  static Result<std::unique_ptr<ZenohTransport>> open(const ZenohOptions& options, PoseInput& input);

  void publish(const MessagePtr& message, PublishOptions options) override;
  void forget(std::string_view key) override;

  /// With the port that was chosen.
  const std::string& locator() const { return locator_; }

 private:
  explicit ZenohTransport(zenoh::Session session) : session_(std::move(session)), locator_(session_.locator()) {}

  zenoh::Session session_;
  std::string locator_;
  zenoh::Subscriber poses_;
};

}  // namespace tensormass::bus
