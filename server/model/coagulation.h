#pragma once

#include <algorithm>
#include <cstdint>

/// Heat in tissue that is not burnt away yet. An element that has taken a part of the energy that removes it
/// coagulates: its proteins denature and it becomes stiffer and pale.
///
///   κ        share of the element's material that is left, 1 to 0; it has taken (1 − κ) of the energy
///   g(κ)     how far it is coagulated: min(1, (1 − κ) / 0.1)
///   C(κ)     stiffness of what is left of it, over that of raw tissue: 1 + (c − 1) g(κ)
///   c        Body.coagulated_stiffness_factor
///
/// Energy and force of the element are κ C(κ) times those at the start, and its mass is κ times. Without a factor
/// (c = 1) both shares are κ to the last bit.
///
/// The tenth: to 75 or 80 °C tissue takes 0.15 to 0.17 J/mm³ (1060 kg/m³, 3.6 kJ/(kg K), from 37 °C), a twelfth of the
/// default of Body.ablation_j_per_m3. The modulus of liver has its first maximum at 70 to 75 °C (Kiss, Daniels and
/// Varghese 2009, J. Biomechanics 42).
namespace tensormass::model {

/// Share of the energy of removal after which tissue is coagulated.
inline constexpr double kCoagulatingShare = 0.1;
/// Most that tissue may stiffen.
inline constexpr double kMaxCoagulatedStiffness = 50;

/// Returns g(κ).
inline double coagulated(double kept) { return std::min(1.0, (1 - kept) / kCoagulatingShare); }
/// Returns C(κ).
inline double stiffening(double kept, double factor) { return 1 + (factor - 1) * coagulated(kept); }
/// Returns g(κ) in thirds, as clients see it: 0, 85, 170 or 255. So clients hear of an element three times at most.
inline std::uint8_t coagulation_seen(double kept) {
  return static_cast<std::uint8_t>(85 * static_cast<int>(3 * coagulated(kept)));
}

}  // namespace tensormass::model
