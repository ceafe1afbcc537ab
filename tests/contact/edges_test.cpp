#include "contact/edge_contact.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <random>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/momentum.h"
#include "support/ridges.h"
#include "support/staged_scene.h"

/// Sharp edges that touch each other where no node is near.
namespace tensormass::contact {
namespace {

using tests::crossed_ridges;
using tests::momentum_of;
using tests::Ridges;
using tests::StagedScene;

constexpr double kDegree = std::numbers::pi / 180;

/// Returns how far the mean of a body's nodes is above where it started [m].
double rise_m(world::World& world, std::size_t body) {
  const model::Model& m = world.model();
  const std::vector<double> x = world.positions(m.bodies[body]);
  double sum = 0;
  for (std::uint32_t node = 0; node < m.bodies[body].node_count; ++node) {
    sum += x[3 * node + 1] - m.rest[4 * std::size_t{m.layout.row_of_node[m.bodies[body].node_begin + node]} + 1];
  }
  return sum / m.bodies[body].node_count;
}

/// Sets the velocity with which a body starts.
void set_velocity(v1::Body& body, std::size_t nodes, const Vec3<double>& velocity) {
  for (std::size_t node = 0; node < nodes; ++node) {
    body.mutable_initial_velocity_m_per_s()->append(reinterpret_cast<const char*>(velocity.data()), 3 * sizeof(double));
  }
}
std::size_t nodes_of(const v1::Body& body) {
  return body.mesh().packed().node_positions().size() / (3 * sizeof(double));
}

class Edges : public tests::OnBackend {};

/// Ridges of random bars that cross at random angles, whose nodes are elsewhere. The upper one falls by up to 5 cm and
/// stays on the lower one.
TEST_P(Edges, HoldABarThatFalls) {
  std::mt19937 random(43);
  const auto between = [&](double least, double most) {
    return std::uniform_real_distribution<double>(least, most)(random);
  };
  for (int i = 0; i < 12; ++i) {
    Ridges ridges;
    ridges.lower_cells = static_cast<std::uint32_t>(between(1, 8));
    ridges.upper_cells = static_cast<std::uint32_t>(between(1, 8));
    ridges.shape = i % 2 == 0 ? mesh::Shape::kHexahedron : mesh::Shape::kTetrahedron;
    ridges.yaw = between(20, 160) * kDegree;
    ridges.upper_turn = i % 4 < 3 ? std::numbers::pi / 4 : 0;
    ridges.gap_m = i % 3 == 0 ? 0 : between(0, 0.05);
    ridges.offset_m = between(-0.02, 0.02);
    ridges.friction = i % 2 == 0 ? 0 : between(0.1, 0.8);
    ridges.dt_s = i % 5 == 4 ? 1e-3 : 1.0 / 60;
    v1::Scene scene = crossed_ridges(ridges);
    if (i % 3 == 1) scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_BDF2);
    if (i % 3 == 2) scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT);
    if (i % 7 == 6) scene.mutable_solver()->set_newton_max_iterations(20);
    SCOPED_TRACE(testing::Message() << "bar " << i << ", cells " << ridges.lower_cells << " and " << ridges.upper_cells
                                    << ", yaw " << ridges.yaw / kDegree << ", gap " << ridges.gap_m);
    const auto world = start(scene);
    double lowest = 0;
    for (int step = 0; step < 1.0 / ridges.dt_s; ++step) {
      ASSERT_TRUE(world->step(false));
      lowest = std::min(lowest, rise_m(*world, 1) + ridges.gap_m);
    }
    EXPECT_GT(lowest, -0.006) << "it bends, and hits";
    EXPECT_GT(rise_m(*world, 1) + ridges.gap_m, -0.003);
    EXPECT_GT(world->last().touching_nodes, 0u);
  }
}

/// A bar at 4 m/s moves 67 mm in a step of 60 Hz, more than both bars are thick.
TEST_P(Edges, CatchWhatWouldPassInOneStep) {
  for (const bool newton : {false, true}) {
    Ridges ridges;
    ridges.gap_m = 0.02;
    v1::Scene scene = crossed_ridges(ridges);
    if (newton) scene.mutable_solver()->set_newton_max_iterations(20);
    set_velocity(*scene.mutable_bodies(1), nodes_of(scene.bodies(1)), {0, -4, 0});
    const auto world = start(scene);
    for (int step = 0; step < 60; ++step) {
      ASSERT_TRUE(world->step(false));
      ASSERT_GT(rise_m(*world, 1), -0.04) << "step " << step;
    }
    EXPECT_NEAR(rise_m(*world, 1), -ridges.gap_m, 0.003);
  }
}

/// Two free bars that meet in flight keep their momentum. Newton's method solves each step to rounding, and leaves out
/// the balance of free bodies.
TEST_P(Edges, KeepTheMomentumOfBarsThatMeetInFlight) {
  for (const double friction : {0.0, 0.5}) {
    Ridges ridges;
    ridges.is_guided = false;
    ridges.gap_m = 0.004;
    ridges.yaw = 70 * kDegree;
    ridges.dt_s = 1e-3;
    ridges.friction = friction;
    v1::Scene scene = crossed_ridges(ridges);
    scene.clear_gravity_m_per_s2();
    scene.mutable_solver()->set_cg_tolerance(1e-14);
    scene.mutable_solver()->set_newton_max_iterations(30);
    scene.mutable_bodies(0)->clear_fixed();
    for (v1::Body& body : *scene.mutable_bodies()) body.clear_rayleigh_stiffness_s();
    set_velocity(*scene.mutable_bodies(1), nodes_of(scene.bodies(1)), {0.05, -0.5, 0.02});
    const auto world = start(scene);
    const Vec3<double> before = momentum_of(*world);
    std::uint32_t touching = 0;
    for (int step = 0; step < 40; ++step) {
      ASSERT_TRUE(world->step(false));
      touching = std::max(touching, world->last().touching_nodes);
      EXPECT_LT((momentum_of(*world) - before).norm(), 1e-10 * before.norm()) << "step " << step;
    }
    EXPECT_GT(touching, 0u);
    EXPECT_GT(world->state().velocity.size(), 0u);
  }
}

TM_ON_EACH_BACKEND(Edges);

/// Makes the links of a scene with the upper bar moved.
double stiffness_after(StagedScene<double>& staged, const Vec3<double>& motion, Vec3<double>* force = nullptr) {
  std::vector<double> displacement(3 * std::size_t{staged.node_count()}, 0.0);
  for (std::uint32_t node = staged.model.bodies[1].node_begin; node < staged.node_count(); ++node) {
    for (std::size_t c = 0; c < 3; ++c) displacement[3 * node + c] = motion[static_cast<Eigen::Index>(c)];
  }
  staged.put(staged.view.state.displacement,
             Eigen::Map<const Eigen::VectorXd>(displacement.data(), static_cast<Eigen::Index>(displacement.size())));
  staged.run(step::StageKind::kBeginLinks);
  staged.run(step::StageKind::kFindLinks);
  const view::LinksView<double>& links = staged.view.links;
  double sum = 0;
  for (std::uint32_t t = links.first_edge_link(); t < links.count(); ++t) {
    const view::Link<double>& link = links.links[t];
    sum += link.stiffness;
    if (force != nullptr && link.stiffness > 0) *force += Vec3<double>(link.force[0], link.force[1], link.force[2]);
  }
  return sum;
}

/// The crossing slides along both ridges, over nodes of either. The stiffness of the contact stays the same.
TEST(EdgeLinks, DoNotJumpFromEdgeToEdgeOfARidge) {
  for (const double yaw : {90 * kDegree, 50 * kDegree}) {
    Ridges ridges;
    ridges.lower_cells = 7;
    ridges.upper_cells = 5;
    ridges.yaw = yaw;
    StagedScene<double> staged(crossed_ridges(ridges));
    Vec3<double> force = Vec3<double>::Zero();
    const double first = stiffness_after(staged, {0, -1e-3, 0}, &force);
    ASSERT_GT(first, 0);
    EXPECT_NEAR(std::abs(force.normalized()[1]), 1, 1e-9) << "along the common perpendicular";
    double least = first, most = first;
    for (int i = -50; i <= 50; ++i) {
      const double now = stiffness_after(staged, {4e-4 * i, -1e-3, 2.6e-4 * i});
      least = std::min(least, now);
      most = std::max(most, now);
    }
    EXPECT_LT(most - least, 1e-9 * first);
  }
}

/// Bars with a gap do not touch, though the far side of each lies behind the far side of the other.
TEST(EdgeLinks, LeaveAloneBarsThatDoNotTouch) {
  for (const double turn : {std::numbers::pi / 4, 0.0}) {
    Ridges ridges;
    ridges.upper_turn = turn;
    ridges.gap_m = 0.004;
    StagedScene<double> staged(crossed_ridges(ridges));
    ASSERT_GT(staged.view.links.edges.candidate_count, 0u);
    EXPECT_EQ(stiffness_after(staged, {0, 0, 0}), 0);
    EXPECT_EQ(stiffness_after(staged, {0, 0.03, 0}), 0);
    EXPECT_GT(stiffness_after(staged, {0, -0.005, 0}), 0);
  }
}

/// The closest points of random edges solve the least-squares problem of their lines, and the gap grows by what the
/// edge moves along n.
TEST(EdgeLinks, MeetWhereTheirLinesAreClosest) {
  std::mt19937 random(7);
  std::uniform_real_distribution<double> any(-1, 1);
  const auto vector = [&] { return Vec3<double>(any(random), any(random), any(random)); };
  const double numbers[view::kEdgeNumbers] = {1, 1, 1, 0, 0};
  int crossing = 0;
  for (int i = 0; i < 200; ++i) {
    SharpEdge<double> e{vector(), vector(), Vec3<double>::Zero(), std::cos(0.7)}, f = e;
    f.a = vector(), f.b = vector();
    const Vec3<double> n = (e.b - e.a).cross(f.b - f.a).normalized();
    e.outward = -n, f.outward = n;
    const Crossing<double> found = crossing_of(e, f, numbers, numbers, 0.0, 0.05);
    if (found.normal.norm() == 0) continue;
    ++crossing;
    Eigen::Matrix<double, 3, 2> lines;
    lines << e.b - e.a, f.a - f.b;
    const Eigen::Vector2d places = (lines.transpose() * lines).ldlt().solve(lines.transpose() * (f.a - e.a));
    EXPECT_NEAR(found.s, places[0], 1e-9 * (1 + std::abs(places[0])));
    EXPECT_NEAR(found.t, places[1], 1e-9 * (1 + std::abs(places[1])));
    EXPECT_NEAR((e.at(found.s) - f.at(found.t) - found.gap * found.normal).norm(), 0, 1e-9 * (1 + std::abs(found.s)));
    EXPECT_NEAR(found.normal.dot(n), 1, 1e-12);
    e.outward = n;  // the edge turns its back to the other
    EXPECT_EQ(crossing_of(e, f, numbers, numbers, 0.0, 0.05).share, 0);
  }
  EXPECT_GT(crossing, 150);
}

/// A body without a sharp edge has no candidates, and neither has one that only touches itself.
TEST(EdgeLinks, AreOnlyThoseOfSharpEdges) {
  v1::Scene scene = crossed_ridges();
  EXPECT_GT(tests::compile_into(scene, 1, matrix::Storage::kEdges).links.edge_candidate_count(), 0u);
  mesh::Mesh ball = mesh::make_grid({-1, -1, -1}, {2, 2, 2}, 6, 6, 6).value();
  for (Eigen::Vector3d& x : ball.nodes) {
    if (x.norm() > 0) x *= 0.02 * x.lpNorm<Eigen::Infinity>() / x.norm();
    x[1] += 0.02;
  }
  *scene.mutable_bodies(1)->mutable_mesh() = v1::Mesh();
  v1::Scene other;
  *scene.mutable_bodies(1)->mutable_mesh() = tests::add_packed(other, "ball", ball).mesh();
  const model::Model smooth = tests::compile_into(scene, 1, matrix::Storage::kEdges);
  EXPECT_EQ(smooth.links.edge_candidate_count(), 0u);
  EXPECT_TRUE(smooth.links.edge_rows.empty() && smooth.links.triangle_edges.empty());
}

}  // namespace
}  // namespace tensormass::contact
