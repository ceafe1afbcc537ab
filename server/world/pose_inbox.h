#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <mutex>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "tensormass/v1/stream.pb.h"
#include "world/latest.h"
#include "world/pose_source.h"
#include "world/tool.h"

namespace tensormass::world {

/// The mailbox for the poses of one tool.
///
///     threads of the bus and of gRPC --> submit: check, lock, compare sequence --> Latest --> take: the scene's loop
///
/// Writers wait for each other, for less than a microsecond. The loop waits for nobody. A tool is where its newest pose
/// says, so a pose that the loop did not take before the next one arrived is dropped and counted as superseded.
///
/// Messages of one client may overtake each other on the way. Each client therefore numbers its poses from 1, and the
/// inbox refuses a pose that is not newer than the client's last. Everybody can read a client's id in the feedback. So
/// a client that must not be locked out has a session: a number that only it knows, whose sequences are its own.
///
/// A session claims the tool by a pose that says how long it is valid, if no other session claims it:
///
///     nobody's ── pose of session S, valid for t ──> claimed by S until t after its last pose, by real time
///        ^   ^                                           │  poses of others are refused, and told whose it is
///        │   └──── S sends a pose without t: hands over ─┤
///        └──────── t has passed ─────────────────────────┤
///                                                        └─ the operator's pose ──> nobody's or the operator's, and
///                                                           S is refused until it has sent nothing for t
class PoseInbox {
 public:
  /// Keeps a pose for the loop. Refuses one that is not finite, whose orientation is not a rotation, whose joint
  /// values are neither absent nor one for each joint, whose valid_for_s is out of range, or that is not newer than the
  /// same client's last. A pose with neither client nor sequence comes from a script and is always newer. A client's
  /// pose is also refused if another session claims the tool. now: when the pose arrived.
  Result<void> submit(const model::ToolModel& tool, const v1::ToolPose& message,
                      PoseSource source = PoseSource::kClient, Clock::time_point now = Clock::now());
  /// For the loop: the newest pose since the last call, else nullptr. Valid until the next call.
  const ReceivedPose* take() { return newest_.take(); }

  /// When the newest pose of a client that says how long its poses are valid arrived; the clock's zero before the
  /// first.
  Clock::time_point newest_arrival() const { return Clock::time_point(Clock::duration(newest_arrival_.load())); }

  std::uint64_t received() const { return received_.load(std::memory_order_relaxed); }
  std::uint64_t rejected() const { return rejected_.load(std::memory_order_relaxed); }
  std::uint64_t superseded() const { return superseded_.load(std::memory_order_relaxed); }

 private:
  struct Client {
    std::uint64_t id = 0;  // its session, or the client's id if it has none
    bool has_session = false;
    std::uint64_t last_sequence = 0;  // 0: this entry is free
  };
  struct Claim {
    std::uint64_t session = 0;  // 0: nobody's
    std::uint64_t client_id = 0;
    Clock::time_point until{};

    bool is_of(const v1::ToolPose& message) const { return session != 0 && session == message.session(); }
    bool holds(Clock::time_point now) const { return session != 0 && now < until; }
  };
  /// Says whether a pose is newer than its client's last, and remembers its sequence if so. Needs the lock.
  bool is_newer(const v1::ToolPose& message);
  /// Refuses a client's pose if the tool is another's, or was taken from it. expiry: of the pose. Needs the lock.
  Result<void> may_move(const v1::ToolPose& message, std::string_view where, Clock::time_point now,
                        Clock::time_point expiry);
  /// Says whether the pose claims the tool, and remembers that. Needs the lock.
  bool claim(const v1::ToolPose& message, PoseSource source, Clock::time_point now, Clock::time_point expiry);

  /// Number of sessions and clients whose sequence is remembered. A further one takes the place of the first.
  static constexpr std::size_t kClients = 8;

  std::mutex writers_;  // guards clients_, next_client_, claim_, taken_ and the writer's side of newest_
  std::array<Client, kClients> clients_{};
  std::size_t next_client_ = 0;
  Claim claim_;
  Claim taken_;  // the claim that the operator ended; renewed by each pose that it sends all the same
  Latest<ReceivedPose> newest_;
  std::atomic<Clock::rep> newest_arrival_{0};
  std::atomic<std::uint64_t> received_{0}, rejected_{0}, superseded_{0};
};

/// The inboxes of a scene, [tool]. Shared, because a tool may be gone before a thread has left a pose for it.
using PoseInboxes = std::vector<std::shared_ptr<PoseInbox>>;

/// Returns inboxes for so many tools that are new.
inline PoseInboxes new_inboxes(std::size_t tool_count) {
  PoseInboxes out(tool_count);
  for (std::shared_ptr<PoseInbox>& inbox : out) inbox = std::make_shared<PoseInbox>();
  return out;
}

/// Poses of a scene that no inbox counts any more.
struct PoseCounts {
  std::atomic<std::uint64_t> malformed{0};                             ///< that none could take
  std::atomic<std::uint64_t> received{0}, rejected{0}, superseded{0};  ///< for tools that are gone

  /// Takes the counts of a tool that goes.
  void add(const PoseInbox& inbox) {
    received.fetch_add(inbox.received(), std::memory_order_relaxed);
    rejected.fetch_add(inbox.rejected(), std::memory_order_relaxed);
    superseded.fetch_add(inbox.superseded(), std::memory_order_relaxed);
  }
};

}  // namespace tensormass::world
