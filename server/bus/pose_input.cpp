#include "bus/pose_input.h"

#include <chrono>
#include <new>
#include <utility>

#include "bus/keys.h"
#include "core/limits.h"

namespace tensormass::bus {

PoseInput::PoseInput(std::string server, PoseHandler on_pose, MalformedHandler on_malformed, BusCounters& counters,
                     const access::KeyRing* keys)
    : server_(std::move(server)),
      on_pose_(std::move(on_pose)),
      on_malformed_(std::move(on_malformed)),
      counters_(counters),
      keys_(keys) {}

// A transport's thread must go on, so a message for which there is no memory is dropped, as if it had not come.
void PoseInput::receive(std::string_view key, std::string_view payload, const Sender& sender) try {
  if (is_within_rate(sender)) parse(key, payload, sender.carrier);
} catch (const std::bad_alloc&) {
}

void PoseInput::parse(std::string_view key, std::string_view payload, Carrier carrier) {
  const auto address = parse_pose_key(server_, key);
  if (!address) return refuse({}, "the key is not one of this server's pose keys");
  if (payload.size() > limits::kMaxPoseMessageBytes) {
    counters_.count_refusal(carrier, Refusal::kMessageSize);
    return refuse(address->scene, "longer than kMaxPoseMessageBytes");
  }
  // protobuf parses zero bytes as a pose without a position, so a successful parse alone proves nothing.
  v1::ToolPose pose;
  if (!pose.ParseFromArray(payload.data(), static_cast<int>(payload.size())) || !pose.has_position_m()) {
    return refuse(address->scene, "not a ToolPose with a position");
  }
  on_pose_(address->scene, address->tool, pose);
}

void PoseInput::receive_framed(std::string_view bytes, const Sender& sender) try {
  if (!is_within_rate(sender)) return;
  const std::size_t end_of_key = bytes.find('\0');
  if (end_of_key == std::string_view::npos) return refuse({}, "no zero byte after the key");
  const std::string_view key = bytes.substr(0, end_of_key);
  if (keys_ != nullptr && !may_move(sender.client, key)) return;
  parse(key, bytes.substr(end_of_key + 1), sender.carrier);
} catch (const std::bad_alloc&) {
}

bool PoseInput::is_within_rate(const Sender& sender) {
  const PoseRate::Verdict verdict =
      rates_[static_cast<std::size_t>(sender.carrier)].take(sender.number, std::chrono::steady_clock::now());
  if (verdict == PoseRate::Verdict::kTaken) return true;
  counters_.count_refusal(sender.carrier, Refusal::kPoseRate);
  if (verdict == PoseRate::Verdict::kDroppedAndTold) {
    on_malformed_({}, sender.client.empty()
                          ? std::string("more than kMaxPosesPerSecond poses of a client; the others are dropped")
                          : "more than kMaxPosesPerSecond poses of the client '" + std::string(sender.client) +
                                "'; the others are dropped");
  }
  return false;
}

bool PoseInput::may_move(std::string_view id, std::string_view key) {
  const auto address = parse_pose_key(server_, key);
  const access::ClientPtr client = keys_->find(id);
  if (client == nullptr) {
    refuse({}, "a pose of a client whose key was removed or has expired");
  } else if (!address) {
    refuse({}, "the key is not one of this server's pose keys");
  } else if (!access::allows(&access::kPuts.front(), client->subject(), address->scene, address->tool)) {
    counters_.count_refusal(Carrier::kZeroMq, Refusal::kAccess);
    refuse(address->scene, "a pose for a tool that its client's key does not move");
  } else {
    return true;
  }
  return false;
}

void PoseInput::refuse(std::string_view scene, std::string_view reason) try {
  malformed_.fetch_add(1, std::memory_order_relaxed);
  on_malformed_(scene, reason);
} catch (const std::bad_alloc&) {
}

}  // namespace tensormass::bus
