#pragma once

#include <atomic>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <utility>
#include <vector>

#include "core/thread_name.h"
#include "model/spare_model.h"
#include "world/adjustments.h"
#include "world/compiled_scene.h"
#include "world/edits.h"
#include "world/loop.h"
#include "world/messages.h"
#include "world/runner.h"

namespace tensormass::world {

/// The message of a scene and how it was compiled, for `adjust`.
struct Source {
  v1::Scene scene;
  RunnerOptions options;
};

/// The loop, and what stays constant while the scene is loaded.
///
/// An adjustment swaps the loop's world between two steps. What a caller gets of a state comes with the generation of
/// that state, so nobody waits for an adjustment.
struct Runner::Impl {
  Impl(CompiledScene compiled, std::unique_ptr<World> world, std::unique_ptr<const Source> from)
      : report(std::move(compiled.report)),
        device{compiled.backend->name(), compiled.backend->device(), report.device()},
        max_patches(compiled.max_patches),
        source(std::move(from)),
        name(world->model().name) {
    auto topology = std::make_shared<const v1::Topology>(make_topology(world->model(), new_topology_version()));
    world->set_topology_version(topology->version());
    auto generation =
        std::make_shared<const Generation>(Generation{0,
                                                      world->shared_model(),
                                                      compiled.scene_hash,
                                                      source ? adjustments_of(source->scene) : v1::SceneAdjustments{},
                                                      false,
                                                      {},
                                                      new_inboxes(world->model().tools.size()),
                                                      std::move(topology)});
    loop = std::make_unique<Loop>(device, std::move(world), std::move(generation));
    if (compiled.place) {
      place = std::move(compiled.place);
      place->follow([this] { return measured_share(); });
    }
    if (has_blades() && !loop->generation()->model->lockstep) changer.start(*this);
  }

  /// The share of its device that the scene takes: measured, or estimated before the first step. A scene in lockstep
  /// may take all of it whenever it is asked to step.
  double measured_share() const {
    const GenerationPointer present = loop->generation();
    const model::Model& model = *present->model;
    const double measured_s = loop->status().statistics()->percentiles().p50_s;
    const double step_s = measured_s > 0 ? measured_s : 1 / report.expected_rate_hz();
    return share_of_device(model.layout.patch_count, max_patches, model.lockstep ? 0 : model.rate_hz, step_s);
  }

  /// Runs a command on the loop's thread and waits for its result.
  /// command: Result<T>(Loop&)
  template <class Command>
  auto call(const Command& command) {
    return loop->call([&] { return command(*loop); });
  }

  /// The same for a command that changes nothing.
  template <class Command>
  auto read(const Command& command) {
    return loop->read([&] { return command(*loop); });
  }

  /// Does an edit of the list in edits.h.
  Result<v1::SceneStatus> apply(const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Adjust& adjust, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Restore& restore, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Reset& reset, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const ChangeScene& change, const EditPointer& edit);
  Result<void> take_values(v1::SceneAdjustments wanted);
  Result<void> write_values(std::uint64_t scene_hash, v1::SceneAdjustments wanted,
                            std::shared_ptr<const model::Model> model);
  GenerationPointer next_generation(const Generation& present, std::shared_ptr<const model::Model> model,
                                    std::uint64_t scene_hash, v1::SceneAdjustments wanted, model::SceneCuts cuts) const;
  Result<void> swap_world(v1::SceneAdjustments wanted, model::SceneCuts cuts, const EditPointer& reset = nullptr,
                          std::vector<v1::Finding>* findings = nullptr, std::size_t new_attachments = 0);
  Result<void> check_attachments(const v1::SceneAdjustments& wanted) const;
  Result<v1::SceneStatus> cut(const v1::SceneEdit& edit);
  Result<v1::SceneStatus> change_attachments(const v1::SceneEdit& edit);
  Result<v1::SceneStatus> change_tools(const v1::SceneEdit& edit, std::vector<v1::Finding>* findings);
  void refuse(std::string_view what, const Error& error) const;
  void forget_parts() {
    coming.reset();
    comes = false;
  }
  Result<v1::SceneStatus> step_in_parts(std::uint32_t count);
  Result<void> change_values(v1::SceneAdjustments wanted);
  Result<void> take_next_part();
  Result<void> take_due_part();
  Result<void> take_last_part();
  /// Returns the values that the scene has after the last part of a change. Needs `adjusting`.
  v1::SceneAdjustments wanted_values() const { return coming ? coming->wanted : loop->generation()->adjustments; }
  Result<void> take_cuts(model::SceneCuts cuts);
  Result<void> cut_what_was_swept();
  bool has_blades() const { return source != nullptr && loop->generation()->model->links.blades.count() > 0; }

  /// A change of stiffness that comes in parts.
  struct Coming {
    v1::SceneAdjustments wanted;
    std::uint64_t step = 0;  ///< after which the next part comes
  };

  /// Changes a scene that runs by the clock on a thread of its own: cuts what blades sweep, as long as something new
  /// was swept, and takes the parts of a change of values.
  class Changer {
   public:
    void start(Impl& of) {
      if (impl_ != nullptr) return;
      impl_ = &of;
      thread_ = std::thread([this] { run(); });
    }
    ~Changer() {
      if (impl_ == nullptr) return;
      ends_ = true;
      impl_->loop->stop_waiting();
      thread_.join();
    }

   private:
    void run() {
      name_thread("change");
      for (std::uint32_t seen = 0; !ends_;) {
        seen = impl_->loop->wait_for_work(seen);
        if (ends_ || impl_->loop->cancelled()) continue;
        if (const auto part = impl_->take_due_part(); !part) impl_->refuse("values", part.error());
        if (!impl_->has_blades()) continue;
        if (const auto cut = impl_->cut_what_was_swept(); !cut) impl_->refuse("cut", cut.error());
      }
    }

    Impl* impl_ = nullptr;
    std::atomic<bool> ends_{false};
    std::thread thread_;
  };

  const v1::SceneReport report;
  const SceneDevice device;
  const std::uint32_t max_patches;             // as of CompiledScene
  const std::unique_ptr<const Source> source;  // nullptr: the scene cannot be adjusted
  const std::string name;

  model::SpareModel spare;                  // for the next change of values
  std::mutex adjusting;                     // one change of values or cuts at a time
  std::optional<Coming> coming;             // guarded by `adjusting`
  std::atomic<bool> comes{false};           // `coming` has a value
  std::unique_ptr<Loop> loop;               // its thread ends before all of the above
  std::unique_ptr<Placement::Place> place;  // nullptr: nobody places it. Ends before the loop, which it asks
  Changer changer;                          // last: uses the loop
};

}  // namespace tensormass::world
