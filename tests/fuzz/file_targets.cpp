#include <stdlib.h>

#include <array>
#include <cstring>
#include <filesystem>
#include <fstream>

#include <gtest/gtest.h>
#include <openssl/evp.h>

#include "access/client_list.h"
#include "daemon/state_store.h"
#include "fuzz/target.h"

namespace tensormass::fuzz {
namespace {

namespace fs = std::filesystem;

class ClientListTarget final : public Target {
 public:
  std::string mutated(Random& random) const override {
    return changed(R"({"tensormass": "client list", "clients": [{"id": "h.0123abcd", "role": "hand", "scene": "demo",)"
                   R"( "tool": "probe", "curve_public": ")" +
                       std::string(access::kCurveCharacters, 'x') + R"(", "expires_s": 1800000000}]})",
                   random);
  }
  void run(const std::string& input) override {
    const auto list = access::read_client_list(input, "clients.json");
    EXPECT_TRUE(list || !list.error().message.empty());
  }
};

/// A folder of `--state` in which one file is another's. The sum of two inputs in three is made right again, because a
/// wrong one ends the reader at once.
class StateTarget final : public Target {
 public:
  StateTarget() {
    std::string path = (fs::temp_directory_path() / "tensormass-fuzz-XXXXXX").string();
    if (mkdtemp(path.data()) == nullptr) std::abort();
    folder_ = path;
    const auto store = open();
    v1::Scene scene;
    scene.set_name("a");
    scene.mutable_stepping()->set_rate_hz(100);
    const auto ticket = store->add(scene);
    daemon::StateStore::Snapshot snapshot;
    snapshot.adjustments.mutable_gravity_m_per_s2()->set_y(-9.81);
    snapshot.snapshot = "the state of a scene";
    EXPECT_TRUE(ticket && store->write("a", *ticket, snapshot));
    for (const char* name : {"a.scene", "a.1.snapshot"}) {
      std::ifstream file(fs::path(path) / name, std::ios::binary);
      seeds_.emplace_back(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
    }
  }
  ~StateTarget() override {
    std::error_code none;
    fs::remove_all(folder_, none);
  }
  std::string mutated(Random& random) const override {
    std::string file = changed(random.one_of(seeds_), random);
    if (file.size() < kHeaderBytes || random.below(3) == 0) return file;
    std::array<unsigned char, EVP_MAX_MD_SIZE> sum{};
    file.replace(kSumAt, kSumBytes, kSumBytes, '\0');
    EXPECT_EQ(EVP_Digest(file.data(), file.size(), sum.data(), nullptr, EVP_sha256(), nullptr), 1);
    std::memcpy(file.data() + kSumAt, sum.data(), kSumBytes);
    return file;
  }
  void run(const std::string& input) override {
    for (const char* name : {"a.scene", "a.1.snapshot"}) {
      std::ofstream(folder_ / name, std::ios::binary | std::ios::trunc) << input;
    }
    const auto store = open();
    const auto scene = store->read_scene("a");
    EXPECT_TRUE(scene || scene.error().message.find("a.scene") != std::string::npos) << scene.error().message;
    const auto snapshot = store->read_snapshot("a", 1);
    EXPECT_TRUE(snapshot || snapshot.error().message.find("a.1.snapshot") != std::string::npos)
        << snapshot.error().message;
  }

 private:
  static constexpr std::size_t kHeaderBytes = 96, kSumBytes = 32, kSumAt = kHeaderBytes - kSumBytes;

  std::unique_ptr<daemon::StateStore> open() const {
    auto store = daemon::StateStore::open(folder_.string(), "1.2.3", 1 << 20);
    if (!store) {
      ADD_FAILURE() << store.error().message;
      std::abort();
    }
    return std::move(*store);
  }

  fs::path folder_;
  std::vector<std::string> seeds_;
};

}  // namespace

std::vector<Case> file_cases() {
  return {of<ClientListTarget>("daemon-clients", 3000), of<StateTarget>("daemon-state", 200)};
}

}  // namespace tensormass::fuzz
