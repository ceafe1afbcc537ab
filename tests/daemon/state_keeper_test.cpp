#include "daemon/state_keeper.h"

#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <future>
#include <thread>

#include <gtest/gtest.h>
#include <spdlog/sinks/base_sink.h>

#include "support/eventually.h"
#include "support/refused.h"
#include "support/scenes.h"

namespace tensormass::daemon {
namespace {

namespace fs = std::filesystem;
using namespace std::chrono_literals;

template <class Condition>
bool eventually(const Condition& condition) {
  return tests::eventually(condition, 60s);
}

v1::Scene scene_named(const std::string& name, bool lockstep = true) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  scene.set_name(name);
  scene.mutable_stepping()->set_lockstep(lockstep);
  return scene;
}

/// The scenes of a daemon and their keeper. The destructor ends them as a killed process does: without a last state.
struct Process {
  explicit Process(const fs::path& folder, const std::string& version = "1") {
    auto opened = StateStore::open(folder.string(), version, std::uint64_t{1} << 30);
    if (!opened) throw std::runtime_error(opened.error().message);
    store = opened->get();
    keeper = std::make_unique<StateKeeper>(std::move(*opened), 10ms);
    registry.set_follower(keeper.get());
    keeper->bring_back(registry, [] { return false; });
  }
  ~Process() {
    keeper.reset();
    registry.close();
  }
  control::RunnerPtr load(const v1::Scene& scene) {
    auto runner = registry.load(scene);
    if (!runner) throw std::runtime_error(runner.error().message);
    return *runner;
  }
  /// Waits until a snapshot shows the state that the scene has now.
  bool kept(const control::RunnerPtr& runner) const {
    return eventually([&] {
      const auto generations = store->generations(runner->name());
      if (generations.empty()) return false;
      const auto newest = store->read_snapshot(runner->name(), generations[0]);
      return newest && newest->snapshot == runner->snapshot()->snapshot();
    });
  }

  control::SceneRegistry registry{{.backend = world::BackendChoice::kCpu, .cpu_threads = 1}, [] {}};
  StateStore* store = nullptr;
  std::unique_ptr<StateKeeper> keeper;
};

class StateKeeperTest : public testing::Test {
 protected:
  StateKeeperTest() {
    std::string path = (fs::temp_directory_path() / "tensormass-keeper-XXXXXX").string();
    if (mkdtemp(path.data()) == nullptr) std::abort();
    folder = path;
  }
  ~StateKeeperTest() override {
    std::error_code none;
    fs::remove_all(folder, none);
  }
  fs::path folder;
};

TEST_F(StateKeeperTest, ScenesComeBackWithTheirState) {
  std::string positions;
  std::uint64_t topology = 0;
  {
    Process process(folder);
    const auto stepped = process.load(scene_named("stepped"));
    topology = stepped->topology()->version();
    v1::SceneAdjustments softer;
    softer.add_bodies()->set_body("beam");
    softer.mutable_bodies(0)->set_stiffness_factor(0.5);
    ASSERT_TRUE(stepped->adjust(softer));
    ASSERT_TRUE(stepped->step(7));
    positions = stepped->positions("beam")->positions();
    ASSERT_TRUE(process.kept(stepped));
    const auto paused = process.load(scene_named("paused", false));
    ASSERT_TRUE(paused->pause());
    ASSERT_TRUE(process.kept(paused));
    process.load(scene_named("running", false));
    process.load(scene_named("gone"));
    ASSERT_TRUE(process.registry.unload("gone"));
  }
  Process process(folder);
  ASSERT_EQ(process.registry.list().size(), 3u);
  const auto stepped = *process.registry.find("stepped");
  EXPECT_EQ(stepped->status().step(), 7u);
  EXPECT_EQ(stepped->positions("beam")->positions(), positions);
  EXPECT_EQ(stepped->adjust({})->adjustments().bodies(0).stiffness_factor(), 0.5);
  EXPECT_GT(stepped->topology()->version(), topology) << "clients see that frames are of another process";
  EXPECT_EQ((*process.registry.find("paused"))->status().state(), v1::SceneStatus::STATE_PAUSED);
  EXPECT_EQ((*process.registry.find("running"))->status().state(), v1::SceneStatus::STATE_RUNNING);

  // A scene that came back is kept as before.
  ASSERT_TRUE(stepped->step(1));
  EXPECT_TRUE(process.kept(stepped));
}

TEST_F(StateKeeperTest, AStateThatDoesNotChangeIsWrittenOnce) {
  Process process(folder);
  const auto scene = process.load(scene_named("a"));
  ASSERT_TRUE(scene->step(1));
  ASSERT_TRUE(process.kept(scene));
  const auto written = process.store->generations("a");
  // The other scene's snapshots say that the keeper's clock goes on.
  const auto other = process.load(scene_named("b"));
  for (int i = 0; i < 5; ++i) {
    ASSERT_TRUE(other->step(1));
    ASSERT_TRUE(process.kept(other));
  }
  EXPECT_EQ(process.store->generations("a"), written);
  ASSERT_TRUE(scene->reset());
  EXPECT_TRUE(process.kept(scene));
}

TEST_F(StateKeeperTest, TheNextGenerationIsTakenForADamagedOne) {
  {
    Process process(folder);
    const auto scene = process.load(scene_named("a"));
    for (int i = 0; i < 2; ++i) {
      ASSERT_TRUE(scene->step(5));
      ASSERT_TRUE(process.kept(scene));
    }
  }
  auto store = StateStore::open(folder.string(), "1", 1 << 30);
  const std::string newest = (*store)->path_of("a." + std::to_string((*store)->generations("a").at(0)) + ".snapshot");
  fs::resize_file(newest, fs::file_size(newest) - 1);
  store->reset();
  Process process(folder);
  EXPECT_EQ((*process.registry.find("a"))->status().step(), 5u);
  EXPECT_TRUE(fs::exists(folder / "aside" / "a.snapshot"));
}

TEST_F(StateKeeperTest, ASnapshotOfAnotherVersionStartsTheSceneFromItsBeginning) {
  {
    Process process(folder, "1");
    const auto scene = process.load(scene_named("a", false));
    v1::SceneAdjustments changes;
    changes.mutable_gravity_m_per_s2()->set_y(-1);
    ASSERT_TRUE(scene->adjust(changes));
    ASSERT_TRUE(eventually([&] { return scene->status().step() > 3; }));
    ASSERT_TRUE(scene->pause());
    ASSERT_TRUE(process.kept(scene));
  }
  testing::internal::CaptureStdout();
  testing::internal::CaptureStderr();
  Process process(folder, "2");
  const std::string log = testing::internal::GetCapturedStdout() + testing::internal::GetCapturedStderr();
  EXPECT_NE(log.find("it is of version 1, and this is version 2"), std::string::npos) << log;
  EXPECT_NE(log.find("starts from its beginning"), std::string::npos) << log;
  const auto scene = *process.registry.find("a");
  EXPECT_EQ(scene->status().state(), v1::SceneStatus::STATE_PAUSED);
  EXPECT_EQ(scene->adjust({})->adjustments().gravity_m_per_s2().y(), -1);
}

TEST_F(StateKeeperTest, ASceneThatDoesNotLoadIsMovedAwayAndTheOthersComeBack) {
  {
    Process process(folder);
    process.load(scene_named("a"));
    v1::Scene refused = scene_named("refused");
    ASSERT_TRUE(process.store->add(refused));
    refused.mutable_bodies(0)->clear_law();
    ASSERT_TRUE(process.store->add(refused));
    process.load(scene_named("z"));
  }
  std::ofstream(folder / "damaged.scene") << "x";
  Process process(folder);
  EXPECT_EQ(process.registry.list().size(), 2u);
  EXPECT_TRUE(fs::exists(folder / "aside" / "refused.scene"));
  EXPECT_TRUE(fs::exists(folder / "aside" / "damaged.scene"));
  EXPECT_FALSE(fs::exists(folder / "refused.scene"));
  process.load(scene_named("refused"));
  EXPECT_TRUE(fs::exists(folder / "refused.scene"));
}

TEST_F(StateKeeperTest, ADaemonThatIsAskedToStopLeavesTheFiles) {
  {
    Process process(folder);
    process.load(scene_named("a"));
  }
  auto store = StateStore::open(folder.string(), "1", 1 << 30);
  ASSERT_TRUE(store);
  control::SceneRegistry registry{{.backend = world::BackendChoice::kCpu, .cpu_threads = 1}, [] {}};
  int asked = 0;
  StateKeeper(std::move(*store)).bring_back(registry, [&] { return ++asked > 1; });
  EXPECT_TRUE(registry.list().empty());
  EXPECT_TRUE(fs::exists(folder / "a.scene"));
}

TEST_F(StateKeeperTest, TheLastStateOfADaemonThatEndsIsKept) {
  {
    auto store = StateStore::open(folder.string(), "1", 1 << 30);
    ASSERT_TRUE(store);
    control::SceneRegistry registry{{.backend = world::BackendChoice::kCpu, .cpu_threads = 1}, [] {}};
    StateKeeper keeper(std::move(*store), 1h);
    registry.set_follower(&keeper);
    ASSERT_TRUE((*registry.load(scene_named("a")))->step(9));
    keeper.take_last(60s);
    registry.close();
  }
  Process process(folder);
  EXPECT_EQ((*process.registry.find("a"))->status().step(), 9u);
}

/// Holds the first thread that logs a line with `text`, until `let_go`.
class HoldingLog final : public spdlog::sinks::base_sink<spdlog::details::null_mutex> {
 public:
  explicit HoldingLog(std::string text) : text_(std::move(text)) {}
  void let_go() { free_.set_value(); }
  std::atomic<bool> holds{false};

 protected:
  void sink_it_(const spdlog::details::log_msg& line) override {
    const std::string_view written(line.payload.data(), line.payload.size());
    if (written.find(text_) != std::string_view::npos && !holds.exchange(true)) free_.get_future().wait();
  }
  void flush_() override {}

 private:
  const std::string text_;
  std::promise<void> free_;
};

/// A thread says that it has taken the last state before it has ended. Joining it then, under the lock that it needs to
/// end, would wait for ever.
TEST_F(StateKeeperTest, AForgottenSceneWhoseThreadIsNotDoneDelaysNoOther) {
  const auto open_store = [&](std::uint64_t max_bytes) {
    auto store = StateStore::open(folder.string(), "1", max_bytes);
    if (!store) throw std::runtime_error(store.error().message);
    return std::move(*store);
  };
  // Room for the scene, and none for a snapshot: the thread logs that after it took the state.
  std::uint64_t room = 16;
  {
    const auto store = open_store(1 << 30);
    ASSERT_TRUE(store->add(scene_named("a")));
    room += fs::file_size(folder / "a.scene");
    store->remove("a");
  }
  const auto log = std::make_shared<HoldingLog>("state is not kept");
  const auto usual_log = spdlog::default_logger();
  spdlog::set_default_logger(std::make_shared<spdlog::logger>("held", log));

  control::SceneRegistry registry{{.backend = world::BackendChoice::kCpu, .cpu_threads = 1}, [] {}};
  const auto other = *registry.load(scene_named("b"));
  auto keeper = std::make_unique<StateKeeper>(open_store(room), 1h);
  registry.set_follower(keeper.get());
  ASSERT_TRUE((*registry.load(scene_named("a")))->step(1));
  keeper->take_last(60s);
  ASSERT_TRUE(eventually([&] { return log->holds.load(); }));
  std::promise<void> went_on;
  std::thread goes_on([&, keeper = keeper.get()] {
    keeper->forget("a");
    keeper->follow(other);
    went_on.set_value();
  });
  const bool waits = went_on.get_future().wait_for(60s) != std::future_status::ready;
  log->let_go();
  if (waits) {
    std::fprintf(stderr, "following a scene waits for the thread of a forgotten one, under the lock that it needs\n");
    std::_Exit(1);  // neither thread ends any more
  }
  goes_on.join();
  keeper.reset();
  registry.close();
  spdlog::set_default_logger(usual_log);
}

}  // namespace
}  // namespace tensormass::daemon
