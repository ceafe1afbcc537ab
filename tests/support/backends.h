#pragma once

#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

#include <gtest/gtest.h>

#include "backend/backend.h"
#include "model/compile.h"
#include "world/world.h"

/// Fixture for tests that run on every backend. Tests of a backend whose device is missing are skipped with the reason.
namespace tensormass::tests {

/// The parameter is the backend's name, "cpu" or "cuda". The CPU takes its thread count from the scene.
class OnBackend : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override {
    if (std::string(GetParam()) == "cpu") {
      backend_ = backend::make_cpu_backend(1);
      return;
    }
    auto cuda = backend::make_cuda_backend();
    if (!cuda) GTEST_SKIP() << "no CUDA device: " << cuda.error().message;
    backend_ = std::move(*cuda);
  }

  /// Returns the scene as a world on this backend. Throws the refusal of a refused scene, which ends the test with its
  /// message.
  std::unique_ptr<world::World> start(const v1::Scene& scene) const {
    auto model = model::compile(scene, backend_->patch_policy(model::requested_cpu_threads(scene)));
    if (!model) throw std::runtime_error(model.error().message);
    auto world = world::World::create(std::make_unique<model::Model>(std::move(*model)), *backend_);
    if (!world) throw std::runtime_error(world.error().message);
    return std::move(*world);
  }

  std::unique_ptr<backend::Backend> backend_;
};

#define TM_ON_EACH_BACKEND(Suite)                                           \
  INSTANTIATE_TEST_SUITE_P(Backends, Suite, testing::Values("cpu", "cuda"), \
                           [](const auto& one) { return std::string(one.param); })

}  // namespace tensormass::tests
