#include "contact/balance.h"

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/dense_system.h"
#include "support/scenes.h"
#include "support/solids.h"

/// Free bodies change their momentum by the forces on them and by nothing else, whatever the tolerance of the solve.
namespace tensormass::contact {
namespace {

constexpr double kGravity = 9.81;

/// Returns a free block of 4 × 2 × 4 cm above the plane y = 0, with the solver's default settings.
v1::Scene free_block(double young_modulus_pa, double gap_m, double dt_s, bool double_precision) {
  v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                       .cells_y = 2,
                                       .cells_z = 4,
                                       .size_x_m = 0.04,
                                       .size_y_m = 0.02,
                                       .size_z_m = 0.04,
                                       .double_precision = double_precision,
                                       .dt_s = dt_s});
  scene.clear_solver();
  scene.mutable_solver()->set_precision(double_precision ? v1::Solver::PRECISION_DOUBLE : v1::Solver::PRECISION_FLOAT);
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_fixed();
  body.set_rayleigh_stiffness_s(0.002);
  v1::IsotropicElastic& law = *body.mutable_law()->mutable_stable_neo_hookean();
  law.set_young_modulus_pa(young_modulus_pa);
  law.set_poisson_ratio(0.4);
  tests::set(*body.mutable_mesh()->mutable_translation_m(), 0, gap_m, 0);
  return scene;
}

/// Adds a table whose surface is the plane y = 0.
v1::Tool& add_table(v1::Scene& scene, const std::string& kind) {
  v1::Tool& table = tests::add_solid(scene, kind, {2, 0.4, 2}, {0, -0.2, 0}, 1, true);
  table.clear_max_force_n();
  table.clear_max_torque_n_m();
  table.set_fixed(true);
  if (kind == "plane") table.mutable_plane()->clear_penalty_stiffness_pa_per_m();
  if (kind == "box") table.mutable_box()->clear_penalty_stiffness_pa_per_m();
  if (kind == "mesh") table.mutable_mesh()->clear_penalty_stiffness_pa_per_m();
  return table;
}

struct Motion {
  double mass_kg = 0;
  Vec3<double> momentum = Vec3<double>::Zero();  // [kg m/s]
  Vec3<double> middle_m = Vec3<double>::Zero();  // displacement of the middle
  Vec3<double> velocity_m_per_s() const { return momentum / mass_kg; }
};
Motion motion_of(world::World& world) {
  const model::Model& m = world.model();
  const backend::RowState now = world.state();
  Motion out;
  for (std::size_t row = 0; row < m.layout.row_count; ++row) {
    out.mass_kg += m.row_mass[row];
    for (std::size_t c = 0; c < 3; ++c) {
      out.momentum[static_cast<Eigen::Index>(c)] += m.row_mass[row] * now.velocity[4 * row + c];
      out.middle_m[static_cast<Eigen::Index>(c)] += m.row_mass[row] * now.displacement[4 * row + c];
    }
  }
  out.middle_m /= out.mass_kg;
  return out;
}

class FreeBodies : public tests::OnBackend {};

/// A smooth table can only push up. The block of 1 MPa left it at 0.25 m/s sideways, and 91 % of its momentum was not
/// in the reported force, before momentum was balanced.
TEST_P(FreeBodies, LeaveASmoothTableAlongItsNormal) {
  constexpr double kDtS = 1.0 / 60, kGapM = 0.05;
  for (const char* kind : {"plane", "box", "mesh"}) {
    for (const double young_pa : {5e3, 1e5, 1e6}) {
      for (const bool precise : {false, true}) {
        SCOPED_TRACE(std::string(kind) + ", " + std::to_string(young_pa) + " Pa, " + (precise ? "double" : "float"));
        v1::Scene scene = free_block(young_pa, kGapM, kDtS, precise);
        add_table(scene, kind);
        const auto world = start(scene);
        Vec3<double> impulse = Vec3<double>::Zero();
        double fastest_aside = 0;
        for (int i = 0; i < 40; ++i) {
          ASSERT_TRUE(world->step(false));
          const Motion now = motion_of(*world);
          if (world->guard_event() != nullptr) {  // made in parts; the report is of the last one
            impulse = now.momentum;
            continue;
          }
          impulse += kDtS * (Vec3<double>(0, -kGravity, 0) * now.mass_kg - world->readings()[0].force_n);
          fastest_aside = std::max(fastest_aside, std::hypot(now.velocity_m_per_s()[0], now.velocity_m_per_s()[2]));
        }
        const Motion end = motion_of(*world);
        const double impact = end.mass_kg * std::sqrt(2 * kGravity * kGapM);
        EXPECT_LT(fastest_aside, precise ? 1e-9 : 1e-4);
        // The last digit of a velocity in single precision changes a contact of 1 MPa by that much.
        const double rounding = young_pa > 5e5 ? 3e-4 : 2e-5;
        EXPECT_LT((end.momentum - impulse).norm(), (precise ? 1e-10 : rounding) * impact);
      }
    }
  }
}

/// The pull on a block, how long it lasts, and the block's speed at first.
struct Drawn {
  const char* name;
  double pull = 0;     ///< in μ N
  double until_s = 9;  ///< after which the pull ends
  double speed_m_per_s = 0;
};

/// Returns the way of a rigid block in a second: implicit Euler with Coulomb's law [m].
double rigid_way(const Drawn& drawn, double rate_hz, double friction) {
  double way = 0, v = drawn.speed_m_per_s;
  for (int step = 1; step <= static_cast<int>(rate_hz); ++step) {
    const double pull = step / rate_hz < drawn.until_s + 1e-9 ? drawn.pull : 0;
    v = std::max(v + (pull - 1) * friction * kGravity / rate_hz, 0.0);
    way += v / rate_hz;
  }
  return way;
}

TEST_P(FreeBodies, SlideByCoulombsLaw) {
  constexpr double kFriction = 0.3;
  for (const double rate_hz : {30.0, 60.0, 240.0, 1000.0}) {
    for (const Drawn& drawn : {Drawn{"drawn", 1.67}, Drawn{"hardly drawn", 1.1}, Drawn{"drawn hard", 2},
                               Drawn{"drawn to rest", 3, 0.251}, Drawn{"thrown", 0, 9, 1}}) {
      SCOPED_TRACE(std::string(drawn.name) + " at " + std::to_string(rate_hz) + " Hz");
      v1::Scene scene = free_block(1e4, 0, 1 / rate_hz, true);
      add_table(scene, "plane").set_friction_coefficient(kFriction);
      const double weight_n = 1000 * 0.04 * 0.02 * 0.04 * kGravity;
      if (drawn.pull > 0) {
        v1::Load& load = *scene.mutable_bodies(0)->add_loads();
        tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
        tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
        load.mutable_force_n()->set_x(drawn.pull * kFriction * weight_n);
        for (const auto& [time_s, factor] :
             {std::pair{1.0, 0.0}, std::pair{1 + 1e-6, 1.0}, std::pair{1 + drawn.until_s, 1.0},
              std::pair{1 + drawn.until_s + 1e-6, 0.0}}) {
          load.mutable_schedule()->add_time_s(time_s);
          load.mutable_schedule()->add_factor(factor);
        }
      }
      if (drawn.speed_m_per_s > 0) {
        std::vector<double> velocity;
        for (int node = 0; node < 5 * 3 * 5; ++node) velocity.insert(velocity.end(), {drawn.speed_m_per_s, 0, 0});
        scene.mutable_bodies(0)->set_initial_velocity_m_per_s(tests::packed_bytes(velocity));
      }
      const auto world = start(scene);
      const int second = static_cast<int>(rate_hz);
      for (int i = 0; i < (drawn.pull > 0 ? second : 0); ++i) ASSERT_TRUE(world->step(false));
      const double start_m = motion_of(*world).middle_m[0];
      for (int i = 0; i < second; ++i) {
        const bool made = world->step(false);
        ASSERT_TRUE(made) << world::to_text(*world->guard_event(), world->model());
        const Vec3<double> force_n = world->readings()[0].force_n;
        EXPECT_LE(std::abs(force_n[0]), 1.06 * kFriction * std::abs(force_n[1]) + 1e-12) << "step " << i;
      }
      const double way_m = motion_of(*world).middle_m[0] - start_m, expected_m = rigid_way(drawn, rate_hz, kFriction);
      // 1 % of the friction is 10 % of what a block that is hardly drawn has left.
      EXPECT_NEAR(way_m, expected_m, (drawn.pull == 1.1 ? 0.1 : 0.02) * expected_m);
    }
  }
}

/// A block spins in space, beside a tool that it does not touch. Σ r × m (v' − v) is the moment of what acts on it:
/// none.
TEST_P(FreeBodies, FeelNoMomentInFreeFlight) {
  v1::Scene scene = free_block(1e4, 1, 1.0 / 60, true);
  scene.clear_gravity_m_per_s2();
  add_table(scene, "plane");
  const Eigen::VectorXd noise = tests::random_field(3 * 5 * 3 * 5, 0.1, 7);
  std::vector<double> velocity;
  for (int node = 0; node < 5 * 3 * 5; ++node) {
    const double x = 0.01 * (node % 5) - 0.02, y = 0.01 * (node / 5 % 3) - 0.01;
    velocity.insert(velocity.end(), {-10 * y + noise[3 * node], 10 * x + noise[3 * node + 1], noise[3 * node + 2]});
  }
  scene.mutable_bodies(0)->set_initial_velocity_m_per_s(tests::packed_bytes(velocity));
  const auto world = start(scene);
  const model::Model& m = world->model();
  for (int i = 0; i < 20; ++i) {
    const backend::RowState before = world->state();
    ASSERT_TRUE(world->step(false));
    const backend::RowState now = world->state();
    Vec3<double> force = Vec3<double>::Zero(), moment = force;
    double size = 0;
    const Vec3<double> center(m.rest[0] + now.displacement[0], m.rest[1] + now.displacement[1],
                              m.rest[2] + now.displacement[2]);
    for (std::size_t row = 0; row < m.layout.row_count; ++row) {
      Vec3<double> r = -center, change;
      for (std::size_t c = 0; c < 3; ++c) {
        const auto axis = static_cast<Eigen::Index>(c);
        r[axis] += m.rest[4 * row + c] + now.displacement[4 * row + c];
        change[axis] = m.row_mass[row] * (now.velocity[4 * row + c] - before.velocity[4 * row + c]);
      }
      force += change;
      moment += r.cross(change);
      size += change.norm();
    }
    EXPECT_LT(force.norm(), 1e-12 * size) << "step " << i;
    EXPECT_LT(moment.norm(), 1e-4 * 0.04 * size) << "step " << i;
  }
}

TM_ON_EACH_BACKEND(FreeBodies);

TEST(SolveRigid, IsTheInverseOfTheProduct) {
  const Eigen::VectorXd numbers = tests::random_field(42, 1, 3);
  Eigen::Matrix<double, 6, 6> a = Eigen::Map<const Eigen::Matrix<double, 6, 6>>(numbers.data());
  const Eigen::Matrix<double, 6, 6> s = a * a.transpose() + Eigen::Matrix<double, 6, 6>::Identity();
  double triangle[view::kBalanceTriangle], d[6], c[6];
  for (int row = 0, i = 0; row < 6; ++row) {
    for (int column = row; column < 6; ++column, ++i) triangle[i] = s(row, column);
    d[row] = numbers[36 + row];
  }
  ASSERT_TRUE(solve_rigid(triangle, d, c));
  EXPECT_LT((s * Eigen::Map<Eigen::Matrix<double, 6, 1>>(c) - Eigen::Map<Eigen::Matrix<double, 6, 1>>(d)).norm(),
            1e-12);
  triangle[0] = -1;
  EXPECT_FALSE(solve_rigid(triangle, d, c));
}

/// Coulomb's force never exceeds μ N, acts along ξ, and follows a motion of the tissue as its derivative says.
TEST(CoulombForce, FollowsAMotionAcrossTheSlip) {
  const Vec3<double> slip(3e-4, 4e-4, 0);
  const auto sliding = coulomb_force(1e4, 0.3, slip, 2.0);
  EXPECT_NEAR(sliding.force.norm(), 0.6, 1e-12);
  EXPECT_NEAR(sliding.force.dot(slip), 0.6 * 5e-4, 1e-15);
  for (const Vec3<double>& motion : {Vec3<double>(4e-8, -3e-8, 0), Vec3<double>(3e-8, 4e-8, 0)}) {
    const auto moved = coulomb_force(1e4, 0.3, Vec3<double>(slip - motion), 2.0);
    EXPECT_LT((sliding.after(motion, false) - moved.force).norm(), 1e-8);
  }
  EXPECT_LT(sliding.after(slip, true).norm(), 1e-15) << "the secant ends at no slip";
  const auto sticking = coulomb_force(1e3, 0.3, slip, 2.0);
  EXPECT_LT((sticking.force - 1e3 * slip).norm(), 1e-15);
  EXPECT_LT((sticking.after(slip, false)).norm(), 1e-15);
  EXPECT_EQ(coulomb_force(1e3, 0.3, slip, -1.0).force.norm(), 0) << "no friction where tissue is pulled";
}

}  // namespace
}  // namespace tensormass::contact
