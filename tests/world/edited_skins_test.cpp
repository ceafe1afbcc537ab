#include <algorithm>
#include <array>
#include <limits>
#include <map>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "mesh/box_tree.h"
#include "mesh/surface.h"
#include "support/backends.h"
#include "support/editing.h"
#include "support/tools.h"
#include "world/enclosure.h"

/// Skins of bodies whose elements are burnt away: what is torn, what comes to light below, and that nobody can look
/// between the two.
namespace tensormass::world {
namespace {

using mesh::kNone;
using model::Ablation;
using Triangles = std::vector<std::array<Vec3<double>, 3>>;

const Vec3<double> kSizeM{0.2, 0.09, 0.1};

/// A skin around the beam of edited_beam: finer or coarser than its boundary, larger or smaller.
struct Skinned {
  v1::Shape shape = v1::SHAPE_TETRAHEDRON;
  std::uint32_t cells = 3, skin_cells = 5;
  double scale = 1.02;

  friend void PrintTo(const Skinned& of, std::ostream* out) {
    *out << v1::Shape_Name(of.shape) << ", skin of " << of.skin_cells << " cells, scaled by " << of.scale;
  }
};

v1::Scene skinned_beam(const Skinned& of) {
  v1::Scene scene = tests::edited_beam({.shape = of.shape, .cells = of.cells});
  scene.mutable_streams()->set_frame_rate_hz(60);
  tests::add_probe(scene, "probe", 0.02, 0.15, 0.12, 0.05);
  scene.mutable_editing()->set_max_new_triangles(40'000);
  scene.mutable_editing()->set_max_new_vertices(40'000);
  const mesh::Mesh mesh = tests::bodies_of(tests::edited_beam({.cells = of.skin_cells})).bodies[0].mesh;
  const mesh::Surface surface = mesh::boundary(mesh);
  std::vector<double> points;
  for (const std::uint32_t node : surface.nodes) {
    const Vec3<double> x = kSizeM / 2 + of.scale * (mesh.nodes[node] - kSizeM / 2);
    points.insert(points.end(), x.begin(), x.end());
  }
  v1::PackedTriangles& skin = *scene.mutable_bodies(0)->mutable_skin()->mutable_packed();
  skin.set_vertex_positions(points.data(), points.size() * sizeof(double));
  skin.set_triangles(surface.triangles.data(), surface.triangles.size() * sizeof(mesh::Triangle));
  return scene;
}

std::vector<Skinned> skins() {
  std::vector<Skinned> out;
  for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_HEXAHEDRON, v1::SHAPE_QUADRATIC_TETRAHEDRON}) {
    for (const std::uint32_t skin_cells : {1u, 3u, 8u}) {
      for (const double scale : {0.98, 1.0, 1.02}) out.push_back({shape, 3, skin_cells, scale});
    }
  }
  return out;
}

Vec3<double> middle_of(const model::Model& m, std::uint32_t element) {
  Vec3<double> sum = Vec3<double>::Zero();
  const auto rows = m.edit_tables->rows[element];
  for (const std::uint32_t row : rows) sum += view::load3<double>(m.rest.data(), row);
  return sum / static_cast<double>(rows.size());
}

/// Craters at random places of the boundary, and single elements anywhere.
class Craters {
 public:
  explicit Craters(std::uint32_t seed) : random_(seed), edits_(seed) {}

  std::vector<Ablation> next(const model::Model& m, const model::Editor& editor) {
    if (random_() % 4 == 0) return edits_.next(editor, m.bodies[0].element_count, 3);
    const std::vector<mesh::Triangle>& skin = m.bodies[0].triangles;
    const std::uint32_t vertex = skin[random_() % skin.size()][0];
    Vec3<double> at = Vec3<double>::Zero();
    for (std::size_t i = 4 * std::size_t{vertex}; i < 4 * std::size_t{vertex} + 4; ++i) {
      at += m.visible.weights[i] * view::load3<double>(m.rest.data(), m.visible.rows[i]);
    }
    std::vector<Ablation> out;
    for (std::uint32_t e = 0; e < m.bodies[0].element_count; ++e) {
      if (editor.kept(e) > 0 && (middle_of(m, e) - at).norm() < 0.035) out.push_back({e, 0});
    }
    return out;
  }

 private:
  std::mt19937 random_;
  tests::RandomEdits edits_;
};

/// Returns where the visible points are at rest.
std::vector<Vec3<double>> points_of(const model::Model& m) {
  std::vector<Vec3<double>> out(m.visible.point_count(), Vec3<double>::Zero());
  for (std::size_t i = 0; i < m.visible.rows.size(); ++i) {
    out[i / 4] += m.visible.weights[i] * view::load3<double>(m.rest.data(), m.visible.rows[i]);
  }
  return out;
}

std::uint32_t point_of(const model::Model& m, const model::BodySurface& surface, std::uint32_t vertex) {
  return vertex < m.bodies[0].vertex_count ? vertex : surface.appended_vertices.at(vertex - m.bodies[0].vertex_count);
}

bool is_dead(const model::BodySurface& surface, std::uint32_t triangle) {
  return std::binary_search(surface.dead_triangles.begin(), surface.dead_triangles.end(), triangle);
}

/// What clients see of the first body, at rest.
Triangles visible_of(const model::Model& m, const model::BodySurface& surface) {
  const std::vector<Vec3<double>> points = points_of(m);
  const auto loaded = static_cast<std::uint32_t>(m.bodies[0].triangles.size());
  Triangles out;
  for (std::uint32_t t = 0; t < loaded + surface.appended_triangles.size(); ++t) {
    if (is_dead(surface, t)) continue;
    const mesh::Triangle& of = t < loaded ? m.bodies[0].triangles[t] : surface.appended_triangles[t - loaded];
    const auto corner = [&](std::size_t c) { return points[point_of(m, surface, of[c])]; };
    out.push_back({corner(0), corner(1), corner(2)});
  }
  return out;
}

/// The boundary of what is left, at rest.
Triangles boundary_of(const model::Model& m, const model::Editor& editor) {
  const model::EditTables& tables = *m.edit_tables;
  Triangles out;
  for (std::uint32_t face = 0; face < tables.face_element.size(); ++face) {
    const std::uint32_t behind = tables.face_behind[face];
    if (!(editor.kept(tables.face_element[face]) > 0)) continue;
    if (behind != kNone && editor.kept(tables.face_element[behind]) > 0) continue;
    for (const auto& rows : tables.pieces[face]) {
      const auto corner = [&](std::size_t c) { return view::load3<double>(m.rest.data(), rows[c]); };
      out.push_back({corner(0), corner(1), corner(2)});
    }
  }
  return out;
}

/// The first triangle that a ray meets.
struct Hit {
  double at_m = std::numeric_limits<double>::infinity();  ///< distance; infinite: the ray meets no triangle
  bool front = true;                                      ///< false: the ray comes from behind the triangle
};

Hit first_hit(const Triangles& triangles, const Vec3<double>& from, const Vec3<double>& along) {
  Hit out;
  for (const auto& x : triangles) {
    const Vec3<double> normal = (x[1] - x[0]).cross(x[2] - x[0]);
    const double facing = normal.dot(along);
    if (facing == 0) continue;
    const double at_m = normal.dot(x[0] - from) / facing;
    if (!(at_m > 0)) continue;
    const Vec3<double> point = from + at_m * along;
    bool inside = true;
    for (std::size_t c = 0; c < 3; ++c) inside = inside && normal.dot((x[(c + 1) % 3] - x[c]).cross(point - x[c])) >= 0;
    // The front one of two that lie on each other is drawn.
    const double rounding_m = 1e-9;
    if (!inside || at_m > out.at_m + rounding_m || (at_m > out.at_m - rounding_m && facing > 0)) continue;
    out = {at_m, facing < 0};
  }
  return out;
}

class EditedSkins : public tests::OnBackend {
 protected:
  model::Model compile(const v1::Scene& scene) const {
    model::PatchPolicy policy = backend_->patch_policy(2);
    policy.max_patches = 3;
    policy.min_nodes_per_patch = 1;
    auto model = model::compile(scene, policy);
    if (!model) throw std::runtime_error(model.error().message);
    return std::move(*model);
  }
};
TM_ON_EACH_BACKEND(EditedSkins);

/// Fails unless live triangles have material below and behind each vertex, and dead ones are near elements that went.
void expect_torn_where_it_burns(const model::Model& m, const model::Editor& editor) {
  const model::BodySurface& surface = editor.surfaces()[0];
  const model::EditTables& tables = *m.edit_tables;
  const std::vector<Vec3<double>> points = points_of(m);
  std::vector<std::pair<Triangles::value_type, std::uint32_t>> faces;  // the boundary, with elements
  for (std::uint32_t face = 0; face < tables.face_element.size(); ++face) {
    if (tables.face_behind[face] != kNone) continue;
    for (const auto& rows : tables.pieces[face]) {
      const auto corner = [&](std::size_t c) { return view::load3<double>(m.rest.data(), rows[c]); };
      faces.push_back({{corner(0), corner(1), corner(2)}, tables.face_element[face]});
    }
  }
  for (std::uint32_t t = 0; t < m.bodies[0].triangles.size(); ++t) {
    Eigen::AlignedBox3d box;
    Vec3<double> middle = Vec3<double>::Zero();
    for (const std::uint32_t v : m.bodies[0].triangles[t]) {
      box.extend(points[v]);
      middle += points[v] / 3;
      for (std::size_t i = 4 * std::size_t{v}; !is_dead(surface, t) && i < 4 * std::size_t{v} + 4; ++i) {
        if (m.visible.weights[i] == 0) continue;
        const auto around = tables.corners[m.visible.rows[i]];
        EXPECT_TRUE(std::any_of(around.begin(), around.end(), [&](const auto& one) {
          return editor.kept(one.item) > 0;
        })) << "a vertex hangs on a row without material";
      }
    }
    if (!is_dead(surface, t)) {
      if (t % 4 != 0) continue;  // slow
      // At least one of the faces nearest to its middle is left.
      double nearest_m = std::numeric_limits<double>::infinity(), left_m = nearest_m;
      for (const auto& [x, element] : faces) {
        const double away_m = (mesh::nearest_on_triangle(middle, x[0], x[1], x[2]) - middle).norm();
        nearest_m = std::min(nearest_m, away_m);
        if (editor.kept(element) > 0) left_m = std::min(left_m, away_m);
      }
      EXPECT_LT(left_m, nearest_m + 1e-9) << "triangle " << t << " covers what is gone";
      continue;
    }
    bool burns = false;
    for (std::uint32_t e = 0; e < m.bodies[0].element_count && !burns; ++e) {
      if (editor.kept(e) > 0) continue;
      Eigen::AlignedBox3d of_element;
      for (const std::uint32_t row : tables.rows[e]) of_element.extend(view::load3<double>(m.rest.data(), row));
      burns =
          of_element.squaredExteriorDistance(box.center()) < 0.01 * 0.01 ||
          of_element.intersection(Eigen::AlignedBox3d(box.min().array() - 0.005, box.max().array() + 0.005)).volume() >
              0;
    }
    EXPECT_TRUE(burns) << "triangle " << t << " died far from what burnt";
  }
}

/// Fails unless the triangles that stand for the body where tools are looked for are closed.
void expect_closed(const model::Model& m, const model::Editor& editor) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> edges;
  editor.for_each_enclosing_triangle(m, 0, [&](const mesh::Triangle& of) {
    for (std::size_t c = 0; c < 3; ++c) {
      ++edges[{of[c], of[(c + 1) % 3]}];
      --edges[{of[(c + 1) % 3], of[c]}];
    }
  });
  EXPECT_GT(edges.size(), 30u);
  for (const auto& [edge, count] : edges) EXPECT_EQ(count, 0) << edge.first << " " << edge.second;
}

TEST_P(EditedSkins, TearWithTheElementsThatTheyHangOn) {
  for (const Skinned& of : skins()) {
    SCOPED_TRACE(testing::PrintToString(of));
    model::Model m = compile(skinned_beam(of));
    const model::VisibleSurface loaded = m.visible;
    auto state = backend_->create(m);
    ASSERT_TRUE(state);
    model::Editor editor(m);
    Craters craters(of.skin_cells);
    model::BodySurface before;
    int done = 0;
    for (int round = 0; round < 6; ++round) {
      const std::vector<Ablation> edit = craters.next(m, editor);
      if (!editor.check(m, edit)) continue;
      (*state)->apply(editor.ablate(m, edit));
      ++done;
      expect_torn_where_it_burns(m, editor);
      expect_closed(m, editor);
      // Readers may lag behind, so nothing is numbered anew.
      const model::BodySurface& surface = editor.surfaces()[0];
      ASSERT_LE(before.appended_triangles.size(), surface.appended_triangles.size());
      ASSERT_LE(before.appended_vertices.size(), surface.appended_vertices.size());
      EXPECT_EQ(surface.appended_kinds.size(), surface.appended_triangles.size());
      EXPECT_TRUE(std::equal(before.appended_triangles.begin(), before.appended_triangles.end(),
                             surface.appended_triangles.begin()));
      EXPECT_TRUE(std::equal(before.appended_vertices.begin(), before.appended_vertices.end(),
                             surface.appended_vertices.begin()));
      EXPECT_TRUE(std::includes(surface.dead_triangles.begin(), surface.dead_triangles.end(),
                                before.dead_triangles.begin(), before.dead_triangles.end()));
      before = surface;
    }
    EXPECT_GE(done, 2);
    EXPECT_GT(before.dead_triangles.size(), 0u);
    auto bound = backend_->create(m);
    ASSERT_TRUE(bound);
    const auto a = (*state)->read_constants(), b = (*bound)->read_constants();
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) EXPECT_TRUE(a[i].bytes == b[i].bytes) << a[i].name;
    // The same edits after a reset tear the same way.
    const model::Editor::Shares shares = editor.shares();
    editor.heal(m, [&](const model::ModelEdit& edit) { (*state)->apply(edit); });
    EXPECT_TRUE(editor.surfaces()[0].dead_triangles.empty());
    EXPECT_TRUE(editor.surfaces()[0].appended_triangles.empty());
    EXPECT_EQ(m.visible.rows, loaded.rows);
    EXPECT_EQ(m.visible.weights, loaded.weights);
    editor.take(m, shares, [](const model::ModelEdit&) {});
    EXPECT_EQ(editor.surfaces()[0].dead_triangles, before.dead_triangles);
    EXPECT_EQ(editor.surfaces()[0].appended_triangles, before.appended_triangles);
  }
}

/// Rays from all sides meet the front of the surface, and not below the boundary: there is no crack to look through.
TEST_P(EditedSkins, HaveNoCracks) {
  for (const Skinned& of : skins()) {
    if (of.scale < 1) continue;  // pieces that are shown lie above the skin, and a ray may meet them from below
    SCOPED_TRACE(testing::PrintToString(of));
    model::Model m = compile(skinned_beam(of));
    model::Editor editor(m);
    Craters craters(7 + of.skin_cells);
    std::mt19937 random(5);
    std::normal_distribution<double> normal;
    std::uniform_real_distribution<double> share(0, 1);
    int hits = 0, torn = 0;
    for (int round = 0; round < 4; ++round) {
      const std::vector<Ablation> edit = craters.next(m, editor);
      if (editor.check(m, edit)) editor.ablate(m, edit);
      const Triangles visible = visible_of(m, editor.surfaces()[0]), boundary = boundary_of(m, editor);
      torn += static_cast<int>(editor.surfaces()[0].dead_triangles.size());
      int cracks = 0;
      for (int i = 0; i < 300; ++i) {
        const Vec3<double> to = kSizeM.cwiseProduct(Vec3<double>(share(random), share(random), share(random)));
        const Vec3<double> along = Vec3<double>(normal(random), normal(random), normal(random)).normalized();
        const Vec3<double> from = to - along;
        const Hit seen = first_hit(visible, from, along), solid = first_hit(boundary, from, along);
        cracks += !seen.front || seen.at_m > solid.at_m + 1e-9;
        hits += solid.at_m < 10;
      }
      EXPECT_EQ(cracks, 0) << "round " << round;
    }
    EXPECT_GT(hits, 800);
    EXPECT_GT(torn, 3);
  }
}

/// What a check counts is what an edit appends, so that it fits exactly.
TEST_P(EditedSkins, RoomIsCountedToTheLastTriangle) {
  for (const std::uint32_t skin_cells : {1u, 5u}) {
    v1::Scene scene = skinned_beam({.skin_cells = skin_cells});
    std::vector<std::vector<Ablation>> edits;
    std::size_t triangles = 0, vertices = 0;
    {
      model::Model m = compile(scene);
      model::Editor editor(m);
      Craters craters(3);
      for (std::size_t torn = 0; edits.size() < 2 || torn == 0;) {  // the last edit tears the skin
        ASSERT_LT(edits.size(), 8u);
        std::vector<Ablation> edit = craters.next(m, editor);
        if (!editor.check(m, edit)) continue;
        const auto dead = [&] {
          const std::vector<std::uint32_t>& all = editor.surfaces()[0].dead_triangles;
          return static_cast<std::size_t>(std::lower_bound(all.begin(), all.end(), m.bodies[0].triangles.size()) -
                                          all.begin());
        };
        const std::size_t before = dead();
        editor.ablate(m, edit);
        torn = dead() - before;
        edits.push_back(std::move(edit));
      }
      triangles = editor.surfaces()[0].appended_triangles.size();
      vertices = editor.surfaces()[0].appended_vertices.size();
      ASSERT_GT(triangles, 50u);
    }
    for (const int less : {0, 1, 2}) {  // nothing, one triangle, one vertex
      scene.mutable_editing()->set_max_new_triangles(static_cast<std::uint32_t>(triangles - (less == 1)));
      scene.mutable_editing()->set_max_new_vertices(static_cast<std::uint32_t>(vertices - (less == 2)));
      model::Model m = compile(scene);
      model::Editor editor(m);
      for (std::size_t i = 0; i + 1 < edits.size(); ++i) {
        ASSERT_TRUE(editor.check(m, edits[i]));
        editor.ablate(m, edits[i]);
      }
      const Result<void> last = editor.check(m, edits.back());
      EXPECT_EQ(last.has_value(), less == 0);
      if (last) {
        editor.ablate(m, edits.back());
      } else {
        const std::string name = less == 1 ? "max_new_triangles" : "max_new_vertices";
        EXPECT_NE(last.error().message.find(name), std::string::npos) << last.error().message;
      }
    }
  }
}

/// Clients see a skin; the tissue does not know of it.
TEST_P(EditedSkins, MoveNothing) {
  const auto run = [&](bool has_skin) {
    v1::Scene scene = skinned_beam({});
    if (!has_skin) scene.mutable_bodies(0)->clear_skin();
    const std::unique_ptr<World> world = start(scene);
    std::vector<double> out;
    tests::RandomEdits random(9);
    for (int i = 0; i < 12; ++i) {
      world->set_tool_target(0, {{0.15, 0.11 - 0.0005 * i, 0.05}, {1, 0, 0, 0}});
      if (i == 4 || i == 8) {
        EXPECT_TRUE(world->edit(random.next(*world->editor(), world->model().bodies[0].element_count, 5), {}));
      }
      EXPECT_TRUE(world->step(true));
      const std::vector<double> u = world->state().displacement;
      out.insert(out.end(), u.begin(), u.end());
    }
    return out;
  };
  EXPECT_EQ(run(true), run(false));
}

/// Tools are inside tissue where elements are left, whatever became of the skin.
TEST_P(EditedSkins, EncloseWhatIsLeft) {
  for (const std::uint32_t skin_cells : {3u, 8u}) {
    v1::Scene scene = skinned_beam({.shape = v1::SHAPE_HEXAHEDRON, .cells = 4, .skin_cells = skin_cells});
    scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
    scene.mutable_stepping()->set_dt_s(0.01);
    const std::unique_ptr<World> world = start(scene);
    const model::Model& m = world->model();
    Enclosure enclosure(m);
    ASSERT_FALSE(enclosure.empty());
    Craters craters(11);
    std::mt19937 random(2);
    std::uniform_real_distribution<double> share(-0.2, 1.2), below(-1, 1.2);
    int inside = 0, outside = 0;
    for (int round = 0; round < 5; ++round) {
      std::vector<Ablation> edit = craters.next(m, *world->editor());
      if (round == 1 || round == 2) {  // a hole above a cave: faces that are shown lie below the skin between them
        edit.clear();
        const Eigen::AlignedBox3d cave(Vec3<double>(0.05, 0, 0), Vec3<double>(0.15, 0.09, 0.05));
        const Eigen::AlignedBox3d hole(Vec3<double>(0.1, 0.04, 0.075), Vec3<double>(0.12, 0.06, 0.1));
        for (std::uint32_t e = 0; e < m.bodies[0].element_count; ++e) {
          if ((round == 1 ? cave : hole).contains(middle_of(m, e))) edit.push_back({e, 0});
        }
        ASSERT_FALSE(edit.empty());
      }
      if (round > 0 && !world->edit(edit, {})) continue;
      if (round > 0) enclosure.take(m, *world->editor());
      world->gather_visible();
      enclosure.update(world->visible_positions());
      for (int i = 0; i < 1500; ++i) {  // rays go up
        const Vec3<double> at = kSizeM.cwiseProduct(Vec3<double>(share(random), share(random), below(random)));
        // Cells are boxes. Points near their walls may be on either side of a skin.
        int walls = 0;
        bool is_left = false;
        for (std::uint32_t e = 0; e < m.bodies[0].element_count; ++e) {
          Eigen::AlignedBox3d cell;
          for (const std::uint32_t row : m.edit_tables->rows[e]) cell.extend(view::load3<double>(m.rest.data(), row));
          const double apart_m = 0.012;
          const Eigen::AlignedBox3d wide(cell.min().array() - apart_m, cell.max().array() + apart_m);
          const bool is_here = world->editor()->kept(e) > 0;
          is_left = is_left || (is_here && cell.contains(at));
          walls |= wide.contains(at) ? (is_here ? 1 : 2) : 0;
        }
        const bool near_outside = ((at.array() < 0.012) || (at.array() > kSizeM.array() - 0.012)).any();
        if (walls == 3 || (walls == 1 && near_outside)) continue;
        EXPECT_EQ(!enclosure.is_outside(m.tools[0], {at, {1, 0, 0, 0}, {}}), is_left)
            << round << ": " << at.transpose();
        (is_left ? inside : outside) += 1;
      }
    }
    EXPECT_GT(inside, 50);
    EXPECT_GT(outside, 50);
  }
}

/// A hole inside of a body kills no triangle of the skin; a reset takes back what came to light in it all the same.
TEST_P(EditedSkins, AHoleInsideHeals) {
  const std::unique_ptr<World> world = start(skinned_beam({.shape = v1::SHAPE_HEXAHEDRON, .cells = 4}));
  const model::Model& m = world->model();
  std::uint32_t middle = 0;
  for (std::uint32_t e = 0; e < m.bodies[0].element_count; ++e) {
    if ((middle_of(m, e) - kSizeM / 2).norm() < (middle_of(m, middle) - kSizeM / 2).norm()) middle = e;
  }
  ASSERT_TRUE(world->edit(std::vector<Ablation>{{middle, 0}}, {}));
  EXPECT_TRUE(world->editor()->surfaces()[0].dead_triangles.empty());
  EXPECT_EQ(world->editor()->surfaces()[0].appended_triangles.size(), 12u);
  world->reset();
  EXPECT_TRUE(world->editor()->surfaces()[0].appended_triangles.empty());
  EXPECT_EQ(m.visible.appended_count, 0u);
}

}  // namespace
}  // namespace tensormass::world
