#include <cmath>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/scenes.h"
#include "world/world.h"

/// Time schemes with one linearized solve a step: how far they are from the converged step, and their order.
namespace tensormass::world {
namespace {

class TimeScheme : public tests::OnBackend {
 protected:
  /// A bar that is clamped at one end and falls under its weight, for 0.2 s.
  static v1::Scene falling_bar(v1::Solver::Integrator integrator, double dt_s, std::uint32_t newton_iterations) {
    v1::Scene scene = tests::beam_scene({.cells_x = 8,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .size_x_m = 0.8,
                                         .size_y_m = 0.1,
                                         .size_z_m = 0.1,
                                         .double_precision = true,
                                         .young_modulus_pa = 1e5,
                                         .dt_s = dt_s,
                                         .cg_max_iterations = 2000,
                                         .cg_tolerance = 1e-10});
    scene.mutable_solver()->set_integrator(integrator);
    scene.mutable_solver()->set_newton_max_iterations(newton_iterations);
    scene.mutable_solver()->set_newton_tolerance(1e-10);
    return scene;
  }
  std::vector<double> after_fall(v1::Solver::Integrator integrator, double dt_s, std::uint32_t newton_iterations) {
    const auto world = start(falling_bar(integrator, dt_s, newton_iterations));
    const int steps = static_cast<int>(std::lround(0.2 / dt_s));
    for (int i = 0; i < steps; ++i) EXPECT_TRUE(world->step(false));
    return world->state().displacement;
  }
  static double distance(const std::vector<double>& a, const std::vector<double>& b) {
    double difference = 0, size = 0;
    for (std::size_t i = 0; i < a.size(); ++i) {
      difference += (a[i] - b[i]) * (a[i] - b[i]);
      size += b[i] * b[i];
    }
    return std::sqrt(difference / size);
  }
};

TEST_P(TimeScheme, OneSolveIsCloseToTheConvergedStep) {
  constexpr auto kEuler = v1::Solver::INTEGRATOR_IMPLICIT_EULER;
  EXPECT_LT(distance(after_fall(kEuler, 1e-3, 1), after_fall(kEuler, 1e-3, 20)), 1e-3);
  EXPECT_LT(distance(after_fall(kEuler, 1e-2, 1), after_fall(kEuler, 1e-2, 20)), 0.05);
}

TEST_P(TimeScheme, ItsOrderIsThatOfTheScheme) {
  constexpr auto kMidpoint = v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT;
  const std::vector<double> limit = after_fall(kMidpoint, 2.5e-4, 1);
  struct Scheme {
    v1::Solver::Integrator integrator;
    double order;
  };
  for (const auto& [integrator, order] : {Scheme{v1::Solver::INTEGRATOR_IMPLICIT_EULER, 1},
                                          Scheme{v1::Solver::INTEGRATOR_BDF2, 2}, Scheme{kMidpoint, 2}}) {
    const double coarse = distance(after_fall(integrator, 4e-3, 1), limit);
    const double fine = distance(after_fall(integrator, 2e-3, 1), limit);
    EXPECT_NEAR(std::log2(coarse / fine), order, 0.15) << v1::Solver::Integrator_Name(integrator);
  }
}

/// A free bar that spins and swings: nothing acts on it.
TEST_P(TimeScheme, TheMidpointRuleKeepsMomentumAndEnergy) {
  v1::Scene scene = falling_bar(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT, 2e-3, 20);
  scene.clear_gravity_m_per_s2();
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_fixed();
  const auto at_rest = start(scene);
  const model::Model& model = at_rest->model();
  // The whole turns about z by 3 rad/s, and its end swings along y.
  std::vector<double> velocity;
  for (const std::uint32_t row : model.layout.row_of_node) {
    const double x = model.rest[4 * row], y = model.rest[4 * row + 1];
    velocity.insert(velocity.end(), {0.5 - 3 * y, 3 * x + 4 * x * x, 0.2});
  }
  body.set_initial_velocity_m_per_s(velocity.data(), velocity.size() * sizeof(double));
  const auto world = start(scene);
  struct Momenta {
    Vec3<double> linear = Vec3<double>::Zero(), angular = Vec3<double>::Zero();
  };
  const auto measure = [&] {
    const backend::RowState state = world->state();
    Momenta sum;
    for (const std::uint32_t row : model.layout.row_of_node) {
      const auto three = [row](const std::vector<double>& v) {
        return Vec3<double>(v[4 * row], v[4 * row + 1], v[4 * row + 2]);
      };
      const Vec3<double> p = model.row_mass[row] * three(state.velocity);
      sum.linear += p;
      sum.angular += (three(model.rest) + three(state.displacement)).cross(p);
    }
    world->diagnose();
    return sum;
  };
  const Momenta before = measure();
  const double energy = world->energy().kinetic_j() + world->energy().elastic_j();
  double most = 0;
  for (int i = 0; i < 500; ++i) {
    ASSERT_TRUE(world->step(false));
    world->diagnose();
    most = std::max(most, std::abs(world->energy().kinetic_j() + world->energy().elastic_j() - energy));
  }
  const Momenta after = measure();
  EXPECT_LT((after.linear - before.linear).norm(), 1e-9 * before.linear.norm());
  EXPECT_LT((after.angular - before.angular).norm(), 1e-7 * before.angular.norm());
  EXPECT_LT(most, 0.01 * energy) << "implicit Euler has lost most of the swing by now";
  EXPECT_GT(world->energy().elastic_j(), 0);
}

/// The end of a free chain of steps moves half of the way in the middle of the step, so that it arrives at its end.
TEST_P(TimeScheme, TheMidpointRuleMovesPrescribedNodesToTheirPlaces) {
  v1::Scene scene = falling_bar(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT, 2e-3, 5);
  v1::PrescribedDisplacement& end = *scene.mutable_bodies(0)->add_prescribed();
  tests::set(*end.mutable_region()->mutable_box()->mutable_min_m(), 0.8 - 1e-6, -1, -1);
  tests::set(*end.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
  end.set_y_m(0.02);
  for (const double time : {0.0, 0.1}) {
    end.mutable_schedule()->add_time_s(time);
    end.mutable_schedule()->add_factor(time * 10);
  }
  const auto world = start(scene);
  const model::Model& model = world->model();
  for (int i = 1; i <= 60; ++i) {
    ASSERT_TRUE(world->step(false));
    const backend::RowState state = world->state();
    for (const std::uint32_t row : model.layout.row_of_node) {
      if (model.rest[4 * row] < 0.8 - 1e-6) continue;
      EXPECT_NEAR(state.displacement[4 * row + 1], 0.02 * std::min(1.0, 0.02 * i), 1e-12);
    }
  }
}

TEST_P(TimeScheme, TheMidpointRuleRefusesPronyTerms) {
  v1::Scene scene = falling_bar(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT, 2e-3, 1);
  v1::PronyTerm& term = *scene.mutable_bodies(0)->mutable_law()->add_prony();
  term.set_share(0.5);
  term.set_relaxation_time_s(0.1);
  const auto model = model::compile(scene, {1, 1});
  ASSERT_FALSE(model);
  EXPECT_NE(model.error().message.find("scene.solver.integrator"), std::string::npos);
}

/// A step in which a tool touches is one of implicit Euler: the midpoint rule would keep the energy that contact takes
/// out. BDF2 makes such steps where tools keep their force.
TEST_P(TimeScheme, InContactStepsAreThoseOfImplicitEuler) {
  struct Kind {
    v1::Solver::Integrator integrator;
    v1::ContactMethod method;
    bool by_euler;
  };
  constexpr auto kPenalty = v1::CONTACT_METHOD_PENALTY, kKept = v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN;
  for (const std::uint32_t newton_iterations : {1u, 10u}) {
    for (const auto& [integrator, method, by_euler] :
         {Kind{v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT, kPenalty, true},
          Kind{v1::Solver::INTEGRATOR_BDF2, kKept, true}, Kind{v1::Solver::INTEGRATOR_BDF2, kPenalty, false}}) {
      SCOPED_TRACE(v1::Solver::Integrator_Name(integrator) + ", " + v1::ContactMethod_Name(method));
      v1::Scene scene = tests::block_with_probe(true, 4);
      scene.clear_gravity_m_per_s2();
      scene.mutable_solver()->set_newton_max_iterations(newton_iterations);
      scene.mutable_solver()->set_newton_tolerance(1e-10);
      scene.mutable_tools(0)->set_contact_method(method);
      const auto euler = start(scene);
      scene.mutable_solver()->set_integrator(integrator);
      const auto world = start(scene);
      double force_n = 0;
      for (int i = 0; i < 20; ++i) {
        for (const auto& of : {euler.get(), world.get()}) {
          of->set_tool_target(0, {{0.05, 0.06 - 1e-4 * i, 0.05}, {1, 0, 0, 0}});
          ASSERT_TRUE(of->step(false));
        }
        force_n = euler->readings()[0].force_n[1];
      }
      ASSERT_GT(force_n, 0);
      const double off = distance(world->state().displacement, euler->state().displacement);
      EXPECT_EQ(off < 1e-9, by_euler) << off;
    }
  }
}

/// Bodies that touch each other likewise.
TEST_P(TimeScheme, WhileBodiesTouchTheMidpointRuleMakesStepsOfImplicitEuler) {
  v1::Scene scene = tests::block_with_probe(true, 4);
  scene.clear_tools();
  v1::Body& above = *scene.add_bodies();
  above = scene.bodies(0);
  above.set_name("above");
  above.clear_fixed();
  tests::set(*above.mutable_mesh()->mutable_translation_m(), 0, 0.0501, 0);
  v1::BodyContact& contact = *scene.add_body_contacts();
  contact.set_body("above");
  contact.set_other(scene.bodies(0).name());
  const auto euler = start(scene);
  scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT);
  const auto world = start(scene);
  for (int i = 0; i < 20; ++i) {
    ASSERT_TRUE(euler->step(false) && world->step(false));
    ASSERT_GT(world->last().touching_nodes, 0u);
  }
  EXPECT_LT(distance(world->state().displacement, euler->state().displacement), 1e-9);
}

/// A bar that is pushed together far beyond its buckling load: the consistent stiffness is indefinite there.
TEST_P(TimeScheme, AnIndefiniteStiffnessIsProjected) {
  v1::Scene scene = falling_bar(v1::Solver::INTEGRATOR_IMPLICIT_EULER, 0.05, 1);
  scene.mutable_solver()->set_cg_tolerance(1e-6);
  v1::PrescribedDisplacement& end = *scene.mutable_bodies(0)->add_prescribed();
  tests::set(*end.mutable_region()->mutable_box()->mutable_min_m(), 0.8 - 1e-6, -1, -1);
  tests::set(*end.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
  end.set_x_m(-0.2);
  end.mutable_schedule()->add_time_s(0);
  end.mutable_schedule()->add_factor(0);
  end.mutable_schedule()->add_time_s(1);
  end.mutable_schedule()->add_factor(1);
  const auto world = start(scene);
  for (int i = 0; i < 100; ++i) {
    ASSERT_TRUE(world->step(false)) << "step " << i + 1;
    EXPECT_EQ(world->guard_event(), nullptr) << "step " << i + 1;
    EXPECT_FALSE(world->last().negative_curvature) << "step " << i + 1;
  }
}

TM_ON_EACH_BACKEND(TimeScheme);

}  // namespace
}  // namespace tensormass::world
