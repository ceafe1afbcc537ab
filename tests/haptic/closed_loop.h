#pragma once

// The whole haptic client on a simulated network and server, in simulated time: what the stability map runs.
//
//     hand <-> SimulatedDevice <-> Loop <-> SimulatedServer
//                                           network: delay, jitter, loss
//                                           tissue: steps at its own rate
//
// Loop, ForceRenderer, PassivityController, limit_force and ForceGuard are the client's own code. Only the clock, the
// network, the tissue and the hand are simulated. The tissue is z < 0, and the hand moves along z.
//
// Units: m, N, N/m, s, J. Single-threaded and deterministic: a case gives the same outcome each time.

#include <array>
#include <cstddef>
#include <cstdint>
#include <string_view>

namespace tensormass::haptic {

/// What moves the device.
enum class Hand {
  kSoft,   // a loose grip
  kStiff,  // a firm grip
  kNone,   // a constant push on a free mass
};

/// What the device is pressed against.
enum class Tissue {
  kWall,   // a linear spring whose local model is exact
  kOrgan,  // viscoelastic, with a noisy force and a local model that is too soft, as that of the real server
  kCut,    // a spring that yields under a blade, with a noisy force
};

/// Parts of the client in use.
enum class Chain {
  kFull,                       // the client
  kNoSecant,                   // without SecantStiffness
  kNoController,               // without the passivity controller
  kTransmittedWithController,  // the tissue's force without a local model
  kTransmitted,                // the same without the passivity controller
};
inline constexpr std::size_t kChainCount = 5;

std::string_view name_of(Hand hand);
std::string_view name_of(Tissue tissue);
std::string_view name_of(Chain chain);

struct Case {
  Tissue tissue = Tissue::kWall;
  /// For a slow press.
  double stiffness_n_per_m = 500.0;
  double server_rate_hz = 60.0;
  /// One way.
  double delay_s = 0.0;
  /// Each message takes delay_s plus a uniformly distributed time up to jitter_s. Messages keep their order, as on TCP.
  double jitter_s = 0.0;
  /// Probability that a message of either direction is lost.
  double loss = 0.0;
  Hand hand = Hand::kSoft;
  std::uint32_t seed = 1;
  /// Mass of the tool and stiffness of its critically damped coupling, which are the server's (world/coupling.h).
  /// Without a mass the tool is at the hand's place.
  double tool_mass_kg = 0.0;
  double coupling_n_per_m = 1000.0;
};

/// The press from first contact to the end of the hold.
enum class Motion {
  kRests,   // peak speed of the last third below kRestSpeedMPerS
  kShakes,  // neither rests nor grows
  kGrows,   // peak kinetic energy of the last third above that of the first
};

std::string_view name_of(Motion motion);

/// Peak speed below which a hand counts as at rest. At 10 Hz it is an amplitude of 30 µm.
inline constexpr double kRestSpeedMPerS = 2e-3;

struct Outcome {
  Motion motion = Motion::kRests;
  /// Peak kinetic energy of device and hand in each third of the press [J].
  std::array<double, 3> kinetic_energy_j{};
  /// Peak-to-peak position in the last third.
  double amplitude_m = 0.0;
  /// Largest net energy that the device had given the hand at any time [J]. Passive tissue gives none. Counted from
  /// force and motion of the device, without the client's cap.
  double generated_energy_j = 0.0;
  /// Lowest energy of the client's observer [J].
  double min_observer_energy_j = 0.0;
  double max_force_n = 0.0;
};

/// Runs one press.
Outcome run_case(const Case& c, Chain chain);

/// Runs presses with the seeds c.seed, c.seed + 1, … and returns the mean of their kinetic energies, with the motion
/// that it shows, and the extremes of the rest. The mean tells growth from a loss that chance put into the last third.
Outcome run_seeds(const Case& c, Chain chain, std::uint32_t count);

}  // namespace tensormass::haptic
