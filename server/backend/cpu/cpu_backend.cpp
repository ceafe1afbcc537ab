#include <algorithm>
#include <cstring>
#include <fstream>
#include <memory>
#include <new>
#include <thread>
#include <vector>

#include "backend/backend.h"
#include "backend/cpu/team.h"
#include "backend/results.h"
#include "backend/stages.h"
#include "model/bind.h"

namespace tensormass::backend {

namespace {

/// Buffers of a scene in host memory, each on a cache line of its own.
class HostArena {
 public:
  template <class T, class U>
  const T* constant(std::string_view name, const std::vector<U>& items) {
    T* copy = zeros<T>(name, items.size());
    std::transform(items.begin(), items.end(), copy, [](U item) { return static_cast<T>(item); });
    return copy;
  }
  template <class T>
  T* zeros(std::string_view /*name*/, std::size_t count) {
    if (count == 0) return nullptr;
    const std::size_t bytes = (count * sizeof(T) + kAlignment - 1) / kAlignment * kAlignment;
    blocks_.emplace_back(static_cast<std::byte*>(std::aligned_alloc(kAlignment, bytes)));
    if (!blocks_.back()) throw std::bad_alloc();
    std::memset(blocks_.back().get(), 0, bytes);
    return reinterpret_cast<T*>(blocks_.back().get());
  }

 private:
  static constexpr std::size_t kAlignment = 64;
  struct Free {
    void operator()(std::byte* p) const { std::free(p); }
  };
  std::vector<std::unique_ptr<std::byte, Free>> blocks_;
};

template <class Real>
class CpuState final : public SceneState {
 public:
  explicit CpuState(const model::Model& model)
      : model_(model),
        view_(model::bind<Real>(model, arena_)),
        tools_(const_cast<tensor::ToolState<Real>*>(view_.tools)),
        barrier_(view_.patch_count) {
    for (const model::ElementGroup& group : model.groups) groups_.push_back(model::bind<Real>(group, arena_));
    for (std::uint32_t patch = 1; patch < view_.patch_count; ++patch) {
      workers_.emplace_back([this, patch] { work(patch); });
    }
  }

  ~CpuState() override {
    command_ = Command::kQuit;
    barrier_.arrive_and_wait();
    for (std::thread& worker : workers_) worker.join();
  }

  StepResult step(ToolCenters centers, std::span<ToolForce> forces, bool gather) override {
    for (std::size_t tool = 0; tool < centers.size(); ++tool) {
      tools_[tool] = tool_state<Real>(model_.tools[tool], centers[tool]);
    }
    command_ = gather ? Command::kStepAndGather : Command::kStep;
    run_team();
    read_forces<Real>({view_.tool_loads, std::size_t{view_.tool_count} * view_.patch_count}, forces);
    return read_step<Real>(*view_.solve_report, {view_.patch_reports, view_.patch_count});
  }

  std::span<const float> visible_positions() override {
    return {view_.visible_positions, 3 * std::size_t{view_.visible_count}};
  }

  void gather_visible() override {
    command_ = Command::kGather;
    run_team();
  }

  void read_rows(std::span<double> displacement, std::span<double> velocity) override {
    std::copy_n(view_.displacement, displacement.size(), displacement.begin());
    std::copy_n(view_.velocity, velocity.size(), velocity.begin());
  }
  void write_rows(std::span<const double> displacement, std::span<const double> velocity) override {
    const auto to_real = [](double value) { return static_cast<Real>(value); };
    std::transform(displacement.begin(), displacement.end(), view_.displacement, to_real);
    std::transform(velocity.begin(), velocity.end(), view_.velocity, to_real);
  }

 private:
  enum class Command { kStep, kStepAndGather, kGather, kQuit };

  /// The calling thread is patch 0. A barrier starts the team and one ends it.
  void run_team() {
    barrier_.arrive_and_wait();
    run_patch(0, command_);
  }

  void work(std::uint32_t patch) {
    for (;;) {
      barrier_.arrive_and_wait();
      const Command command = command_;  // the caller may write the next one as soon as the last barrier is passed
      if (command == Command::kQuit) return;
      run_patch(patch, command);
    }
  }

  void run_patch(std::uint32_t patch, Command command) {
    cpu::Team team(patch, view_.patch_count, barrier_);
    if (command != Command::kGather) {
      for (const model::Stage& stage : model_.stages) {
        with_stage(model_, stage, [&](auto type) {
          decltype(type)::run(team, view_, groups_.empty() ? tensor::ElementView<Real>{} : groups_[stage.group]);
        });
        barrier_.arrive_and_wait();
      }
    }
    if (command != Command::kStep) {
      GatherVisible::run(team, view_, {});
      barrier_.arrive_and_wait();
    }
  }

  const model::Model& model_;
  HostArena arena_;
  const tensor::SceneView<Real> view_;
  tensor::ToolState<Real>* const tools_;
  std::vector<tensor::ElementView<Real>> groups_;
  cpu::Barrier barrier_;
  Command command_ = Command::kStep;
  std::vector<std::thread> workers_;
};

std::string processor_name() {
  std::ifstream file("/proc/cpuinfo");
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with("model name")) return line.substr(line.find(':') + 2);
  }
  return "unknown processor";
}

class CpuBackend final : public Backend {
 public:
  explicit CpuBackend(std::uint32_t default_threads) : default_threads_(default_threads) {}

  std::string name() const override { return "cpu"; }
  std::string device() const override {
    return processor_name() + ", " + std::to_string(std::thread::hardware_concurrency()) + " threads";
  }
  model::PatchPolicy patch_policy(const v1::Scene& scene) const override {
    // Below that, waiting for each other costs more than the work saved.
    constexpr std::uint32_t kMinNodesPerThread = 512;
    return {model::requested_cpu_threads(scene, default_threads_), kMinNodesPerThread};
  }
  model::MachineRates rates(const v1::Scene& scene) const override {
    // Of one core of a current server, with vectors; measured by tensormass-bench where it matters.
    const double threads = model::requested_cpu_threads(scene, default_threads_);
    return {.bytes_per_s = 8e9 * threads,
            .operations_per_s = 6e9 * threads,
            .stage_latency_s = threads > 1 ? 2e-6 : 0,
            .iteration_latency_s = threads > 1 ? 2e-6 : 0};
  }
  Result<std::unique_ptr<SceneState>> create(const model::Model& model) const override try {
    std::unique_ptr<SceneState> state;
    if (model.double_precision) {
      state = std::make_unique<CpuState<double>>(model);
    } else {
      state = std::make_unique<CpuState<float>>(model);
    }
    return state;
  } catch (const std::bad_alloc&) {
    return fail(ErrorCode::kResourceExhausted, "not enough host memory for the scene's buffers; use a coarser mesh");
  }

 private:
  const std::uint32_t default_threads_;
};

}  // namespace

std::unique_ptr<Backend> make_cpu_backend(std::uint32_t default_threads) {
  return std::make_unique<CpuBackend>(std::max(default_threads, 1u));
}

}  // namespace tensormass::backend
