#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "core/result.h"
#include "core/scalar.h"
#include "model/compile.h"
#include "model/model.h"
#include "solver/step_result.h"
#include "step/plan.h"

/// Where a scene's numbers live and who runs its stages.
namespace tensormass::backend {

/// Centre of each tool's sphere for the coming step [m].
using ToolCenters = std::span<const Vec3<double>>;

/// What the tissue does to a tool at the end of a step, about the centre of its sphere.
struct ToolForce {
  Vec3<double> force_n = Vec3<double>::Zero();
  Vec3<double> torque_n_m = Vec3<double>::Zero();
};

/// What the host tells a step.
struct StepInput {
  ToolCenters centers{};  ///< [tool_count]
  double end_time_s = 0;  ///< for displacements that are prescribed over time
  double dt_s = 0;
  std::uint32_t cg_max_iterations = 0;
  bool saves_checkpoint = true;  ///< `restore` goes back to the state before this step
  /// Implicit Euler instead of BDF2, and stiffness projected to positive definite instead of the consistent one.
  bool fallback_settings = false;
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

/// Everything that moves, of all rows. internal_variables: the groups' Γ_i, one group after the other.
struct RowState {
  std::vector<double> displacement;        ///< [row_count, 4] m
  std::vector<double> velocity;            ///< [row_count, 4] m/s
  std::vector<double> internal_variables;  ///< Pa
  /// Length of the step by which the displacement is ahead of the internal variables; 0: they belong together.
  double internal_dt_s = 0;
};

/// The state of one scene on one device. Not thread-safe. A step allocates nothing.
class SceneState {
 public:
  virtual ~SceneState() = default;

  /// One step of the model's stages. forces: [tool_count], written. With `gather_visible` the frame's positions are
  /// ready when it returns.
  virtual StepResult step(const StepInput& input, std::span<ToolForce> forces) = 0;
  /// Goes back to the checkpoint: the state before the last step that saved one. The state never leaves the device.
  virtual void restore() = 0;
  /// [visible_count, 3] m, as of the last step that gathered them; valid until the next one.
  virtual std::span<const float> visible_positions() = 0;
  /// Gathers them without a step.
  virtual void gather_visible() = 0;
  /// Measures the elements at the present state. groups: [group_count], written.
  virtual void diagnose(std::span<GroupDiagnostics> groups) = 0;
  /// For requests, not for the loop.
  virtual RowState read() = 0;
  virtual void write(const RowState& state) = 0;
};

/// A kind of device.
class Backend {
 public:
  virtual ~Backend() = default;
  virtual std::string name() const = 0;    ///< "cpu" or "cuda"
  virtual std::string device() const = 0;  ///< for people
  virtual model::PatchPolicy patch_policy(const v1::Scene& scene) const = 0;
  virtual step::MachineRates rates(const v1::Scene& scene) const = 0;
  /// Measures memory bandwidth by a copy or STREAM's triad, bytes read and written: the floor of a step whose data come
  /// from memory.
  virtual double measure_bandwidth_bytes_per_s() const = 0;
  virtual Result<std::unique_ptr<SceneState>> create(const model::Model& model) const = 0;
};

std::unique_ptr<Backend> make_cpu_backend(std::uint32_t default_threads);
/// scenes: how many are to step at the same time; each gets its share of the multiprocessors. Fails with kUnavailable,
/// saying why, where there is no device or no CUDA in this build.
Result<std::unique_ptr<Backend>> make_cuda_backend(std::uint32_t scenes = 1);

}  // namespace tensormass::backend
