#include "model/values.h"

#include <cmath>
#include <cstring>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "backend/cpu/arena.h"
#include "model/bind.h"
#include "support/cutting.h"
#include "support/editing.h"
#include "support/ridges.h"
#include "support/scenes.h"
#include "world/adjustments.h"

/// Gravity, moduli and damping change in place. The proof, with random values: all buffers of a state are those of the
/// scene compiled with these values, byte for byte. So everything about a compiled scene holds for an adjusted one.
namespace tensormass::world {
namespace {

using tests::EditedBeam;

model::Model compile(const v1::Scene& scene, matrix::Storage storage, const model::SceneCuts& cuts = {}) {
  auto model = model::compile(scene, {.max_patches = 3, .min_nodes_per_patch = 1, .storage = storage}, {}, cuts);
  if (!model) throw std::runtime_error(model.error().message);
  return std::move(*model);
}

/// The buffers of a model in host memory, as every backend has them.
class Buffers {
 public:
  explicit Buffers(const model::Model& m) : bound_(model::bind<float>(m, arena_)) {
    for (std::size_t g = 0; g < m.groups.size(); ++g) model::bind<float>(m, g, arena_, &groups_.emplace_back());
  }
  void write(const model::Model& m, const std::vector<model::EditRange>& ranges) {
    model::for_each_write<float>(m, ranges, bound_.buffers, groups_,
                                 [](void* to, const void* from, std::size_t bytes) { std::memcpy(to, from, bytes); });
  }
  void expect_equal(const Buffers& other) const {
    const auto &a = arena_.constants(), &b = other.arena_.constants();
    ASSERT_EQ(a.size(), b.size());
    ASSERT_GT(a.size(), 10u);
    for (std::size_t i = 0; i < a.size(); ++i) {
      EXPECT_EQ(a[i].name, b[i].name);
      ASSERT_EQ(a[i].bytes, b[i].bytes) << a[i].name;
      EXPECT_EQ(std::memcmp(a[i].items, b[i].items, a[i].bytes), 0) << a[i].name;
    }
  }

 private:
  backend::cpu::Arena arena_;
  model::BoundScene<float> bound_;
  std::vector<model::GroupBuffers<float>> groups_;
};

/// Returns random values of a scene.
v1::SceneAdjustments random_values(const v1::Scene& scene, std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(-1, 1);
  v1::SceneAdjustments out = adjustments_of(scene);
  if (scene.has_gravity_m_per_s2()) {
    tests::set(*out.mutable_gravity_m_per_s2(), uniform(random), 10 * uniform(random), uniform(random));
  }
  for (v1::BodyAdjustment& body : *out.mutable_bodies()) {
    body.clear_cuts();
    body.set_stiffness_factor(std::exp(5 * uniform(random)));
    if (random() % 4 != 0) body.set_rayleigh_mass_per_s(1 + uniform(random));
    if (random() % 4 != 0) body.set_rayleigh_stiffness_s(0.01 + 0.01 * uniform(random));
  }
  return out;
}

std::string packed(const std::vector<double>& values) {
  return {reinterpret_cast<const char*>(values.data()), values.size() * sizeof(double)};
}

/// Everything that has a modulus: laws of parts and of elements, forces beside gravity, contact with tools.
v1::Scene beam_of_parts(const EditedBeam& of, bool with_fields) {
  v1::Scene scene = tests::edited_beam(of);
  v1::Body& body = *scene.mutable_bodies(0);
  v1::LawRegion& part = *body.add_law_regions();
  *part.mutable_law() = tests::law("ogden", 7e4, 0.3);
  v1::Box& box = *part.mutable_region()->mutable_box();
  tests::set(*box.mutable_min_m(), -1, -1, -1);
  tests::set(*box.mutable_max_m(), 0.11, 1, 1);
  v1::Load& load = *body.add_loads();
  *load.mutable_region()->mutable_box() = box;
  tests::set(*load.mutable_force_n(), 0.1, 0.7, -0.3);
  if (with_fields) {
    part.mutable_law()->CopyFrom(tests::law("neo_hookean", 7e4, 0.3));
    std::mt19937 random(4);
    std::vector<double> young(mesh::element_count(tests::bodies_of(scene).bodies[0].mesh));
    for (double& one : young) one = 1e5 * (1 + static_cast<double>(random() % 1000) / 500);
    body.mutable_element_fields()->set_young_modulus_pa(packed(young));
  }
  return scene;
}

std::vector<v1::Scene> scenes() {
  std::vector<v1::Scene> out;
  for (const v1::Quadrature quadrature : {v1::QUADRATURE_FULL, v1::QUADRATURE_SELECTIVE}) {
    for (const v1::Shape shape : tests::shapes()) {
      out.push_back(tests::edited_beam({.shape = shape, .law = "hooke", .quadrature = quadrature, .cells = 2}));
    }
    out.push_back(tests::edited_beam({.quadrature = quadrature, .viscoelastic = true, .cells = 2}));
    out.push_back(beam_of_parts({.quadrature = quadrature, .cells = 2}, false));
    out.push_back(beam_of_parts({.law = "neo_hookean", .quadrature = quadrature, .cells = 2}, true));
  }
  for (const std::string& law : tests::law_names()) out.push_back(tests::edited_beam({.law = law, .cells = 2}));
  for (v1::Scene& scene : out) tests::add_probe(scene, "probe", 0.02, 0.15, 0.13, 0.05);
  const std::size_t edited = out.size();
  for (std::size_t i = 0; i < edited; ++i) out.emplace_back(out[i]).clear_editing();
  // Contact between bodies, at nodes and at sharp edges, and attachments.
  out.push_back(tests::crossed_ridges());
  out.push_back(tests::hanging_block(2));
  v1::BodyContact& contact = *out.back().add_body_contacts();
  contact.set_body("hanging");
  contact.set_other(out.back().bodies(0).name());
  return out;
}

/// Adjusts a scene several times in place, and compares each time with a compile.
void expect_compiled_values(const v1::Scene& scene, matrix::Storage storage, const model::SceneCuts& cuts = {}) {
  const model::Model first = compile(scene, storage, cuts);
  Buffers buffers(first);
  const model::Model* present = &first;
  std::shared_ptr<const model::Model> next;
  model::SpareModel spare;
  std::mt19937 random(3);
  v1::SceneAdjustments last;
  // From the third on in the memory of an earlier one, then with the gravity of the last one, then with its bodies.
  for (int round = 0; round < 5; ++round) {
    v1::SceneAdjustments values = random_values(scene, random);
    if (round == 3 && scene.has_gravity_m_per_s2()) *values.mutable_gravity_m_per_s2() = last.gravity_m_per_s2();
    if (round == 4 && scene.has_gravity_m_per_s2()) *values.mutable_bodies() = last.bodies();
    const v1::Scene wanted = adjusted(scene, values);
    last = values;
    auto made = model::with_values(*present, wanted, spare);
    ASSERT_TRUE(made) << made.error().message;
    ASSERT_NE(*made, nullptr);
    EXPECT_FALSE(model::changed(*present, **made).empty());
    buffers.write(**made, model::changed(*present, **made));
    const model::Model compiled = compile(wanted, storage, cuts);
    const Buffers bound(compiled);
    buffers.expect_equal(bound);
    Buffers(**made).expect_equal(bound);
    EXPECT_EQ((*made)->gravity_m_per_s2, compiled.gravity_m_per_s2);
    for (std::size_t b = 0; b < compiled.bodies.size(); ++b) {
      EXPECT_EQ((*made)->bodies[b].most_surface_modulus_pa, compiled.bodies[b].most_surface_modulus_pa);
      EXPECT_EQ((*made)->bodies[b].least_surface_modulus_pa, compiled.bodies[b].least_surface_modulus_pa);
    }
    next = std::move(*made);  // ends the one before
    present = next.get();
  }
}

class Values : public testing::TestWithParam<matrix::Storage> {
 protected:
  model::SpareModel spare_;
};

TEST_P(Values, AreThoseOfACompiledScene) {
  int number = 0;
  for (const v1::Scene& scene : scenes()) {
    SCOPED_TRACE(testing::Message() << "scene " << number++ << (scene.has_editing() ? ", editing: " : ": ")
                                    << scene.bodies(0).law().ShortDebugString());
    expect_compiled_values(scene, GetParam());
  }
}

TEST_P(Values, OfAQuasiStaticSceneAreThoseOfACompiledScene) {
  v1::Scene scene = tests::edited_beam({.integrator = v1::Solver::INTEGRATOR_QUASI_STATIC, .cells = 2});
  const v1::Scene with_gravity = scene;
  scene.clear_gravity_m_per_s2();
  expect_compiled_values(scene, GetParam());
  // Loads of such a scene grow in the first step, from values that a state would not have.
  v1::Scene lighter = with_gravity;
  lighter.mutable_gravity_m_per_s2()->set_y(-1);
  EXPECT_EQ(model::with_values(compile(with_gravity, GetParam()), lighter, spare_).value(), nullptr);
}

TEST_P(Values, OfACutSceneAreThoseOfACompiledScene) {
  v1::Scene scene = tests::edited_beam({.law = "hooke", .cells = 2});
  scene.mutable_editing()->mutable_cutting();
  tests::CutBody body(scene);
  std::mt19937 random(5);
  for (int i = 0; i < 4; ++i) body.move_at_random(random, {0.2, 0.09, 0.1});
  ASSERT_GT(compile(scene, GetParam(), body.cuts()).layout.row_of_node.size(),
            compile(scene, GetParam()).layout.row_of_node.size());
  expect_compiled_values(scene, GetParam(), body.cuts());
}

/// Gravity that was not there, and gravity over time, need buffers and factors that a compile makes.
TEST_P(Values, ThatNeedOtherBuffersAreCompiled) {
  v1::Scene scene = tests::beam_scene({.cells_x = 4, .cells_y = 2, .cells_z = 2});
  scene.clear_gravity_m_per_s2();
  v1::Scene heavy = scene;
  heavy.mutable_gravity_m_per_s2()->set_y(-1);
  EXPECT_EQ(model::with_values(compile(scene, GetParam()), heavy, spare_).value(), nullptr);
  heavy.mutable_gravity_schedule()->add_time_s(0);
  heavy.mutable_gravity_schedule()->add_factor(0.5);
  v1::Scene heavier = heavy;
  heavier.mutable_gravity_m_per_s2()->set_y(-2);
  const model::Model present = compile(heavy, GetParam());
  EXPECT_EQ(model::with_values(present, heavier, spare_).value(), nullptr);
  heavy.mutable_bodies(0)->set_rayleigh_mass_per_s(3);
  EXPECT_NE(model::with_values(present, heavy, spare_).value(), nullptr) << "the same gravity stays as it is";
}

TEST_P(Values, AreRefusedAsACompileDoes) {
  const v1::Scene scene = tests::beam_scene({.cells_x = 4, .cells_y = 2, .cells_z = 2});
  const model::Model present = compile(scene, GetParam());
  v1::Scene bad = scene;
  bad.mutable_bodies(0)->mutable_law()->mutable_st_venant_kirchhoff()->set_young_modulus_pa(-1);
  const auto refused = model::with_values(present, bad, spare_);
  ASSERT_FALSE(refused);
  const auto compiled = model::compile(bad, {.storage = GetParam()});
  ASSERT_FALSE(compiled);
  EXPECT_EQ(refused.error().message, compiled.error().message);
}

INSTANTIATE_TEST_SUITE_P(Storages, Values,
                         testing::Values(matrix::Storage::kEdges, matrix::Storage::kRows, matrix::Storage::kTiles),
                         [](const auto& of) {
                           return of.param == matrix::Storage::kEdges  ? std::string("Edges")
                                  : of.param == matrix::Storage::kRows ? std::string("Rows")
                                                                       : std::string("Tiles");
                         });

/// Values change in a state while material is burnt away from it, in turns.
class ChangingValues : public tests::OnBackend {};
TM_ON_EACH_BACKEND(ChangingValues);

/// Fails if the buffers of two states differ.
void expect_equal_states(backend::SceneState& a, backend::SceneState& b) {
  const auto of_a = a.read_constants(), of_b = b.read_constants();
  ASSERT_EQ(of_a.size(), of_b.size());
  for (std::size_t i = 0; i < of_a.size(); ++i) EXPECT_TRUE(of_a[i].bytes == of_b[i].bytes) << of_a[i].name;
}

TEST_P(ChangingValues, LeaveTheBuffersOfTheEditedModel) {
  for (const EditedBeam& of :
       {EditedBeam{}, EditedBeam{.law = "hooke"}, EditedBeam{.quadrature = v1::QUADRATURE_SELECTIVE},
        EditedBeam{.law = "hooke", .quadrature = v1::QUADRATURE_SELECTIVE, .double_precision = false},
        EditedBeam{.shape = v1::SHAPE_HEXAHEDRON, .double_precision = false, .consistent_mass = true}}) {
    SCOPED_TRACE(testing::PrintToString(of));
    v1::Scene scene = tests::edited_beam(of);
    tests::add_probe(scene, "probe", 0.02, 0.15, 0.13, 0.05);
    model::PatchPolicy policy = backend_->patch_policy(model::requested_cpu_threads(scene));
    policy.max_patches = 3;
    policy.min_nodes_per_patch = 1;
    const auto compile_here = [&](const v1::Scene& wanted) { return model::compile(wanted, policy).value(); };
    const auto first = std::make_shared<const model::Model>(compile_here(scene));
    auto present = first;
    model::Model edited = *first;
    const auto state = backend_->create(edited).value();
    model::Editor editor(edited);
    model::SpareModel spare;
    tests::RandomEdits random(7);
    std::mt19937 random_of_values(8);
    v1::Scene wanted = scene;
    std::vector<std::vector<model::Ablation>> done;
    for (int round = 0; round < 8; ++round) {
      const std::vector<model::Ablation> edit = random.next(editor, edited.bodies[0].element_count, 3);
      ASSERT_TRUE(editor.check(edited, edit));
      state->apply(editor.ablate(edited, edit));
      done.push_back(edit);
      wanted = adjusted(scene, random_values(scene, random_of_values));
      auto next = model::with_values(*present, wanted, spare).value();
      const auto ready = state->prepare(*next, model::changed(*present, *next));
      model::EditedValues values(*next);
      state->apply(*ready);
      state->apply(editor.take_values(edited, *next, values));
      present = std::move(next);
      expect_equal_states(*state, *backend_->create(edited).value());
    }
    // The same edits of a scene that was loaded with these values.
    model::Model other = compile_here(wanted);
    model::Editor of_other(other);
    for (const auto& edit : done) of_other.ablate(other, edit);
    expect_equal_states(*state, *backend_->create(other).value());
    editor.heal(edited, [&](const model::ModelEdit& edit) { state->apply(edit); });
    expect_equal_states(*state, *backend_->create(compile_here(wanted)).value());
  }
}

}  // namespace
}  // namespace tensormass::world
