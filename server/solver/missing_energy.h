#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "view/solve.h"

/// How far a linear solve fell short that ended at its limit of iterations.
///
///   e     Δv − A⁻¹ b, the error of the solve [m/s];  its energy is e·A e [J]
///   n     most iterations of the solve
///   G_k   x·Âx, the energy gained up to iteration k; conjugate gradients only ever gain
///   late  G_n − G_3n/4, the gain of the last quarter
///   q     late / (G_3n/4 − G_n/2), by which the gain of a quarter falls to the next
///
///   e·A e = G_∞ − G_n ≈ late · max(q / (1 − q), 1)
///
/// The first of the two is a geometric series (Golub & Meurant 2010 has such estimates). Convergence comes in stairs;
/// so one step of them must not count as the end.
///
/// 1. The residual does not tell this: in a slender body its norm says nothing about smooth errors.
/// 2. A ⪰ M gives bounds that follow from the energy alone, without another pass over the rows: dt √(e·A e / m) for the
///    root mean square of the error in displacement, weighted by mass, and √(m e·A e) / dt for the error of the force
///    on a free body.
/// 3. docs/decisions/preconditioner.md compares the estimate with converged solutions. At up to 100 iterations
///    √(e·A e) is right within a factor of about two, if the solve is far from its end.
namespace tensormass::solver {

/// Largest q: the gain may grow for a while, and then the series would not end.
inline constexpr double kMaxGainRatio = 0.95;

/// Returns e·A e [J]. 0: the solve ended before its limit, or the limit has fewer iterations than the estimate needs.
template <class Real>
double missing_energy_j(const view::SolveReport<Real>& report, std::uint32_t max_iterations) {
  constexpr std::uint32_t kLeastIterations = 8;
  if (report.iterations < max_iterations || max_iterations < kLeastIterations) return 0;
  const auto gained = [&](int k) { return static_cast<double>(report.gained_energy[k]); };
  const double before = std::max(gained(1) - gained(0), 0.0), late = std::max(gained(2) - gained(1), 0.0);
  if (!(late > 0) || !std::isfinite(late)) return 0;
  const double ratio = before > 0 ? std::min(late / before, kMaxGainRatio) : kMaxGainRatio;
  return late * std::max(ratio / (1 - ratio), 1.0);
}

/// Returns √(e·A e / (x·A x + e·A e)): the error of the solve in the energy norm, relative to its solution. 0: as
/// above.
template <class Real>
double missing_share(const view::SolveReport<Real>& report, std::uint32_t max_iterations) {
  const double missing_j = missing_energy_j(report, max_iterations);
  return missing_j > 0 ? std::sqrt(missing_j / (static_cast<double>(report.gained_energy[2]) + missing_j)) : 0;
}

/// The error of a step that the energy e·A e implies.
struct StepError {
  double displacement_m = 0;  ///< root mean square over the scene, weighted by mass
  double force_n = 0;         ///< error of the force on a free body
};

/// mass_kg: of the scene's free rows.
inline StepError step_error(double energy_j, double mass_kg, double dt_s) {
  if (!(mass_kg > 0) || !(dt_s > 0)) return {};
  return {dt_s * std::sqrt(energy_j / mass_kg), std::sqrt(energy_j * mass_kg) / dt_s};
}

}  // namespace tensormass::solver
