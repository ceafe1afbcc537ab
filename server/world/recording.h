#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "backend/backend.h"
#include "core/limits.h"
#include "core/recording_limits.h"
#include "model/model.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/recording.pb.h"
#include "world/edits.h"
#include "world/ring.h"
#include "world/tool.h"

/// The recording of a scene: what its steps take from outside, from the loop to one reader.
///
///     loop's thread                              rings                     reader (a thread of gRPC)
///
///     take_pose, take_edit ──> end_step ───────> steps, poses, edits ─┐
///     check_due ─> copy of the state ──────────> checks         ────┴─> take: messages, hashes
///
/// The loop never waits. A step that finds no room in a ring is lost, and the reader learns it from the gap in the
/// indices. The loop allocates nothing for a step. For a check it copies the state, as GetFields does; the reader
/// hashes the copy.
///
/// Edits come between two steps, and belong to the step that follows. The recording stays when a change replaces the
/// world. Poses know whose tools theirs are.
///
/// A scene has one recording. A reader looks for steps all the time, so one that has not for the length of a lease is
/// stuck: its client takes no bytes. Whoever wants to record then evicts it.
namespace tensormass::world {

struct RecordingOptions {
  std::uint32_t check_every_steps = 0;  ///< 0: no checks
  bool reset = false;                   ///< resets the scene first
  std::size_t room_for_steps = limits::kRecordedSteps;
  std::size_t room_for_checks = limits::kRecordedChecks;
  std::size_t room_for_edits = limits::kRecordedEdits;
  std::chrono::milliseconds lease = limits::kRecordingLease;
};

/// A step as it ended.
struct StepEnd {
  std::uint64_t step = 0;  ///< its number, also if it was rejected
  std::uint64_t server_time_ns = 0;
  std::uint32_t cg_limit = 0;
  bool diagnosed = false, rejected = false, recovered = false;
  bool evaluates_all = false;  ///< World::evaluate_all_next before it
};

/// What a recording keeps of a scene's tools.
struct RecordedTools {
  explicit RecordedTools(const model::Model& model);
  std::vector<std::string> names;
  std::vector<std::size_t> joints;  ///< number of each
};

class Recording {
 public:
  Recording(const model::Model& model, const RecordingOptions& options);

  // -- the loop's thread ----------------------------------------------------------------------------------------------

  /// Takes a target that the coming step takes. The last one for a tool counts.
  void take_pose(std::size_t tool, const ReceivedPose& received);
  /// An edit was done. Poses of steps that did not come are dropped if the state is another one now.
  void take_edit(DoneEdit done);
  /// The scene has other tools from here on. Poses of steps that did not come are dropped.
  void go_on_with(std::shared_ptr<const RecordedTools> tools) noexcept;
  /// Whether it can take another EditScene before the coming step.
  bool takes_change() const { return count_changes(coming_edits_) < kMaxChangesOfStep; }
  void end_step(const StepEnd& end);
  /// Says whether the state after the last step must be checked.
  bool check_due() const { return check_every_ > 0 && index_.load(std::memory_order_relaxed) % check_every_ == 0; }
  /// Takes a copy of the state after the last step.
  void take_check(std::uint64_t step, backend::RowState state, std::shared_ptr<const model::Model> model);
  /// No step follows.
  void close() { closed_.store(true, std::memory_order_release); }
  /// Says whether the reader has not looked for steps for the length of the lease.
  bool abandoned() const;
  /// Closes the recording because somebody else needs the scene, and calls what `on_evicted` has set.
  void evict();

  // -- the reader's thread --------------------------------------------------------------------------------------------

  bool closed() const { return closed_.load(std::memory_order_acquire); }
  /// Fills `response` with what came since the last call: at most kMaxSteps steps, and after kMaxEditBytes of edits
  /// no further step. Returns false if there is nothing. After `close`, one more false means the end.
  bool take(v1::RecordSceneResponse& response);
  /// Sets what frees the reader when it is evicted. Called on the loop's thread; must not block. Set nothing before
  /// what it uses ends: no call runs after this returns.
  void on_evicted(std::function<void()> free);
  bool evicted() const { return evicted_.load(std::memory_order_relaxed); }

  /// Steps in one message.
  static constexpr int kMaxSteps = 1000;
  /// Bytes of edits in one message, after which it ends.
  static constexpr std::size_t kMaxEditBytes = std::size_t{1} << 20;

 private:
  struct Step {
    StepEnd end;
    std::uint64_t index = 0;
    std::uint32_t poses = 0, edits = 0;
  };
  struct TakenPose {
    std::size_t tool = 0;
    ReceivedPose received;
    std::shared_ptr<const RecordedTools> tools;
  };
  struct Check {
    std::uint64_t index = 0, step = 0;
    backend::RowState state;
    std::shared_ptr<const model::Model> model;  ///< that of the state: a cut brings another one
  };
  bool has_room_for_step(std::size_t poses) const;
  void add_lost(std::uint64_t next, v1::RecordSceneResponse& response);
  std::size_t add_edits(const Step& step, v1::RecordedStep& out, v1::RecordSceneResponse& response);

  const std::uint32_t check_every_;
  const std::chrono::steady_clock::duration lease_;

  // The loop's own.
  std::shared_ptr<const RecordedTools> tools_;            // a copy, because the reader may outlive the scene
  std::array<ReceivedPose, limits::kMaxTools> coming_{};  // [tool]
  std::array<bool, limits::kMaxTools> has_coming_{};      // [tool]
  std::vector<DoneEdit> coming_edits_;

  Ring<Step> steps_;
  Ring<TakenPose> poses_;
  Ring<Check> checks_;
  Ring<DoneEdit> edits_;
  std::atomic<std::size_t> edit_bytes_{0};  // that wait in the ring
  std::atomic<std::uint64_t> index_{0};     // index of the last step, also if it was lost
  std::atomic<std::uint64_t> lost_checks_{0};
  std::atomic<bool> closed_{false}, evicted_{false};
  std::atomic<std::chrono::steady_clock::time_point> taken_{std::chrono::steady_clock::now()};  // last `take`
  std::mutex freeing_;
  std::function<void()> free_;  // guarded by freeing_

  std::uint64_t read_index_ = 0;  // the reader's: of the last step that it knows of
};

/// Makes the check of a state. row_of_node: matrix::Layout::row_of_node.
v1::StateCheck make_check(std::uint64_t index, std::uint64_t step, const backend::RowState& state,
                          std::span<const std::uint32_t> row_of_node);

/// Converts a pose of a tool with so many joints, and back. Reading refuses what a step must not see.
void write_pose(const std::string& tool, const ReceivedPose& received, std::size_t joints, v1::RecordedPose& out);
Result<ReceivedPose> read_pose(const v1::RecordedPose& message, const model::ToolModel& tool, std::string_view where);

}  // namespace tensormass::world
