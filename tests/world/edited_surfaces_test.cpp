#include <algorithm>
#include <array>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "mesh/shapes.h"
#include "mesh/surface.h"
#include "support/backends.h"
#include "support/editing.h"

/// The surfaces of a scene whose elements are burnt away: what tools touch and clients see is the boundary of what is
/// left, whatever was done and in which order.
namespace tensormass::world {
namespace {

using model::Ablation;
using tests::EditedBeam;

/// A triangle by the nodes of the scene, lowest first, in its winding.
using ByNodes = std::array<std::uint32_t, 3>;

ByNodes sorted(ByNodes nodes) {
  std::rotate(nodes.begin(), std::min_element(nodes.begin(), nodes.end()), nodes.end());
  return nodes;
}

/// Returns the boundary of what is left of a body, by the nodes of its whole mesh.
std::multiset<ByNodes> boundary_of(const mesh::Mesh& whole, const model::Editor& editor) {
  mesh::Mesh left{whole.nodes, {}};
  std::uint32_t element = 0;
  for (const mesh::ElementBlock& block : whole.blocks) {
    const std::size_t nodes = mesh::topology(block.shape).node_count;
    mesh::ElementBlock& kept = left.blocks.emplace_back(mesh::ElementBlock{block.shape, {}});
    for (std::size_t first = 0; first < block.nodes.size(); first += nodes, ++element) {
      if (!(editor.kept(element) > 0)) continue;
      for (std::size_t k = first; k < first + nodes; ++k) kept.nodes.push_back(block.nodes[k]);
    }
  }
  const mesh::Surface surface = mesh::boundary(left);
  std::multiset<ByNodes> out;
  for (const mesh::Triangle& t : surface.triangles) {
    out.insert(sorted({surface.nodes[t[0]], surface.nodes[t[1]], surface.nodes[t[2]]}));
  }
  return out;
}

/// Returns the contact surface by nodes, and checks that its parts fit together.
std::multiset<ByNodes> contact_of(const model::Model& m) {
  const model::ContactSurface& contact = m.contact;
  const auto node = [&](std::uint32_t row) { return m.layout.node_of_row[row]; };
  std::multiset<ByNodes> out;
  std::map<std::array<std::uint32_t, 2>, std::vector<std::uint32_t>> edges;  // directed, by rows
  std::vector<bool> exists(contact.triangle_count(), false);
  for (std::uint32_t patch = 0; patch < m.layout.patch_count; ++patch) {
    EXPECT_LE(contact.triangles_end[patch], contact.patch_triangles[patch + 1]);
    for (std::uint32_t t = contact.patch_triangles[patch]; t < contact.triangles_end[patch]; ++t) {
      const std::uint32_t* rows = &contact.triangle_rows[3 * std::size_t{t}];
      exists[t] = true;
      EXPECT_EQ(m.layout.patch_of_row(rows[0]), patch) << "the patch of its first corner owns a triangle";
      EXPECT_GT(contact.triangle_area[t], 0);
      EXPECT_GT(contact.triangle_moduli[2 * std::size_t{t}], 0);
      out.insert(sorted({node(rows[0]), node(rows[1]), node(rows[2])}));
      for (std::size_t c = 0; c < 3; ++c) {
        edges[{rows[c], rows[(c + 1) % 3]}].push_back(t);
        EXPECT_EQ(contact.surface_rows[contact.vertex_of_corner[3 * std::size_t{t} + c]], rows[c]);
      }
    }
  }
  std::size_t listed = 0;
  std::set<std::uint32_t> rows_met;
  for (std::uint32_t patch = 0; patch < m.layout.patch_count; ++patch) {
    for (std::uint32_t v = contact.patch_surface[patch]; v < contact.surface_end[patch]; ++v) {
      const std::uint32_t row = contact.surface_rows[v];
      EXPECT_TRUE(rows_met.insert(row).second) << "a row has one vertex";
      EXPECT_EQ(m.layout.patch_of_row(row), patch);
      for (std::uint32_t i = contact.incidence_begin[v]; i < contact.incidence_end[v]; ++i, ++listed) {
        const std::uint32_t* entry = &contact.incidence[4 * std::size_t{i}];
        EXPECT_TRUE(exists[entry[0]]);
        const std::uint32_t* rows = &contact.triangle_rows[3 * std::size_t{entry[0]}];
        EXPECT_EQ(rows[entry[1]], row);
        EXPECT_EQ(entry[2], m.layout.slot(row, rows[(entry[1] + 1) % 3]));
        EXPECT_EQ(entry[3], m.layout.slot(row, rows[(entry[1] + 2) % 3]));
      }
    }
  }
  EXPECT_EQ(listed, 3 * out.size()) << "each corner is listed once";
  for (const auto& [edge, triangles] : edges) {
    const auto back = edges.find({edge[1], edge[0]});
    const std::size_t met = triangles.size() + (back == edges.end() ? 0 : back->second.size());
    for (const std::uint32_t t : triangles) {
      std::size_t side = 0;
      while (contact.triangle_rows[3 * std::size_t{t} + side] != edge[0]) ++side;
      const std::uint32_t neighbour = contact.triangle_neighbours[3 * std::size_t{t} + side];
      const bool paired = met == 2 && back != edges.end();
      EXPECT_EQ(neighbour, paired ? back->second.front() : view::kNoTriangle);
    }
  }
  return out;
}

/// Returns what clients see of the first body, by nodes.
std::multiset<ByNodes> visible_of(const model::Model& m, const model::BodySurface& surface) {
  const model::BodyModel& body = m.bodies[0];
  const auto node = [&](std::uint32_t vertex) {
    if (vertex < body.vertex_count) return body.vertex_nodes[vertex];
    const std::size_t point = surface.appended_vertices.at(vertex - body.vertex_count);
    EXPECT_GE(point, m.visible.count());
    EXPECT_LT(point, m.visible.count() + m.visible.appended_count);
    EXPECT_EQ(m.visible.weights[4 * point], 1);
    return m.layout.node_of_row[m.visible.rows[4 * point]];
  };
  std::multiset<ByNodes> out;
  EXPECT_TRUE(std::is_sorted(surface.dead_triangles.begin(), surface.dead_triangles.end()));
  const std::size_t loaded = body.triangles.size();
  for (std::uint32_t t = 0; t < loaded + surface.appended_triangles.size(); ++t) {
    if (std::binary_search(surface.dead_triangles.begin(), surface.dead_triangles.end(), t)) continue;
    const mesh::Triangle& of = t < loaded ? body.triangles[t] : surface.appended_triangles[t - loaded];
    out.insert(sorted({node(of[0]), node(of[1]), node(of[2])}));
  }
  return out;
}

v1::Scene touched_beam(const EditedBeam& of, double friction = 0.3) {
  v1::Scene scene = tests::edited_beam(of);
  scene.mutable_streams()->set_frame_rate_hz(60);
  tests::add_probe(scene, "probe", 0.02, 0.15, 0.12, 0.05).set_friction_coefficient(friction);
  scene.mutable_solver()->set_cg_max_iterations(60);
  scene.mutable_editing()->set_max_new_triangles(20'000);
  scene.mutable_editing()->set_max_new_vertices(20'000);
  return scene;
}

class EditedSurfaces : public tests::OnBackend {};
TM_ON_EACH_BACKEND(EditedSurfaces);

TEST_P(EditedSurfaces, AreTheBoundaryOfWhatIsLeft) {
  for (const v1::Shape shape : tests::shapes()) {
    SCOPED_TRACE(v1::Shape_Name(shape));
    const std::uint32_t cells = shape == v1::SHAPE_QUADRATIC_HEXAHEDRON ? 2 : 3;
    const v1::Scene scene = touched_beam({.shape = shape, .cells = cells});
    const mesh::Mesh mesh = tests::bodies_of(scene).bodies[0].mesh;
    model::PatchPolicy policy = backend_->patch_policy(2);
    policy.max_patches = 3;
    policy.min_nodes_per_patch = 1;
    auto model = model::compile(scene, policy);
    ASSERT_TRUE(model) << model.error().message;
    auto made = backend_->create(*model);
    ASSERT_TRUE(made);
    backend::SceneState& state = **made;
    model::Editor editor(*model);
    const auto all_fits = [&] {
      const std::multiset<ByNodes> boundary = boundary_of(mesh, editor);
      EXPECT_EQ(contact_of(*model), boundary);
      EXPECT_EQ(visible_of(*model, editor.surfaces()[0]), boundary);
    };
    all_fits();
    tests::RandomEdits random(23);
    int refused = 0;
    for (int round = 0; round < 25; ++round) {
      const std::vector<Ablation> edit = random.next(editor, model->bodies[0].element_count, 4);
      if (!editor.check(*model, edit)) {
        ++refused;
        continue;
      }
      state.apply(editor.ablate(*model, edit));
      all_fits();
    }
    EXPECT_LT(refused, 10) << "elements that are missing here and there make a sponge, whose surface has no room";
    auto bound = backend_->create(*model);
    ASSERT_TRUE(bound);
    const auto a = state.read_constants(), b = (*bound)->read_constants();
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) EXPECT_TRUE(a[i].bytes == b[i].bytes) << a[i].name;
    const std::uint32_t revision = editor.surface_revision();
    editor.heal(*model, [&](const model::ModelEdit& edit) { state.apply(edit); });
    all_fits();
    EXPECT_TRUE(editor.surfaces()[0].dead_triangles.empty());
    EXPECT_GT(editor.surface_revision(), revision) << "a revision never falls";
  }
}

/// A scene with room for edits, without any, is the scene without room, but for rounding of the sums that edits
/// compute.
TEST_P(EditedSurfaces, RoomChangesNothing) {
  v1::Scene scene = touched_beam({});
  scene.mutable_tools(0)->mutable_position_m()->set_y(0.108);
  scene.clear_gravity_m_per_s2();
  const std::unique_ptr<World> with = start(scene);
  scene.clear_editing();
  const std::unique_ptr<World> without = start(scene);
  double most_n = 0;
  for (int i = 0; i < 10; ++i) {
    ASSERT_TRUE(with->step(true));
    ASSERT_TRUE(without->step(true));
    const Vec3<double> force_n = without->readings()[0].force_n;
    most_n = std::max(most_n, force_n.norm());
    EXPECT_LT((with->readings()[0].force_n - force_n).norm(), 1e-9 * most_n);
  }
  EXPECT_GT(most_n, 0.01);
  const auto a = with->visible_positions(), b = without->visible_positions();
  ASSERT_EQ(b.size(), 3 * std::size_t{without->model().visible.count()});
  for (std::size_t i = 0; i < b.size(); ++i) EXPECT_NEAR(a[i], b[i], 1e-7);
}

/// A probe that lies on a block sinks into the hole that is burnt below it, and rests on what comes to light there.
TEST_P(EditedSurfaces, AToolFeelsWhatComesToLight) {
  v1::Scene scene = touched_beam({.shape = v1::SHAPE_HEXAHEDRON, .cells = 5});
  v1::Box& clamp = *scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box();
  tests::set(*clamp.mutable_min_m(), -1, -1, -1);
  tests::set(*clamp.mutable_max_m(), 1, 1e-6, 1);
  scene.clear_gravity_m_per_s2();
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.11, 0.109, 0.05);  // 1 mm into the top, y = 0.09
  const std::unique_ptr<World> world = start(scene);
  const model::Model& m = world->model();
  const auto rest = [&](int steps) {
    for (int i = 0; i < steps; ++i) EXPECT_TRUE(world->step(true));
    return world->readings()[0].force_n;
  };
  const double before = rest(40)[1];
  ASSERT_GT(before, 0.02) << "pushed up";
  std::vector<Ablation> hole;  // the top layer around the tool
  for (std::uint32_t e = 0; e < m.bodies[0].element_count; ++e) {
    Vec3<double> middle = Vec3<double>::Zero();
    for (const std::uint32_t row : m.edit_tables->rows[e]) middle += view::load3<double>(m.rest.data(), row) / 8;
    if (middle[1] > 0.072 && std::abs(middle[0] - 0.11) < 0.05 && std::abs(middle[2] - 0.05) < 0.05)
      hole.push_back({e, 0});
  }
  ASSERT_GT(hole.size(), 8u);
  ASSERT_TRUE(world->edit(hole, {}));
  EXPECT_LT(rest(40).norm(), 1e-9) << "the tool is above the floor of the hole, y = 0.072";
  world->set_tool_target(0, {{0.11, 0.0905, 0.05}, {1, 0, 0, 0}});
  const double floor = rest(40)[1];
  EXPECT_GT(floor, 0.02) << "it rests on the floor";
  EXPECT_GT(world->editor()->surfaces()[0].appended_triangles.size(), 10u);
  // Positions of appended vertices are gathered.
  const auto positions = world->visible_positions();
  for (const std::uint32_t point : world->editor()->surfaces()[0].appended_vertices) {
    EXPECT_NEAR(positions[3 * std::size_t{point} + 1], 0.072f, 0.01f);
  }
  world->reset();
  world->set_tool_target(0, {{0.11, 0.109, 0.05}, {1, 0, 0, 0}});
  EXPECT_NEAR(rest(40)[1], before, 1e-6 * before) << "a reset heals the surface";
}

/// A tool that rubs over tissue that burns away: nothing breaks, and a snapshot goes on to the last bit.
TEST_P(EditedSurfaces, RubAndBurnRepeatsToTheLastBit) {
  for (const bool double_precision : {true, false}) {
    v1::Scene scene = touched_beam({.double_precision = double_precision});
    scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
    const std::unique_ptr<World> world = start(scene), other = start(scene);
    tests::RandomEdits random(4);
    const auto go = [](World& of, int from, int steps) {
      for (int i = from; i < from + steps; ++i) {
        of.set_tool_target(0, {{0.12 + 0.001 * i, 0.106, 0.05}, {1, 0, 0, 0}});
        EXPECT_TRUE(of.step(true));
      }
      return of.state().displacement;
    };
    for (int i = 0; i < 8; ++i) {
      go(*world, 2 * i, 2);
      ASSERT_TRUE(world->edit(random.next(*world->editor(), world->model().bodies[0].element_count, 3), {}));
    }
    go(*world, 16, 4);
    const World::Saved saved = world->save();
    const std::vector<double> once = go(*world, 20, 6);
    other->restore(saved);
    EXPECT_EQ(go(*other, 20, 6), once);
  }
}

TEST_P(EditedSurfaces, RefusesWhatHasNoRoom) {
  v1::Scene scene = touched_beam({.shape = v1::SHAPE_HEXAHEDRON});
  scene.mutable_editing()->set_max_new_triangles(12);
  scene.mutable_editing()->set_max_new_vertices(6);
  const std::unique_ptr<World> world = start(scene);
  const auto inner = [&](std::uint32_t x, std::uint32_t y, std::uint32_t z) { return x + 6 * (y + 3 * z); };
  ASSERT_TRUE(world->edit(std::vector<Ablation>{{inner(2, 2, 1), 0}}, {})) << "ten new triangles, four new vertices";
  const std::uint32_t revision = world->editor()->surface_revision();
  const Result<void> result = world->edit(std::vector<Ablation>{{inner(4, 2, 1), 0}}, {});
  ASSERT_FALSE(result);
  EXPECT_NE(result.error().message.find("scene.editing.max_new_triangles"), std::string::npos);
  EXPECT_EQ(world->editor()->surface_revision(), revision);
  EXPECT_EQ(world->editor()->kept(inner(4, 2, 1)), 1);
  world->reset();
  EXPECT_TRUE(world->edit(std::vector<Ablation>{{inner(4, 2, 1), 0}}, {})) << "a reset gives the room back";
}

TEST_P(EditedSurfaces, RefusesScenesThatCannotBeEditedYet) {
  v1::Scene touching = touched_beam({});
  *touching.add_bodies() = touching.bodies(0);
  touching.mutable_bodies(1)->set_name("other");
  tests::set(*touching.mutable_bodies(1)->mutable_mesh()->mutable_translation_m(), 0, 0.2, 0);
  touching.add_body_contacts()->set_body("beam");
  touching.mutable_body_contacts(0)->set_other("other");
  const auto model = model::compile(touching, backend_->patch_policy(2));
  ASSERT_FALSE(model);
  EXPECT_NE(model.error().message.find("cannot have body_contacts yet"), std::string::npos) << model.error().message;
}

TEST_P(EditedSurfaces, SpringsAreSeveredAndGoWithTheirTissue) {
  v1::Scene scene = tests::hanging_block();
  scene.mutable_attachments(1)->clear_breaking_force_n();
  scene.mutable_editing();
  const std::unique_ptr<World> world = start(scene);
  const model::Model& m = world->model();
  const auto broken = [&] {
    int count = 0;
    for (std::uint32_t i = 0; i < m.links.spring_count(); ++i) count += world->broken_springs()[i / 8] >> i % 8 & 1;
    return count;
  };
  ASSERT_TRUE(world->step(false));
  ASSERT_EQ(m.links.spring_count(), 17u);
  EXPECT_EQ(broken(), 0);
  ASSERT_TRUE(world->edit({}, std::vector<std::uint32_t>{3, 12}));
  EXPECT_EQ(broken(), 2);
  EXPECT_FALSE(world->edit({}, std::vector<std::uint32_t>{0, 3})) << "severed already";
  EXPECT_FALSE(world->edit({}, std::vector<std::uint32_t>{0, 17})) << "there are 17";
  EXPECT_FALSE(world->edit({}, std::vector<std::uint32_t>{0, 0}));
  EXPECT_EQ(broken(), 2) << "nothing half done";
  ASSERT_TRUE(world->step(false));
  EXPECT_EQ(broken(), 2);
  // All springs are linked to the first node of the block.
  const std::uint32_t row = m.layout.row_of_node[m.bodies[0].node_begin];
  std::vector<Ablation> edit;
  for (const auto& one : m.edit_tables->corners[row]) edit.push_back({one.item, 0});
  ASSERT_TRUE(world->edit(edit, {}));
  EXPECT_EQ(broken(), 17);
  ASSERT_TRUE(world->step(false));
  EXPECT_EQ(broken(), 17);
  world->reset();
  EXPECT_EQ(broken(), 0);
  ASSERT_TRUE(world->step(false));
  EXPECT_EQ(broken(), 0);
}

}  // namespace
}  // namespace tensormass::world
