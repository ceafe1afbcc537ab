#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <mutex>
#include <string_view>

#include "core/result.h"
#include "tensormass/v1/stream.pb.h"
#include "world/latest.h"
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
/// inbox refuses a pose that is not newer than the client's last.
class PoseInbox {
 public:
  /// Keeps a pose for the loop. Refuses one that is not finite, whose orientation is not a rotation, whose joint
  /// values are neither absent nor one for each joint, whose valid_for_s is out of range, or that is not newer than the
  /// same client's last. A pose with neither client nor sequence comes from a script and is always newer.
  Result<void> submit(const model::ToolModel& tool, const v1::ToolPose& message);
  /// For the loop: the newest pose since the last call, else nullptr. Valid until the next call.
  const ReceivedPose* take() { return newest_.take(); }

  std::uint64_t received() const { return received_.load(std::memory_order_relaxed); }
  std::uint64_t rejected() const { return rejected_.load(std::memory_order_relaxed); }
  std::uint64_t superseded() const { return superseded_.load(std::memory_order_relaxed); }

 private:
  struct Client {
    std::uint64_t id = 0;
    std::uint64_t last_sequence = 0;  // 0: this entry is free
  };
  /// Says whether a pose is newer than its client's last, and remembers its sequence if so. Needs the lock.
  bool is_newer(const v1::ToolPose& message);

  /// Number of clients whose sequence is remembered. A further client takes the place of the one that came first.
  static constexpr std::size_t kClients = 8;

  std::mutex writers_;  // guards clients_, next_client_ and the writer's side of newest_
  std::array<Client, kClients> clients_{};
  std::size_t next_client_ = 0;
  Latest<ReceivedPose> newest_;
  std::atomic<std::uint64_t> received_{0}, rejected_{0}, superseded_{0};
};

}  // namespace tensormass::world
