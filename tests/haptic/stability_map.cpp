// tensormass-haptic-stability-map: presses the haptic client against walls over bad networks, and prints one line of
// JSON for each case and chain. stability_map.py runs it and draws the map; closed_loop.h says what a case is.

#include <array>
#include <cstdio>

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

}  // namespace

int main() {
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
