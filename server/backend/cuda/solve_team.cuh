#pragma once

#include <limits>

#include "backend/cuda/stop.cuh"
#include "backend/cuda/team.cuh"

namespace tensormass::backend::cuda {

/// The team of a solve. Its last sum is not a number if the host asks for the end of the solve (stop.cuh).
template <class Real>
class SolveTeam : public Team {
 public:
  __device__ explicit SolveTeam(const view::SolveReport<Real>* report) : report_(report) {}

  /// Exchanges once in each iteration.
  template <std::size_t Count>
  __device__ void exchange(Real (&sums)[Count], Real* scratch) {
    if (leads() && is_end_asked(report_, iteration_++)) sums[Count - 1] = std::numeric_limits<Real>::quiet_NaN();
    Team::exchange(sums, scratch);
  }

 private:
  const view::SolveReport<Real>* const report_;
  std::uint32_t iteration_ = 0;
};

}  // namespace tensormass::backend::cuda
