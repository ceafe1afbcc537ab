#include "model/edit.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <numeric>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "model/clusters.h"
#include "physics/lists.h"
#include "support/backends.h"
#include "support/editing.h"

/// Material is taken out of elements while a scene steps. Three proofs, with random edits:
///
///   the buffers of an edited state are those that `bind` makes of the edited model, byte for byte
///   a step of the edited scene is that of a scene that was loaded without what is gone
///   mass and volume are balanced
namespace tensormass::world {
namespace {

using model::Ablation;
using tests::EditedBeam;

std::vector<EditedBeam> beams() {
  std::vector<EditedBeam> out;
  for (const v1::Shape shape : tests::shapes()) {
    for (const v1::Quadrature quadrature : {v1::QUADRATURE_FULL, v1::QUADRATURE_SELECTIVE}) {
      const std::uint32_t cells = shape == v1::SHAPE_QUADRATIC_HEXAHEDRON || shape == v1::SHAPE_PYRAMID ? 2 : 3;
      out.push_back({.shape = shape, .quadrature = quadrature, .cells = cells});
      out.push_back(
          {.shape = shape, .law = "hooke", .quadrature = quadrature, .consistent_mass = true, .cells = cells});
    }
  }
  out.push_back({.law = "ogden", .double_precision = false});
  out.push_back({.law = "hooke", .quadrature = v1::QUADRATURE_SELECTIVE, .double_precision = false});
  out.push_back({.shape = v1::SHAPE_HEXAHEDRON, .viscoelastic = true});
  out.push_back({.viscoelastic = true, .integrator = v1::Solver::INTEGRATOR_BDF2});
  out.push_back({.integrator = v1::Solver::INTEGRATOR_QUASI_STATIC});
  out.push_back({.law = "hooke", .integrator = v1::Solver::INTEGRATOR_QUASI_STATIC});
  out.push_back({.coagulated_stiffness_factor = 4});
  out.push_back({.lag_steps = 4});
  out.push_back({.quadrature = v1::QUADRATURE_SELECTIVE, .double_precision = false, .lag_steps = 8});
  out.push_back({.law = "hooke",
                 .quadrature = v1::QUADRATURE_SELECTIVE,
                 .double_precision = false,
                 .coagulated_stiffness_factor = 7});
  out.push_back({.double_precision = false, .consistent_mass = true, .integrator = v1::Solver::INTEGRATOR_BDF2});
  return out;
}

class Editing : public tests::OnBackend {
 protected:
  model::Model compile(const v1::Scene& scene) const {
    model::PatchPolicy policy = backend_->patch_policy(model::requested_cpu_threads(scene));
    policy.max_patches = 3;  // patches share elements
    policy.min_nodes_per_patch = 1;
    auto model = model::compile(scene, policy);
    if (!model) throw std::runtime_error(model.error().message);
    return std::move(*model);
  }
  std::unique_ptr<backend::SceneState> state_of(const model::Model& model) const {
    auto state = backend_->create(model);
    if (!state) throw std::runtime_error(state.error().message);
    return std::move(*state);
  }
  /// Fails if two states have unequal buffers.
  static void expect_equal_buffers(backend::SceneState& edited, backend::SceneState& bound) {
    const auto a = edited.read_constants(), b = bound.read_constants();
    ASSERT_EQ(a.size(), b.size());
    ASSERT_GT(a.size(), 10u);
    for (std::size_t i = 0; i < a.size(); ++i) {
      EXPECT_EQ(a[i].name, b[i].name);
      EXPECT_TRUE(a[i].bytes == b[i].bytes) << a[i].name;
    }
  }
};
TM_ON_EACH_BACKEND(Editing);

TEST_P(Editing, LeavesTheBuffersThatTheEditedModelHas) {
  for (const EditedBeam& of : beams()) {
    SCOPED_TRACE(testing::PrintToString(of));
    model::Model m = compile(tests::edited_beam(of));
    const std::unique_ptr<backend::SceneState> state = state_of(m), loaded = state_of(m);
    model::Editor editor(m);
    tests::RandomEdits random(7);
    for (int round = 0; round < 12; ++round) {
      const std::vector<Ablation> edit = random.next(editor, m.bodies[0].element_count, 1 + round % 5);
      ASSERT_TRUE(editor.check(m, edit));
      state->apply(editor.ablate(m, edit));
    }
    expect_equal_buffers(*state, *state_of(m));
    editor.heal(m, [&](const model::ModelEdit& edit) { state->apply(edit); });
    expect_equal_buffers(*state, *loaded);
  }
}

/// What a world ends with, node by node: positions, then velocities.
std::vector<double> motion_of(World& world) {
  const model::Model& m = world.model();
  std::vector<double> out = world.positions(m.bodies[0]);
  const backend::RowState state = world.state();
  for (const std::uint32_t row : m.layout.row_of_node) {
    for (std::size_t c = 0; c < 3; ++c) out.push_back(state.velocity[4 * std::size_t{row} + c]);
  }
  return out;
}

std::string bytes_of(const std::vector<double>& values) {
  return {reinterpret_cast<const char*>(values.data()), values.size() * sizeof(double)};
}

/// Clusters are made anew where elements are missing, so those of an edited scene are others; the test below has their
/// energy.
bool forms_clusters(const EditedBeam& of) {
  return of.quadrature == v1::QUADRATURE_SELECTIVE &&
         (of.shape == v1::SHAPE_TETRAHEDRON || of.shape == v1::SHAPE_WEDGE);
}

TEST_P(Editing, StepsAsASceneThatNeverHadTheElements) {
  int compared = 0;
  for (const EditedBeam& of : beams()) {
    // A lagged element of one mesh may follow its tangent where that of the other mesh is evaluated.
    if (!of.double_precision || forms_clusters(of) || of.lag_steps > 1) continue;
    SCOPED_TRACE(testing::PrintToString(of));
    const bool quasi_static = of.integrator == v1::Solver::INTEGRATOR_QUASI_STATIC;
    v1::Scene scene = tests::edited_beam(of);
    const mesh::Mesh mesh = tests::bodies_of(scene).bodies[0].mesh;
    // Both start in motion.
    std::vector<double> displacement, velocity;
    for (const Eigen::Vector3d& x : mesh.nodes) {
      const double bend = x[0] * x[0];
      displacement.insert(displacement.end(), {0.1 * bend, -0.8 * bend, 0.3 * bend});
      velocity.insert(velocity.end(), {bend, 3 * bend, -2 * bend});
    }
    const auto set_start = [&](v1::Scene& of_scene, const auto& of_node) {
      if (quasi_static) return;
      std::vector<double> u, v;
      for (const std::uint32_t node : of_node) {
        for (std::size_t c = 0; c < 3; ++c) {
          u.push_back(displacement[3 * std::size_t{node} + c]);
          v.push_back(velocity[3 * std::size_t{node} + c]);
        }
      }
      of_scene.mutable_bodies(0)->set_initial_displacement_m(bytes_of(u));
      of_scene.mutable_bodies(0)->set_initial_velocity_m_per_s(bytes_of(v));
    };
    std::vector<std::uint32_t> all(mesh.nodes.size());
    std::iota(all.begin(), all.end(), 0u);
    set_start(scene, all);
    const std::unique_ptr<World> edited = start(scene);
    // Elements off the fixed end, so that nothing comes loose from it in a scene without inertia.
    std::vector<Ablation> edit;
    tests::RandomEdits random(11);
    const std::uint32_t elements = edited->model().bodies[0].element_count;
    for (std::uint32_t e = quasi_static ? elements * 4 / 5 : elements / 4; e < elements; e += 1 + random() % 6) {
      edit.push_back({e, 0});
    }
    ASSERT_TRUE(edited->edit(edit, {}));
    const tests::RestOfMesh rest =
        tests::without(mesh, [&](std::uint32_t e) { return !(edited->editor()->kept(e) > 0); });
    v1::Scene without = scene;
    without.clear_editing();
    *without.mutable_bodies(0)->mutable_mesh()->mutable_packed() = rest.mesh;
    set_start(without, rest.nodes);
    const std::unique_ptr<World> loaded = start(without);
    for (int step = 0; step < 3; ++step) {
      ASSERT_TRUE(edited->step(false));
      ASSERT_TRUE(loaded->step(false));
    }
    const std::vector<double> a = motion_of(*edited), b = motion_of(*loaded);
    const std::size_t nodes = mesh.nodes.size(), left = rest.nodes.size();
    ASSERT_LT(left, nodes + 1);
    double worst = 0, most = 0;
    for (std::size_t n = 0; n < left; ++n) {
      for (std::size_t c = 0; c < 3; ++c) {
        const std::size_t of_a = 3 * std::size_t{rest.nodes[n]} + c, of_b = 3 * n + c;
        worst = std::max(worst, std::abs(a[of_a] - b[of_b]));
        worst = std::max(worst, 0.01 * std::abs(a[3 * nodes + of_a] - b[3 * left + of_b]));
        most = std::max(most, std::abs(b[of_b] - mesh.nodes[rest.nodes[n]][static_cast<Eigen::Index>(c)]));
      }
    }
    ASSERT_GT(most, 1e-5);
    // A solve without inertia ends at a tolerance, after a number of iterations that rounding decides.
    EXPECT_LT(worst, (quasi_static ? 1e-9 : 1e-12) * most);
    EXPECT_NEAR(edited->last().kinetic_energy_j, loaded->last().kinetic_energy_j,
                1e-9 * loaded->last().kinetic_energy_j + 1e-15);
    ++compared;
  }
  EXPECT_GT(compared, 12);
}

TEST_P(Editing, BalancesMassAndVolume) {
  for (const EditedBeam& of : beams()) {
    SCOPED_TRACE(testing::PrintToString(of));
    const std::unique_ptr<World> world = start(tests::edited_beam(of));
    const model::Model& m = world->model();
    const auto mass = [&] { return std::accumulate(m.row_mass.begin(), m.row_mass.end(), 0.0); };
    const double before = mass();
    tests::RandomEdits random(3);
    for (int round = 0; round < 30; ++round) {
      if (!world->edit(random.next(*world->editor(), m.bodies[0].element_count, 3), {})) break;  // the last element
      double weight = 0, volume = 0;
      for (std::uint32_t e = 0; e < m.bodies[0].element_count; ++e) {
        volume += (1 - world->editor()->kept(e)) * m.edit_tables->volumes[e];
      }
      for (std::size_t i = 0; i < m.external.size(); i += 4) weight += m.external[i + 1];
      EXPECT_NEAR(mass() + world->editor()->removed_mass_kg(), before, 1e-12 * before);
      EXPECT_NEAR(weight, -9.81 * mass(), 1e-12 * 9.81 * before);
      EXPECT_NEAR(world->editor()->removed_volume_m3(), volume, 1e-12 * m.bodies[0].volume_m3);
    }
    EXPECT_GT(world->editor()->removed_mass_kg(), 0.01 * before);
    world->reset();
    EXPECT_EQ(mass(), before);
    EXPECT_EQ(world->editor()->removed_mass_kg(), 0);
  }
}

/// The energy of clusters (model/clusters.h) that have lost elements, or parts of them, from the energies of elements.
TEST_P(Editing, EditedClustersAreMeansOverWhatIsLeft) {
  using Law = physics::StVenantKirchhoff;
  for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_WEDGE}) {
    const v1::Scene scene = tests::edited_beam({.shape = shape, .quadrature = v1::QUADRATURE_SELECTIVE});
    const model::ReadBodies bodies = tests::bodies_of(scene);
    const std::vector<model::Cluster> clusters = model::make_clusters(bodies.bodies).clusters;
    ASSERT_GT(clusters.size(), 10u);
    const std::unique_ptr<World> world = start(scene);
    const model::Model& m = world->model();
    tests::RandomEdits random(17);
    for (int round = 0; round < 8; ++round) {
      ASSERT_TRUE(world->edit(random.next(*world->editor(), m.bodies[0].element_count, 10), {}));
    }
    World::Copied saved = world->copy();
    std::vector<Vec3<double>> u;  // [node]
    for (const std::uint32_t row : m.layout.row_of_node) {
      const Vec3<double> x = view::load3<double>(m.rest.data(), row);
      u.push_back(Vec3<double>(x[1] * x[1] + 0.2 * x[0] * x[2], 0.6 * x[0] * x[0], 0.4 * x[0] * x[1]));
      view::store3<double>(saved.tissue.rows.displacement.data(), row, u.back());
    }
    world->restore(saved);
    world->diagnose();
    std::vector<const model::Cluster*> cluster_of(m.bodies[0].element_count, nullptr);
    for (const model::Cluster& cluster : clusters) {
      for (const std::uint32_t e : cluster.elements) {
        if (e != mesh::kNone) cluster_of[e] = &cluster;
      }
    }
    struct Mean {
      Mat3<double> sum = Mat3<double>::Zero();
      double volume = 0;
    };
    std::map<const model::Cluster*, Mean> means;
    double energy = 0;
    const auto scaled = [&](double deviatoric, double volumetric) {
      std::array<double, Law::kParameterCount> own;
      std::copy_n(bodies.bodies[0].material(0).parameters.data(), own.size(), own.begin());
      Law::scale_moduli(own.data(), deviatoric, volumetric);
      return own;
    };
    model::for_each_element(bodies, [&](auto tag, std::size_t, std::uint32_t e, std::span<const std::uint32_t> nodes,
                                        const auto& x) {
      using Shape = typename decltype(tag)::Type;
      const double kept = world->editor()->kept(e);
      Vec3<double> of_nodes[Shape::kNodes];
      for (std::size_t k = 0; k < nodes.size(); ++k) of_nodes[k] = u[nodes[k]];
      const double* whole = bodies.bodies[0].material(0).parameters.data();
      if (cluster_of[e] == nullptr) {
        const physics::ElementAtRest<Shape> rest(x, physics::Quadrature::kSelective);
        energy += kept * physics::element_energy<Law>(rest, of_nodes, whole);
        return;
      }
      const double d = cluster_of[e]->deviatoric_part;
      const physics::ElementAtRest<Shape> full(x, physics::Quadrature::kFull), one(x, physics::Quadrature::kReduced);
      energy += kept * physics::element_energy<Law>(full, of_nodes, scaled(1 - d, 0).data());
      one.template for_each_point<Law>(of_nodes, whole, [&](const auto& point, const Mat3<double>& f, const double*) {
        means[cluster_of[e]].sum += kept * point.weight * f;
        means[cluster_of[e]].volume += kept * point.weight;
      });
    });
    int partial = 0;
    for (const auto& [cluster, mean] : means) {
      if (!(mean.volume > 0)) continue;
      const auto own = scaled(cluster->deviatoric_part, 1);
      energy += mean.volume * Law::energy(Law::at(Mat3<double>(mean.sum / mean.volume), own.data()));
      partial += mean.volume < 0.999 * cluster->mean.weight;
    }
    ASSERT_GT(partial, 5) << "clusters that lost a part";
    ASSERT_GT(energy, 0);
    EXPECT_NEAR(world->energy().elastic_j(), energy, 1e-11 * energy);
  }
}

/// An element with a part of its material has that part of its energy and of its mass.
TEST_P(Editing, APartOfTheMaterialIsAPartOfTheStiffness) {
  for (const v1::Quadrature quadrature : {v1::QUADRATURE_FULL, v1::QUADRATURE_SELECTIVE}) {
    for (const char* law : {"st_venant_kirchhoff", "hooke"}) {
      v1::Scene scene = tests::edited_beam({.law = law, .quadrature = quadrature});
      scene.clear_gravity_m_per_s2();
      const std::unique_ptr<World> edited = start(scene);
      std::vector<Ablation> edit;
      for (std::uint32_t e = 0; e < edited->model().bodies[0].element_count; ++e) edit.push_back({e, 0.25});
      for (std::size_t i = 0; i < edit.size(); i += 1000) {
        const std::span<const Ablation> all(edit);
        ASSERT_TRUE(edited->edit(all.subspan(i, std::min<std::size_t>(1000, edit.size() - i)), {}));
      }
      // Without loads, a quarter of all stiffness and of all mass moves the same.
      backend::RowState bent = edited->state();
      const std::unique_ptr<World> loaded = start(scene);
      for (std::size_t row = 0; row < edited->model().layout.row_count; ++row) {
        const double x = edited->model().rest[4 * row];
        bent.displacement[4 * row + 1] = edited->model().rest[4 * row + 3] > 0 ? 0.5 * x * x : 0;
      }
      World::Copied saved = edited->copy(), whole = loaded->copy();
      saved.tissue.rows.displacement = whole.tissue.rows.displacement = bent.displacement;
      edited->restore(saved);
      loaded->restore(whole);
      edited->diagnose();
      loaded->diagnose();
      ASSERT_GT(loaded->energy().elastic_j(), 0);
      EXPECT_NEAR(edited->energy().elastic_j(), 0.25 * loaded->energy().elastic_j(),
                  1e-12 * loaded->energy().elastic_j());
      for (int i = 0; i < 3; ++i) {
        ASSERT_TRUE(edited->step(false));
        ASSERT_TRUE(loaded->step(false));
      }
      const std::vector<double> a = motion_of(*edited), b = motion_of(*loaded);
      for (std::size_t i = 0; i < a.size(); ++i) EXPECT_NEAR(a[i], b[i], 1e-11);
    }
  }
}

TEST_P(Editing, RowsWithoutMaterialStop) {
  const std::unique_ptr<World> world = start(tests::edited_beam({.integrator = v1::Solver::INTEGRATOR_BDF2}));
  for (int i = 0; i < 20; ++i) ASSERT_TRUE(world->step(false));
  const model::Model& m = world->model();
  // All elements of the node at the far corner.
  std::uint32_t corner = 0;
  for (std::uint32_t node = 0; node < m.layout.row_of_node.size(); ++node) {
    const auto sum = [&](std::uint32_t n) {
      const double* x = &m.rest[4 * std::size_t{m.layout.row_of_node[n]}];
      return x[0] + x[1] + x[2];
    };
    if (sum(node) > sum(corner)) corner = node;
  }
  const std::uint32_t row = m.layout.row_of_node[corner];
  std::vector<Ablation> edit;
  for (const auto& one : m.edit_tables->corners[row]) edit.push_back({one.item, 0});
  ASSERT_FALSE(edit.empty());
  const auto position = [&] {
    const std::vector<double> x = world->positions(m.bodies[0]);
    return Vec3<double>(x[3 * corner], x[3 * corner + 1], x[3 * corner + 2]);
  };
  ASSERT_TRUE(world->edit(edit, {}));
  const Vec3<double> there = position();
  for (int i = 0; i < 10; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_LT((position() - there).norm(), 1e-14) << "BDF2 extrapolates, which rounds";
  EXPECT_EQ(m.row_mass[row], 0);
  EXPECT_EQ(m.rest[4 * std::size_t{row} + 3], 0);
  world->reset();
  EXPECT_EQ(m.rest[4 * std::size_t{row} + 3], 7);
  for (int i = 0; i < 20; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_GT((position() - Vec3<double>(0.2, 0.09, 0.1)).norm(), 1e-6) << "a reset frees it";
}

TEST_P(Editing, GoesOnFromASnapshotToTheLastBit) {
  for (const EditedBeam& of :
       {EditedBeam{.double_precision = false}, EditedBeam{.integrator = v1::Solver::INTEGRATOR_BDF2},
        EditedBeam{.law = "hooke", .quadrature = v1::QUADRATURE_SELECTIVE}}) {
    SCOPED_TRACE(testing::PrintToString(of));
    const std::unique_ptr<World> world = start(tests::edited_beam(of)), other = start(tests::edited_beam(of));
    tests::RandomEdits random(5);
    const auto go = [&](World& of_world, int steps) {
      for (int i = 0; i < steps; ++i) ASSERT_TRUE(of_world.step(false));
    };
    for (int i = 0; i < 6; ++i) {
      go(*world, 2);
      ASSERT_TRUE(world->edit(random.next(*world->editor(), world->model().bodies[0].element_count, 4), {}));
    }
    go(*world, 2);
    const World::Saved saved = world->save();
    go(*world, 5);
    const std::vector<double> once = motion_of(*world);
    ASSERT_TRUE(world->edit(random.next(*world->editor(), world->model().bodies[0].element_count, 4), {}));
    go(*world, 3);
    ASSERT_TRUE(world->check_shares(saved));
    world->restore(saved);
    go(*world, 5);
    EXPECT_EQ(motion_of(*world), once);
    other->restore(saved);
    go(*other, 5);
    EXPECT_EQ(motion_of(*other), once) << "in a world that had no edits of its own";
  }
}

TEST_P(Editing, ALongTimeOfRandomEditsEndsWhereItBegan) {
  constexpr int kEdits = 1000, kBetweenResets = 40;
  for (const EditedBeam& of :
       {EditedBeam{}, EditedBeam{.law = "hooke", .quadrature = v1::QUADRATURE_SELECTIVE, .double_precision = false},
        EditedBeam{.shape = v1::SHAPE_WEDGE, .quadrature = v1::QUADRATURE_SELECTIVE}}) {
    SCOPED_TRACE(testing::PrintToString(of));
    v1::Scene scene = tests::edited_beam(of);
    scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
    const std::unique_ptr<World> world = start(scene);
    const std::unique_ptr<World> fresh = start(scene);
    tests::RandomEdits random(1);
    int done = 0;
    for (int i = 0; i < kEdits / 3; ++i) {
      if (world->edit(random.next(*world->editor(), world->model().bodies[0].element_count, 4), {})) ++done;
      if (i % 4 == 0 && !world->step(false)) world->reset();
      if (i % kBetweenResets == kBetweenResets - 1) world->reset();
    }
    EXPECT_GT(done, kEdits / 3 - 20);
    world->reset();
    for (int i = 0; i < 5; ++i) {
      ASSERT_TRUE(world->step(false));
      ASSERT_TRUE(fresh->step(false));
    }
    EXPECT_EQ(motion_of(*world), motion_of(*fresh));
  }
}

TEST_P(Editing, RefusesWhatCannotBeDoneAndChangesNothing) {
  const std::unique_ptr<World> world = start(tests::edited_beam({.cells = 1}));
  const std::uint32_t elements = world->model().bodies[0].element_count;
  ASSERT_EQ(elements, 12u);
  ASSERT_TRUE(world->edit(std::vector<Ablation>{{2, 0}, {3, 0.5}}, {}));
  const auto state = [&] { return std::pair(world->model().row_mass, world->editor()->removed_mass_kg()); };
  const auto before = state();
  constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
  std::vector<Ablation> all;
  for (std::uint32_t e = 0; e < elements; ++e) {
    if (e != 2) all.push_back({e, 0});
  }
  const std::vector<std::pair<std::vector<Ablation>, std::string>> refused{
      {{{0, 0}, {elements, 0}}, "does not exist"},
      {{{0, 0}, {2, 0}}, "is gone already"},
      {{{0, 0}, {0, 0}}, "named twice"},
      {{{0, 0}, {3, 0.5}}, "has a share of 0.5 left"},
      {{{0, 0}, {3, 0.7}}, "has a share of 0.5 left"},
      {{{0, 0}, {1, kNaN}}, "not within [0, 1]"},
      {{{0, 0}, {1, -0.1}}, "not within [0, 1]"},
      {{{0, 0}, {1, 1.5}}, "not within [0, 1]"},
      {all, "is the last one"},
      {std::vector<Ablation>(limits::kMaxElementsOfEdit + 1, {0, 0}), "kMaxElementsOfEdit"}};
  for (const auto& [edit, words] : refused) {
    const Result<void> result = world->edit(edit, {});
    ASSERT_FALSE(result) << words;
    EXPECT_NE(result.error().message.find(words), std::string::npos) << result.error().message;
    EXPECT_EQ(state(), before) << words;
  }
  all.pop_back();
  EXPECT_TRUE(world->edit(all, {})) << "all but one may go";
  EXPECT_TRUE(world->step(false));
}

TEST_P(Editing, NeedsASceneThatSaysSo) {
  v1::Scene scene = tests::edited_beam({});
  scene.clear_editing();
  const std::unique_ptr<World> world = start(scene);
  const Result<void> result = world->edit(std::vector<Ablation>{{0, 0}}, {});
  ASSERT_FALSE(result);
  EXPECT_NE(result.error().message.find("scene.editing"), std::string::npos) << result.error().message;
}

}  // namespace
}  // namespace tensormass::world
