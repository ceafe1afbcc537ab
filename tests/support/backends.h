#pragma once

#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

#include <gtest/gtest.h>

#include "backend/backend.h"
#include "model/compile.h"
#include "world/world.h"

/// Tests that step a scene take the backend as their parameter; a machine without a device skips those, out loud.
namespace tensormass::tests {

/// A test whose parameter is a backend's name. CPU scenes take their thread count from the scene.
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

  /// The scene as a world on this backend. A scene that is refused ends the test with the refusal.
  std::unique_ptr<world::World> start(const v1::Scene& scene) const {
    auto model = model::compile(scene, backend_->patch_policy(scene));
    if (!model) throw std::runtime_error(model.error().message);
    auto world = world::World::create(std::make_unique<const model::Model>(std::move(*model)), *backend_);
    if (!world) throw std::runtime_error(world.error().message);
    return std::move(*world);
  }

  std::unique_ptr<backend::Backend> backend_;
};

#define TM_ON_EACH_BACKEND(Suite)                                           \
  INSTANTIATE_TEST_SUITE_P(Backends, Suite, testing::Values("cpu", "cuda"), \
                           [](const auto& one) { return std::string(one.param); })

}  // namespace tensormass::tests
