#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <vector>

#include "tensormass/v1/stream.pb.h"
#include "world/latest.h"
#include "world/messages.h"
#include "world/scene_counts.h"
#include "world/world.h"

/// The results of a scene's loop, and the mailboxes that carry them to other threads.
///
/// A step must never wait for a reader. Each reader therefore has a mailbox of its own that keeps the newest value
/// (latest.h), and a value that nobody took in time is dropped:
///
///     loop's thread                   mailbox                 reader
///
///     world -> stamp, tools --+--> frames            --> publisher: take_frame      a replaced frame is counted
///                             +--> feedback          --> publisher: take_feedback
///                             +--> status feedback   --> any thread: add_to         readers share a mutex
///     edits -> set_changes ---+--> changes           --> publisher: take_changes
///                             +--> shown changes     --> any thread: changes        readers share a mutex
///     add_event ---------------->  events            --> publisher: take_events
///
/// A frame holds the positions of the visible nodes [m], all tools and the broken springs. Feedback holds the tools
/// only, and goes out after every step, while frames go out at the rate of the scene's streams. Changes of the surface
/// and events hold everything so far, so a reader that misses some loses nothing.
namespace tensormass::world {

class LoopOutputs {
 public:
  /// `world` outlives the outputs, or the next call of go_on_with. Allocates all buffers, so that publishing allocates
  /// nothing.
  explicit LoopOutputs(World& world, std::shared_ptr<SceneCounts> counts = std::make_shared<SceneCounts>());

  // -- the loop's thread; these read the world ------------------------------------------------------------------------

  /// Goes on with another world of the same scene: same visible vertices. parts_change: its tools or attachments are
  /// others, or in another order.
  void go_on_with(World& world, bool parts_change = false) noexcept;
  /// Says to readers that the changes so far are those of the world's topology, which is another one with that surface.
  void repeat_changes();
  /// Copies step, time and tool readings from the world.
  void take_step(Clock::time_point began);
  /// Takes what became of the surface. Frames of the steps from here on have its revision, and the world's visible
  /// positions have its appended vertices. Nobody may change it any more. Whoever makes changes again and again keeps
  /// the old ones until use_count() is 1, so that the loop frees nothing.
  void set_changes(SurfaceChangesPointer changes);
  /// Adds an event and leaves it for the publisher, who learns of it with the next `publish`.
  void add_event(SceneEvent event);
  /// Adds the event of a recovery that began in the world's last step, or of a step that stopped the scene.
  void note_guard();
  /// Zeroes force, torque and stiffness of every tool: a scene that does not step must not push anyone's hand.
  void release_tools();

  bool has_frames() const { return world_->model().visible.count() > 0; }
  /// Has the world collect its visible positions, if there are any, unless its last step did so.
  void gather_frame();
  /// Leaves the results in the mailboxes and calls the signal.
  /// with_frame: leaves a frame as well; the world must have gathered its visible positions.
  void publish(bool with_frame);
  /// signal: void(), called on the loop's thread after each `publish` and once now. Must not block.
  void set_signal(std::function<void()> signal);

  const StepStamp& stamp() const { return stamp_; }
  /// The frame of this moment; gathers the visible positions. Needs has_frames().
  v1::Frame frame();
  v1::ToolFeedback feedback(std::size_t tool) const;

  // -- the publisher's thread -----------------------------------------------------------------------------------------

  /// Takes the newest frame; false if no step has made one since the last call. The frame has the topology version of
  /// its step, also if the world has a newer topology by now.
  bool take_frame(v1::Frame& frame);
  /// Takes the newest feedback of all tools; false if the last call took it, or if the scene has other tools or
  /// attachments by now: newer feedback is on its way then. The same holds for frames.
  bool take_feedback(std::vector<v1::ToolFeedback>& feedback);
  /// Takes the newest changes of the surface; false if they are those of the last call.
  bool take_changes(v1::SurfaceChanges& changes);
  /// Takes the last events; false if nothing happened since the last call.
  bool take_events(v1::SceneEvents& events);

  // -- any thread -----------------------------------------------------------------------------------------------------

  /// Fills in the newest changes of the surface; false if there were none.
  bool changes(v1::SurfaceChanges& changes) const;
  /// Adds the counts of frames and the newest feedback of all tools.
  void add_to(v1::SceneStatus& status) const;

 private:
  void leave_feedback();
  void leave_frame();
  void stamp_changes();
  void leave_changes();
  void leave_events();
  void count_answer(std::size_t tool, Clock::time_point arrived);

  /// What other threads read of the world that made the newest results.
  struct Shown {
    std::shared_ptr<const model::Model> model;
    std::uint32_t part_changes = 0;  // results with another number have other tools or attachments
  };
  Shown shown() const {
    const std::lock_guard lock(shown_mutex_);
    return shown_;
  }

  World* world_;  // the loop's
  mutable std::mutex shown_mutex_;
  Shown shown_;  // guarded by shown_mutex_
  const std::uint64_t first_topology_version_;
  // The loop's own copy of the newest results; readers get copies of it.
  StepStamp stamp_;
  ToolReadings tools_;
  SurfaceChangesPointer newest_changes_;
  EventLog log_;
  bool was_recovering_ = false;
  std::function<void()> signal_;

  Latest<FrameSlot> frames_;
  Latest<FeedbackSlot> feedback_;
  mutable std::mutex status_mutex_;  // guards the reader's side of the next two
  mutable Latest<FeedbackSlot> status_feedback_;
  mutable const FeedbackSlot* newest_status_feedback_ = nullptr;

  Latest<ChangesSlot> changes_;
  mutable std::mutex changes_mutex_;  // guards the reader's side of the next two
  mutable Latest<ChangesSlot> shown_changes_;
  mutable const ChangesSlot* newest_shown_changes_ = nullptr;
  Latest<EventsSlot> events_;

  const std::shared_ptr<SceneCounts> counts_;
  // The publisher's: [tool] arrival of the newest pose that was counted, and whose tools these are.
  std::array<Clock::time_point, limits::kMaxTools> answered_{};
  std::uint32_t answered_changes_ = 0;
  // frames_published_: those that the publisher took, which is the sequence of the last one.
  std::atomic<std::uint64_t> frames_published_{0}, frames_replaced_{0};
};

}  // namespace tensormass::world
