#include "bus/bus.h"

#include <utility>

#include "bus/zenoh/zenoh_transport.h"
#include "bus/zeromq/zeromq_transport.h"
#include "core/names.h"

namespace tensormass::bus {
namespace {

using LogHandler = std::function<void(bool, std::string_view, std::string_view)>;

/// Installs `handler` as zenoh's log, the first time only. zenoh logs for the whole process until it exits, so the
/// handler is never freed.
void forward_zenoh_log(LogHandler handler) {
  static const LogHandler* const installed = [&handler] {
    auto* kept = new LogHandler(std::move(handler));
    tensormass_zenoh_set_log(
        [](void* context, bool is_error, const char* who, std::size_t who_size, const char* message, std::size_t size) {
          (*static_cast<LogHandler*>(context))(is_error, {who, who_size}, {message, size});
        },
        kept);
    return kept;
  }();
  static_cast<void>(installed);
}

}  // namespace

Bus::Bus(const BusOptions& options)
    : input_(options.server, options.on_pose, options.on_malformed, counters_, options.keys),
      failed_handshakes_before_(tensormass_zenoh_failed_handshakes()),
      refused_before_(tensormass_zenoh_refused()) {}

Bus::~Bus() = default;

Result<std::unique_ptr<Bus>> Bus::open(const BusOptions& options) {
  if (!is_valid_name(options.server)) {
    return invalid("server name '" + options.server + "': must be 1 to " + std::to_string(limits::kMaxNameLength) +
                   " characters out of [A-Za-z0-9_-]");
  }
  if (options.zeromq_publish_endpoint.empty() != options.zeromq_pose_endpoint.empty()) {
    return invalid("ZeroMQ: give both the publish and the pose endpoint, or neither");
  }
  std::unique_ptr<Bus> bus(new Bus(options));
  if (!options.zeromq_publish_endpoint.empty()) {
    auto zeromq = ZeroMqTransport::open(
        {options.server, options.zeromq_publish_endpoint, options.zeromq_pose_endpoint, options.keys}, bus->input_,
        bus->counters_);
    if (!zeromq) return tl::make_unexpected(zeromq.error());
    bus->endpoints_.zeromq_publish = (*zeromq)->publish_endpoint();
    bus->endpoints_.zeromq_pose = (*zeromq)->pose_endpoint();
    bus->transports_.push_back(std::move(*zeromq));
  }
  if (!options.zenoh_listen.empty()) {
    forward_zenoh_log(options.on_log);
    auto zenoh = ZenohTransport::open({options.server, options.zenoh_listen, options.zenoh_sessions, options.keys},
                                      bus->input_, bus->counters_);
    if (!zenoh) return tl::make_unexpected(zenoh.error());
    bus->endpoints_.zenoh_locator = (*zenoh)->locator();
    bus->transports_.push_back(std::move(*zenoh));
  }
  return bus;
}

void Bus::publish(std::string_view key, const google::protobuf::MessageLite& content, PublishOptions options) {
  if (transports_.empty()) return;
  const auto message = std::make_shared<const Message>(key, content);
  for (const auto& transport : transports_) transport->publish(message, options);
}

void Bus::forget(std::string_view key) {
  for (const auto& transport : transports_) transport->forget(key);
}

bool Bus::keys_changed() {
  bool done = true;
  for (const auto& transport : transports_) done &= transport->keys_changed();
  return done;
}

BusCounts Bus::counts() const {
  BusCounts out = counters_.read();
  const tensormass_zenoh_refusals refused = tensormass_zenoh_refused();
  const auto add = [&](Refusal refusal, std::uint64_t count) {
    out.refusals[static_cast<std::size_t>(Carrier::kZenoh)][static_cast<std::size_t>(refusal)] += count;
  };
  add(Refusal::kAccess, refused.not_allowed - refused_before_.not_allowed);
  add(Refusal::kMessageSize, refused.too_large - refused_before_.too_large);
  add(Refusal::kSubscriptions, refused.too_many_declarations - refused_before_.too_many_declarations);
  return out;
}

std::uint64_t Bus::malformed_count() const {
  return input_.malformed_count() + tensormass_zenoh_failed_handshakes() - failed_handshakes_before_;
}

}  // namespace tensormass::bus
