#pragma once

#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

#include "support/backends.h"
#include "support/faulty_backend.h"
#include "world/compiled_scene.h"
#include "world/runner.h"

namespace tensormass::tests {

/// Fixture for tests of scenes on a thread of their own, on every backend.
class OnRunner : public OnBackend {
 protected:
  /// Starts the scene. Throws the refusal of a refused scene, which ends the test with its message.
  std::unique_ptr<world::Runner> load(const v1::Scene& scene) const {
    const bool cpu = std::string(GetParam()) == "cpu";
    auto runner = world::Runner::start(scene, {cpu ? world::BackendChoice::kCpu : world::BackendChoice::kCuda, 1});
    if (!runner) throw std::runtime_error(runner.error().message);
    return std::move(*runner);
  }
  /// Loads a scene on a backend that fails at planned steps.
  std::unique_ptr<world::Runner> load(const v1::Scene& scene, FaultPlan plan) const {
    const bool cpu = std::string(GetParam()) == "cpu";
    auto compiled = world::compile_scene(scene, {cpu ? world::BackendChoice::kCpu : world::BackendChoice::kCuda, 1});
    if (!compiled) throw std::runtime_error(compiled.error().message);
    compiled->backend = std::make_unique<FaultyBackend>(std::move(compiled->backend), std::move(plan));
    auto runner = world::Runner::start(std::move(*compiled));
    if (!runner) throw std::runtime_error(runner.error().message);
    return std::move(*runner);
  }
};

}  // namespace tensormass::tests
