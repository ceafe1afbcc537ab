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
#include "model/plan.h"

/// Where a scene's numbers live and who runs its stages.
namespace tensormass::backend {

/// Centre of each tool's sphere for the coming step [m].
using ToolCenters = std::span<const Vec3<double>>;

/// What the tissue does to a tool at the end of a step, about the centre of its sphere.
struct ToolForce {
  Vec3<double> force_n = Vec3<double>::Zero();
  Vec3<double> torque_n_m = Vec3<double>::Zero();
};

/// What a step is told.
struct StepInput {
  ToolCenters centers{};  ///< [tool_count]
  double end_time_s = 0;  ///< for displacements that are prescribed over time
  double dt_s = 0;
  std::uint32_t cg_max_iterations = 0;
  bool keeps = true;     ///< the state at its begin is the one that `restore` goes back to
  bool careful = false;  ///< implicit Euler in place of BDF2, positive stiffness in place of the consistent one
  bool gather_visible = false;
};

struct StepResult {
  std::uint32_t cg_iterations = 0;  ///< of all solves of the step
  double cg_relative_residual = 0;  ///< of the last one
  bool negative_curvature = false;
  bool finite = true;
  double max_speed_m_per_s = 0;
  double max_move_m = 0;        ///< of any node from the kept state
  double max_distance_m = 0;    ///< of any node from rest
  double kinetic_energy_j = 0;  ///< of the nodes' masses
  double work_j = 0;            ///< of gravity and loads since the kept state
  /// Of the elements that are checked in each step; 1 where none is. Infinity: none of them is inside out.
  double min_det_f = 1;
  std::uint32_t newton_iterations = 1;
  double newton_residual = 0;  ///< imbalance relative to the forces at work; 0 in a step that is linearized once
  /// False: the outer iteration ended before its tolerance, and what is left would have moved something.
  bool converged = true;
};

/// What elements of a group look like (tensor::PatchWatch).
struct GroupWatch {
  double min_det_f = 1;
  double max_strain = 0;
  double max_rotation_rad = 0;
  double least_stretch = 1;
  double elastic_energy_j = 0;
};

/// Everything that moves, of all rows. `histories` are the groups' Γ_i one after the other.
struct RowState {
  std::vector<double> displacement;  ///< [row_count, 4] m
  std::vector<double> velocity;      ///< [row_count, 4] m/s
  std::vector<double> histories;     ///< Pa
  /// Length of the step that displacement is ahead of the histories; 0: they belong together.
  double history_dt_s = 0;
};

/// The state of one scene on one device. Not thread-safe. A step allocates nothing.
class SceneState {
 public:
  virtual ~SceneState() = default;

  /// One step of the model's stages. forces: [tool_count], written. With `gather_visible` the frame's positions are
  /// ready when it returns.
  virtual StepResult step(const StepInput& input, std::span<ToolForce> forces) = 0;
  /// Back to the begin of the last step that kept it. No host sees the state on its way.
  virtual void restore() = 0;
  /// [visible_count, 3] m, as of the last step that gathered them; valid until the next one.
  virtual std::span<const float> visible_positions() = 0;
  /// Gathers them without a step.
  virtual void gather_visible() = 0;
  /// Looks at the elements as they are now. groups: [group_count], written.
  virtual void watch(std::span<GroupWatch> groups) = 0;
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
  virtual model::MachineRates rates(const v1::Scene& scene) const = 0;
  /// Measured now, as a copy or STREAM's triad reaches it, bytes read and written: what no step beats that has to go
  /// through memory.
  virtual double measure_bandwidth_bytes_per_s() const = 0;
  virtual Result<std::unique_ptr<SceneState>> create(const model::Model& model) const = 0;
};

std::unique_ptr<Backend> make_cpu_backend(std::uint32_t default_threads);
/// scenes: how many are to step at the same time; each gets its share of the multiprocessors. Fails with kUnavailable,
/// saying why, where there is no device or no CUDA in this build.
Result<std::unique_ptr<Backend>> make_cuda_backend(std::uint32_t scenes = 1);

}  // namespace tensormass::backend
