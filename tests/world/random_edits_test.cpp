#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <map>
#include <optional>
#include <random>
#include <set>
#include <string>
#include <vector>

#include <unistd.h>

#include <gtest/gtest.h>

#include "support/editing.h"
#include "support/on_runner.h"
#include "support/recorded.h"
#include "world/runner.h"

/// Random edits in a row: material burnt away, springs severed, values adjusted under a tool that presses, tools and
/// attachments that come and go, resets, snapshots and restored ones. Nothing fails but what the scene refuses in
/// words; mass is balanced after each; the recording is repeated to the last bit; memory stays flat.
///
/// TENSORMASS_RANDOM_EDITS says how many. 10,000 of them: docs/decisions/recording.md
namespace tensormass::world {
namespace {

constexpr int kUsualEdits = 150;
/// Edits of one recording: its rings have room for so many with all their steps.
constexpr int kEditsOfRecording = 50;

int edits_wanted() {
  const char* const wanted = std::getenv("TENSORMASS_RANDOM_EDITS");
  return wanted == nullptr ? kUsualEdits : std::atoi(wanted);
}

/// Returns the memory that the process has [bytes].
std::size_t resident_bytes() {
  std::ifstream file("/proc/self/statm");
  std::size_t pages = 0, resident = 0;
  file >> pages >> resident;
  return resident * static_cast<std::size_t>(sysconf(_SC_PAGESIZE));
}

/// Two beams, joined by springs, with a probe above the first. In float the first one's tangents lag.
v1::Scene scene_of(bool in_double) {
  v1::Scene scene =
      tests::edited_beam({.double_precision = in_double, .cells = 2, .threads = 1, .lag_steps = in_double ? 1u : 4u});
  scene.mutable_streams()->set_frame_rate_hz(60);
  scene.mutable_solver()->set_cg_max_iterations(40);
  scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
  v1::Body& other = *scene.add_bodies();
  other = scene.bodies(0);
  other.set_name("other");
  *other.mutable_law() = tests::law("hooke", 1e5, 0.3);
  tests::set(*other.mutable_mesh()->mutable_translation_m(), 0, 0, 0.12);
  tests::attach_every_second(scene, "strings", "beam", "other", 0, 20);
  tests::add_probe(scene, "probe", 0.02, 0.15, 0.12, 0.05).set_friction_coefficient(0.3);
  return scene;
}

class RandomScene {
 public:
  RandomScene(const v1::Scene& scene, std::uint32_t seed) : random_(seed) {
    const model::ReadBodies bodies = tests::bodies_of(scene);
    for (const model::ReadBody& body : bodies.bodies) {
      std::vector<double>& volumes = volumes_.emplace_back();
      mesh::for_each_element(body.mesh, [&](std::uint32_t, const mesh::Topology&, std::span<const std::uint32_t> of) {
        const auto x = [&](std::size_t k) { return body.mesh.nodes[of[k]]; };
        volumes.push_back(std::abs((x(1) - x(0)).cross(x(2) - x(0)).dot(x(3) - x(0))) / 6);
      });
      kept_.emplace_back(volumes.size(), 1.0);
      names_.push_back(body.name);
    }
  }

  /// Does one edit, or is refused.
  void edit(Runner& runner) {
    switch (random_() % 17) {
      case 0:
        ASSERT_TRUE(runner.reset());
        clips_.clear();
        for (std::vector<double>& of_body : kept_) std::fill(of_body.begin(), of_body.end(), 1.0);
        return;
      case 1:
        if (auto saved = runner.snapshot()) snapshot_ = {std::move(*saved), kept_};
        return;
      case 2:
        if (!snapshot_) return;
        if (const auto restored = runner.restore(snapshot_->answer.snapshot())) {
          kept_ = snapshot_->kept;
        } else {
          EXPECT_EQ(restored.error().code, ErrorCode::kFailedPrecondition) << restored.error().message;
        }
        return;
      case 3:
      case 4:
      case 5:
      case 6:
        return adjust(runner);
      case 7:
        return sever(runner);
      case 8:
        return move(runner);
      case 9:
        return change_tools(runner);
      case 10:
        return change_attachments(runner);
      default:
        return burn(runner);
    }
  }

  double removed_kg() const {
    double sum = 0;
    for (std::size_t b = 0; b < kept_.size(); ++b) {
      for (std::size_t e = 0; e < kept_[b].size(); ++e) sum += 1000 * (1 - kept_[b][e]) * volumes_[b][e];
    }
    return sum;
  }
  std::uint32_t operator()() { return static_cast<std::uint32_t>(random_()); }

 private:
  struct Kept {
    v1::SnapshotSceneResponse answer;
    std::vector<std::vector<double>> kept;
  };

  double uniform() { return std::uniform_real_distribution<double>(0, 1)(random_); }

  void adjust(Runner& runner) {
    v1::SceneAdjustments values;
    if (random_() % 2 == 0) tests::set(*values.mutable_gravity_m_per_s2(), uniform(), -10 * uniform(), uniform());
    v1::BodyAdjustment& body = *values.add_bodies();
    body.set_body(names_[random_() % 2]);
    if (random_() % 2 == 0) body.set_stiffness_factor(std::exp(3 * uniform() - 1));
    if (random_() % 2 == 0) body.set_rayleigh_mass_per_s(uniform());
    if (random_() % 2 == 0) body.set_rayleigh_stiffness_s(0.01 * uniform());
    const auto adjusted = runner.adjust(values);
    EXPECT_TRUE(adjusted) << adjusted.error().message;
  }

  void sever(Runner& runner) {
    v1::SceneEdit edit;
    v1::Severing& severing = *edit.add_severings();
    const bool severs_clip = !clips_.empty() && random_() % 2 == 0;
    severing.set_attachment(severs_clip ? clips_.back() : "strings");
    severing.add_springs(static_cast<std::uint32_t>(random_() % (severs_clip ? 3 : 10)));
    if (const auto severed = runner.edit(edit); !severed) {
      EXPECT_EQ(severed.error().code, ErrorCode::kFailedPrecondition) << severed.error().message;
    }
  }

  void move(Runner& runner) {
    v1::ToolPose pose;
    tests::set(*pose.mutable_position_m(), 0.05 + 0.1 * uniform(), 0.1 + 0.02 * uniform(), 0.05);
    EXPECT_TRUE(runner.submit_pose("probe", pose));
  }

  /// Adds a tool, or removes one that was added; then moves one of them.
  void change_tools(Runner& runner) {
    v1::SceneEdit edit;
    if (tools_.empty() || (tools_.size() < 4 && random_() % 2 == 0)) {
      tools_.push_back("tool" + std::to_string(random_() % 3));
      v1::Scene with;
      tests::add_probe(with, tools_.back(), 0.01 + 0.01 * uniform(), 0.3 * uniform(), 0.13, 0.05);
      with.mutable_tools(0)->set_friction_coefficient(random_() % 2 == 0 ? 0 : 0.2);
      *edit.add_add_tools() = with.tools(0);
    } else {
      const std::size_t i = random_() % tools_.size();
      edit.add_remove_tools(tools_[i]);
      tools_.erase(tools_.begin() + static_cast<std::ptrdiff_t>(i));
    }
    if (const auto changed = runner.edit(edit); !changed) {
      EXPECT_EQ(changed.error().code, ErrorCode::kAlreadyExists) << changed.error().message;
      tools_.pop_back();
    }
    if (tools_.empty()) return;
    v1::ToolPose pose;
    tests::set(*pose.mutable_position_m(), 0.1 + 0.1 * uniform(), 0.105 + 0.02 * uniform(), 0.05);
    EXPECT_TRUE(runner.submit_pose(tools_.back(), pose));
  }

  /// Adds a clip of three springs, or removes one that was added.
  void change_attachments(Runner& runner) {
    v1::SceneEdit edit;
    const bool adds = clips_.empty() || (clips_.size() < 5 && random_() % 2 == 0);
    const std::string name = adds ? "clip" + std::to_string(random_() % 4) : clips_[random_() % clips_.size()];
    if (adds) {
      v1::Attachment& clip = *edit.add_add_attachments();
      clip.set_name(name);
      clip.set_body("beam");
      clip.set_other(random_() % 2 == 0 ? "other" : "beam");
      std::set<std::uint32_t> nodes;
      while (nodes.size() < 4) nodes.insert(static_cast<std::uint32_t>(random_() % 45));
      clip.mutable_other_region()->mutable_nodes()->add_indices(*nodes.begin());
      nodes.erase(nodes.begin());
      clip.mutable_region()->mutable_nodes()->mutable_indices()->Assign(nodes.begin(), nodes.end());
      clip.set_stiffness_n_per_m(std::exp(6 * uniform()));
      if (random_() % 3 == 0) clip.set_breaking_force_n(uniform());
      if (random_() % 3 == 0) clip.add_rest_lengths_m(0.05 * uniform());
    } else {
      edit.add_remove_attachments(name);
    }
    if (const auto changed = runner.edit(edit); !changed) {
      EXPECT_TRUE(adds) << changed.error().message;
      const ErrorCode code = changed.error().code;  // the name is taken, or a node has no material
      EXPECT_TRUE(code == ErrorCode::kAlreadyExists || code == ErrorCode::kFailedPrecondition)
          << changed.error().message;
      return;
    }
    if (adds) {
      clips_.push_back(name);
    } else {
      std::erase(clips_, name);
    }
  }

  void burn(Runner& runner) {
    const std::size_t b = random_() % 2;
    v1::SceneEdit edit;
    v1::Ablation& ablation = *edit.add_ablations();
    ablation.set_body(names_[b]);
    std::map<std::uint32_t, double> wanted;
    for (int i = 0; i < 2; ++i) {
      wanted[static_cast<std::uint32_t>(random_() % kept_[b].size())] = random_() % 2 == 0 ? 0 : 0.9 * uniform();
    }
    for (const auto& [element, share] : wanted) {
      ablation.add_elements(element);
      ablation.add_kept(share * kept_[b][element]);
    }
    const auto burnt = runner.edit(edit);
    if (!burnt) {
      // Gone already, the last of a body, or more than the surface has room for.
      const ErrorCode code = burnt.error().code;
      EXPECT_TRUE(code == ErrorCode::kFailedPrecondition || code == ErrorCode::kResourceExhausted)
          << burnt.error().message;
      return;
    }
    for (int i = 0; i < ablation.elements_size(); ++i) kept_[b][ablation.elements(i)] = ablation.kept(i);
  }

  std::mt19937 random_;
  std::vector<std::vector<double>> volumes_, kept_;  // [body, element]
  std::vector<std::string> names_, tools_, clips_;   // tools and attachments that were added
  std::optional<Kept> snapshot_;
};

class RandomEditsInARow : public tests::OnRunner {};
TM_ON_EACH_BACKEND(RandomEditsInARow);

TEST_P(RandomEditsInARow, AreBalancedAndRepeated) {
  const int wanted = edits_wanted();
  for (const bool in_double : {true, false}) {
    SCOPED_TRACE(in_double ? "double" : "float");
    const v1::Scene scene = scene_of(in_double);
    const auto runner = load(scene);
    RandomScene random(scene, 11);
    std::size_t early_bytes = 0;
    for (int done = 0; done < wanted;) {
      const auto started = runner->record({.check_every_steps = 5, .reset = false});
      ASSERT_TRUE(started) << started.error().message;
      for (int i = 0; i < kEditsOfRecording && done < wanted; ++i, ++done) {
        random.edit(*runner);
        const double removed = random.removed_kg();
        ASSERT_NEAR(runner->status().removed_mass_kg(), removed, (in_double ? 1e-12 : 1e-5) * std::max(removed, 1.0));
        const auto stepped = runner->step(1 + random() % 4);
        ASSERT_TRUE(stepped) << "edit " << done << ": " << stepped.error().message;
      }
      const tests::Recorded recorded = tests::take_recorded(*started);
      runner->stop_recording(started->recording);
      ASSERT_FALSE(recorded.checks.empty());
      const auto other = load(scene);
      ASSERT_NO_FATAL_FAILURE(tests::expect_repeats(*other, *started, recorded));
      if (HasFailure()) return;
      if (early_bytes == 0 && done >= wanted / 4) early_bytes = resident_bytes();
    }
    constexpr std::size_t kSame = std::size_t{24} << 20;
    EXPECT_LT(resident_bytes(), early_bytes + kSame);
    std::printf("%d edits, %zu MiB, at first %zu\n", wanted, resident_bytes() >> 20, early_bytes >> 20);
  }
}

}  // namespace
}  // namespace tensormass::world
