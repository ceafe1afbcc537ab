#include "step/plan.h"

#include <algorithm>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "model/compile.h"
#include "support/laws.h"
#include "support/scenes.h"
#include "support/strands.h"

/// A scene has only the stages and buffers that it needs.
namespace tensormass::step {
namespace {

constexpr MachineRates kMachine{.bytes_per_s = 1e10, .operations_per_s = 1e10};

v1::SceneReport plan(const v1::Scene& scene) {
  const auto model = model::compile(scene, {2, 1});
  if (!model) throw std::runtime_error(model.error().message);
  return make_report(*model, kMachine);
}

std::vector<std::string> stages(const v1::SceneReport& report) {
  std::vector<std::string> names;
  for (const v1::PlanStage& stage : report.stages()) names.push_back(stage.name());
  return names;
}

bool has_buffer(const v1::SceneReport& report, const std::string& part) {
  return std::any_of(report.buffers().begin(), report.buffers().end(),
                     [&](const v1::PlanBuffer& buffer) { return buffer.name().find(part) != std::string::npos; });
}

bool says_not_modelled(const v1::SceneReport& report, const std::string& part) {
  return std::any_of(report.not_modelled().begin(), report.not_modelled().end(),
                     [&](const std::string& line) { return line.find(part) != std::string::npos; });
}

const std::vector<std::string> kContactBuffers{"contact", "tool"};

TEST(Plan, OfAFullSceneIsTheWholeStepInOrder) {
  const v1::SceneReport report = plan(tests::block_with_probe());
  EXPECT_EQ(
      stages(report),
      (std::vector<std::string>{
          "closest-point query", "contact generation", "element tensors: tetrahedron, st_venant_kirchhoff",
          "measure row errors", "assemble contact", "coarse level", "factorize diagonal", "scale matrix",
          "conjugate gradients", "advance", "measure contact", "check inversion: tetrahedron, st_venant_kirchhoff",
          "diagnostics: tetrahedron, st_venant_kirchhoff", "gather surface"}));
  for (const std::string& part : kContactBuffers) EXPECT_TRUE(has_buffer(report, part)) << part;
  EXPECT_TRUE(has_buffer(report, "visible"));
  EXPECT_TRUE(has_buffer(report, "external"));
  EXPECT_FALSE(says_not_modelled(report, "contact with tools"));
}

TEST(Plan, WithoutToolsHasNoContactStageAndNoContactBuffer) {
  v1::Scene scene = tests::block_with_probe();
  scene.clear_tools();
  const v1::SceneReport report = plan(scene);
  EXPECT_EQ(stages(report),
            (std::vector<std::string>{"element tensors: tetrahedron, st_venant_kirchhoff", "measure row errors",
                                      "coarse level", "factorize diagonal", "scale matrix", "conjugate gradients",
                                      "advance", "check inversion: tetrahedron, st_venant_kirchhoff",
                                      "diagnostics: tetrahedron, st_venant_kirchhoff", "gather surface"}));
  for (const std::string& part : kContactBuffers) EXPECT_FALSE(has_buffer(report, part)) << part;
  EXPECT_TRUE(says_not_modelled(report, "contact with tools"));
}

TEST(Plan, SaysWhatASceneThatIsCutLacks) {
  v1::Scene scene = tests::block_with_probe();
  EXPECT_TRUE(says_not_modelled(plan(scene), "plasticity, cutting"));
  scene.mutable_editing();
  EXPECT_TRUE(says_not_modelled(plan(scene), "plasticity, cutting"));
  scene.mutable_editing()->mutable_cutting();
  EXPECT_FALSE(says_not_modelled(plan(scene), "plasticity, cutting"));
  EXPECT_TRUE(says_not_modelled(plan(scene), "contact of the flaps"));
}

TEST(Plan, WithoutGravityAndLoadsHasNoExternalForces) {
  v1::Scene scene = tests::beam_scene();
  scene.clear_gravity_m_per_s2();
  v1::SceneReport report = plan(scene);
  for (const std::string& stage : stages(report)) EXPECT_NE(stage, "external forces");
  EXPECT_FALSE(has_buffer(report, "external"));
  EXPECT_TRUE(says_not_modelled(report, "gravity and loads"));

  v1::Load& load = *scene.mutable_bodies(0)->add_loads();
  load.mutable_region()->mutable_nodes()->add_indices(0);
  tests::set(*load.mutable_force_n(), 1, 0, 0);
  report = plan(scene);
  EXPECT_TRUE(has_buffer(report, "external")) << "a load alone needs them";
  EXPECT_FALSE(says_not_modelled(report, "gravity and loads"));
}

TEST(Plan, SaysWherePressureHasNoStiffness) {
  v1::Scene scene = tests::beam_scene();
  v1::Load& load = *scene.mutable_bodies(0)->add_loads();
  tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), -9, -9, -9);
  tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 9, 9, 9);
  load.set_pressure_pa(100);
  EXPECT_FALSE(says_not_modelled(plan(scene), "stiffness of pressure")) << "the pressed surface is closed";
  load.mutable_region()->mutable_box()->mutable_max_m()->set_z(0);
  EXPECT_TRUE(says_not_modelled(plan(scene), "stiffness of pressure")) << "the face below has a free rim";
  EXPECT_FALSE(says_not_modelled(plan(tests::beam_scene()), "stiffness of pressure"));
}

TEST(Plan, WithoutFramesGathersNothing) {
  v1::Scene scene = tests::beam_scene();
  scene.mutable_streams()->set_frame_rate_hz(0);
  const v1::SceneReport report = plan(scene);
  EXPECT_FALSE(has_buffer(report, "visible"));
  EXPECT_TRUE(says_not_modelled(report, "frames"));
}

TEST(Plan, OfALinearSceneRefreshesNoElement) {
  const v1::SceneReport report = plan(tests::beam_scene({.linear = true}));
  EXPECT_EQ(stages(report).front(), "finish rows");
  EXPECT_FALSE(has_buffer(report, "element lists"));
  EXPECT_TRUE(has_buffer(report, "constant edge tensors"));
}

TEST(Plan, ChecksTheVolumeOnlyOfLawsThatDoNotRecover) {
  for (const std::string& name : tests::law_names()) {
    v1::Scene scene = tests::beam_scene();
    *scene.mutable_bodies(0)->mutable_law() = tests::law(name, 1e4, 0.3);
    const v1::SceneReport report = plan(scene);
    const std::vector<std::string> names = stages(report);
    const bool checks = name != "hooke" && name != "corotational" && name != "stable_neo_hookean";
    EXPECT_EQ(std::count(names.begin(), names.end(), "check inversion: tetrahedron, " + name), checks ? 1 : 0) << name;
    EXPECT_EQ(has_buffer(report, "volume check"), checks) << name;
  }
}

TEST(Plan, NamesClusters) {
  v1::Scene scene = tests::beam_scene();
  scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(v1::SHAPE_WEDGE);
  scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
  const std::vector<std::string> names = stages(plan(scene));
  EXPECT_EQ(names[0], "element tensors: wedge, st_venant_kirchhoff");
  EXPECT_EQ(names[1], "element tensors: clusters, st_venant_kirchhoff");
}

TEST(Plan, OfANonLinearSceneStoresNoConstantTensors) {
  const v1::SceneReport report = plan(tests::beam_scene());
  EXPECT_FALSE(has_buffer(report, "constant"));
  EXPECT_TRUE(has_buffer(report, "element lists"));
}

TEST(Plan, StartsAMatrixOfEdgesBeforeElementsAddToIt) {
  const v1::Scene scene = tests::beam_scene();
  const auto model = model::compile(scene, {2, 1, matrix::Storage::kEdges});
  ASSERT_TRUE(model);
  const v1::SceneReport report = make_report(*model, {});
  std::vector<std::string> names = stages(report);
  names.resize(4);
  EXPECT_EQ(names,
            (std::vector<std::string>{"assemble constant part", "element tensors: tetrahedron, st_venant_kirchhoff",
                                      "external forces", "factorize diagonal"}));
  EXPECT_FALSE(has_buffer(report, "element lists"));
  EXPECT_TRUE(has_buffer(report, "element places"));
}

/// A GPU's fused solves are stages: the plan shows what runs.
TEST(Plan, ShowsTheFusedSolveInPlaceOfItsParts) {
  const v1::Scene scene = tests::beam_scene();
  const auto names_with = [&](model::SolveKind solve) {
    model::PatchPolicy policy{.max_patches = 2, .min_nodes_per_patch = 1, .storage = matrix::Storage::kRows};
    policy.solve_of = [solve](const matrix::Layout&) { return solve; };
    const auto model = model::compile(scene, policy);
    if (!model) throw std::runtime_error(model.error().message);
    std::vector<std::string> names = stages(make_report(*model, kMachine));
    std::erase_if(names, [](const std::string& name) {
      return name.find("solve") == std::string::npos && name != "advance" && name != "factorize diagonal" &&
             name != "scale matrix" && name != "conjugate gradients";
    });
    return names;
  };
  using Names = std::vector<std::string>;
  EXPECT_EQ(names_with(model::SolveKind::kStages),
            (Names{"factorize diagonal", "scale matrix", "conjugate gradients", "advance"}));
  EXPECT_EQ(names_with(model::SolveKind::kResident),
            (Names{"resident solve: factorize, scale, conjugate gradients, advance"}));
  EXPECT_EQ(names_with(model::SolveKind::kStreamed),
            (Names{"factorize diagonal", "streamed solve: scale, pack, conjugate gradients, advance"}));
}

/// Links have blocks of their own in the resident solve. The streamed one knows none, so stages solve instead.
TEST(Plan, ShowsAFusedSolveOfLinksOnlyIfItIsResident) {
  const v1::Scene scene = tests::strung_blocks(false, false);
  const auto solve_with = [&](model::SolveKind solve) {
    model::PatchPolicy policy{.max_patches = 2, .min_nodes_per_patch = 1, .storage = matrix::Storage::kRows};
    policy.solve_of = [solve](const matrix::Layout&) { return solve; };
    const auto model = model::compile(scene, policy);
    if (!model) throw std::runtime_error(model.error().message);
    return model->solve;
  };
  EXPECT_EQ(solve_with(model::SolveKind::kResident), model::SolveKind::kResident);
  EXPECT_EQ(solve_with(model::SolveKind::kStreamed), model::SolveKind::kStages);
  EXPECT_EQ(solve_with(model::SolveKind::kStages), model::SolveKind::kStages);
}

TEST(Plan, CountsItsBytes) {
  const auto plan_of = [](bool double_precision) {
    v1::Scene scene = tests::block_with_probe(double_precision);
    scene.mutable_solver()->set_coarse_level(false);  // it sums in doubles, whatever the precision
    return plan(scene);
  };
  const v1::SceneReport report = plan_of(false);
  std::uint64_t bytes = 0;
  for (const v1::PlanBuffer& buffer : report.buffers()) {
    EXPECT_GT(buffer.bytes(), 0u) << buffer.name();
    bytes += buffer.bytes();
  }
  EXPECT_EQ(report.bytes_total(), bytes);
  EXPECT_GT(report.expected_rate_hz(), 0);

  const v1::SceneReport precise = plan_of(true);
  EXPECT_GT(precise.bytes_total(), 1.5 * static_cast<double>(bytes)) << "double precision";
  EXPECT_LT(precise.bytes_total(), 2 * bytes) << "indices stay as they are";
}

TEST(Plan, SaysWhatEachStageReadsAndWrites) {
  const v1::SceneReport report = plan(tests::block_with_probe());
  for (const v1::PlanStage& stage : report.stages()) {
    EXPECT_FALSE(stage.reads().empty()) << stage.name();
    EXPECT_FALSE(stage.writes().empty()) << stage.name();
    EXPECT_GT(stage.bytes(), 0u) << stage.name();
    EXPECT_GT(stage.operations(), 0u) << stage.name();
  }
}

TEST(Plan, NamesDampingOnlyWhereThereIsNone) {
  v1::Scene scene = tests::beam_scene();
  EXPECT_TRUE(says_not_modelled(plan(scene), "Rayleigh"));
  scene.mutable_bodies(0)->set_rayleigh_stiffness_s(0.01);
  EXPECT_FALSE(says_not_modelled(plan(scene), "Rayleigh"));
}

TEST(Plan, ReportsTheBodies) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  const v1::SceneReport report = plan(scene);
  ASSERT_EQ(report.bodies_size(), 1);
  const v1::BodyReport& body = report.bodies(0);
  EXPECT_EQ(body.node_count(), 5u * 3 * 5);
  EXPECT_EQ(body.element_count(), 6u * 4 * 2 * 4);
  EXPECT_EQ(body.fixed_node_count(), 25u);
  EXPECT_EQ(body.component_count(), 1u);
  EXPECT_NEAR(body.volume_m3(), 5e-4, 1e-12);
  EXPECT_NEAR(body.mass_kg(), 0.5, 1e-9);
  EXPECT_EQ(body.surface_triangle_count(), 2u * (2 * 16 + 4 * 8));
}

}  // namespace
}  // namespace tensormass::step
