#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <numbers>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/momentum.h"
#include "support/on_runner.h"
#include "support/recorded.h"
#include "support/refused.h"
#include "support/strands.h"
#include "world/runner.h"

/// Tools that sever springs of attachments: which ones, when, what is felt of it, what clients are told, and what is
/// refused.
namespace tensormass::world {
namespace {

using tests::kGapBegins;
using tests::kGapEnds;
using tests::kReachM;
using tests::kSeveringRadiusM;

constexpr double kWithinM = kReachM + kSeveringRadiusM;

/// Returns the springs at rest, in the order of the scene: upright, through (x, z).
std::vector<Vec3<double>> strands_of(const World& world) {
  const model::Model& m = world.model();
  std::vector<Vec3<double>> out;
  for (const std::uint32_t place : m.links.spring_places) {
    const double* rest = m.rest.data() + std::size_t{4} * m.links.spring_rows[std::size_t{2} * place];
    out.emplace_back(rest[0], 0, rest[2]);
  }
  return out;
}

std::vector<bool> severed_of(const World& world) {
  std::vector<bool> out;
  for (std::size_t i = 0; i < world.model().links.spring_count(); ++i) {
    out.push_back((world.broken_springs()[i / 8] >> i % 8 & 1) != 0);
  }
  return out;
}

/// Distance from an upright strand to a line, by trying many points of it [m].
double distance_m(const Vec3<double>& strand, const Vec3<double>& from, const Vec3<double>& to) {
  double least = std::numeric_limits<double>::infinity();
  constexpr int kPoints = 2000;
  for (int i = 0; i <= kPoints; ++i) {
    const Vec3<double> p = from + (to - from) * (static_cast<double>(i) / kPoints);
    const double beyond = std::max({kGapBegins - p[1], 0.0, p[1] - kGapEnds});
    least = std::min(least, std::hypot(p[0] - strand[0], beyond, p[2] - strand[2]));
  }
  return least;
}

/// A tool, and the line of it that severs when the tool is at the origin.
struct Kind {
  std::string name;
  std::function<void(v1::Tool&)> set;
  std::vector<Vec3<double>> line;
};

const Vec3<double> kTip = Vec3<double>::Zero();

std::vector<Kind> kinds() {
  const auto capsule = [](double length_m) {
    return [length_m](v1::Tool& tool) {
      tool.mutable_capsule()->set_radius_m(kSeveringRadiusM);
      tool.mutable_capsule()->set_length_m(0.1);
      tool.mutable_dissection()->set_length_m(length_m);
      // A quarter turn about y: the shaft runs along x. Then an eighth back: along x and away from the strands.
      const double half = 3 * std::numbers::pi / 8;
      tool.mutable_orientation()->set_w(std::cos(half));
      tool.mutable_orientation()->set_y(std::sin(half));
    };
  };
  const double aside = std::sqrt(0.5);
  const Vec3<double> along(aside, 0, -aside);
  return {
      {"sphere", [](v1::Tool&) {}, {kTip, kTip}},
      {"capsule's tip", capsule(0), {kTip, kTip}},
      {"part of a capsule", capsule(0.03), {kTip, along * 0.03}},
      {"capsule", capsule(0.11), {kTip, along * 0.1}},
      {"hook's blade",
       [](v1::Tool& tool) {
         tool.mutable_retractor()->set_radius_m(kSeveringRadiusM);
         tool.mutable_retractor()->set_blade_length_m(0.022);
         tool.mutable_retractor()->set_shaft_length_m(0.1);
         tool.mutable_dissection()->set_length_m(0.022);
         tool.mutable_orientation()->set_w(0);  // half a turn about x: the shaft runs away from the strands
         tool.mutable_orientation()->set_x(1);
       },
       {kTip, {0.022, 0, 0}}},
      {"blade and a part of the shaft",
       [](v1::Tool& tool) {
         tool.mutable_retractor()->set_radius_m(kSeveringRadiusM);
         tool.mutable_retractor()->set_blade_length_m(0.022);
         tool.mutable_retractor()->set_shaft_length_m(0.1);
         tool.mutable_dissection()->set_length_m(0.042);
       },
       {kTip, {0.022, 0, 0}, {0.022, 0, 0.02}}},
  };
}

Pose at(double x_m, double z_m) { return {{x_m, 0.03, z_m}, {1, 0, 0, 0}, {}}; }

/// Lets the lower block start higher than at rest.
void lift(v1::Scene& scene, double by_m) {
  constexpr std::size_t kNodes = 11 * 3 * 2;
  std::string displacement;
  for (std::size_t i = 0; i < kNodes; ++i) {
    for (const double value : {0.0, by_m, 0.0}) {
      displacement.append(reinterpret_cast<const char*>(&value), sizeof value);
    }
  }
  scene.mutable_bodies(0)->set_initial_displacement_m(displacement);
}

class Dissection : public tests::OnRunner {
 protected:
  std::unique_ptr<World> strung(bool in_double, const std::function<void(v1::Tool&)>& set) const {
    v1::Scene scene = tests::strung_blocks(in_double, false);
    set(*scene.mutable_tools(0));
    return start(scene);
  }
  /// Moves the tool, in its orientation.
  static void move(World& world, double x_m, double z_m) {
    Pose pose = at(x_m, z_m);
    pose.orientation = world.readings()[0].pose.orientation;
    pose.joint_values = world.readings()[0].pose.joint_values;
    world.set_tool_target(0, pose);
    ASSERT_TRUE(world.step(false));
  }
};
TM_ON_EACH_BACKEND(Dissection);

/// The tool passes in front of the strands: those that come within reach of its line are severed, and no other.
TEST_P(Dissection, SeversExactlyWhatComesWithinReach) {
  for (const bool in_double : {true, false}) {
    for (const Kind& kind : kinds()) {
      SCOPED_TRACE(kind.name + (in_double ? ", double" : ", float"));
      const auto world = strung(in_double, kind.set);
      const std::vector<Vec3<double>> strands = strands_of(*world);
      ASSERT_EQ(strands.size(), 22u);
      std::vector<bool> expected(strands.size(), false);
      for (int i = 0; i <= 20; ++i) {
        const double x_m = 0.0213 + 0.0007 * i, z_m = -0.0051 + 0.0002 * i;
        move(*world, x_m, z_m);
        for (std::size_t s = 0; s < strands.size(); ++s) {
          for (std::size_t p = 0; p + 1 < kind.line.size(); ++p) {
            const Vec3<double> tip(x_m, 0.03, z_m);
            const double apart_m = distance_m(strands[s], tip + kind.line[p], tip + kind.line[p + 1]);
            ASSERT_GT(std::abs(apart_m - kWithinM), 1e-7) << "no close call";
            if (apart_m < kWithinM) expected[s] = true;
          }
        }
        ASSERT_EQ(severed_of(*world), expected) << "step " << i + 1;
        EXPECT_FALSE(world->readings()[0].touching);
      }
      const auto count = std::count(expected.begin(), expected.end(), true);
      EXPECT_GT(count, 0);
      EXPECT_LT(count, 22);
      EXPECT_EQ(world->last().broken_springs, count);
      world->reset();
      ASSERT_TRUE(world->step(false));
      EXPECT_EQ(world->last().broken_springs, 0u) << "a reset heals";
    }
  }
}

/// A strand ends where its nodes are: a tip in front of the upper block reaches its end, and no farther.
TEST_P(Dissection, ReachesTheEndsOfStrands) {
  constexpr double kFrontM = 0.0045;
  const double above_m = std::sqrt(kWithinM * kWithinM - kFrontM * kFrontM);
  for (const bool within : {true, false}) {
    v1::Scene scene = tests::strung_blocks(true, false);
    tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, kGapEnds + above_m + (within ? -1e-5 : 1e-5),
               -kFrontM);
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    EXPECT_EQ(world->last().broken_springs, within ? 1u : 0u);
  }
}

TEST_P(Dissection, SeversSlackStrands) {
  for (const double lifted_m : {0.0, 0.002}) {
    v1::Scene scene = tests::strung_blocks(true, false);
    lift(scene, lifted_m);
    tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.03, -0.0045);
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    EXPECT_EQ(world->last().broken_springs, 1u) << "the one before the tip";
  }
}

/// Jaws sever while their round tips touch: 2 L sin(θ / 2) ≤ 2 r. Both jaws do.
TEST_P(Dissection, NeedsShutJaws) {
  constexpr double kJawM = 0.02;
  const double shut_rad = 2 * std::asin(kSeveringRadiusM / kJawM);
  const auto grasper = [](v1::Tool& tool) {
    tool.mutable_grasper()->set_radius_m(kSeveringRadiusM);
    tool.mutable_grasper()->set_jaw_length_m(kJawM);
    tool.mutable_orientation()->set_w(0);  // half a turn about x: the hinge is away from the strands
    tool.mutable_orientation()->set_x(1);
    tool.add_joint_values(1);
  };
  for (const bool in_double : {true, false}) {
    const auto world = strung(in_double, grasper);
    const std::vector<Vec3<double>> strands = strands_of(*world);
    constexpr double kBetweenM = 0.0547;  // one jaw reaches the strand at 50 mm, the other that at 60 mm
    Pose pose = at(kBetweenM, -0.005);
    pose.orientation = {0, 1, 0, 0};
    for (const double opening_rad : {1.0, 0.6, shut_rad + 1e-3}) {
      pose.joint_values[0] = opening_rad;
      world->set_tool_target(0, pose);
      ASSERT_TRUE(world->step(false));
      EXPECT_EQ(world->last().broken_springs, 0u) << opening_rad;
    }
    pose.joint_values[0] = shut_rad - 1e-3;
    world->set_tool_target(0, pose);
    ASSERT_TRUE(world->step(false));
    const double aside_m = kJawM * std::sin(pose.joint_values[0] / 2);
    const double back_m = kJawM * (1 - std::cos(pose.joint_values[0] / 2));
    std::vector<bool> expected;
    for (const Vec3<double>& strand : strands) {
      double least_m = 1;
      for (const double x_m : {kBetweenM - aside_m, kBetweenM + aside_m}) {
        least_m = std::min(least_m, std::hypot(x_m - strand[0], -0.005 - back_m - strand[2]));
      }
      ASSERT_GT(std::abs(least_m - kWithinM), 1e-5);
      expected.push_back(least_m < kWithinM);
    }
    EXPECT_EQ(severed_of(*world), expected);
    EXPECT_EQ(std::count(expected.begin(), expected.end(), true), 2);
  }
}

/// A block hangs from strands. In the step after some are severed, it feels its weight and the tension of the others.
TEST_P(Dissection, LeavesTheForceOfTheOthers) {
  for (const bool in_double : {true, false}) {
    v1::Scene scene = tests::strung_blocks(in_double, true);
    scene.mutable_bodies(0)->set_rayleigh_mass_per_s(0);
    scene.mutable_bodies(0)->set_rayleigh_stiffness_s(1e-3);
    scene.mutable_stepping()->set_dt_s(1e-4);
    scene.mutable_tools(0)->set_max_speed_m_per_s(1e3);
    constexpr double kMassKg = 1000 * 0.1 * kGapBegins * 0.01, kWeightN = 9.81 * kMassKg;
    constexpr double kSunkM = kWeightN / tests::kStrandsStiffness;
    lift(scene, -kSunkM);  // it hangs at rest: the strands are as long as its weight makes them
    const auto world = start(scene);
    const std::vector<Vec3<double>> strands = strands_of(*world);
    const auto pull_n = [&] {  // upwards, by the strands that are whole
      const std::vector<bool> severed = severed_of(*world);
      const auto whole = static_cast<double>(std::count(severed.begin(), severed.end(), false));
      return tests::kStrandsStiffness / 22 * whole * kSunkM;
    };
    const auto gained_n = [&] {  // by the lower block in one step
      const double before = tests::momentum_of(*world)[1];
      EXPECT_TRUE(world->step(false));
      return (tests::momentum_of(*world)[1] - before) / 1e-4;
    };
    EXPECT_NEAR(gained_n(), 0, 2e-3 * kWeightN) << "at rest";
    move(*world, 0.05, -0.003);  // severs at the end of this step
    const std::uint32_t severed = world->last().broken_springs;
    EXPECT_GT(severed, 0u);
    EXPECT_LT(severed, 22u);
    EXPECT_NEAR(gained_n(), pull_n() - kWeightN, 5e-3 * kWeightN);
    EXPECT_NEAR(pull_n(), kWeightN * (1 - severed / 22.0), 1e-9);
  }
}

/// A tool whose pose has expired severs nothing, nor does it while it comes back.
TEST_P(Dissection, NeedsATool) {
  const auto runner = load(tests::strung_blocks(true, false));
  v1::ToolPose pose;
  tests::set(*pose.mutable_position_m(), 0.05, 0.03, -0.05);
  pose.set_valid_for_s(0.05);
  ASSERT_TRUE(runner->submit_pose("tool", pose));
  ASSERT_TRUE(runner->step(30));
  EXPECT_TRUE(runner->feedback("tool")->retired());
  tests::set(*pose.mutable_position_m(), 0.05, 0.03, 0);
  pose.clear_valid_for_s();
  ASSERT_TRUE(runner->submit_pose("tool", pose));
  ASSERT_TRUE(runner->step(5));
  EXPECT_EQ(runner->status().broken_springs(), 0u);
  ASSERT_TRUE(runner->step(10));
  EXPECT_GT(runner->status().broken_springs(), 0u);
}

/// A call severs while the scene stands still, and its answer counts already.
TEST_P(Dissection, ByACallCountsAtOnce) {
  const auto runner = load(tests::strung_blocks(true, true));
  ASSERT_TRUE(runner->step(3));
  v1::SceneEdit edit;
  v1::Severing& severing = *edit.add_severings();
  severing.set_attachment("strands");
  severing.add_springs(2);
  severing.add_springs(5);
  const auto edited = runner->edit(edit);
  ASSERT_TRUE(edited) << edited.error().message;
  EXPECT_EQ(edited->broken_springs(), 2u);
  EXPECT_EQ(runner->status().broken_springs(), 2u);
  ASSERT_TRUE(runner->step(1));
  EXPECT_EQ(runner->status().broken_springs(), 2u);
  ASSERT_TRUE(runner->reset());
  EXPECT_EQ(runner->status().broken_springs(), 0u);
}

/// Moves the tool through the gap, from strand to strand.
void pass(Runner& runner, int from, int to) {
  for (int i = from; i < to; ++i) {
    v1::ToolPose pose;
    tests::set(*pose.mutable_position_m(), -0.01 + 0.002 * i, 0.03, -0.004);
    ASSERT_TRUE(runner.submit_pose("tool", pose));
    ASSERT_TRUE(runner.step(1));
  }
}

/// A recording begins while strands are severed, and a replay from its snapshot repeats it. So does a snapshot alone.
TEST_P(Dissection, IsRepeatedToTheLastBit) {
  for (const bool in_double : {true, false}) {
    const v1::Scene scene = tests::strung_blocks(in_double, true);
    const auto runner = load(scene), other = load(scene), third = load(scene);
    pass(*runner, 0, 15);
    const std::uint32_t before = runner->status().broken_springs();
    EXPECT_GT(before, 0u);
    const auto started = runner->record({.check_every_steps = 1, .reset = false});
    ASSERT_TRUE(started) << started.error().message;
    pass(*runner, 15, 40);
    EXPECT_GT(runner->status().broken_springs(), before);

    ASSERT_TRUE(third->restore(started->start.snapshot()));
    pass(*third, 15, 40);
    EXPECT_EQ(third->positions("lower")->positions(), runner->positions("lower")->positions());
    EXPECT_EQ(third->frame()->broken_springs(), runner->frame()->broken_springs());

    const auto [request, checks] = tests::take_recorded(*started);
    EXPECT_EQ(request.edits_size(), 0) << "what a tool severs follows from its poses";
    EXPECT_EQ(request.steps_size(), 25);
    ASSERT_FALSE(checks.empty());
    ASSERT_TRUE(other->restore(started->start.snapshot()));
    EXPECT_EQ(other->frame()->broken_springs().empty(), false);
    const auto replayed = other->replay(request);
    ASSERT_TRUE(replayed) << replayed.error().message;
    tests::expect_repeated(*replayed, checks);
    EXPECT_EQ(replayed->status().broken_springs(), runner->status().broken_springs());
  }
}

/// Events have the attachment's name, how many springs, the tool and the step; restored states and resets tell of none.
TEST_P(Dissection, IsTold) {
  const auto runner = load(tests::strung_blocks(true, false));
  v1::SceneEvents events;
  pass(*runner, 0, 40);
  ASSERT_TRUE(runner->take_events(events));
  double told = 0;
  for (const v1::SceneEvent& event : events.events()) {
    EXPECT_EQ(event.kind(), v1::SceneEvent::KIND_SEVERED);
    EXPECT_EQ(event.attachment(), "strands");
    EXPECT_EQ(event.tool(), "tool");
    EXPECT_NEAR(event.position_m().x(), -0.01 + 0.002 * (static_cast<double>(event.step()) - 1), 1e-9);
    told += event.value();
  }
  EXPECT_EQ(told, runner->status().broken_springs());
  EXPECT_GE(events.events_size(), 5) << "strand by strand";

  v1::SceneEdit edit;
  v1::Severing& severing = *edit.add_severings();
  severing.set_attachment("strands");
  for (std::uint32_t i = 0; i < 22; ++i) severing.add_springs(i);
  EXPECT_REFUSED(runner->edit(edit), ErrorCode::kFailedPrecondition, "is broken already");
  ASSERT_TRUE(runner->reset());
  ASSERT_TRUE(runner->step(3));
  ASSERT_TRUE(runner->edit(edit));
  ASSERT_TRUE(runner->step(2));
  ASSERT_TRUE(runner->take_events(events));
  const v1::SceneEvent &reset = events.events(events.events_size() - 2),
                       &call = events.events(events.events_size() - 1);
  EXPECT_EQ(reset.kind(), v1::SceneEvent::KIND_RESET);
  EXPECT_EQ(call.kind(), v1::SceneEvent::KIND_SEVERED);
  EXPECT_EQ(call.value(), 22);
  EXPECT_EQ(call.step(), 3u);
  EXPECT_EQ(call.text(), "22 springs of attachment 'strands' severed");
}

/// What pulls too hard is told as well, once.
TEST_P(Dissection, TellsOfSpringsThatBreak) {
  const auto runner = load(tests::hanging_block());
  ASSERT_TRUE(runner->step(20));
  v1::SceneEvents events;
  ASSERT_TRUE(runner->take_events(events));
  double told = 0;
  for (const v1::SceneEvent& event : events.events()) {
    EXPECT_EQ(event.kind(), v1::SceneEvent::KIND_BROKEN);
    EXPECT_EQ(event.attachment(), "weak");
    EXPECT_TRUE(event.tool().empty());
    told += event.value();
  }
  EXPECT_EQ(told, 9);
}

TEST_P(Dissection, RefusesInWords) {
  const auto refuses = [&](const std::function<void(v1::Scene&)>& change, const std::string& why) {
    v1::Scene scene = tests::strung_blocks(true, false);
    change(scene);
    EXPECT_REFUSED(Runner::start(scene, {BackendChoice::kCpu, 1}), ErrorCode::kInvalidArgument, why);
  };
  const auto dissection = [](v1::Scene& scene) -> v1::Dissection& {
    return *scene.mutable_tools(0)->mutable_dissection();
  };
  for (const double wrong :
       {-1e-3, 5.0, std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    refuses([&](v1::Scene& scene) { dissection(scene).set_reach_m(wrong); }, "dissection.reach_m");
    refuses([&](v1::Scene& scene) { dissection(scene).set_length_m(wrong); }, "dissection.length_m");
  }
  refuses([&](v1::Scene& scene) { scene.clear_attachments(); }, "no springs to sever");
  refuses(
      [&](v1::Scene& scene) {
        scene.mutable_tools(0)->set_fixed(true);
        scene.mutable_tools(0)->clear_max_force_n();
        scene.mutable_tools(0)->clear_max_torque_n_m();
      },
      "only a thin tool that moves");
  refuses(
      [&](v1::Scene& scene) {
        scene.mutable_tools(0)->mutable_box()->set_size_x_m(0.01);
        scene.mutable_tools(0)->mutable_box()->set_size_y_m(0.01);
        scene.mutable_tools(0)->mutable_box()->set_size_z_m(0.01);
      },
      "only a thin tool that moves");
}

}  // namespace
}  // namespace tensormass::world
