#include "model/compile.h"

#include <limits>
#include <numeric>

#include <gtest/gtest.h>

#include "model/scene_input.h"
#include "support/findings.h"
#include "support/scenes.h"

/// Compares a compiled scene with what its message says.
namespace tensormass::model {
namespace {

Model compiled(const v1::Scene& scene, const PatchPolicy& policy = {}) {
  auto model = compile(scene, policy);
  if (!model) throw std::runtime_error(model.error().message);
  return std::move(*model);
}

/// Component `c` of a row field of a node.
double at(const Model& model, const std::vector<double>& field, std::uint32_t node, std::size_t c) {
  return field[4 * std::size_t{model.layout.row_of_node[node]} + c];
}

TEST(Compile, TakesTheDefaultsThatTheProtocolNames) {
  v1::Scene scene = tests::block_with_probe();
  scene.clear_stepping();
  scene.clear_solver();
  scene.clear_streams();
  const Model model = compiled(scene);
  EXPECT_EQ(model.dt_s, 1.0 / 60);
  EXPECT_NEAR(model.rate_hz, 60, 1e-12);
  EXPECT_EQ(model.cg_max_iterations, 100u);
  EXPECT_EQ(model.cg_tolerance, 1e-3);
  EXPECT_FALSE(model.double_precision);
  EXPECT_FALSE(model.lockstep);
  EXPECT_EQ(model.frame_rate_hz, 60);
  EXPECT_EQ(model.status_rate_hz, 4);
  const ToolModel& tool = model.tools.at(0);
  EXPECT_NEAR(tool.max_speed_m_per_s, 60 * 0.01 / 2, 1e-12) << "half of its radius in a step";
  EXPECT_EQ(tool.penalty_pa_per_m, 0);
  EXPECT_NEAR(tool.penalty_per_m, 20 / 0.01, 1e-9);
  EXPECT_EQ(tool.initial_pose.orientation, (std::array<double, 4>{1, 0, 0, 0}));
  scene.mutable_stepping()->set_dt_s(0.001);
  EXPECT_EQ(compiled(scene).tools.at(0).max_speed_m_per_s, 0.5);
}

TEST(Compile, ACouplingIsCriticallyDampedByDefault) {
  v1::Scene scene = tests::block_with_probe();
  EXPECT_EQ(compiled(scene).tools.at(0).mass_kg, 0) << "without a mass the tool is at its pose";
  scene.mutable_tools(0)->set_mass_kg(0.1);
  const Model model = compiled(scene);
  EXPECT_EQ(model.tools.at(0).mass_kg, 0.1);
  EXPECT_EQ(model.tools.at(0).coupling_stiffness_n_per_m, 1000);
  EXPECT_NEAR(model.tools.at(0).coupling_damping_n_s_per_m, 20, 1e-12) << "2 sqrt(k m)";
}

TEST(Compile, RefusesACouplingThatCannotMoveItsTool) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  struct Wrong {
    double mass_kg, stiffness, damping;
    bool fixed;
    const char* words;
  };
  for (const Wrong& wrong :
       {Wrong{0, 1, 1, false, "tool 'probe'.mass_kg"}, Wrong{nan, 1, 1, false, "tool 'probe'.mass_kg"},
        Wrong{1e4, 1, 1, false, "tool 'probe'.mass_kg"}, Wrong{1, 0, 1, false, "coupling_stiffness_n_per_m"},
        Wrong{1, 1, -1, false, "coupling_damping_n_s_per_m"}, Wrong{1, 1, nan, false, "coupling_damping_n_s_per_m"},
        Wrong{1, 1, 1, true, "a fixed tool does not move"}}) {
    v1::Scene scene = tests::block_with_probe();
    v1::Tool& tool = *scene.mutable_tools(0);
    tool.set_mass_kg(wrong.mass_kg);
    tool.set_coupling_stiffness_n_per_m(wrong.stiffness);
    tool.set_coupling_damping_n_s_per_m(wrong.damping);
    tool.set_fixed(wrong.fixed);
    const auto model = compile(scene, {});
    ASSERT_FALSE(model) << wrong.words;
    EXPECT_EQ(model.error().code, ErrorCode::kInvalidArgument);
    EXPECT_NE(model.error().message.find(wrong.words), std::string::npos) << model.error().message;
  }
  v1::Scene scene = tests::block_with_probe();
  scene.mutable_tools(0)->set_coupling_damping_n_s_per_m(1);
  const auto model = compile(scene, {});
  ASSERT_FALSE(model);
  EXPECT_NE(model.error().message.find("a coupling needs mass_kg"), std::string::npos) << model.error().message;
}

/// Each triangle of the contact surface has the modulus of the element behind it, in all ways of giving one.
TEST(Compile, ContactIsAsStiffAsTheElementBehindIt) {
  constexpr double kSoftPa = 5e3, kStiffPa = 1e6, kStiffPoisson = 0.2;
  const auto stiffen = [](v1::Law& law) {
    law.mutable_hooke()->set_young_modulus_pa(kStiffPa);
    law.mutable_hooke()->set_poisson_ratio(kStiffPoisson);
  };
  const auto upper_half = [](v1::Region& region, double middle_m) {
    tests::set(*region.mutable_box()->mutable_min_m(), -1, middle_m - 1e-9, -1);
    tests::set(*region.mutable_box()->mutable_max_m(), 1, 1, 1);
  };
  v1::Scene of_bodies = tests::block_with_probe();
  *of_bodies.add_bodies() = of_bodies.bodies(0);
  of_bodies.mutable_bodies(1)->set_name("bone");
  stiffen(*of_bodies.mutable_bodies(1)->mutable_law());
  v1::Scene of_regions = tests::block_with_probe();
  const double height_m = of_regions.bodies(0).mesh().grid().size_m().y();
  v1::LawRegion& region = *of_regions.mutable_bodies(0)->add_law_regions();
  upper_half(*region.mutable_region(), height_m / 2);
  stiffen(*region.mutable_law());
  for (const v1::Scene& scene : {of_bodies, of_regions}) {
    const Model m = compiled(scene);
    ASSERT_EQ(m.contact.triangle_moduli.size(), 2 * m.contact.triangle_area.size());
    int soft = 0, stiff = 0;
    for (std::size_t t = 0; t < m.contact.triangle_count(); ++t) {
      const double young_pa = m.contact.triangle_moduli[2 * t], plane_strain_pa = m.contact.triangle_moduli[2 * t + 1];
      double lowest_m = 1;
      bool is_bone = m.bodies.size() > 1;
      for (std::size_t i = 0; i < 3; ++i) {
        const std::uint32_t row = m.contact.triangle_rows[3 * t + i];
        lowest_m = std::min(lowest_m, m.rest[4 * std::size_t{row} + 1]);
        is_bone = is_bone && m.layout.node_of_row[row] >= m.bodies.back().node_begin;
      }
      const bool is_stiff = m.bodies.size() > 1 ? is_bone : lowest_m > height_m / 2 - 1e-9;
      EXPECT_NEAR(young_pa, is_stiff ? kStiffPa : kSoftPa, 1e-9 * young_pa);
      EXPECT_NEAR(plane_strain_pa,
                  is_stiff ? kStiffPa / (1 - kStiffPoisson * kStiffPoisson) : kSoftPa / (1 - 0.4 * 0.4),
                  1e-9 * young_pa);
      ++(is_stiff ? stiff : soft);
    }
    EXPECT_GT(soft, 0);
    EXPECT_GT(stiff, 0);
  }
}

TEST(Compile, MassIsDensityTimesVolumeAndGravityItsWeight) {
  const Model model = compiled(tests::beam_scene(), {4, 1});
  double mass = 0;
  for (std::uint32_t node = 0; node < model.layout.row_of_node.size(); ++node) {
    const double own = at(model, model.inertia, node, 0);
    EXPECT_GT(own, 0);
    EXPECT_NEAR(at(model, model.external, node, 1), -9.81 * own, 1e-12 * own);
    EXPECT_EQ(at(model, model.external, node, 0), 0);
    mass += own;
  }
  EXPECT_NEAR(mass, 1000 * 8 * 1 * 0.8, 1e-9 * mass);
  EXPECT_NEAR(model.bodies[0].mass_kg, mass, 1e-9 * mass);
}

TEST(Compile, ALoadIsDividedEquallyAmongTheNodesOfItsRegion) {
  v1::Scene scene = tests::beam_scene({.cells_x = 2, .cells_y = 1, .cells_z = 1});
  scene.clear_gravity_m_per_s2();
  for (const double force : {6.0, 2.0}) {  // two loads on the same nodes add up
    v1::Load& load = *scene.mutable_bodies(0)->add_loads();
    tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), 7.9, -1, -1);
    tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 8.1, 2, 2);
    tests::set(*load.mutable_force_n(), 0, 0, force);
  }
  const Model model = compiled(scene);
  for (std::uint32_t node = 0; node < 12; ++node) {
    EXPECT_EQ(at(model, model.external, node, 2), node % 3 == 2 ? 2 : 0) << "8 N on the four nodes of the end";
  }
}

TEST(Compile, RegionsChooseByPositionAfterScaleAndTranslation) {
  v1::Scene scene =
      tests::beam_scene({.cells_x = 2, .cells_y = 2, .cells_z = 2, .size_x_m = 2, .size_y_m = 2, .size_z_m = 2});
  v1::Body& body = *scene.mutable_bodies(0);
  body.mutable_mesh()->set_scale(0.5);
  tests::set(*body.mutable_mesh()->mutable_translation_m(), 10, 0, 0);
  body.clear_fixed();
  v1::Sphere& sphere = *body.add_fixed()->mutable_sphere();
  tests::set(*sphere.mutable_center_m(), 10, 0, 0);
  sphere.set_radius_m(0.5);
  v1::NodeSet& nodes = *body.add_fixed()->mutable_nodes();
  for (const std::uint32_t index : {26u, 26u, 0u}) nodes.add_indices(index);  // twice, and one of the sphere's
  const Model model = compiled(scene);
  EXPECT_EQ(model.bodies[0].fixed_node_count, 5u) << "the corner, its three neighbours half a metre away, and node 26";
  EXPECT_EQ(at(model, model.rest, 0, 3), 0);
  EXPECT_EQ(at(model, model.rest, 26, 3), 0);
  EXPECT_EQ(at(model, model.rest, 13, 3), 7) << "free in x, y and z";
  EXPECT_NEAR(at(model, model.rest, 26, 0), 11, 1e-12);
  EXPECT_NEAR(model.bodies[0].volume_m3, 1, 1e-12);
}

TEST(Compile, EachBodyKeepsItsOwnDamping) {
  v1::Scene scene = tests::beam_scene({.cells_x = 1, .cells_y = 1, .cells_z = 1});
  *scene.add_bodies() = scene.bodies(0);
  scene.mutable_bodies(1)->set_name("second");
  scene.mutable_bodies(1)->set_rayleigh_mass_per_s(0.5);
  scene.mutable_bodies(1)->set_rayleigh_stiffness_s(0.25);
  const Model model = compiled(scene, {2, 1});
  for (std::uint32_t node = 0; node < 16; ++node) {
    EXPECT_EQ(at(model, model.inertia, node, 1), node < 8 ? 0 : 0.5);
    EXPECT_EQ(at(model, model.inertia, node, 2), node < 8 ? 0 : 0.25);
  }
  EXPECT_EQ(model.bodies[1].node_begin, 8u);
}

TEST(Compile, ALightBodyWeighsAsMuchInTheSolveAsAHeavyOneUnlessNothingHasInertia) {
  v1::Scene scene = tests::beam_scene({.cells_x = 1, .cells_y = 1, .cells_z = 1});
  *scene.add_bodies() = scene.bodies(0);
  scene.mutable_bodies(1)->set_name("light");
  scene.mutable_bodies(1)->set_density_kg_per_m3(10);
  const auto expect = [&](double light) {
    const Model model = compiled(scene, {2, 1});
    for (std::size_t row = 0; row < model.layout.row_count; ++row) {
      const std::uint32_t node = model.layout.node_of_row[row];
      EXPECT_EQ(model.inertia[4 * row + 3], node == mesh::kNone || node < 8 ? 1 : light);
    }
  };
  expect(10);  // √(1000 / 10)
  scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
  expect(1);
}

TEST(Compile, VisibleSurfaceIsTheBoundaryOfEachBody) {
  v1::Scene scene = tests::beam_scene({.cells_x = 3, .cells_y = 3, .cells_z = 3, .frame_rate_hz = 60});
  *scene.add_bodies() = scene.bodies(0);
  scene.mutable_bodies(1)->set_name("second");
  const Model model = compiled(scene, {3, 1});
  for (const BodyModel& body : model.bodies) {
    EXPECT_EQ(body.vertex_count, 56u) << "64 nodes, 8 of them inside";
    EXPECT_EQ(body.triangles.size(), 6u * 9 * 2);
    ASSERT_EQ(body.vertex_nodes.size(), body.vertex_count);
    for (std::uint32_t i = 0; i < body.vertex_count; ++i) {
      EXPECT_EQ(model.visible.rows[4 * (body.vertex_begin + i)],
                model.layout.row_of_node[body.node_begin + body.vertex_nodes[i]]);
    }
  }
  EXPECT_EQ(model.visible.count(), 112u);
}

TEST(Compile, FindingsOfTheMeshReachTheModel) {
  v1::Scene scene = tests::beam_scene({.cells_x = 1, .cells_y = 1, .cells_z = 1});
  scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->mutable_size_m()->set_z(0.001);
  const Model model = compiled(scene);
  const std::vector<std::string> found = tests::texts(model.findings, FindingCode::kSlivers);
  ASSERT_EQ(found.size(), 1u);
  EXPECT_NE(found[0].find("'beam'"), std::string::npos) << found[0];
}

/// Two cells of Kuhn's tetrahedra along x, made quadratic: 2 × 1 × 1 m, 12 nodes of the mesh and 33 in the middle of
/// edges.
class MadeQuadratic : public testing::Test {
 protected:
  void SetUp() override {
    scene_ = tests::beam_scene({.cells_x = 2, .cells_y = 1, .cells_z = 1, .size_x_m = 2, .size_z_m = 1});
    scene_.clear_gravity_m_per_s2();
    body().clear_fixed();
    body().set_element_order(v1::ELEMENT_ORDER_QUADRATIC);
  }
  v1::Body& body() { return *scene_.mutable_bodies(0); }
  /// The nodes of the mesh at x = 0.
  static void end(v1::NodeSet& nodes) {
    for (const std::uint32_t node : {0u, 3u, 6u, 9u}) nodes.add_indices(node);
  }
  /// Nodes that are not free, by their rest positions.
  static std::vector<Eigen::Vector3d> fixed(const Model& model) {
    std::vector<Eigen::Vector3d> found;
    for (std::uint32_t node = 0; node < model.bodies[0].node_count; ++node) {
      if (at(model, model.rest, node, 3) == 7) continue;
      found.emplace_back(at(model, model.rest, node, 0), at(model, model.rest, node, 1),
                         at(model, model.rest, node, 2));
    }
    return found;
  }
  /// Returns three values a node: its number, 0 and 10.
  static std::string numbers(std::size_t count) {
    std::vector<double> values(3 * count, 10);
    for (std::size_t node = 0; node < count; ++node) {
      values[3 * node] = static_cast<double>(node);
      values[3 * node + 1] = 0;
    }
    return {reinterpret_cast<const char*>(values.data()), values.size() * sizeof(double)};
  }

  v1::Scene scene_;
};

TEST_F(MadeQuadratic, NodesGrowAndElementsVolumeAndMassDoNot) {
  const Model model = compiled(scene_);
  EXPECT_EQ(model.bodies[0].node_count, 45u) << "a lattice of 5 x 3 x 3 points";
  EXPECT_EQ(model.bodies[0].element_count, 12u);
  EXPECT_NEAR(model.bodies[0].volume_m3, 2, 1e-12);
  EXPECT_NEAR(std::accumulate(model.row_mass.begin(), model.row_mass.end(), 0.0), 2000, 1e-9);
  body().set_element_order(v1::ELEMENT_ORDER_AS_GIVEN);
  EXPECT_EQ(compiled(scene_).bodies[0].node_count, 12u);
}

TEST_F(MadeQuadratic, ARegionHasTheNodesBetweenItsOwn) {
  const auto expect_end = [&](const char* what) {
    const std::vector<Eigen::Vector3d> nodes = fixed(compiled(scene_));
    EXPECT_EQ(nodes.size(), 9u) << what << ": four corners, and the middles of four sides and a diagonal";
    for (const Eigen::Vector3d& node : nodes) EXPECT_EQ(node.x(), 0) << what;
    body().clear_fixed();
    body().clear_sets();
  };
  end(*body().add_fixed()->mutable_nodes());
  expect_end("indices");

  tests::set(*body().add_fixed()->mutable_box()->mutable_max_m(), 0, 1, 1);
  expect_end("box");

  v1::Sphere& sphere = *body().add_fixed()->mutable_sphere();
  tests::set(*sphere.mutable_center_m(), -1, 0.5, 0.5);
  sphere.set_radius_m(std::sqrt(1.5) + 1e-9);
  expect_end("sphere");

  v1::NamedSet& set = *body().add_sets();
  set.set_name("end");
  for (const std::uint32_t node : {0u, 3u, 6u, 9u}) set.add_regions()->mutable_nodes()->add_indices(node);
  body().add_fixed()->set_set("end");
  expect_end("a set, each of its regions one node");

  tests::set(*body().add_fixed()->mutable_box()->mutable_min_m(), 0.4, -1, -1);
  tests::set(*body().mutable_fixed(0)->mutable_box()->mutable_max_m(), 0.6, 2, 2);
  for (const Eigen::Vector3d& node : fixed(compiled(scene_))) {
    EXPECT_EQ(node.x(), 0.5) << "no node of the mesh lies in the box, nine in the middle of edges do";
  }
}

TEST_F(MadeQuadratic, LoadsAndLawsOfRegionsFindTheSameFacesAndElements) {
  v1::Load& load = *body().add_loads();
  end(*load.mutable_region()->mutable_nodes());
  tests::set(*load.mutable_traction_pa(), 3, 0, 0);
  v1::LawRegion& part = *body().add_law_regions();
  for (const std::uint32_t node : {0u, 1u, 3u, 4u, 6u, 7u, 9u, 10u}) {
    part.mutable_region()->mutable_nodes()->add_indices(node);
  }
  part.mutable_law()->mutable_hooke()->set_young_modulus_pa(5);
  const Model model = compiled(scene_);
  double total = 0;
  for (std::uint32_t node = 0; node < 45; ++node) total += at(model, model.external, node, 0);
  EXPECT_NEAR(total, 3, 1e-12) << "3 Pa on 1 m²";
  ASSERT_EQ(model.groups.size(), 2u);
  EXPECT_EQ(model.groups[1].element_count, 6u) << "the first cell, under the linear law";
}

TEST_F(MadeQuadratic, AStartOfTheMeshsNodesIsInterpolated) {
  body().set_initial_displacement_m(numbers(12));
  body().set_initial_velocity_m_per_s(numbers(45));
  end(*body().add_fixed()->mutable_nodes());
  EXPECT_FALSE(compile(scene_, {})) << "fixed nodes must start at rest";
  body().clear_fixed();
  const Model model = compiled(scene_);
  // The first three edges are 0-1, 0-3, 0-4.
  for (const auto& [node, x] : {std::pair(11u, 11.0), std::pair(12u, 0.5), std::pair(13u, 1.5), std::pair(14u, 2.0)}) {
    EXPECT_EQ(at(model, model.initial_displacement, node, 0), x) << node;
    EXPECT_EQ(at(model, model.initial_displacement, node, 1), 0) << node;
    EXPECT_EQ(at(model, model.initial_displacement, node, 2), 10) << node;
  }
  EXPECT_EQ(at(model, model.initial_velocity, 44, 0), 44) << "values of all nodes are taken as they are";
}

TEST_F(MadeQuadratic, AFixedNodeInTheMiddleOfAFreeEdgeStartsAtRest) {
  body().set_initial_displacement_m(numbers(12));
  body().add_fixed()->mutable_nodes()->add_indices(12);
  const Model model = compiled(scene_);
  EXPECT_EQ(at(model, model.initial_displacement, 12, 0), 0);
  EXPECT_EQ(at(model, model.initial_displacement, 12, 2), 0);
  EXPECT_EQ(at(model, model.initial_displacement, 13, 0), 1.5);
}

TEST_F(MadeQuadratic, ElementFieldsAreOfTheSameElements) {
  std::vector<double> young(12, 1e6);
  young[7] = 2e6;
  body().mutable_element_fields()->set_young_modulus_pa(young.data(), young.size() * sizeof(double));
  EXPECT_EQ(compiled(scene_).bodies[0].element_count, 12u);
  body().mutable_element_fields()->set_young_modulus_pa(young.data(), 11 * sizeof(double));
  const auto refused = compile(scene_, {});
  ASSERT_FALSE(refused);
  EXPECT_NE(refused.error().message.find("11 values for 12 elements"), std::string::npos) << refused.error().message;
}

TEST_F(MadeQuadratic, ASkinFollowsTheQuadraticMesh) {
  const std::vector<double> vertices{0.25, 1, 0.25, 0.5, 1, 0.25, 0.25, 1, 0.75};
  const std::vector<std::uint32_t> triangle{0, 1, 2};
  v1::PackedTriangles& skin = *body().mutable_skin()->mutable_packed();
  skin.set_vertex_positions(vertices.data(), vertices.size() * sizeof(double));
  skin.set_triangles(triangle.data(), triangle.size() * sizeof(std::uint32_t));
  scene_.mutable_streams()->set_frame_rate_hz(60);
  const Model model = compiled(scene_);
  ASSERT_EQ(model.visible.count(), 3u);
  bool uses_middle = false;
  for (std::size_t vertex = 0; vertex < 3; ++vertex) {
    for (std::size_t axis = 0; axis < 3; ++axis) {
      double x = 0;
      for (std::size_t i = 4 * vertex; i < 4 * vertex + 4; ++i) {
        x += model.visible.weights[i] * model.rest[4 * model.visible.rows[i] + axis];
        uses_middle =
            uses_middle || (model.visible.weights[i] != 0 && model.layout.node_of_row[model.visible.rows[i]] >= 12);
      }
      EXPECT_NEAR(x, vertices[3 * vertex + axis], 1e-14);
    }
  }
  EXPECT_TRUE(uses_middle);
}

/// The skin is a roof over each of the two cells, with its ridges at x = 0.5 and 1.5 m and a slope of 0.2.
TEST_F(MadeQuadratic, EdgesOfTheBoundaryCurveToTheSkin) {
  std::vector<double> vertices;
  for (int i = 0; i < 5; ++i) {
    for (const double z : {-1.0, 2.0}) vertices.insert(vertices.end(), {0.5 * i, i % 2 == 0 ? 1 : 1.1, z});
  }
  std::vector<std::uint32_t> triangles;
  for (std::uint32_t i = 0; i < 8; i += 2) triangles.insert(triangles.end(), {i, i + 1, i + 2, i + 2, i + 1, i + 3});
  v1::PackedTriangles& skin = *body().mutable_skin()->mutable_packed();
  skin.set_vertex_positions(vertices.data(), vertices.size() * sizeof(double));
  skin.set_triangles(triangles.data(), triangles.size() * sizeof(std::uint32_t));
  end(*body().add_fixed()->mutable_nodes());
  const Model model = compiled(scene_);
  int raised = 0;
  for (std::uint32_t node = 12; node < 45; ++node) {
    const double y = at(model, model.rest, node, 1), z = at(model, model.rest, node, 2);
    if (z != 0.5 || y <= 1) continue;
    EXPECT_NEAR(y, 1 + 0.1 / (1 + 0.2 * 0.2), 1e-12) << "the nearest point of a slope, along the normal of the top";
    ++raised;
  }
  EXPECT_EQ(raised, 2) << "the diagonal of each cell's top";
  EXPECT_EQ(fixed(model).size(), 9u) << "a region keeps the nodes between its own wherever they are";

  triangles[0] = 99;
  skin.set_triangles(triangles.data(), triangles.size() * sizeof(std::uint32_t));
  const auto refused = compile(scene_, {});
  ASSERT_FALSE(refused);
  EXPECT_NE(refused.error().message.find("vertex 99"), std::string::npos) << refused.error().message;
}

TEST(PatchPolicy, GivesEachPatchEnoughNodesAndAtLeastOnePatch) {
  EXPECT_EQ((PatchPolicy{8, 100}).count(1000), 8u);
  EXPECT_EQ((PatchPolicy{8, 100}).count(799), 7u);
  EXPECT_EQ((PatchPolicy{8, 100}).count(5), 1u);
  EXPECT_EQ((PatchPolicy{0, 0}).count(5), 1u);
  // A device that many scenes share: a tenth of 132 multiprocessors, unless a patch gets too large for one.
  const PatchPolicy shared{132, 96, matrix::Storage::kRows, 13, 416};
  EXPECT_EQ(shared.count(700), 7u);
  EXPECT_EQ(shared.count(4000), 13u);
  EXPECT_EQ(shared.count(8700), 21u);
  EXPECT_EQ(shared.count(400000), 132u);
}

TEST(ReadOrientation, NormalizesAlmostUnitAndTakesAllZeroAsIdentity) {
  v1::Quaternion q;
  EXPECT_EQ(read_orientation(q, "here").value(), (std::array<double, 4>{1, 0, 0, 0}));
  q.set_x(0.995);
  EXPECT_EQ(read_orientation(q, "here").value(), (std::array<double, 4>{0, 1, 0, 0}));
  q.set_x(0.9);
  EXPECT_FALSE(read_orientation(q, "here"));
}

}  // namespace
}  // namespace tensormass::model
