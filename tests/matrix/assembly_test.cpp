#include "matrix/edge_assembly.h"

#include <gtest/gtest.h>

#include "mesh/random_mesh.h"
#include "mesh/surface.h"
#include "support/dense_system.h"
#include "support/laws.h"
#include "support/staged_scene.h"

/// The system that the stages assemble is the one that the definitions say, on any mesh, for any number of patches.
namespace tensormass::matrix {
namespace {

using step::StageKind;
using tests::StagedScene;

struct Case {
  const char* name;
  bool hooke, st_venant_kirchhoff;
};

class Assembly : public testing::TestWithParam<std::tuple<Case, std::uint32_t, Storage>> {
 protected:
  const Case& laws() const { return std::get<0>(GetParam()); }
  std::uint32_t patches() const { return std::get<1>(GetParam()); }
  Storage storage() const { return std::get<2>(GetParam()); }

  /// One body for each law, with damping and gravity, of different meshes.
  v1::Scene scene() const {
    v1::Scene out;
    std::uint32_t seed = 1;
    for (const bool linear : {true, false}) {
      if (!(linear ? laws().hooke : laws().st_venant_kirchhoff)) continue;
      v1::Scene one = tests::packed_scene(mesh::testing::random_mesh(seed++, 3, 0.8), linear);
      v1::Body& body = *one.mutable_bodies(0);
      body.set_name(linear ? "linear" : "nonlinear");
      body.set_rayleigh_mass_per_s(linear ? 0.7 : 0.2);
      body.set_rayleigh_stiffness_s(linear ? 0.01 : 0.03);
      body.set_density_kg_per_m3(linear ? 900 : 1100);
      if (out.bodies().empty()) {
        out = one;
      } else {
        *out.add_bodies() = body;
      }
    }
    tests::set(*out.mutable_gravity_m_per_s2(), 1, -9.81, 2);
    return out;
  }
};

TEST_P(Assembly, EqualsTheBruteForceSystem) {
  const v1::Scene source = scene();
  StagedScene<double> staged(source, patches(), storage());
  ASSERT_EQ(staged.view.patches.patch_count, patches());
  const Eigen::Index size = 3 * staged.node_count();
  const Eigen::VectorXd u = tests::random_field(size, 0.03, 1), v = tests::random_field(size, 0.5, 2);
  staged.put(staged.view.state.displacement, u);
  staged.put(staged.view.state.velocity, v);
  // Twice: what a step leaves behind must not reach the next.
  for (int round = 0; round < 2; ++round) {
    staged.run_through(StageKind::kExternalForces);
    const tests::DenseSystem expected = tests::dense_system(source, u);
    const Eigen::MatrixXd a = expected.a(staged.model.dt_s);
    const Eigen::VectorXd b = expected.b(staged.model.dt_s, v);
    EXPECT_LT((staged.matrix() - a).norm(), 1e-13 * a.norm());
    EXPECT_LT((staged.by_node(staged.view.matrix.rhs) - b).norm(), 1e-12 * b.norm());
  }
}

TEST_P(Assembly, PaddingRowsStayOut) {
  StagedScene<double> staged(scene(), patches(), storage());
  staged.put(staged.view.state.displacement, tests::random_field(3 * staged.node_count(), 0.03, 3));
  staged.step();
  for (std::uint32_t row = 0; row < staged.view.patches.row_count; ++row) {
    if (staged.model.layout.node_of_row[row] != mesh::kNone) continue;
    for (const double* field : {staged.view.matrix.rhs, staged.view.state.velocity, staged.view.state.displacement,
                                staged.view.solve.solution}) {
      EXPECT_EQ(view::load3<double>(field, row), (Vec3<double>(Vec3<double>::Zero())));
    }
  }
}

INSTANTIATE_TEST_SUITE_P(
    LawsAndPatches, Assembly,
    testing::Combine(testing::Values(Case{"hooke", true, false}, Case{"stvk", false, true}, Case{"both", true, true}),
                     testing::Values(1u, 2u, 5u), testing::Values(Storage::kRows, Storage::kEdges)),
    [](const auto& one) {
      return std::string(std::get<0>(one.param).name) + "_" + std::to_string(std::get<1>(one.param)) +
             (std::get<2>(one.param) == Storage::kRows ? "_rows" : "_edges");
    });

/// Every law in every shape, against the same sums over elements.
class EveryEntry : public testing::TestWithParam<std::tuple<v1::Shape, std::string, Storage>> {};

TEST_P(EveryEntry, EqualsTheBruteForceSystem) {
  const auto& [shape, law, storage] = GetParam();
  v1::Scene source = tests::beam_scene({.cells_x = 3, .cells_y = 2, .cells_z = 2, .double_precision = true});
  source.mutable_bodies(0)->clear_fixed();
  source.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
  *source.mutable_bodies(0)->mutable_law() = tests::law(law, 1e5, 0.4);
  StagedScene<double> staged(source, 2, storage);
  const Eigen::Index size = 3 * staged.node_count();
  const Eigen::VectorXd u = tests::random_field(size, 0.02, 1), v = tests::random_field(size, 0.5, 2);
  staged.put(staged.view.state.displacement, u);
  staged.put(staged.view.state.velocity, v);
  staged.run_through(StageKind::kExternalForces);
  const tests::DenseSystem expected = tests::dense_system(source, u);
  const Eigen::MatrixXd a = expected.a(staged.model.dt_s);
  const Eigen::VectorXd b = expected.b(staged.model.dt_s, v);
  EXPECT_LT((staged.matrix() - a).norm(), 1e-12 * a.norm());
  EXPECT_LT((staged.by_node(staged.view.matrix.rhs) - b).norm(), 1e-11 * b.norm());
}

INSTANTIATE_TEST_SUITE_P(Family, EveryEntry,
                         testing::Combine(testing::ValuesIn(tests::shapes()), testing::ValuesIn(tests::law_names()),
                                          testing::Values(Storage::kRows, Storage::kEdges)),
                         [](const auto& one) {
                           return v1::Shape_Name(std::get<0>(one.param)) + "_" + std::get<1>(one.param) +
                                  (std::get<2>(one.param) == Storage::kRows ? "_rows" : "_edges");
                         });

/// The forces of an element balance to rounding of its stress. Rounding of its modulus is a million times that where a
/// stiff body hardly strains; a soft one that hangs on it would feel the difference.
TEST_P(EveryEntry, ForcesBalanceToRoundingOfTheStress) {
  const auto& [shape, law, storage] = GetParam();
  v1::Scene source = tests::beam_scene({.cells_x = 3, .cells_y = 2, .cells_z = 2});
  source.clear_gravity_m_per_s2();
  source.mutable_bodies(0)->clear_fixed();
  source.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
  *source.mutable_bodies(0)->mutable_law() = tests::law(law, 1e5, 0.4);
  StagedScene<float> staged(source, 2, storage);
  const Eigen::Index size = 3 * staged.node_count();
  Eigen::VectorXd u = tests::random_field(size, 1e-6, 1);
  for (Eigen::Index i = 0; i < size; ++i) u[i] += 0.01 * static_cast<double>(i % 3 + 1);
  staged.put(staged.view.state.displacement, u);
  staged.run_through(StageKind::kExternalForces);
  const Eigen::VectorXd forces = staged.by_node(staged.view.matrix.rhs);
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (Eigen::Index i = 0; i < size; i += 3) sum += forces.segment<3>(i);
  EXPECT_LT(sum.norm(), 1e-5 * forces.norm());
}

/// What a consistent mass adds to the stiffness is ρ ∫ N_k N_l: symmetric, the same in all directions, exact for the
/// kinetic energy of a linear velocity, where lumped mass is too heavy.
TEST(Mass, ConsistentIsExactForLinearVelocities) {
  for (const v1::Shape shape : tests::shapes()) {
    for (const v1::Mass mass : {v1::MASS_LUMPED, v1::MASS_CONSISTENT}) {
      v1::Scene source = tests::beam_scene({.cells_x = 3,
                                            .cells_y = 2,
                                            .cells_z = 2,
                                            .size_x_m = 3,
                                            .size_y_m = 1,
                                            .size_z_m = 1,
                                            .linear = true,
                                            .double_precision = true});
      source.mutable_bodies(0)->clear_fixed();
      source.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
      source.mutable_bodies(0)->set_mass(mass);
      StagedScene<double> staged(source, 2);
      const Eigen::Index size = 3 * staged.node_count();
      staged.run_through(StageKind::kFinishRows);
      const double dt = staged.model.dt_s;
      const Eigen::MatrixXd m = staged.matrix() - dt * dt * tests::dense_system(source, Eigen::VectorXd::Zero(size)).k;
      EXPECT_LT((m - m.transpose()).norm(), 1e-12 * m.norm());
      Eigen::VectorXd along_x = Eigen::VectorXd::Zero(size), along_y = along_x, unit = along_x;
      for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
        const double x = staged.model.rest[4 * std::size_t{staged.row(node)}];
        along_x[3 * node] = along_y[3 * node + 1] = x;
        unit[3 * node] = 1;
      }
      const double exact = 1000 * 27.0 / 3;  // ρ ∫ x² dV
      EXPECT_NEAR(unit.dot(m * unit), 3000, 1e-8) << v1::Shape_Name(shape);
      EXPECT_NEAR(along_x.dot(m * along_x), along_y.dot(m * along_y), 1e-9 * exact);
      if (mass == v1::MASS_CONSISTENT) {
        EXPECT_NEAR(along_x.dot(m * along_x), exact, 1e-10 * exact) << v1::Shape_Name(shape);
      } else {
        EXPECT_GT(along_x.dot(m * along_x), 1.001 * exact) << v1::Shape_Name(shape);
      }
    }
  }
}

/// The patch test: an affine displacement strains every element alike, so that no force is left inside.
class PatchTest : public testing::TestWithParam<bool> {};

TEST_P(PatchTest, AffineDisplacementLeavesNoForceInside) {
  const mesh::Mesh mesh = mesh::testing::random_mesh(4, 5, 1.0);  // all elements: a box with moved nodes
  const v1::Scene scene = tests::packed_scene(mesh, GetParam());
  StagedScene<double> staged(scene, 3);
  const Mat3<double> gradient = Mat3<double>::Random() * 0.05;
  Eigen::VectorXd u(3 * staged.node_count());
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    u.segment<3>(3 * node) = gradient * mesh.nodes[node] + Vec3<double>(0.1, 0.2, -0.3);
  }
  staged.put(staged.view.state.displacement, u);
  staged.run_through(StageKind::kFinishRows);

  const mesh::Surface surface = mesh::boundary(mesh);
  std::vector<bool> outside(mesh.nodes.size(), false);
  for (const std::uint32_t node : surface.nodes) outside[node] = true;
  const Eigen::VectorXd force = staged.by_node(staged.view.matrix.rhs) / staged.model.dt_s;
  double inside_largest = 0, outside_largest = 0;
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    double& largest = outside[node] ? outside_largest : inside_largest;
    largest = std::max(largest, force.segment<3>(3 * node).norm());
  }
  EXPECT_GT(outside_largest, 1) << "newtons hold the boundary in place";
  EXPECT_LT(inside_largest, 1e-11 * outside_largest);
}

INSTANTIATE_TEST_SUITE_P(Laws, PatchTest, testing::Bool(),
                         [](const auto& one) { return std::string(one.param ? "hooke" : "stvk"); });

}  // namespace
}  // namespace tensormass::matrix
