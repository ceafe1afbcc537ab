#include <algorithm>
#include <cctype>
#include <cmath>
#include <tuple>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/laws.h"
#include "support/scenes.h"

/// CUDA and the CPU run the same functions for every law in every shape, so they must reach the same state after some
/// steps.
namespace tensormass {
namespace {

/// A bar of 8 × 2 × 2 cells, fixed at x = 0, bent by gravity and pulled by a traction.
v1::Scene bar(v1::Shape shape, const std::string& law, bool double_precision) {
  v1::Scene scene = tests::beam_scene({.cells_x = 8,
                                       .cells_y = 2,
                                       .cells_z = 2,
                                       .size_x_m = 0.4,
                                       .size_y_m = 0.1,
                                       .size_z_m = 0.1,
                                       .double_precision = double_precision,
                                       .dt_s = 0.005,
                                       .cg_max_iterations = 1000,
                                       .cg_tolerance = double_precision ? 1e-14 : 1e-6});
  v1::Body& body = *scene.mutable_bodies(0);
  body.mutable_mesh()->mutable_grid()->set_shape(shape);
  *body.mutable_law() = tests::law(law, 5e4, 0.4);
  v1::Load& load = *body.add_loads();
  tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), 0.4 - 1e-6, -1, -1);
  tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
  tests::set(*load.mutable_traction_pa(), 2e3, 0, 500);
  return scene;
}

std::vector<double> positions_after(const backend::Backend& backend, const v1::Scene& scene, int steps) {
  auto model = model::compile(scene, backend.patch_policy(model::requested_cpu_threads(scene)));
  if (!model) throw std::runtime_error(model.error().message);
  auto world = world::World::create(std::make_unique<model::Model>(std::move(*model)), backend);
  if (!world) throw std::runtime_error(world.error().message);
  for (int i = 0; i < steps; ++i) EXPECT_TRUE((*world)->step(false)) << "step " << i;
  return (*world)->positions((*world)->model().bodies[0]);
}

class Agreement : public testing::Test {
 protected:
  void SetUp() override {
    auto made = backend::make_cuda_backend();
    if (!made) GTEST_SKIP() << "no GPU here: " << made.error().message;
    cuda_ = std::move(*made);
  }
  /// Returns ‖cpu − cuda‖ / ‖cpu − rest‖ after some steps.
  double difference(const v1::Scene& scene, int steps) {
    const auto rest = positions_after(*cpu_, scene, 0), cpu = positions_after(*cpu_, scene, steps),
               cuda = positions_after(*cuda_, scene, steps);
    double apart = 0, moved = 0;
    for (std::size_t i = 0; i < rest.size(); ++i) {
      apart += (cpu[i] - cuda[i]) * (cpu[i] - cuda[i]);
      moved += (cpu[i] - rest[i]) * (cpu[i] - rest[i]);
    }
    EXPECT_GT(moved, 1e-6);
    return std::sqrt(apart / moved);
  }

  std::unique_ptr<backend::Backend> cuda_;
  std::unique_ptr<backend::Backend> cpu_ = backend::make_cpu_backend(1);
};

using Entry = std::tuple<v1::Shape, std::string, bool>;
class EveryEntry : public Agreement, public testing::WithParamInterface<Entry> {};

TEST_P(EveryEntry, ReachesTheSameState) {
  const auto& [shape, law, double_precision] = GetParam();
  const double found = difference(bar(shape, law, double_precision), 20);
  RecordProperty("relative_difference", std::to_string(found));
  EXPECT_LT(found, double_precision ? 1e-10 : 1e-4);
}

INSTANTIATE_TEST_SUITE_P(Family, EveryEntry,
                         testing::Combine(testing::ValuesIn(tests::shapes()), testing::ValuesIn(tests::law_names()),
                                          testing::Bool()),
                         [](const auto& one) {
                           std::string name = v1::Shape_Name(std::get<0>(one.param)) + "_" + std::get<1>(one.param) +
                                              (std::get<2>(one.param) ? "_double" : "_float");
                           return name;
                         });

using Features = Agreement;

/// Wedges and tetrahedra share points in clusters.
TEST_F(Features, ViscoelasticWithSelectivePoints) {
  for (const v1::Shape shape : {v1::SHAPE_HEXAHEDRON, v1::SHAPE_WEDGE, v1::SHAPE_TETRAHEDRON}) {
    v1::Scene scene = bar(shape, "neo_hookean", true);
    v1::Body& body = *scene.mutable_bodies(0);
    body.set_quadrature(v1::QUADRATURE_SELECTIVE);
    v1::PronyTerm& term = *body.mutable_law()->add_prony();
    term.set_share(0.5);
    term.set_relaxation_time_s(0.02);
    EXPECT_LT(difference(scene, 20), 1e-10) << v1::Shape_Name(shape);
  }
}

TEST_F(Features, SecondOrderInTimeWithConsistentMass) {
  v1::Scene scene = bar(v1::SHAPE_QUADRATIC_TETRAHEDRON, "corotational", true);
  scene.mutable_bodies(0)->set_mass(v1::MASS_CONSISTENT);
  scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_BDF2);
  EXPECT_LT(difference(scene, 20), 1e-10);
}

TEST_F(Features, EquilibriumUnderPressureAndPrescribedEnd) {
  v1::Scene scene = bar(v1::SHAPE_WEDGE, "stable_neo_hookean", true);
  scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
  scene.mutable_solver()->set_newton_tolerance(1e-11);
  scene.mutable_solver()->set_cg_tolerance(1e-10);
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_loads();
  v1::Load& load = *body.add_loads();
  tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, 0.1 - 1e-6);
  tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
  load.set_pressure_pa(300);
  v1::PrescribedDisplacement& end = *body.add_prescribed();
  tests::set(*end.mutable_region()->mutable_box()->mutable_min_m(), 0.4 - 1e-6, -1, -1);
  tests::set(*end.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
  end.set_x_m(0.02);
  EXPECT_LT(difference(scene, 1), 1e-9);
}

}  // namespace
}  // namespace tensormass
