#include "backend/cpu/team.h"

#include <atomic>
#include <cmath>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

/// The CPU's team: threads that meet in an exchange.
namespace tensormass::backend::cpu {
namespace {

TEST(Team, ExchangeSumsOverAllPatchesInTheirOrderAndPublishesTheirWrites) {
  constexpr std::uint32_t kPatches = 4, kExchanges = 200;
  Barrier barrier(kPatches);
  std::vector<float> scratch(2 * 4 * kPatches);
  std::vector<std::uint32_t> written(2 * kPatches);  // by parity, as a solve writes its product
  std::vector<int> failures(kPatches, 0);
  const auto run = [&](std::uint32_t patch) {
    Team team(patch, kPatches, barrier);
    for (std::uint32_t i = 0; i < kExchanges; ++i) {
      // In their order, the 1 is lost beside 1e8. In another order it is not.
      const float values[kPatches] = {1e8f, 1, -1e8f, static_cast<float>(i)}, expected = values[3];
      written[(i & 1) * kPatches + patch] = i;
      float sums[2] = {values[patch], 1};
      team.exchange(sums, scratch.data() + std::size_t{i & 1} * 4 * kPatches);
      if (sums[0] != expected || sums[1] != kPatches) ++failures[patch];
      for (std::uint32_t p = 0; p < kPatches; ++p) {
        if (written[(i & 1) * kPatches + p] != i) ++failures[patch];
      }
    }
  };
  std::vector<std::jthread> threads;
  for (std::uint32_t patch = 1; patch < kPatches; ++patch) threads.emplace_back(run, patch);
  run(0);
  threads.clear();  // joins
  EXPECT_EQ(failures, std::vector<int>(kPatches, 0));
}

TEST(Team, OnePatchExchangesWithNobody) {
  Barrier barrier(1);
  Team team(0, 1, barrier);
  double sums[1] = {3};
  team.exchange(sums, static_cast<double*>(nullptr));
  EXPECT_EQ(sums[0], 3);
  EXPECT_TRUE(team.leads());
}

/// A solve ends when a sum is not a number, so all patches must get it in the same exchange, whenever the flag comes.
TEST(Team, AllPatchesGetAStopInTheSameExchange) {
  constexpr std::uint32_t kPatches = 3;
  Barrier barrier(kPatches);
  std::vector<float> scratch(2 * 4 * kPatches);
  std::vector<std::uint32_t> ended(kPatches);
  std::atomic<bool> stopped{false};
  const auto run = [&](std::uint32_t patch) {
    Team team(patch, kPatches, barrier, &stopped);
    for (std::uint32_t& i = ended[patch];; ++i) {
      if (patch == 1 && i == 500) stopped = true;
      float sums[2] = {1, 1};
      team.exchange(sums, scratch.data() + std::size_t{i & 1} * 4 * kPatches);
      if (std::isnan(sums[1])) return;
    }
  };
  std::vector<std::jthread> threads;
  for (std::uint32_t patch = 1; patch < kPatches; ++patch) threads.emplace_back(run, patch);
  run(0);
  threads.clear();  // joins
  EXPECT_GE(ended[0], 499u);
  EXPECT_EQ(ended, std::vector<std::uint32_t>(kPatches, ended[0]));
}

TEST(Team, OneOfAllPatchesLeads) {
  Barrier barrier(2);
  EXPECT_TRUE(Team(0, 2, barrier).leads());
  EXPECT_FALSE(Team(1, 2, barrier).leads());
  EXPECT_TRUE(Team(1, 2, barrier).leads_patch());
}

}  // namespace
}  // namespace tensormass::backend::cpu
