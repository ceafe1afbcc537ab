#include "bus/zenoh/zenoh_transport.h"

#include <utility>

#include "bus/keys.h"
#include "bus/zenoh/access_control.h"
#include "core/bus_limits.h"
#include "core/log.h"

namespace tensormass::bus {
namespace {

/// tcp/HOST:PORT, as users write it, is tls/HOST:PORT with keys.
std::string with_tls(const std::string& locator) {
  constexpr std::string_view kPlain = "tcp/";
  return locator.starts_with(kPlain) ? "tls/" + locator.substr(kPlain.size()) : locator;
}

}  // namespace

ZenohTransport::ZenohTransport(ZenohOptions options, PoseInput& input, BusCounters& counters)
    : options_(std::move(options)), input_(input), counters_(counters) {}

Result<std::unique_ptr<ZenohTransport>> ZenohTransport::open(const ZenohOptions& options, PoseInput& input,
                                                             BusCounters& counters) {
  std::unique_ptr<ZenohTransport> transport(new ZenohTransport(options, input, counters));
  if (options.keys != nullptr) {
    transport->options_.listen = with_tls(options.listen);
    transport->access_control_ = zenoh_access_control(options.server, options.keys->list());
  }
  TM_RETURN_IF_ERROR(transport->open_session());
  transport->locator_ = transport->session_->locator();
  return transport;
}

Result<void> ZenohTransport::open_session() {
  zenoh::SessionOptions wanted{.listen = locator_.empty() ? options_.listen : locator_,
                               .serve = std::string(kKeyRoot) + "/" + options_.server + "/**",
                               .accept = pose_key(options_.server, "*", "*"),
                               .access_control = access_control_,
                               .max_sessions = options_.max_sessions,
                               .max_message_bytes = limits::kMaxZenohMessageBytes,
                               .max_declarations = limits::kMaxZenohDeclarations,
                               .max_declarations_of_all = limits::kMaxZenohDeclarationsOfAll,
                               .max_keys = limits::kMaxZenohKeys,
                               .max_key_bytes = limits::kMaxZenohKeyBytes,
                               .max_requests = limits::kMaxZenohRequestsAtOnce,
                               .max_requests_per_s = limits::kMaxZenohRequestsPerS,
                               // Whoever has an account on this machine can read shared memory.
                               .shared_memory = options_.keys == nullptr};
  if (options_.keys != nullptr) {
    const access::DaemonKeys& own = options_.keys->daemon();
    wanted.authority = own.authority_pem;
    wanted.certificate = own.certificate_pem;
    wanted.private_key = own.private_key_pem;
  }
  TM_ASSIGN_OR_RETURN(session, zenoh::Session::open(wanted));
  TM_ASSIGN_OR_RETURN(poses, session.subscribe(pose_key(options_.server, "*", "*"), [this](std::string_view key,
                                                                                           std::string_view payload) {
    if (!input_.receive(key, payload, {Carrier::kZenoh, tensormass_zenoh_sender()})) tensormass_zenoh_end_sender();
  }));
  session_.emplace(std::move(session));
  poses_ = std::move(poses);
  return {};
}

void ZenohTransport::publish(const MessagePtr& message, PublishOptions options) {
  if (options_.keys == nullptr) return put(message, options);
  const std::lock_guard lock(retained_mutex_);
  if (options.retain) retained_.insert_or_assign(std::string(message->key()), message);
  // While the session is opened again, which takes a moment, nobody is connected who could miss the message.
  const std::shared_lock open(session_mutex_, std::try_to_lock);
  if (open.owns_lock() && session_) put(message, options);
}

void ZenohTransport::put(const MessagePtr& message, PublishOptions options) {
  if (options.retain) session_->retain(message->key(), message->payload());
  std::uint32_t full_queues = 0;
  session_->put(message->key(), message->payload(), options.urgent, &full_queues);
  counters_.count_full_queues(Carrier::kZenoh, message->key(), full_queues);
}

void ZenohTransport::forget(std::string_view key) {
  if (options_.keys == nullptr) return session_->forget(key);
  const std::lock_guard lock(retained_mutex_);
  if (const auto found = retained_.find(key); found != retained_.end()) retained_.erase(found);
  const std::shared_lock open(session_mutex_, std::try_to_lock);
  if (open.owns_lock() && session_) session_->forget(key);
}

bool ZenohTransport::keys_changed() {
  if (options_.keys == nullptr) return true;
  std::string rules = zenoh_access_control(options_.server, options_.keys->list());
  // Only this thread ends and begins sessions.
  if (session_ && rules == access_control_) return true;
  access_control_ = std::move(rules);
  {
    const std::unique_lock closed(session_mutex_);
    poses_ = {};
    session_.reset();
    if (const auto opened = open_session(); !opened) {
      if (!std::exchange(told_off_, true)) {
        log::error("zenoh is off, and is tried again", {{"reason", opened.error().message}});
      }
      return false;
    }
  }
  if (std::exchange(told_off_, false)) log::info("zenoh is on again");
  const std::lock_guard lock(retained_mutex_);
  const std::shared_lock open(session_mutex_);
  for (const auto& [key, message] : retained_) session_->retain(key, message->payload());
  return true;
}

}  // namespace tensormass::bus
