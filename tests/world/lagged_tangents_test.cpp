#include <algorithm>
#include <cmath>
#include <functional>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/laws.h"
#include "support/momentum.h"
#include "support/scenes.h"
#include "world/world.h"

/// Elements that follow their last tangents (matrix/lagged_tangents.h): what the lag costs, and what it keeps.
namespace tensormass::world {
namespace {

constexpr double kDtS = 2e-3;

/// A free bar that turns and swings.
v1::Scene swinging_bar(v1::Shape shape, const std::string& law, bool double_precision = true) {
  v1::Scene scene = tests::beam_scene({.cells_x = 9,
                                       .cells_y = 2,
                                       .cells_z = 3,
                                       .size_x_m = 0.8,
                                       .size_y_m = 0.1,
                                       .size_z_m = 0.1,
                                       .double_precision = double_precision,
                                       .dt_s = kDtS,
                                       .cg_max_iterations = 2000,
                                       .cg_tolerance = double_precision ? 1e-12 : 1e-6});
  scene.mutable_solver()->set_cpu_threads(3);
  scene.clear_gravity_m_per_s2();
  v1::Body& body = *scene.mutable_bodies(0);
  body.mutable_mesh()->mutable_grid()->set_shape(shape);
  *body.mutable_law() = tests::law(law, 1e5, 0.4);
  body.clear_fixed();
  return scene;
}

v1::Scene lagged(v1::Scene scene, std::uint32_t steps, double strain) {
  scene.mutable_solver()->set_tangent_lag_steps(steps);
  scene.mutable_solver()->set_tangent_lag_strain(strain);
  return scene;
}

double distance(const std::vector<double>& a, const std::vector<double>& b) {
  double difference = 0, size = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    difference += (a[i] - b[i]) * (a[i] - b[i]);
    size += b[i] * b[i];
  }
  return std::sqrt(difference / size);
}

class LaggedTangents : public tests::OnBackend {
 protected:
  /// Gives the bar a turn of 3 rad/s and a swing.
  std::unique_ptr<World> swing(v1::Scene scene) const {
    const auto at_rest = start(scene);
    const model::Model& model = at_rest->model();
    std::vector<double> velocity;
    for (const std::uint32_t row : model.layout.row_of_node) {
      const double x = model.rest[4 * row], y = model.rest[4 * row + 1];
      velocity.insert(velocity.end(), {0.5 - 3 * y, 3 * x + 4 * x * x, 0.2});
    }
    scene.mutable_bodies(0)->set_initial_velocity_m_per_s(velocity.data(), velocity.size() * sizeof(double));
    return start(scene);
  }
  std::vector<double> after(const v1::Scene& scene, int steps) const { return after(*swing(scene), steps); }
  static std::vector<double> after(World& world, int steps) {
    for (int i = 0; i < steps; ++i) {
      if (!world.step(false)) throw std::runtime_error("the scene stopped");
    }
    return world.state().displacement;
  }
};

/// A bound that every motion exceeds has all elements evaluated in each step. What is kept must then be what is new:
/// sums that go astray, a block that is transposed or a row that is left out would show.
TEST_P(LaggedTangents, WithoutALagMoveAsIfThereWereNone) {
  for (const v1::Shape shape : tests::shapes()) {
    SCOPED_TRACE(v1::Shape_Name(shape));
    const v1::Scene scene = swinging_bar(shape, "stable_neo_hookean");
    EXPECT_LT(distance(after(lagged(scene, 16, 1e-6), 20), after(scene, 20)), 1e-9);
  }
  for (const std::string& law : tests::law_names()) {
    SCOPED_TRACE(law);
    v1::Scene scene = swinging_bar(v1::SHAPE_TETRAHEDRON, law);
    EXPECT_LT(distance(after(lagged(scene, 16, 1e-6), 20), after(scene, 20)), 1e-9);
    scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
    EXPECT_LT(distance(after(lagged(scene, 16, 1e-6), 20), after(scene, 20)), 1e-9);
  }
}

struct Beside {
  const char* name;
  std::function<void(v1::Scene&)> add;
};

/// What else adds to the rows of elements that lag, and schemes that evaluate forces elsewhere.
TEST_P(LaggedTangents, AddToWhatElseARowHas) {
  const auto half = [](v1::Scene& s, const v1::Law& law) {
    v1::LawRegion& region = *s.mutable_bodies(0)->add_law_regions();
    tests::set(*region.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
    tests::set(*region.mutable_region()->mutable_box()->mutable_max_m(), 0.4, 1, 1);
    *region.mutable_law() = law;
  };
  const std::vector<Beside> all{
      {"linear law", [&](v1::Scene& s) { half(s, tests::law("hooke", 1e5, 0.3)); }},
      {"viscoelastic law",
       [&](v1::Scene& s) {
         v1::Law law = tests::law("neo_hookean", 1e5, 0.3);
         v1::PronyTerm& term = *law.add_prony();
         term.set_share(0.4);
         term.set_relaxation_time_s(0.1);
         half(s, law);
       }},
      {"another law", [&](v1::Scene& s) { half(s, tests::law("st_venant_kirchhoff", 1e5, 0.3)); }},
      {"consistent mass", [](v1::Scene& s) { s.mutable_bodies(0)->set_mass(v1::MASS_CONSISTENT); }},
      {"damping", [](v1::Scene& s) { s.mutable_bodies(0)->set_rayleigh_stiffness_s(0.01); }},
      {"BDF2", [](v1::Scene& s) { s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_BDF2); }},
      {"midpoint", [](v1::Scene& s) { s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT); }},
      {"coarse level", [](v1::Scene& s) { s.mutable_solver()->set_coarse_level(true); }},
  };
  for (const Beside& one : all) {
    SCOPED_TRACE(one.name);
    v1::Scene scene = swinging_bar(v1::SHAPE_TETRAHEDRON, "stable_neo_hookean");
    scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
    one.add(scene);
    EXPECT_LT(distance(after(lagged(scene, 16, 1e-6), 20), after(scene, 20)), 1e-8);
  }
}

/// The error is of second order in the change of F that ends a lag.
TEST_P(LaggedTangents, MoveLessTheShorterTheirLag) {
  const v1::Scene scene = swinging_bar(v1::SHAPE_TETRAHEDRON, "stable_neo_hookean");
  const std::vector<double> exact = after(scene, 100);
  const double wide = distance(after(lagged(scene, 64, 0.04), 100), exact);
  const double half = distance(after(lagged(scene, 64, 0.02), 100), exact);
  EXPECT_GT(wide, 1e-6) << "nothing lags";
  EXPECT_LT(wide, 5e-3);
  EXPECT_LT(half, 0.5 * wide);
}

/// All rows of an element follow the same tangent, so that its forces balance. In float the sums drift by rounding.
TEST_P(LaggedTangents, KeepMomentum) {
  for (const v1::Shape shape : tests::shapes()) {
    for (const bool double_precision : {true, false}) {
      SCOPED_TRACE(v1::Shape_Name(shape) + (double_precision ? ", double" : ", float"));
      const auto world = swing(lagged(swinging_bar(shape, "stable_neo_hookean", double_precision), 8, 0.02));
      const Vec3<double> before = tests::momentum_of(*world);
      for (int i = 0; i < 200; ++i) ASSERT_TRUE(world->step(false));
      EXPECT_LT((tests::momentum_of(*world) - before).norm(), (double_precision ? 1e-9 : 5e-4) * before.norm());
    }
  }
}

/// Forces of a stiff part that did not balance would be those of the soft part beside it.
TEST_P(LaggedTangents, RoundAlikeBesideAPartAMillionTimesSofter) {
  const auto bar = [](bool double_precision) {
    v1::Scene scene = swinging_bar(v1::SHAPE_TETRAHEDRON, "stable_neo_hookean", double_precision);
    v1::Body& body = *scene.mutable_bodies(0);
    body.mutable_law()->mutable_stable_neo_hookean()->set_young_modulus_pa(1e9);
    v1::LawRegion& soft = *body.add_law_regions();
    tests::set(*soft.mutable_region()->mutable_box()->mutable_min_m(), 0.4, -1, -1);
    tests::set(*soft.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
    *soft.mutable_law() = tests::law("stable_neo_hookean", 1e3, 0.4);
    v1::Box& clamp = *body.add_fixed()->mutable_box();
    tests::set(*clamp.mutable_min_m(), -1, -1, -1);
    tests::set(*clamp.mutable_max_m(), 1e-6, 1, 1);
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, -1, 0);
    return lagged(scene, 8, 0.02);
  };
  EXPECT_LT(distance(after(*start(bar(false)), 50), after(*start(bar(true)), 50)), 1e-3);
}

/// At rest every tangent is that of the state, so the equilibrium is the one without a lag.
TEST_P(LaggedTangents, EndInTheSameEquilibrium) {
  v1::Scene scene = tests::block_with_probe(true, 6);
  *scene.mutable_bodies(0)->mutable_law() = tests::law("stable_neo_hookean", 5e3, 0.4);
  scene.mutable_bodies(0)->set_rayleigh_mass_per_s(40);
  scene.clear_tools();
  EXPECT_LT(distance(after(*start(lagged(scene, 16, 0.05)), 300), after(*start(scene), 300)), 1e-8);
}

/// What an edit takes is not in the next step, also where no element is left that lags.
TEST_P(LaggedTangents, ForgetWhatIsTaken) {
  v1::Scene scene = swinging_bar(v1::SHAPE_TETRAHEDRON, "stable_neo_hookean");
  v1::LawRegion& region = *scene.mutable_bodies(0)->add_law_regions();
  tests::set(*region.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
  tests::set(*region.mutable_region()->mutable_box()->mutable_max_m(), 0.4, 1, 1);
  *region.mutable_law() = tests::law("hooke", 1e5, 0.3);
  scene.mutable_editing();
  scene.mutable_solver()->set_cg_max_iterations(400);
  std::vector<double> displacements[2];
  for (const bool lags : {false, true}) {
    const auto world = swing(lags ? lagged(scene, 64, 1) : scene);
    ASSERT_TRUE(world->step(false));
    std::vector<model::Ablation> edit;
    const model::Model& m = world->model();
    for (const model::ElementGroup& group : m.groups) {
      if (group.is_constant) continue;
      for (const std::uint32_t element : group.elements) {
        if (element != mesh::kNone) edit.push_back({element, 0});
      }
    }
    ASSERT_TRUE(world->edit(edit, {}));
    ASSERT_TRUE(world->step(false));
    displacements[lags ? 1 : 0] = world->state().displacement;
  }
  EXPECT_LT(distance(displacements[1], displacements[0]), 1e-6);
}

/// A reset repeats the run.
TEST_P(LaggedTangents, ForgetWhatDoesNotFit) {
  const v1::Scene scene = lagged(swinging_bar(v1::SHAPE_TETRAHEDRON, "stable_neo_hookean"), 64, 1);
  const auto one = swing(scene);
  for (int i = 0; i < 30; ++i) ASSERT_TRUE(one->step(false));
  const backend::RowState far = one->state();
  one->reset();
  for (int i = 0; i < 30; ++i) ASSERT_TRUE(one->step(false));
  EXPECT_EQ(one->state().displacement, far.displacement) << "a reset repeats the run";
}

TM_ON_EACH_BACKEND(LaggedTangents);

}  // namespace
}  // namespace tensormass::world
