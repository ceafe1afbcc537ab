#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "core/assert.h"
#include "model/edit.h"
#include "model/model.h"
#include "world/enclosure.h"
#include "world/guard.h"
#include "world/news.h"
#include "world/node_state.h"
#include "world/sweeps.h"
#include "world/tool.h"

namespace tensormass::world {

/// One scene that steps: its state on a backend, its tools, its time and its guard. Used by one thread; Loop owns it
/// and does everything about other threads. A step allocates nothing:
///
///     move tools towards their targets -> save checkpoint, run the stages on the backend -> guard -> read tools
///                                          ^                                                 |
///                                          +---- restore checkpoint, next retry (guard.h) <--+ a bound was left
///
/// Retries take smaller steps, then fallback settings; a hand that feels tissue does not wait for those. If none helps,
/// tools that a hand moves back off (hold.h), then let go of the tissue. If that does not help either, the tissue is
/// held: the step ends with the state at which it began, at rest. A scene that stops on faults, or whose tissue is held
/// for kLongestHeldS on end, stays at the checkpoint: the end of the last good step.
///
/// A step is also made again if it leaves a load that a tool does not bear. The tool then gives way.
///
/// A step that is linearized once uses the consistent stiffness. It may be indefinite, in strong compression. If
/// conjugate gradients find that, or the guard does not trust the step, it is repeated with the stiffness projected to
/// positive definite. The following steps then project it too, for as long as Projection says. So do steps in which a
/// tool touches: a tool that moves far within a step compresses elements so much that the consistent stiffness throws
/// them, and conjugate gradients need not notice.
///
///     dt        length of a step [s]
///     part      one of the equal parts of dt that a retry makes; a step as planned is one part
///     shape     pose of a tool's shape (tool.h)
class World {
 public:
  static Result<std::unique_ptr<World>> create(std::shared_ptr<const model::Model> model,
                                               const backend::Backend& backend);

  const model::Model& model() const { return *model_; }
  /// For threads that need the model for longer than this world may live. It has the present values and is as loaded
  /// otherwise: edits change a copy, which is model().
  const std::shared_ptr<const model::Model>& shared_model() const { return loaded_; }

  /// Version of the v1::Topology that describes the visible surface; frames repeat it.
  std::uint64_t topology_version() const { return topology_version_; }
  /// Call it between two steps.
  void set_topology_version(std::uint64_t version) { topology_version_ = version; }

  /// Returns the pose that a tool moves to.
  const Pose& tool_target(std::size_t tool) const { return tools_[tool].target(); }
  /// stamp: of the pose's message; the tool's next reading repeats it. valid_for_s, level: as in ReceivedPose.
  void set_tool_target(std::size_t tool, const Pose& pose, const PoseStamp& stamp = {},
                       double valid_for_s = kUntilTheNext, double level = 0) {
    TM_ASSERT(tool < tools_.size(), "a pose is for a tool of the scene");
    tools_[tool].set_target(pose, valid_for_s, level);
    readings_[tool].newest = stamp;
  }

  /// What the next step depends on, besides its inputs and the state of the tissue.
  struct SavedBesideTissue {
    struct Tool {
      ToolMotion::Saved motion;
      PoseStamp newest;          ///< stamp of the newest pose, without its arrival
      backend::ToolForce force;  ///< at the end of the last step
      double unspent_j = 0;      ///< energy that its tip has brought along for the next element
    };
    std::uint64_t step_count = 0;
    std::vector<Tool> tools;
    EnergyBalance::Entries energy;
    std::uint32_t projection_left = 0, projection_length = 0, projection_good = 0;  ///< see Projection
    std::uint32_t cg_limit = 0;
    std::uint32_t held_steps = 0;  ///< steps on end in which the tissue was held
    bool recovering = false;       ///< see World::recovering
    double stuck_s = 0;            ///< grows with each step of a recovery, falls with each other one
    bool bodies_touch = false;     ///< bodies touched each other at the end of the last step
    model::Editor::Shares shares;  ///< what edits have left
  };
  /// Everything that the next step depends on, besides the inputs of that step.
  struct Saved : SavedBesideTissue {
    NodeState tissue;
  };
  /// The same in the order of this world's layout. The thread of the loop copies it, and others do the rest.
  struct Copied : SavedBesideTissue {
    LayoutState tissue;
  };
  static Saved by_node(const model::Model& model, const Copied& copied) {
    return {copied, world::by_node(model, copied.tissue)};
  }
  static Copied in_layout(const model::Model& model, const Saved& saved) {
    return {saved, world::in_layout(model, saved.tissue)};
  }
  /// Has the next step evaluate all elements, if tangents lag. Call it once a state was copied that may be restored: a
  /// world that goes on from it does the same, so both go on alike.
  void evaluate_all_next() { evaluates_all_next_ = model_->lags(); }
  bool evaluates_all_next() const { return evaluates_all_next_; }
  /// Copies the state. Allocates; for requests.
  Copied copy();
  Saved save() { return by_node(*loaded_, copy()); }
  /// Says in words why edits of this scene cannot have left what a saved state says.
  Result<void> check_shares(const SavedBesideTissue& saved) const;
  /// Goes on from a state of the same scene, whatever backend or number of threads it was saved on.
  void restore(const Saved& saved) { restore(in_layout(*loaded_, saved)); }
  /// Goes on from a state in the order of this world's layout.
  void restore(const Copied& copied);
  /// Other values of this world's scene, ready on its device.
  struct Values {
    std::shared_ptr<const model::Model> model;  ///< made by model::with_values; after take_values the one before
    std::unique_ptr<backend::PreparedEdit> buffers;
    Guard guard;
    std::optional<model::EditedValues> edited;  ///< the scene has editing
  };
  /// Makes other values ready while the scene steps. Any thread may call it, if no other changes values meanwhile.
  /// Throws what SceneState::prepare throws.
  Values prepare_values(std::shared_ptr<const model::Model> next) const;
  /// Goes on from the present state with other values. The elastic energy is then another one, so the energy balance
  /// starts anew. Throws nothing but what the device throws.
  void take_values(Values& values);

  /// Goes on from a state that a world of another material saved. Its elastic energy is another one, so the energy
  /// balance starts anew.
  void take_over(const Saved& saved);

  /// Ablates elements and severs springs, before the next step. Fails, and changes nothing, if one of them cannot be
  /// done (model::Editor::check).
  ///
  ///   springs   in the order of the scene's attachments
  Result<void> edit(std::span<const model::Ablation> ablations, std::span<const std::uint32_t> springs);
  /// Lets guards allow the energy that added attachments brought when they came [J].
  void allow_springs(double energy_j) { guard_.allow_springs(energy_j); }
  /// What edits have done since the start or the last reset; nullptr: the scene has no editing.
  const model::Editor* editor() const { return editor_ ? &*editor_ : nullptr; }
  /// What edits and tools have taken from each body since then, [body]. Empty: the scene has no editing.
  std::span<const RemovedTissue> removed() const { return removed_; }
  /// What blades have swept since the last cut was made of it.
  BladeSweeps& sweeps() { return sweeps_; }
  const BladeSweeps& sweeps() const { return sweeps_; }
  /// Springs that broke in the last step or edit. A reset and a restored state break none.
  std::span<const BrokenSprings> newly_broken() const { return newly_broken_; }
  /// Returns the position of a tool's tip [m].
  Vec3<double> tip_m(std::size_t tool) const { return tools_[tool].shape_of(tools_[tool].pose()).position_m; }

  std::uint32_t cg_limit() const { return cg_limit_; }

  /// Simulated time for which the tissue is held on end, at most [s].
  static constexpr double kLongestHeldS = 0.1;

  /// Makes a step. Returns false if the scene must stop: the world is then as before the call. Throws
  /// backend::StepStopped after `stop`.
  bool step(bool gather_visible);
  /// Ends a step under way soon, and every later one. Any thread may call it.
  void stop() { state_->stop(); }
  /// Limits the iterations of a solve from the next step on, to at most the model's. Retries ignore the limit.
  void set_cg_limit(std::uint32_t cg_max_iterations) {
    TM_ASSERT(cg_max_iterations <= model_->cg_max_iterations, "a budget lowers the model's iterations");
    cg_limit_ = cg_max_iterations;
  }
  /// Whether the last step could not be made as planned, so that tools backed off, let go or were taken out, or the
  /// tissue was held. It has a guard event then.
  bool recovering() const { return recovering_; }
  /// Event of the last step if it left its bounds, else nullptr.
  const GuardEvent* guard_event() const { return has_event_ ? &event_ : nullptr; }
  /// Computes strains, det F and elastic energy of all elements. Too slow for every step.
  void diagnose();
  /// Back to the start: displacement, velocity, time, tools.
  void reset();

  std::uint64_t step_count() const { return step_count_; }
  double simulated_time_s() const { return static_cast<double>(step_count_) * model_->dt_s; }
  const solver::StepResult& last() const { return last_; }
  const EnergyBalance& energy() const { return energy_; }
  std::span<const ToolReading> readings() const { return readings_; }
  /// Results of the last `diagnose`; [group_count].
  std::span<const backend::GroupDiagnostics> diagnostics() const { return diagnostics_; }

  /// Broken springs after the last step, as in Frame.broken_springs: [⌈spring_count / 8⌉] bytes.
  std::span<const std::uint8_t> broken_springs() const { return broken_bits_; }
  /// Positions that were last gathered, [visible_count, 3] m, then those of appended vertices and the room for more.
  std::span<const float> visible_positions() { return state_->visible_positions(); }
  void gather_visible() { state_->gather_visible(); }
  /// All nodes of a body as loaded, in the order of its mesh, [node_count, 3] m. Allocates; for requests.
  std::vector<double> positions(const model::BodyModel& body);
  /// Displacement, velocity and internal variables. Allocates; for requests.
  backend::RowState state() { return state_->read(); }

 private:
  World(std::shared_ptr<const model::Model> loaded, std::unique_ptr<model::Model> edited,
        std::unique_ptr<backend::SceneState> state);
  void write_start();
  Result<void> check_springs(std::span<const std::uint32_t> springs) const;
  void take_edited_surfaces();
  void take_shares(const model::Editor::Shares& shares);
  void apply(std::span<const model::Ablation> ablations, std::uint32_t tool = SceneEvent::kNone);
  void burn();
  double diagnose_elastic_energy();
  void place_tools();
  void read_tools();
  void read_broken();
  void add_news(std::uint32_t attachment, std::uint8_t state);
  static bool touches(std::span<const backend::ToolForce> forces);
  static bool jumps(const Vec3<double>& from_n, const Vec3<double>& to_n);
  bool starts_anew(bool jumped) const;
  bool asks_for_euler(std::span<const backend::ToolForce> forces, bool bodies_touch) const;
  BoundCheck plan_step(bool gather_visible);
  BoundCheck check_loads(double rise) const;
  BoundCheck step_with_tools_moved(BoundCheck check);
  void take_event(const BoundCheck& check);
  bool take_tools_out();
  Pose place_outside(std::size_t tool) const;
  bool can_back_off(std::size_t tool) const;
  bool may_recover(const BoundCheck& check) const;
  BoundCheck recover(BoundCheck check);
  BoundCheck repeat_step(std::uint32_t parts);
  void hold_tissue();
  BoundCheck retry(const BoundCheck& first);
  BoundCheck make_step(const Retry& how, bool projects_stiffness, std::uint32_t cg_max_iterations,
                       bool saves_checkpoint, bool gather_visible);
  BoundCheck make_parts(const Retry& how, bool projects_stiffness, std::uint32_t cg_max_iterations,
                        bool saves_checkpoint, bool gather_visible);

  /// A tool's shape and the load on it. Two of them give the work of the tool in between.
  struct Touch {
    Pose shape;
    backend::ToolForce load;
  };

  /// Counts the steps that project the stiffness after the consistent one failed. Each failure doubles them, so that
  /// few steps are made twice in a scene that stays indefinite. As many steps without a failure halve them again.
  class Projection {
   public:
    bool active() const { return left_ > 0; }
    /// Call if the consistent stiffness failed.
    void begin() {
      length_ = std::min(2 * length_, kMax);
      left_ = length_;
      good_ = 0;
    }
    /// Call after a step. consistent: it was made with the consistent stiffness.
    void end_step(bool consistent) {
      if (left_ > 0) --left_;
      if (!consistent || ++good_ < length_) return;
      length_ = std::max(length_ / 2, kLeast / 2);
      good_ = 0;
    }

    void save(SavedBesideTissue& to) const {
      to.projection_left = left_;
      to.projection_length = length_;
      to.projection_good = good_;
    }
    void restore(const SavedBesideTissue& from) {
      left_ = std::min(from.projection_left, kMax);
      length_ = std::clamp(from.projection_length, kLeast / 2, kMax);
      good_ = std::min(from.projection_good, kMax);
    }

   private:
    static constexpr std::uint32_t kLeast = 32, kMax = 1024;  // steps
    std::uint32_t left_ = 0, length_ = kLeast / 2, good_ = 0;
  };

  std::shared_ptr<const model::Model> first_;   // the values that the state was created with; tools refer to it
  std::shared_ptr<const model::Model> loaded_;  // the present values
  std::unique_ptr<model::Model> edited_;        // what edits have made of it; nullptr: the scene has no editing
  const model::Model* model_;                   // the one that steps
  std::unique_ptr<backend::SceneState> state_;
  std::optional<model::Editor> editor_;  // no value: the scene has no editing
  model::ModelEdit severed_;             // springs of the present edit
  std::vector<double> unspent_j_;        // [tool] see Saved::Tool
  std::vector<std::uint32_t> spared_;    // [tool] element that the tip may not burn, else mesh::kNone
  std::vector<ToolMotion> tools_;
  std::vector<backend::ToolForce> published_;  // [tool], at the end of the last step
  bool contact_jumped_ = false;                // in the last step, or its last part
  bool trial_jumped_ = false;                  // the same of the step that is tried
  bool bodies_touch_ = false;                  // at the end of the last step
  bool evaluates_all_next_ = false;            // evaluate_all_next
  bool evaluates_all_ = false;                 // the same of the current step
  bool by_euler_ = false;                      // the current step is one of implicit Euler, whatever the integrator
  // The current step, [tool].
  std::vector<backend::ToolInput> inputs_;  // at the end of the current part
  std::vector<Touch> touches_;              // at the end of the previous part
  std::vector<backend::ToolForce> forces_;
  std::vector<backend::ToolForce> tried_;  // those of the last trial before tools backed off
  std::vector<ToolReading> readings_;
  std::vector<backend::GroupDiagnostics> diagnostics_;
  Enclosure enclosure_;
  Guard guard_;
  EnergyBalance energy_;
  double tools_work_j_ = 0;  // work of the tools in the current step
  bool recovering_ = false;
  std::uint32_t held_steps_ = 0;  // on end, up to the last step
  double stuck_s_ = 0;            // as Saved has it
  Projection projection_;
  bool trusted_ = true;  // Guard::trusts of the last part
  GuardEvent event_;
  bool has_event_ = false;
  std::uint32_t cg_limit_;
  solver::StepResult last_;
  std::vector<std::uint8_t> broken_;  // [spring] as SceneState::read_broken writes it
  std::vector<std::uint8_t> broken_bits_;
  std::uint32_t broken_count_ = 0;  // bits that are set
  std::vector<BrokenSprings> newly_broken_;
  std::vector<RemovedTissue> removed_;
  std::vector<backend::BladeFront> fronts_;  // [points of all blades] of the last step
  BladeSweeps sweeps_;
  std::uint64_t step_count_ = 0;
  std::uint64_t topology_version_ = 0;
};

}  // namespace tensormass::world
