#include "bus/pose_input.h"

#include <new>
#include <utility>

#include "bus/keys.h"
#include "core/limits.h"

namespace tensormass::bus {

PoseInput::PoseInput(std::string server, PoseHandler on_pose, MalformedHandler on_malformed,
                     const access::KeyRing* keys)
    : server_(std::move(server)), on_pose_(std::move(on_pose)), on_malformed_(std::move(on_malformed)), keys_(keys) {}

// A transport's thread must go on, so a message for which there is no memory is dropped, as if it had not come.
void PoseInput::receive(std::string_view key, std::string_view payload) try {
  const auto address = parse_pose_key(server_, key);
  if (!address) return refuse({}, "the key is not one of this server's pose keys");
  if (payload.size() > limits::kMaxPoseMessageBytes) return refuse(address->scene, "longer than kMaxPoseMessageBytes");
  // protobuf parses zero bytes as a pose without a position, so a successful parse alone proves nothing.
  v1::ToolPose pose;
  if (!pose.ParseFromArray(payload.data(), static_cast<int>(payload.size())) || !pose.has_position_m()) {
    return refuse(address->scene, "not a ToolPose with a position");
  }
  on_pose_(address->scene, address->tool, pose);
} catch (const std::bad_alloc&) {
}

void PoseInput::receive_framed(std::string_view bytes, std::string_view sender) {
  const std::size_t end_of_key = bytes.find('\0');
  if (end_of_key == std::string_view::npos) return refuse({}, "no zero byte after the key");
  const std::string_view key = bytes.substr(0, end_of_key);
  if (keys_ != nullptr && !may_move(sender, key)) return;
  receive(key, bytes.substr(end_of_key + 1));
}

bool PoseInput::may_move(std::string_view sender, std::string_view key) {
  const auto address = parse_pose_key(server_, key);
  const access::ClientPtr client = keys_->find(sender);
  if (client == nullptr) {
    refuse({}, "a pose of a client whose key was removed or has expired");
  } else if (!address) {
    refuse({}, "the key is not one of this server's pose keys");
  } else if (!access::allows(&access::kPuts.front(), client->subject(), address->scene, address->tool)) {
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
