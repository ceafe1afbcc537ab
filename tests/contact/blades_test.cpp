#include "contact/blades.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/blades.h"
#include "support/momentum.h"
#include "support/reaction.h"

/// Blades: force and work of a cut follow from toughness alone, and the tissue receives what the blade exerts.
namespace tensormass::contact {
namespace {

using Eigen::Vector3d;
using tests::BladeScene;
using tests::move_and_step;

class Blades : public tests::OnBackend {
 protected:
  struct Cut {
    double mean_n = 0, largest_change_n = 0;
    double work_j = 0, elastic_j = 0, fracture_j = 0, pins_j = 0;
    std::vector<double> forces_n;
  };
  /// Pushes the blade through a block and lets it come to rest.
  Cut push(const BladeScene& of, double speed_m_per_s, double way_m, double rest_s,
           const Vector3d& direction = {1, 0, 0}) {
    const auto world = start(tests::block_with_scalpel(of));
    Cut out;
    double before_n = 0;
    Vector3d force_before = Vector3d::Zero();
    int cutting = 0;
    const int moving = static_cast<int>(std::lround(way_m / speed_m_per_s / of.dt_s));
    const int steps = moving + static_cast<int>(std::lround(rest_s / of.dt_s));
    for (int i = 0; i < steps; ++i) {
      const Vector3d way = i < moving ? Vector3d(direction * speed_m_per_s * of.dt_s) : Vector3d(Vector3d::Zero());
      EXPECT_TRUE(move_and_step(*world, way));
      EXPECT_EQ(world->guard_event(), nullptr);
      const Vector3d force = world->readings()[0].force_n;
      out.work_j -= way.dot(force_before + force) / 2;
      force_before = force;
      const double now_n = -force.dot(direction);
      out.forces_n.push_back(now_n);
      out.largest_change_n = std::max(out.largest_change_n, std::abs(now_n - before_n));
      before_n = now_n;
      if (i > moving / 2 && i < moving) {
        out.mean_n += now_n;
        ++cutting;
      }
    }
    out.mean_n /= cutting;
    world->diagnose();
    for (const backend::GroupDiagnostics& group : world->diagnostics()) out.elastic_j += group.elastic_energy_j;
    out.fracture_j = world->sweeps().fracture_j();
    out.pins_j =
        out.forces_n.back() * out.forces_n.back() * tests::kBladeThicknessM / 2 / (of.toughness_j_per_m2 * of.width_m);
    return out;
  }
};
TM_ON_EACH_BACKEND(Blades);

TEST_P(Blades, NeedAForceThatFollowsFromToughnessAndWidthAlone) {
  for (const bool in_double : {true, false}) {
    for (const double width_m : {0.01, 0.02}) {
      double softer_n = 0;
      for (const double young_modulus_pa : {20e3, 200e3}) {
        const BladeScene of{.width_m = width_m, .young_modulus_pa = young_modulus_pa, .double_precision = in_double};
        SCOPED_TRACE(testing::Message() << width_m << " m, " << young_modulus_pa << " Pa, double: " << in_double);
        const Cut cut = push(of, 0.05, 0.012, 0.06);
        const double expected_n = of.toughness_j_per_m2 * width_m;
        EXPECT_NEAR(cut.mean_n, expected_n, 0.03 * expected_n);
        EXPECT_LT(cut.largest_change_n, 0.15 * expected_n);
        const double lost_j = cut.work_j - cut.elastic_j - cut.pins_j;
        EXPECT_NEAR(lost_j, cut.fracture_j, 0.02 * cut.fracture_j);
        EXPECT_GT(cut.fracture_j, 0.4 * expected_n * 0.011);
        if (softer_n > 0) {
          EXPECT_NEAR(cut.mean_n, softer_n, 0.02 * softer_n);
        }
        softer_n = cut.mean_n;
      }
    }
  }
}

TEST_P(Blades, ChangeTheMomentumOfAFreeBlockByTheirForceAlone) {
  for (const bool in_double : {true, false}) {
    for (const std::uint32_t threads : {1u, 2u}) {
      const BladeScene of{.double_precision = in_double, .is_free = true, .threads = threads, .tolerance = 1e-12};
      const auto world = start(tests::block_with_scalpel(of));
      Vector3d impulse = Vector3d::Zero();
      double largest_n = 0;
      for (int i = 0; i < 120; ++i) {
        // Forwards, sideways and back, so that every limit is met.
        const Vector3d way = i < 60 ? Vector3d(0.1, 0.01, 0) : (i < 90 ? Vector3d(0, 0.02, 0.1) : Vector3d(-0.2, 0, 0));
        ASSERT_TRUE(move_and_step(*world, way * of.dt_s));
        const Vector3d force_n = world->readings()[0].force_n;
        impulse -= force_n * of.dt_s;
        largest_n = std::max(largest_n, force_n.norm());
      }
      EXPECT_GT(largest_n, 0.05);
      const Vector3d momentum = tests::momentum_of(*world);
      EXPECT_LT((momentum - impulse).norm(), (in_double ? 1e-10 : 2e-5) * largest_n * 120 * of.dt_s);
    }
  }
}

TEST_P(Blades, KeepTheirForceWhileTheyStandStill) {
  const BladeScene of{.selective = true};
  const auto world = start(tests::block_with_scalpel(of));
  for (int i = 0; i < 160; ++i) ASSERT_TRUE(move_and_step(*world, {0.06 * of.dt_s, 0, 0}));
  const double limit_n = of.toughness_j_per_m2 * of.width_m, fracture_j = world->sweeps().fracture_j();
  for (int i = 0; i < 200; ++i) {
    ASSERT_TRUE(move_and_step(*world, Vector3d::Zero()));
    ASSERT_LE(-world->readings()[0].force_n[0], 1.001 * limit_n);
  }
  EXPECT_GT(-world->readings()[0].force_n[0], 0.8 * limit_n);
  EXPECT_LT(world->sweeps().fracture_j(), fracture_j + 0.05 * limit_n * 0.01) << "it does not creep on";
}

/// A haptic client renders this between two steps.
TEST_P(Blades, ReportTheSpringThatYieldsAndItsLimit) {
  const BladeScene of;
  const auto world = start(tests::block_with_scalpel(of));
  const auto yielding = [&]() -> const world::YieldingSpring& { return world->readings()[0].yielding; };
  EXPECT_EQ(yielding().limit_n, 0) << "before the tissue";
  for (int i = 0; i < 160; ++i) ASSERT_TRUE(move_and_step(*world, {0.06 * of.dt_s, 0, 0}));
  const double limit_n = of.toughness_j_per_m2 * of.width_m;
  EXPECT_NEAR(yielding().limit_n, limit_n, 1e-6 * limit_n);
  EXPECT_LT((yielding().direction - Vector3d::UnitX()).norm(), 1e-12);
  EXPECT_NEAR(-world->readings()[0].force_n[0], limit_n, 0.03 * limit_n) << "it is the force of the cut";
  // The springs of the points and the tissue before them: softer than either, and not by orders of magnitude.
  EXPECT_LT(yielding().stiffness_n_per_m, limit_n / tests::kBladeThicknessM);
  EXPECT_GT(yielding().stiffness_n_per_m, 0.1 * of.young_modulus_pa * of.width_m);
  // The blade goes back by a step of a haptic loop at 60 Hz: the force falls as the model says, within a factor.
  const double before_n = -world->readings()[0].force_n[0], stiffness_n_per_m = yielding().stiffness_n_per_m;
  const double back_m = 0.2 * before_n / stiffness_n_per_m;
  for (int i = 0; i < 40; ++i) ASSERT_TRUE(move_and_step(*world, {-back_m / 40, 0, 0}));
  for (int i = 0; i < 40; ++i) ASSERT_TRUE(move_and_step(*world, Vector3d::Zero()));
  const double fallen = (before_n + world->readings()[0].force_n[0]) / before_n;
  std::printf("fell by %.3g of itself, 0.2 by the model\n", fallen);
  EXPECT_GT(fallen, 0.07);
  EXPECT_LT(fallen, 0.6);
  for (int i = 0; i < 40; ++i) ASSERT_TRUE(move_and_step(*world, {-0.06 * of.dt_s, 0, 0}));
  EXPECT_EQ(yielding().limit_n, 0) << "nothing holds on the way back";
}

/// A limit that would throw it within a step: 20 N on 8 g are 42 m/s after a 60th of a second.
TEST_P(Blades, PushAFreeBlockNoFasterThanTheyMove) {
  for (const Vector3d& direction : {Vector3d(1, 0, 0), Vector3d(0.8, 0, 0.6)}) {
    const BladeScene of{
        .young_modulus_pa = 200e3, .toughness_j_per_m2 = 2000, .dt_s = 1.0 / 60, .is_free = true, .tolerance = 1e-12};
    const auto world = start(tests::block_with_scalpel(of));
    const double speed_m_per_s = 0.12;
    double mass_kg = 0, fastest_m_per_s = 0;
    for (const std::uint32_t row : world->model().layout.row_of_node) mass_kg += world->model().row_mass[row];
    ASSERT_GT(of.toughness_j_per_m2 * of.width_m * of.dt_s / mass_kg, 100 * speed_m_per_s) << "it could be thrown";
    for (int i = 0; i < 120; ++i) {
      ASSERT_TRUE(move_and_step(*world, direction * speed_m_per_s * of.dt_s));
      const double now = tests::momentum_of(*world).norm() / mass_kg;
      fastest_m_per_s = std::max(fastest_m_per_s, now);
    }
    EXPECT_LT(fastest_m_per_s, 1.05 * speed_m_per_s);
    EXPECT_GT(fastest_m_per_s, 0.5 * speed_m_per_s) << "it goes along";
    EXPECT_EQ(world->guard_event(), nullptr);
  }
}

/// At rest, what holds the block holds against the blade, and nothing else does.
TEST_P(Blades, PushTheBaseWithTheForceThatTheyReport) {
  for (const bool selective : {false, true}) {
    const BladeScene of{.selective = selective};
    v1::Scene scene = tests::block_with_scalpel(of);
    scene.mutable_bodies(0)->set_rayleigh_mass_per_s(20);
    const auto world = start(scene);
    for (int i = 0; i < 200; ++i) ASSERT_TRUE(move_and_step(*world, {0.05 * of.dt_s, 0.01 * of.dt_s, 0.02 * of.dt_s}));
    for (int i = 0; i < 1500; ++i) ASSERT_TRUE(move_and_step(*world, Vector3d::Zero()));
    const Vector3d force_n = world->readings()[0].force_n;
    EXPECT_GT(force_n.norm(), 0.1);
    EXPECT_LT((tests::reaction_of(*world) - force_n).norm(), 1e-5 * force_n.norm());
  }
}

TEST_P(Blades, FeelNothingBackwardsNorUpToWhereTheyHadBeen) {
  const BladeScene of;
  const auto world = start(tests::block_with_scalpel(of));
  const auto move = [&](int steps, double speed_m_per_s) {
    for (int i = 0; i < steps; ++i) EXPECT_TRUE(move_and_step(*world, {speed_m_per_s * of.dt_s, 0, 0}));
    return -world->readings()[0].force_n[0];
  };
  const double limit_n = of.toughness_j_per_m2 * of.width_m;
  EXPECT_NEAR(move(200, 0.06), limit_n, 0.03 * limit_n);
  const double fracture_j = world->sweeps().fracture_j();
  EXPECT_EQ(move(60, -0.06), 0);
  EXPECT_EQ(move(20, 0.06), 0) << "the way is cut already";
  EXPECT_EQ(world->sweeps().fracture_j(), fracture_j);
  EXPECT_NEAR(move(80, 0.06), limit_n, 0.03 * limit_n);
  EXPECT_GT(world->sweeps().fracture_j(), fracture_j);
  EXPECT_EQ(move(400, -0.06), 0) << "it has left the block";
}

/// The work of a cut is G · A, however much the edge slides along itself on the way.
TEST_P(Blades, WorkByTheAreaThatTheyCut) {
  for (const double degrees : {45.0, 80.0}) {
    const double angle = degrees * M_PI / 180;
    BladeScene of{.young_modulus_pa = 200e3, .points_width_m = 0.004};
    v1::Scene scene = tests::block_with_scalpel(of);
    scene.mutable_tools(0)->mutable_position_m()->set_y(0.0005);
    const auto world = start(scene);
    double work_j = 0;
    Vector3d before = Vector3d::Zero();
    const double forwards_m = 0.005;
    const int steps = 500;
    const Vector3d way(forwards_m / steps, forwards_m * std::tan(angle) / steps, 0);
    // Within the block all the time: first in, then aslant as far as its width lets the edge.
    for (int i = 0; i < 200; ++i) ASSERT_TRUE(move_and_step(*world, {0.05 * of.dt_s, 0, 0}));
    const double begun_j = world->sweeps().fracture_j();
    const int made = std::min(steps, static_cast<int>(0.0045 / way[1]));
    for (int i = 0; i < made; ++i) {
      ASSERT_TRUE(move_and_step(*world, way));
      const Vector3d force = world->readings()[0].force_n;
      if (i > 0) work_j -= way.dot(before + force) / 2;
      before = force;
    }
    const double expected_j = of.toughness_j_per_m2 * 0.004 * way[0] * (made - 1);
    EXPECT_NEAR(work_j, expected_j, 0.03 * expected_j) << degrees;
    EXPECT_NEAR(world->sweeps().fracture_j() - begun_j, expected_j, 0.03 * expected_j) << degrees;
  }
}

TEST_P(Blades, TakeAnchorsWhereTheyAreIfTheyBeginInTissue) {
  const BladeScene of;
  v1::Scene scene = tests::block_with_scalpel(of);
  scene.mutable_tools(0)->mutable_position_m()->set_x(0.01);
  const auto world = start(scene);
  for (int i = 0; i < 20; ++i) {
    ASSERT_TRUE(move_and_step(*world, Vector3d::Zero()));
    ASSERT_LT(world->readings()[0].force_n.norm(), 1e-12);
  }
  EXPECT_EQ(world->guard_event(), nullptr);
  for (int i = 0; i < 200; ++i) ASSERT_TRUE(move_and_step(*world, {0.06 * of.dt_s, 0, 0}));
  const double limit_n = of.toughness_j_per_m2 * of.width_m;
  EXPECT_NEAR(-world->readings()[0].force_n[0], limit_n, 0.03 * limit_n);
}

TEST_P(Blades, MayPassSeveralElementsInAStep) {
  const BladeScene of{.young_modulus_pa = 200e3, .dt_s = 1.0 / 60};
  const auto world = start(tests::block_with_scalpel(of));
  for (int i = 0; i < 5; ++i) {
    ASSERT_TRUE(move_and_step(*world, {0.008, 0, 0}));  // an element is 5 mm long
    ASSERT_LT(world->readings()[0].force_n.norm(), 3 * of.toughness_j_per_m2 * of.width_m);
  }
  EXPECT_GT(world->sweeps().fracture_j(), 0.6 * of.toughness_j_per_m2 * of.width_m * 0.02);
}

TEST_P(Blades, CutBesideNodesThatAreFixed) {
  const BladeScene of{.young_modulus_pa = 200e3};
  v1::Scene scene = tests::block_with_scalpel(of);
  scene.mutable_tools(0)->mutable_position_m()->set_z(0);  // in the plane of fixed nodes, on their faces
  const auto world = start(scene);
  for (int i = 0; i < 300; ++i) ASSERT_TRUE(move_and_step(*world, {0.06 * of.dt_s, 0, 0}));
  EXPECT_EQ(world->guard_event(), nullptr);
  scene.mutable_tools(0)->mutable_position_m()->set_z(1e-4);
  const auto inside = start(scene);
  for (int i = 0; i < 300; ++i) ASSERT_TRUE(move_and_step(*inside, {0.06 * of.dt_s, 0, 0}));
  const double limit_n = of.toughness_j_per_m2 * of.width_m;
  EXPECT_NEAR(-inside->readings()[0].force_n[0], limit_n, 0.03 * limit_n);
}

}  // namespace
}  // namespace tensormass::contact
