#pragma once

#include "backend/cuda/packed_matrix.cuh"
#include "backend/cuda/patch_sums.cuh"
#include "backend/cuda/patch_volume.cuh"
#include "backend/cuda/streamed_memory.h"
#include "solver/conjugate_gradients.h"
#include "solver/time_scheme.h"
#include "solver/vector_updates.h"

/// The solve of solver/conjugate_gradients.h in single precision, for patches with more rows than a block has threads.
/// A thread block runs one patch for the whole solve and reads the packed matrix from memory in each iteration. Symbols
/// (Â, b̂, x, r, p, q, α, β): conjugate_gradients.h.
///
///   where the data of a patch are:
///     device memory   the packed matrix (packed_matrix.cuh)
///     shared memory   q of the tiles that warps work on, then p, r, x in this order, as far as they fit
///     device memory   the vectors that do not fit (bits of StreamedVectors say which ones do)
///
///   scale, pack ──> q = Â p, tile by tile ──> exchange q and sums ──> update x, r, p ──┬──> end_solve
///                    ^                                                                 │
///                    └─────────────────────────────────────────────────────────────────┘
///
/// 1. An iteration waits for little but the matrix. Warps therefore read it ahead, across tiles and iterations
///    (TileWalk).
/// 2. If p is in device memory, x is updated only in every other iteration. That saves its reads and writes.
///
/// resident_solve.cuh serves smaller patches.
namespace tensormass::backend::cuda {

/// A vector of a patch, in shared memory or in a buffer of the scene: three floats a row.
struct Vectors {
  float* data;
  __device__ Vec3<float> operator[](std::uint32_t local) const {
    const float* v = data + std::size_t{3} * local;
    return {v[0], v[1], v[2]};
  }
  __device__ void set(std::uint32_t local, const Vec3<float>& value) const {
    float* v = data + std::size_t{3} * local;
    v[0] = value[0];
    v[1] = value[1];
    v[2] = value[2];
  }
};
/// Threads of streamed_solve: one warp for each tile that is worked on at once.
inline constexpr unsigned kStreamedThreads = matrix::kTilesAtOnce * kWarp;

/// Solves the system of a patch and moves its rows. solver::factorize must have run: `diagonal` holds L⁻¹, `rhs` holds
/// b̂.
/// Word: type of a packed column index.
/// NearDirection: p is in shared memory.
template <unsigned Threads, class Word, bool NearDirection>
__global__ void __launch_bounds__(Threads, 1)
    streamed_solve(const __grid_constant__ SceneView<float> s, std::uint32_t near_vectors) {
  extern __shared__ float4 shared[];
  __shared__ PatchSums<Threads> sums;
  __shared__ typename PatchVolume<Threads>::Parts tetrahedra;
  const view::Patch patch = view::patch_of(s.patches, blockIdx.x);
  const std::uint32_t own = patch.own(), locals = own + patch.halo_count;
  const std::uint32_t thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp;
  const std::uint32_t tile_rows = s.matrix.tile_rows != 0 ? s.matrix.tile_rows : matrix::kMaxTileRows;

  constexpr std::uint32_t kWarps = Threads / kWarp;
  static_assert(kWarps == matrix::kTilesAtOnce);
  const std::uint32_t held_rows = streamed_tile_rows(own, tile_rows);
  float4* const tile = shared + std::size_t{warp} * tile_rows;
  StreamedMemory<float4> memory(shared, held_rows, near_vectors);
  float4* p;  // a template parameter, so that the compiler knows its memory
  if constexpr (NearDirection) {
    p = memory.place_direction(locals);
  } else {
    p = reinterpret_cast<float4*>(s.solve.direction + 4 * patch.local_begin);
  }
  const Vectors r{memory.place(kNearResidual, locals, s.solve.residual + 4 * patch.local_begin)};
  const Vectors x{memory.place(kNearSolution, own, s.solve.solution + std::size_t{4} * patch.row_begin)};

  const bool starts_from_last = solver::Recurrence<float>::may_start_from_last(s.state);
  float residual_squared = 0, along_residual = 0;  // r·r and, before the first iteration, p·r
  for (std::uint32_t i = thread; i < locals; i += Threads) {
    const std::uint32_t row = view::global_row(s.patches, patch, i);
    const Vec3<float> b = view::load3<float>(s.matrix.rhs, row);
    const Vec3<float> start =
        starts_from_last ? view::load3<float>(solver::last_solution(s.patches, s.state, s.solve), row) : b;
    p[i] = cell_of(start);
    r.set(i, b);
    if (i >= own) continue;
    x.set(i, Vec3<float>::Zero());
    residual_squared += b.dot(b);
    along_residual += start.dot(b);
  }
  __syncthreads();

  if (s.guard.patch_tetrahedra != nullptr && thread == 0) tetrahedra = PatchVolume<Threads>::parts_of(s, patch);
  Exchange exchange(s, patch.index);
  solver::Recurrence<float> recurrence(s.state, s.solve);
  for (std::uint32_t first = warp * tile_rows; first < own; first += kWarps * tile_rows) {
    scale_tile<Word>(s, patch, first, minimum(first + tile_rows, own), reinterpret_cast<RowLoss*>(tile));
  }
  TileWalk<kWarps, Word> walk(s, patch, tile_rows);
  float gamma = 0;  // γ of a postponed update of x (solver/vector_updates.h)
  do {
    exchange.begin();
    // If q does not fit into shared memory, it is read back from the cells that this patch has just published.
    const auto* const q = held_rows == own ? shared : reinterpret_cast<const float4*>(exchange.rows(patch.row_begin));
    const bool along_last = recurrence.is_along_last();
    Exchange::Cell own_sums{0, 0, residual_squared, 0};
    for (std::uint32_t first = warp * tile_rows; first < own; first += kWarps * tile_rows) {
      const std::uint32_t last = minimum(first + tile_rows, own);
      walk.multiply(p, tile);
      for (std::uint32_t local = first + lane; local < last; local += kWarp) {
        const Vec3<float> product = three_of(tile[local - first]);
        exchange.publish_row(patch.row_begin + local, product[0], product[1], product[2]);
        own_sums.x += three_of(p[local]).dot(product);
        own_sums.y += product.dot(product);
      }
      __syncwarp();  // the next tile uses the same memory
    }
    if (along_last) own_sums.y = along_residual;
    sums.exchange(exchange, s.patches.patch_count, own_sums, recurrence.iterations());
    __syncthreads();
    const Exchange::Cell all = sums.total();
    if (!recurrence.take(all.x, all.y, all.z)) break;
    const float alpha = recurrence.alpha(), beta = recurrence.beta();
    const bool postpones = !NearDirection && solver::may_postpone(gamma, beta);
    const auto moved = [&](const Vec3<float>& x, const Vec3<float>& direction,
                           const Vec3<float>& residual) -> Vec3<float> {
      if constexpr (NearDirection) return solver::next_solution(x, direction, alpha);
      return solver::solution_with_postponed(x, direction, residual, alpha, gamma);
    };
    residual_squared = 0;
    constexpr std::uint32_t kRowsAtOnce = 2;
    for (std::uint32_t begin = thread; begin < own; begin += kRowsAtOnce * Threads) {
      Vec3<float> direction[kRowsAtOnce], residual[kRowsAtOnce], product[kRowsAtOnce], solution[kRowsAtOnce];
#pragma unroll
      for (std::uint32_t i = 0; i < kRowsAtOnce; ++i) {
        // Beyond the end, the thread reads its own first row again: others may be writing theirs.
        const std::uint32_t local = begin + i * Threads < own ? begin + i * Threads : begin;
        direction[i] = three_of(p[local]);
        residual[i] = r[local];
        product[i] = three_of(q[local]);
        if (!postpones) solution[i] = x[local];
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kRowsAtOnce; ++i) {
        const std::uint32_t local = begin + i * Threads;
        if (local >= own) break;
        if (!postpones) x.set(local, moved(solution[i], direction[i], residual[i]));
        residual[i] = solver::next_residual(residual[i], product[i], alpha);
        r.set(local, residual[i]);
        p[local] = cell_of(solver::next_direction(residual[i], direction[i], beta));
        residual_squared += residual[i].dot(residual[i]);
      }
    }
    constexpr int kAtOnce = 4;
    for (std::uint32_t h = thread; h < patch.halo_count; h += kAtOnce * Threads) {
      Exchange::Cell cells[kAtOnce];
      exchange.wait_for_rows(
          h, Threads, patch.halo_count, [&](int i) { return s.patches.halo[patch.halo_begin + h + i * Threads]; },
          cells);
      for (int i = 0; i < kAtOnce && h + i * Threads < patch.halo_count; ++i) {
        const std::uint32_t local = own + h + i * Threads;
        const Vec3<float> product(cells[i].x, cells[i].y, cells[i].z);
        const Vec3<float> residual = solver::next_residual(r[local], product, alpha);
        r.set(local, residual);
        p[local] = cell_of(solver::next_direction(residual, three_of(p[local]), beta));
      }
    }
    gamma = postpones ? alpha / beta : 0;
    __syncthreads();
    if (thread == 0 && patch.index == 0) recurrence.report_gain(s.solve);
  } while (recurrence.goes_on());

  // Adds the update that the last iteration has postponed. No barrier is needed: each thread moves the rows that it
  // completes here. end_solve overwrites other rows' vectors only if p is in shared memory, and then no update is
  // postponed.
  if (gamma != 0) {
    for (std::uint32_t local = thread; local < own; local += Threads) {
      x.set(local, solver::postponed_solution(x[local], three_of(p[local]), r[local], gamma));
    }
  }
  for (std::uint32_t local = thread; local < own; local += Threads) {
    solver::keep_solution(s.patches, s.state, s.solve, patch.row_begin + local, x[local]);
  }
  if (thread == 0 && patch.index == 0) recurrence.report(s.solve);
  // end_solve does not overwrite x, which lies after the memory that it uses.
  end_solve<Threads>(s, patch, tetrahedra, exchange, shared, [&](std::uint32_t row) -> Vec3<float> {
    return solver::unscaled(s.state, row, solver::load_lower<float>(s.matrix.diagonal, row), x[row - patch.row_begin]);
  });
}

}  // namespace tensormass::backend::cuda
