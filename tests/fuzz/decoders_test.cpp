#include <fcntl.h>
#include <unistd.h>

#include <cmath>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <iostream>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <fmt/format.h>
#include <google/protobuf/stubs/logging.h>
#include <gtest/gtest.h>

#include "bus/keys.h"
#include "bus/pose_input.h"
#include "control/http2_meter.h"
#include "control/scene_registry.h"
#include "fuzz/target.h"
#include "support/editing.h"
#include "support/http2.h"
#include "support/scenes.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/recording.pb.h"
#include "world/snapshot.h"

/// Each C++ decoder of what others send takes or refuses mutated bytes, and a scene goes on with finite positions.
///
/// An input is in a file while a decoder reads it, so one that ends the process, or takes longer than kMaxTime, is
/// kept. Without variables a few inputs are tried, the same ones each time. `make fuzz` builds with sanitizers and sets
///
///   FUZZ_SECONDS   for each decoder
///   FUZZ_SEED      another one gives other inputs
///   FUZZ_KEEP      folder for inputs that fail; commit one as tests/fuzz/inputs/DECODER/*.bin with its fix
namespace tensormass::fuzz {
namespace {

constexpr unsigned kMaxTime = 60;  // [s], a hundred times that of the slowest with sanitizers

/// A scene of a few elements in lockstep.
class OfScene {
 protected:
  explicit OfScene(v1::Scene scene) {
    scene.set_name("fuzzed");
    scene.mutable_stepping()->set_lockstep(true);
    scene.mutable_streams()->set_frame_rate_hz(60);
    scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
    scene_ = std::move(scene);
    load();
  }
  world::Runner& runner() { return *runner_; }
  const v1::Scene& scene() const { return scene_; }
  control::SceneRegistry& registry() { return registry_; }

  /// Steps, and checks what is published. A scene that stopped is reset, or loaded again after 100 inputs.
  void go_on() {
    (void)runner_->step(1);
    expect_finite(*runner_);
    if (++inputs_ % 100 == 0) {
      EXPECT_TRUE(registry_.unload("fuzzed"));
      load();
    } else {
      EXPECT_TRUE(runner_->reset());
    }
  }

 public:
  static void expect_finite(world::Runner& runner) {
    const auto frame = runner.frame();
    if (!frame) return;  // refused, with a reason
    const std::string& bytes = frame->positions();
    for (std::size_t at = 0; at + sizeof(float) <= bytes.size(); at += sizeof(float)) {
      float position = 0;
      std::memcpy(&position, bytes.data() + at, sizeof position);
      if (std::isfinite(position)) continue;
      ADD_FAILURE() << "a published position is " << position;
      return;
    }
  }

 private:
  void load() {
    auto loaded = registry_.load(scene_);
    ASSERT_TRUE(loaded) << loaded.error().message;
    runner_ = *loaded;
  }

  static inline const world::RunnerOptions kCpu{.backend = world::BackendChoice::kCpu, .cpu_threads = 1};
  control::SceneRegistry registry_{kCpu, [] {}};
  v1::Scene scene_;
  control::RunnerPtr runner_;
  std::size_t inputs_ = 0;
};

v1::Scene block() { return tests::block_with_probe(false, 2); }
v1::Scene edited(bool cuts) {
  v1::Scene scene = tests::edited_beam({.cells = 2, .threads = 1});
  tests::add_probe(scene, "probe", 0.02, 0.15, 0.106, 0.05);
  if (cuts) scene.mutable_editing()->mutable_cutting();
  return scene;
}

// -- the data plane ---------------------------------------------------------------------------------------------------

/// Bytes of a pose as ZeroMQ brings them: key, zero, message.
class PoseTarget final : public Target, OfScene {
 public:
  PoseTarget() : OfScene(block()) {}
  std::string mutated(Random& random) const override {
    v1::ToolPose pose;
    pose.set_sequence(random.below(5));
    pose.set_session(random.below(3));
    pose.set_valid_for_s(0.5);
    tests::set(*pose.mutable_position_m(), 0.05, 0.06, 0.05);
    pose.mutable_orientation()->set_w(1);
    for (std::size_t i = random.below(4); i > 0; --i) mutate(pose, random);
    std::string key = bus::pose_key("local", "fuzzed", "probe");
    if (random.below(5) == 0) mutate(key, random);
    std::string bytes = key + '\0' + pose.SerializeAsString();
    return random.below(4) == 0 ? changed(bytes, random) : bytes;
  }
  void run(const std::string& input) override {
    const std::size_t before = poses_ + refused_;
    input_.receive_framed(input);
    const std::size_t end = std::min(input.find('\0'), input.size());
    input_.receive(std::string_view(input).substr(0, end),
                   std::string_view(input).substr(std::min(end + 1, input.size())));
    EXPECT_EQ(poses_ + refused_, before + 2) << "each message is taken or refused, once";
    go_on();
  }

 private:
  std::size_t poses_ = 0, refused_ = 0;
  bus::BusCounters counters_;
  bus::PoseInput input_{"local",
                        [this](std::string_view, std::string_view tool, const v1::ToolPose& pose, const bus::Sender&) {
                          ++poses_;
                          (void)runner().submit_pose(tool, pose);
                        },
                        [this](const Refused&) { ++refused_; }, counters_};
};

/// Keys of streams and poses.
class KeyTarget final : public Target {
 public:
  std::string mutated(Random& random) const override {
    static const std::vector<std::string> keys{bus::pose_key("local", "demo", "probe"), "tensormass/local/demo/frame",
                                               "tensormass/local/demo/tool/probe/feedback"};
    return changed(random.one_of(keys), random);
  }
  void run(const std::string& input) override {
    if (const auto pose = bus::parse_pose_key("local", input)) {
      EXPECT_EQ(bus::pose_key("local", pose->scene, pose->tool), input);
    }
    (void)bus::parse_stream_key("local", input);
  }
};

// -- the control plane ------------------------------------------------------------------------------------------------

/// What a client and gRPC send, in turns, each part behind its length: 15 bits, and one that says whose it is.
class Http2Target final : public Target {
 public:
  std::string mutated(Random& random) const override {
    std::string bytes = part(true, "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n");
    for (std::size_t i = random.below(40); i > 0; --i) {
      const std::uint32_t stream = static_cast<std::uint32_t>(random.below(4)) * 2 + 1;
      std::string payload(random.below(60), 'x');
      if (random.below(2) == 0) payload = tests::http2::message(odd_integer(random), random.below(40));
      std::string one =
          tests::http2::frame(static_cast<int>(random.below(11)), static_cast<int>(random.below(64)), stream, payload);
      if (random.below(8) == 0) mutate(one, random);
      bytes += part(random.below(3) != 0, one);
    }
    return random.below(4) == 0 ? changed(bytes, random) : bytes;
  }
  void run(const std::string& input) override {
    std::atomic<std::uint64_t> half_sent{0};
    const control::Http2Meter::Messages messages;
    control::Http2Meter::Time now{};
    {
      control::Http2Meter meter(half_sent, messages, now);
      std::string_view left = input;
      while (left.size() >= 2) {
        const std::size_t head = static_cast<unsigned char>(left[0]) * 256u + static_cast<unsigned char>(left[1]);
        const std::string_view bytes = left.substr(2, head / 2);
        left.remove_prefix(2 + bytes.size());
        now += std::chrono::milliseconds(bytes.size());
        if (head % 2 != 0) {
          if (!meter.from_client(bytes, now).empty()) break;  // the connection is closed
        } else {
          meter.from_server(bytes);
        }
        EXPECT_LE(meter.stream_count(), limits::kMaxStreamsPerConnection);
        EXPECT_GE(meter.held_byte_s(now), 0);
        (void)meter.at(now);
      }
    }
    EXPECT_EQ(half_sent, 0u) << "a connection that is gone holds nothing";
  }

 private:
  static std::string part(bool of_client, const std::string& bytes) {
    const std::size_t head = 2 * bytes.size() + (of_client ? 1 : 0);
    return std::string{static_cast<char>(head / 256), static_cast<char>(head % 256)} + bytes;
  }
};

/// Loads that fit into 100 MiB by their counts.
class SceneTarget final : public MessageTarget<v1::LoadSceneRequest> {
 public:
  SceneTarget() {
    for (const v1::Scene& scene : {block(), edited(false), tests::hanging_block(2)}) {
      *seeds_.emplace_back().mutable_scene() = scene;
    }
  }

 private:
  void take(v1::LoadSceneRequest& request) override {
    v1::Scene& scene = *request.mutable_scene();
    v1::Solver& solver = *scene.mutable_solver();  // decoders are tested here, and not how long a solver may take
    if (solver.cg_max_iterations() > 50) solver.set_cg_max_iterations(50);
    if (solver.newton_max_iterations() > 5) solver.set_newton_max_iterations(5);
    if (solver.cpu_threads() > 2) solver.set_cpu_threads(2);
    scene.mutable_stepping()->set_lockstep(true);
    const auto loaded = registry_.load(scene);
    if (!loaded) {
      EXPECT_FALSE(loaded.error().message.empty());
      return;
    }
    (void)(*loaded)->step(2);
    OfScene::expect_finite(**loaded);
    (void)(*loaded)->status();
    EXPECT_TRUE(registry_.unload((*loaded)->name()));
  }

  control::SceneRegistry registry_{
      {.backend = world::BackendChoice::kCpu, .cpu_threads = 1}, [] {}, {.scene_bytes = 100 << 20, .load_s = 1}};
};

/// States behind a good header, because a checksum would refuse the others.
class SnapshotTarget final : public MessageTarget<v1::SnapshotState>, OfScene {
 public:
  SnapshotTarget() : OfScene(tests::hanging_block(2)) {
    EXPECT_TRUE(runner().step(3));
    const auto snapshot = runner().snapshot();
    seeds_ = {read(snapshot->snapshot())};
  }
  void run(const std::string& input) override {
    (void)runner().restore(world::seal_snapshot(input));
    go_on();
    (void)runner().restore(input);
    go_on();
  }

 private:
  void take(v1::SnapshotState&) override {}
  static v1::SnapshotState read(const std::string& snapshot) {
    v1::SnapshotState state;
    EXPECT_TRUE(state.ParseFromString(snapshot.substr(world::seal_snapshot("").size())));
    return state;
  }
};

/// Recorded steps and edits.
class RecordingTarget final : public MessageTarget<v1::ReplaySceneRequest>, OfScene {
 public:
  RecordingTarget() : OfScene(edited(false)) {
    const auto started = runner().record({.check_every_steps = 1, .reset = true});
    EXPECT_TRUE(started);
    v1::ReplaySceneRequest request;
    request.set_scene("fuzzed");
    request.set_scene_hash(started->start.scene_hash());
    runner().stop_recording(started->recording);
    for (std::uint64_t index = 1; index <= 3; ++index) {
      v1::RecordedStep& step = *request.add_steps();
      step.set_index(index);
      step.set_step(index);
      step.set_cg_iteration_limit(12);
      step.set_edits(1);
      v1::RecordedEdit& edit = *request.add_edits();
      edit.set_index(index);
      if (index == 1) edit.mutable_reset();
      if (index == 2) edit.mutable_scene_edit()->add_ablations()->set_body("beam");
      if (index == 2) edit.mutable_scene_edit()->mutable_ablations(0)->add_elements(3);
      if (index == 3) edit.mutable_adjust()->add_bodies()->set_body("beam");
    }
    v1::RecordedPose& pose = *request.mutable_steps(1)->add_poses();
    pose.set_tool("probe");
    tests::set(*pose.mutable_position_m(), 0.15, 0.1, 0.05);
    pose.mutable_orientation()->set_w(1);
    request.add_check_indices(2);
    seeds_ = {request};
  }

 private:
  void take(v1::ReplaySceneRequest& request) override {
    (void)registry().replay(request);
    go_on();
  }
};

class CutTarget final : public MessageTarget<v1::SceneEdit>, OfScene {
 public:
  CutTarget() : OfScene(edited(true)) {
    v1::SceneEdit edit;
    v1::Cut& cut = *edit.add_cuts();
    cut.set_body("beam");
    for (const double z : {0.2, -0.1}) {
      v1::BladePosition& blade = *cut.add_blade();
      for (const double point : {0.09, -0.1, z, 0.11, 0.2, z}) blade.add_points_m(point);
    }
    seeds_ = {edit};
  }

 private:
  void take(v1::SceneEdit& edit) override {
    (void)registry().edit("fuzzed", edit);
    go_on();
  }
};

/// Ablations, severings, tools, attachments and adjusted values, as the control plane takes them.
class EditTarget final : public MessageTarget<v1::RecordedEdit>, OfScene {
 public:
  EditTarget() : OfScene(edited(false)) {
    v1::RecordedEdit ablates, severs, adjusts, adds, attaches;
    v1::Ablation& ablation = *ablates.mutable_scene_edit()->add_ablations();
    ablation.set_body("beam");
    for (const std::uint32_t element : {1, 7, 11}) ablation.add_elements(element);
    ablation.add_kept(0.5);
    v1::Severing& severing = *severs.mutable_scene_edit()->add_severings();
    severing.set_attachment("weak");
    severing.add_springs(0);
    v1::BodyAdjustment& body = *adjusts.mutable_adjust()->add_bodies();
    body.set_body("beam");
    body.set_stiffness_factor(2);
    body.set_rayleigh_mass_per_s(1);
    tests::set(*adjusts.mutable_adjust()->mutable_gravity_m_per_s2(), 0, -9.81, 0);
    v1::Scene with;
    tests::add_probe(with, "second", 0.01, 0, 1, 0);
    *adds.mutable_scene_edit()->add_add_tools() = with.tools(0);
    adds.mutable_scene_edit()->add_remove_tools("probe");
    v1::Attachment& clip = *attaches.mutable_scene_edit()->add_add_attachments();
    clip.set_name("clip");
    clip.set_body("beam");
    clip.set_other("beam");
    clip.mutable_region()->mutable_nodes()->add_indices(1);
    clip.mutable_other_region()->mutable_nodes()->add_indices(2);
    clip.set_stiffness_n_per_m(100);
    clip.set_breaking_force_n(1);
    clip.add_rest_lengths_m(0.01);
    attaches.mutable_scene_edit()->add_remove_attachments("weak");
    seeds_ = {ablates, severs, adjusts, adds, attaches};
  }

 private:
  void take(v1::RecordedEdit& edit) override {
    if (edit.has_adjust()) (void)registry().adjust("fuzzed", edit.adjust());
    (void)registry().edit("fuzzed", edit.scene_edit());
    go_on();
  }
};

// -- the tests --------------------------------------------------------------------------------------------------------

const std::vector<Case>& cases() {
  static const std::vector<Case> all = [] {
    std::vector<Case> list{of<PoseTarget>("daemon-pose", 1000),        of<KeyTarget>("daemon-key", 20'000),
                           of<Http2Target>("daemon-http2", 3000),      of<SceneTarget>("daemon-scene", 300),
                           of<SnapshotTarget>("daemon-snapshot", 400), of<RecordingTarget>("daemon-recording", 300),
                           of<CutTarget>("daemon-cut", 150),           of<EditTarget>("daemon-edit", 300)};
    for (Case& one : file_cases()) list.push_back(std::move(one));
    for (Case& one : haptic_cases()) list.push_back(std::move(one));
    return list;
  }();
  return all;
}

const char* variable(const char* name, const char* otherwise) {
  const char* const value = std::getenv(name);
  return value == nullptr ? otherwise : value;
}

/// Runs the inputs that failed once.
void run_kept(const std::filesystem::path& folder, Target& target) {
  if (!std::filesystem::exists(folder)) return;
  for (const auto& entry : std::filesystem::directory_iterator(folder)) {
    std::ifstream file(entry.path(), std::ios::binary);
    target.run({std::istreambuf_iterator<char>(file), {}});
    ASSERT_FALSE(testing::Test::HasFailure()) << entry.path();
  }
}

class Decoder : public testing::TestWithParam<Case> {
 private:
  google::protobuf::LogSilencer silent_;  // about text that is not UTF-8
};

TEST_P(Decoder, TakesOrRefusesMutatedInputs) {
  const Case& one = GetParam();
  const double seconds = std::atof(variable("FUZZ_SECONDS", "0"));
  const std::string seed = variable("FUZZ_SEED", "1");
  const std::filesystem::path folder =
      std::filesystem::path(variable("FUZZ_KEEP", testing::TempDir().c_str())) / one.name;
  const std::filesystem::path file = folder / fmt::format("{}.bin", getpid());
  std::filesystem::create_directories(folder);
  const int kept = open(file.c_str(), O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
  ASSERT_GE(kept, 0) << file;

  const std::unique_ptr<Target> target = one.make();
  run_kept(std::filesystem::path("tests/fuzz/inputs") / one.name, *target);
  const auto begin = std::chrono::steady_clock::now();
  const auto is_over = [&](std::size_t count) {
    if (seconds == 0) return count >= one.count;
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count() > seconds;
  };
  std::size_t count = 0;
  for (; !HasFailure() && !is_over(count); ++count) {
    Random random(std::hash<std::string>()(fmt::format("{} {} {}", seed, one.name, count)));
    const std::string input = target->mutated(random);
    ASSERT_EQ(pwrite(kept, input.data(), input.size(), 0), static_cast<ssize_t>(input.size()));
    ASSERT_EQ(ftruncate(kept, static_cast<off_t>(input.size())), 0);
    alarm(kMaxTime);
    target->run(input);
    alarm(0);
  }
  close(kept);
  std::cout << one.name << ": " << count << " inputs of seed " << seed << '\n';
  if (HasFailure()) {
    std::cout << "the input is " << file << '\n';
  } else {
    std::filesystem::remove(file);
  }
}

INSTANTIATE_TEST_SUITE_P(All, Decoder, testing::ValuesIn(cases()), [](const auto& one) {
  std::string name = one.param.name;
  std::erase(name, '-');
  return name;
});

}  // namespace
}  // namespace tensormass::fuzz
