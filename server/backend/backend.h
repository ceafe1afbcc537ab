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

struct StepResult {
  std::uint32_t cg_iterations = 0;
  double cg_relative_residual = 0;
  bool negative_curvature = false;
  bool finite = true;
  double max_speed_m_per_s = 0;
};

/// The state of one scene on one device. Not thread-safe. Nothing allocates after construction.
class SceneState {
 public:
  virtual ~SceneState() = default;

  /// One step of the model's stages. forces: [tool_count], written. With `gather_visible` the frame's positions are
  /// ready when it returns.
  virtual StepResult step(ToolCenters centers, std::span<ToolForce> forces, bool gather_visible) = 0;
  /// [visible_count, 3] m, as of the last step that gathered them; valid until the next one.
  virtual std::span<const float> visible_positions() = 0;
  /// Gathers them without a step.
  virtual void gather_visible() = 0;
  /// Of all rows [row_count, 4]; for requests, not for the loop.
  virtual void read_rows(std::span<double> displacement, std::span<double> velocity) = 0;
  virtual void write_rows(std::span<const double> displacement, std::span<const double> velocity) = 0;
};

/// A kind of device.
class Backend {
 public:
  virtual ~Backend() = default;
  virtual std::string name() const = 0;    ///< "cpu" or "cuda"
  virtual std::string device() const = 0;  ///< for people
  virtual model::PatchPolicy patch_policy(const v1::Scene& scene) const = 0;
  virtual model::MachineRates rates(const v1::Scene& scene) const = 0;
  virtual Result<std::unique_ptr<SceneState>> create(const model::Model& model) const = 0;
};

std::unique_ptr<Backend> make_cpu_backend(std::uint32_t default_threads);
/// Fails with kUnavailable, saying why, where there is no device or no CUDA in this build.
Result<std::unique_ptr<Backend>> make_cuda_backend();

}  // namespace tensormass::backend
