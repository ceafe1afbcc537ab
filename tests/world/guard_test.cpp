#include "world/guard.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <functional>
#include <limits>
#include <string_view>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/faulty_backend.h"
#include "support/laws.h"
#include "support/scenes.h"
#include "world/fields.h"

namespace tensormass::world {
namespace {

using tests::Fault;

/// Scenes with every kind of state that a step changes and a checkpoint must restore.
struct Kind {
  const char* name;
  std::function<void(v1::Scene&)> set;
};
const std::vector<Kind>& kinds() {
  static const std::vector<Kind> all{
      {"plain", [](v1::Scene&) {}},
      {"bdf2", [](v1::Scene& s) { s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_BDF2); }},
      {"newton", [](v1::Scene& s) { s.mutable_solver()->set_newton_max_iterations(5); }},
      {"memory",
       [](v1::Scene& s) {
         v1::PronyTerm& term = *s.mutable_bodies(0)->mutable_law()->add_prony();
         term.set_share(0.5);
         term.set_relaxation_time_s(0.03);
       }},
      {"friction",
       [](v1::Scene& s) {
         s.mutable_tools(0)->set_friction_coefficient(0.5);
         tests::set(*s.mutable_gravity_m_per_s2(), 4, -9.81, 0);  // it also slides over the probe
       }},
      {"prescribed",
       [](v1::Scene& s) {
         v1::PrescribedDisplacement& sides = *s.mutable_bodies(0)->add_prescribed();
         tests::set(*sides.mutable_region()->mutable_box()->mutable_min_m(), -1, 0.02, -1);
         tests::set(*sides.mutable_region()->mutable_box()->mutable_max_m(), 1e-6, 1, 1);
         sides.set_x_m(0.002);
         for (const double end : {0.0, 1.0}) {
           sides.mutable_schedule()->add_time_s(0.1 * end);
           sides.mutable_schedule()->add_factor(end);
         }
       }},
      {"all of it",
       [](v1::Scene& s) {
         s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_BDF2);
         s.mutable_solver()->set_newton_max_iterations(5);
         v1::PronyTerm& term = *s.mutable_bodies(0)->mutable_law()->add_prony();
         term.set_share(0.5);
         term.set_relaxation_time_s(0.03);
       }},
  };
  return all;
}

/// A block that sinks under its weight onto a probe at rest.
v1::Scene pressed_block(const Kind& kind, double dt_s = 0.01) {
  v1::Scene scene = tests::block_with_probe(true, 4);
  scene.mutable_stepping()->set_dt_s(dt_s);
  scene.mutable_tools(0)->mutable_position_m()->set_y(0.054);
  scene.mutable_tools(0)->set_max_speed_m_per_s(2);  // so fast that contact hardens at no dt_s (contact/tools.h)
  scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_STOP);
  kind.set(scene);
  return scene;
}

using Guarding = tests::OnFaultyBackend;

/// A step that is rolled back and repeated as two halves equals two steps of half the length, for all kinds of state.
TEST_P(Guarding, AStepThatIsRolledBackLeavesNoTrace) {
  for (const Kind& kind : kinds()) {
    // A step that is linearized once is tried with the projected stiffness before it is halved. The sound world
    // projects it from the start.
    const bool projects = tests::iterates(pressed_block(kind)) == false;
    const auto faulty = start_faulty(pressed_block(kind), [=](std::uint64_t step, std::uint64_t call) {
      const bool whole = call == 0 || (projects && step == 1 && call == 1);
      return whole ? std::optional(Fault::kNotANumber) : std::nullopt;
    });
    const auto sound = start_faulty(pressed_block(kind, 0.005), [=](std::uint64_t step, std::uint64_t call) {
      return projects && step == 1 && call == 0 ? std::optional(Fault::kIndefinite) : std::nullopt;
    });
    double most_force_n = 0;
    for (int i = 0; i < 5; ++i) {
      ASSERT_TRUE(faulty->step(false)) << kind.name;
      solver::StepResult halves[2];
      for (solver::StepResult& half : halves) {
        ASSERT_TRUE(sound->step(false)) << kind.name;
        half = sound->last();
      }
      EXPECT_EQ(faulty->last().cg_iterations, halves[0].cg_iterations + halves[1].cg_iterations);
      EXPECT_EQ(faulty->last().newton_iterations, halves[0].newton_iterations + halves[1].newton_iterations);
      EXPECT_EQ(faulty->last().newton_residual, std::max(halves[0].newton_residual, halves[1].newton_residual));
      EXPECT_EQ(faulty->last().converged, halves[0].converged && halves[1].converged);
      ASSERT_NE(faulty->guard_event(), nullptr);
      EXPECT_EQ(faulty->guard_event()->outcome, GuardEvent::Outcome::kRepeated);
      EXPECT_EQ(faulty->guard_event()->steps, 2u);
      EXPECT_EQ(faulty->state().displacement, sound->state().displacement) << kind.name << ", step " << i + 1;
      EXPECT_EQ(faulty->state().velocity, sound->state().velocity) << kind.name;
      EXPECT_EQ(faulty->readings()[0].force_n, sound->readings()[0].force_n) << kind.name;
      most_force_n = std::max(most_force_n, faulty->readings()[0].force_n.norm());
    }
    EXPECT_EQ(faulty->step_count(), 5u);
    EXPECT_GT(most_force_n, 0) << "the probe was among what ran";
  }
}

/// If every retry fails, the world stays at its checkpoint and continues from there as if the step had not been tried.
TEST_P(Guarding, IfEveryRetryFailsTheWorldStaysAtItsLastGoodState) {
  for (const Fault fault : {Fault::kNotANumber, Fault::kExplosion, Fault::kStall}) {
    for (const Kind& kind : kinds()) {
      // Prescribed displacements do work that is not counted, so no energy is too much.
      if (fault == Fault::kExplosion && std::string_view(kind.name) == "prescribed") continue;
      // The first part of each retry is good, so internal variables advance in it. A solve that stalls is not tried
      // with the projected stiffness.
      const std::uint64_t wholes = tests::iterates(pressed_block(kind)) || fault == Fault::kStall ? 1 : 2;
      const auto faulty = start_faulty(pressed_block(kind), [=](std::uint64_t step, std::uint64_t call) {
        const bool fails = call < wholes || (call - wholes) % 2 == 1;
        return step == 6 && fails ? std::optional(fault) : std::nullopt;
      });
      const auto sound = start(pressed_block(kind));
      faulty->set_tool_target(0, {{0.06, 0.054, 0.05}, {1, 0, 0, 0}});
      sound->set_tool_target(0, {{0.06, 0.054, 0.05}, {1, 0, 0, 0}});
      for (int i = 0; i < 5; ++i) ASSERT_TRUE(faulty->step(false) && sound->step(false));
      const auto stress = [&](World& world) {
        v1::GetFieldsRequest request;
        request.add_fields(v1::FIELD_VON_MISES_STRESS);
        const auto fields =
            measure_fields(world.model(), world.state(), world.simulated_time_s(), world.model().bodies[0], request);
        std::vector<double> values(fields->fields(0).values().size() / sizeof(double));
        std::memcpy(values.data(), fields->fields(0).values().data(), fields->fields(0).values().size());
        return Eigen::Map<Eigen::VectorXd>(values.data(), static_cast<Eigen::Index>(values.size())).eval();
      };
      const backend::RowState before = faulty->state();
      const Eigen::VectorXd stress_before = stress(*faulty);
      const ToolReading reading = faulty->readings()[0];

      ASSERT_FALSE(faulty->step(false)) << kind.name;
      ASSERT_NE(faulty->guard_event(), nullptr);
      EXPECT_EQ(faulty->guard_event()->outcome, GuardEvent::Outcome::kStopped);
      EXPECT_EQ(faulty->guard_event()->step, 6u);
      EXPECT_EQ(faulty->guard_event()->retries, 3u);
      EXPECT_EQ(faulty->step_count(), 5u);
      EXPECT_EQ(faulty->state().displacement, before.displacement) << kind.name;
      EXPECT_EQ(faulty->state().velocity, before.velocity) << kind.name;
      EXPECT_EQ(faulty->readings()[0].pose.position_m, reading.pose.position_m);
      EXPECT_LT((stress(*faulty) - stress_before).norm(), 1e-12 * stress_before.norm()) << kind.name;

      for (int i = 0; i < 5; ++i) ASSERT_TRUE(faulty->step(false) && sound->step(false));
      EXPECT_EQ(faulty->state().displacement, sound->state().displacement) << kind.name;
      EXPECT_EQ(faulty->readings()[0].force_n, sound->readings()[0].force_n) << kind.name;
    }
  }
}

TEST_P(Guarding, TheFirstRetryRestoresIterationsThatTheBudgetLowered) {
  v1::Scene scene = pressed_block(kinds()[0]);
  scene.mutable_solver()->set_cg_tolerance(1e-8);
  scene.mutable_solver()->set_floor_tolerance(1e-4);
  const auto world = start(scene), all = start(scene);
  world->set_cg_limit(3);
  for (int i = 0; i < 3; ++i) {
    ASSERT_TRUE(world->step(false) && all->step(false));
    ASSERT_NE(world->guard_event(), nullptr);
    EXPECT_EQ(world->guard_event()->first.breach, Breach::kLinearResidual);
    EXPECT_EQ(world->guard_event()->first.bound, 1e-4);
    EXPECT_EQ(world->guard_event()->steps, 1u);
    EXPECT_LE(world->last().cg_relative_residual, 1e-4);
    EXPECT_EQ(all->guard_event(), nullptr);
    EXPECT_EQ(world->state().displacement, all->state().displacement);
  }
}

TEST_P(Guarding, AStepFailsIfNoRetryReachesTheFloorTolerance) {
  v1::Scene scene = pressed_block(kinds()[0]);
  scene.mutable_solver()->set_cg_max_iterations(1);
  scene.mutable_solver()->set_cg_tolerance(1e-9);
  scene.mutable_solver()->set_floor_tolerance(1e-9);
  const auto world = start(scene);
  EXPECT_FALSE(world->step(false));
  EXPECT_EQ(world->guard_event()->first.breach, Breach::kLinearResidual);
  EXPECT_EQ(world->guard_event()->last.breach, Breach::kLinearResidual);
}

/// One of two plates is pushed through the other, with a block between them. No node is free, so only the law decides.
TEST_P(Guarding, OnlyLawsThatDoNotRecoverAreStoppedByInversion) {
  const auto check = [&](const std::string& name, bool double_precision) {
    SCOPED_TRACE(double_precision ? "double" : "float");
    v1::Scene scene = tests::beam_scene({.cells_x = 1,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .size_x_m = 0.4,
                                         .size_y_m = 0.1,
                                         .size_z_m = 0.1,
                                         .double_precision = double_precision,
                                         .cg_max_iterations = 500,
                                         .cg_tolerance = 1e-6});
    scene.clear_gravity_m_per_s2();
    v1::Body& body = *scene.mutable_bodies(0);
    *body.mutable_law() = tests::law(name, 1e5, 0.3);
    v1::PrescribedDisplacement& end = *body.add_prescribed();
    tests::set(*end.mutable_region()->mutable_box()->mutable_min_m(), 0.4 - 1e-6, -1, -1);
    tests::set(*end.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
    end.set_x_m(-0.6);
    end.set_y_m(0);
    end.set_z_m(0);
    end.mutable_schedule()->add_time_s(0);
    end.mutable_schedule()->add_factor(0);
    end.mutable_schedule()->add_time_s(0.2);
    end.mutable_schedule()->add_factor(1);
    const auto world = start(scene);
    int steps = 0;
    while (steps < 30 && world->step(false)) ++steps;
    const int law = world->model().groups[0].law;
    physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
      using Law = typename decltype(tag)::Type;
      if (index != law) return;
      if (Law::kInversion != physics::Inversion::kCaught) {
        EXPECT_EQ(steps, 30) << name << ": " << to_text(*world->guard_event(), world->model());
        return;
      }
      EXPECT_EQ(steps, 13) << name << ": 3 cm each, 40 cm in all";
      EXPECT_EQ(world->guard_event()->first.breach, Breach::kVolume) << name;
      EXPECT_NEAR(world->guard_event()->first.value, -0.05, double_precision ? 1e-6 : 1e-5) << name << ": 42 cm";
      world->diagnose();
      EXPECT_NEAR(world->diagnostics()[0].min_det_f, 0.025, double_precision ? 1e-6 : 1e-5)
          << name << ": the state that it stands in";
    });
  };
  for (const std::string& name : tests::law_names()) {
    check(name, true);
    check(name, false);
  }
}

/// After n steps v_n = n g dt. Kinetic energy is m (g dt)² n² / 2, and gravity did the work m (g dt)² n (n + 1) / 2.
TEST_P(Guarding, CountsTheEnergyThatImplicitEulerDissipatesInAFall) {
  v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                       .cells_y = 2,
                                       .cells_z = 2,
                                       .double_precision = true,
                                       .cg_max_iterations = 500,
                                       .cg_tolerance = 1e-14});
  scene.mutable_bodies(0)->clear_fixed();
  const auto world = start(scene);
  const double mass = world->model().bodies[0].mass_kg, n = 20, unit = mass * std::pow(9.81 * 0.01, 2) / 2;
  for (int i = 0; i < n; ++i) ASSERT_TRUE(world->step(false));
  world->diagnose();
  EXPECT_NEAR(world->energy().work_j(), unit * n * (n + 1), 1e-9 * unit * n * n);
  EXPECT_NEAR(world->energy().kinetic_j(), unit * n * n, 1e-9 * unit * n * n);
  EXPECT_NEAR(world->energy().elastic_j(), 0, 1e-9 * unit * n * n);
  EXPECT_NEAR(world->energy().dissipated_j().value(), unit * n, 1e-8 * unit * n * n);
}

/// Holds for every law and shape: GetFields computes the energy on the host.
TEST_P(Guarding, ElasticEnergyEqualsThatOfTheFields) {
  for (const v1::Shape shape : tests::shapes()) {
    for (const std::string& name : tests::law_names()) {
      v1::Scene scene = tests::block_with_probe(true, 2);
      scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
      scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
      *scene.mutable_bodies(0)->mutable_law() = tests::law(name, 5e3, 0.4);
      const auto world = start(scene);
      for (int i = 0; i < 3; ++i) ASSERT_TRUE(world->step(false));
      world->diagnose();
      const auto fields =
          measure_fields(world->model(), world->state(), world->simulated_time_s(), world->model().bodies[0], {});
      EXPECT_GT(fields->elastic_energy_j(), 0);
      EXPECT_NEAR(world->energy().elastic_j(), fields->elastic_energy_j(), 1e-9 * fields->elastic_energy_j())
          << name << ", " << v1::Shape_Name(shape);
    }
  }
}

/// The work of a tool that presses equals the energy in the tissue plus the energy that the time scheme dissipated.
TEST_P(Guarding, WorkOfToolsIsCounted) {
  v1::Scene scene = tests::block_with_probe(true, 6);
  scene.clear_gravity_m_per_s2();
  const auto world = start(scene);
  for (int i = 0; i < 100; ++i) {
    world->set_tool_target(0, {{0.05, 0.06 - 0.0001 * i, 0.05}, {1, 0, 0, 0}});
    ASSERT_TRUE(world->step(false));
  }
  world->diagnose();
  EXPECT_GT(world->energy().work_j(), 0);
  EXPECT_GT(world->energy().elastic_j(), 0.3 * world->energy().work_j()) << "pressed slowly, most of it is there";
  EXPECT_GT(world->energy().dissipated_j().value(), 0);
}

TM_ON_EACH_BACKEND(Guarding);

model::Model model_of(const v1::Scene& scene) { return std::move(model::compile(scene, {1, 1}).value()); }

/// The block of 0.1 × 0.05 × 0.1 m is 0.15 m across.
TEST(GuardBounds, EachBoundIsChecked) {
  v1::Scene scene = tests::block_with_probe();
  const model::Model model = model_of(scene);
  const Guard guard(model);
  const StepEnergy energy{.available_j = 1};
  const solver::StepResult good{.max_move_m = 0.14,
                                .max_distance_m = 1.4,
                                .kinetic_energy_j = 3.9,
                                .min_det_f = 1e-6,
                                .newton_residual = 0.9,
                                .converged = false};
  EXPECT_TRUE(guard.check(good, energy).good()) << to_text(guard.check(good, energy));
  solver::StepResult at_rest = good;
  at_rest.newton_residual = 1.1;
  at_rest.converged = true;
  EXPECT_TRUE(guard.check(at_rest, energy).good()) << "what is left of forces that are rounding moves nothing";
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  const auto breach = [&](auto member, auto value) {
    solver::StepResult bad = good;
    bad.*member = value;
    const BoundCheck check = guard.check(bad, energy);
    EXPECT_FALSE(to_text(check).empty());
    return check.breach;
  };
  using Result = solver::StepResult;
  EXPECT_EQ(breach(&Result::finite, false), Breach::kNotFinite);
  EXPECT_EQ(breach(&Result::max_move_m, 0.16), Breach::kMove);
  EXPECT_EQ(breach(&Result::max_distance_m, 1.6), Breach::kDistance);
  EXPECT_EQ(breach(&Result::kinetic_energy_j, 4.1), Breach::kEnergy);
  EXPECT_EQ(breach(&Result::kinetic_energy_j, kNan), Breach::kEnergy);
  EXPECT_EQ(breach(&Result::cg_relative_residual, 101.0), Breach::kLinearResidual);
  EXPECT_EQ(breach(&Result::newton_residual, 1.1), Breach::kNewtonResidual);
  EXPECT_EQ(breach(&Result::min_det_f, 0.0), Breach::kVolume);
  EXPECT_EQ(breach(&Result::min_det_f, kNan), Breach::kVolume);
}

TEST(GuardBounds, TheSceneMaySetThem) {
  v1::Scene scene = tests::block_with_probe();
  scene.mutable_guard()->set_max_move_m(0.3);
  scene.mutable_guard()->set_max_distance_m(3);
  scene.mutable_guard()->set_max_energy_ratio(8);
  const model::Model model = model_of(scene);
  const Guard guard(model);
  EXPECT_TRUE(
      guard.check({.max_move_m = 0.29, .max_distance_m = 2.9, .kinetic_energy_j = 7.9}, {.available_j = 1}).good());
  EXPECT_EQ(guard.check({.max_move_m = 0.31}, {}).bound, 0.3);
  EXPECT_EQ(guard.check({.max_distance_m = 3.1}, {}).bound, 3);
  EXPECT_EQ(guard.check({.kinetic_energy_j = 8.1}, {.available_j = 1}).breach, Breach::kEnergy);
}

TEST(GuardBounds, AnEquilibriumMustConvergeAndMayThenBeFar) {
  v1::Scene scene = tests::block_with_probe();
  scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
  const Guard guard(model_of(scene));
  const solver::StepResult far{.max_move_m = 100, .max_distance_m = 100, .newton_residual = 1e-4};
  EXPECT_TRUE(guard.check(far, {}).good());
  solver::StepResult ended = far;
  ended.converged = false;
  EXPECT_EQ(guard.check(ended, {}).breach, Breach::kNoEquilibrium);
  solver::StepResult inverted = far;
  inverted.min_det_f = -1;
  EXPECT_EQ(guard.check(inverted, {}).breach, Breach::kVolume);
  scene.mutable_solver()->set_allow_unconverged(true);
  const Guard lenient(model_of(scene));
  ended.max_move_m = ended.max_distance_m = 0.01;
  EXPECT_TRUE(lenient.check(ended, {}).good());
  EXPECT_EQ(lenient.check(far, {}).breach, Breach::kMove);
}

TEST(GuardBounds, KineticEnergyMayReachTheAvailableEnergy) {
  const model::Model model = model_of(tests::block_with_probe());
  const Guard guard(model);
  const solver::StepResult moving{.kinetic_energy_j = 1};
  EXPECT_EQ(guard.check(moving, {}).breach, Breach::kEnergy);
  EXPECT_TRUE(guard.check(moving, {.available_j = 1}).good());
  EXPECT_TRUE(guard.check(moving, {.tools_work_j = 1}).good());
  EXPECT_TRUE(guard.check(moving, {.contacts_j = 1}).good());
  solver::StepResult loaded = moving;
  loaded.work_j = 1;
  EXPECT_TRUE(guard.check(loaded, {}).good());
  EXPECT_EQ(guard.check(moving, {.available_j = 0.2, .tools_work_j = -10}).breach, Breach::kEnergy);

  EXPECT_TRUE(guard.trusts(moving, {.available_j = 1}));
  EXPECT_FALSE(guard.trusts(moving, {.available_j = 0.9})) << "within the bound, and still from nowhere";
  EXPECT_TRUE(guard.check(moving, {.available_j = 0.9}).good());
  EXPECT_TRUE(guard.trusts({.max_move_m = 0.014}, {}));
  EXPECT_FALSE(guard.trusts({.max_move_m = 0.016}, {})) << "a tenth of 0.15 m";

  EnergyBalance balance(model);
  balance.add_step(1, 2, 3);
  balance.add_step(2, 1, -4);
  EXPECT_EQ(balance.available_j(), 6) << "work that went out was kinetic energy, or elastic energy before";
  EXPECT_EQ(balance.work_j(), 2);
  balance.take_elastic(0.5);
  EXPECT_EQ(balance.available_j(), 2.5);
  EXPECT_EQ(balance.dissipated_j(), -0.5);
}

TEST(GuardBounds, FreeBodiesAndPrescribedDisplacementsWidenThem) {
  v1::Scene scene = tests::block_with_probe();
  v1::Scene loose = scene;
  loose.mutable_bodies(0)->clear_fixed();
  const solver::StepResult far{.max_distance_m = 100};
  EXPECT_EQ(Guard(model_of(scene)).check(far, {}).breach, Breach::kDistance);
  EXPECT_TRUE(Guard(model_of(loose)).check(far, {}).good()) << "no node is fixed";

  v1::PrescribedDisplacement& pull = *scene.mutable_bodies(0)->add_prescribed();
  tests::set(*pull.mutable_region()->mutable_box()->mutable_min_m(), -1, 0.049, -1);
  tests::set(*pull.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
  pull.set_y_m(0.5);
  const model::Model prescribed = model_of(scene);
  EXPECT_TRUE(Guard(prescribed).check({.max_move_m = 0.5}, {}).good());
  EXPECT_TRUE(Guard(prescribed).check({.kinetic_energy_j = 1e6}, {}).good())
      << "work of prescribed displacements is not counted";
  EXPECT_FALSE(EnergyBalance(prescribed).dissipated_j().has_value());
}

}  // namespace
}  // namespace tensormass::world
