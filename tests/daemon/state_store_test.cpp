#include "daemon/state_store.h"

#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <random>
#include <sstream>

#include <gtest/gtest.h>

#include "core/state_limits.h"
#include "support/refused.h"

namespace tensormass::daemon {
namespace {

namespace fs = std::filesystem;

constexpr std::uint64_t kMib = 1 << 20;

std::string content_of(const fs::path& path) {
  std::ostringstream text;
  text << std::ifstream(path, std::ios::binary).rdbuf();
  return text.str();
}

void write_file(const fs::path& path, const std::string& content) {
  std::ofstream(path, std::ios::binary | std::ios::trunc) << content;
}

v1::Scene scene_named(const std::string& name) {
  v1::Scene scene;
  scene.set_name(name);
  scene.mutable_stepping()->set_rate_hz(100);
  return scene;
}

StateStore::Snapshot snapshot(const std::string& content) {
  StateStore::Snapshot out;
  out.paused = true;
  out.adjustments.mutable_gravity_m_per_s2()->set_y(-9.81);
  out.snapshot = content;
  return out;
}

class StateStoreTest : public testing::Test {
 protected:
  StateStoreTest() {
    std::string path = (fs::temp_directory_path() / "tensormass-state-XXXXXX").string();
    if (mkdtemp(path.data()) == nullptr) std::abort();
    parent = path;
    folder = parent / "state";
  }
  ~StateStoreTest() override {
    std::error_code none;
    fs::remove_all(parent, none);
  }
  std::unique_ptr<StateStore> open(std::uint64_t max_bytes = 64 * kMib) const {
    auto store = StateStore::open(folder.string(), "1.2.3", max_bytes);
    if (!store) {
      ADD_FAILURE() << store.error().message;
      std::abort();
    }
    return std::move(*store);
  }
  std::vector<std::string> files() const {
    std::vector<std::string> names;
    for (const auto& entry : fs::directory_iterator(folder)) names.push_back(entry.path().filename());
    std::sort(names.begin(), names.end());
    return names;
  }

  fs::path parent, folder;
};

TEST_F(StateStoreTest, KeepsScenesAndTheirNewestSnapshots) {
  {
    const auto store = open();
    EXPECT_EQ(fs::status(folder).permissions(), fs::perms::owner_all);
    const auto ticket = store->add(scene_named("a"));
    ASSERT_TRUE(ticket) << ticket.error().message;
    for (int i = 1; i <= 5; ++i) ASSERT_TRUE(store->write("a", *ticket, snapshot(std::to_string(i))));
    ASSERT_TRUE(store->add(scene_named("b")));
  }
  const auto store = open();
  EXPECT_EQ(store->scenes(), (std::vector<std::string>{"a", "b"}));
  EXPECT_EQ(store->read_scene("a")->SerializeAsString(), scene_named("a").SerializeAsString());
  EXPECT_EQ(store->generations("a"), (std::vector<std::uint64_t>{5, 4, 3}));
  EXPECT_TRUE(store->generations("b").empty());
  const auto newest = store->read_snapshot("a", 5);
  ASSERT_TRUE(newest) << newest.error().message;
  EXPECT_EQ(newest->snapshot, "5");
  EXPECT_EQ(newest->version, "1.2.3");
  EXPECT_TRUE(newest->paused);
  EXPECT_EQ(newest->adjustments.gravity_m_per_s2().y(), -9.81);
  ASSERT_TRUE(store->write("a", store->ticket("a"), snapshot("6")));
  EXPECT_EQ(store->generations("a"), (std::vector<std::uint64_t>{6, 5, 4}));

  store->remove("a");
  EXPECT_EQ(files(), std::vector<std::string>{"b.scene"});
}

TEST_F(StateStoreTest, ATicketEndsWithItsScene) {
  const auto store = open();
  const auto first = store->add(scene_named("a"));
  ASSERT_TRUE(first);
  ASSERT_TRUE(store->write("a", *first, snapshot("old")));
  const auto second = store->add(scene_named("a"));
  ASSERT_TRUE(second);
  EXPECT_TRUE(store->write("a", *first, snapshot("late")));
  EXPECT_EQ(files(), std::vector<std::string>{"a.scene"});
  EXPECT_TRUE(store->write("a", *second, snapshot("new")));
  EXPECT_EQ(files().size(), 2u);
}

/// Every byte, and every length: the damage is found and named, nothing crashes, and the other files still count.
TEST_F(StateStoreTest, EveryDamageIsFound) {
  const auto store = open();
  const auto ticket = store->add(scene_named("a"));
  ASSERT_TRUE(ticket);
  ASSERT_TRUE(store->write("a", *ticket, snapshot("the one before")));
  ASSERT_TRUE(store->write("a", *ticket, snapshot("the newest")));
  std::mt19937 random(1);
  const auto is_named = [](const auto& result, const fs::path& file) {
    return !result && result.error().message.find(file.string()) != std::string::npos;
  };
  for (const char* name : {"a.scene", "a.2.snapshot"}) {
    const fs::path file = folder / name;
    const std::string good = content_of(file);
    const auto refused = [&](const std::string& damaged) {
      write_file(file, damaged);
      return file.extension() == ".scene" ? is_named(store->read_scene("a"), file)
                                          : is_named(store->read_snapshot("a", 2), file);
    };
    for (std::size_t i = 0; i < good.size(); ++i) {
      std::string flipped = good;
      flipped[i] = static_cast<char>(flipped[i] ^ (1 << (random() % 8)));
      EXPECT_TRUE(refused(flipped)) << name << " with another byte " << i;
      EXPECT_TRUE(refused(good.substr(0, i))) << name << " cut to " << i;
    }
    EXPECT_TRUE(refused(good + '\0')) << name;
    for (int i = 0; i < 200; ++i) {
      std::string noise(random() % 300, '\0');
      for (char& byte : noise) byte = static_cast<char>(random());
      EXPECT_TRUE(refused(noise)) << name << " as noise " << i;
    }
    write_file(file, good);
  }
  EXPECT_TRUE(store->read_scene("a"));
  EXPECT_EQ(store->read_snapshot("a", 2)->snapshot, "the newest");
  EXPECT_EQ(store->read_snapshot("a", 1)->snapshot, "the one before");
}

TEST_F(StateStoreTest, AFileIsOfItsOwnSceneAndKind) {
  const auto store = open();
  const auto ticket = store->add(scene_named("a"));
  ASSERT_TRUE(ticket);
  ASSERT_TRUE(store->write("a", *ticket, snapshot("x")));
  fs::copy_file(folder / "a.scene", folder / "b.scene");
  EXPECT_REFUSED(store->read_scene("b"), ErrorCode::kInvalidArgument, "is not a scene named 'b'");
  fs::copy_file(folder / "a.1.snapshot", folder / "c.scene");
  EXPECT_REFUSED(store->read_scene("c"), ErrorCode::kInvalidArgument, "its header is wrong");
  fs::remove(folder / "a.scene");
  ASSERT_EQ(mkfifo((folder / "a.scene").c_str(), 0600), 0);
  EXPECT_REFUSED(store->read_scene("a"), ErrorCode::kInvalidArgument, "is not a regular file");
  fs::remove(folder / "a.scene");
  fs::create_symlink("b.scene", folder / "a.scene");
  EXPECT_REFUSED(store->read_scene("a"), ErrorCode::kInvalidArgument, "a.scene");
}

/// While it lives, no file may grow beyond `bytes`, as on a full disk.
class FullDisk {
 public:
  explicit FullDisk(rlim_t bytes) {
    before_ = std::signal(SIGXFSZ, SIG_IGN);
    getrlimit(RLIMIT_FSIZE, &limit_);
    const rlimit small{bytes, limit_.rlim_max};
    setrlimit(RLIMIT_FSIZE, &small);
  }
  ~FullDisk() {
    setrlimit(RLIMIT_FSIZE, &limit_);
    std::signal(SIGXFSZ, before_);
  }

 private:
  rlimit limit_{};
  void (*before_)(int) = nullptr;
};

TEST_F(StateStoreTest, AFullDiskLeavesTheLastGoodSnapshot) {
  const auto store = open();
  const auto ticket = store->add(scene_named("a"));
  ASSERT_TRUE(ticket);
  ASSERT_TRUE(store->write("a", *ticket, snapshot("good")));
  const auto before = files();
  for (const rlim_t bytes : {0, 50, 100, 500}) {
    Result<void> written;
    {
      const FullDisk full(bytes);
      written = store->write("a", *ticket, snapshot(std::string(1000, 'x')));
    }
    EXPECT_REFUSED(written, ErrorCode::kUnavailable, folder.string());
    EXPECT_EQ(files(), before) << bytes;
  }
  EXPECT_EQ(store->read_snapshot("a", 1)->snapshot, "good");
  Result<StateStore::Ticket> added;
  {
    const FullDisk full(10);
    added = store->add(scene_named("b"));
  }
  EXPECT_REFUSED(added, ErrorCode::kUnavailable, "make room");
  EXPECT_EQ(files(), before);
  EXPECT_TRUE(store->write("a", *ticket, snapshot("better")));
}

TEST_F(StateStoreTest, AllFilesTogetherHaveALimit) {
  const auto large = snapshot(std::string(600'000, 'x'));
  {
    const auto store = open(kMib);
    const auto ticket = store->add(scene_named("a"));
    ASSERT_TRUE(ticket);
    ASSERT_TRUE(store->write("a", *ticket, large));
    EXPECT_REFUSED(store->write("a", *ticket, large), ErrorCode::kResourceExhausted, "--max-state-mib 1");
    EXPECT_EQ(store->generations("a"), std::vector<std::uint64_t>{1});
  }
  // Files that are there count after a start, too, and removed ones do not.
  auto store = open(kMib);
  EXPECT_REFUSED(store->write("a", store->ticket("a"), large), ErrorCode::kResourceExhausted, "--max-state-mib 1");
  store->move_to_aside("a", 1);
  EXPECT_REFUSED(store->write("a", store->ticket("a"), large), ErrorCode::kResourceExhausted, "state/aside");
  store.reset();
  fs::remove_all(folder / "aside");
  store = open(kMib);
  EXPECT_TRUE(store->write("a", store->ticket("a"), large));
  store->remove("a");
  const auto again = store->add(scene_named("a"));
  ASSERT_TRUE(again);
  EXPECT_TRUE(store->write("a", *again, large));
}

/// A process is killed while it writes. The newest snapshot that it called complete is there, whole.
TEST_F(StateStoreTest, AKilledProcessLeavesAWholeSnapshot) {
  std::mt19937 random(2);
  std::uint64_t last = 0;
  open()->add(scene_named("a")).value();
  for (int round = 0; round < 25; ++round) {
    int told[2];
    ASSERT_EQ(pipe(told), 0);
    const pid_t child = fork();
    if (child == 0) {
      auto store = StateStore::open(folder.string(), "1.2.3", 64 * kMib);
      if (!store) _exit(1);
      for (std::uint64_t number = last + 1;; ++number) {
        const std::string content = std::to_string(number) + std::string(20'000 + number % 7, 'x');
        if (!(*store)->write("a", (*store)->ticket("a"), snapshot(content))) _exit(2);
        if (::write(told[1], &number, sizeof(number)) != sizeof(number)) _exit(3);
      }
    }
    close(told[1]);
    std::uint64_t complete = 0;
    const unsigned count = 1 + random() % 5;
    for (unsigned i = 0; i < count; ++i) {
      ASSERT_EQ(::read(told[0], &complete, sizeof(complete)), static_cast<ssize_t>(sizeof(complete)));
    }
    usleep(random() % 500);  // any moment of the next write
    kill(child, SIGKILL);
    int status = 0;
    waitpid(child, &status, 0);
    close(told[0]);
    const auto store = open();
    for (const std::string& file : files()) EXPECT_EQ(file.find("unfinished"), std::string::npos) << file;
    const auto newest = store->read_snapshot("a", store->generations("a").at(0));
    ASSERT_TRUE(newest) << newest.error().message;
    last = std::stoull(newest->snapshot);
    EXPECT_GE(last, complete);
    EXPECT_LE(store->generations("a").size(), limits::kStateGenerations + 1);
  }
}

TEST_F(StateStoreTest, RefusesAFolderThatOthersCanWriteOrUse) {
  {
    const auto store = open();
    EXPECT_REFUSED(StateStore::open(folder.string(), "1", kMib), ErrorCode::kUnavailable, "another daemon uses");
  }
  for (const int mode : {0777, 0720, 0702}) {
    ASSERT_EQ(chmod(folder.c_str(), static_cast<mode_t>(mode)), 0);
    EXPECT_REFUSED(StateStore::open(folder.string(), "1", kMib), ErrorCode::kInvalidArgument,
                   "chmod 700 '" + folder.string());
  }
  ASSERT_EQ(chmod(folder.c_str(), 0755), 0);
  open();
  write_file(parent / "file", "");
  EXPECT_REFUSED(StateStore::open((parent / "file").string(), "1", kMib), ErrorCode::kInvalidArgument,
                 (parent / "file").string());
  EXPECT_REFUSED(StateStore::open((parent / "none" / "state").string(), "1", kMib), ErrorCode::kInvalidArgument,
                 "install -d -m 700");
}

TEST_F(StateStoreTest, TakesOnlyFilesThatItCouldHaveWritten) {
  open()->add(scene_named("a")).value();
  for (const char* name : {".scene", "a b.scene", "a.01.snapshot", "a.-1.snapshot", "a.99999999999999999999.snapshot",
                           "a..snapshot", "a.1.snapshot.scene", "README"}) {
    write_file(folder / name, "x");
  }
  fs::create_directory(folder / "d.scene");
  write_file(folder / "gone.1.snapshot", "x");  // its scene was removed before it
  write_file(folder / ".7.unfinished", "x");
  const auto store = open();
  EXPECT_EQ(store->scenes(), std::vector<std::string>{"a"});
  EXPECT_TRUE(store->generations("a").empty());
  EXPECT_FALSE(fs::exists(folder / "gone.1.snapshot"));
  EXPECT_FALSE(fs::exists(folder / ".7.unfinished"));
  EXPECT_TRUE(fs::exists(folder / "README"));
}

TEST_F(StateStoreTest, MovesAwayWhatCannotBeUsed) {
  const auto store = open();
  const auto ticket = store->add(scene_named("a"));
  ASSERT_TRUE(ticket);
  for (const char* content : {"1", "2", "3"}) ASSERT_TRUE(store->write("a", *ticket, snapshot(content)));
  const std::string second = content_of(folder / "a.2.snapshot");
  store->move_to_aside("a", 3);
  store->move_to_aside("a", 2);
  EXPECT_EQ(store->generations("a"), std::vector<std::uint64_t>{1});
  EXPECT_EQ(content_of(folder / "aside" / "a.snapshot"), second);
  store->move_to_aside("a");
  EXPECT_TRUE(store->scenes().empty());
  EXPECT_EQ(files(), std::vector<std::string>{"aside"});
  EXPECT_TRUE(fs::exists(folder / "aside" / "a.scene"));
}

}  // namespace
}  // namespace tensormass::daemon
