#include "model/compile_parts.h"

#include <stdexcept>
#include <string>
#include <utility>

#include <gtest/gtest.h>

#include "model/clusters.h"
#include "support/scenes.h"

/// A part of a model is made again alone, from what was read once: for another cut into patches, and with new moduli.
namespace tensormass::model {
namespace {

template <class T>
T value_of(Result<T> result) {
  if (!result) throw std::runtime_error(result.error().message);
  return std::move(*result);
}

/// Two blocks that touch and are attached to each other, one with a linear law, the other of tetrahedra in clusters.
v1::Scene scene_with_all_parts(double young_modulus_pa = 5e3) {
  v1::Scene scene = tests::hanging_block();
  v1::Body& hanging = *scene.mutable_bodies(1);
  hanging.mutable_mesh()->mutable_grid()->set_shape(v1::SHAPE_TETRAHEDRON);
  hanging.set_quadrature(v1::QUADRATURE_SELECTIVE);
  v1::IsotropicElastic& law = *scene.mutable_bodies(0)->mutable_law()->mutable_hooke();
  law.set_young_modulus_pa(young_modulus_pa);
  law.set_poisson_ratio(0.4);
  hanging.mutable_law()->mutable_st_venant_kirchhoff()->set_young_modulus_pa(young_modulus_pa);
  v1::BodyContact& contact = *scene.add_body_contacts();
  contact.set_body(scene.bodies(0).name());
  contact.set_other(hanging.name());
  return scene;
}

/// What compile() reads of a scene.
struct Read {
  v1::Scene scene;
  Settings settings = value_of(read_settings(scene));
  ReadBodies bodies = value_of(read_bodies(scene, {}));
  BodyBoundaries boundaries{bodies.bodies};
  ReadLinks links = value_of(read_links(scene, bodies, boundaries));
  std::vector<Damping> damping = value_of(read_damping(scene));
  Clusters clusters = make_clusters(bodies.bodies);

  explicit Read(v1::Scene of) : scene(std::move(of)) {}
};

PatchPolicy policy_of(std::uint32_t patches, matrix::Storage storage) {
  return {.max_patches = patches, .min_nodes_per_patch = 1, .storage = storage};
}

const char* name_of(matrix::Storage storage) {
  if (storage == matrix::Storage::kRows) return "Rows";
  return storage == matrix::Storage::kTiles ? "Tiles" : "Edges";
}

void expect_equal_groups(const std::vector<ElementGroup>& made, const std::vector<ElementGroup>& compiled) {
  ASSERT_EQ(made.size(), compiled.size());
  for (std::size_t g = 0; g < made.size(); ++g) {
    EXPECT_EQ(made[g].elements, compiled[g].elements);
    EXPECT_EQ(made[g].members, compiled[g].members);
    EXPECT_EQ(made[g].member_parts, compiled[g].member_parts);
    EXPECT_EQ(made[g].rows, compiled[g].rows);
    EXPECT_EQ(made[g].rest, compiled[g].rest);
    EXPECT_EQ(made[g].parameters, compiled[g].parameters);
    EXPECT_EQ(made[g].patch_elements, compiled[g].patch_elements);
    EXPECT_EQ(made[g].pair_places, compiled[g].pair_places);
  }
}

void expect_equal_rows(const matrix::Layout& made, const matrix::Layout& compiled) {
  EXPECT_EQ(made.row_of_node, compiled.row_of_node);
  EXPECT_EQ(made.patch_rows, compiled.patch_rows);
  EXPECT_EQ(made.slice_begin, compiled.slice_begin);
  EXPECT_EQ(made.columns, compiled.columns);
}

class CompileParts : public testing::TestWithParam<PatchPolicy> {};

TEST_P(CompileParts, AreMadeAgainForAnotherCutIntoPatches) {
  Read read(scene_with_all_parts());
  static_cast<void>(make_layout(read.bodies.merged, read.clusters.clusters, policy_of(5, matrix::Storage::kRows)));
  const Model model = value_of(compile(read.scene, GetParam()));
  ASSERT_GT(model.layout.patch_count, 1u);

  const matrix::Layout layout = make_layout(read.bodies.merged, read.clusters.clusters, GetParam());
  expect_equal_rows(layout, model.layout);

  RowFields fields = make_row_fields(read.bodies, read.damping, read.links, read.settings, layout);
  const BoundaryConditions boundary =
      value_of(make_boundary_conditions(read.scene, read.bodies, read.settings, layout, fields.row_mass));
  hold_directions(boundary.held, fields.rest);
  EXPECT_EQ(fields.rest, model.rest);
  EXPECT_EQ(fields.inertia, model.inertia);
  EXPECT_EQ(boundary.external, model.external);
  EXPECT_EQ(boundary.fixed_node_count, (std::vector<std::uint32_t>{model.bodies[0].fixed_node_count, 0}));

  const GroupedElements elements = value_of(group_elements(read.bodies, read.clusters.clusters, layout));
  expect_equal_groups(elements.groups, model.groups);
  EXPECT_FALSE(elements.constant_edges.empty());
  EXPECT_EQ(elements.constant_edges, model.constant_edges);
  EXPECT_EQ(value_of(list_elements_of_rows(model, layout, elements)).begun_slices, model.begun_slices);

  const ContactSurface contact = make_contact_surface(read.bodies, layout);
  EXPECT_EQ(contact.triangle_rows, model.contact.triangle_rows);
  EXPECT_EQ(contact.incidence, model.contact.incidence);
  const Links links = make_links(
      {.bodies = read.bodies, .links = read.links, .layout = layout, .contact = contact, .tools = model.tools});
  EXPECT_EQ(links.rows, model.links.rows);
  EXPECT_EQ(links.candidates, model.links.candidates);
  EXPECT_EQ(links.spring_rows, model.links.spring_rows);
  const FreeBodies free = find_free_bodies({.bodies = read.bodies,
                                            .layout = layout,
                                            .rest = fields.rest,
                                            .prescribed_rows = boundary.prescribed_rows,
                                            .pressure = boundary.pressure,
                                            .contacts = {},
                                            .spring_rows = {}});
  EXPECT_EQ(free.count(), 1u) << "the block that hangs";
  EXPECT_EQ(free.row_body, model.free_bodies.row_body);

  const VisibleBodies visible = value_of(make_visible_surface(read.scene, read.bodies, read.boundaries, layout));
  const VisibleSprings springs = make_visible_springs(read.links.attachments, layout);
  std::vector<std::uint32_t> rows = visible.surface.rows;
  rows.insert(rows.end(), springs.rows.begin(), springs.rows.end());
  EXPECT_EQ(rows, model.visible.rows);
  EXPECT_EQ(springs.attachments.size(), 2u);
}

/// A slider changes values, so neither clusters nor the layout nor a surface are made again.
TEST_P(CompileParts, NewModuliNeedNewGroupsOnly) {
  const Read first(scene_with_all_parts());
  const Read stiffer(scene_with_all_parts(2e4));
  const Model model = value_of(compile(stiffer.scene, GetParam()));
  const matrix::Layout layout = make_layout(first.bodies.merged, first.clusters.clusters, GetParam());
  const GroupedElements before = value_of(group_elements(first.bodies, first.clusters.clusters, layout));
  const GroupedElements elements = value_of(group_elements(stiffer.bodies, first.clusters.clusters, layout));
  expect_equal_rows(layout, model.layout);
  expect_equal_groups(elements.groups, model.groups);
  EXPECT_EQ(elements.constant_edges, model.constant_edges);
  EXPECT_NE(elements.constant_edges, before.constant_edges);
  EXPECT_EQ(value_of(list_elements_of_rows(model, layout, before)).begun_slices, model.begun_slices);
  EXPECT_EQ(make_contact_surface(first.bodies, layout).triangle_rows, model.contact.triangle_rows);
}

INSTANTIATE_TEST_SUITE_P(Storages, CompileParts,
                         testing::Values(policy_of(3, matrix::Storage::kRows), policy_of(3, matrix::Storage::kTiles),
                                         policy_of(2, matrix::Storage::kEdges)),
                         [](const auto& of) { return std::string(name_of(of.param.storage)); });

}  // namespace
}  // namespace tensormass::model
