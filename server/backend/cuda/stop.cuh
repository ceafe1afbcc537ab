#pragma once

#include <atomic>
#include <cstdint>
#include <limits>

#include "view/solve.h"

/// How the host ends a solve that is under way, because nobody will see the scene again.
///
///   host                                             device
///   wait() sees SceneState::stopped()
///     ── kEndAsked ──> SolveReport::iterations ──>   the first patch looks, every kIterationsPerLook iterations
///                      in page-locked host memory    its part of r·r is then not a number, and so is the sum
///                                                    all patches end the solve (solver::Recurrence::take)
///
/// 1. A solve writes its report at its end alone. Until then that place is free for the host.
/// 2. One patch looks. If each did, some might end an iteration before the others, which would wait for ever.
/// 3. A look takes a microsecond, because host memory is far. Usual solves end before the first one.
namespace tensormass::backend::cuda {

inline constexpr std::uint32_t kEndAsked = 0xFFFFFFFF;
inline constexpr std::uint32_t kIterationsPerLook = 64;

/// Asks the solve that writes this report to end.
template <class Real>
void ask_for_end(view::SolveReport<Real>& report) {
  std::atomic_ref(report.iterations).store(kEndAsked, std::memory_order_relaxed);
}

/// Whether the host asks for the end of the solve. iteration: of the solve, from 0.
template <class Real>
__device__ inline bool is_end_asked(const view::SolveReport<Real>* report, std::uint32_t iteration) {
  if (iteration % kIterationsPerLook != kIterationsPerLook - 1) return false;
  return *const_cast<const volatile std::uint32_t*>(&report->iterations) == kEndAsked;
}

}  // namespace tensormass::backend::cuda
