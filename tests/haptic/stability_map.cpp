// tensormass-haptic-stability-map: presses the haptic client against walls over bad networks, and prints one line of
// JSON for each case and chain. stability_map.py runs it and draws the map; closed_loop.h says what a case is.
//
// `tensormass-haptic-stability-map coupling` prints results/coupling.csv instead: what a tool with a mass changes.
// `tensormass-haptic-stability-map cut` prints results/cut.csv: tissue that is cut.

#include <algorithm>
#include <array>
#include <cstdio>
#include <string_view>

#include <spdlog/fmt/fmt.h>

#include "closed_loop.h"

namespace {

using namespace tensormass::haptic;

constexpr std::array kStiffnesses{50.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0};
constexpr std::array kTissues{Tissue::kWall, Tissue::kOrgan};
constexpr std::array kServerRates{60.0, 1000.0};
constexpr std::array kDelaysMs{0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 35.0, 50.0};
constexpr std::array kJitterShares{0.0, 0.5, 1.0};
constexpr std::array kLosses{0.0, 0.1, 0.5};
constexpr std::array kHands{Hand::kSoft, Hand::kStiff, Hand::kNone};

// Networks of a case.
constexpr std::uint32_t kSeeds = 3;
constexpr double kSPerMs = 1e-3;

void print(const Case& c, Chain chain, const Outcome& o) {
  fmt::print(
      "{{\"tissue\": \"{}\", \"stiffness_n_per_m\": {}, \"server_rate_hz\": {}, \"delay_ms\": {}, "
      "\"jitter_ms\": {}, \"loss\": {}, \"hand\": \"{}\", \"chain\": \"{}\", \"motion\": \"{}\", "
      "\"kinetic_energy_j\": [{:.3g}, {:.3g}, {:.3g}], \"amplitude_m\": {:.3g}, \"generated_energy_j\": {:.3g}, "
      "\"min_observer_energy_j\": {:.3g}, \"max_force_n\": {:.3g}}}\n",
      name_of(c.tissue), c.stiffness_n_per_m, c.server_rate_hz, c.delay_s / kSPerMs, c.jitter_s / kSPerMs, c.loss,
      name_of(c.hand), name_of(chain), name_of(o.motion), o.kinetic_energy_j[0], o.kinetic_energy_j[1],
      o.kinetic_energy_j[2], o.amplitude_m, o.generated_energy_j, o.min_observer_energy_j, o.max_force_n);
}

/// Runs every chain on the same networks.
void run(const Case& c) {
  const bool is_random = c.jitter_s > 0.0 || c.loss > 0.0 || c.tissue == Tissue::kOrgan;
  for (std::size_t i = 0; i < kChainCount; ++i) print(c, Chain(i), run_seeds(c, Chain(i), is_random ? kSeeds : 1));
}

/// Presses against 5000 N/m at 60 Hz, over four delays and with three hands for each row.
void print_couplings() {
  fmt::print("chain,tissue,mass_kg,coupling_n_per_m,rests,shakes,grows,kinetic_energy_mj,generated_energy_mj\n");
  for (const Chain chain : {Chain::kFull, Chain::kTransmittedWithController, Chain::kTransmitted}) {
    for (const Tissue tissue : kTissues) {
      for (const auto& [mass_kg, coupling] : {std::pair{0.0, 0.0}, std::pair{0.01, 500.0}, std::pair{0.05, 500.0},
                                              std::pair{0.2, 500.0}, std::pair{0.05, 1000.0}}) {
        std::array<int, 3> motions{};
        double kinetic_j = 0.0, generated_j = 0.0;
        for (const double delay_ms : {0.0, 5.0, 20.0, 50.0}) {
          for (const Hand hand : kHands) {
            const Outcome o = run_case({.tissue = tissue,
                                        .stiffness_n_per_m = 5000.0,
                                        .delay_s = delay_ms * kSPerMs,
                                        .hand = hand,
                                        .tool_mass_kg = mass_kg,
                                        .coupling_n_per_m = coupling},
                                       chain);
            ++motions[static_cast<std::size_t>(o.motion)];
            kinetic_j = std::max(kinetic_j, o.kinetic_energy_j[2]);
            generated_j = std::max(generated_j, o.generated_energy_j);
          }
        }
        fmt::print("{},{},{},{},{},{},{},{:.3g},{:.3g}\n", name_of(chain), name_of(tissue), mass_kg, coupling,
                   motions[0], motions[1], motions[2], 1e3 * kinetic_j, 1e3 * generated_j);
      }
    }
  }
}

/// Cuts over all networks of the map but the worst, with 10 % loss at most. A row for each chain and hand.
void print_cuts() {
  fmt::print("chain,hand,rests,shakes,grows,kinetic_energy_mj,generated_energy_mj\n");
  for (const Chain chain :
       {Chain::kFull, Chain::kNoController, Chain::kTransmittedWithController, Chain::kTransmitted}) {
    for (const Hand hand : kHands) {
      std::array<int, 3> motions{};
      double kinetic_j = 0.0, generated_j = 0.0;
      Case c{.tissue = Tissue::kCut, .hand = hand};
      const auto count = [&] {
        const Outcome o = run_seeds(c, chain, kSeeds);
        ++motions[static_cast<std::size_t>(o.motion)];
        kinetic_j = std::max(kinetic_j, o.kinetic_energy_j[2]);
        generated_j = std::max(generated_j, o.generated_energy_j);
        c.seed += kSeeds;
      };
      for (const double stiffness : kStiffnesses) {
        for (const double rate : kServerRates) {
          for (const double delay_ms : kDelaysMs) {
            for (const double jitter : kJitterShares) {
              if (delay_ms == 0.0 && jitter > 0.0) continue;
              for (const double loss : {0.0, 0.1}) {
                c.stiffness_n_per_m = stiffness;
                c.server_rate_hz = rate;
                c.delay_s = delay_ms * kSPerMs;
                c.jitter_s = jitter * c.delay_s;
                c.loss = loss;
                count();
              }
            }
          }
        }
      }
      fmt::print("{},{},{},{},{},{:.3g},{:.3g}\n", name_of(chain), name_of(hand), motions[0], motions[1], motions[2],
                 1e3 * kinetic_j, 1e3 * generated_j);
    }
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc > 1 && std::string_view(argv[1]) == "coupling") {
    print_couplings();
    return 0;
  }
  if (argc > 1 && std::string_view(argv[1]) == "cut") {
    print_cuts();
    return 0;
  }
  Case c;
  for (const double stiffness : kStiffnesses) {
    c.stiffness_n_per_m = stiffness;
    for (const Tissue tissue : kTissues) {
      c.tissue = tissue;
      for (const double rate : kServerRates) {
        c.server_rate_hz = rate;
        for (const double delay_ms : kDelaysMs) {
          c.delay_s = delay_ms * kSPerMs;
          for (const double jitter : kJitterShares) {
            if (delay_ms == 0.0 && jitter > 0.0) continue;
            c.jitter_s = jitter * c.delay_s;
            for (const double loss : kLosses) {
              c.loss = loss;
              for (const Hand hand : kHands) {
                c.hand = hand;
                run(c);
                c.seed += kSeeds;
              }
            }
          }
        }
      }
    }
  }
}
