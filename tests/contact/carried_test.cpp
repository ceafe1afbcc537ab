#include "contact/carried.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <map>
#include <memory>
#include <numbers>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "support/laws.h"
#include "support/momentum.h"
#include "support/parted.h"
#include "support/solids.h"
#include "support/tools.h"

/// Tools that touch the faces of cuts.
namespace tensormass::contact {
namespace {

using Eigen::Vector3d;
using tests::CutBody;

const Vector3d kSizeM{0.06, 0.03, 0.03};
constexpr double kCutM = 0.0323;

/// A block of tetrahedra without gravity, as long as `size_x_m`.
v1::Scene block_scene(double size_x_m, std::uint32_t cells_x, std::uint32_t cells, double dt_s) {
  v1::Scene scene = tests::beam_scene({.cells_x = cells_x,
                                       .cells_y = cells,
                                       .cells_z = cells,
                                       .size_x_m = size_x_m,
                                       .size_y_m = kSizeM[1],
                                       .size_z_m = kSizeM[2],
                                       .linear = true,
                                       .double_precision = true,
                                       .young_modulus_pa = 1e4,
                                       .poisson_ratio = 0.3,
                                       .dt_s = dt_s,
                                       .cg_max_iterations = 5000,
                                       .cg_tolerance = 1e-13});
  scene.clear_gravity_m_per_s2();
  scene.mutable_editing()->mutable_cutting();
  scene.mutable_solver()->set_cpu_threads(2);
  return scene;
}

class FacesOfCuts : public tests::OnBackendWithParts {};
TM_ON_EACH_BACKEND(FacesOfCuts);

/// Positions of rows at rest.
Vector3d rest_of(const model::Model& m, std::uint32_t row) {
  return {m.rest[4 * std::size_t{row}], m.rest[4 * std::size_t{row} + 1], m.rest[4 * std::size_t{row} + 2]};
}
/// The corners of a contact triangle at rest.
std::array<Vector3d, 3> corners_at_rest(const model::Model& m, std::uint32_t triangle) {
  std::array<Vector3d, 3> out;
  const std::uint32_t outer = m.contact.outer_count();
  for (std::uint32_t c = 0; c < 3; ++c) {
    if (triangle < outer) {
      out[c] = rest_of(m, m.contact.triangle_rows[3 * std::size_t{triangle} + c]);
      continue;
    }
    out[c].setZero();
    for (std::size_t k = 0; k < 4; ++k) {
      const std::size_t at = triangle - outer;
      out[c] += m.contact.carried.weights[12 * at + 4 * c + k] * rest_of(m, m.contact.carried.rows[4 * at + k]);
    }
  }
  return out;
}

/// What tools touch of a body that is cut at random: one closed surface around the whole volume. Each edge has two
/// triangles, and each face of a cut has a twin.
TEST_P(FacesOfCuts, CloseTheSurface) {
  std::mt19937 random(7);
  for (const std::uint32_t threads : {1u, 3u}) {
    for (int round = 0; round < 6; ++round) {
      v1::Scene scene = block_scene(kSizeM[0], 6, 3, 0.01);
      scene.mutable_solver()->set_cpu_threads(threads);
      tests::add_probe(scene, "probe", 0.01, 0.03, 1, 0.015);
      CutBody body(scene);
      for (int cut = 0; cut < 4; ++cut) body.move_at_random(random, kSizeM);
      const auto world = start_cut(scene, body.cuts());
      const model::Model& m = world->model();
      const model::ContactSurface& contact = m.contact;
      const model::CarriedTriangles& carried = contact.carried;
      ASSERT_GT(carried.count(), 50u);
      Vector3d area = Vector3d::Zero();
      double volume_m3 = 0;
      std::size_t rims = 0, faces = 0;
      for (std::uint32_t t = 0; t < contact.triangle_count(); ++t) {
        const auto x = corners_at_rest(m, t);
        const Vector3d twice = (x[1] - x[0]).cross(x[2] - x[0]);
        area += twice / 2;
        volume_m3 += twice.dot(x[0]) / 6;
        EXPECT_NEAR(contact.triangle_area[t], twice.norm() / 2, 1e-15);
        for (std::uint32_t side = 0; side < 3; ++side) {
          const std::uint32_t across = contact.triangle_neighbours[3 * std::size_t{t} + side];
          if (across == view::kNoTriangle) {
            ++rims;
            continue;
          }
          // The edge is the same one, and the triangle beyond it names this one.
          const auto other = corners_at_rest(m, across);
          std::size_t same = 0;
          for (std::size_t i = 0; i < 3; ++i) {
            same += (other[i] - x[(side + 1) % 3]).norm() + (other[(i + 1) % 3] - x[side]).norm() < 1e-12 ? 1 : 0;
          }
          EXPECT_EQ(same, 1u);
          const auto back = contact.triangle_neighbours.begin() + 3 * std::ptrdiff_t{across};
          EXPECT_EQ(std::count(back, back + 3, t), 1);
        }
        if (t < contact.outer_count()) continue;
        const std::uint32_t twin = carried.twins[t - contact.outer_count()];
        if (twin == view::kNoTriangle) continue;
        ++faces;
        EXPECT_EQ(carried.twins[twin - contact.outer_count()], t);
        const auto of_twin = corners_at_rest(m, twin);
        EXPECT_LT(((of_twin[1] - of_twin[0]).cross(of_twin[2] - of_twin[0]) + twice).norm(), 1e-15);
      }
      EXPECT_LT(area.norm(), 1e-14);
      EXPECT_NEAR(volume_m3, kSizeM.prod(), 1e-12 * kSizeM.prod());
      EXPECT_EQ(rims, 0u);
      EXPECT_GT(faces, 50u);
    }
  }
}

/// A step from rest gives the tissue the momentum and the moment that the tool reports: each row gets its share.
TEST_P(FacesOfCuts, ReceiveTheForceThatTheToolReports) {
  const std::vector<std::string> thin = tests::thin_tool_kinds();
  std::vector<std::string> kinds = thin;
  for (const std::string& kind : tests::solid_kinds()) kinds.push_back(kind);
  for (const std::string& kind : kinds) {
    for (const v1::ContactMethod method : {v1::CONTACT_METHOD_PENALTY, v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN}) {
      for (const double friction : {0.0, 0.4}) {
        SCOPED_TRACE(kind + ", friction " + std::to_string(friction));
        // Moments are those about the place of the rows at rest, and differ by how far a step moves them.
        const bool keeps = method == v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN;
        const double eps = keeps ? 3e-3 : 1e-6;
        // Newton's method does not quite converge where points of a solid that keep their force touch and leave in
        // turn.
        const double unbalanced = keeps && (kind == "box" || kind == "mesh") ? 1e-4 : 1e-10;
        v1::Scene scene = block_scene(kSizeM[0], 6, 3, keeps ? 1.0 / 240 : 1e-5);
        // Balance (balance.h) would hide a wrong force, and a step with Newton's method has none.
        scene.mutable_solver()->set_newton_max_iterations(30);
        scene.mutable_solver()->set_newton_tolerance(1e-11);
        scene.mutable_bodies(0)->clear_fixed();
        const bool is_thin = std::ranges::find(thin, kind) != thin.end();
        // Cut across y: the tool comes from above on the face of the lower half.
        constexpr double kFaceM = 0.0163;
        if (is_thin) {
          tests::add_tool(scene, kind, 0.01, 0.031, kFaceM + 0.0094, 0.014, 1e7);
          // The blade would lie along the face, where Newton's method does not converge in so stiff a step.
          if (kind == "retractor") tests::stand_on_its_tip(*scene.mutable_tools(0));
        } else {
          tests::add_solid(scene, kind, {0.03, 0.02, 0.02}, {0.031, kFaceM + 0.0094, 0.014}, 1e7);
        }
        scene.mutable_tools(0)->set_contact_method(method);
        scene.mutable_tools(0)->set_friction_coefficient(friction);
        scene.mutable_tools(0)->set_max_speed_m_per_s(100);
        CutBody body(scene);
        tests::cut_across(body, 1, kFaceM);
        const auto world = start_apart(scene, body, [](std::uint32_t piece) {
          return piece == 0 ? Vector3d(0, 0, 0) : Vector3d(0, -1, 0);  // the upper half is far away
        });
        const physics::Pose pose = world->readings()[0].pose;
        physics::Pose moved = pose;
        moved.position_m += Vector3d(2e-4, -1e-4, 1e-4);
        const model::Model& m = world->model();
        const auto moment_of = [&](const Vector3d& center) {
          const std::vector<double> v = world->state().velocity;
          Vector3d sum = Vector3d::Zero();
          for (std::uint32_t row = 0; row < m.layout.row_count; ++row) {
            const Vector3d of_row(v[4 * std::size_t{row}], v[4 * std::size_t{row} + 1], v[4 * std::size_t{row} + 2]);
            sum += m.row_mass[row] * (rest_of(m, row) - center).cross(of_row);
          }
          return sum;
        };
        world->set_tool_target(0, moved);
        ASSERT_TRUE(world->step(false));
        const world::ToolReading& reading = world->readings()[0];
        const Vector3d impulse = -reading.force_n * m.dt_s, turn = -reading.torque_n_m * m.dt_s;
        ASSERT_GT(reading.force_n[1], 0.01);
        EXPECT_EQ(reading.friction_n.norm() > 1e-4, friction > 0);
        EXPECT_LT((tests::momentum_of(*world) - impulse).norm(), unbalanced * impulse.norm());
        EXPECT_LT((moment_of(reading.pose.position_m) - turn).norm(), eps * impulse.norm() * kSizeM.norm());
      }
    }
  }
}

/// The half of a block that is fixed, pressed on its cut face, answers as a block with that face as its skin.
///
/// A triangle carries its area at the depth of its deepest point, so round tools press too much on large triangles.
/// Faces of a cut have triangles of half the size of the skin's, so the skin of a mesh with half of its cells is
/// compared. Tissue that does not yield has an exact force, with the pressure p · depth: π p (R − d) d² for a sphere of
/// the radius R.
TEST_P(FacesOfCuts, AnswerAsTheSkinOfABlockThatEndsThere) {
  constexpr double kRadiusM = 0.012, kDepthM = 2.5e-3, kPenalty = 2e6, kHalf = 0.70710678118654757;
  constexpr double kExactN = std::numbers::pi * kPenalty * (kRadiusM - kDepthM) * kDepthM * kDepthM;
  struct Press {
    const char* kind;
    double young_modulus_pa;
    std::uint32_t cells_of_skin;
  };
  for (const Press& press : {Press{"plane", 1e4, 12}, Press{"box", 1e4, 12}, Press{"spherical_probe", 1e4, 24},
                             Press{"capsule", 1e4, 24}, Press{"spherical_probe", 1e7, 12}}) {
    std::vector<double> force_n;
    for (const std::uint32_t cells : {0u, press.cells_of_skin}) {  // 0: cut
      const bool is_cut = cells == 0;
      v1::Scene scene = is_cut ? block_scene(kSizeM[0], 24, 12, 1) : block_scene(kCutM, 13 * cells / 12, cells, 1);
      scene.mutable_bodies(0)->mutable_law()->mutable_hooke()->set_young_modulus_pa(press.young_modulus_pa);
      scene.mutable_solver()->set_cg_tolerance(1e-8);
      tests::set(*scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box()->mutable_max_m(), 1e-6, 2, 2);
      const std::string kind = press.kind;
      if (kind == "plane" || kind == "box") {
        tests::add_solid(scene, kind, {0.05, 0.05, 0.05}, {0, 0, 0}, kPenalty);
        v1::Tool& solid = *scene.mutable_tools(0);
        // The plane's z axis, or a side of the box, towards the block.
        tests::set(*solid.mutable_position_m(), kCutM - kDepthM + (kind == "box" ? 0.025 : 0), 0.015, 0.015);
        v1::Quaternion& q = *solid.mutable_orientation();
        q.set_w(kind == "box" ? 1 : kHalf), q.set_x(0), q.set_y(kind == "box" ? 0 : -kHalf), q.set_z(0);
      } else {
        tests::add_tool(scene, kind, kRadiusM, kCutM + kRadiusM - kDepthM, kind == "capsule" ? -0.009 : 0.0147, 0.0143,
                        kPenalty);
      }
      std::unique_ptr<world::World> world;
      if (is_cut) {
        CutBody body(scene);
        tests::cut_across(body, 0, kCutM);
        world = start_apart(scene, body,
                            [](std::uint32_t piece) { return piece == 0 ? Vector3d(0, 0, 0) : Vector3d(-1, 1, 0); });
      } else {
        scene.clear_editing();
        world = start(scene);
      }
      for (int i = 0; i < 8; ++i) ASSERT_TRUE(world->step(false));
      force_n.push_back(world->readings()[0].force_n[0]);
    }
    std::printf("%-16s %.0e Pa: face of a cut %.4f N, skin %.4f N, %+.2f %%\n", press.kind, press.young_modulus_pa,
                force_n[0], force_n[1], 100 * (force_n[0] / force_n[1] - 1));
    if (press.young_modulus_pa < 1e6) {
      EXPECT_NEAR(force_n[0], force_n[1], 0.02 * force_n[1]) << press.kind;
    } else {
      EXPECT_GT(force_n[0], kExactN);
      EXPECT_LT(force_n[0], force_n[1]) << "smaller triangles are closer to the exact force";
    }
  }
}

/// Tissue that hardly moves in a step shows the contact alone: what a tool feels above a cut that is closed, with its
/// core above the skin or deep below it.
TEST_P(FacesOfCuts, DoNotExistWhileTheCutIsClosed) {
  struct Press {
    const char* kind;
    double depth_m;
  };
  for (const double angle : {0.0, 0.6}) {
    for (const Press& press :
         {Press{"spherical_probe", 3e-3}, Press{"spherical_probe", 0.013}, Press{"capsule", 2e-3},
          Press{"capsule", 9e-3}, Press{"grasper", 2e-3}, Press{"box", 1e-3}, Press{"plane", 1e-3}}) {
      SCOPED_TRACE(std::string(press.kind) + " " + std::to_string(press.depth_m) + " m, angle " +
                   std::to_string(angle));
      std::vector<double> force_n;
      for (const bool is_cut : {false, true}) {
        v1::Scene scene = block_scene(kSizeM[0], 24, 12, 1e-6);
        const std::string kind = press.kind;
        if (kind == "plane" || kind == "box") {
          tests::add_solid(scene, kind, {0.03, 0.02, 0.02}, {kCutM, kSizeM[1] + 0.01 - press.depth_m, 0.014}, 1e6);
        } else {
          tests::add_tool(scene, kind, 0.008, kCutM, kSizeM[1] + 0.008 - press.depth_m, 0.014, 1e6);
          if (kind != "spherical_probe") tests::stand_on_its_tip(*scene.mutable_tools(0));
        }
        std::unique_ptr<world::World> world;
        if (is_cut) {
          CutBody body(scene);
          // Through the block, upright or slanting, below the tool.
          const Vector3d top{kCutM, kSizeM[1], 0}, down = Vector3d(std::tan(angle), -1, 0), aside{0, 0, 0.1};
          body.move({top - 0.02 * down - aside, top - 0.02 * down + aside},
                    {top + 0.025 * down - aside, top + 0.025 * down + aside});
          world = start_cut(scene, body.cuts());
          EXPECT_GT(world->model().contact.carried.count(), 100u);
        } else {
          world = start(scene);
        }
        ASSERT_TRUE(world->step(false));
        force_n.push_back(world->readings()[0].force_n[1]);
      }
      std::printf("%-16s %.4f m, %.1f rad: whole %.5f N, cut %.5f N, %+.2f %%\n", press.kind, press.depth_m, angle,
                  force_n[0], force_n[1], 100 * (force_n[1] / force_n[0] - 1));
      EXPECT_GT(force_n[0], 0.01);
      EXPECT_NEAR(force_n[1], force_n[0], 0.08 * force_n[0]) << "rims of the cut have smaller triangles";
    }
  }
}

/// A tool on a flap that is much thinner than itself feels the side that faces it, and not the face of the cut below.
TEST_P(FacesOfCuts, DoNotPushAToolThatIsBehindThem) {
  std::vector<double> force_n;
  for (const bool is_cut : {false, true}) {
    v1::Scene scene = block_scene(kSizeM[0], 24, 12, 1e-6);
    scene.mutable_bodies(0)->clear_fixed();
    tests::add_tool(scene, "spherical_probe", 0.008, 0.0312, kSizeM[1] + 0.008 - 2e-3, 0.014, 1e6);
    std::unique_ptr<world::World> world;
    if (is_cut) {
      CutBody body(scene);
      tests::cut_across(body, 1, kSizeM[1] - 5e-4);
      world = start_apart(scene, body,
                          [](std::uint32_t piece) { return piece == 0 ? Vector3d(0, -0.1, 0) : Vector3d(0, 0, 0); });
    } else {
      world = start(scene);
    }
    ASSERT_TRUE(world->step(false));
    force_n.push_back(world->readings()[0].force_n[1]);
  }
  EXPECT_GT(force_n[0], 0.05);
  EXPECT_NEAR(force_n[1], force_n[0], 1e-3 * force_n[0]);
}

/// A sphere and a capsule that lie in an open cut push its faces apart, each by what the other one feels.
TEST_P(FacesOfCuts, ArePushedApartByWhatLiesBetweenThem) {
  for (const std::string kind : {"spherical_probe", "capsule"}) {
    SCOPED_TRACE(kind);
    constexpr double kRadiusM = 0.006, kDepthM = 1e-3;
    v1::Scene scene = block_scene(kSizeM[0], 12, 6, 1e-4);
    scene.mutable_bodies(0)->clear_fixed();
    const double middle_m = kCutM + kRadiusM - kDepthM;
    tests::add_tool(scene, kind, kRadiusM, middle_m, 0.014, 0.016, 1e6);
    CutBody body(scene);
    tests::cut_across(body, 0, kCutM);
    const auto world = start_apart(scene, body, [&](std::uint32_t piece) {
      return piece == 0 ? Vector3d(0, 0, 0) : Vector3d(2 * (kRadiusM - kDepthM), 0, 0);
    });
    const std::vector<std::uint32_t> pieces = tests::pieces_by_row(body.body().cut());
    const model::Model& m = world->model();
    ASSERT_TRUE(world->step(false));
    const std::vector<double> v = world->state().velocity;
    Vector3d left = Vector3d::Zero(), right = Vector3d::Zero();
    for (std::uint32_t node = 0; node < pieces.size(); ++node) {
      const std::size_t row = m.layout.row_of_node[node];
      (pieces[node] == 0 ? left : right) += m.row_mass[row] * Vector3d(v[4 * row], v[4 * row + 1], v[4 * row + 2]);
    }
    const Vector3d felt = world->readings()[0].force_n;
    const double push_n = right[0] / m.dt_s;
    EXPECT_GT(push_n, 0.02);
    EXPECT_NEAR(-left[0] / m.dt_s, push_n, 0.15 * push_n) << "both faces have other triangles";
    EXPECT_LT((left + right + felt * m.dt_s).norm(), 1e-10 * right.norm());
  }
}

/// A piece whose lower side is the face of a cut lies on a plane and bears its weight.
TEST_P(FacesOfCuts, BearTheWeightOfTheirPiece) {
  for (const bool double_precision : {true, false}) {
    constexpr double kFaceM = 0.0163, kFarM = 0.2;
    v1::Scene scene = block_scene(kSizeM[0], 8, 4, 1.0 / 60);
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
    tests::set(*scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box()->mutable_max_m(), 1, 1e-6, 1);
    scene.mutable_bodies(0)->set_rayleigh_mass_per_s(5);
    scene.mutable_bodies(0)->set_rayleigh_stiffness_s(0.01);
    scene.mutable_solver()->set_cg_tolerance(double_precision ? 1e-10 : 1e-4);
    scene.mutable_solver()->set_precision(double_precision ? v1::Solver::PRECISION_DOUBLE
                                                           : v1::Solver::PRECISION_FLOAT);
    tests::add_solid(scene, "plane", {1, 0.02, 1}, {0, -kFarM - 0.01 + kFaceM, 0}, 2e6, true);
    scene.mutable_tools(0)->set_friction_coefficient(0.3);
    CutBody body(scene);
    tests::cut_across(body, 1, kFaceM);
    const auto world = start_apart(scene, body, [](std::uint32_t piece) {
      return piece == 0 ? Vector3d(0, 0, 0) : Vector3d(0.2, 0.001 - kFarM, 0);
    });
    const std::vector<std::uint32_t> pieces = tests::pieces_by_row(body.body().cut());
    const model::Model& m = world->model();
    double mass_kg = 0;
    for (std::uint32_t node = 0; node < pieces.size(); ++node) {
      if (pieces[node] != 0) mass_kg += m.row_mass[m.layout.row_of_node[node]];
    }
    for (int i = 0; i < 240; ++i) ASSERT_TRUE(world->step(false)) << i;
    const double weight_n = 9.81 * mass_kg;
    EXPECT_GT(weight_n, 0.2);
    EXPECT_NEAR(-world->readings()[0].force_n[1], weight_n, 0.01 * weight_n);
    const backend::RowState state = world->state();
    double top_m_per_s = 0;
    for (const double v : state.velocity) top_m_per_s = std::max(top_m_per_s, std::abs(v));
    EXPECT_LT(top_m_per_s, 2e-3) << "it is at rest";
  }
}

/// Soft tissue over a floor, solved as coarsely as in a scene for a hand.
v1::Scene soft_scene() {
  v1::Scene scene = block_scene(kSizeM[0], 6, 3, 1.0 / 60);
  tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
  v1::Body& body = *scene.mutable_bodies(0);
  *body.mutable_law() = tests::law("stable_neo_hookean", 5e3, 0.45);
  body.set_rayleigh_mass_per_s(0.5);
  body.set_rayleigh_stiffness_s(0.01);
  scene.mutable_solver()->set_precision(v1::Solver::PRECISION_FLOAT);
  scene.mutable_solver()->set_cg_tolerance(0.01);
  scene.mutable_solver()->set_cg_max_iterations(100);
  scene.mutable_solver()->set_cpu_threads(1);
  tests::add_solid(scene, "plane", {1, 0.02, 1}, {0, -0.015, 0}, 1e6, true);
  v1::Tool& floor = *scene.mutable_tools(0);
  floor.set_fixed(true);
  floor.clear_max_force_n(), floor.clear_max_torque_n_m();
  scene.mutable_tools(0)->set_friction_coefficient(0.3);
  return scene;
}

/// Nothing that random cuts free falls through the floor, however little outer skin it has.
TEST_P(FacesOfCuts, HoldEachPieceOnTheFloor) {
  std::mt19937 random(3);
  std::size_t fallen = 0;
  for (int round = 0; round < 4; ++round) {
    v1::Scene scene = soft_scene();
    scene.mutable_bodies(0)->clear_fixed();
    auto world = start(scene);
    CutBody body(scene);
    for (int cut = 0; cut < 8; ++cut) {
      body.move_at_random(random, kSizeM);
      world = cut_on(scene, *world, body.cuts());
      for (int i = 0; i < 10; ++i) ASSERT_TRUE(world->step(false));
    }
    for (int i = 0; i < 120; ++i) ASSERT_TRUE(world->step(false));
    const std::vector<std::uint32_t> pieces = tests::pieces_by_row(body.body().cut());
    const model::Model& m = world->model();
    const backend::RowState state = world->state();
    std::map<std::uint32_t, std::pair<double, double>> of_piece;  // mass, and its moment of height
    for (std::uint32_t node = 0; node < pieces.size(); ++node) {
      const std::size_t row = m.layout.row_of_node[node];
      const double height_m = m.rest[4 * row + 1] + state.displacement[4 * row + 1];
      of_piece[pieces[node]].first += m.row_mass[row];
      of_piece[pieces[node]].second += m.row_mass[row] * height_m;
    }
    for (const auto& [piece, sums] : of_piece) EXPECT_GT(sums.second / sums.first, -0.01) << "piece " << piece;
    fallen += of_piece.size() - 1;
  }
  EXPECT_GT(fallen, 5u) << "pieces came free";
}

/// Instruments that move at random among random cuts make no event of the guard.
TEST_P(FacesOfCuts, AreCalmUnderRandomInstruments) {
  std::mt19937 random(5);
  std::uniform_real_distribution<double> uniform(-1, 1);
  for (int round = 0; round < 3; ++round) {
    v1::Scene scene = soft_scene();
    v1::Box& clamp = *scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box();
    tests::set(*clamp.mutable_min_m(), -1, -1, -1);
    tests::set(*clamp.mutable_max_m(), 1, 1e-6, 1);
    const std::vector<std::string> kinds{"spherical_probe", "capsule", "grasper"};
    for (const std::string& kind : kinds) {
      v1::Tool& tool = tests::add_tool(scene, kind, 0.004, 0.03, 0.05, 0.015, 1e6);
      tool.set_name(kind);
      tool.clear_max_force_n(), tool.clear_max_torque_n_m(), tool.clear_max_joint_load();
      tool.set_friction_coefficient(0.3);
    }
    auto world = start(scene);
    CutBody body(scene);
    std::vector<physics::Pose> poses;
    for (std::size_t t = 0; t < kinds.size(); ++t) poses.push_back(world->readings()[1 + t].pose);
    for (int cut = 0; cut < 6; ++cut) {
      body.move_at_random(random, kSizeM);
      world = cut_on(scene, *world, body.cuts());
      for (int i = 0; i < 40; ++i) {
        for (std::size_t t = 0; t < poses.size(); ++t) {
          Vector3d& at = poses[t].position_m;
          at += 1e-3 * Vector3d(uniform(random), uniform(random), uniform(random));
          at = at.cwiseMax(Vector3d(0, 0.01, 0)).cwiseMin(Vector3d(0.06, 0.05, 0.03));
          world->set_tool_target(static_cast<std::uint32_t>(1 + t), poses[t]);
        }
        ASSERT_TRUE(world->step(false));
        ASSERT_EQ(world->guard_event(), nullptr)
            << round << ", cut " << cut << ", step " << i << ": " << to_text(*world->guard_event(), world->model());
      }
    }
    for (const double v : world->state().velocity) ASSERT_TRUE(std::isfinite(v) && std::abs(v) < 5);
  }
}

/// Springs of friction stay as they are where a further cut changes nothing.
TEST_P(FacesOfCuts, KeepTheirFrictionWhenTissueIsCutFurther) {
  v1::Scene scene = block_scene(kSizeM[0], 6, 3, 1.0 / 60);
  constexpr double kFaceM = 0.0163;
  tests::set(*scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box()->mutable_max_m(), 1, 1e-6, 1);
  tests::add_tool(scene, "spherical_probe", 0.01, 0.041, kFaceM + 0.009, 0.014, 1e7);
  scene.mutable_tools(0)->set_friction_coefficient(0.5);
  CutBody body(scene);
  tests::cut_across(body, 1, kFaceM);
  const auto world =
      start_apart(scene, body, [](std::uint32_t piece) { return piece == 0 ? Vector3d(0, 0, 0) : Vector3d(0, 1, 0); });
  physics::Pose pose = world->readings()[0].pose;
  for (int i = 0; i < 5; ++i) {
    pose.position_m[0] += 5e-5;
    world->set_tool_target(0, pose);
    ASSERT_TRUE(world->step(false));
  }
  const auto sum_of = [](const std::vector<double>& slips) {
    double sum = 0;
    for (const double slip : slips) sum += std::abs(slip);
    return sum;
  };
  const std::vector<double> before = world->save().tissue.slips;
  ASSERT_GT(sum_of(before), 0);
  const Vector3d corner{0, 0.02, -0.1}, aside{0, 0, 0.2}, way{0.004, -0.1, 0};
  body.move({corner, corner + aside}, {corner + way, corner + way + aside});
  const auto after = cut_on(scene, *world, body.cuts());
  const std::vector<double> kept = after->save().tissue.slips;
  EXPECT_GT(kept.size(), before.size());
  EXPECT_EQ(sum_of(kept), sum_of(before));
}

}  // namespace
}  // namespace tensormass::contact
