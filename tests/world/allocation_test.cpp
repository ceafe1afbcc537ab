#include <algorithm>
#include <atomic>
#include <cstdint>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/editing.h"
#include "support/laws.h"
#include "support/operator_new.h"
#include "support/parted.h"
#include "support/scenes.h"
#include "support/strands.h"
#include "world/loop_outputs.h"
#include "world/recording.h"

/// The step loop allocates nothing. This program counts every call of operator new, in every thread.
namespace {

std::atomic<std::uint64_t> allocations{0};

}  // namespace

bool tensormass::tests::may_allocate(std::size_t) noexcept {
  allocations.fetch_add(1, std::memory_order_relaxed);
  return true;
}

namespace tensormass::world {
namespace {

class StepLoop : public tests::OnBackend {};

TEST_P(StepLoop, AllocatesNothing) {
  for (const bool mixed : {false, true}) {
    v1::Scene scene = tests::block_with_probe(false, 12);
    scene.mutable_solver()->set_cpu_threads(2);
    scene.mutable_solver()->set_cg_tolerance(1e-3);
    scene.mutable_solver()->set_floor_tolerance(1e-2);
    if (mixed) {
      *scene.add_bodies() = scene.bodies(0);
      scene.mutable_bodies(1)->set_name("linear");
      scene.mutable_bodies(1)->mutable_law()->mutable_hooke()->set_young_modulus_pa(1e4);
    }
    const auto world = start(scene);
    const std::uint64_t before = allocations.load();
    for (int i = 0; i < 20; ++i) {
      world->set_tool_target(0, {{0.05, 0.058 - 0.0003 * i, 0.05}, {1, 0, 0, 0}});
      world->set_cg_limit(i < 15 ? 200 : 3);
      ASSERT_TRUE(world->step(i % 2 == 0))
          << mixed << ", step " << i + 1 << ": " << to_text(*world->guard_event(), world->model());
    }
    EXPECT_NE(world->guard_event(), nullptr) << "a step that was done again was among them";
    EXPECT_EQ(allocations.load() - before, 0u);
    EXPECT_GT(world->readings()[0].force_n.norm(), 0) << "contact was among what ran";
  }
}

class CutTissue : public tests::OnBackendWithParts {};

/// A tool presses on the face of a cut.
TEST_P(CutTissue, AllocatesNothing) {
  v1::Scene scene = tests::block_with_probe(false, 6);
  scene.mutable_editing()->mutable_cutting();
  scene.mutable_tools(0)->set_friction_coefficient(0.3);
  scene.mutable_tools(0)->set_max_speed_m_per_s(10);
  tests::CutBody body(scene);
  tests::cut_across(body, 1, 0.0303);
  const auto world = start_apart(scene, body, [](std::uint32_t piece) -> Eigen::Vector3d {
    return {0, piece == 0 ? 0.0 : 1.0, 0};
  });
  double largest_n = 0;
  const std::uint64_t before = allocations.load();
  for (int i = 0; i < 20; ++i) {
    world->set_tool_target(0, {{0.05, 0.042 - 0.0003 * i, 0.05}, {1, 0, 0, 0}});
    ASSERT_TRUE(world->step(i % 2 == 0));
    largest_n = std::max(largest_n, world->readings()[0].force_n.norm());
  }
  EXPECT_EQ(allocations.load() - before, 0u);
  EXPECT_GT(largest_n, 0.01) << "contact was among what ran";
}

/// The loop reads which springs are broken and leaves them in frames.
TEST_P(StepLoop, AllocatesNothingWhenSpringsBreak) {
  const auto world = start(tests::hanging_block());
  LoopOutputs outputs(*world);
  const std::uint64_t before = allocations.load();
  for (int i = 0; i < 20; ++i) {
    ASSERT_TRUE(world->step(true));
    outputs.take_step(Clock::now());
    outputs.publish(true);
  }
  EXPECT_EQ(allocations.load() - before, 0u);
  EXPECT_EQ(world->last().broken_springs, 9u) << "springs broke among what ran";
}

/// A tool severs springs, and each step tells which.
TEST_P(StepLoop, AllocatesNothingWhenATipSevers) {
  const auto world = start(tests::strung_blocks(false, true));
  LoopOutputs outputs(*world);
  std::size_t told = 0;
  const std::uint64_t before = allocations.load();
  for (int i = 0; i < 40; ++i) {
    world->set_tool_target(0, {{-0.01 + 0.002 * i, 0.03, -0.004}, {1, 0, 0, 0}});
    ASSERT_TRUE(world->step(true));
    for (const BrokenSprings& one : world->newly_broken()) {
      outputs.add_event({.kind = EventKind::kSevered, .tool = one.tool, .attachment = one.attachment});
      ++told;
    }
    outputs.take_step(Clock::now());
    outputs.publish(true);
  }
  EXPECT_EQ(allocations.load() - before, 0u);
  EXPECT_GT(told, 3u) << "springs were severed among what ran";
}

/// Changes of the surface are shared, and events have a fixed size.
TEST_P(StepLoop, AllocatesNothingForChangesAndEvents) {
  const auto world = start(tests::block_with_probe());
  LoopOutputs outputs(*world);
  std::vector<SurfaceChangesPointer> made;
  for (std::uint32_t revision = 1; revision <= 20; ++revision) {
    made.push_back(std::make_shared<const SurfaceChanges>(
        SurfaceChanges{.revision = revision, .bodies = std::vector<BodyChanges>(1)}));
  }
  const std::uint64_t before = allocations.load();
  for (const SurfaceChangesPointer& changes : made) {
    outputs.set_changes(changes);
    outputs.add_event({.kind = EventKind::kAblated, .value = 1e-9});
    ASSERT_TRUE(world->step(true));
    outputs.note_guard();
    outputs.take_step(Clock::now());
    outputs.publish(true);
  }
  EXPECT_EQ(allocations.load() - before, 0u);
}

/// A tool burns elements away below a skin, after the first of them.
TEST_P(StepLoop, AllocatesNothingWhileASkinBurns) {
  v1::Scene scene = tests::block_with_probe(false, 10);
  scene.mutable_stepping()->set_dt_s(0.01);
  scene.mutable_bodies(0)->set_ablation_j_per_m3(2e6);
  scene.mutable_tools(0)->mutable_cautery()->set_power_w(40);
  scene.mutable_editing();
  const mesh::Mesh mesh = tests::bodies_of(scene).bodies[0].mesh;
  const mesh::Surface surface = mesh::boundary(mesh);
  std::vector<double> points;
  for (const std::uint32_t node : surface.nodes) {
    const Vec3<double> middle(0.05, 0.025, 0.05), x = middle + 1.01 * (mesh.nodes[node] - middle);
    points.insert(points.end(), x.begin(), x.end());
  }
  v1::PackedTriangles& skin = *scene.mutable_bodies(0)->mutable_skin()->mutable_packed();
  skin.set_vertex_positions(points.data(), points.size() * sizeof(double));
  skin.set_triangles(surface.triangles.data(), surface.triangles.size() * sizeof(mesh::Triangle));
  const auto world = start(scene);
  std::uint64_t before = 0;
  std::uint32_t revision = 0;
  for (int i = 0; i < 60; ++i) {
    world->set_tool_target(0, {{0.051, 0.056 - 5e-5 * i, 0.049}, {1, 0, 0, 0}}, {}, kUntilTheNext, 1);
    ASSERT_TRUE(world->step(true));
    if (i != 20) continue;
    before = allocations.load();
    revision = world->editor()->surface_revision();
  }
  EXPECT_EQ(allocations.load() - before, 0u);
  EXPECT_GT(world->editor()->surface_revision(), revision + 3);
  EXPECT_GT(world->editor()->surfaces()[0].appended_triangles.size(), 20u);
}

/// Loads whose factors change in every step.
void schedule_loads(v1::Scene& scene) {
  const auto ramp = [](v1::Schedule& schedule) {
    for (const double end : {0.0, 1.0}) {
      schedule.add_time_s(end);
      schedule.add_factor(end);
    }
  };
  ramp(*scene.mutable_gravity_schedule());
  for (const bool is_pressure : {false, true}) {
    v1::Load& load = *scene.mutable_bodies(0)->add_loads();
    tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
    tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 2, 1, 1);
    if (is_pressure) {
      load.set_pressure_pa(10);
    } else {
      tests::set(*load.mutable_force_n(), 0.1, 0, 0);
    }
    ramp(*load.mutable_schedule());
  }
}

TEST_P(StepLoop, AllocatesNothingWhileLoadsChange) {
  v1::Scene scene = tests::block_with_probe(false, 12);
  schedule_loads(scene);
  const auto world = start(scene);
  const std::uint64_t before = allocations.load();
  for (int i = 0; i < 20; ++i) ASSERT_TRUE(world->step(i % 2 == 0));
  EXPECT_EQ(allocations.load() - before, 0u);
  EXPECT_NE(world->last().work_j, 0) << "loads were among what ran";
}

/// Both kinds of loads are written for each part of the first step: those with a schedule and those without.
TEST_P(StepLoop, AllocatesNothingWhileLoadsGrowInParts) {
  for (const bool scheduled : {false, true}) {
    v1::Scene scene = tests::beam_scene({.cells_x = 16,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .size_x_m = 1,
                                         .size_y_m = 0.05,
                                         .size_z_m = 0.05,
                                         .double_precision = true});
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, -60, 0);
    *scene.mutable_bodies(0)->mutable_law() = tests::law("neo_hookean", 1e5, 0.3);
    scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
    scene.mutable_solver()->clear_cg_max_iterations();
    scene.mutable_solver()->clear_cg_tolerance();
    if (scheduled) {
      schedule_loads(scene);
      scene.mutable_stepping()->set_dt_s(1);
    }
    const auto world = start(scene);
    const std::uint64_t before = allocations.load();
    ASSERT_TRUE(world->step(false));
    EXPECT_EQ(allocations.load() - before, 0u) << scheduled;
    ASSERT_NE(world->guard_event(), nullptr) << "the load is too much for one part; make it larger";
  }
}

TM_ON_EACH_BACKEND(StepLoop);
TM_ON_EACH_BACKEND(CutTissue);

TEST(ARecording, AllocatesNothingForAStep) {
  const auto backend = backend::make_cpu_backend(1);
  const v1::Scene scene = tests::block_with_probe(false, 4);
  const auto model = model::compile(scene, backend->patch_policy(model::requested_cpu_threads(scene)));
  ASSERT_TRUE(model);
  Recording recording(*model, {.room_for_steps = 16});
  const auto reset = std::make_shared<const Edit>(Reset{});
  const std::uint64_t before = allocations.load();
  for (int i = 0; i < 40; ++i) {  // the last ones find no room
    if (i == 10) recording.take_edit({reset, 0});
    recording.take_pose(0, {});
    recording.end_step({});
  }
  EXPECT_EQ(allocations.load() - before, 0u);
}

TEST(Counting, SeesAnAllocation) {
  const std::uint64_t before = allocations.load();
  int* volatile kept = new int(1);  // else the compiler may leave both calls out
  delete kept;
  EXPECT_GT(allocations.load(), before);
}

}  // namespace
}  // namespace tensormass::world
