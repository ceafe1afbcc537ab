#pragma once

#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>

#include "backend/backend.h"
#include "support/backends.h"

/// A backend that injects faults into steps, in the state and in the result alike.
namespace tensormass::tests {

enum class Fault {
  kNotANumber,   ///< the state is no longer finite
  kExplosion,    ///< velocities a thousand times too large
  kStall,        ///< the linear solve did not converge
  kIndefinite,   ///< conjugate gradients met negative curvature
  kDeviceError,  ///< the device throws
  kDeviceLost,   ///< the device throws, and no other call of this process will work
  kWriteError,   ///< the device throws when a state is written; asked for with step 0
};

/// Returns the fault to inject into the `call`-th solve (from 0) that a world makes for its `step`-th step (from 1), or
/// nullopt. Step 0 stands for a write of a state.
using FaultPlan = std::function<std::optional<Fault>(std::uint64_t step, std::uint64_t call)>;

class FaultyState final : public backend::SceneState {
 public:
  FaultyState(std::unique_ptr<backend::SceneState> sound, FaultPlan plan)
      : sound_(std::move(sound)), plan_(std::move(plan)) {}

  solver::StepResult step(const backend::StepInput& input, std::span<backend::ToolForce> forces) override {
    if (input.saves_checkpoint) {
      ++step_;
      call_ = 0;
    } else {
      ++call_;
    }
    solver::StepResult result = sound_->step(input, forces);
    const std::optional<Fault> fault = plan_(step_, call_);
    if (!fault) return result;
    backend::RowState state = sound_->read();
    switch (*fault) {
      case Fault::kNotANumber:
        for (double& value : state.displacement) value = std::numeric_limits<double>::quiet_NaN();
        for (backend::ToolForce& force : forces) force.force_n.setConstant(std::numeric_limits<double>::quiet_NaN());
        result.finite = false;
        break;
      case Fault::kExplosion:
        for (double& value : state.velocity) value *= 1e3;
        result.kinetic_energy_j = 1e6 * (result.kinetic_energy_j + 1);
        break;
      case Fault::kStall:
        result.cg_relative_residual = 1e3;
        break;
      case Fault::kIndefinite:
        result.negative_curvature = true;
        break;
      case Fault::kDeviceError:
        throw std::runtime_error("injected");
      case Fault::kDeviceLost:
        throw std::runtime_error("a kernel: an illegal memory access was encountered");
      case Fault::kWriteError:
        break;
    }
    sound_->write(state);
    if (input.gather_visible) sound_->gather_visible();
    return result;
  }
  void restore() override { sound_->restore(); }
  void come_to_rest() override { sound_->come_to_rest(); }
  std::span<const float> visible_positions() override { return sound_->visible_positions(); }
  void gather_visible() override { sound_->gather_visible(); }
  void apply(const model::ModelEdit& edit) override { sound_->apply(edit); }
  std::unique_ptr<backend::PreparedEdit> prepare(const model::Model& next,
                                                 const std::vector<model::EditRange>& ranges) const override {
    if (plan_(0, 0) == Fault::kWriteError) throw std::runtime_error("injected");
    return sound_->prepare(next, ranges);
  }
  void apply(const backend::PreparedEdit& edit) override { sound_->apply(edit); }
  std::vector<backend::ConstantBuffer> read_constants() override { return sound_->read_constants(); }
  void read_blades(std::span<backend::BladeFront> fronts) override { sound_->read_blades(fronts); }
  void read_broken(std::span<std::uint8_t> broken) override { sound_->read_broken(broken); }
  void diagnose(std::span<backend::GroupDiagnostics> groups) override { sound_->diagnose(groups); }
  backend::RowState read() override { return sound_->read(); }
  void write(const backend::RowState& state) override {
    if (plan_(0, 0) == Fault::kWriteError) throw std::runtime_error("injected");
    sound_->write(state);
  }
  backend::StepHistory read_history() override { return sound_->read_history(); }
  void write_history(const backend::StepHistory& history) override { sound_->write_history(history); }

 private:
  const std::unique_ptr<backend::SceneState> sound_;
  const FaultPlan plan_;
  std::uint64_t step_ = 0, call_ = 0;
};

class FaultyBackend final : public backend::Backend {
 public:
  FaultyBackend(std::unique_ptr<backend::Backend> sound, FaultPlan plan)
      : sound_(std::move(sound)), plan_(std::move(plan)) {}

  std::string name() const override { return sound_->name(); }
  std::string device() const override { return sound_->device(); }
  model::PatchPolicy patch_policy(std::uint32_t threads) const override { return sound_->patch_policy(threads); }
  step::MachineRates rates(std::uint32_t threads) const override { return sound_->rates(threads); }
  double measure_bandwidth_bytes_per_s() const override { return sound_->measure_bandwidth_bytes_per_s(); }
  Result<std::unique_ptr<backend::SceneState>> create(const model::Model& model) const override {
    TM_ASSIGN_OR_RETURN(state, sound_->create(model));
    return std::unique_ptr<backend::SceneState>(std::make_unique<FaultyState>(std::move(state), plan_));
  }

 private:
  const std::unique_ptr<backend::Backend> sound_;
  const FaultPlan plan_;
};

/// Fixture for tests of worlds whose steps fail as planned, on every backend.
class OnFaultyBackend : public OnBackend {
 protected:
  std::unique_ptr<world::World> start_faulty(const v1::Scene& scene, FaultPlan plan) {
    backend_ = std::make_unique<FaultyBackend>(std::move(backend_), std::move(plan));
    auto world = start(scene);
    SetUp();  // the working backend again
    return world;
  }
};

}  // namespace tensormass::tests
