#include "model/cut_bodies.h"

#include <cmath>
#include <memory>
#include <random>
#include <span>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "mesh/components.h"
#include "support/cutting.h"

/// Bodies that are cut apart: what a cut must not change, and what the pieces then do.
namespace tensormass::world {
namespace {

using Eigen::Vector3d;
using tests::CutBody;
using tests::EditedBeam;

std::vector<EditedBeam> beams() {
  std::vector<EditedBeam> out;
  for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_HEXAHEDRON}) {
    for (const v1::Quadrature quadrature : {v1::QUADRATURE_FULL, v1::QUADRATURE_SELECTIVE}) {
      out.push_back({.shape = shape, .quadrature = quadrature});
      out.push_back({.shape = shape, .law = "hooke", .quadrature = quadrature, .consistent_mass = true});
    }
  }
  out.push_back({.law = "ogden"});
  out.push_back({.law = "stable_neo_hookean", .double_precision = false});
  out.push_back({.viscoelastic = true});
  out.push_back({.shape = v1::SHAPE_HEXAHEDRON, .viscoelastic = true, .integrator = v1::Solver::INTEGRATOR_BDF2});
  return out;
}

v1::Scene scene_of(const EditedBeam& of, double rate_of_gravity = 1) {
  v1::Scene scene = tests::edited_beam(of);
  scene.clear_editing();
  tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81 * rate_of_gravity, 0);
  return scene;
}
const Vector3d kSize{0.2, 0.09, 0.1};

/// Whether a cut that divides clusters changes the energy: their mean gradient is another one then.
bool divides_clusters(const EditedBeam& of) {
  return of.quadrature == v1::QUADRATURE_SELECTIVE && of.shape == v1::SHAPE_TETRAHEDRON;
}

/// Sums over all rows of a world.
struct Sums {
  double mass_kg = 0, kinetic_j = 0, elastic_j = 0;
  Vector3d moment = Vector3d::Zero(), momentum = Vector3d::Zero(), angular = Vector3d::Zero();
};
Sums sums_of(World& world) {
  world.diagnose();
  const model::Model& m = world.model();
  const backend::RowState state = world.state();
  Sums out;
  for (const std::uint32_t row : m.layout.row_of_node) {
    const auto at = [&](const std::vector<double>& of) {
      return Vector3d(of[4 * std::size_t{row}], of[4 * std::size_t{row} + 1], of[4 * std::size_t{row} + 2]);
    };
    const Vector3d x = at(m.rest) + at(state.displacement), v = at(state.velocity);
    const double mass = m.row_mass[row];
    out.mass_kg += mass;
    out.moment += mass * at(m.rest);
    out.momentum += mass * v;
    out.angular += mass * x.cross(v);
    out.kinetic_j += mass * v.squaredNorm() / 2;
  }
  for (const backend::GroupDiagnostics& group : world.diagnostics()) out.elastic_j += group.elastic_energy_j;
  return out;
}

class CutBodies : public tests::OnBackendWithCuts {};
TM_ON_EACH_BACKEND(CutBodies);

TEST_P(CutBodies, KeepMassEnergyAndMomentum) {
  std::mt19937 random(11);
  int compared = 0, copies = 0;
  for (const EditedBeam& of : beams()) {
    SCOPED_TRACE(testing::PrintToString(of));
    const v1::Scene scene = scene_of(of);
    for (int round = 0; round < 4; ++round) {
      const auto before = start(scene);
      for (int i = 0; i < 5; ++i) ASSERT_TRUE(before->step(false));
      CutBody body(scene);
      for (int cut = 0; cut < 3; ++cut) body.move_at_random(random, kSize);
      const auto after = cut_on(scene, *before, body.cuts());
      copies += static_cast<int>(after->model().bodies[0].element_copies.size());
      const Sums a = sums_of(*before), b = sums_of(*after);
      const double eps = of.double_precision ? 1e-12 : 1e-5;
      EXPECT_NEAR(a.mass_kg, b.mass_kg, 1e-12 * a.mass_kg);
      EXPECT_LT((a.moment - b.moment).norm(), 1e-12 * a.mass_kg * kSize.norm());
      EXPECT_LT((a.momentum - b.momentum).norm(), eps * a.momentum.norm());
      if (divides_clusters(of)) continue;
      EXPECT_NEAR(a.elastic_j, b.elastic_j, eps * a.elastic_j);
      if (of.consistent_mass) continue;  // the sum above takes lumped masses
      EXPECT_NEAR(a.kinetic_j, b.kinetic_j, eps * a.kinetic_j);
      EXPECT_LT((a.angular - b.angular).norm(), eps * a.momentum.norm() * kSize.norm());
      ++compared;
    }
  }
  EXPECT_GT(compared, 10);
  EXPECT_GT(copies, 100);
}

/// In a motion that is the same everywhere, every mean over a cluster is that of its parts.
TEST_P(CutBodies, KeepTheEnergyOfClustersInAHomogeneousState) {
  std::mt19937 random(5);
  const EditedBeam of{.quadrature = v1::QUADRATURE_SELECTIVE};
  v1::Scene scene = scene_of(of);
  scene.mutable_bodies(0)->clear_fixed();
  std::vector<double> u;
  const mesh::Mesh mesh = tests::bodies_of(scene).bodies[0].mesh;
  for (const Vector3d& x : mesh.nodes) {
    u.insert(u.end(), {0.1 * x[0] + 0.03 * x[1], -0.04 * x[1] + 0.02 * x[2], 0.05 * x[2]});
  }
  scene.mutable_bodies(0)->set_initial_displacement_m(
      std::string(reinterpret_cast<const char*>(u.data()), u.size() * sizeof(double)));
  for (int round = 0; round < 8; ++round) {
    const auto before = start(scene);
    CutBody body(scene);
    for (int cut = 0; cut < 3; ++cut) body.move_at_random(random, kSize);
    const auto after = cut_on(scene, *before, body.cuts());
    const Sums a = sums_of(*before), b = sums_of(*after);
    ASSERT_GT(a.elastic_j, 1e-3);
    EXPECT_NEAR(a.elastic_j, b.elastic_j, 1e-12 * a.elastic_j);
    EXPECT_NEAR(a.kinetic_j, b.kinetic_j, 1e-12);
  }
}

/// A free block flies and is strained. Cut in two, both parts keep the momentum that they had, and fall with g.
TEST_P(CutBodies, MoveApartEachWithItsOwnMomentum) {
  for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_HEXAHEDRON}) {
    EditedBeam of{.shape = shape};
    v1::Scene scene = scene_of(of);
    scene.mutable_bodies(0)->clear_fixed();
    scene.mutable_bodies(0)->clear_rayleigh_mass_per_s();
    scene.mutable_solver()->set_cg_max_iterations(500);
    scene.mutable_solver()->set_cg_tolerance(1e-13);
    std::vector<double> velocity;
    const mesh::Mesh mesh = tests::bodies_of(scene).bodies[0].mesh;
    for (const Vector3d& x : mesh.nodes) {
      velocity.insert(velocity.end(), {0.5 + 2 * (x[0] - 0.1), 3 * x[2], 1 - 3 * x[1]});
    }
    scene.mutable_bodies(0)->set_initial_velocity_m_per_s(
        std::string(reinterpret_cast<const char*>(velocity.data()), velocity.size() * sizeof(double)));
    const auto before = start(scene);
    for (int i = 0; i < 3; ++i) ASSERT_TRUE(before->step(false));
    CutBody body(scene);
    body.move({{0.093, -1, -0.5}, {0.093, 1, -0.5}}, {{0.11, -1, 0.6}, {0.11, 1, 0.6}});
    const auto after = cut_on(scene, *before, body.cuts());

    const model::Model& m = after->model();
    // Which piece a node belongs to: by the elements that have it.
    mesh::Components pieces(m.layout.row_of_node.size());
    for (const model::ElementGroup& group : m.groups) {
      const std::size_t nodes = group.rows.size() / group.stride;
      for (std::size_t place = 0; place < group.elements.size(); ++place) {
        if (group.elements[place] == mesh::kNone) continue;
        for (std::size_t k = 1; k < nodes; ++k) {
          pieces.join(m.layout.node_of_row[group.rows[place]],
                      m.layout.node_of_row[group.rows[k * group.stride + place]]);
        }
      }
    }
    const auto momenta = [&] {
      std::map<std::uint32_t, std::pair<double, Vector3d>> out;
      const backend::RowState state = after->state();
      for (std::uint32_t node = 0; node < m.layout.row_of_node.size(); ++node) {
        const std::size_t row = m.layout.row_of_node[node];
        auto& [mass, momentum] = out.try_emplace(pieces.root(node), 0.0, Vector3d::Zero()).first->second;
        mass += m.row_mass[row];
        momentum += m.row_mass[row] *
                    Vector3d(state.velocity[4 * row], state.velocity[4 * row + 1], state.velocity[4 * row + 2]);
      }
      return out;
    };
    const auto start_of = momenta();
    ASSERT_EQ(start_of.size(), 2u);
    constexpr int kSteps = 20;
    for (int i = 0; i < kSteps; ++i) ASSERT_TRUE(after->step(false));
    for (const auto& [node, end] : momenta()) {
      const auto& [mass, begin] = start_of.at(node);
      EXPECT_NEAR(end.first, mass, 1e-15);
      const Vector3d fallen = begin + mass * kSteps * m.dt_s * Vector3d(0, -9.81, 0);
      EXPECT_LT((end.second - fallen).norm(), 1e-10 * begin.norm()) << v1::Shape_Name(shape);
    }
  }
}

TEST_P(CutBodies, StepOnWithEveryLawAndStayFinite) {
  std::mt19937 random(3);
  for (const EditedBeam& of : beams()) {
    SCOPED_TRACE(testing::PrintToString(of));
    v1::Scene scene = scene_of(of, 0.2);
    tests::add_probe(scene, "probe", 0.02, 0.1, 0.12, 0.05);
    std::unique_ptr<World> world = start(scene);
    CutBody body(scene);
    for (int round = 0; round < 4; ++round) {
      body.move_at_random(random, kSize);
      world = cut_on(scene, *world, body.cuts());
      for (int i = 0; i < 5; ++i) {
        world->set_tool_target(0, Pose{{0.1, 0.12 - 0.002 * (5 * round + i), 0.05}});
        ASSERT_TRUE(world->step(false));
      }
      for (const double u : world->state().displacement) ASSERT_TRUE(std::isfinite(u));
    }
  }
}

TEST_P(CutBodies, AreRefusedInWordsWhereTheyCannotBeCut) {
  const auto refusal = [&](const v1::Scene& scene) {
    try {
      CutBody body(scene);
      body.move({{0.093, -1, -0.5}, {0.093, 1, -0.5}}, {{0.11, -1, 0.6}, {0.11, 1, 0.6}});
      const auto world = start_cut(scene, body.cuts());
    } catch (const std::runtime_error& error) {
      return std::string(error.what());
    }
    return std::string();
  };
  EXPECT_EQ(refusal(scene_of({})), "");
  EXPECT_EQ(refusal(scene_of({.shape = v1::SHAPE_WEDGE})),
            "body 'beam': elements of shape wedge cannot be cut yet; tetrahedra and hexahedra can");
  v1::Scene pressed = scene_of({});
  v1::Load& load = *pressed.mutable_bodies(0)->add_loads();
  load.set_pressure_pa(100);
  v1::Box& box = *load.mutable_region()->mutable_box();
  tests::set(*box.mutable_min_m(), -1, 0.0899, -1);
  tests::set(*box.mutable_max_m(), 1, 1, 1);
  EXPECT_NE(refusal(pressed).find("cannot be cut yet; give force_n"), std::string::npos) << refusal(pressed);
}

/// A block that is cut half through and pulled apart, against a mesh of the same size with a slit along its faces.
///
/// `aligned` meshes have the slit between elements; the two others are cut off their nodes.
class HalfCutBlock : public tests::OnBackendWithCuts {
 protected:
  static constexpr double kLength = 0.06, kSide = 0.02, kPull = 0.0006;

  static v1::Scene block(std::uint32_t cells, v1::Shape shape) {
    tests::Beam beam;
    beam.cells_x = 3 * cells;
    beam.cells_y = beam.cells_z = cells;
    beam.size_x_m = kLength;
    beam.size_y_m = beam.size_z_m = kSide;
    beam.linear = true;
    beam.double_precision = true;
    beam.young_modulus_pa = 1e5;
    beam.poisson_ratio = 0.3;
    beam.cg_max_iterations = 4000;
    beam.cg_tolerance = 1e-9;
    v1::Scene scene = tests::beam_scene(beam);
    v1::Body& body = *scene.mutable_bodies(0);
    body.mutable_mesh()->mutable_grid()->set_shape(shape);
    scene.clear_gravity_m_per_s2();
    v1::PrescribedDisplacement& pull = *body.add_prescribed();
    pull.set_x_m(kPull);
    pull.set_y_m(0);
    pull.set_z_m(0);
    v1::Box& end = *pull.mutable_region()->mutable_box();
    tests::set(*end.mutable_min_m(), kLength - 1e-6, -1, -1);
    tests::set(*end.mutable_max_m(), 1, 1, 1);
    scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
    scene.mutable_solver()->set_cpu_threads(2);
    return scene;
  }
  /// Twice the elastic energy over the pull: the force.
  static double force_of(World& world) {
    EXPECT_TRUE(world.step(false));
    return 2 * sums_of(world).elastic_j / kPull;
  }
  /// Cuts at x from the top to the middle, and half an element further: the front lags by that much.
  double cut_force(std::uint32_t cells, v1::Shape shape) const {
    const v1::Scene scene = block(cells, shape);
    const double h = kSide / cells, x = kLength / 2 + 0.31 * h, depth = kSide / 2 - h / 2;
    CutBody body(scene);
    body.move({{x, 1, -1}, {x, 1, 1}}, {{x, depth, -1}, {x, depth, 1}});
    return force_of(*start_cut(scene, body.cuts()));
  }
  /// The same with a slit between elements: the nodes above the middle are there twice.
  double slit_force(std::uint32_t cells, v1::Shape shape) const {
    v1::Scene scene = block(cells, shape);
    mesh::Mesh mesh = tests::bodies_of(scene).bodies[0].mesh;
    std::vector<std::uint32_t> twin(mesh.nodes.size(), mesh::kNone);
    const std::size_t count = mesh.nodes.size();
    for (std::size_t node = 0; node < count; ++node) {
      const Vector3d x = mesh.nodes[node];
      if (std::abs(x[0] - kLength / 2) > 1e-9 || x[1] < kSide / 2 + 1e-9) continue;
      twin[node] = static_cast<std::uint32_t>(mesh.nodes.size());
      mesh.nodes.push_back(x);
    }
    for (mesh::ElementBlock& elements : mesh.blocks) {
      const std::size_t width = mesh::topology(elements.shape).node_count;
      for (std::size_t first = 0; first < elements.nodes.size(); first += width) {
        double mean = 0;
        for (std::size_t k = 0; k < width; ++k) mean += mesh.nodes[elements.nodes[first + k]][0] / double(width);
        for (std::size_t k = 0; mean > kLength / 2 && k < width; ++k) {
          std::uint32_t& node = elements.nodes[first + k];
          if (twin[node] != mesh::kNone) node = twin[node];
        }
      }
    }
    *scene.mutable_bodies(0)->mutable_mesh()->mutable_packed() =
        tests::without(mesh, [](std::uint32_t) { return false; }).mesh;
    return force_of(*start(scene));
  }
};
TM_ON_EACH_BACKEND(HalfCutBlock);

TEST_P(HalfCutBlock, IsAsAccurateAsAMeshWithASlit) {
  for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_HEXAHEDRON}) {
    SCOPED_TRACE(v1::Shape_Name(shape));
    const double coarse = slit_force(4, shape), fine = slit_force(8, shape);
    const double exact = 2 * fine - coarse;  // a stress without bound at the front: first order
    const double cut_coarse = cut_force(4, shape), cut_fine = cut_force(8, shape);
    const auto percent = [&](double force) { return 100 * (force / exact - 1); };
    std::printf("%s: slit %.2f %.2f %%, cut %.2f %.2f %%\n", v1::Shape_Name(shape).c_str(), percent(coarse),
                percent(fine), percent(cut_coarse), percent(cut_fine));
    EXPECT_LT(percent(cut_fine), percent(fine) + 3);
    EXPECT_GT(percent(cut_fine), percent(fine) - 3);
    EXPECT_LT(std::abs(percent(cut_fine)), std::abs(percent(cut_coarse)));
  }
}

}  // namespace
}  // namespace tensormass::world
