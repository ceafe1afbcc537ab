#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <limits>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "core/scalar.h"
#include "model/compile.h"
#include "model/edit.h"
#include "model/model.h"
#include "solver/step_result.h"
#include "step/plan.h"

/// A backend holds the data of scenes on a device and runs their stages there.
///
///   world (one thread a scene)          backend
///     StepInput ───────────────────────> SceneState::step ──> the stages of step/stages.h
///     StepResult, tool forces <──────────┘
///     restore, visible_positions, diagnose, read, write: between steps
///
/// 1. A Backend stands for a device, a SceneState for one scene on it. Both backends, CPU and CUDA, run the same stage
///    functions (step/run.h).
/// 2. The state of a scene stays on its device. Only inputs, reports and visible positions move in a step. After a step
///    in which springs broke, the caller also asks which.
/// 3. `read` and `write` copy the whole state, for requests of clients. They do not belong in the loop.
namespace tensormass::backend {

/// Force and torque of the tissue on a tool at the end of a step. The torque is about the origin of its shape's frame.
struct ToolForce {
  Vec3<double> force_n = Vec3<double>::Zero();
  Vec3<double> torque_n_m = Vec3<double>::Zero();
  Vec3<double> friction_n = Vec3<double>::Zero();       ///< the part of force_n that is friction
  std::array<double, limits::kMaxToolJoints> joints{};  ///< force of the tissue along each joint [N m or N]
  /// E and E / (1 − ν²) of the tissue that it touches, means weighted by pressure [Pa]; 0: it touches nothing.
  double young_modulus_pa = 0, plane_strain_modulus_pa = 0;
  /// The contact triangle that was closest to the tip of a thin tool where the step began, and its distance from the
  /// tip's centre. A solid, and a scene without contact triangles: mesh::kNone and infinity.
  std::uint32_t tip_triangle = mesh::kNone;
  double tip_distance_m = std::numeric_limits<double>::infinity();
};

/// A tool in a step: poses of its shape (model::ToolModel::placed) at the end and at the start.
struct ToolInput {
  physics::Pose shape, start;
  double presence = 1;  ///< share of its contact stiffness with which it touches; 0: not at all
};

/// Inputs of a step.
struct StepInput {
  std::span<const ToolInput> tools{};  ///< [tool_count]
  double end_time_s = 0;               ///< time of the scene, for prescribed displacements that change
  double dt_s = 0;
  std::uint32_t cg_max_iterations = 0;
  bool saves_checkpoint = true;  ///< `restore` goes back to the state before this step
  bool first_order = false;      ///< BDF2 starts a new sequence of steps, by implicit Euler
  bool by_euler = false;         ///< implicit Euler instead of the scene's scheme, within the sequence of steps
  /// Stiffness projected to positive definite instead of the consistent one.
  bool projects_stiffness = false;
  double loads_time_s = 0;  ///< time of the scene at which scheduled gravity, loads and pressure have their factors
  /// Share of gravity, loads, pressure and prescribed displacements without a schedule.
  double load_factor = 1;
  bool evaluates_all = false;  ///< no element follows its last tangent (matrix/lagged_tangents.h)
  bool gather_visible = false;
};

using solver::StepResult;

/// Deformation of one element group (view::PatchDiagnostics).
struct GroupDiagnostics {
  double min_det_f = 1;
  double max_strain = 0;
  double max_rotation_rad = 0;
  double least_stretch = 1;
  double elastic_energy_j = 0;
};

/// The state of all rows.
/// internal_variables: the groups' viscoelastic internal variables Γ_i, one group after the other.
struct RowState {
  std::vector<double> displacement;        ///< [row_count, 4] m
  std::vector<double> velocity;            ///< [row_count, 4] m/s
  std::vector<double> internal_variables;  ///< Pa
  /// Time by which the internal variables lag behind the displacement, one step or none [s].
  double internal_dt_s = 0;
};

/// The part of past steps that the next step needs, besides RowState. Without it, a state starts a new sequence of
/// steps. Arrays that the model does not use are empty.
struct StepHistory {
  std::vector<double> previous_displacement;  ///< [row_count, 4] m, at the end of the step before the last
  std::vector<double> previous_velocity;      ///< [row_count, 4] m/s
  std::vector<double> slips;                  ///< view::ContactView::slips
  std::vector<double> link_slips;             ///< view::LinksView::slips
  std::vector<double> broken;                 ///< view::LinksView::broken
  std::vector<double> solution;               ///< [row_count, 4] of the last linear solve
  double last_dt_s = 0;                       ///< length of the last step; 0: there was none
  double largest_force_squared = 0;           ///< see solver::newton_step
  std::uint32_t coarse_solves = 0;            ///< see CoarseSwitch
};

/// The front of a blade point at the end of a step (view::BladeReport).
struct BladeFront {
  Vec3<double> rest_m = Vec3<double>::Zero();
  std::uint32_t element = view::kNoTetrahedron;  ///< numbered in the scene; kNoTetrahedron: it cuts nothing
  double dissipated_j = 0;                       ///< work of fracture in the step
  double cut_m2 = 0;                             ///< area that the point cut in the step
  double holds_n = 0;                            ///< force at which it goes on cutting; 0: it holds nothing
};

/// A buffer that steps only read.
struct ConstantBuffer {
  std::string_view name;
  std::vector<std::byte> bytes;
};

/// Thrown by a step that `SceneState::stop` ended. The state is then that of no step.
class StepStopped final : public std::exception {
 public:
  const char* what() const noexcept override { return "the step was stopped"; }
};

/// Values for the buffers of a state, ready on its device: SceneState::prepare makes it.
class PreparedEdit {
 public:
  virtual ~PreparedEdit() = default;
};

/// The state of one scene on one device. Not thread-safe, except for `stop` and `prepare`. A step allocates nothing.
class SceneState {
 public:
  virtual ~SceneState() = default;

  /// Makes a step under way, and every later one, throw StepStopped soon: solves look at the flag. Any thread may call
  /// it, so that nobody waits minutes for the end of a scene.
  void stop() { stopped_.store(true, std::memory_order_relaxed); }
  bool stopped() const { return stopped_.load(std::memory_order_relaxed); }

  /// Runs one step of the model's stages. forces: [tool_count], written. With `gather_visible` the visible positions
  /// are ready when it returns.
  virtual StepResult step(const StepInput& input, std::span<ToolForce> forces) = 0;
  /// Goes back to the checkpoint: the state before the last step that saved one. No data leave the device.
  virtual void restore() = 0;
  /// Ends all motion: velocities become zero, and the next step starts a new sequence of steps.
  virtual void come_to_rest() = 0;
  /// Visible positions as last gathered, [visible_count, 3] m. Valid until they are gathered again.
  virtual std::span<const float> visible_positions() = 0;
  /// Gathers the visible positions without a step.
  virtual void gather_visible() = 0;
  /// Takes over an edit of the model that this state was created from (model/edit.h): copies what the edit lists, stops
  /// rows that lost their material and breaks springs. Needs no memory, and costs as much as the edit touched.
  virtual void apply(const model::ModelEdit& edit) = 0;
  /// Makes the entries of a model ready for `apply`, while the scene steps. Any thread may call it. Throws
  /// std::bad_alloc or what the device throws.
  ///
  ///   next     has the sizes of the model that this state was created from
  ///   ranges   entries of `next`
  virtual std::unique_ptr<PreparedEdit> prepare(const model::Model& next,
                                                const std::vector<model::EditRange>& ranges) const = 0;
  /// Takes over what this state has prepared. Costs a copy within the device.
  virtual void apply(const PreparedEdit& edit) = 0;
  /// Copies all buffers that steps only read, in the order of their allocation; slow, for tests.
  virtual std::vector<ConstantBuffer> read_constants() = 0;
  /// Copies which springs of attachments are broken, and by what. broken: [spring_count] view::LinksView::broken;
  /// written.
  virtual void read_broken(std::span<std::uint8_t> broken) = 0;
  /// Copies what the last step reported of blade points. fronts: [points of all blades], written. No data leave the
  /// device: the step has written them to the host.
  virtual void read_blades(std::span<BladeFront> fronts) = 0;
  /// Measures the deformation of the elements at the present state. groups: [group_count], written.
  virtual void diagnose(std::span<GroupDiagnostics> groups) = 0;
  /// Copies the state to the host; slow.
  virtual RowState read() = 0;
  /// Replaces the state; slow.
  virtual void write(const RowState& state) = 0;
  /// Copies the history to the host; slow.
  virtual StepHistory read_history() = 0;
  /// Replaces the history, in arrays of the same sizes as those of `read_history`; slow. Call it after `write`, which
  /// starts a new history.
  virtual void write_history(const StepHistory& history) = 0;

 protected:
  const std::atomic<bool>* stop_flag() const { return &stopped_; }
  void throw_if_stopped() const {
    if (stopped()) throw StepStopped();
  }

 private:
  std::atomic<bool> stopped_{false};
};

/// A device. Any thread may call it and the states that it creates: each call makes the device current itself, and a
/// thread may go from one device to another.
class Backend {
 public:
  virtual ~Backend() = default;
  virtual std::string name() const = 0;    ///< "cpu" or "cuda"
  virtual std::string device() const = 0;  ///< its product name
  /// cpu_threads: those that the scene asks for (model::requested_cpu_threads); 0: the backend's default.
  virtual model::PatchPolicy patch_policy(std::uint32_t cpu_threads) const = 0;
  virtual step::MachineRates rates(std::uint32_t cpu_threads) const = 0;
  /// Measures memory bandwidth by a copy or STREAM's triad; bytes read and written both count. It bounds the rate of a
  /// scene whose data come from memory in each step.
  virtual double measure_bandwidth_bytes_per_s() const = 0;
  virtual Result<std::unique_ptr<SceneState>> create(const model::Model& model) const = 0;
};

std::unique_ptr<Backend> make_cpu_backend(std::uint32_t default_threads);
/// scenes: how many must step at the same time. Each gets its share of the multiprocessors.
/// device: number of the GPU in the order of CUDA.
/// It fails with kUnavailable and the reason if the machine has no such device or this build has no CUDA.
Result<std::unique_ptr<Backend>> make_cuda_backend(std::uint32_t scenes = 1, std::uint32_t device = 0);

}  // namespace tensormass::backend
