#include <algorithm>
#include <cmath>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/momentum.h"
#include "support/reaction.h"
#include "support/scissors.h"

/// Scissors: the torque of a cut follows from toughness and area, and the tissue receives what the edges exert.
namespace tensormass::contact {
namespace {

using Eigen::Vector3d;
using tests::open_and_step;
using tests::ScissorsScene;

constexpr double kCloses = 0.3;  // [rad/s]

class ScissorsBlades : public tests::OnBackend {
 protected:
  static double torque_n_m(const world::World& world) { return world.readings()[0].joint_loads[0]; }
};
TM_ON_EACH_BACKEND(ScissorsBlades);

/// torque = Gc · thickness · ds/dθ, s: how far the edges have come, on average over the thickness (swept_m2 /
/// thickness).
TEST_P(ScissorsBlades, NeedATorqueThatFollowsFromToughnessAndAreaAlone) {
  for (const bool in_double : {true, false}) {
    double softer_n_m = 0;
    for (const double young_modulus_pa : {1e6, 1e7}) {
      const ScissorsScene of{.young_modulus_pa = young_modulus_pa, .double_precision = in_double};
      SCOPED_TRACE(testing::Message() << young_modulus_pa << " Pa, double: " << in_double);
      const auto world = start(tests::sheet_with_scissors(of));
      const double begins_rad = 0.31, ends_rad = 0.19;
      double opening_rad = of.opening_rad, sum_n_m = 0, begun_j = 0, largest_n_m = 0;
      int count = 0;
      while (opening_rad > ends_rad) {
        opening_rad -= kCloses * of.dt_s;
        ASSERT_TRUE(open_and_step(*world, opening_rad));
        ASSERT_EQ(world->guard_event(), nullptr);
        if (opening_rad > begins_rad) {
          begun_j = world->sweeps().fracture_j();
          continue;
        }
        sum_n_m += torque_n_m(*world);
        largest_n_m = std::max(largest_n_m, torque_n_m(*world));
        ++count;
      }
      const double swept_m2 = tests::swept_m2(of, ends_rad) - tests::swept_m2(of, begins_rad);
      const double mean_n_m = sum_n_m / count;
      const double expected_n_m = of.toughness_j_per_m2 * swept_m2 / (begins_rad - ends_rad);
      EXPECT_NEAR(mean_n_m, expected_n_m, 0.03 * expected_n_m);
      const double fracture_j = world->sweeps().fracture_j() - begun_j;
      EXPECT_NEAR(fracture_j, of.toughness_j_per_m2 * swept_m2, 0.03 * of.toughness_j_per_m2 * swept_m2);
      EXPECT_LT(largest_n_m, 2 * expected_n_m);
      if (softer_n_m > 0) {
        EXPECT_NEAR(mean_n_m, softer_n_m, 0.02 * softer_n_m);
      }
      softer_n_m = mean_n_m;
    }
  }
}

TEST_P(ScissorsBlades, ChangeTheMomentumOfAFreeSheetByTheirForceAlone) {
  for (const bool in_double : {true, false}) {
    for (const std::uint32_t threads : {1u, 2u}) {
      const ScissorsScene of{.young_modulus_pa = 1e5,
                             .double_precision = in_double,
                             .is_free = true,
                             .threads = threads,
                             .tolerance = 1e-12};
      const auto world = start(tests::sheet_with_scissors(of));
      Vector3d impulse = Vector3d::Zero();
      double largest_n = 0, opening_rad = of.opening_rad;
      for (int i = 0; i < 160; ++i) {
        // Closing while they move aside, then opening and back.
        opening_rad += (i < 120 ? -3 : 3) * of.dt_s;
        const Vector3d way = i < 120 ? Vector3d(0.05, 0.01, 0.02) : Vector3d(-0.1, 0, 0);
        ASSERT_TRUE(open_and_step(*world, opening_rad, way * of.dt_s));
        const Vector3d force_n = world->readings()[0].force_n;
        impulse -= force_n * of.dt_s;
        largest_n = std::max(largest_n, force_n.norm());
      }
      EXPECT_GT(largest_n, 0.02);
      const Vector3d momentum = tests::momentum_of(*world);
      EXPECT_LT((momentum - impulse).norm(), (in_double ? 1e-10 : 2e-5) * largest_n * 160 * of.dt_s);
    }
  }
}

TEST_P(ScissorsBlades, PushWhatHoldsTheSheetWithTheForceThatTheyReport) {
  const ScissorsScene of;
  v1::Scene scene = tests::sheet_with_scissors(of);
  scene.mutable_bodies(0)->set_rayleigh_mass_per_s(20);
  const auto world = start(scene);
  double opening_rad = of.opening_rad;
  while (opening_rad > 0.25) ASSERT_TRUE(open_and_step(*world, opening_rad -= kCloses * of.dt_s));
  for (int i = 0; i < 1500; ++i) ASSERT_TRUE(open_and_step(*world, opening_rad));
  const Vector3d force_n = world->readings()[0].force_n;
  EXPECT_GT(force_n.norm(), 0.01);
  EXPECT_LT((tests::reaction_of(*world) - force_n).norm(), 1e-5 * force_n.norm());
}

TEST_P(ScissorsBlades, DoNothingWhileTheyAreShutOrShutOnNothing) {
  const double shut_rad = 2 * std::asin(tests::kEdgeOffsetM / tests::kBladeLengthM);
  const ScissorsScene of{.opening_rad = shut_rad - 1e-3};
  const auto world = start(tests::sheet_with_scissors(of));
  for (int i = 0; i < 40; ++i) {
    ASSERT_TRUE(open_and_step(*world, of.opening_rad, {0.05 * of.dt_s, 0, 0}));
    ASSERT_EQ(world->readings()[0].force_n.norm(), 0);
  }
  EXPECT_EQ(world->sweeps().fracture_j(), 0);
  v1::Scene beside = tests::sheet_with_scissors();
  beside.mutable_tools(0)->mutable_position_m()->set_z(0.2);
  const auto nothing = start(beside);
  for (double opening_rad = 0.7; opening_rad > 0; opening_rad -= 0.02) {
    ASSERT_TRUE(open_and_step(*nothing, opening_rad));
    ASSERT_EQ(torque_n_m(*nothing), 0);
    ASSERT_EQ(nothing->readings()[0].force_n.norm(), 0);
  }
}

TEST_P(ScissorsBlades, KeepTheirTorqueWhileTheyStandStillAndLoseItByOpening) {
  const ScissorsScene of;
  const auto world = start(tests::sheet_with_scissors(of));
  double opening_rad = of.opening_rad;
  while (opening_rad > 0.28) ASSERT_TRUE(open_and_step(*world, opening_rad -= kCloses * of.dt_s));
  const double closing_n_m = torque_n_m(*world), fracture_j = world->sweeps().fracture_j();
  EXPECT_GT(closing_n_m, 1e-3);
  for (int i = 0; i < 200; ++i) ASSERT_TRUE(open_and_step(*world, opening_rad));
  EXPECT_GT(torque_n_m(*world), 0.8 * closing_n_m);
  EXPECT_LT(torque_n_m(*world), 1.001 * closing_n_m);
  EXPECT_LT(world->sweeps().fracture_j(), 1.02 * fracture_j) << "they do not creep on";
  for (int i = 0; i < 40; ++i) ASSERT_TRUE(open_and_step(*world, opening_rad += kCloses * of.dt_s));
  EXPECT_EQ(torque_n_m(*world), 0);
  const double opened_j = world->sweeps().fracture_j();
  for (int i = 0; i < 20; ++i) ASSERT_TRUE(open_and_step(*world, opening_rad -= kCloses * of.dt_s));
  EXPECT_LT(torque_n_m(*world), 0.2 * closing_n_m) << "the way is cut already";
  EXPECT_LT(world->sweeps().fracture_j() - opened_j, 0.02 * fracture_j);
}

}  // namespace
}  // namespace tensormass::contact
