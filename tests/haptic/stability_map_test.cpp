#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstdio>
#include <map>

#include "closed_loop.h"
#include "haptic/force_renderer.h"

// A small part of the stability map, without loss.

namespace tensormass::haptic {
namespace {

constexpr std::array kStiffnesses{50.0, 500.0, 2000.0};
constexpr std::array kDelaysS{0.0, 0.01, 0.05};
constexpr std::array kServerRates{60.0, 1000.0};

/// Calls run(case) for each of 108 cases.
template <class Run>
void for_each_case(Run run) {
  for (const Tissue tissue : {Tissue::kWall, Tissue::kOrgan}) {
    for (const double stiffness : kStiffnesses) {
      for (const double rate : kServerRates) {
        for (const double delay_s : kDelaysS) {
          for (const Hand hand : {Hand::kSoft, Hand::kStiff, Hand::kNone}) {
            run(Case{.tissue = tissue,
                     .stiffness_n_per_m = stiffness,
                     .server_rate_hz = rate,
                     .delay_s = delay_s,
                     .jitter_s = 0.5 * delay_s,
                     .hand = hand});
          }
        }
      }
    }
  }
}

std::map<Motion, int> motions_of(Chain chain) {
  std::map<Motion, int> count;
  for_each_case([&](const Case& c) { ++count[run_case(c, chain).motion]; });
  return count;
}

// Fails if the passivity controller adds no damping.
TEST(StabilityMap, TheClientLetsNoOscillationGrow) {
  for_each_case([](const Case& c) {
    const Outcome outcome = run_case(c, Chain::kFull);
    EXPECT_NE(outcome.motion, Motion::kGrows)
        << name_of(c.tissue) << " of " << c.stiffness_n_per_m << " N/m at " << c.server_rate_hz << " Hz, " << c.delay_s
        << " s, hand " << name_of(c.hand);
    EXPECT_LE(outcome.max_force_n, ForceLimits{}.max_force_n);
  });
}

TEST(StabilityMap, EachPartOfTheClientIsNeeded) {
  auto full = motions_of(Chain::kFull);
  auto no_secant = motions_of(Chain::kNoSecant);
  auto no_controller = motions_of(Chain::kNoController);
  auto transmitted = motions_of(Chain::kTransmitted);
  EXPECT_GT(full[Motion::kRests], 95);
  EXPECT_LT(no_secant[Motion::kRests], full[Motion::kRests] - 10);
  EXPECT_GT(no_controller[Motion::kGrows], 10);
  EXPECT_LT(transmitted[Motion::kRests], no_controller[Motion::kRests] - 10);
}

// Tissue that is cut, over networks that lose a tenth of all messages.
TEST(StabilityMap, TheClientLetsNoOscillationGrowWhileItCuts) {
  int rests = 0, transmitted_rests = 0;
  for (const double stiffness : kStiffnesses) {
    for (const double rate : kServerRates) {
      for (const double delay_s : kDelaysS) {
        for (const Hand hand : {Hand::kSoft, Hand::kStiff, Hand::kNone}) {
          const Case c{.tissue = Tissue::kCut,
                       .stiffness_n_per_m = stiffness,
                       .server_rate_hz = rate,
                       .delay_s = delay_s,
                       .jitter_s = 0.5 * delay_s,
                       .loss = 0.1,
                       .hand = hand};
          const Outcome outcome = run_seeds(c, Chain::kFull, 3);
          SCOPED_TRACE(testing::Message()
                       << stiffness << " N/m at " << rate << " Hz, " << delay_s << " s, hand " << name_of(hand));
          // A mass that nothing holds falls the farther, the deeper its cut is. It gets next to no energy from the
          // device: what it has when the first force arrives late.
          if (hand != Hand::kNone) {
            EXPECT_NE(outcome.motion, Motion::kGrows);
          }
          EXPECT_LT(outcome.generated_energy_j, hand == Hand::kNone ? 3e-3 : 2e-4);
          rests += outcome.motion == Motion::kRests;
          transmitted_rests += run_seeds(c, Chain::kTransmittedWithController, 3).motion == Motion::kRests;
        }
      }
    }
  }
  std::printf("at rest: %d of 54, without the spring %d\n", rests, transmitted_rests);
  EXPECT_GT(rests, transmitted_rests);
}

// These cases grow in the map, on three networks each. Half of the messages are lost at 60 Hz, so the local model
// expires between two answers, the tissue vanishes, and the hand falls in. Over many networks its energy falls.
TEST(StabilityMap, ALossyNetworkStirsTheHandWithoutGrowth) {
  constexpr std::uint32_t kNetworks = 100;
  const Case lossy{.stiffness_n_per_m = 500.0, .loss = 0.5};
  std::array<Case, 4> cases;
  cases.fill(lossy);
  cases[0].hand = Hand::kNone;
  cases[0].delay_s = 0.001;
  cases[0].jitter_s = 0.0005;
  cases[1].hand = Hand::kNone;
  cases[1].tissue = Tissue::kOrgan;
  cases[1].delay_s = 0.002;
  cases[2] = cases[1];
  cases[2].hand = Hand::kSoft;
  cases[3].hand = Hand::kStiff;
  cases[3].stiffness_n_per_m = 5000.0;
  cases[3].delay_s = 0.005;
  cases[3].jitter_s = 0.0025;
  for (const Case& c : cases) {
    const auto energy_j = run_seeds(c, Chain::kFull, kNetworks).kinetic_energy_j;
    EXPECT_LT(energy_j[2], 0.5 * energy_j[0]) << name_of(c.tissue) << ", hand " << name_of(c.hand);
  }
}

TEST(StabilityMap, ACaseRepeatsExactly) {
  const Case c{.delay_s = 0.02, .jitter_s = 0.02, .loss = 0.1};
  const Outcome first = run_case(c, Chain::kFull), second = run_case(c, Chain::kFull);
  EXPECT_EQ(first.generated_energy_j, second.generated_energy_j);
  EXPECT_EQ(first.amplitude_m, second.amplitude_m);
}

// A hand that falls into 5000 N/m before the force arrives is thrown out by a spring of 500 N/m instead. Fails if the
// coupling passes the tissue's own force on.
TEST(StabilityMap, ACouplingSoftensTheContactOfALateForce) {
  for (const Chain chain : {Chain::kFull, Chain::kTransmittedWithController}) {
    std::array<int, 2> rests{};
    std::array<double, 2> generated_j{};
    for (const double delay_s : {0.0, 0.005, 0.02, 0.05}) {
      for (const Hand hand : {Hand::kSoft, Hand::kStiff, Hand::kNone}) {
        Case c{.stiffness_n_per_m = 5000.0, .delay_s = delay_s, .hand = hand, .coupling_n_per_m = 500.0};
        for (const std::size_t coupled : {0, 1}) {
          c.tool_mass_kg = coupled == 1 ? 0.05 : 0.0;
          const Outcome outcome = run_case(c, chain);
          EXPECT_NE(outcome.motion, Motion::kGrows) << name_of(chain) << " " << delay_s << " s, " << name_of(hand);
          rests[coupled] += outcome.motion == Motion::kRests;
          generated_j[coupled] = std::max(generated_j[coupled], outcome.generated_energy_j);
        }
      }
    }
    EXPECT_LT(generated_j[1], generated_j[0] / 2) << name_of(chain);
    if (chain == Chain::kTransmittedWithController) {
      EXPECT_GT(rests[1], rests[0] + 6) << "it replaces a local model";
    }
  }
}

}  // namespace
}  // namespace tensormass::haptic
