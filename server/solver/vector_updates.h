#pragma once

#include "core/scalar.h"

/// The updates of conjugate gradients, for one vector or one component. Every solve calls them: the CPU's and the GPU's
/// unfused one (conjugate_gradients.h), the resident and the streamed one (backend/cuda). Symbols (x, r, p, q, α, β):
/// conjugate_gradients.h; a prime marks a value after its update.
///
///   V      a number, a pack of numbers, or a vector of three
///   Real   type of α, β and γ
///
/// For vectors, a function returns an expression that refers to its arguments. Assign it at once. nvcc would make other
/// code of functions that return a vector.
///
///   r' = r − α q           p' = r' + β p           x' = x + α p
///
/// A solve that keeps p in device memory updates x in every other iteration only, which saves reads and writes of x:
///
///   iteration 1   x stays as it is; γ = α / β is remembered
///   iteration 2   x'' = x + α p + α' p' = x + (α' + γ) p' − γ r'      because β p = p' − r'
///
/// If no second iteration follows, x' = x + γ (p' − r') adds what was postponed. If β is small, p' − r' has few digits
/// of β p, so the update must not be postponed.
namespace tensormass::solver {

template <class V, class Real>
TM_HOST_DEVICE auto next_solution(const V& x, const V& p, Real alpha) {
  return x + p * alpha;
}
template <class V, class Real>
TM_HOST_DEVICE auto next_residual(const V& r, const V& q, Real alpha) {
  return r - q * alpha;
}
/// r: after its update. p: before.
template <class V, class Real>
TM_HOST_DEVICE auto next_direction(const V& r, const V& p, Real beta) {
  return r + p * beta;
}

/// Whether an iteration may postpone its update of x. gamma: γ of the last iteration; zero if it postponed nothing.
template <class Real>
TM_HOST_DEVICE bool may_postpone(Real gamma, Real beta) {
  constexpr Real kLeastBeta = Real(0.05);
  return gamma == 0 && beta > kLeastBeta;
}
/// Returns x after the update of this iteration and the one that the last iteration postponed, if γ is not zero.
/// r, p: before their update in this iteration.
template <class V, class Real>
TM_HOST_DEVICE auto solution_with_postponed(const V& x, const V& p, const V& r, Real alpha, Real gamma) {
  return x + p * (alpha + gamma) - r * gamma;
}
/// Returns x after the postponed update alone. r, p: after their update.
template <class V, class Real>
TM_HOST_DEVICE auto postponed_solution(const V& x, const V& p, const V& r, Real gamma) {
  return x + (p - r) * gamma;
}

}  // namespace tensormass::solver
