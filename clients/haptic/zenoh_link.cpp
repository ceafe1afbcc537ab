#include "haptic/zenoh_link.h"

#include <string>
#include <utility>

#include "bus/zenoh/session.h"
#include "haptic/clock.h"

namespace tensormass::haptic {
namespace {

class ZenohLink final : public Link {
 public:
  ZenohLink(zenoh::Session session, std::string pose_key)
      : session_(std::move(session)), pose_key_(std::move(pose_key)) {}

  Result<void> subscribe(const std::string& feedback_key) {
    auto subscriber = session_.subscribe(
        feedback_key, [this](std::string_view, std::string_view payload) { inbox_.offer(payload, clock_.now_ns()); });
    if (!subscriber) return tl::make_unexpected(std::move(subscriber.error()));
    subscriber_ = std::move(*subscriber);
    return {};
  }

  bool send(const OutgoingPose& pose) override {
    encode_pose(pose, payload_);
    return session_.put(pose_key_, payload_, true);
  }

  std::optional<Feedback> receive() override { return inbox_.take(); }
  std::uint64_t malformed() const override { return inbox_.malformed(); }

 private:
  MonotonicClock clock_;
  FeedbackInbox inbox_;
  zenoh::Session session_;
  std::string pose_key_;
  std::string payload_;
  // Declared last, so that it is destroyed first: its handler uses the members above.
  zenoh::Subscriber subscriber_;
};

}  // namespace

Result<std::unique_ptr<Link>> connect_zenoh(const LinkAddress& address) {
  if (address.zenoh_locator.empty()) {
    return fail(ErrorCode::kUnavailable, "the server has zenoh off; use --transport zeromq");
  }
  zenoh::SessionOptions options;
  options.connect = address.zenoh_locator;
  options.authority = address.keys.authority;
  options.certificate = address.keys.certificate;
  options.private_key = address.keys.private_key;
  options.shared_memory = false;  // a pose is 100 bytes
  auto session = zenoh::Session::open(options);
  if (!session) return tl::make_unexpected(std::move(session.error()));
  auto link = std::make_unique<ZenohLink>(std::move(*session), address.pose_key);
  if (auto subscribed = link->subscribe(address.feedback_key); !subscribed) {
    return tl::make_unexpected(std::move(subscribed.error()));
  }
  return link;
}

}  // namespace tensormass::haptic
