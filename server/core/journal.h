#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string_view>

#include "core/log.h"

namespace tensormass {

/// A refusal: what was refused, and to whom. The texts may come from a client, and must live for a call only.
struct Refused {
  std::string_view who = {};    ///< the client's key, or without keys its address; empty: not known
  std::string_view what = {};   ///< a call, or in words what it sent
  std::string_view scene = {};  ///< empty: it was about none
  std::string_view reason = {};
  bool is_closed = false;  ///< who sent it was disconnected
};

/// One line in the log for each refusal: who asked for what in a scene, and the reason.
///
/// Strangers can cause lines at any rate, so each kind has one a second; the next one tells how many are missing. A
/// flood of one kind hides no other. Any thread may call it; nobody waits.
class Journal {
 public:
  enum class Kind : std::uint8_t { kRole, kCall, kPose, kMessage, kFlood, kConnection, kZenoh };

  /// event: "refused", or "closed" for a client that was disconnected.
  void note(Kind kind, std::string_view event, const Refused& refused) {
    const auto suppressed = limiters_[static_cast<std::size_t>(kind)].admit();
    if (!suppressed) return;
    log::warn(event, {{"who", refused.who.substr(0, kMaxText)},
                      {"what", refused.what.substr(0, kMaxText)},
                      {"scene", refused.scene.substr(0, kMaxText)},
                      {"reason", refused.reason.substr(0, kMaxReason)},
                      {"suppressed", *suppressed}});
  }

 private:
  static constexpr std::size_t kMaxText = 200, kMaxReason = 1000;
  std::array<log::Limiter, static_cast<std::size_t>(Kind::kZenoh) + 1> limiters_;
};

}  // namespace tensormass
