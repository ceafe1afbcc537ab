#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

#include "model/compile.h"
#include "support/laws.h"
#include "support/ridges.h"
#include "support/scenes.h"
#include "support/strands.h"
#include "world/world.h"

/// CUDA and the CPU compute the same. They agree to rounding, amplified by 100 steps, but not bitwise: patch counts
/// differ, so sums have another order, and compilers fuse other operations.
namespace tensormass {
namespace {

struct Trajectory {
  std::vector<double> positions;
  std::vector<Vec3<double>> forces;  // [step] force on the tool [N]
  double min_det_f = 1;              // StepResult::min_det_f of the last step
  std::uint32_t patches = 0, largest_patch = 0;
  matrix::Storage storage = matrix::Storage::kRows;
  bool solve_checks_volume = false;
  model::SolveKind solve = model::SolveKind::kStages;
};

/// Steps a scene and returns where it ends. `press` moves the tool into the block; `policy` replaces the backend's
/// patch policy.
Trajectory run(const backend::Backend& backend, const v1::Scene& scene, int steps, bool press,
               const model::PatchPolicy* policy = nullptr) {
  auto model =
      model::compile(scene, policy != nullptr ? *policy : backend.patch_policy(model::requested_cpu_threads(scene)));
  EXPECT_TRUE(model) << model.error().message;
  Trajectory out;
  out.patches = model->layout.patch_count;
  out.largest_patch = model->layout.largest_patch();
  out.storage = model->layout.storage;
  out.solve_checks_volume = !model->checked.begin.empty();
  out.solve = model->solve;
  auto world = world::World::create(std::make_unique<model::Model>(std::move(*model)), backend);
  EXPECT_TRUE(world) << world.error().message;
  for (int i = 0; i < steps; ++i) {
    if (press) (*world)->set_tool_target(0, {{0.05, 0.058 - 0.006 * std::min(i / 60.0, 1.0), 0.05}, {1, 0, 0, 0}});
    EXPECT_TRUE((*world)->step(false));
    if (press) out.forces.push_back((*world)->readings()[0].force_n);
  }
  out.positions = (*world)->positions((*world)->model().bodies[0]);
  out.min_det_f = (*world)->last().min_det_f;
  return out;
}

/// Returns ‖a − b‖ / ‖a − rest‖: the difference relative to the displacement.
double relative_difference(const std::vector<double>& a, const std::vector<double>& b,
                           const std::vector<double>& rest) {
  double difference = 0, moved = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    difference += (a[i] - b[i]) * (a[i] - b[i]);
    moved += (a[i] - rest[i]) * (a[i] - rest[i]);
  }
  return std::sqrt(difference / moved);
}

struct Parameters {
  bool linear;
  bool double_precision;
  friend void PrintTo(const Parameters& p, std::ostream* out) {
    *out << (p.linear ? "Hooke" : "StVK") << (p.double_precision ? "Double" : "Float");
  }
};

class CudaAgreement : public testing::TestWithParam<Parameters> {
 protected:
  void SetUp() override {
    auto made = backend::make_cuda_backend();
    if (!made) GTEST_SKIP() << "no GPU here: " << made.error().message;
    cuda_ = std::move(*made);
  }
  double tolerance() const { return GetParam().double_precision ? 1e-10 : 1e-4; }

  std::unique_ptr<backend::Backend> cuda_;
  std::unique_ptr<backend::Backend> cpu_ = backend::make_cpu_backend(1);
};

TEST_P(CudaAgreement, BeamAfterAHundredSteps) {
  tests::Beam beam;
  beam.linear = GetParam().linear;
  beam.double_precision = GetParam().double_precision;
  // The solve converges to rounding level, so that the comparison sees arithmetic and not an unfinished iteration.
  beam.cg_max_iterations = 400;
  beam.cg_tolerance = beam.double_precision ? 1e-14 : 1e-6;
  const v1::Scene scene = tests::beam_scene(beam);
  const Trajectory rest = run(*cpu_, scene, 0, false);
  const Trajectory cpu = run(*cpu_, scene, 100, false);
  const Trajectory cuda = run(*cuda_, scene, 100, false);
  EXPECT_GT(cuda.patches, 1u);
  const double difference = relative_difference(cpu.positions, cuda.positions, rest.positions);
  RecordProperty("relative_difference", std::to_string(difference));
  EXPECT_LT(difference, tolerance());
  EXPECT_EQ(cuda.solve_checks_volume, !GetParam().linear && !GetParam().double_precision);
  const double found = GetParam().linear ? 1 : std::numeric_limits<double>::infinity();  // no element is inverted
  EXPECT_EQ(cpu.min_det_f, found);
  EXPECT_EQ(cuda.min_det_f, found);
}

TEST_P(CudaAgreement, ProbePressedIntoABlock) {
  v1::Scene scene = tests::block_with_probe(GetParam().double_precision);
  if (GetParam().linear) {
    const v1::IsotropicElastic law = scene.bodies(0).law().st_venant_kirchhoff();
    *scene.mutable_bodies(0)->mutable_law()->mutable_hooke() = law;
  }
  scene.mutable_solver()->set_cg_tolerance(GetParam().double_precision ? 1e-14 : 1e-6);
  scene.mutable_solver()->set_cg_max_iterations(400);
  const Trajectory rest = run(*cpu_, scene, 0, true);
  const Trajectory cpu = run(*cpu_, scene, 100, true);
  const Trajectory cuda = run(*cuda_, scene, 100, true);
  EXPECT_LT(relative_difference(cpu.positions, cuda.positions, rest.positions), tolerance());
  ASSERT_GT(cpu.forces.back().norm(), 0.1);
  EXPECT_LT((cpu.forces.back() - cuda.forces.back()).norm(), tolerance() * 10 * cpu.forces.back().norm());
}

/// Ridges that hold each other at their edges alone: the bar falls, strikes, and rubs.
TEST_P(CudaAgreement, CrossedRidges) {
  if (GetParam().linear) GTEST_SKIP() << "the law makes no difference to contact";
  tests::Ridges ridges;
  ridges.gap_m = 0.002;
  ridges.yaw = 1.1;
  ridges.friction = 0.3;
  ridges.dt_s = 0.005;
  ridges.double_precision = GetParam().double_precision;
  v1::Scene scene = tests::crossed_ridges(ridges);
  scene.mutable_solver()->set_cg_tolerance(GetParam().double_precision ? 1e-14 : 1e-6);
  // The bar that moves is first: `run` reads that body.
  scene.mutable_bodies()->SwapElements(0, 1);
  const Trajectory rest = run(*cpu_, scene, 0, false);
  const Trajectory cpu = run(*cpu_, scene, 100, false);
  const Trajectory cuda = run(*cuda_, scene, 100, false), again = run(*cuda_, scene, 100, false);
  EXPECT_LT(relative_difference(cpu.positions, cuda.positions, rest.positions), tolerance());
  EXPECT_EQ(cuda.positions, again.positions) << "it repeats bitwise";
  double lowest_m = 0;
  for (std::size_t i = 1; i < cpu.positions.size(); i += 3) lowest_m = std::min(lowest_m, cpu.positions[i]);
  EXPECT_GT(lowest_m, -0.005) << "the ridges hold";
}

/// A block that hangs on strands, each between rows of two patches.
TEST_P(CudaAgreement, StrandsBetweenManyPatches) {
  v1::Scene scene = tests::strung_blocks(GetParam().double_precision, true);
  for (v1::Body& body : *scene.mutable_bodies()) {
    body.mutable_mesh()->mutable_grid()->set_cells_x(40);
    body.mutable_mesh()->mutable_grid()->set_cells_y(6);
    body.mutable_mesh()->mutable_grid()->set_cells_z(4);
    if (!GetParam().linear) continue;
    const v1::IsotropicElastic law = body.law().st_venant_kirchhoff();
    *body.mutable_law()->mutable_hooke() = law;
  }
  scene.mutable_solver()->set_cg_tolerance(GetParam().double_precision ? 1e-14 : 1e-6);
  scene.mutable_solver()->set_cg_max_iterations(4000);  // a block on soft strands is a badly conditioned system
  const Trajectory rest = run(*cpu_, scene, 0, false);
  const Trajectory cpu = run(*cpu_, scene, 60, false);
  const Trajectory cuda = run(*cuda_, scene, 60, false), again = run(*cuda_, scene, 60, false);
  EXPECT_GT(cuda.patches, 10u);
  EXPECT_EQ(cuda.solve, GetParam().double_precision ? model::SolveKind::kStages : model::SolveKind::kResident);
  EXPECT_LT(relative_difference(cpu.positions, cuda.positions, rest.positions), tolerance());
  EXPECT_EQ(cuda.positions, again.positions) << "it repeats bitwise";
}

/// Pushes one node through its neighbours. The inverted element must be detected in every patch, by a stage or by the
/// solve, with a resident or a streamed matrix.
TEST_P(CudaAgreement, DetectsAnInvertedElementInEveryPatch) {
  if (GetParam().linear) GTEST_SKIP() << "Hooke's law has no inversion check";
  tests::Beam beam;
  beam.cells_y = beam.cells_z = 8;
  beam.double_precision = GetParam().double_precision;
  beam.cg_max_iterations = 1000;
  beam.cg_tolerance = beam.double_precision ? 1e-14 : 1e-6;
  for (const std::uint32_t patches : {40u, 2u, 1u}) {
    for (std::uint32_t i = 1; i < beam.cells_x; ++i) {
      v1::Scene scene = tests::beam_scene(beam);
      v1::PrescribedDisplacement& pushed = *scene.mutable_bodies(0)->add_prescribed();
      const double h = beam.size_x_m / beam.cells_x, x = i * h;
      const double y = beam.size_y_m * (1 + i % 7) / 8, z = beam.size_z_m * (1 + i % 5) / 8;
      tests::set(*pushed.mutable_region()->mutable_box()->mutable_min_m(), x - h / 4, y - 1e-6, z - 1e-6);
      tests::set(*pushed.mutable_region()->mutable_box()->mutable_max_m(), x + h / 4, y + 1e-6, z + 1e-6);
      pushed.set_x_m(3 * h);
      pushed.set_y_m(0);
      pushed.set_z_m(0);
      model::PatchPolicy policy = cuda_->patch_policy(model::requested_cpu_threads(scene));
      policy.max_patches = patches;
      policy.min_nodes_per_patch = 1;
      std::array<double, 2> seen{};
      for (const bool device : {false, true}) {
        const backend::Backend& backend = device ? *cuda_ : *cpu_;
        auto model = model::compile(scene, device ? policy : cpu_->patch_policy(model::requested_cpu_threads(scene)));
        ASSERT_TRUE(model) << model.error().message;
        EXPECT_EQ(!model->checked.begin.empty(), device && !GetParam().double_precision);
        auto world = world::World::create(std::make_unique<model::Model>(std::move(*model)), backend);
        ASSERT_TRUE(world) << world.error().message;
        EXPECT_FALSE((*world)->step(false));
        ASSERT_NE((*world)->guard_event(), nullptr);
        ASSERT_EQ((*world)->guard_event()->first.breach, world::Breach::kVolume) << "node " << i;
        seen[device] = (*world)->guard_event()->first.value;
      }
      EXPECT_LT(seen[0], -0.1);
      EXPECT_NEAR(seen[0], seen[1], 10 * tolerance()) << patches << " patches, node " << i;
    }
  }
}

TEST_P(CudaAgreement, RepeatsBitwise) {
  v1::Scene scene = tests::block_with_probe(GetParam().double_precision);
  if (GetParam().linear) *scene.mutable_bodies(0)->mutable_law() = tests::law("hooke", 5e3, 0.4);
  const Trajectory first = run(*cuda_, scene, 50, true);
  const Trajectory second = run(*cuda_, scene, 50, true);
  EXPECT_EQ(first.positions, second.positions);
  EXPECT_TRUE(std::equal(first.forces.begin(), first.forces.end(), second.forces.begin()));
}

/// The beams of docs/performance.md, each with the whole device.
TEST_P(CudaAgreement, LargeBeamsRepeatBitwise) {
  constexpr int kSteps = 3;
  for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_HEXAHEDRON}) {
    v1::Scene scene = tests::beam_scene({.cells_x = 160,
                                         .cells_y = 20,
                                         .cells_z = 16,
                                         .linear = GetParam().linear,
                                         .double_precision = GetParam().double_precision});
    scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
    const Trajectory first = run(*cuda_, scene, kSteps, false), second = run(*cuda_, scene, kSteps, false);
    EXPECT_EQ(first.patches, cuda_->patch_policy(model::requested_cpu_threads(scene)).max_patches)
        << "the test needs a scene that uses every patch";
    EXPECT_EQ(first.positions, second.positions) << v1::Shape_Name(shape);
  }
}

/// Concurrent scenes on one device give the same bits as one of them alone. A scene with the whole device gives the
/// same state to rounding, because its sums have another order.
TEST_P(CudaAgreement, ConcurrentScenesDoNotAffectEachOther) {
  constexpr int kScenes = 6, kSteps = 50;
  auto shared = backend::make_cuda_backend(100);
  ASSERT_TRUE(shared) << shared.error().message;
  v1::Scene scene = tests::block_with_probe(GetParam().double_precision);
  scene.mutable_solver()->set_cg_tolerance(GetParam().double_precision ? 1e-14 : 1e-6);
  scene.mutable_solver()->set_cg_max_iterations(400);
  const Trajectory rest = run(*cuda_, scene, 0, true);
  const Trajectory whole = run(*cuda_, scene, kSteps, true), alone = run(**shared, scene, kSteps, true);
  EXPECT_LT(alone.patches, whole.patches);
  EXPECT_LT(relative_difference(whole.positions, alone.positions, rest.positions), tolerance());
  std::vector<Trajectory> together(kScenes);
  {
    std::vector<std::jthread> threads;
    for (Trajectory& one : together) threads.emplace_back([&] { one = run(**shared, scene, kSteps, true); });
  }
  for (const Trajectory& one : together) EXPECT_EQ(one.positions, alone.positions);
}

/// Patches with more rows than a thread block has threads: tiles stream the matrix, and blocks serve two rows
/// (matrix/tiles.h). The sizes cover all vectors in shared memory, q one tile at a time, no room for most vectors, and
/// columns of more than 16 bits.
TEST_P(CudaAgreement, BeamsThatAreStreamedAndRepeat) {
  struct Size {
    std::uint32_t cells_x, cells, patches;
    double size_x_m;
    int steps;
  };
  for (const Size size :
       {Size{24, 12, 3, 8, 10}, Size{24, 12, 1, 8, 10}, Size{24, 20, 1, 8, 10}, Size{32, 32, 1, 1, 2}}) {
    SCOPED_TRACE(testing::Message() << size.cells << " cells across, " << size.patches << " patches");
    tests::Beam beam;
    beam.cells_x = size.cells_x;
    beam.cells_y = beam.cells_z = size.cells;
    beam.size_x_m = size.size_x_m;
    beam.linear = GetParam().linear;
    beam.double_precision = GetParam().double_precision;
    beam.cg_max_iterations = 1000;
    beam.cg_tolerance = beam.double_precision ? 1e-14 : 1e-6;
    const auto scene_of = [](const tests::Beam& of) {
      v1::Scene out = tests::beam_scene(of);
      out.mutable_solver()->set_coarse_level(false);  // a streamed matrix has none
      return out;
    };
    const v1::Scene scene = scene_of(beam);
    model::PatchPolicy policy = cuda_->patch_policy(model::requested_cpu_threads(scene));
    policy.max_patches = size.patches;
    const Trajectory rest = run(*cpu_, scene, 0, false), cpu = run(*cpu_, scene, size.steps, false);
    const Trajectory cuda = run(*cuda_, scene, size.steps, false, &policy);
    const Trajectory again = run(*cuda_, scene, size.steps, false, &policy);
    EXPECT_EQ(cuda.storage, matrix::Storage::kTiles) << "the test needs a streamed matrix";
    EXPECT_EQ(cuda.largest_patch > 1u << 15, size.cells == 32)
        << "only the largest size must need columns of more than 16 bits";
    EXPECT_LT(relative_difference(cpu.positions, cuda.positions, rest.positions), tolerance());
    EXPECT_EQ(cuda.positions, again.positions);
    if (beam.double_precision) continue;
    // The streamed matrix has fewer digits than float (matrix/packed_block.h). The error must still be that of the
    // solve for smaller patches, which stores full floats.
    const Trajectory resident = run(*cuda_, scene, size.steps, false);
    EXPECT_EQ(resident.storage, matrix::Storage::kRows) << "the comparison needs a resident matrix";
    beam.double_precision = true;
    beam.cg_tolerance = 1e-14;
    const Trajectory exact = run(*cpu_, scene_of(beam), size.steps, false);
    const double lost = relative_difference(exact.positions, resident.positions, rest.positions);
    const double lost_packed = relative_difference(exact.positions, cuda.positions, rest.positions);
    RecordProperty("lost_" + std::to_string(size.cells) + "_" + std::to_string(size.patches),
                   testing::PrintToString(lost) + " " + testing::PrintToString(lost_packed));
    EXPECT_LT(lost_packed, 2 * lost);
  }
}

INSTANTIATE_TEST_SUITE_P(Laws, CudaAgreement,
                         testing::Values(Parameters{false, false}, Parameters{false, true}, Parameters{true, false},
                                         Parameters{true, true}),
                         [](const auto& one) { return testing::PrintToString(one.param); });

/// The same properties for different numbers of CPU threads; needs no GPU.
TEST(CpuTeams, AgreeAndRepeat) {
  tests::Beam beam;
  beam.double_precision = true;
  beam.cg_max_iterations = 400;
  beam.cg_tolerance = 1e-14;
  beam.cells_y = beam.cells_z = 8;
  const v1::Scene scene = tests::beam_scene(beam);
  const auto one = backend::make_cpu_backend(1), three = backend::make_cpu_backend(3);
  const Trajectory rest = run(*one, scene, 0, false);
  const Trajectory single = run(*one, scene, 30, false), team = run(*three, scene, 30, false),
                   again = run(*three, scene, 30, false);
  EXPECT_EQ(single.patches, 1u);
  EXPECT_EQ(team.patches, 3u) << "the test needs several patches";
  EXPECT_EQ(team.positions, again.positions);
  EXPECT_LT(relative_difference(single.positions, team.positions, rest.positions), 1e-10);
}

/// Edges of one thread's bar touch those of another's.
TEST(CpuTeams, AgreeOnCrossedRidges) {
  tests::Ridges ridges;
  ridges.lower_cells = ridges.upper_cells = 131;  // 1,056 nodes: two patches
  ridges.gap_m = 0.002;
  ridges.friction = 0.3;
  ridges.dt_s = 0.005;
  v1::Scene scene = tests::crossed_ridges(ridges);
  scene.mutable_solver()->set_cg_tolerance(1e-14);
  scene.mutable_bodies()->SwapElements(0, 1);
  const auto one = backend::make_cpu_backend(1), three = backend::make_cpu_backend(3);
  const Trajectory rest = run(*one, scene, 0, false);
  const Trajectory single = run(*one, scene, 40, false), team = run(*three, scene, 40, false),
                   again = run(*three, scene, 40, false);
  EXPECT_GT(team.patches, 1u) << "the test needs several patches";
  EXPECT_EQ(team.positions, again.positions);
  EXPECT_LT(relative_difference(single.positions, team.positions, rest.positions), 1e-10);
}

}  // namespace
}  // namespace tensormass
