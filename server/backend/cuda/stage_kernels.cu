#include "backend/cuda/stage_kernels.h"

#include "backend/cuda/launch.cuh"
#include "backend/cuda/stop.cuh"
#include "step/run.h"

// TM_REAL, float or double, comes from the build.
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

template <class StageType, class Real>
__global__ void __launch_bounds__(kMaxBlockThreads)
    run_solve(const __grid_constant__ view::SceneView<Real> view,
              const __grid_constant__ view::ElementView<Real> elements) {
  SolveTeam<Real> team(view.solve.report);
  StageType::run(team, view, elements);
}

template <class Real>
const void* stage_kernel(const model::Model& model, const step::Stage& stage) {
  const void* kernel = nullptr;
  step::with_stage(model, stage, [&](auto type) {
    using Stage = decltype(type);
    if constexpr (Stage::kInfo.kind == step::StageKind::kSolve) {
      kernel = reinterpret_cast<const void*>(&run_solve<Stage, Real>);
    } else {
      kernel = reinterpret_cast<const void*>(&run_stage<Stage, Real>);
    }
  });
  return kernel;
}

template const void* stage_kernel<TM_REAL>(const model::Model&, const step::Stage&);

}  // namespace tensormass::backend::cuda
