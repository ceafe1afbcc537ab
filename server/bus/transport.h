#pragma once

#include <string>
#include <string_view>

#include "bus/message.h"

namespace tensormass::bus {

struct PublishOptions {
  /// Kept, and sent again to whoever joins late, until `Transport::forget`.
  bool retain = false;
  /// Ahead of bulk data where the transport knows priorities.
  bool urgent = false;
};

/// One way out. Never blocks on a reader: who cannot take a message loses it.
class Transport {
 public:
  virtual ~Transport() = default;
  /// From any thread.
  virtual void publish(const MessagePtr& message, PublishOptions options) = 0;
  /// Ends the retention of a key's message.
  virtual void forget(std::string_view key) = 0;
};

}  // namespace tensormass::bus
