#include "bus/zenoh/zenoh_transport.h"

#include <utility>

#include "bus/keys.h"
#include "core/bus_limits.h"

namespace tensormass::bus {

Result<std::unique_ptr<ZenohTransport>> ZenohTransport::open(const ZenohOptions& options, PoseInput& input) {
  auto session = zenoh::Session::open({.listen = options.listen,
                                       .connect = {},
                                       .serve = std::string(kKeyRoot) + "/" + options.server + "/**",
                                       .accept = pose_key(options.server, "*", "*"),
                                       .max_sessions = options.max_sessions,
                                       .max_message_bytes = limits::kMaxZenohMessageBytes,
                                       .shared_memory = true});
  if (!session) return tl::make_unexpected(session.error());
  std::unique_ptr<ZenohTransport> transport(new ZenohTransport(std::move(*session)));
  auto poses = transport->session_.subscribe(
      pose_key(options.server, "*", "*"),
      [&input](std::string_view key, std::string_view payload) { input.receive(key, payload); });
  if (!poses) return tl::make_unexpected(poses.error());
  transport->poses_ = std::move(*poses);
  return transport;
}

void ZenohTransport::publish(const MessagePtr& message, PublishOptions options) {
  if (options.retain) session_.retain(message->key(), message->payload());
  session_.put(message->key(), message->payload(), options.urgent);
}

void ZenohTransport::forget(std::string_view key) { session_.forget(key); }

}  // namespace tensormass::bus
