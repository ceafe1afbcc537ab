#pragma once

#include <cstdint>
#include <vector>

#include <cuda_runtime.h>

#include "backend/cuda/blocks.h"
#include "backend/cuda/coarse_kernels.h"
#include "backend/cuda/memory.cuh"
#include "backend/cuda/solve_plan.cuh"
#include "backend/cuda/stage_kernels.h"
#include "model/bind.h"
#include "model/coarse_lists.h"
#include "step/stages.h"

/// The coarse level of one scene on a device (solver/coarse_rows.h): its buffers, and how to launch its kernels.
///
///   stages of the solve without it              with it
///   measure row errors   nothing                e
///   coarse level         nothing                R, E, W
///   solve                the fused kernel       factorize, scale, δ, conjugate gradients, advance, check volume
///
/// A fused solve keeps its vectors on the chip and does several stages in one kernel. A solve with a coarse level runs
/// these stages one by one, with vectors of its own in device memory.
namespace tensormass::backend::cuda {

template <class Real>
class CoarseStages {
 public:
  /// scene: of the solve without a coarse level. groups: the scene's element groups.
  CoarseStages(const model::Model& model, const view::SceneView<Real>& scene, DeviceArena& arena)
      : model_(model),
        view_{scene, model::bind_coarse<Real>(model, arena), model::bind_coarse_lists(model, arena)},
        kernels_(coarse_kernels<Real>()) {
    if (!exists() || model.solve == model::SolveKind::kStages) return;
    const std::size_t rows = model.layout.row_count, local = rows + model.layout.halo.size();
    view::SolveView<Real>& solve = view_.scene.solve;
    solve.residual = arena.zeros<Real>("residual with a coarse level", 4 * local);
    solve.direction = arena.zeros<Real>("direction with a coarse level", 4 * local);
    // The fused solve's own product and sums carry tags (exchange.cuh), which others must not overwrite.
    solve.product = arena.zeros<Real>("product with a coarse level", 2 * 4 * rows);
    solve.reduction = arena.zeros<Real>("partial sums with a coarse level",
                                        2 * std::size_t{model.layout.patch_count} * view::kPatchSums);
    any_reference_gradients_ = arena.zeros<Real>("reference gradients of checked elements", 12);
  }

  bool exists() const { return view_.coarse.aggregate_count > 0; }
  /// The scene with the vectors of the solve with a coarse level.
  const view::SceneView<Real>& scene() const { return view_.scene; }

  void launch_errors(cudaStream_t stream) { launch(kernels_.errors, by_rows(), kStageThreads, stream); }
  void launch_matrix(cudaStream_t stream) {
    launch(kernels_.sums, by_rows(), kStageThreads, stream);
    launch(kernels_.matrix, view_.lists.pair_count, kStageThreads, stream);
    launch(kernels_.invert, 1, kCoarseThreads, stream);
  }
  /// Solves the scaled system.
  void launch_solve(cudaStream_t stream) {
    launch(kernels_.losses, by_rows(), kStageThreads, stream);
    int resident = 0, processors = 0, device = 0;
    check(cudaGetDevice(&device), "device");
    check(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device), "device");
    const std::size_t bytes =
        coarse_shared_bytes<Real>(static_cast<std::uint32_t>(solver::coarse_unknowns(view_.coarse)));
    if (bytes > allow_all_shared_bytes(kernels_.solve))
      throw CudaFailure("no room for the inverse of the coarse level");
    check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, kernels_.solve, kCoarseThreads, bytes),
          "coarse level");
    if (resident * processors < static_cast<int>(model_.layout.patch_count)) {
      throw CudaFailure("the scene's patches do not fit on the device at once with a coarse level");
    }
    void* arguments[] = {&view_};
    check(cudaLaunchCooperativeKernel(kernels_.solve, model_.layout.patch_count, kCoarseThreads, arguments, bytes,
                                      stream),
          "solve with a coarse level");
  }
  /// Elements of a group that the fused solve would check, as the stage that checks inversion reads them. Linear
  /// tetrahedra need only their rows; the stage tests whether gradients exist.
  view::ElementView<Real> checked(view::ElementView<Real> elements) const {
    elements.reference_gradients = any_reference_gradients_;
    elements.reference_points = 1;
    return elements;
  }

 private:
  dim3 by_rows() const {
    const std::uint32_t patches = model_.layout.patch_count;
    return {patches, model_.layout.row_count / patches / kStageThreads + 1};
  }
  void launch(const void* kernel, dim3 grid, unsigned threads, cudaStream_t stream) {
    void* arguments[] = {&view_};
    check(cudaLaunchKernel(kernel, grid, threads, arguments, 0, stream), "coarse level");
  }

  const model::Model& model_;
  CoarseScene<Real> view_;
  const CoarseKernels kernels_;
  const Real* any_reference_gradients_ = nullptr;
};

}  // namespace tensormass::backend::cuda
