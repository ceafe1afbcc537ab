#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <mutex>
#include <string_view>

#include "core/result.h"
#include "tensormass/v1/stream.pb.h"
#include "world/latest.h"
#include "world/world.h"

namespace tensormass::world {

/// A pose with what its feedback echoes.
struct ReceivedPose {
  Pose pose;
  std::uint64_t sequence = 0;
  std::uint64_t client_time_ns = 0;
  std::uint64_t client_id = 0;
};

/// Where the poses of one tool arrive: from any thread, checked, the newest kept for the loop.
class PoseInbox {
 public:
  /// Refuses a pose that is not finite, no rotation, or not newer than the last of the same client. A pose with neither
  /// client nor sequence is a script's and is always newer.
  Result<void> submit(std::string_view tool, const v1::ToolPose& message);
  /// For the loop: the newest since the last call, else nullptr.
  const ReceivedPose* take() { return newest_.take(); }

  std::uint64_t received() const { return received_.load(std::memory_order_relaxed); }
  std::uint64_t rejected() const { return rejected_.load(std::memory_order_relaxed); }
  std::uint64_t superseded() const { return superseded_.load(std::memory_order_relaxed); }

 private:
  struct Client {
    std::uint64_t id = 0;
    std::uint64_t last_sequence = 0;
  };
  bool is_newer(const v1::ToolPose& message);

  /// Clients whose sequence is remembered; the one that came first is forgotten for a new one.
  static constexpr std::size_t kClients = 8;

  std::mutex writers_;
  std::array<Client, kClients> clients_{};
  std::size_t next_client_ = 0;
  Latest<ReceivedPose> newest_;
  std::atomic<std::uint64_t> received_{0}, rejected_{0}, superseded_{0};
};

}  // namespace tensormass::world
