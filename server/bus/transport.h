#pragma once

#include <string>
#include <string_view>

#include "bus/message.h"

namespace tensormass::bus {

struct PublishOptions {
  /// True: the transport keeps the newest message of this key and sends it to each late joiner, until
  /// `Transport::forget`.
  bool retain = false;
  /// True: the message overtakes bulk data on transports that have priorities (zenoh).
  bool urgent = false;
};

/// One way for messages to reach clients: ZeroMQ or zenoh. All methods may be called from any thread.
///
/// `publish` never waits for a reader. A reader whose queue is full loses the message.
class Transport {
 public:
  virtual ~Transport() = default;
  virtual void publish(const MessagePtr& message, PublishOptions options) = 0;
  /// Drops the retained message of `key`; does nothing if there is no such message.
  virtual void forget(std::string_view key) = 0;
  /// Cuts clients whose keys do not count any more. Scenes step on meanwhile. Returns false if it must be called again,
  /// after a while.
  virtual bool keys_changed() = 0;
};

}  // namespace tensormass::bus
