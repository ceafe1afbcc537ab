#include <cmath>
#include <cstring>
#include <functional>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "core/finding_kinds.h"
#include "core/limits.h"
#include "model/compile.h"
#include "support/findings.h"
#include "support/laws.h"
#include "support/scenes.h"
#include "support/solids.h"

/// Each finding of the load has a scene that shows it, and one just below its threshold that does not.
namespace tensormass::model {
namespace {

std::vector<Finding> find(const v1::Scene& scene, FindingCode code) {
  const Result<Model> model = compile(scene, {});
  EXPECT_TRUE(model) << model.error().message;
  std::vector<Finding> out;
  if (!model) return out;
  for (const Finding& finding : model->findings) {
    if (finding.code == code) out.push_back(finding);
  }
  return out;
}

/// Expects one finding, beyond its limit and with names, place, message and remedy. Returns it.
Finding expect_one(const v1::Scene& scene, FindingCode code, const std::string& place) {
  const std::vector<Finding> found = find(scene, code);
  EXPECT_EQ(found.size(), 1u) << kind_of(code).name;
  if (found.empty()) return {};
  EXPECT_GT(found[0].value, found[0].limit);
  EXPECT_EQ(found[0].place, place);
  EXPECT_FALSE(found[0].message.empty());
  EXPECT_FALSE(found[0].remedy.empty());
  EXPECT_TRUE(found[0].accepted.empty());
  return found[0];
}

v1::Scene block(std::uint32_t cells = 4) {
  v1::Scene scene = tests::beam_scene({.cells_x = cells,
                                       .cells_y = cells,
                                       .cells_z = cells,
                                       .size_x_m = 0.1,
                                       .size_y_m = 0.1,
                                       .size_z_m = 0.1,
                                       .frame_rate_hz = 60});
  *scene.mutable_bodies(0)->mutable_law() = tests::law("stable_neo_hookean", 5e3, 0.4);
  return scene;
}

TEST(Mistakes, NoneInAnOrdinaryScene) {
  v1::Scene scene = block(10);
  tests::add_probe(scene, "probe", 0.01, 0.05, 0.12, 0.05);
  EXPECT_TRUE(compile(scene, {}).value().findings.empty());
}

TEST(Mistakes, AMeshInMillimetres) {
  v1::Scene scene = block();
  v1::Mesh& mesh = *scene.mutable_bodies(0)->mutable_mesh();
  mesh.set_scale(50);
  EXPECT_TRUE(find(scene, FindingCode::kMeshUnit).empty());
  mesh.set_scale(50.1);
  const Finding found = expect_one(scene, FindingCode::kMeshUnit, "body 'beam'.mesh.scale");
  EXPECT_NEAR(found.value, 5.01, 1e-9);
  EXPECT_EQ(found.body, "beam");
  EXPECT_NE(found.text().find("5.01 × 5.01 × 5.01 m large and weighs 1.3e+05 kg"), std::string::npos) << found.text();
}

TEST(Mistakes, LinearElementsThatLock) {
  v1::Scene scene = block();
  v1::Body& body = *scene.mutable_bodies(0);
  v1::IsotropicElastic& law = *body.mutable_law()->mutable_stable_neo_hookean();
  law.set_poisson_ratio(thresholds::kLockingPoisson);
  EXPECT_TRUE(find(scene, FindingCode::kLocking).empty());
  law.set_poisson_ratio(thresholds::kLockingPoisson + 1e-3);
  const Finding found = expect_one(scene, FindingCode::kLocking, "body 'beam'.quadrature");
  EXPECT_NE(found.remedy.find("selective, or element_order: quadratic"), std::string::npos);

  body.set_quadrature(v1::QUADRATURE_SELECTIVE);
  EXPECT_TRUE(find(scene, FindingCode::kLocking).empty());
  body.clear_quadrature();
  body.set_element_order(v1::ELEMENT_ORDER_QUADRATIC);
  EXPECT_TRUE(find(scene, FindingCode::kLocking).empty());
  body.clear_element_order();
  body.mutable_mesh()->mutable_grid()->set_shape(v1::SHAPE_HEXAHEDRON);
  EXPECT_TRUE(find(scene, FindingCode::kLocking).empty()) << "hexahedra stand more";
  body.mutable_law()->mutable_stable_neo_hookean()->set_poisson_ratio(thresholds::kLockingPoissonOfOthers + 1e-4);
  EXPECT_EQ(expect_one(scene, FindingCode::kLocking, "body 'beam'.quadrature").remedy, "give it quadrature: selective");
}

/// A tenth of a body may lock: 38 of 384 elements may, 39 may not.
TEST(Mistakes, AFewElementsMayLock) {
  v1::Scene scene = block();
  for (const std::size_t count : {38u, 39u}) {
    std::vector<double> poisson(384, 0.4);
    std::fill_n(poisson.begin(), count, 0.499);
    scene.mutable_bodies(0)->mutable_element_fields()->set_poisson_ratio(poisson.data(),
                                                                         poisson.size() * sizeof(double));
    EXPECT_EQ(find(scene, FindingCode::kLocking).size(), count == 39 ? 1u : 0u);
  }
}

/// The probe's radius is 10 mm, and the block's top at y = 0.1 m.
TEST(Mistakes, AToolThatStartsInsideTissue) {
  const auto scene_with = [](double y_m) {
    v1::Scene scene = block();
    tests::add_probe(scene, "probe", 0.01, 0.05, y_m, 0.05);
    return scene;
  };
  EXPECT_TRUE(find(scene_with(0.1076), FindingCode::kToolInsideTissue).empty()) << "2.4 mm deep";
  Finding found = expect_one(scene_with(0.1074), FindingCode::kToolInsideTissue, "tool 'probe'.position_m");
  EXPECT_NEAR(found.value, 0.26, 1e-6);
  EXPECT_EQ(found.tool, "probe");
  EXPECT_EQ(found.body, "beam");
  EXPECT_NE(found.message.find("tissue of body 'beam' 2.6 mm inside it"), std::string::npos) << found.message;
  found = expect_one(scene_with(0.05), FindingCode::kToolInsideTissue, "tool 'probe'.position_m");
  EXPECT_EQ(found.value, 1) << "no surface is near";
  EXPECT_NE(found.message.find("starts inside body 'beam'"), std::string::npos) << found.message;
}

TEST(Mistakes, AToolThatTheInitialDisplacementPutsIntoTissue) {
  v1::Scene scene = block();
  scene.mutable_bodies(0)->clear_fixed();
  tests::add_probe(scene, "probe", 0.01, 0.05, 0.12, 0.05);
  EXPECT_TRUE(find(scene, FindingCode::kToolInsideTissue).empty());
  std::vector<double> up(3 * 125, 0);
  for (std::size_t node = 0; node < 125; ++node) up[3 * node + 1] = 0.04;
  scene.mutable_bodies(0)->set_initial_displacement_m(up.data(), up.size() * sizeof(double));
  expect_one(scene, FindingCode::kToolInsideTissue, "tool 'probe'.position_m");
}

/// A solid of 40 × 20 × 40 mm above the block: half of its thickness is 10 mm.
TEST(Mistakes, ASolidThatStartsInsideTissue) {
  for (const std::string& kind : {std::string("box"), std::string("mesh")}) {
    const auto scene_with = [&](double y_m) {
      v1::Scene scene = block();
      tests::add_solid(scene, kind, {0.04, 0.02, 0.04}, {0.05, y_m, 0.05}, 1e6);
      return scene;
    };
    EXPECT_TRUE(find(scene_with(0.1079), FindingCode::kToolInsideTissue).empty()) << kind;
    expect_one(scene_with(0.107), FindingCode::kToolInsideTissue, "tool 'solid'.position_m");
    expect_one(scene_with(0.05), FindingCode::kToolInsideTissue, "tool 'solid'.position_m");
  }
}

/// A block falls by 50 mm on a ball. It arrives with 0.990 m/s and moves by 10.9 mm in the step of 10 ms after that.
TEST(Mistakes, ABodyThatPassesATool) {
  const auto scene_with = [](double radius_m, const std::function<void(v1::Scene&)>& change = {}) {
    v1::Scene scene = block();
    scene.mutable_bodies(0)->clear_fixed();
    tests::add_probe(scene, "probe", radius_m, 0.05, -0.05 - radius_m, 0.05);
    if (change) change(scene);
    return scene;
  };
  EXPECT_TRUE(find(scene_with(0.0055), FindingCode::kBodyPassesTool).empty());
  const Finding found = expect_one(scene_with(0.0054), FindingCode::kBodyPassesTool, "scene.stepping.dt_s");
  EXPECT_NEAR(found.value, 1.008, 1e-3);
  EXPECT_EQ(found.tool, "probe");

  const auto passes = [&](const std::function<void(v1::Scene&)>& change) {
    return !find(scene_with(0.0054, change), FindingCode::kBodyPassesTool).empty();
  };
  EXPECT_FALSE(passes([](v1::Scene& scene) { scene.mutable_stepping()->set_dt_s(0.0095); }));
  EXPECT_FALSE(passes([](v1::Scene& scene) { scene.clear_gravity_m_per_s2(); }));
  EXPECT_FALSE(passes([](v1::Scene& scene) { tests::set(*scene.mutable_gravity_m_per_s2(), 0, 9.81, 0); }));
  EXPECT_FALSE(passes([](v1::Scene& scene) { scene.mutable_bodies(0)->set_rayleigh_mass_per_s(10.5); }))
      << "it falls with 0.93 m/s at most";
  EXPECT_FALSE(passes([](v1::Scene& scene) { scene.mutable_tools(0)->mutable_position_m()->set_x(0.2); }))
      << "it falls beside the ball";
  EXPECT_FALSE(passes([](v1::Scene& scene) { *scene.mutable_bodies(0) = block().bodies(0); })) << "it is fixed";
  EXPECT_TRUE(passes([](v1::Scene& scene) {
    scene.clear_gravity_m_per_s2();
    std::vector<double> down(3 * 125, 0);
    for (std::size_t node = 0; node < 125; ++node) down[3 * node + 1] = -1.2;
    scene.mutable_bodies(0)->set_initial_velocity_m_per_s(down.data(), down.size() * sizeof(double));
  })) << "it is thrown";
}

TEST(Mistakes, NothingPassesASolid) {
  for (const std::string& kind : tests::solid_kinds()) {
    v1::Scene scene = block();
    scene.mutable_bodies(0)->clear_fixed();
    tests::add_solid(scene, kind, {0.4, 0.02, 0.4}, {0.05, -2, 0.05}, 1e6);
    EXPECT_TRUE(find(scene, FindingCode::kBodyPassesTool).empty()) << kind;
  }
}

/// The block's triangles have the area of equilateral ones with an edge of 26.9 mm.
TEST(Mistakes, TrianglesLargerThanATool) {
  const auto scene_with = [](double radius_m) {
    v1::Scene scene = block();
    tests::add_probe(scene, "probe", radius_m, 0.05, 0.2, 0.05);
    return scene;
  };
  EXPECT_TRUE(find(scene_with(0.0207), FindingCode::kCoarseSurface).empty());
  const Finding found = expect_one(scene_with(0.0206), FindingCode::kCoarseSurface, "body 'beam'.mesh");
  EXPECT_EQ(found.tool, "probe");
  EXPECT_NEAR(found.value, 0.02687 / 0.0412, 1e-3);
}

/// A plate is as wide as its second largest size.
TEST(Mistakes, APlateIsNotAsWideAsThick) {
  for (const double width_m : {0.042, 0.041}) {
    v1::Scene scene = block();
    tests::add_solid(scene, "box", {0.2, 0.002, width_m}, {0.05, 0.2, 0.05}, 1e6);
    EXPECT_EQ(find(scene, FindingCode::kCoarseSurface).size(), width_m > 0.0415 ? 0u : 1u);
  }
}

TEST(Mistakes, ALawThatSoftensUnderATool) {
  for (const std::string& law : {std::string("st_venant_kirchhoff"), std::string("transversely_isotropic")}) {
    v1::Scene scene = block();
    *scene.mutable_bodies(0)->mutable_law() = tests::law(law, 5e3, 0.4);
    EXPECT_TRUE(find(scene, FindingCode::kSofteningLaw).empty()) << "there is no tool";
    tests::add_probe(scene, "probe", 0.02, 0.05, 0.2, 0.05).set_fixed(true);
    scene.mutable_tools(0)->clear_max_force_n();
    scene.mutable_tools(0)->clear_max_torque_n_m();
    EXPECT_TRUE(find(scene, FindingCode::kSofteningLaw).empty()) << "no hand moves it";
    scene.mutable_tools(0)->clear_fixed();
    EXPECT_EQ(expect_one(scene, FindingCode::kSofteningLaw, "body 'beam'.law").value, 0.577);
    *scene.mutable_bodies(0)->mutable_law() = tests::law("stable_neo_hookean", 5e3, 0.4);
    EXPECT_TRUE(find(scene, FindingCode::kSofteningLaw).empty());
  }
}

/// Two blocks without contact. The mean edge of their surfaces is 28.5 mm.
v1::Scene two_blocks(double y_m, bool with_skin = false) {
  v1::Scene scene = block();
  *scene.add_bodies() = scene.bodies(0);
  v1::Body& other = *scene.mutable_bodies(1);
  other.set_name("other");
  other.clear_fixed();
  tests::set(*other.mutable_mesh()->mutable_translation_m(), 0.01, y_m, 0.01);
  if (with_skin) {
    v1::PackedTriangles skin = tests::box_surface({0.1, 0.1, 0.1});
    std::vector<double> corners(24);
    std::memcpy(corners.data(), skin.vertex_positions().data(), skin.vertex_positions().size());
    for (double& coordinate : corners) coordinate += 0.05;
    skin.set_vertex_positions(tests::packed_bytes(corners));
    for (v1::Body& body : *scene.mutable_bodies()) *body.mutable_skin()->mutable_packed() = skin;
  }
  return scene;
}

TEST(Mistakes, BodiesThatOverlapWithoutContact) {
  for (const bool with_skin : {false, true}) {
    EXPECT_TRUE(find(two_blocks(0.2, with_skin), FindingCode::kOverlap).empty());
    EXPECT_TRUE(find(two_blocks(0.1, with_skin), FindingCode::kOverlap).empty());
    EXPECT_TRUE(find(two_blocks(0.0975, with_skin), FindingCode::kOverlap).empty()) << "less than a tenth of an edge";
    const Finding found = expect_one(two_blocks(0.097, with_skin), FindingCode::kOverlap, "body 'other'.mesh");
    EXPECT_EQ(found.body, "beam");
    EXPECT_EQ(found.other, "other");
    EXPECT_NEAR(found.value, 0.003, 1e-9);
    EXPECT_NEAR(found.limit, 0.00285, 1e-5);
  }
}

/// With a tool the surfaces are those of contact, in another order.
TEST(Mistakes, BodiesThatOverlapBesideATool) {
  for (const double y_m : {0.0975, 0.097}) {
    v1::Scene scene = two_blocks(y_m, true);
    tests::add_probe(scene, "probe", 0.02, 0.05, 0.5, 0.05);
    EXPECT_EQ(find(scene, FindingCode::kOverlap).size(), y_m < 0.0972 ? 1u : 0u);
  }
}

/// A small body in the middle of an element-free part of a larger surface: no vertex of the larger one is near.
TEST(Mistakes, ABodyInsideAnother) {
  v1::Scene scene = two_blocks(0);
  v1::Mesh& mesh = *scene.mutable_bodies(1)->mutable_mesh();
  mesh.set_scale(0.1);
  tests::set(*mesh.mutable_translation_m(), 0.045, 0.045, 0.045);
  expect_one(scene, FindingCode::kOverlap, "body 'other'.mesh");
}

v1::Scene accepting(v1::FindingCode code, const std::string& body, const std::string& tool, const std::string& reason) {
  v1::Scene scene = block();
  tests::add_probe(scene, "probe", 0.01, 0.05, 0.12, 0.05);
  v1::AcceptedFinding& accepted = *scene.add_accepted_findings();
  accepted.set_code(code);
  accepted.set_body(body);
  accepted.set_tool(tool);
  accepted.set_reason(reason);
  return scene;
}

TEST(AcceptedFindings, AreMarkedWithTheirReason) {
  const auto reason = [](const std::string& body, const std::string& tool) {
    const std::vector<Finding> found =
        find(accepting(v1::FINDING_CODE_COARSE_SURFACE, body, tool, "a test"), FindingCode::kCoarseSurface);
    return found.size() == 1 ? found[0].accepted : "not found";
  };
  EXPECT_EQ(reason("", ""), "a test");
  EXPECT_EQ(reason("beam", ""), "a test");
  EXPECT_EQ(reason("beam", "probe"), "a test");
  const std::vector<Finding> others =
      find(accepting(v1::FINDING_CODE_LOCKING, "", "", "a test"), FindingCode::kCoarseSurface);
  ASSERT_EQ(others.size(), 1u);
  EXPECT_EQ(others[0].accepted, "");
}

TEST(AcceptedFindings, ThatMeanNothingAreRefused) {
  const auto refusal = [](const v1::Scene& scene) {
    const Result<Model> model = compile(scene, {});
    return model ? std::string("accepted") : model.error().message;
  };
  EXPECT_EQ(refusal(accepting(v1::FINDING_CODE_UNSPECIFIED, "", "", "so")),
            "scene.accepted_findings[0].code: 0 is not given or unknown; docs/findings.md lists the codes");
  EXPECT_EQ(refusal(accepting(static_cast<v1::FindingCode>(999), "", "", "so")),
            "scene.accepted_findings[0].code: 999 is not given or unknown; docs/findings.md lists the codes");
  EXPECT_EQ(refusal(accepting(v1::FINDING_CODE_LOCKING, "", "", "")),
            "scene.accepted_findings[0].reason: say why locking is right for this scene");
  EXPECT_NE(refusal(accepting(v1::FINDING_CODE_LOCKING, "", "", std::string(1025, 'a'))).find("kMaxReasonLength"),
            std::string::npos);
  EXPECT_EQ(refusal(accepting(v1::FINDING_CODE_LOCKING, "liver", "", "so")),
            "scene.accepted_findings[0].body: the scene has no body 'liver'");
  EXPECT_EQ(refusal(accepting(v1::FINDING_CODE_LOCKING, "", "knife", "so")),
            "scene.accepted_findings[0].tool: the scene has no tool 'knife'");
  v1::Scene many = accepting(v1::FINDING_CODE_LOCKING, "", "", "so");
  for (std::size_t i = 0; i < limits::kMaxAcceptedFindings; ++i)
    *many.add_accepted_findings() = many.accepted_findings(0);
  EXPECT_NE(refusal(many).find("limits::kMaxAcceptedFindings = 256"), std::string::npos);
}

}  // namespace
}  // namespace tensormass::model
