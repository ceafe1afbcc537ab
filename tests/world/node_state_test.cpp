#include "world/node_state.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/laws.h"
#include "support/meshes.h"
#include "support/refused.h"
#include "support/ridges.h"
#include "support/scenes.h"
#include "world/world.h"

/// A state that one layout saves and another goes on from.
namespace tensormass::world {
namespace {

using matrix::Storage;

/// Layouts: those of the CPU with one and several threads, which can step here, then those of a GPU.
const std::vector<model::PatchPolicy>& policies() {
  static const std::vector<model::PatchPolicy> all{{1, 1, Storage::kEdges},
                                                   {2, 1, Storage::kEdges},
                                                   {5, 1, Storage::kEdges},
                                                   {3, 1, Storage::kRows},
                                                   {2, 1, Storage::kRows, ~0u, ~0u, 0}};  // tiles
  return all;
}

constexpr std::size_t kStepping = 3;  // policies that the CPU can step

std::unique_ptr<World> start(const v1::Scene& scene, const model::PatchPolicy& policy) {
  static const std::unique_ptr<backend::Backend> cpu = backend::make_cpu_backend(1);
  auto model = model::compile(scene, policy);
  if (!model) throw std::runtime_error(model.error().message);
  auto world = World::create(std::make_unique<const model::Model>(std::move(*model)), *cpu);
  if (!world) throw std::runtime_error(world.error().message);
  return std::move(*world);
}

template <class T>
bool same_bits(const std::vector<T>& a, const std::vector<T>& b) {
  return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0);
}

/// Which edge searches is not part of a state, and slots are its own.
std::vector<EdgePair> without_slots(std::vector<EdgePair> pairs) {
  for (EdgePair& pair : pairs) pair.slot = 0;
  return pairs;
}

void expect_same_bits(const NodeState& a, const NodeState& b) {
  EXPECT_TRUE(same_bits(a.displacement, b.displacement));
  EXPECT_TRUE(same_bits(a.velocity, b.velocity));
  EXPECT_TRUE(same_bits(a.previous_displacement, b.previous_displacement));
  EXPECT_TRUE(same_bits(a.previous_velocity, b.previous_velocity));
  EXPECT_TRUE(same_bits(a.solution, b.solution));
  EXPECT_TRUE(same_bits(a.internal_variables, b.internal_variables));
  EXPECT_TRUE(same_bits(a.slips, b.slips));
  EXPECT_TRUE(same_bits(a.link_slips, b.link_slips));
  EXPECT_EQ(a.broken, b.broken);
  EXPECT_EQ(without_slots(a.edge_pairs), without_slots(b.edge_pairs));
  EXPECT_EQ(a.internal_dt_s, b.internal_dt_s);
  EXPECT_EQ(a.last_dt_s, b.last_dt_s);
  EXPECT_EQ(a.largest_force_squared, b.largest_force_squared);
  EXPECT_EQ(a.coarse_solves, b.coarse_solves);
}

double largest(const std::vector<double>& values) {
  double out = 0;
  for (const double value : values) out = std::max(out, std::abs(value));
  return out;
}
double largest_difference(const std::vector<double>& a, const std::vector<double>& b) {
  double out = 0;
  for (std::size_t i = 0; i < a.size(); ++i) out = std::max(out, std::abs(a[i] - b[i]));
  return out;
}

struct Kind {
  std::string name;
  v1::Scene scene;
  std::function<void(World&, int)> move = [](World&, int) {};  ///< moves the tools before a step
  int steps = 25;                                              ///< before the state is saved
};

/// Presses the probe into the block and drags it along.
void drag(World& world, int i) {
  world.set_tool_target(0, {{0.04 + 0.0004 * i, 0.0595 - 0.0002 * i, 0.05}, {1, 0, 0, 0}});
}

void set_precision(v1::Scene& scene, bool in_double) {
  scene.mutable_solver()->set_precision(in_double ? v1::Solver::PRECISION_DOUBLE : v1::Solver::PRECISION_FLOAT);
  scene.mutable_solver()->set_cg_tolerance(in_double ? 1e-13 : 1e-6);
  scene.mutable_solver()->set_cg_max_iterations(1000);
}

v1::Scene block_of(v1::Shape shape, v1::Solver::Integrator integrator) {
  v1::Scene scene = tests::block_with_probe(true, 4);
  scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
  scene.mutable_bodies(0)->set_rayleigh_stiffness_s(0.01);
  *scene.mutable_bodies(0)->mutable_law() = tests::law("stable_neo_hookean", 5e3, 0.4);
  scene.mutable_solver()->set_integrator(integrator);
  scene.mutable_tools(0)->set_friction_coefficient(0.4);
  return scene;
}

void add_prony(v1::Law& law) {
  for (const double time_s : {0.05, 0.5}) {
    v1::PronyTerm& term = *law.add_prony();
    term.set_share(0.3);
    term.set_relaxation_time_s(time_s);
  }
}

/// Adds a block that lies on the first one and holds to it by springs that tear, beside the probe.
void add_upper_block(v1::Scene& scene) {
  v1::Body& above = *scene.add_bodies();
  above = scene.bodies(0);
  above.set_name("above");
  above.clear_fixed();
  above.mutable_mesh()->set_scale(0.3);
  tests::set(*above.mutable_mesh()->mutable_translation_m(), 0, 0.0505, 0);
  v1::BodyContact& contact = *scene.add_body_contacts();
  contact.set_body("above");
  contact.set_other(scene.bodies(0).name());
  contact.set_friction_coefficient(0.3);
  tests::attach_every_second(scene, "strong", "above", scene.bodies(0).name(), 1, 9);
  tests::attach_every_second(scene, "weak", "above", scene.bodies(0).name(), 0, 9).set_breaking_force_n(1e-5);
}

std::vector<Kind> kinds() {
  std::vector<Kind> out;
  for (const v1::Shape shape : tests::shapes()) {
    if (shape == v1::SHAPE_PYRAMID) continue;  // no grid of pyramids; the mixed mesh has some
    for (const auto integrator : {v1::Solver::INTEGRATOR_IMPLICIT_EULER, v1::Solver::INTEGRATOR_BDF2,
                                  v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT}) {
      if (shape != v1::SHAPE_TETRAHEDRON && integrator == v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT) continue;
      out.push_back(
          {v1::Shape_Name(shape) + v1::Solver::Integrator_Name(integrator), block_of(shape, integrator), drag});
    }
  }
  for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_WEDGE, v1::SHAPE_HEXAHEDRON}) {
    v1::Scene scene = block_of(shape, v1::Solver::INTEGRATOR_IMPLICIT_EULER);
    v1::Body& body = *scene.mutable_bodies(0);
    body.set_quadrature(v1::QUADRATURE_SELECTIVE);
    *body.mutable_law() = tests::law("neo_hookean", 5e3, 0.45);
    add_prony(*body.mutable_law());
    out.push_back({"viscoelastic, selective " + v1::Shape_Name(shape), scene, drag});
  }
  {
    v1::Scene scene = block_of(v1::SHAPE_HEXAHEDRON, v1::Solver::INTEGRATOR_IMPLICIT_EULER);
    scene.clear_tools();
    scene.mutable_bodies()->erase(scene.mutable_bodies()->begin());
    mesh::Mesh mesh = tests::mixed_mesh();
    v1::Body& body = tests::add_packed(scene, "mixed", mesh);
    *body.mutable_law() = tests::law("st_venant_kirchhoff", 5e4, 0.3);
    add_prony(*body.mutable_law());
    body.set_density_kg_per_m3(1000);
    v1::Box& clamp = *body.add_fixed()->mutable_box();
    tests::set(*clamp.mutable_min_m(), -1, -1, -1);
    tests::set(*clamp.mutable_max_m(), 1e-6, 3, 3);
    out.push_back({"mixed", scene});
  }
  {
    v1::Scene scene = block_of(v1::SHAPE_TETRAHEDRON, v1::Solver::INTEGRATOR_IMPLICIT_EULER);
    scene.mutable_solver()->set_newton_max_iterations(8);
    scene.mutable_solver()->set_newton_tolerance(1e-12);
    scene.mutable_tools(0)->set_contact_method(v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN);
    out.push_back({"Newton, kept forces", scene, drag});
  }
  {
    v1::Scene scene = block_of(v1::SHAPE_TETRAHEDRON, v1::Solver::INTEGRATOR_IMPLICIT_EULER);
    add_upper_block(scene);
    scene.add_body_contacts()->set_body("above");
    out.push_back({"two bodies", scene, drag});
  }
  out.push_back({"ridges", tests::crossed_ridges({.friction = 0.4}), [](World&, int) {}, 40});
  out.push_back({"equal ridges", tests::crossed_ridges({.lower_cells = 4, .upper_cells = 4, .friction = 0.4}),
                 [](World&, int) {}, 40});
  return out;
}

/// Makes the steps [from, to) and returns the state at the end of each.
std::vector<NodeState> run(World& world, const Kind& kind, int from, int to) {
  std::vector<NodeState> out;
  for (int i = from; i < to; ++i) {
    kind.move(world, i);
    EXPECT_TRUE(world.step(false)) << "step " << i;
    out.push_back(world.save().tissue);
  }
  return out;
}

/// Which parts of a NodeState the scenes below use.
struct Used {
  bool previous = false, no_solution = false, internal = false, slips = false, link_slips = false, broken = false,
       pairs = false;
  void add(const NodeState& state) {
    previous |= !state.previous_velocity.empty();
    no_solution |= state.solution.empty();
    internal |= largest(state.internal_variables) > 0;
    slips |= largest(state.slips) > 0;
    link_slips |= largest(state.link_slips) > 0;
    broken |= std::count(state.broken.begin(), state.broken.end(), 1) > 0 &&
              std::count(state.broken.begin(), state.broken.end(), 0) > 0;
    pairs |= !state.edge_pairs.empty();
  }
  bool all() const { return previous && no_solution && internal && slips && link_slips && broken && pairs; }
};

/// Goes on from a state in every layout: to the bit in the one that saved it, to rounding in others.
TEST(NodeState, IsWhatEveryLayoutGoesOnFrom) {
  constexpr int kSteps = 20;
  Used used;
  std::size_t number = 0;
  for (Kind& kind : kinds()) {
    for (const bool in_double : {true, false}) {
      set_precision(kind.scene, in_double);
      for (const std::size_t from : {number % kStepping, (number + 1) % kStepping}) {
        if (!in_double && from != number % kStepping) continue;  // float has its own bits, and no tight bound
        const auto world = start(kind.scene, policies()[from]);
        run(*world, kind, 0, kind.steps);
        const World::Saved saved = world->save();
        used.add(saved.tissue);
        const std::vector<NodeState> expected = run(*world, kind, kind.steps, kind.steps + kSteps);
        for (std::size_t to = 0; to < policies().size(); ++to) {
          SCOPED_TRACE(kind.name + (in_double ? ", double" : ", float") + ", layout " + std::to_string(from) + " to " +
                       std::to_string(to));
          const auto other = start(kind.scene, policies()[to]);
          other->restore(saved);
          expect_same_bits(other->save().tissue, saved.tissue);
          if (to >= kStepping) continue;
          const std::vector<NodeState> found = run(*other, kind, kind.steps, kind.steps + kSteps);
          if (to == from) {
            EXPECT_EQ(other->save().tissue.edge_pairs, world->save().tissue.edge_pairs) << "slots as well";
            for (int i = 0; i < kSteps; ++i) expect_same_bits(found[i], expected[i]);
          } else {
            const double scale = largest(expected.back().displacement);
            EXPECT_LT(largest_difference(found.back().displacement, expected.back().displacement),
                      (in_double ? 1e-9 : 1e-2) * scale);
          }
        }
      }
      ++number;
    }
  }
  EXPECT_TRUE(used.all());
}

/// What a layout computes for several patches is equal there, and padding stays at rest.
TEST(NodeState, IsAllThatALayoutHas) {
  for (Kind& kind : kinds()) {
    SCOPED_TRACE(kind.name);
    const auto first = start(kind.scene, policies()[0]);
    run(*first, kind, 0, kind.steps);
    for (std::size_t layout = 0; layout < policies().size(); ++layout) {
      SCOPED_TRACE("layout " + std::to_string(layout));
      const auto world = start(kind.scene, policies()[layout]);
      if (layout < kStepping) {
        run(*world, kind, 0, kind.steps);
      } else {
        world->restore(first->save());
      }
      const World::Copied copied = world->copy();
      const LayoutState back = in_layout(world->model(), by_node(world->model(), copied.tissue));
      const auto &rows = copied.tissue.rows, &of_nodes = back.rows;
      const auto &history = copied.tissue.history, &of_contacts = back.history;
      EXPECT_TRUE(same_bits(of_nodes.displacement, rows.displacement));
      EXPECT_TRUE(same_bits(of_nodes.velocity, rows.velocity));
      EXPECT_TRUE(same_bits(of_nodes.internal_variables, rows.internal_variables));
      EXPECT_TRUE(same_bits(of_contacts.previous_displacement, history.previous_displacement));
      EXPECT_TRUE(same_bits(of_contacts.previous_velocity, history.previous_velocity));
      EXPECT_TRUE(same_bits(of_contacts.solution, history.solution));
      EXPECT_TRUE(same_bits(of_contacts.slips, history.slips));
      EXPECT_TRUE(same_bits(of_contacts.link_slips, history.link_slips));
      EXPECT_TRUE(same_bits(of_contacts.broken, history.broken));
    }
  }
}

/// The pairs of crossed ridges, in a model and in one whose other body searches.
class EdgePairs : public testing::Test {
 protected:
  EdgePairs() {
    const auto world = start(scene, policies()[0]);
    for (int i = 0; i < 40; ++i) EXPECT_TRUE(world->step(false));
    state = world->save().tissue;
    EXPECT_FALSE(state.edge_pairs.empty());
  }
  /// Returns whether a body's edges search those of the other.
  static bool searches(const World& world, std::size_t body) {
    const model::Links& links = world.model().links;
    const std::uint32_t row = links.edge_rows[4 * std::size_t{links.edge_candidates[0]}];
    return world.model().body_of_node(world.model().layout.node_of_row[row]) == body;
  }

  const v1::Scene scene = tests::crossed_ridges({.friction = 0.4});
  NodeState state;
};

TEST_F(EdgePairs, AreKeptWhoeverSearches) {
  // The same ridges, but each edge of the lower bar is now the shorter one.
  const auto finer = start(tests::crossed_ridges({.lower_cells = 3, .upper_cells = 5, .friction = 0.4}), policies()[0]);
  ASSERT_TRUE(searches(*finer, 1));
  model::Model turned = finer->model();
  // Lets the other body search, as a layout may decide for two bodies that are equally fine.
  std::vector<std::uint32_t> candidates;
  for (std::uint32_t edge = 0; edge < turned.links.edge_rows.size() / 4; ++edge) {
    const std::uint32_t node = turned.layout.node_of_row[turned.links.edge_rows[4 * std::size_t{edge}]];
    if (turned.body_of_node(node) == 0) candidates.insert(candidates.end(), {edge, 1});
  }
  turned.links.edge_candidates = candidates;
  const LayoutState there = in_layout(turned, state);
  EXPECT_EQ(by_node(turned, there).edge_pairs, state.edge_pairs);
  const LayoutState here = in_layout(finer->model(), by_node(turned, there));
  EXPECT_EQ(by_node(finer->model(), here).edge_pairs, state.edge_pairs);
  const std::size_t begin = 4 * std::size_t{turned.links.candidate_count()};
  const auto stretch = [&](const LayoutState& of) {
    double sum = 0;  // one pair at least, and all of them point the same way
    for (std::size_t i = begin; i < of.history.link_slips.size(); i += view::kEdgeMemory) {
      sum += of.history.link_slips[i] + of.history.link_slips[i + 2];
    }
    return sum;
  };
  EXPECT_NE(stretch(here), 0);
  EXPECT_DOUBLE_EQ(stretch(here), -stretch(there)) << "a spring pulls both ways";
}

TEST_F(EdgePairs, ThatCannotBeAreRefused) {
  const auto world = start(scene, policies()[0]);
  const model::Model& m = world->model();
  ASSERT_TRUE(check_edge_pairs(m, state.edge_pairs));
  const auto refuse = [&](const std::function<void(EdgePair&)>& change, const std::string& part) {
    std::vector<EdgePair> pairs = state.edge_pairs;
    change(pairs[0]);
    EXPECT_REFUSED(check_edge_pairs(m, pairs), ErrorCode::kInvalidArgument, part);
  };
  refuse([](EdgePair& pair) { pair.contact = 1; }, "edge_pairs[0]: contact 1");
  refuse([](EdgePair& pair) { pair.slot = view::kEdgeSlots; }, "slot 4");
  refuse([](EdgePair& pair) { pair.other[1] = 1'000'000; }, "no such sharp edges");
  refuse([](EdgePair& pair) { std::swap(pair.edge, pair.other); }, "ascend");
  refuse([](EdgePair& pair) { std::swap(pair.edge[0], pair.edge[1]); }, "no such sharp edges");
  std::vector<EdgePair> twice{state.edge_pairs[0], state.edge_pairs[0]};
  EXPECT_REFUSED(check_edge_pairs(m, twice), ErrorCode::kInvalidArgument, "ascend");
  // Two edges of one body.
  std::vector<EdgePair::Edge> of_lower;
  for (std::uint32_t edge = 0; edge < m.links.edge_rows.size() / 4; ++edge) {
    const std::uint32_t* rows = m.links.edge_rows.data() + 4 * std::size_t{edge};
    const auto [low, high] = std::minmax(m.layout.node_of_row[rows[0]], m.layout.node_of_row[rows[1]]);
    if (m.body_of_node(low) == 0) of_lower.push_back({low, high});
  }
  std::sort(of_lower.begin(), of_lower.end());
  refuse([&](EdgePair& pair) { pair.edge = of_lower[0], pair.other = of_lower[1]; }, "not of the two bodies");
}

}  // namespace
}  // namespace tensormass::world
