#include "world/placement.h"

#include <array>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

/// Scenes on several GPUs, by a list of GPUs that do not exist.
namespace tensormass::world {
namespace {

constexpr std::uint64_t kGiB = std::uint64_t{1} << 30;

DeviceLoad device(double share, std::uint64_t free_gib = 139, std::uint64_t total_gib = 139) {
  return {.free = free_gib * kGiB, .total = total_gib * kGiB, .share = share};
}
std::size_t chosen(const std::vector<DeviceLoad>& devices, const DeviceNeeds& needs) {
  return choose_device(devices, needs);
}

TEST(ChooseDevice, TakesTheOneWithTheMostFreeTime) {
  EXPECT_EQ(chosen({device(0.5), device(0.2), device(0.3)}, {kGiB, 0.1}), 1u);
}

TEST(ChooseDevice, TakesTheFirstOfEqualOnes) { EXPECT_EQ(chosen({device(0.2), device(0.2)}, {kGiB, 0.1}), 0u); }

TEST(ChooseDevice, FollowsTheScarcestResource) {
  // The second has more free time, but another process has nearly all of its memory.
  EXPECT_EQ(chosen({device(0.5), device(0.1, 14)}, {kGiB, 0.1}), 0u);
  EXPECT_EQ(chosen({device(0.95), device(0.1, 14)}, {kGiB, 0.1}), 1u) << "no time is worse than little memory";
}

TEST(ChooseDevice, TakesMoreMemoryWhereTimeIsEqual) {
  EXPECT_EQ(chosen({device(0.5, 100), device(0.5, 120)}, {kGiB, 0.2}), 1u);
}

TEST(ChooseDevice, LeavesADeviceWithoutRoom) {
  EXPECT_EQ(chosen({device(0, 3), device(3)}, {4 * kGiB, 0.1}), 1u) << "a slow scene is better than none";
  EXPECT_EQ(chosen({device(0, 3), device(0, 2)}, {4 * kGiB, 0.1}), 0u) << "the load fails there, and says so";
}

TEST(ChooseDevice, LeavesADeviceThatDoesNotAnswer) {
  EXPECT_EQ(chosen({DeviceLoad{}, device(5)}, {kGiB, 0.1}), 1u);
  EXPECT_EQ(chosen({DeviceLoad{}, DeviceLoad{}}, {0, 0}), 0u) << "the load fails there, and says so";
}

TEST(ShareOfDevice, IsOfTimeAndOfMultiprocessors) {
  EXPECT_DOUBLE_EQ(share_of_device(132, 132, 1000, 7e-4), 0.7);
  EXPECT_DOUBLE_EQ(share_of_device(33, 132, 1000, 7e-4), 0.175);
  EXPECT_DOUBLE_EQ(share_of_device(264, 132, 1000, 2e-3), 1) << "a scene that is too slow takes all of it, not more";
  EXPECT_DOUBLE_EQ(share_of_device(66, 132, 0, 1e-6), 0.5) << "in lockstep it steps as fast as it can";
}

/// GPUs with numbers 0 and 2, as where number 1 is of another kind.
class Placing : public testing::Test {
 protected:
  Result<backend::DeviceMemory> read(std::uint32_t device) {
    ++reads_;
    if (!free_.contains(device)) return fail(ErrorCode::kUnavailable, "no answer");
    return backend::DeviceMemory{free_[device] * kGiB, 100 * kGiB};
  }
  std::map<std::uint32_t, std::uint64_t> free_{{0, 99}, {2, 99}};
  int reads_ = 0;
  std::shared_ptr<Placement> placement_ = std::make_shared<Placement>(
      std::vector<std::uint32_t>{0, 2}, [this](std::uint32_t device) { return read(device); });
};

TEST_F(Placing, SpreadsScenesAsTheyCome) {
  std::vector<std::unique_ptr<Placement::Place>> places;
  std::map<std::uint32_t, int> scenes;
  for (int i = 0; i < 10; ++i) {
    places.push_back(placement_->place({kGiB, 0.1}));
    ++scenes[places.back()->device()];
  }
  EXPECT_EQ(scenes, (std::map<std::uint32_t, int>{{0, 5}, {2, 5}}));
}

TEST_F(Placing, GivesAPlaceBack) {
  auto first = placement_->place({0, 0.9});
  EXPECT_EQ(first->device(), 0u);
  EXPECT_EQ(placement_->preview({0, 0.1}), 2u);
  first.reset();
  EXPECT_EQ(placement_->preview({0, 0.1}), 0u);
}

/// Two loads at the same time: the first has a place, and nothing is allocated yet.
TEST_F(Placing, CountsMemoryThatALoadUnderWayWillTake) {
  const auto first = placement_->place({60 * kGiB, 0});
  EXPECT_EQ(first->device(), 0u);
  const auto second = placement_->place({60 * kGiB, 0});
  EXPECT_EQ(second->device(), 2u);
  // The first has allocated: the GPU counts it, and nobody counts it twice.
  free_[0] = 39;
  first->follow([] { return 0.0; });
  EXPECT_EQ(placement_->preview({30 * kGiB, 0}), 0u);
  EXPECT_EQ(placement_->preview({45 * kGiB, 0}), 0u) << "neither has room";
}

TEST_F(Placing, FollowsWhatScenesMeasure) {
  double share = 0.6;
  const auto first = placement_->place({0, 0.1});
  first->follow([&] { return share; });
  const auto second = placement_->place({0, 0.3});
  second->follow([] { return 0.3; });
  EXPECT_EQ(second->device(), 2u);
  EXPECT_EQ(placement_->preview({0, 0.1}), 2u);
  share = 0.2;  // its solves have become shorter
  EXPECT_EQ(placement_->preview({0, 0.1}), 0u);
}

TEST_F(Placing, AsksNoDeviceWhereThereIsNoChoice) {
  const auto one =
      std::make_shared<Placement>(std::vector<std::uint32_t>{3}, [this](std::uint32_t device) { return read(device); });
  EXPECT_EQ(one->preview({1000 * kGiB, 5}), 3u);
  EXPECT_EQ(reads_, 0);
}

TEST_F(Placing, ManyThreadsSpreadEvenly) {
  constexpr int kThreads = 8, kScenes = 25;
  std::array<std::vector<std::unique_ptr<Placement::Place>>, kThreads> places;
  {
    std::vector<std::jthread> threads;
    for (auto& own : places) {
      threads.emplace_back([&] {
        for (int i = 0; i < kScenes; ++i) own.push_back(placement_->place({kGiB / 100, 0.01}));
      });
    }
  }
  std::map<std::uint32_t, int> scenes;
  for (const auto& own : places) {
    for (const auto& place : own) ++scenes[place->device()];
  }
  EXPECT_EQ(scenes, (std::map<std::uint32_t, int>{{0, 100}, {2, 100}}));
}

}  // namespace
}  // namespace tensormass::world
