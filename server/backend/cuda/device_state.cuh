#pragma once

#include <memory>
#include <span>
#include <vector>

#include "backend/cuda/current_device.cuh"
#include "backend/cuda/state.cuh"

/// The state of a scene on one device of several: makes the device current, and then does what CudaState does.
namespace tensormass::backend::cuda {

/// Comes before CudaState in the list of bases, so that the device is current when the state allocates.
class OnDevice {
 protected:
  explicit OnDevice(int device) : number_(device) { use(); }
  void use() const { use_device(number_); }
  const int number_;
};

/// Overrides every method of SceneState that calls CUDA; a new one needs an override here, too. The others read
/// page-locked memory: visible_positions, read_blades. The tests of several devices call all of them with another
/// device current.
template <class Real>
class DeviceState final : private OnDevice, public CudaState<Real> {
  using State = CudaState<Real>;

 public:
  /// number: of the device. device, shares: as of CudaState.
  DeviceState(int number, const model::Model& model, const cudaDeviceProp& device, bool shares)
      : OnDevice(number), State(model, device, shares) {}
  /// The bases end after this.
  ~DeviceState() override { use_device_if_possible(number_); }

  StepResult step(const StepInput& input, std::span<ToolForce> forces) override {
    use();
    return State::step(input, forces);
  }
  void restore() override {
    use();
    State::restore();
  }
  void come_to_rest() override {
    use();
    State::come_to_rest();
  }
  void gather_visible() override {
    use();
    State::gather_visible();
  }
  void apply(const model::ModelEdit& edit) override {
    use();
    State::apply(edit);
  }
  std::unique_ptr<PreparedEdit> prepare(const model::Model& next,
                                        const std::vector<model::EditRange>& ranges) const override {
    use();
    return State::prepare(next, ranges);
  }
  void apply(const PreparedEdit& edit) override {
    use();
    State::apply(edit);
  }
  std::vector<ConstantBuffer> read_constants() override {
    use();
    return State::read_constants();
  }
  void read_broken(std::span<std::uint8_t> broken) override {
    use();
    State::read_broken(broken);
  }
  void diagnose(std::span<GroupDiagnostics> groups) override {
    use();
    State::diagnose(groups);
  }
  RowState read() override {
    use();
    return State::read();
  }
  void write(const RowState& state) override {
    use();
    State::write(state);
  }
  StepHistory read_history() override {
    use();
    return State::read_history();
  }
  void write_history(const StepHistory& history) override {
    use();
    State::write_history(history);
  }
};

}  // namespace tensormass::backend::cuda
