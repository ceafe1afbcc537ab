#include "bus/pose_input.h"

#include <array>
#include <chrono>
#include <new>
#include <utility>

#include "bus/keys.h"
#include "bus/zenoh/tensormass_zenoh.h"
#include "core/limits.h"
#include "core/peer_address.h"

namespace tensormass::bus {
namespace {

std::string_view what_of(Carrier carrier) {
  return carrier == Carrier::kZeroMq ? "a pose over ZeroMQ" : "a pose over zenoh";
}

}  // namespace

std::string Sender::who() const {
  if (!client.empty()) return std::string(client);
  if (carrier == Carrier::kZeroMq) return address_of_peer(descriptor);
  std::array<char, 128> name{};
  tensormass_zenoh_sender_name(name.data(), name.size());
  return name.data();
}

PoseInput::PoseInput(std::string server, PoseHandler on_pose, MalformedHandler on_malformed, BusCounters& counters,
                     const access::KeyRing* keys)
    : server_(std::move(server)),
      on_pose_(std::move(on_pose)),
      on_malformed_(std::move(on_malformed)),
      counters_(counters),
      keys_(keys) {}

// A transport's thread must go on, so a message for which there is no memory is dropped, as if it had not come.
bool PoseInput::receive(std::string_view key, std::string_view payload, const Sender& sender) try {
  const Rate rate = count(key.size() + payload.size(), sender);
  if (rate == Rate::kWithin) parse(key, payload, sender);
  return rate != Rate::kFlood;
} catch (const std::bad_alloc&) {
  return true;
}

void PoseInput::parse(std::string_view key, std::string_view payload, const Sender& sender) {
  const auto address = parse_pose_key(server_, key);
  if (!address) return refuse_of(sender, {}, "the key is not one of this server's pose keys");
  if (payload.size() > limits::kMaxPoseMessageBytes) {
    counters_.count_refusal(sender.carrier, Refusal::kMessageSize);
    return refuse_of(sender, address->scene, "longer than kMaxPoseMessageBytes");
  }
  // protobuf parses zero bytes as a pose without a position, so a successful parse alone proves nothing.
  v1::ToolPose pose;
  if (!pose.ParseFromArray(payload.data(), static_cast<int>(payload.size())) || !pose.has_position_m()) {
    return refuse_of(sender, address->scene, "not a ToolPose with a position");
  }
  on_pose_(address->scene, address->tool, pose, sender);
}

bool PoseInput::receive_framed(std::string_view bytes, const Sender& sender) try {
  const Rate rate = count(bytes.size(), sender);
  if (rate == Rate::kWithin) parse_framed(bytes, sender);
  return rate != Rate::kFlood;
} catch (const std::bad_alloc&) {
  return true;
}

bool PoseInput::refuse_frames(std::size_t bytes, const Sender& sender) try {
  const Rate rate = count(bytes, sender);
  if (rate == Rate::kWithin) refuse_of(sender, {}, "more than one frame");
  return rate != Rate::kFlood;
} catch (const std::bad_alloc&) {
  return true;
}

void PoseInput::forget(const Sender& sender) { rate_of(sender).forget(sender.number); }

void PoseInput::parse_framed(std::string_view bytes, const Sender& sender) {
  const std::size_t end_of_key = bytes.find('\0');
  if (end_of_key == std::string_view::npos) return refuse_of(sender, {}, "no zero byte after the key");
  const std::string_view key = bytes.substr(0, end_of_key);
  if (keys_ != nullptr && !may_move(sender, key)) return;
  parse(key, bytes.substr(end_of_key + 1), sender);
}

PoseInput::Rate PoseInput::count(std::size_t bytes, const Sender& sender) {
  using Verdict = PoseRate::Verdict;
  const Verdict verdict = rate_of(sender).take(sender.number, bytes, std::chrono::steady_clock::now());
  if (verdict == Verdict::kTaken) return Rate::kWithin;
  counters_.count_refusal(sender.carrier, Refusal::kPoseRate);
  const auto tell = [&](std::string_view what, std::string_view reason, bool is_closed = false) {
    on_malformed_({.who = sender.who(), .what = what, .reason = reason, .is_closed = is_closed});
  };
  if (verdict == Verdict::kDroppedAndTold) {
    tell(what_of(sender.carrier),
         "more than kMaxPosesPerSecond poses or kMaxPoseBytesPerSecond of a client; the others are dropped");
  }
  if (verdict == Verdict::kFloodAndTold) {
    tell(sender.carrier == Carrier::kZeroMq ? "a flood of poses over ZeroMQ" : "a flood of poses over zenoh",
         "kMaxPoseLeadS ahead of kMaxPosesPerSecond or kMaxPoseBytesPerSecond; its client was disconnected", true);
  }
  const bool floods = verdict == Verdict::kFlood || verdict == Verdict::kFloodAndTold;
  return floods ? Rate::kFlood : Rate::kBeyond;
}

bool PoseInput::may_move(const Sender& sender, std::string_view key) {
  const auto address = parse_pose_key(server_, key);
  const access::ClientPtr client = keys_->find(sender.client);
  if (client == nullptr) {
    refuse_of(sender, {}, "a pose of a client whose key was removed or has expired");
  } else if (!address) {
    refuse_of(sender, {}, "the key is not one of this server's pose keys");
  } else if (!access::allows(&access::kPuts.front(), client->subject(), address->scene, address->tool)) {
    counters_.count_refusal(Carrier::kZeroMq, Refusal::kAccess);
    refuse_of(sender, address->scene, "a pose for a tool that its client's key does not move");
  } else {
    return true;
  }
  return false;
}

void PoseInput::refuse_of(const Sender& sender, std::string_view scene, std::string_view reason) {
  refuse({.who = sender.who(), .what = what_of(sender.carrier), .scene = scene, .reason = reason});
}

void PoseInput::refuse(const Refused& refused) try {
  malformed_.fetch_add(1, std::memory_order_relaxed);
  on_malformed_(refused);
} catch (const std::bad_alloc&) {
}

}  // namespace tensormass::bus
