#include "world/snapshot.h"

#include <functional>
#include <limits>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "core/limits.h"
#include "support/laws.h"
#include "support/on_runner.h"
#include "support/scenes.h"
#include "tensormass/v1/recording.pb.h"
#include "world/runner.h"

/// A restored scene goes on as if nothing had happened, and other bytes are refused.
namespace tensormass::world {
namespace {

struct Kind {
  const char* name;
  std::function<void(v1::Scene&)> change;
};

v1::Scene scene_of(const Kind& kind) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  scene.mutable_solver()->set_cg_tolerance(1e-3);
  kind.change(scene);
  return scene;
}

/// Adds a block that lies on the first one and is linked to it, beside the probe.
void add_links(v1::Scene& s) {
  v1::Body& above = *s.add_bodies();
  above = s.bodies(0);
  above.set_name("above");
  above.clear_fixed();
  above.mutable_mesh()->set_scale(0.3);
  tests::set(*above.mutable_mesh()->mutable_translation_m(), 0, 0.051, 0);
  v1::BodyContact& contact = *s.add_body_contacts();
  contact.set_body("above");
  contact.set_other(s.bodies(0).name());
  contact.set_friction_coefficient(0.3);
  v1::Attachment& spring = *s.add_attachments();
  spring.set_name("spring");
  spring.set_body("above");
  spring.set_other(s.bodies(0).name());
  for (std::uint32_t node = 0; node < 5; ++node) {
    spring.mutable_region()->mutable_nodes()->add_indices(node);
    spring.mutable_other_region()->mutable_nodes()->add_indices(node);
  }
  spring.set_stiffness_n_per_m(100);
  spring.set_breaking_force_n(0.1);
}

const std::vector<Kind>& kinds() {
  static const std::vector<Kind> all{
      {"euler", [](v1::Scene&) {}},
      {"friction", [](v1::Scene& s) { s.mutable_tools(0)->set_friction_coefficient(0.5); }},
      {"bdf2", [](v1::Scene& s) { s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_BDF2); }},
      {"double_midpoint",
       [](v1::Scene& s) {
         s.mutable_solver()->set_precision(v1::Solver::PRECISION_DOUBLE);
         s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT);
       }},
      {"prony",
       [](v1::Scene& s) {
         v1::Law& law = *s.mutable_bodies(0)->mutable_law();
         law = tests::law("neo_hookean", 5e3, 0.4);
         v1::PronyTerm& term = *law.add_prony();
         term.set_share(0.4);
         term.set_relaxation_time_s(0.1);
       }},
      {"lagged_tangents", [](v1::Scene& s) { s.mutable_solver()->set_tangent_lag_steps(8); }},
      {"mass", [](v1::Scene& s) { s.mutable_tools(0)->set_mass_kg(0.05); }},
      {"bdf2_kept_forces",
       [](v1::Scene& s) {
         s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_BDF2);
         s.mutable_tools(0)->set_contact_method(v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN);
       }},
      {"links", add_links},
      {"midpoint_links",
       [](v1::Scene& s) {
         add_links(s);
         s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT);
       }},
      // Without friction a contact remembers only on which side of its own surface a node is.
      {"self_contact", [](v1::Scene& s) { s.add_body_contacts()->set_body(s.bodies(0).name()); }},
      {"newton", [](v1::Scene& s) { s.mutable_solver()->set_newton_max_iterations(4); }},
      {"two_threads",
       [](v1::Scene& s) {
         s = tests::block_with_probe(false, 14);
         s.mutable_solver()->set_cpu_threads(2);
       }},
  };
  return all;
}

class Snapshots : public tests::OnRunner {
 protected:
  /// Presses and drags the probe. Returns the positions, the force and the time at the end.
  static std::string drag(Runner& runner, int from, int to) {
    for (int i = from; i < to; ++i) {
      v1::ToolPose pose;
      tests::set(*pose.mutable_position_m(), 0.05 + 0.0002 * i, 0.0595 - 0.0001 * i, 0.05);
      if (i % 10 != 3) {
        EXPECT_TRUE(runner.submit_pose("probe", pose));
      }
      const auto stepped = runner.step(1);
      EXPECT_TRUE(stepped) << stepped.error().message;
    }
    auto positions = runner.positions(runner.topology()->bodies(0).name());
    auto feedback = runner.feedback("probe");
    if (!positions || !feedback) throw std::runtime_error("no state");
    const v1::SceneStatus status = runner.status();
    return positions->positions() + feedback->force_n().SerializeAsString() +
           feedback->friction_n().SerializeAsString() + std::to_string(status.simulated_time_s()) + " " +
           std::to_string(status.work_j());
  }

  static std::string take(Runner& runner) {
    auto snapshot = runner.snapshot();
    if (!snapshot) throw std::runtime_error(snapshot.error().message);
    return snapshot->snapshot();
  }

  static void expect_refused(Runner& runner, const std::string& snapshot, const std::string& part) {
    const auto restored = runner.restore(snapshot);
    ASSERT_FALSE(restored) << part;
    EXPECT_NE(restored.error().message.find(part), std::string::npos) << restored.error().message;
  }
};

TEST_P(Snapshots, GoOnToTheLastBit) {
  for (const Kind& kind : kinds()) {
    SCOPED_TRACE(kind.name);
    const auto runner = load(scene_of(kind));
    drag(*runner, 0, 20);
    const std::string snapshot = take(*runner);
    const std::string once = drag(*runner, 20, 35);
    // A contact that has just jumped must not matter to what is restored.
    v1::ToolPose away;
    tests::set(*away.mutable_position_m(), 0.05, 0.2, 0.05);
    ASSERT_TRUE(runner->submit_pose("probe", away));
    ASSERT_TRUE(runner->step(1));
    const auto restored = runner->restore(snapshot);
    ASSERT_TRUE(restored) << restored.error().message;
    EXPECT_EQ(restored->step(), 20u);
    EXPECT_EQ(take(*runner), snapshot) << "a snapshot of what was restored is the same";
    EXPECT_EQ(drag(*runner, 20, 35), once);
    const auto another = load(scene_of(kind));
    ASSERT_TRUE(another->restore(snapshot));
    EXPECT_EQ(drag(*another, 20, 35), once) << "in a scene that was loaded anew";
    EXPECT_GT(runner->feedback("probe")->force_n().y(), 0) << "the probe touched";
  }
}

TEST_P(Snapshots, OfAnotherSceneAreRefused) {
  const auto runner = load(scene_of(kinds()[0]));
  ASSERT_TRUE(runner->step(2));
  v1::Scene stiffer = scene_of(kinds()[0]);
  stiffer.mutable_bodies(0)->set_rayleigh_mass_per_s(0.1);
  expect_refused(*runner, take(*load(stiffer)), "another scene");
  v1::Scene renamed = scene_of(kinds()[0]);
  renamed.set_name("renamed");
  renamed.mutable_streams()->set_frame_rate_hz(5);
  EXPECT_TRUE(runner->restore(take(*load(renamed)))) << "the state has neither its name nor its streams";
}

/// node_state_test.cpp compares what comes after it.
TEST_P(Snapshots, MoveBetweenNumbersOfThreads) {
  v1::Scene wide = scene_of(kinds().back());
  const auto two = load(wide);
  wide.mutable_solver()->set_cpu_threads(1);
  const auto one = load(wide);
  drag(*two, 0, 10);
  const std::string snapshot = take(*two);
  ASSERT_TRUE(one->restore(snapshot));
  EXPECT_EQ(take(*one), snapshot);
  drag(*one, 10, 20);
  const std::string later = take(*one);
  ASSERT_TRUE(two->restore(later));
  EXPECT_EQ(take(*two), later);
}

TEST_P(Snapshots, LeaveOutZeros) {
  const auto runner = load(scene_of(kinds().back()));
  const std::string at_rest = take(*runner);
  EXPECT_LT(at_rest.size(), 4096u) << "a file would pack it so small that a reader refuses it";
  drag(*runner, 0, 3);
  EXPECT_GT(take(*runner).size(), 100'000u);
  ASSERT_TRUE(runner->restore(at_rest));
  EXPECT_EQ(take(*runner), at_rest);
}

TEST_P(Snapshots, DamagedOnesAreRefusedAndChangeNothing) {
  const auto runner = load(scene_of(kinds()[1]));
  drag(*runner, 0, 5);
  const std::string snapshot = take(*runner);
  ASSERT_TRUE(runner->step(1));
  for (std::size_t size = 0; size < snapshot.size(); size += 1 + size / 2) {
    expect_refused(*runner, snapshot.substr(0, size), "snapshot: ");
  }
  for (std::size_t at = 0; at < snapshot.size(); at += 1 + at / 3) {
    std::string flipped = snapshot;
    flipped[at] = static_cast<char>(flipped[at] ^ 4);
    // Only bytes 12 to 15 are reserved.
    if (at < 12 || at > 15) expect_refused(*runner, flipped, "snapshot: ");
  }
  std::string newer = snapshot;
  for (const char version : {1, 3}) {
    newer[8] = version;
    expect_refused(*runner, newer, "but this server reads version 2; take it again with this server");
  }
  expect_refused(*runner, "a text", "too few");
  expect_refused(*runner, std::string(64, 'x'), "not a snapshot");
  EXPECT_EQ(runner->status().step(), 6u);
}

TM_ON_EACH_BACKEND(Snapshots);

/// A content that a correct checksum protects may still be wrong: it comes from outside.
class SnapshotContent : public testing::Test {
 protected:
  SnapshotContent() {
    auto runner = Runner::start(scene_of(kinds()[1]), {BackendChoice::kCpu, 1});
    if (!runner) throw std::runtime_error(runner.error().message);
    loaded = std::move(*runner);
    v1::ToolPose pose;  // presses the probe in, so that no array has zeros alone
    tests::set(*pose.mutable_position_m(), 0.052, 0.056, 0.05);
    EXPECT_TRUE(loaded->submit_pose("probe", pose));
    EXPECT_TRUE(loaded->step(10));
    const std::string snapshot = loaded->snapshot()->snapshot();
    EXPECT_TRUE(good.ParseFromString(snapshot.substr(32)));
  }

  void expect_refused(const v1::SnapshotState& content, const std::string& part) const {
    const auto restored = loaded->restore(seal_snapshot(content.SerializeAsString()));
    ASSERT_FALSE(restored) << part;
    EXPECT_NE(restored.error().message.find(part), std::string::npos) << restored.error().message;
  }

  std::unique_ptr<Runner> loaded;
  v1::SnapshotState good;
};

TEST_F(SnapshotContent, IsChecked) {
  EXPECT_TRUE(loaded->restore(seal_snapshot(good.SerializeAsString())));
  const double nan = std::numeric_limits<double>::quiet_NaN();
  v1::SnapshotState bad = good;
  bad.mutable_displacement()->append(8, '\0');
  expect_refused(bad, "displacement");
  bad = good;
  bad.mutable_velocity()->replace(0, 8, reinterpret_cast<const char*>(&nan), 8);
  expect_refused(bad, "velocity: has numbers that are not finite");
  const auto put = [](std::string* numbers, double value) {
    numbers->replace(0, sizeof(value), reinterpret_cast<const char*>(&value), sizeof(value));
  };
  for (const double beyond_float : {1e39, -1e300}) {
    bad = good;
    put(bad.mutable_displacement(), beyond_float);
    expect_refused(bad, "displacement: has ");
    bad = good;
    put(bad.mutable_velocity(), beyond_float);
    expect_refused(bad, "velocity: has ");
    bad = good;
    put(bad.mutable_solution(), beyond_float);
    expect_refused(bad, "solution: has ");
    bad = good;
    bad.mutable_tools(0)->set_young_modulus_pa(std::abs(beyond_float));
    expect_refused(bad, "young_modulus_pa");
    bad = good;
    bad.set_kinetic_energy_j(beyond_float);
    expect_refused(bad, "energies");
  }
  bad = good;
  put(bad.mutable_displacement(), 1000);
  expect_refused(bad, "displacement: a node is 1e+03 m from its rest position, farther than ");
  for (const char* array : {"displacement", "velocity", "slips", "solution"}) {
    SCOPED_TRACE(array);
    bad = good;
    const auto* field = v1::SnapshotState::descriptor()->FindFieldByName(array);
    const std::string present = good.GetReflection()->GetString(good, field);
    ASSERT_FALSE(present.empty());
    bad.GetReflection()->SetString(&bad, field, present.substr(8));
    expect_refused(bad, array);
    bad.GetReflection()->SetString(&bad, field, "");
    EXPECT_TRUE(loaded->restore(seal_snapshot(bad.SerializeAsString()))) << "an array of zeros is left out";
  }
  for (const char* array : {"link_slips", "internal_variables", "broken_springs"}) {
    SCOPED_TRACE(array);
    bad = good;
    const auto* field = v1::SnapshotState::descriptor()->FindFieldByName(array);
    bad.GetReflection()->SetString(&bad, field, std::string(8, '\0'));
    expect_refused(bad, array);
  }
  bad = good;
  bad.add_edge_pairs()->add_nodes(1);
  expect_refused(bad, "edge_pairs[0].nodes: 1, not 4");
  for (std::uint32_t node = 2; node < 5; ++node) bad.mutable_edge_pairs(0)->add_nodes(node);
  expect_refused(bad, "edge_pairs[0]: contact 0");
  bad = good;
  bad.mutable_previous_displacement()->assign(good.displacement());
  bad.mutable_previous_velocity()->assign(good.velocity());
  expect_refused(bad, "previous_displacement");
  bad = good;
  bad.clear_tools();
  expect_refused(bad, "tools");
  bad = good;
  bad.mutable_tools(0)->mutable_target()->set_tool("knife");
  expect_refused(bad, "knife");
  bad = good;
  bad.mutable_tools(0)->set_fade(2);
  expect_refused(bad, "fade");
  bad = good;
  bad.mutable_tools(0)->mutable_pose()->mutable_position_m()->set_x(2 * limits::kMaxLength);
  expect_refused(bad, "position_m");
  bad = good;
  bad.set_work_j(nan);
  expect_refused(bad, "energies");
  bad = good;
  bad.set_cg_iteration_limit(0);
  expect_refused(bad, "cg_iteration_limit");
}

TEST_F(SnapshotContent, HasOnlySpringsThatAreBrokenOrNot) {
  v1::Scene linked = scene_of(kinds()[0]);
  add_links(linked);
  loaded = Runner::start(linked, {BackendChoice::kCpu, 1}).value();
  v1::SnapshotState content;
  ASSERT_TRUE(content.ParseFromString(loaded->snapshot()->snapshot().substr(32)));
  *content.mutable_broken_springs() = std::string("\1\0\0\1\0", 5);
  ASSERT_TRUE(loaded->restore(seal_snapshot(content.SerializeAsString())));
  EXPECT_TRUE(loaded->snapshot()->snapshot().find(content.broken_springs()) != std::string::npos);
  for (const char* bad : {"\2", "\xff"}) {
    content.mutable_broken_springs()->replace(1, 1, bad);
    expect_refused(content, "broken_springs: a spring is broken (1) or not (0)");
  }
  *content.mutable_broken_springs() = std::string(6, '\1');
  expect_refused(content, "broken_springs: 6 bytes, but this scene has 5");
}

}  // namespace
}  // namespace tensormass::world
