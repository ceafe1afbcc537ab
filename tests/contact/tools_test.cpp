#include "contact/tools.h"

#include <gtest/gtest.h>

#include "contact/staged_tool.h"
#include "mesh/random_mesh.h"
#include "mesh/surface.h"
#include "support/dense_system.h"
#include "support/staged_scene.h"
#include "support/tools.h"

/// The contact stages of one step against brute force over the mesh's boundary, for every kind of tool.
namespace tensormass::contact {
namespace {

using step::StageKind;
using tests::StagedScene;

constexpr double kPenalty = 4e6;  // Pa/m

/// Puts the scene's tool, with the orientation that the scene gives it, at a position.
void place_at(StagedScene<double>& staged, const Vec3<double>& position) {
  physics::Pose pose = staged.model.tools[0].initial_pose;
  pose.position_m = position;
  place(staged, pose);
}

/// What contact with a tool outside the tissue adds to the system, triangle by triangle from the boundary.
struct DenseContact {
  Eigen::MatrixXd a;
  Eigen::VectorXd b;
  int touching = 0;

  template <class Kind>
  DenseContact(Kind, const mesh::Mesh& mesh, const Eigen::VectorXd& u, const Eigen::VectorXd& v, double dt,
               const physics::PlacedTool<double>& tool)
      : a(Eigen::MatrixXd::Zero(u.size(), u.size())), b(Eigen::VectorXd::Zero(u.size())) {
    const mesh::Surface surface = mesh::boundary(mesh);
    for (const mesh::Triangle& triangle : surface.triangles) {
      Triangle rest, x;
      Eigen::Matrix<double, 9, 1> change;  // until the end of the step
      std::uint32_t node[3];
      for (std::size_t c = 0; c < 3; ++c) {
        node[c] = surface.nodes[triangle[c]];
        rest[c] = mesh.nodes[node[c]];
        x[c] = rest[c] + u.segment<3>(3 * node[c]);
        change.segment<3>(3 * static_cast<Eigen::Index>(c)) = dt * v.segment<3>(3 * node[c]);
      }
      Deepest at = deepest<Kind>(tool, x);
      if (at.depth <= 0) continue;
      ++touching;
      const Line line = line_of<Kind>(tool, x, at);
      const Vec3<double> n = line.found ? line.normal : Kind::gradient(tool, point_at(x, at.weights));
      if (line.found) at = line.mean;
      const auto [pressure, slope] = tests::hardened(at.depth, tool.radius_m, tool.steepest);
      const double whole = kPenalty * (rest[1] - rest[0]).cross(rest[2] - rest[0]).norm() / 2;
      const double k = whole * line.sum * line.sum;
      Eigen::Matrix<double, 1, 9> along;  // how far the contact point moves along n
      for (int c = 0; c < 3; ++c) along.segment<3>(3 * c) = at.weights[c] * n.transpose();
      const Eigen::Matrix<double, 3, 9> across =
          line.found ? tilt_across(x, at.weights, n, line.lever) : way_in_triangle(x, at.weights, at.core);
      const double length = line.found ? line.lever : (point_at(x, at.weights) - at.core).norm();
      Eigen::Matrix<double, 9, 9> stiffness =
          k * slope * along.transpose() * along + k * pressure / length * across.transpose() * across;
      if (line.found) {
        Eigen::Matrix<double, 1, 9> tilt;
        for (int c = 0; c < 3; ++c) tilt.segment<3>(3 * c) = line.tilt[c] * n.transpose();
        stiffness += whole * slope * line.bend * tilt.transpose() * tilt;
      }
      const Eigen::Matrix<double, 9, 1> force = k * pressure * along.transpose() - stiffness * change;
      for (int c = 0; c < 3; ++c) {
        b.segment<3>(3 * node[c]) += dt * force.segment<3>(3 * c);
        for (int d = 0; d < 3; ++d) {
          a.block<3, 3>(3 * node[c], 3 * node[d]) += dt * dt * stiffness.block<3, 3>(3 * c, 3 * d);
        }
      }
    }
  }

 private:
  using Triangle = std::array<Vec3<double>, 3>;
  struct Deepest {
    double depth = 0;
    Vec3<double> weights = Vec3<double>::Zero(), core = Vec3<double>::Zero();
  };

  static Vec3<double> point_at(const Triangle& x, const Vec3<double>& w) {
    return x[0] * w[0] + x[1] * w[1] + x[2] * w[2];
  }
  template <class Kind>
  static Deepest deepest(const physics::PlacedTool<double>& tool, const Triangle& x) {
    Deepest found;
    Kind::for_each_candidate(tool, x[0], x[1], x[2], [&](const Vec3<double>& candidate, const auto& core) {
      const double depth = tool.radius_m - (point_at(x, candidate) - core.position).norm();
      if (!(depth > found.depth)) return;
      found.depth = depth;
      found.weights = candidate;
      found.core = core.position;
    });
    return found;
  }
  /// The same as way_in_triangle for a direction n that is not orthogonal to the triangle: L θ + T y of tilt.h.
  static Eigen::Matrix<double, 3, 9> tilt_across(const Triangle& x, const Vec3<double>& weights, const Vec3<double>& n,
                                                 double lever) {
    std::vector<int> corners;
    for (int c = 0; c < 3; ++c) {
      if (weights[c] > 0) corners.push_back(c);
    }
    Eigen::Matrix<double, 3, 9> out = Eigen::Matrix<double, 3, 9>::Zero();
    const auto count = static_cast<Eigen::Index>(corners.size()) - 1;
    if (count == 0) return out;
    Eigen::MatrixXd edges(3, count), gradients = Eigen::MatrixXd::Zero(3, 3);
    for (Eigen::Index i = 0; i < count; ++i) {
      const auto from = static_cast<std::size_t>(corners[0]),
                 to = static_cast<std::size_t>(corners[static_cast<std::size_t>(i) + 1]);
      edges.col(i) = x[to] - x[from];
    }
    const Eigen::MatrixXd inverse = edges.completeOrthogonalDecomposition().pseudoInverse();
    for (Eigen::Index i = 0; i < count; ++i) {
      gradients.col(corners[static_cast<std::size_t>(i) + 1]) = inverse.row(i).transpose();
      gradients.col(corners[0]) -= inverse.row(i).transpose();
    }
    const Eigen::MatrixXd free =
        count == 2 ? Eigen::MatrixXd(Mat3<double>::Identity() - n * n.transpose())
                   : Eigen::MatrixXd(edges.col(0) * edges.col(0).transpose() / edges.col(0).squaredNorm());
    for (int c = 0; c < 3; ++c)
      out.block<3, 3>(0, 3 * c) = lever * gradients.col(c) * n.transpose() + free * weights[c];
    return out;
  }
  /// A core that lies along the triangle: the mean of both ends of what they share (contact/line.h).
  struct Line {
    bool found = false;
    double sum = 1, bend = 0, lever = 0;  // φ + (1 − r) φ', φ φ''
    Deepest mean;
    Vec3<double> normal = Vec3<double>::Zero(), tilt = Vec3<double>::Zero();
  };
  template <class Kind>
  static Line line_of(const physics::PlacedTool<double>& tool, const Triangle& x, const Deepest& at) {
    Line out;
    for (std::uint32_t i = 0; i + 1 < Kind::kCorePoints; ++i) {
      const Vec3<double> p = Kind::core_point(tool, i), way = Kind::core_point(tool, i + 1) - p;
      const double own = (at.core - p).dot(way) / way.squaredNorm();
      if (own < -1e-12 || own > 1 + 1e-12 || (at.core - p - own * way).norm() > 1e-9) continue;
      Eigen::Matrix<double, 3, 2> edges;
      edges << x[1] - x[0], x[2] - x[0];
      const auto weights_at = [&](double s) -> Vec3<double> {
        const Eigen::Vector2d b = edges.colPivHouseholderQr().solve(p + s * way - x[0]);
        return {1 - b.sum(), b[0], b[1]};
      };
      const Vec3<double> start = weights_at(0), end = weights_at(1);
      double first = 0, last = 1;
      for (int c = 0; c < 3; ++c) {
        const double zero = start[c] / (start[c] - end[c]);
        if (end[c] > start[c]) first = std::max(first, zero);
        if (end[c] < start[c]) last = std::min(last, zero);
      }
      if (!(first < last)) return out;
      const double other = own - first > last - own ? first : last;
      const Vec3<double> weights = weights_at(other), away = point_at(x, weights) - (p + other * way);
      const double r = std::min(1.0, (tool.radius_m - away.norm()) / at.depth), w = kLineWidth;
      if (r <= 1 - kLineAhead) return out;
      const double c = 0.5 / (1 - w / 4), t = std::max(0.0, (r - 1 + w) / w), slope = c * t;
      const double phi = 1 + c * w * t * t / 2, of_deepest = phi - r * slope;
      const Vec3<double> from_core = point_at(x, at.weights) - at.core;
      out.found = true;
      out.sum = of_deepest + slope;
      out.bend = phi * c / w;
      out.tilt = weights - r * at.weights;
      out.lever = (of_deepest * from_core.norm() + slope * away.norm()) / out.sum;
      out.normal = (of_deepest * from_core.normalized() + slope * away.normalized()).normalized();
      out.mean.weights = (of_deepest * at.weights + slope * weights) / out.sum;
      out.mean.depth = at.depth * phi / out.sum;
      out.mean.core = point_at(x, out.mean.weights) - out.lever * out.normal;
      return out;
    }
    return out;
  }
  /// Returns the matrix that takes the motion of the corners to the way of the closest point through the triangle. The
  /// vector r from the core to that point stays orthogonal to the directions e in which it is free:
  ///
  ///   (dp + Σ e_j dz_j) · e_i + r · de_i = 0     dp: motion of the material there;  dz: change of its coordinates
  static Eigen::Matrix<double, 3, 9> way_in_triangle(const Triangle& x, const Vec3<double>& weights,
                                                     const Vec3<double>& core) {
    std::vector<std::pair<int, int>> ways;  // from one corner to another
    for (int c = 0; c < 3; ++c) {
      if (weights[c] > 0 && weights[(c + 1) % 3] > 0) ways.emplace_back(c, (c + 1) % 3);
    }
    if (ways.size() == 3) ways.pop_back();
    const auto count = static_cast<Eigen::Index>(ways.size());
    if (count == 0) return Eigen::Matrix<double, 3, 9>::Zero();
    const Vec3<double> r = point_at(x, weights) - core;
    Eigen::MatrixXd e(3, count), change = Eigen::MatrixXd::Zero(count, 9);
    for (Eigen::Index i = 0; i < count; ++i) {
      const auto [from, to] = ways[static_cast<std::size_t>(i)];
      e.col(i) = x[static_cast<std::size_t>(to)] - x[static_cast<std::size_t>(from)];
      for (int c = 0; c < 3; ++c) change.block<1, 3>(i, 3 * c) = weights[c] * e.col(i).transpose();
      change.block<1, 3>(i, 3 * to) += r.transpose();
      change.block<1, 3>(i, 3 * from) -= r.transpose();
    }
    return -e * (e.transpose() * e).inverse() * change;
  }
};

/// The unit box with moved nodes, free, and one tool.
v1::Scene box_scene(const mesh::Mesh& mesh, const std::string& kind, double radius_m) {
  v1::Scene scene = tests::packed_scene(mesh, true);
  v1::Tool& tool = tests::add_tool(scene, kind, radius_m, 0, 5, 0, kPenalty);
  if (kind == "retractor") tests::stand_on_its_tip(tool);
  scene.mutable_solver()->set_cg_max_iterations(3000);
  scene.mutable_solver()->set_cg_tolerance(1e-13);
  return scene;
}

/// A kind of tool, on one and on several patches.
class EveryTool : public testing::TestWithParam<std::tuple<std::string, std::uint32_t>> {
 protected:
  const std::string& kind() const { return std::get<0>(GetParam()); }
  std::uint32_t patches() const { return std::get<1>(GetParam()); }

  const mesh::Mesh mesh_ = mesh::testing::random_mesh(8, 4, 1.0);
};

TEST_P(EveryTool, AddsToTheSystemWhatBruteForceAdds) {
  const v1::Scene scene = box_scene(mesh_, kind(), 0.3);
  StagedScene<double> staged(scene, patches());
  const Eigen::Index size = 3 * staged.node_count();
  const Eigen::VectorXd u = tests::random_field(size, 0.01, 1), v = tests::random_field(size, 0.5, 2);
  staged.put(staged.view.state.displacement, u);
  staged.put(staged.view.state.velocity, v);
  const double dt = staged.model.dt_s;
  const tests::DenseSystem tissue = tests::dense_system(scene, u);
  // Over a face, over an edge, at a corner.
  for (const Vec3<double>& position : {Vec3<double>(0.5, 1.2, 0.5), {1.15, 1.1, 0.5}, {-0.1, 1.1, 1.1}}) {
    place_at(staged, position);
    staged.run_through(StageKind::kAssembleContact);
    physics::with_tool(staged.model.tools[0].kind, [&](auto tag) {
      using Kind = typename decltype(tag)::Type;
      if constexpr (!Kind::kIsSolid) {
        const DenseContact contact(Kind{}, mesh_, u, v, dt, staged.view.contact.tools[0]);
        ASSERT_GT(contact.touching, 3);
        const Eigen::MatrixXd a = tissue.a(dt) + contact.a;
        const Eigen::VectorXd b = tissue.b(dt, v) + contact.b;
        EXPECT_LT((staged.matrix() - a).norm(), 1e-12 * contact.a.norm());
        EXPECT_LT((staged.by_node(staged.view.matrix.rhs) - b).norm(), 1e-12 * b.norm());
      }
    });
  }
}

/// The tissue gains the momentum and the angular momentum that the reported load of the tool gives.
TEST_P(EveryTool, ActsOnTheTissueAsTheTissueOnIt) {
  StagedScene<double> staged(box_scene(mesh_, kind(), 0.3), patches());
  const Vec3<double> origin(0.4, 1.1, 0.6);
  place_at(staged, origin);
  staged.step();
  const Eigen::VectorXd v = staged.by_node(staged.view.state.velocity);
  Vec3<double> momentum = Vec3<double>::Zero(), angular = Vec3<double>::Zero();
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    const Vec3<double> mv = staged.model.inertia[4 * std::size_t{staged.row(node)}] * v.segment<3>(3 * node);
    momentum += mv;
    angular += (mesh_.nodes[node] - origin).cross(mv);
  }
  const backend::ToolForce tool = measured(staged);
  ASSERT_GT(tool.force_n[1], 100);
  const double dt = staged.model.dt_s;
  EXPECT_LT((momentum + dt * tool.force_n).norm(), 1e-9 * momentum.norm());
  // The torque is that where the contact was generated; the step balances moments where the tissue ends (balance.h).
  EXPECT_LT((angular + dt * tool.torque_n_m).norm(), 0.01 * momentum.norm());
}

/// Without friction every force on a sphere passes through its centre.
TEST(SphericalProbe, FeelsNoTorqueAboutItsCentre) {
  StagedScene<double> staged(box_scene(mesh::testing::random_mesh(8, 4, 1.0), "spherical_probe", 0.3));
  place_at(staged, {0.4, 1.1, 0.6});
  staged.step();
  EXPECT_LT(measured(staged).torque_n_m.norm(), 1e-12 * measured(staged).force_n.norm());
}

TEST_P(EveryTool, OutOfReachIsExactlyNothing) {
  v1::Scene with = box_scene(mesh_, kind(), 0.3);
  // Held at a node: a free body is balanced in a scene with tools, whether one touches it or not.
  with.mutable_bodies(0)->add_fixed()->mutable_nodes()->add_indices(0);
  v1::Scene without = with;
  without.clear_tools();
  StagedScene<double> touching_nothing(with, patches()), alone(without, patches());
  const Eigen::VectorXd v = tests::random_field(3 * alone.node_count(), 0.5, 2);
  alone.put(alone.view.state.velocity, v);
  touching_nothing.put(touching_nothing.view.state.velocity, v);
  place_at(touching_nothing, {0.5, 1.6, 0.5});
  for (int i = 0; i < 3; ++i) {
    alone.step();
    touching_nothing.step();
  }
  EXPECT_EQ(measured(touching_nothing).force_n, (Vec3<double>(Vec3<double>::Zero())));
  EXPECT_EQ(measured(touching_nothing).torque_n_m, (Vec3<double>(Vec3<double>::Zero())));
  EXPECT_EQ(touching_nothing.by_node(touching_nothing.view.state.displacement),
            alone.by_node(alone.view.state.displacement));
}

/// Contacts of one step must not push in the next.
TEST_P(EveryTool, LetsGoWhenItLeaves) {
  StagedScene<double> staged(box_scene(mesh_, kind(), 0.3), patches());
  place_at(staged, {0.5, 1.1, 0.5});
  staged.step();
  ASSERT_GT(measured(staged).force_n.norm(), 100);
  place_at(staged, {0.5, 9, 0.5});
  staged.step();
  EXPECT_EQ(measured(staged).force_n.norm(), 0);
}

INSTANTIATE_TEST_SUITE_P(Tools, EveryTool,
                         testing::Combine(testing::ValuesIn(tests::thin_tool_kinds()), testing::Values(1u, 2u, 6u)));

/// A tool that comes down on the block with its tip.
class OnARigidBlock : public testing::TestWithParam<std::string> {};

TEST_P(OnARigidBlock, FeelsStiffnessTimesDepth) {
  StagedScene<double> staged(tests::rigid_block(GetParam(), kPenalty));
  for (const double depth : {1e-4, 1e-3, 1e-2}) {
    place_at(staged, {0.3, 1.05 - depth, 0.7});  // far from every edge: one triangle
    staged.step();
    const backend::ToolForce tool = measured(staged);
    EXPECT_NEAR(tool.force_n[1], kPenalty * 0.5 * depth, 1e-9 * kPenalty * depth);
    EXPECT_NEAR(tool.force_n[0], 0, 1e-9 * tool.force_n[1]);
    EXPECT_NEAR(tool.force_n[2], 0, 1e-9 * tool.force_n[1]);
    EXPECT_NEAR(tool.torque_n_m.norm(), 0, 1e-12);
  }
}

/// The force grows on when the tip's centre passes the surface, and goes on pushing the tool out.
TEST_P(OnARigidBlock, IsPushedOutWithItsCentreInside) {
  StagedScene<double> staged(tests::rigid_block(GetParam(), kPenalty));
  for (const double depth : {0.049, 0.0499999, 0.05, 0.0500001, 0.051, 0.1}) {
    place_at(staged, {0.3, 1.05 - depth, 0.7});
    staged.step();
    const double steepest = staged.model.tools[0].steepest;
    const double force_n = kPenalty * 0.5 * tests::hardened(depth, 0.05, steepest).pressure_m;
    EXPECT_GT(steepest, 0.5);
    EXPECT_NEAR(measured(staged).force_n[1], force_n, 1e-6 * force_n) << "at " << depth << " m";
  }
}

INSTANTIATE_TEST_SUITE_P(Tools, OnARigidBlock, testing::ValuesIn(tests::thin_tool_kinds()));

/// A capsule that lies on one triangle touches it with its deepest point, which is the lower end if it is tilted.
TEST(CapsuleOnARigidBlock, TouchesWithItsLowerEnd) {
  StagedScene<double> staged(tests::rigid_block("capsule", kPenalty));
  physics::Pose pose;
  for (const double tilt : {0.02, -0.02}) {
    pose.position_m = {0.3, 1.05 - 1e-3, 0.6};  // the axis runs along z; a positive tilt lowers the other end
    const Eigen::Quaterniond turned(Eigen::AngleAxisd(tilt, Vec3<double>::UnitX()));
    pose.orientation = {turned.w(), turned.x(), turned.y(), turned.z()};
    place(staged, pose);
    staged.step();
    const backend::ToolForce tool = measured(staged);
    const double lower = tilt > 0 ? 0.2 * std::sin(tilt) : 0, depth = 1e-3 + lower;
    EXPECT_NEAR(tool.force_n[1], kPenalty * 0.5 * depth, 1e-6 * kPenalty * depth);
    const double lever = tilt > 0 ? 0.2 * std::cos(tilt) : 0;  // along z, from the tip to the end that touches
    EXPECT_NEAR(tool.torque_n_m[0], -lever * tool.force_n[1], 1e-6 * tool.force_n[1]);
  }
}

/// A shaft that lies across the block pushes the tool out, also when it has sunk in by more than its radius. Its ends
/// beside the block say nothing about its middle.
TEST(CapsuleAcrossARigidBlock, IsPushedOutWithItsEndsOutside) {
  struct Shaft {
    double start_m, length_m;  // along z; the block is from 0 to 1
    double pushed_m2;          // area of the triangles of the top that push at full depth
  };
  for (const Shaft& shaft : {Shaft{-0.25, 1.5, 1.0}, Shaft{0.6, 0.9, 0.5}, Shaft{-0.5, 0.9, 0.5}}) {
    v1::Scene scene = tests::rigid_block("capsule", kPenalty);
    scene.mutable_tools(0)->mutable_capsule()->set_length_m(shaft.length_m);
    for (const std::uint32_t patches : {1u, 3u}) {
      StagedScene<double> staged(scene, patches);
      for (const double depth : {0.04, 0.0499, 0.0501, 0.07, 0.1}) {
        physics::Pose pose;
        pose.position_m = {0.3, 1.05 - depth, shaft.start_m};
        place(staged, pose);
        staged.step();
        EXPECT_GT(measured(staged).force_n[1], 0.999 * kPenalty * shaft.pushed_m2 * depth)
            << depth << " m deep, from " << shaft.start_m << ", " << patches << " patches";
      }
    }
  }
}

/// The same for the blade of a retractor, whose shaft stands beside the block.
TEST(RetractorAcrossARigidBlock, IsPushedOutWithItsCornersOutside) {
  v1::Scene scene = tests::rigid_block("retractor", kPenalty);
  scene.mutable_tools(0)->mutable_retractor()->set_blade_length_m(1.5);
  StagedScene<double> staged(scene);
  for (const double depth : {0.04, 0.0501, 0.1}) {
    physics::Pose pose;
    pose.position_m = {0.3, 1.05 - depth, -0.25};
    const Eigen::Quaterniond turned = Eigen::Quaterniond::FromTwoVectors(Vec3<double>::UnitX(), Vec3<double>::UnitZ());
    pose.orientation = {turned.w(), turned.x(), turned.y(), turned.z()};
    place(staged, pose);
    staged.step();
    EXPECT_GT(measured(staged).force_n[1], 0.999 * kPenalty * depth) << depth << " m deep";
  }
}

/// The depth of a core between its ends, from the crossings that each patch has found.
TEST(CoreDepths, ChangesItsSignAtTheCrossings) {
  physics::PlacedTool<double> tool{};
  for (int c = 0; c < 3; ++c) tool.rotation[4 * c] = 1;
  tool.radius_m = 0.05;
  tool.parameters[0] = 1;  // length
  view::PatchesView patches{};
  patches.patch_count = 2;
  const auto depths = [&](double start_side, double end_side) {
    // [core point, patch]; one patch has the crossing at 0.8, the other the one at 0.2.
    view::ClosestTriangle<double> closest[] = {
        {0.04, start_side, 0.8, 0.8, 0}, {0.09, 1, 0.2, 0.2, 1}, {0.01, end_side, 2, -1, 0}, {0.09, 1, 2, -1, 1}};
    view::ContactView<double> contact{};
    contact.closest = closest;
    return CoreDepths<physics::Capsule, double>(patches, contact, tool);
  };
  const auto across = depths(1, 1);  // both ends outside
  EXPECT_EQ(across.at(0), -0.2);
  EXPECT_LE(across.at(0.1), 0);
  EXPECT_NEAR(across.at(0.21), 0.01, 1e-12) << "the way to the crossing";
  EXPECT_EQ(across.at(0.5), 0.05) << "the radius";
  EXPECT_LE(across.at(0.9), 0);
  EXPECT_EQ(across.at(1), -0.1);
  const auto tip_inside = depths(-1, 1);
  EXPECT_EQ(tip_inside.at(0), 0.2);
  EXPECT_NEAR(tip_inside.at(0.1), 0.1, 1e-12);
  for (const double place : {0.3, 0.5, 0.9, 1.0}) EXPECT_LE(tip_inside.at(place), 0) << place;
  const auto hollow = depths(-1, -1);  // both ends inside, a gap between them
  EXPECT_GT(hollow.at(0.1), 0);
  EXPECT_LE(hollow.at(0.5), 0);
  EXPECT_GT(hollow.at(0.9), 0);
}

/// A centre inside of one body is not inside of its neighbour: that one is pushed away and not drawn in.
TEST(ProbeBetweenTwoBodies, PushesTheOneThatItIsNotIn) {
  v1::Scene scene = box_scene(mesh::testing::unit_grid(2), "spherical_probe", 0.1);
  v1::Body& neighbour = *scene.add_bodies();
  neighbour = scene.bodies(0);
  neighbour.set_name("neighbour");
  neighbour.mutable_mesh()->mutable_translation_m()->set_x(1.02);
  for (const std::uint32_t patches : {1u, 3u}) {
    StagedScene<double> staged(scene, patches);
    place_at(staged, {0.97, 0.4, 0.6});  // 3 cm inside of the first, 5 cm before the second
    staged.step();
    const Eigen::VectorXd v = staged.by_node(staged.view.state.velocity);
    Vec3<double> momentum[2] = {Vec3<double>::Zero(), Vec3<double>::Zero()};
    for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
      momentum[node / 27] += staged.model.inertia[4 * std::size_t{staged.row(node)}] * v.segment<3>(3 * node);
    }
    EXPECT_LT(momentum[0][0], -1) << "over the sphere and out of it";
    EXPECT_GT(momentum[1][0], 1);
  }
}

/// Compares the sign by pseudonormal with a search for an element that contains the point: at faces, edges and corners,
/// sharp and blunt.
/// Returns how many points were inside.
int check_sides(const mesh::Mesh& mesh, std::uint32_t patches, std::uint32_t seed) {
  StagedScene<double> staged(box_scene(mesh, "spherical_probe", 0.05), patches);
  Eigen::AlignedBox3d box;
  for (const Eigen::Vector3d& x : mesh.nodes) box.extend(x);
  const auto contains = [&](const Eigen::Vector3d& p, std::span<const std::uint32_t> nodes) {
    Mat3<double> edges;
    for (int k = 0; k < 3; ++k)
      edges.col(k) = mesh.nodes[nodes[static_cast<std::size_t>(k) + 1]] - mesh.nodes[nodes[0]];
    const Vec3<double> w = edges.inverse() * (p - mesh.nodes[nodes[0]]);
    return w.minCoeff() >= 0 && w.sum() <= 1;
  };
  const auto elements = mesh::element_nodes(mesh);
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(-0.25, 1.25);
  int inside_count = 0;
  for (int i = 0; i < 400; ++i) {
    const Eigen::Vector3d p =
        box.min() + box.sizes().cwiseProduct(Eigen::Vector3d(uniform(random), uniform(random), uniform(random)));
    const bool inside =
        std::any_of(elements.begin(), elements.end(), [&](const auto& nodes) { return contains(p, nodes); });
    inside_count += inside ? 1 : 0;
    place_at(staged, p);
    staged.run(StageKind::kQueryClosest);
    const auto* first = staged.view.contact.closest;
    const auto* nearest = std::min_element(
        first, first + patches, [](const auto& a, const auto& b) { return a.distance_squared < b.distance_squared; });
    EXPECT_EQ(nearest->side < 0, inside) << "point " << p.transpose() << ", " << std::sqrt(nearest->distance_squared)
                                         << " m from the surface";
  }
  return inside_count;
}

TEST(Side, IsRightAroundABoxWithADentedSurface) {
  EXPECT_GT(check_sides(mesh::testing::random_mesh(12, 3, 1.0), 1, 1), 50);
  EXPECT_GT(check_sides(mesh::testing::random_mesh(13, 3, 1.0), 4, 2), 50);
}

TEST(Side, IsRightAroundSharpTetrahedra) {
  std::mt19937 random(4);
  std::uniform_real_distribution<double> uniform(0, 1);
  int inside = 0;
  for (int trial = 0; trial < 20; ++trial) {
    mesh::Mesh mesh;
    for (int k = 0; k < 4; ++k) mesh.nodes.push_back({uniform(random), uniform(random), 0.2 * uniform(random)});
    mesh.blocks.push_back({mesh::Shape::kTetrahedron, {0, 1, 2, 3}});
    const double volume = mesh::six_volumes(mesh.nodes[0], mesh.nodes[1], mesh.nodes[2], mesh.nodes[3]) / 6;
    if (std::abs(volume) < 3e-3) continue;
    if (volume < 0) std::swap(mesh.nodes[0], mesh.nodes[1]);
    inside += check_sides(mesh, 1, static_cast<std::uint32_t>(trial));
  }
  EXPECT_GT(inside, 50);
}

}  // namespace
}  // namespace tensormass::contact
