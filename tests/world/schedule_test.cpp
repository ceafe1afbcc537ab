#include <array>
#include <cmath>
#include <functional>
#include <string>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/faulty_backend.h"
#include "support/laws.h"
#include "support/scenes.h"
#include "world/fields.h"

/// Schedules of gravity and loads.
namespace tensormass::world {
namespace {

using tests::Fault;

constexpr double kDt = 0.01;

using Points = std::vector<std::pair<double, double>>;  // time [s], factor

void set_schedule(v1::Schedule& schedule, const Points& points) {
  for (const auto& [time_s, factor] : points) {
    schedule.add_time_s(time_s);
    schedule.add_factor(factor);
  }
}

/// Gravity or a load that can follow a schedule.
struct Acting {
  const char* name;
  /// Adds it times `factor` to the scene and returns the schedule to be filled.
  std::function<v1::Schedule*(v1::Scene&, double factor)> add;
};

v1::Load& load_of_end(v1::Scene& scene) {
  v1::Load& load = *scene.mutable_bodies(0)->add_loads();
  tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), 0.4 - 1e-6, -1, -1);
  tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
  return load;
}

const std::vector<Acting>& all_that_act() {
  static const std::vector<Acting> all{
      {"force",
       [](v1::Scene& s, double factor) {
         v1::Load& load = load_of_end(s);
         tests::set(*load.mutable_force_n(), 0, 0, 3 * factor);
         return load.mutable_schedule();
       }},
      {"traction",
       [](v1::Scene& s, double factor) {
         v1::Load& load = load_of_end(s);
         tests::set(*load.mutable_traction_pa(), 0, 300 * factor, 0);
         return load.mutable_schedule();
       }},
      {"pressure",
       [](v1::Scene& s, double factor) {
         v1::Load& load = load_of_end(s);
         load.set_pressure_pa(5000 * factor);
         return load.mutable_schedule();
       }},
      {"gravity",
       [](v1::Scene& s, double factor) {
         tests::set(*s.mutable_gravity_m_per_s2(), 0, -0.5 * factor, 0);
         return s.mutable_gravity_schedule();
       }},
  };
  return all;
}

class Schedules : public tests::OnFaultyBackend {
 protected:
  /// A bar 0.4 × 0.1 × 0.1 m, clamped at x = 0, on which nothing acts.
  static v1::Scene bar(bool quasi_static) {
    v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .size_x_m = 0.4,
                                         .size_y_m = 0.1,
                                         .size_z_m = 0.1,
                                         .double_precision = true,
                                         .dt_s = kDt,
                                         .cg_max_iterations = 5000,
                                         .cg_tolerance = 1e-13});
    scene.clear_gravity_m_per_s2();
    *scene.mutable_bodies(0)->mutable_law() = tests::law("stable_neo_hookean", 1e5, 0.3);
    if (quasi_static) {
      scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
      scene.mutable_solver()->set_newton_tolerance(1e-11);
    }
    return scene;
  }
  /// The bar without its clamp, under a gravity of 2 m/s² along z times the schedule. It moves without deforming.
  static v1::Scene thrown_bar(const Points& points) {
    v1::Scene scene = bar(false);
    scene.mutable_bodies(0)->clear_fixed();
    scene.mutable_solver()->set_newton_max_iterations(3);
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, 0, 2);
    set_schedule(*scene.mutable_gravity_schedule(), points);
    return scene;
  }
  /// A slender bar under its weight, which Newton's method does not reach at once.
  static v1::Scene bent_bar(const Points& points) {
    v1::Scene scene = tests::beam_scene({.cells_x = 16,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .size_x_m = 1,
                                         .size_y_m = 0.05,
                                         .size_z_m = 0.05,
                                         .double_precision = true,
                                         .dt_s = kDt});
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, -60, 0);
    *scene.mutable_bodies(0)->mutable_law() = tests::law("neo_hookean", 1e5, 0.3);
    scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
    scene.mutable_solver()->clear_cg_max_iterations();
    scene.mutable_solver()->clear_cg_tolerance();
    if (!points.empty()) set_schedule(*scene.mutable_gravity_schedule(), points);
    return scene;
  }

  static Eigen::VectorXd displacement(World& world) {
    const backend::RowState state = world.state();
    return Eigen::Map<const Eigen::VectorXd>(state.displacement.data(),
                                             static_cast<Eigen::Index>(state.displacement.size()));
  }
  /// Reaction forces of all nodes [N].
  static Eigen::VectorXd reactions(World& world) {
    v1::GetFieldsRequest request;
    request.add_fields(v1::FIELD_REACTION_FORCE);
    const auto fields =
        measure_fields(world.model(), world.state(), world.simulated_time_s(), world.model().bodies[0], request);
    const std::string& bytes = fields->fields(0).values();
    return Eigen::Map<const Eigen::VectorXd>(reinterpret_cast<const double*>(bytes.data()),
                                             static_cast<Eigen::Index>(bytes.size() / sizeof(double)));
  }
  static void expect_near(const Eigen::VectorXd& found, const Eigen::VectorXd& expected, double tolerance,
                          const std::string& what) {
    EXPECT_LT((found - expected).norm(), tolerance * expected.norm()) << what;
  }
};

/// A schedule is known by its factor at the end of a step: equilibrium and reactions are those of the load times it.
TEST_P(Schedules, AStepTakesTheFactorAtItsEnd) {
  for (const Acting& acting : all_that_act()) {
    const auto constant = [&](double factor) {
      v1::Scene scene = bar(true);
      acting.add(scene, factor);
      scene.clear_gravity_schedule();
      for (v1::Load& load : *scene.mutable_bodies(0)->mutable_loads()) load.clear_schedule();
      auto world = start(scene);
      EXPECT_TRUE(world->step(false)) << acting.name;
      return world;
    };
    v1::Scene scene = bar(true);
    set_schedule(*acting.add(scene, 1), {{0, 0}, {2 * kDt, 1}, {3 * kDt, 0}});
    const auto world = start(scene);
    for (const double factor : {0.5, 1.0}) {
      const std::string what = std::string(acting.name) + " times " + std::to_string(factor);
      ASSERT_TRUE(world->step(false)) << what;
      EXPECT_EQ(world->guard_event(), nullptr) << what;
      const auto other = constant(factor);
      ASSERT_GT(displacement(*other).norm(), 1e-3) << what;
      expect_near(displacement(*world), displacement(*other), 1e-7, what);
      expect_near(reactions(*world), reactions(*other), 1e-7, what);
    }
    ASSERT_TRUE(world->step(false));
    EXPECT_LT(displacement(*world).norm(), 1e-8) << acting.name << " has ended";
    EXPECT_LT(reactions(*world).norm(), 1e-5) << acting.name << " has ended";
  }
}

/// Loads on the same nodes and faces keep their own factors and add up.
TEST_P(Schedules, EachLoadHasItsOwn) {
  v1::Scene scheduled = bar(true), constant = bar(true);
  const std::array<Points, 4> points{{{{0, 0}, {2 * kDt, 1}}, {}, {{0, 2}, {2 * kDt, 0}}, {{0, 0}, {2 * kDt, 1}}}};
  const std::array<double, 4> factors{0.5, 1, 1, 0.5};  // after the first step
  for (int round = 0; round < 2; ++round) {
    for (std::size_t i = 0; i < points.size(); ++i) {
      const Acting& acting = all_that_act()[i];
      const Points& own = points[round == 0 || i == 3 ? i : (i + 1) % 3];
      const double factor = factors[round == 0 || i == 3 ? i : (i + 1) % 3];
      v1::Schedule& schedule = *acting.add(scheduled, 0.3);
      if (i < 3 || round == 0) set_schedule(schedule, own);
      acting.add(constant, 0.3 * factor);
    }
  }
  for (v1::Load& load : *scheduled.mutable_bodies(0)->mutable_loads()) {
    if (load.schedule().time_s().empty()) load.clear_schedule();
  }
  for (v1::Load& load : *constant.mutable_bodies(0)->mutable_loads()) load.clear_schedule();
  constant.clear_gravity_schedule();
  const auto world = start(scheduled), other = start(constant);
  EXPECT_EQ(world->model().scheduled.schedules.size(), 2u) << "equal schedules are one";
  EXPECT_TRUE(other->model().scheduled.schedules.empty());
  ASSERT_TRUE(world->step(false) && other->step(false));
  expect_near(displacement(*world), displacement(*other), 1e-7, "all loads");
  expect_near(reactions(*world), reactions(*other), 1e-7, "all loads");
}

/// A schedule of ones changes nothing, also in single precision.
TEST_P(Schedules, AFactorOfOneIsTheLoadItself) {
  for (const Acting& acting : all_that_act()) {
    for (const bool scheduled_too : {false, true}) {
      v1::Scene scene = bar(false);
      scene.mutable_solver()->set_precision(v1::Solver::PRECISION_FLOAT);
      scene.mutable_solver()->set_cg_tolerance(1e-5);
      v1::Schedule& schedule = *acting.add(scene, 1);
      const auto plain = [&] {
        v1::Scene copy = scene;
        copy.clear_gravity_schedule();
        for (v1::Load& load : *copy.mutable_bodies(0)->mutable_loads()) load.clear_schedule();
        return start(copy);
      }();
      set_schedule(schedule, scheduled_too ? Points{{0, 1}, {1, 1}} : Points{{0, 1}});
      const auto world = start(scene);
      for (int i = 0; i < 5; ++i) ASSERT_TRUE(world->step(false) && plain->step(false)) << acting.name;
      EXPECT_EQ(displacement(*world), displacement(*plain)) << acting.name;
      EXPECT_EQ(world->energy().work_j(), plain->energy().work_j()) << acting.name;
    }
  }
}

/// After n steps under gravity v = n g dt. Then the body flies on, and gravity does no more work.
TEST_P(Schedules, GravityThatSwitchesOffDoesNoMoreWork) {
  for (const bool double_precision : {false, true}) {
    v1::Scene scene = bar(false);
    scene.mutable_bodies(0)->clear_fixed();
    scene.mutable_solver()->set_precision(double_precision ? v1::Solver::PRECISION_DOUBLE
                                                           : v1::Solver::PRECISION_FLOAT);
    scene.mutable_solver()->set_cg_tolerance(double_precision ? 1e-13 : 1e-6);
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
    set_schedule(*scene.mutable_gravity_schedule(), {{5.5 * kDt, 1}, {5.6 * kDt, 0}});
    const auto world = start(scene);
    const double n = 5, unit = world->model().bodies[0].mass_kg * std::pow(9.81 * kDt, 2) / 2;
    const double tolerance = double_precision ? 1e-9 : 1e-4;
    for (int i = 0; i < n; ++i) ASSERT_TRUE(world->step(false));
    EXPECT_NEAR(world->energy().work_j(), unit * n * (n + 1), tolerance * unit * n * n);
    for (int i = 0; i < 20; ++i) ASSERT_TRUE(world->step(false)) << "the guard sees no energy from nowhere";
    world->diagnose();
    EXPECT_NEAR(world->energy().work_j(), unit * n * (n + 1), tolerance * unit * n * n);
    EXPECT_NEAR(world->energy().kinetic_j(), unit * n * n, tolerance * unit * n * n);
    EXPECT_NEAR(*world->energy().dissipated_j(), unit * n, tolerance * unit * n * n);
    const backend::RowState state = world->state();
    EXPECT_NEAR(state.velocity[1], -9.81 * kDt * n, 10 * tolerance);
  }
}

/// Implicit midpoint takes the factor in the middle of a step: the impulse of a linear ramp is then exact, v = g t²/2.
TEST_P(Schedules, TheMidpointRuleIsExactOnARamp) {
  v1::Scene scene = bar(false);
  scene.mutable_bodies(0)->clear_fixed();
  scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT);
  tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
  set_schedule(*scene.mutable_gravity_schedule(), {{0, 0}, {1, 1}});
  const auto world = start(scene);
  for (int i = 0; i < 10; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_NEAR(world->state().velocity[1], -9.81 * std::pow(10 * kDt, 2) / 2, 1e-6);
}

/// A ramp's work is the sum of force times distance, each step with its own factor: also if a step is made in parts.
TEST_P(Schedules, TheWorkOfARampIsCountedWithTheFactorOfEachStep) {
  const Points ramp{{0, 0}, {10 * kDt, 1}};
  const auto whole = start(thrown_bar(ramp));
  const auto in_parts = start_faulty(thrown_bar(ramp), [](std::uint64_t step, std::uint64_t call) {
    return step >= 4 && call == 0 ? std::optional(Fault::kNotANumber) : std::nullopt;
  });
  const double mass = whole->model().bodies[0].mass_kg;
  double speed = 0, work = 0, work_in_parts = 0;
  for (int i = 1; i <= 6; ++i) {
    ASSERT_TRUE(whole->step(false) && in_parts->step(false)) << i;
    ASSERT_EQ(in_parts->guard_event() != nullptr, i >= 4);
    const double force = 2 * mass * i / 10.0, gain = force * kDt / mass;
    if (i >= 4) {
      EXPECT_EQ(in_parts->guard_event()->steps, 2u);
    }
    work += force * (speed + gain) * kDt;
    work_in_parts += force * (i < 4 ? speed + gain : speed + 0.75 * gain) * kDt;
    speed += gain;
    EXPECT_NEAR(whole->last().kinetic_energy_j, mass * speed * speed / 2, 1e-9 * mass * speed * speed) << i;
    EXPECT_NEAR(in_parts->last().kinetic_energy_j, mass * speed * speed / 2, 1e-9 * mass * speed * speed) << i;
    EXPECT_NEAR(whole->energy().work_j(), work, 1e-9 * work) << i;
    EXPECT_NEAR(in_parts->energy().work_j(), work_in_parts, 1e-9 * work_in_parts) << i;
  }
}

/// A step that fails leaves the loads of the checkpoint, and the next one takes its own.
TEST_P(Schedules, AFailedStepLeavesNoTrace) {
  for (const Acting& acting : all_that_act()) {
    v1::Scene scene = bar(false);
    set_schedule(*acting.add(scene, 1), {{0, 0}, {3 * kDt, 1}, {6 * kDt, -1}});
    const auto faulty = start_faulty(scene, [](std::uint64_t step, std::uint64_t) {
      return step == 4 ? std::optional(Fault::kNotANumber) : std::nullopt;
    });
    const auto sound = start(scene);
    for (int i = 0; i < 3; ++i) ASSERT_TRUE(faulty->step(false) && sound->step(false));
    const Eigen::VectorXd before = reactions(*sound);
    ASSERT_FALSE(faulty->step(false)) << acting.name;
    expect_near(reactions(*faulty), before, 1e-12, acting.name);
    for (int i = 0; i < 3; ++i) ASSERT_TRUE(faulty->step(false) && sound->step(false));
    EXPECT_EQ(displacement(*faulty), displacement(*sound)) << acting.name;
  }
}

TEST_P(Schedules, AResetStartsThemAgain) {
  for (const Acting& acting : all_that_act()) {
    v1::Scene scene = bar(false);
    set_schedule(*acting.add(scene, 1), {{0, 1}, {4 * kDt, 0.2}});
    const auto world = start(scene);
    for (int i = 0; i < 6; ++i) ASSERT_TRUE(world->step(false));
    const Eigen::VectorXd first = displacement(*world);
    world->reset();
    for (int i = 0; i < 6; ++i) ASSERT_TRUE(world->step(false));
    EXPECT_EQ(displacement(*world), first) << acting.name;
  }
}

/// The parts of a quasi-static step take the factors at their own ends, in every step. An unscheduled load grows in
/// the parts of the first one.
TEST_P(Schedules, ALoadThatFailsAtOnceGrowsInPartsByItsSchedule) {
  const auto unscheduled = start(bent_bar({}));
  ASSERT_TRUE(unscheduled->step(false)) << to_text(*unscheduled->guard_event(), unscheduled->model());
  ASSERT_NE(unscheduled->guard_event(), nullptr) << "the load is too much for one part; make it larger";
  for (const int first : {0, 2}) {  // steps without gravity
    const auto world = start(bent_bar({{first * kDt, 0}, {(first + 1) * kDt, 1}}));
    for (int i = 0; i < first; ++i) {
      ASSERT_TRUE(world->step(false));
      EXPECT_EQ(world->guard_event(), nullptr);
      EXPECT_LT(displacement(*world).norm(), 1e-12);
    }
    ASSERT_TRUE(world->step(false)) << to_text(*world->guard_event(), world->model());
    ASSERT_NE(world->guard_event(), nullptr);
    EXPECT_EQ(world->guard_event()->steps, unscheduled->guard_event()->steps);
    EXPECT_TRUE(world->last().converged);
    expect_near(displacement(*world), displacement(*unscheduled), 1e-5, "after " + std::to_string(first));
  }
}

/// The parts of the first step multiply a load by their share only if no schedule says how it grows.
TEST_P(Schedules, ScheduledAndUnscheduledLoadsGrowTogetherInTheFirstStep) {
  v1::Scene scene = bent_bar({{0, 0}, {kDt, 1}}), constant = bent_bar({});
  for (v1::Scene* each : {&scene, &constant}) {
    v1::Load& load = *each->mutable_bodies(0)->add_loads();
    tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), 1 - 1e-6, -1, -1);
    tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 2, 1, 1);
    tests::set(*load.mutable_force_n(), 0, 0, 0.5);
  }
  const auto world = start(scene), other = start(constant);
  ASSERT_TRUE(world->step(false) && other->step(false));
  ASSERT_NE(world->guard_event(), nullptr);
  ASSERT_NE(other->guard_event(), nullptr);
  EXPECT_EQ(world->guard_event()->steps, other->guard_event()->steps);
  EXPECT_EQ(world->last().newton_iterations, other->last().newton_iterations) << "each part had the same loads";
  expect_near(displacement(*world), displacement(*other), 1e-5, "both");
}

TM_ON_EACH_BACKEND(Schedules);

}  // namespace
}  // namespace tensormass::world
