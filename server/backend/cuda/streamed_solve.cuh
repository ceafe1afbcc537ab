#pragma once

#include "backend/cuda/patch_sums.cuh"
#include "backend/cuda/patch_volume.cuh"
#include "solver/advance.h"
#include "solver/conjugate_gradients.h"
#include "solver/jacobi_scaling.h"
#include "tensor/tiles.h"

/// The solve of solver/conjugate_gradients.h for single precision, where a patch is a thread block for the whole
/// solve and has more rows than threads: the matrix comes from memory in each iteration, vectors stay as near as they
/// fit. resident_solve.cuh is for smaller patches.
namespace tensormass::backend::cuda {

using tensor::kSliceRows;
using tensor::SceneView;

/// A patch's vector, in shared memory or in a buffer of the scene: three floats a row.
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
__device__ inline Vec3<float> three_of(const float4& cell) { return {cell.x, cell.y, cell.z}; }
/// Whole, as memory that is written in part is read first.
__device__ inline float4 cell_of(const Vec3<float>& v) { return {v[0], v[1], v[2], 0}; }

/// Shared memory of streamed_solve [bytes], and its threads: a warp a tile at once.
inline constexpr std::size_t kStreamedBytesPerCell = 16, kStreamedBytesPerVector = 12;
inline constexpr unsigned kStreamedThreads = tensor::kTilesAtOnce * kWarp;

/// Where the columns of a slice begin, and where those end that a solve reads.
struct ReadColumns {
  std::uint32_t begin, end;
  __device__ ReadColumns(const SceneView<float>& s, std::uint32_t slice)
      : begin(s.slice_begin[slice]), end(s.slice_read != nullptr ? s.slice_read[slice] : s.slice_begin[slice + 1]) {}
};

/// Â for A in what is read of a tile's rows. By its warp.
__device__ inline void scale_tile(const SceneView<float>& s, const tensor::Patch& patch, std::uint32_t first,
                                  std::uint32_t last) {
  for (std::uint32_t row = patch.row_begin + first + threadIdx.x % kWarp; row < patch.row_begin + last; row += kWarp) {
    const ReadColumns columns(s, row / kSliceRows);
    const Mat3<float> own = solver::load_lower<float>(s.diagonal, row);
    // Some at once, as each waits for memory twice.
    constexpr std::uint32_t kAtOnce = 3;
#pragma unroll 1
    for (std::uint32_t begin = columns.begin; begin < columns.end; begin += kAtOnce) {
      std::uint32_t other[kAtOnce];
      Mat3<float> block[kAtOnce], factor[kAtOnce];
      const auto slot_of = [&](std::uint32_t i) {
        return std::size_t{minimum(begin + i, columns.end - 1)} * kSliceRows + row % kSliceRows;
      };
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) other[i] = s.columns[slot_of(i)];
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) block[i] = tensor::load_block<float>(s.edges, slot_of(i));
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        factor[i] = solver::load_lower<float>(s.diagonal, tensor::global_row(s, patch, other[i]));
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        if (begin + i >= columns.end) break;
        const Mat3<float> scaled = own * block[i] * factor[i].transpose();
        tensor::store_block<float>(s.edges, slot_of(i), scaled);
      }
    }
  }
}

/// A warp's way through its tiles, over and over: the columns that it multiplies next are on their way from memory,
/// also while patches exchange.
template <unsigned Warps>
class TileWalk {
 public:
  /// A warp that has no tile is not to multiply.
  __device__ TileWalk(const SceneView<float>& s, const tensor::Patch& patch, std::uint32_t tile_rows)
      : s_(s), patch_(patch), tile_rows_(tile_rows), own_(patch.own()), begin_(threadIdx.x / kWarp * tile_rows) {
    if (begin_ >= own_) return;
    begin_tile(begin_);
    load();
  }

  /// q = Â p on the rows of the tile at hand, all of it: what other tiles' rows have to do with them is read here
  /// (tensor/tiles.h). Then the warp's next tile is at hand. p: of the patch; q: of the tile, in shared memory; four
  /// floats a row.
  __device__ void multiply(const float4* p, float4* q) {
    const std::uint32_t first = first_, last = minimum(first + tile_rows_, own_);
    for (std::uint32_t local = first + lane(); local < last; local += kWarp)
      q[local - first] = p[local];  // unit diagonal
    __syncwarp();
#pragma unroll 1
    for (std::uint32_t local = first + lane(); local < last; local += kWarp) {
      const float4 own = p[local];
      Vec3<float> sum = Vec3<float>::Zero();
      bool ends = false;
#pragma unroll 1
      do {
        float4 direction[kAtOnce];
#pragma unroll
        for (std::uint32_t i = 0; i < kAtOnce; ++i) direction[i] = p[column_[i]];
#pragma unroll
        for (std::uint32_t i = 0; i < kAtOnce; ++i) {
          const float* a = block_[i];
          const float4 v = direction[i];
          for (int c = 0; c < 3; ++c) sum[c] += a[3 * c] * v.x + a[3 * c + 1] * v.y + a[3 * c + 2] * v.z;
          if ((twice_[i] >> lane() & 1) != 0) {
            float4& other = q[column_[i] - first];
            const float4 before = other;
            other = {before.x + a[0] * own.x + a[3] * own.y + a[6] * own.z,
                     before.y + a[1] * own.x + a[4] * own.y + a[7] * own.z,
                     before.z + a[2] * own.x + a[5] * own.y + a[8] * own.z, 0};
          }
          __syncwarp();  // the next column adds to the same rows
        }
        next_ += kAtOnce;
        ends = next_ >= end_;
        if (ends) next_slice();
        load();
      } while (!ends);
      float4& mine = q[local - first];
      const float4 before = mine;
      mine = {before.x + sum[0], before.y + sum[1], before.z + sum[2], 0};
      __syncwarp();
    }
  }

 private:
  static constexpr std::uint32_t kAtOnce = 5;  // two rounds for most rows

  __device__ static unsigned lane() { return threadIdx.x % kWarp; }
  /// A lane for each of its slices.
  __device__ void begin_tile(std::uint32_t first) {
    first_ = first;
    slice_ = 0;
    const std::uint32_t last = minimum(first + tile_rows_, own_);
    slices_ = (last - first) / kSliceRows;
    const std::uint32_t slice = (patch_.row_begin + first) / kSliceRows + minimum(lane(), slices_ - 1);
    const ReadColumns columns(s_, slice);
    begin_of_ = columns.begin;
    end_of_ = columns.end;
    begin_slice();
  }
  __device__ void begin_slice() {
    next_ = __shfl_sync(0xFFFFFFFFu, begin_of_, slice_);
    end_ = __shfl_sync(0xFFFFFFFFu, end_of_, slice_);
  }
  __device__ void next_slice() {
    if (++slice_ < slices_) return begin_slice();
    std::uint32_t next = first_ + Warps * tile_rows_;
    if (next >= own_) next = begin_;
    if (next != first_) return begin_tile(next);
    slice_ = 0;
    begin_slice();
  }
  /// Reads are under way together.
  __device__ void load() {
#pragma unroll
    for (std::uint32_t i = 0; i < kAtOnce; ++i) {
      const std::uint32_t j = next_ + i;
      column_[i] = j < end_ ? s_.columns[std::size_t{j} * kSliceRows + lane()] : 0;
      twice_[i] = j < end_ && s_.used_twice != nullptr ? s_.used_twice[j] : 0;
    }
#pragma unroll
    for (std::uint32_t i = 0; i < kAtOnce; ++i) {
      // The matrix passes by in every iteration: it is not to drive out of the cache what stays.
      const float* from = s_.edges + tensor::block_begin(std::size_t{next_ + i} * kSliceRows + lane());
      for (int c = 0; c < 9; ++c) block_[i][c] = next_ + i < end_ ? __ldcs(from + c * kSliceRows) : 0;
    }
  }

  const SceneView<float>& s_;
  const tensor::Patch& patch_;
  const std::uint32_t tile_rows_, own_, begin_;  // where the warp's first tile begins
  std::uint32_t first_;                          // where the tile at hand does
  std::uint32_t slice_, slices_;                 // of it
  std::uint32_t next_, end_;                     // columns of the slice
  std::uint32_t begin_of_, end_of_;              // the same of the lane's slice
  float block_[kAtOnce][9];
  std::uint32_t column_[kAtOnce], twice_[kAtOnce];
};

/// Vectors that streamed_solve keeps in shared memory, one bit each, in this order. Beside them tiles add up their q
/// there (kStreamedBytesPerCell a row): all of q where each warp has one tile.
enum StreamedVectors : std::uint32_t { kNearDirection = 1, kNearResidual = 2, kNearSolution = 4 };

/// Factors L⁻¹ and b̂ are in `diagonal` and `rhs` (solver::factorize).
template <unsigned Threads>
__global__ void __launch_bounds__(Threads, 1)
    streamed_solve(const __grid_constant__ SceneView<float> s, std::uint32_t near_vectors) {
  extern __shared__ float4 shared[];
  __shared__ PatchSums<Threads> sums;
  __shared__ typename PatchVolume<Threads>::Parts tetrahedra;
  const tensor::Patch patch = tensor::patch_of(s, blockIdx.x);
  const std::uint32_t own = patch.own(), locals = own + patch.halo_count;
  const std::uint32_t thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp;
  const std::uint32_t tile_rows = s.tile_rows != 0 ? s.tile_rows : tensor::kMostTileRows;

  constexpr std::uint32_t kWarps = Threads / kWarp;
  static_assert(kWarps == tensor::kTilesAtOnce);
  const std::uint32_t held_rows = minimum(own, kWarps * tile_rows);
  float4* const tile = shared + std::size_t{warp} * tile_rows;
  float* next = &shared[held_rows].x;
  const auto place = [&](StreamedVectors which, std::size_t bytes_per_row, std::uint32_t rows, float* otherwise) {
    if ((near_vectors & which) == 0) return otherwise;
    float* const begin = next;
    next += (bytes_per_row * rows + 15) / 16 * 4;
    return begin;
  };
  auto* const p = reinterpret_cast<float4*>(
      place(kNearDirection, kStreamedBytesPerCell, locals, s.direction + 4 * patch.local_begin));
  const Vectors r{place(kNearResidual, kStreamedBytesPerVector, locals, s.residual + 4 * patch.local_begin)};
  const Vectors x{place(kNearSolution, kStreamedBytesPerVector, own, s.solution + std::size_t{4} * patch.row_begin)};

  float residual_squared = 0;
  for (std::uint32_t i = thread; i < locals; i += Threads) {
    const Vec3<float> b = tensor::load3<float>(s.rhs, tensor::global_row(s, patch, i));
    p[i] = cell_of(b);
    r.set(i, b);
    if (i >= own) continue;
    x.set(i, Vec3<float>::Zero());
    residual_squared += b.dot(b);
  }
  __syncthreads();

  if (s.patch_tetrahedra != nullptr && thread == 0) tetrahedra = PatchVolume<Threads>::parts_of(s, patch);
  Exchange exchange(s, patch.index);
  solver::Recurrence<float> recurrence(s);
  for (std::uint32_t first = warp * tile_rows; first < own; first += kWarps * tile_rows) {
    scale_tile(s, patch, first, minimum(first + tile_rows, own));
  }
  TileWalk<kWarps> walk(s, patch, tile_rows);
  do {
    exchange.begin();
    // Without room for it, q is read back from the cells that this patch has just published.
    const auto* const q = held_rows == own ? shared : reinterpret_cast<const float4*>(exchange.rows(patch.row_begin));
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
      __syncwarp();  // the next tile is added up in the same place
    }
    sums.exchange(exchange, s.patch_count, own_sums);
    __syncthreads();
    const Exchange::Cell all = sums.total();
    if (!recurrence.take(all.x, all.y, all.z)) break;
    const float alpha = recurrence.alpha(), beta = recurrence.beta();
    residual_squared = 0;
    constexpr std::uint32_t kRowsAtOnce = 2;
    for (std::uint32_t begin = thread; begin < own; begin += kRowsAtOnce * Threads) {
      Vec3<float> direction[kRowsAtOnce], residual[kRowsAtOnce], product[kRowsAtOnce], solution[kRowsAtOnce];
#pragma unroll
      for (std::uint32_t i = 0; i < kRowsAtOnce; ++i) {
        // Beyond the end the thread's own first row again: others may be writing theirs.
        const std::uint32_t local = begin + i * Threads < own ? begin + i * Threads : begin;
        direction[i] = three_of(p[local]);
        residual[i] = r[local];
        product[i] = three_of(q[local]);
        solution[i] = x[local];
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kRowsAtOnce; ++i) {
        const std::uint32_t local = begin + i * Threads;
        if (local >= own) break;
        residual[i] -= product[i] * alpha;
        x.set(local, solution[i] + direction[i] * alpha);
        r.set(local, residual[i]);
        p[local] = cell_of(residual[i] + direction[i] * beta);
        residual_squared += residual[i].dot(residual[i]);
      }
    }
    constexpr int kAtOnce = 4;
    for (std::uint32_t h = thread; h < patch.halo_count; h += kAtOnce * Threads) {
      Exchange::Cell cells[kAtOnce];
      exchange.wait_for_rows(
          h, Threads, patch.halo_count, [&](int i) { return s.halo[patch.halo_begin + h + i * Threads]; }, cells);
      for (int i = 0; i < kAtOnce && h + i * Threads < patch.halo_count; ++i) {
        const std::uint32_t local = own + h + i * Threads;
        const Vec3<float> residual = r[local] - Vec3<float>(cells[i].x, cells[i].y, cells[i].z) * alpha;
        r.set(local, residual);
        p[local] = cell_of(residual + three_of(p[local]) * beta);
      }
    }
    __syncthreads();
  } while (recurrence.goes_on());

  if (thread == 0 && patch.index == 0) recurrence.report(s);
  // x is behind what the end has another use for.
  end_solve<Threads>(s, patch, tetrahedra, exchange, shared, [&](std::uint32_t row) -> Vec3<float> {
    return solver::unscaled(s, row, solver::load_lower<float>(s.diagonal, row), x[row - patch.row_begin]);
  });
}

}  // namespace tensormass::backend::cuda
