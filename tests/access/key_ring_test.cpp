#include "access/key_ring.h"

#include <atomic>
#include <chrono>
#include <filesystem>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <string_view>

#include <gtest/gtest.h>
#include <spdlog/sinks/base_sink.h>
#include <spdlog/spdlog.h>

#include "support/eventually.h"
#include "support/key_folder.h"
#include "support/no_descriptors.h"
#include "support/refused.h"

namespace tensormass::access {
namespace {

constexpr const char* kAlice = "alice.01234567";
constexpr const char* kUnreadable = "the list of clients cannot be read";

/// Collects what is logged.
class Lines final : public spdlog::sinks::base_sink<std::mutex> {
 public:
  int count(std::string_view text) {
    const std::lock_guard lock(mutex_);
    int found = 0;
    for (std::size_t at = text_.find(text); at != std::string::npos; at = text_.find(text, at + 1)) ++found;
    return found;
  }

 private:
  void sink_it_(const spdlog::details::log_msg& line) override {
    text_.append(line.payload.data(), line.payload.size()).append("\n");
  }
  void flush_() override {}
  std::string text_;
};

class KeyRingTest : public testing::Test {
 protected:
  KeyRingTest() {
    spdlog::set_default_logger(std::make_shared<spdlog::logger>("test", lines_));
    folder_.write("without.json", tests::KeyFolder::list_of(""));
    auto opened = KeyRing::open(folder_.path());
    if (!opened) throw std::runtime_error(opened.error().message);
    ring_ = std::move(*opened);
  }
  ~KeyRingTest() override {
    ring_.reset();
    spdlog::set_default_logger(logger_before_);
  }
  template <class Condition>
  static bool eventually(const Condition& condition) {
    return tests::eventually(condition, std::chrono::seconds(20));
  }
  bool knows_alice() const { return ring_->find(kAlice) != nullptr; }

  std::shared_ptr<spdlog::logger> logger_before_ = spdlog::default_logger();
  std::shared_ptr<Lines> lines_ = std::make_shared<Lines>();
  tests::KeyFolder folder_{tests::KeyFolder::client(kAlice)};
  std::unique_ptr<KeyRing> ring_;
};

TEST_F(KeyRingTest, ARemovalCountsThoughTheListCouldNotBeReadAtFirst) {
  ring_->follow([] { return true; });
  {
    const tests::NoDescriptors none;
    folder_.rename("without.json", "clients.json");
    EXPECT_TRUE(eventually([&] { return lines_->count(kUnreadable) > 0; }));
    EXPECT_TRUE(knows_alice()) << "the list before counts on";
  }
  EXPECT_TRUE(eventually([&] { return !knows_alice(); }));
  EXPECT_EQ(lines_->count(kUnreadable), 1) << "one line for each state of the file";
}

TEST_F(KeyRingTest, AFolderInPlaceOfTheListIsTold) {
  ring_->follow([] { return true; });
  folder_.rename("clients.json", "before.json");
  std::filesystem::create_directory(folder_.path() / "clients.json");
  EXPECT_TRUE(eventually([&] { return lines_->count("clients.json: not a file") > 0; }));
  EXPECT_TRUE(knows_alice()) << "the list before counts on";
  std::filesystem::remove(folder_.path() / "clients.json");
  folder_.rename("without.json", "clients.json");
  EXPECT_TRUE(eventually([&] { return !knows_alice(); }));
}

TEST_F(KeyRingTest, AChangeThatFailsIsTriedAgain) {
  std::atomic<int> calls = 0;
  ring_->follow([&] {
    if (++calls == 1) throw std::runtime_error("no memory");
    return calls == 3;
  });
  folder_.rename("without.json", "clients.json");
  EXPECT_TRUE(eventually([&] { return calls == 3; }));
  EXPECT_EQ(lines_->count("other keys count"), 1);
  EXPECT_EQ(lines_->count("the change of keys is tried again reason=\"no memory\""), 1);
}

TEST_F(KeyRingTest, RefusesADaemonFileThatItCannotUse) {
  const auto refuse = [&](const std::string& what) {
    EXPECT_REFUSED(KeyRing::open(folder_.path()), ErrorCode::kInvalidArgument, what);
    EXPECT_REFUSED(KeyRing::open(folder_.path()), ErrorCode::kInvalidArgument, "tensormass keys init");
  };
  folder_.write_daemon(tests::KeyFolder::kCurve, "short");
  refuse("curve_secret is not a key of ZeroMQ");
  folder_.write_daemon(std::string(40, ' '), tests::KeyFolder::kCurve);
  refuse("curve_public is not a key of ZeroMQ");
  std::filesystem::remove(folder_.path() / "daemon.json");
  std::filesystem::create_directory(folder_.path() / "daemon.json");
  refuse("daemon.json: not a file");
}

}  // namespace
}  // namespace tensormass::access
