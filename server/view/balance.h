#pragma once

#include <cstddef>
#include <cstdint>

#include "core/scalar.h"

/// Free bodies, whose momentum each step balances (contact/balance.h). In a scene without them all pointers are nullptr
/// and all counts zero.
///
///   entry     a free body in a patch that has rows of it
///   partner   of a free body: another one that links may join to it
namespace tensormass::view {

inline constexpr std::uint32_t kNoBody = 0xFFFFFFFFu;

/// Entries of the upper triangle of a symmetric 6 × 6 matrix, row by row.
inline constexpr std::size_t kBalanceTriangle = 21;

/// What BalanceSums::sliding holds.
enum SlidingSum : std::size_t {
  kSlidingN,           // Σ N over contacts that slide
  kSlidingSlip,        // Σ N ξ, three numbers
  kSlidingArm = 4,     // Σ N r, three numbers
  kSizeOfImpulses = 7  // sum of the sizes of all impulses [N s]
};

/// Sums over a free body. Moments are about its centre row. Doubles: momentum and impulse nearly cancel.
struct BalanceSums {
  double defect[6];                     // impulse and moment of impulse that are missing in the motion [N s, N m s]
  double sliding[8];                    // SlidingSum
  double stiffness[kBalanceTriangle];   // what resists a rigid motion of the body: mass, and h² times that of contacts
  double along_slip[kBalanceTriangle];  // the same, only of the secant of friction along the slip
};
inline constexpr std::size_t kBalanceSums = sizeof(BalanceSums) / sizeof(double);

/// How the rigid motion of a partner changes the impulse and the moment of impulse on a free body: a 6 × 6 matrix in
/// two halves, row by row. The first has what the partner's translation does, the second what its rotation does.
struct PartnerSums {
  double moved[18], turned[18];
};
/// Most free bodies with partners whose motions are solved for together. In a scene with more, each counts its
/// partners as the solve has moved them.
inline constexpr std::uint32_t kMaxCoupledBodies = 16;

/// The rigid motion that is added to a free body.
template <class Real>
struct BodyCorrection {
  Real velocity[3];  // that of the centre row [m/s]
  Real spin[3];      // [rad/s]
  Real center_m[3];  // position of the centre row after the solve
  Real with_along;   // 1: friction counts with its resistance along the slip, which never reverses it
};

/// The error in the motion of a free body before the last pass of its balance.
template <class Real>
struct BalanceReport {
  Real defect_n_s;   // size of the impulse that was missing
  Real impulse_n_s;  // sum of the sizes of all impulses on the body
};

template <class Real>
struct BalanceView {
  std::uint32_t body_count;  // free bodies

  const std::uint32_t* row_body;        // [row_count] free body of a row, or kNoBody
  const std::uint32_t* center_rows;     // [body_count] a row near the middle of the body
  const std::uint32_t* patch_entries;   // [patch_count + 1] entries of a patch
  const std::uint32_t* entry_body;      // [entry]
  const std::uint32_t* body_begin;      // [body_count + 1] into body_entries
  const std::uint32_t* body_entries;    // [entry] entries, body by body
  const std::uint32_t* partner_begin;   // [body_count + 1] into partners
  const std::uint32_t* partners;        // [partner] free bodies, body by body
  const std::uint32_t* entry_partners;  // [entry + 1] into partner_sums; nullptr: no body has partners

  Real* start_velocity;               // [row_count, 4] v̂ of rows of free bodies
  BalanceSums* sums;                  // [entry]
  BalanceSums* totals;                // [body_count]
  PartnerSums* partner_sums;          // [partners of each entry]
  double* system;                     // [6 · body_count, 6 · body_count] lower triangle; without partners nullptr
  double* motions;                    // [6 · body_count] right-hand side of the system, then its solution
  BodyCorrection<Real>* corrections;  // [body_count]
  BalanceReport<Real>* reports;       // [body_count]
};

}  // namespace tensormass::view
