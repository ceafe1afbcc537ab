#include "world/coupling.h"

#include <cmath>

#include <gtest/gtest.h>

#include "physics/lists.h"
#include "support/backends.h"
#include "support/scenes.h"
#include "world/tool.h"

/// Tools with a mass: the coupling alone, and in whole steps.
namespace tensormass::world {
namespace {

constexpr double kStepsPerS = 60;

model::ToolModel coupled_tool(double mass_kg, double stiffness_n_per_m, double damping_n_s_per_m) {
  model::ToolModel tool;
  physics::for_each_type(physics::Tools{}, [&](auto tag, int index) {
    if (std::string(decltype(tag)::Type::kName) == "spherical_probe") tool.kind = static_cast<std::uint32_t>(index);
  });
  tool.radius_m = 0.01;
  tool.penalty_pa_per_m = 1e12;
  tool.max_speed_m_per_s = 1e3;
  tool.max_force_n = tool.max_torque_n_m = tool.max_joint_load = 1e9;
  tool.mass_kg = mass_kg;
  tool.coupling_stiffness_n_per_m = stiffness_n_per_m;
  tool.coupling_damping_n_s_per_m = damping_n_s_per_m;
  return tool;
}

Pose at(double z_m) { return {{0, 0, z_m}, {1, 0, 0, 0}, {}}; }

/// A spring K in z < 0. share: of K that the server knows.
void feel_wall(ToolMotion& tool, double wall_n_per_m, double share) {
  const double depth_m = std::max(-tool.pose().position_m.z(), 0.0);
  Mat3<double> known = Mat3<double>::Zero();
  if (depth_m > 0) known(2, 2) = share * wall_n_per_m;
  tool.feel({0, 0, wall_n_per_m * depth_m}, known, 0);
}

/// The hand jumps by d. With critical damping the tool follows as m x'' + c (x' − h') + k (x − h) = 0 says:
/// x = d (1 − (1 − ω t) e^(−ω t)), ω = √(k / m). Implicit Euler comes closer to that in proportion to its step.
TEST(Coupling, AFreeToolFollowsTheHandAsItsDynamicsSay) {
  constexpr double kMassKg = 0.05, kStiffness = 500, kJumpM = 0.01;
  const double omega = std::sqrt(kStiffness / kMassKg), damping = 2 * std::sqrt(kStiffness * kMassKg);
  const model::ToolModel model = coupled_tool(kMassKg, kStiffness, damping);
  const auto worst_m = [&](double dt_s) {
    ToolMotion tool(model);
    tool.set_target(at(kJumpM), kUntilTheNext);
    double worst = 0;
    for (double t_s = dt_s; t_s < 10 / omega; t_s += dt_s) {
      tool.move(dt_s, {});
      const double exact_m = kJumpM * (1 - (1 - omega * t_s) * std::exp(-omega * t_s));
      worst = std::max(worst, std::abs(tool.pose().position_m.z() - exact_m));
    }
    EXPECT_NEAR(tool.pose().position_m.z(), kJumpM, 1e-3 * kJumpM);
    EXPECT_NEAR(tool.force_on_hand_n().norm(), 0, kStiffness * 1e-3 * kJumpM);
    return worst;
  };
  const double dt_s = 0.01 / omega;
  EXPECT_LT(worst_m(dt_s), 0.02 * kJumpM);
  EXPECT_NEAR(worst_m(dt_s) / worst_m(dt_s / 2), 2, 0.1) << "first order";
}

/// A hand that moves steadily feels nothing, because the damper moves with it.
TEST(Coupling, ASteadyHandFeelsNoDragInTheAir) {
  const model::ToolModel model = coupled_tool(0.05, 500, 10);
  ToolMotion tool(model);
  for (int step = 1; step <= 300; ++step) {
    tool.set_target(at(0.001 * step), kUntilTheNext);
    tool.move(1 / kStepsPerS, {});
  }
  EXPECT_NEAR(tool.force_on_hand_n().norm(), 0, 1e-9);
  EXPECT_NEAR(tool.pose().position_m.z(), 0.3, 1e-9);
}

/// Pressed on a spring K, the tool rests where coupling and wall balance: x = k h / (k + K). Its step is stable for
/// every mass, wall and rate, even if the server knows nothing of the wall's stiffness.
TEST(Coupling, APressedToolRestsWhereCouplingAndWallBalance) {
  constexpr double kPressM = -0.004;
  for (const double share : {1.0, 1.0 / 3, 0.0}) {
    for (const double wall : {500.0, 5000.0, 1e5}) {
      for (const double mass_kg : {1e-5, 1e-3, 0.05, 1.0}) {
        for (const double stiffness : {1000.0, 1e5}) {
          for (const double rate_hz : {kStepsPerS, 1000.0}) {
            const model::ToolModel model = coupled_tool(mass_kg, stiffness, 2 * std::sqrt(stiffness * mass_kg));
            ToolMotion tool(model);
            double moved_m = 0;
            for (int step = 1; step <= 2 * rate_hz; ++step) {
              const double before_m = tool.pose().position_m.z();
              tool.set_target(at(std::max(kPressM, 0.01 - 0.05 * step / rate_hz)), kUntilTheNext);
              tool.move(1 / rate_hz, {});
              feel_wall(tool, wall, share);
              if (step > rate_hz) moved_m = std::max(moved_m, std::abs(tool.pose().position_m.z() - before_m));
            }
            const auto where = testing::Message() << share << " of " << wall << " N/m known, " << mass_kg << " kg, "
                                                  << stiffness << " N/m, " << rate_hz << " Hz";
            const double rest_m = stiffness * kPressM / (stiffness + wall);
            EXPECT_NEAR(tool.pose().position_m.z(), rest_m, 1e-6) << where;
            EXPECT_LT(moved_m, 1e-6) << where;
            EXPECT_NEAR(tool.force_on_hand_n().z(), -wall * rest_m, 1e-3 * -wall * rest_m) << where;
          }
        }
      }
    }
  }
}

TEST(Coupling, TheHandFeelsCouplingAndTissueInSeries) {
  const Vec3<double> normal = Vec3<double>(1, 2, 2) / 3;
  const Mat3<double> series = in_series(1000, 4000 * normal * normal.transpose());
  EXPECT_TRUE(series.isApprox(800 * normal * normal.transpose(), 1e-12));
  EXPECT_TRUE(in_series(1000, Mat3<double>::Zero()).isZero(0)) << "nothing in the air";
}

TEST(Coupling, AFailedStepIsTakenBackWithItsVelocity) {
  const model::ToolModel model = coupled_tool(0.05, 500, 10);
  ToolMotion tool(model), twin(model);
  for (ToolMotion* one : {&tool, &twin}) {
    one->set_target(at(0.01), kUntilTheNext);
    one->move(0.01, {});
  }
  tool.move(0.01, {});
  tool.take_back();
  for (ToolMotion* one : {&tool, &twin}) one->move(0.01, {});
  EXPECT_EQ(tool.pose().position_m, twin.pose().position_m);
  EXPECT_EQ(tool.force_on_hand_n(), twin.force_on_hand_n());
}

TEST(Coupling, TheToolIsNoFasterThanItsMaximumSpeed) {
  model::ToolModel model = coupled_tool(1e-3, 1e5, 0);
  model.max_speed_m_per_s = 0.5;
  ToolMotion tool(model);
  tool.set_target(at(1), kUntilTheNext);
  for (int step = 0; step < 200; ++step) {
    const Vec3<double> before_m = tool.pose().position_m;
    tool.move(1 / kStepsPerS, {});
    EXPECT_LE((tool.pose().position_m - before_m).norm(), 0.5 / kStepsPerS * (1 + 1e-12)) << step;
    EXPECT_TRUE(tool.shape_at(1).position_m.isApprox(tool.pose().position_m, 1e-12));
  }
}

class CoupledTool : public tests::OnBackend {
 protected:
  /// Presses the probe straight down to this place and holds it there. Returns its reading.
  ToolReading press(World& world, const Vec3<double>& place_m = {0.043, 0.055, 0.056}) {
    const double top_m = world.tool_target(0).position_m.y();
    for (int step = 1; step <= 150; ++step) {
      Pose pose = world.tool_target(0);
      pose.position_m = place_m;
      pose.position_m.y() = std::max(place_m.y(), top_m - 0.001 * step);
      world.set_tool_target(0, pose);
      EXPECT_TRUE(world.step(false)) << step;
    }
    return world.readings()[0];
  }
  v1::Scene block(double mass_kg, double stiffness_n_per_m) const {
    v1::Scene scene = tests::block_with_probe(true, 4);
    scene.mutable_stepping()->set_dt_s(1 / kStepsPerS);
    scene.mutable_solver()->set_cg_max_iterations(200);
    scene.mutable_solver()->set_cg_tolerance(1e-8);
    if (mass_kg > 0) scene.mutable_tools(0)->set_mass_kg(mass_kg);
    if (mass_kg > 0) scene.mutable_tools(0)->set_coupling_stiffness_n_per_m(stiffness_n_per_m);
    return scene;
  }
};

/// At rest the coupling's force is the tissue's, which a tool without mass at the same place feels.
TEST_P(CoupledTool, PressedOnTissueItsCouplingCarriesTheTissuesForce) {
  constexpr double kStiffness = 200;
  const auto coupled = start(block(0.05, kStiffness));
  const ToolReading felt = press(*coupled);
  const Vec3<double> stretch_m = felt.pose.position_m - felt.hand_m;
  EXPECT_GT(stretch_m.y(), 1e-4) << "the tool lags behind the hand";
  EXPECT_TRUE(felt.force_n.isApprox(kStiffness * stretch_m, 1e-3)) << felt.force_n.transpose();
  EXPECT_NEAR(felt.hand_m.y(), 0.055, 1e-12);
  // The same press without a mass, to the place of the tool.
  const auto rigid = start(block(0, 0));
  const ToolReading alone = press(*rigid, felt.pose.position_m);
  EXPECT_TRUE(felt.force_n.isApprox(alone.force_n, 1e-2))
      << felt.force_n.transpose() << " " << alone.force_n.transpose();
  EXPECT_TRUE(felt.stiffness_n_per_m.isApprox(in_series(kStiffness, alone.stiffness_n_per_m), 1e-2));
}

TEST_P(CoupledTool, InTheAirItsCouplingPullsButItTouchesNothing) {
  const auto world = start(block(0.05, 200));
  EXPECT_TRUE(press(*world).touching);
  Pose away = world->tool_target(0);
  away.position_m.y() += 1;
  world->set_tool_target(0, away);
  for (int step = 0; step < 10; ++step) EXPECT_TRUE(world->step(false));
  EXPECT_GT(world->readings()[0].force_n.norm(), 0.02) << "the tool is still on its way";
  EXPECT_FALSE(world->readings()[0].touching);
}

/// A light tool on a stiff coupling is where a tool without mass is, and feels what it feels.
TEST_P(CoupledTool, OfLittleMassOnAStiffCouplingIsAToolWithoutMass) {
  const auto coupled = start(block(1e-6, 1e7));
  const auto rigid = start(block(0, 0));
  const ToolReading felt = press(*coupled), alone = press(*rigid);
  EXPECT_LT((felt.pose.position_m - alone.pose.position_m).norm(), 1e-6);
  EXPECT_TRUE(felt.force_n.isApprox(alone.force_n, 1e-3))
      << felt.force_n.transpose() << " " << alone.force_n.transpose();
}

TEST_P(CoupledTool, AResetPutsToolAndHandBack) {
  const auto world = start(block(0.05, 200));
  const Vec3<double> home_m = world->readings()[0].pose.position_m;
  press(*world);
  world->reset();
  EXPECT_EQ(world->readings()[0].pose.position_m, home_m);
  EXPECT_EQ(world->readings()[0].hand_m, home_m);
  ASSERT_TRUE(world->step(false));
  EXPECT_TRUE(world->readings()[0].force_n.isZero(1e-12));
}

TM_ON_EACH_BACKEND(CoupledTool);

}  // namespace
}  // namespace tensormass::world
