#include "model/coagulation.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/editing.h"
#include "support/refused.h"
#include "world/fields.h"

/// Heated tissue: how stiff it is, against a scene that was loaded with other moduli, and what clients see of it.
namespace tensormass::world {
namespace {

using model::Ablation;
using tests::EditedBeam;

constexpr double kFactor = 4;

/// Returns C(κ), written down a second time.
double expected_stiffening(double kept) { return kept >= 0.9 ? 1 + (kFactor - 1) * (1 - kept) * 10 : kFactor; }

template <class T>
std::string bytes_of(const std::vector<T>& values) {
  return {reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T)};
}

/// A beam that a force bends, in equilibrium.
v1::Scene bent_beam(EditedBeam of) {
  of.integrator = v1::Solver::INTEGRATOR_QUASI_STATIC;
  v1::Scene scene = tests::edited_beam(of);
  scene.clear_gravity_m_per_s2();
  v1::Load& load = *scene.mutable_bodies(0)->add_loads();
  tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), 0.19, -1, -1);
  tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 0.21, 1, 1);
  tests::set(*load.mutable_force_n(), 2, -6, 1);
  return scene;
}

/// A beam that clients see.
v1::Scene seen_beam(const EditedBeam& of) {
  v1::Scene scene = tests::edited_beam(of);
  scene.mutable_streams()->set_frame_rate_hz(60);
  return scene;
}

class Coagulation : public tests::OnBackend {};
TM_ON_EACH_BACKEND(Coagulation);

TEST(CoagulationLaw, IsRawAtFirstAndWholeAfterATenth) {
  EXPECT_EQ(model::stiffening(1, kFactor), 1);
  for (const double kept : {0.99, 0.95, 0.9, 0.5, 0.0}) {
    EXPECT_NEAR(model::stiffening(kept, kFactor), expected_stiffening(kept), 1e-12) << kept;
    EXPECT_EQ(model::stiffening(kept, 1), 1) << "to the last bit";
  }
  EXPECT_EQ(model::coagulation_seen(1), 0);
  EXPECT_EQ(model::coagulation_seen(0.95), 85);
  EXPECT_EQ(model::coagulation_seen(0.92), 170);
  EXPECT_EQ(model::coagulation_seen(0.8), 255);
  EXPECT_EQ(model::coagulation_seen(0), 255);
}

/// Elements with shares of their material bend as those of a scene that was loaded with moduli E κ C(κ).
TEST_P(Coagulation, IsAsStiffAsASceneWithTheseModuli) {
  for (const EditedBeam& of :
       {EditedBeam{.law = "stable_neo_hookean"}, EditedBeam{.law = "hooke"},
        EditedBeam{.shape = v1::SHAPE_HEXAHEDRON, .law = "stable_neo_hookean"},
        EditedBeam{
            .shape = v1::SHAPE_HEXAHEDRON, .law = "stable_neo_hookean", .quadrature = v1::QUADRATURE_SELECTIVE}}) {
    SCOPED_TRACE(testing::PrintToString(of));
    v1::Scene scene = bent_beam(of);
    scene.mutable_bodies(0)->set_coagulated_stiffness_factor(kFactor);
    const std::unique_ptr<World> edited = start(scene);
    const std::uint32_t elements = edited->model().bodies[0].element_count;
    std::vector<Ablation> edit;
    std::vector<double> kept(elements, 1), moduli(elements, 2e5);
    for (std::uint32_t e = 0; e < elements; e += 2) {
      kept[e] = std::vector{0.97, 0.9, 0.4}[e / 2 % 3];
      moduli[e] *= kept[e] * expected_stiffening(kept[e]);
      edit.push_back({e, kept[e]});
    }
    ASSERT_TRUE(edited->edit(edit, {}));
    v1::Scene other = scene;
    other.clear_editing();
    other.mutable_bodies(0)->mutable_element_fields()->set_young_modulus_pa(bytes_of(moduli));
    const std::unique_ptr<World> loaded = start(other), raw = start(bent_beam(of));
    for (World* world : {edited.get(), loaded.get(), raw.get()}) {
      for (int i = 0; i < 3; ++i) ASSERT_TRUE(world->step(false));
    }
    const auto moved = [](World& world) { return world.positions(world.model().bodies[0]); };
    const std::vector<double> a = moved(*edited), b = moved(*loaded), c = moved(*raw);
    double difference = 0, bend = 0;
    for (std::size_t i = 0; i < a.size(); ++i) {
      difference = std::max(difference, std::abs(a[i] - b[i]));
      bend = std::max(bend, std::abs(a[i] - c[i]));
    }
    EXPECT_GT(bend, 1e-3) << "the edit moves the beam";
    EXPECT_LT(difference, 1e-8);

    // The same force in a part κ of the material: the stress is 1/κ times that of the whole element.
    v1::GetFieldsRequest request;
    request.add_fields(v1::FIELD_VON_MISES_STRESS);
    const auto stress = [&](World& world) {
      const auto fields = measure_fields(world.model(), world.state(), 0, world.model().bodies[0], request);
      if (!fields) throw std::runtime_error(fields.error().message);
      std::vector<double> values(elements);
      EXPECT_EQ(fields->fields(0).values().size(), elements * sizeof(double));
      std::memcpy(values.data(), fields->fields(0).values().data(), elements * sizeof(double));
      return values;
    };
    const std::vector<double> in_parts = stress(*edited), in_whole = stress(*loaded);
    const double most = *std::max_element(in_whole.begin(), in_whole.end());
    for (std::uint32_t e = 0; e < elements; ++e) EXPECT_NEAR(in_parts[e] * kept[e], in_whole[e], 1e-5 * most) << e;
  }
}

TEST_P(Coagulation, WithoutAFactorElementsFallWithTheirMaterialToTheLastBit) {
  const auto go = [&](double factor) {
    v1::Scene scene = tests::edited_beam({.law = "stable_neo_hookean"});
    if (factor > 0) scene.mutable_bodies(0)->set_coagulated_stiffness_factor(factor);
    const std::unique_ptr<World> world = start(scene);
    EXPECT_TRUE(world->edit(std::vector<Ablation>{{60, 0.95}, {61, 0.5}, {70, 0}}, {}));
    for (int i = 0; i < 5; ++i) EXPECT_TRUE(world->step(false));
    return world->positions(world->model().bodies[0]);
  };
  EXPECT_EQ(go(0), go(1));
  EXPECT_NE(go(0), go(2));
}

TEST_P(Coagulation, PalesTheVerticesOfTheElementsUntilAReset) {
  v1::Scene scene = seen_beam({.shape = v1::SHAPE_HEXAHEDRON});
  const std::unique_ptr<World> world = start(scene);
  const model::Model& m = world->model();
  const model::Editor& editor = *world->editor();
  const mesh::Mesh mesh = tests::bodies_of(scene).bodies[0].mesh;
  const auto coagulation = [&]() { return editor.surfaces()[0].coagulation; };
  // What each vertex shows, by the element's nodes.
  const auto seen = [&](std::uint32_t element, std::uint8_t at, std::vector<std::uint8_t> expected) {
    for (std::uint32_t v = 0; v < m.bodies[0].vertex_count; ++v) {
      const auto nodes = mesh.blocks[0].nodes.begin() + 8 * std::ptrdiff_t{element};
      if (std::find(nodes, nodes + 8, m.bodies[0].vertex_nodes[v]) != nodes + 8) {
        expected[v] = std::max(expected[v], at);
      }
    }
    return expected;
  };
  EXPECT_TRUE(coagulation().empty());
  const std::uint32_t corner = m.bodies[0].element_count - 1, shape = editor.shape_revision();
  ASSERT_TRUE(world->edit(std::vector<Ablation>{{corner, 0.99}}, {}));
  EXPECT_TRUE(coagulation().empty()) << "less than a third of the way";
  EXPECT_EQ(editor.surface_revision(), 0u);
  ASSERT_TRUE(world->edit(std::vector<Ablation>{{corner, 0.95}}, {}));
  std::vector<std::uint8_t> expected = seen(corner, 85, std::vector<std::uint8_t>(m.bodies[0].vertex_count, 0));
  EXPECT_EQ(coagulation(), expected);
  EXPECT_EQ(std::count(expected.begin(), expected.end(), 85), 7) << "the eighth is inside";
  EXPECT_EQ(editor.surface_revision(), 1u);
  ASSERT_TRUE(world->edit(std::vector<Ablation>{{corner - 1, 0.5}}, {}));
  EXPECT_EQ(coagulation(), expected = seen(corner - 1, 255, expected));
  EXPECT_EQ(editor.shape_revision(), shape) << "no triangle has changed";
  // An element that goes leaves a pale rim. The vertex that comes to light belongs to it, too.
  ASSERT_TRUE(world->edit(std::vector<Ablation>{{corner, 0}}, {}));
  std::vector<std::uint8_t> now = coagulation();
  ASSERT_EQ(now.size(), m.bodies[0].vertex_count + 1u);
  EXPECT_EQ(now.back(), 255);
  now.pop_back();
  EXPECT_EQ(now, expected = seen(corner, 255, expected));

  // A snapshot restores what is seen.
  const World::Saved saved = world->save();
  const std::unique_ptr<World> other = start(scene);
  other->restore(saved);
  EXPECT_EQ(other->editor()->surfaces()[0].coagulation, coagulation());
  const std::uint32_t revision = editor.surface_revision();
  world->reset();
  EXPECT_TRUE(coagulation().empty());
  EXPECT_GT(editor.surface_revision(), revision) << "clients hear of it";
}

TEST_P(Coagulation, OfTissueBelowASkinPalesTheSkin) {
  v1::Scene scene = seen_beam({});
  const mesh::Mesh mesh = tests::bodies_of(scene).bodies[0].mesh;
  const mesh::Surface surface = mesh::boundary(mesh);
  std::vector<double> points;
  for (const std::uint32_t node : surface.nodes) {
    const Vec3<double> middle(0.1, 0.045, 0.05), x = middle + 1.01 * (mesh.nodes[node] - middle);
    points.insert(points.end(), x.begin(), x.end());
  }
  v1::PackedTriangles& skin = *scene.mutable_bodies(0)->mutable_skin()->mutable_packed();
  skin.set_vertex_positions(bytes_of(points));
  skin.set_triangles(surface.triangles.data(), surface.triangles.size() * sizeof(mesh::Triangle));
  const std::unique_ptr<World> world = start(scene);
  const std::uint32_t last = world->model().bodies[0].element_count - 1;
  ASSERT_TRUE(world->edit(std::vector<Ablation>{{last, 0.5}}, {}));
  const std::vector<std::uint8_t>& seen = world->editor()->surfaces()[0].coagulation;
  ASSERT_EQ(seen.size(), surface.nodes.size());
  std::size_t pale = 0;
  double farthest_m = 0;
  Vec3<double> center = Vec3<double>::Zero();
  for (std::size_t k = 0; k < 4; ++k) center += mesh.nodes[mesh.blocks[0].nodes[4 * std::size_t{last} + k]] / 4;
  for (std::size_t v = 0; v < seen.size(); ++v) {
    if (seen[v] == 0) continue;
    EXPECT_EQ(seen[v], 255);
    ++pale;
    farthest_m = std::max(farthest_m, (mesh.nodes[surface.nodes[v]] - center).norm());
  }
  EXPECT_GE(pale, 3u);
  EXPECT_LT(farthest_m, 0.08) << "two cells around the element";
  world->reset();
  EXPECT_TRUE(world->editor()->surfaces()[0].coagulation.empty());
}

TEST(CoagulationInput, RefusesFactorsOutOfRange) {
  for (const double wrong : {0.0, 0.99, 51.0, -1.0, std::nan("")}) {
    v1::Scene scene = tests::edited_beam({});
    scene.mutable_bodies(0)->set_coagulated_stiffness_factor(wrong);
    EXPECT_REFUSED(model::read_bodies(scene, {}), ErrorCode::kInvalidArgument, "coagulated_stiffness_factor");
  }
}

}  // namespace
}  // namespace tensormass::world
