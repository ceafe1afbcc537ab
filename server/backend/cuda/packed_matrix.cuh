#pragma once

#include <cuda_fp16.h>

#include "backend/cuda/exchange.cuh"
#include "backend/cuda/packed_column.h"
#include "backend/cuda/team.cuh"
#include "matrix/packed_block.h"
#include "matrix/tiles.h"
#include "solver/jacobi_scaling.h"

/// The packed matrix that streamed_solve.cuh reads from memory in each iteration, and the order in which a warp reads
/// it.
///
///   Â            scaled matrix (solver/jacobi_scaling.h);  p, q   vectors of the solve, q = Â p
///   tile         neighbouring rows of a patch that one warp multiplies (matrix/tiles.h); several slices
///   column       32 blocks of a slice, one for each of its rows and so for each lane
///   serves both  the block also serves the row that it names: transposed, as A_jiᵀ = A_ij
///   loss         rounding error of a packed block, exact minus packed (matrix/packed_block.h)
///
/// packed_column.h says where a column and its parts are, and in which order a warp walks its slices.
///
/// 1. Each iteration waits mostly for these reads. Packing them makes an iteration faster, and so does reading a block
///    once for two rows.
/// 2. scale_tile replaces A by packed Â in place, before the first iteration.
/// 3. TileWalk reads ahead: the next columns are under way while the warp multiplies, also while patches exchange.
namespace tensormass::backend::cuda {

using view::kSliceRows;
using view::SceneView;

/// Sum of the losses of a row's blocks, in half precision: as many digits as PackedDiagonal keeps. kUnit scales it to
/// the middle of the range of halves.
struct RowLoss {
  __half2 sums[3];
  __half2 unused;

  static constexpr float kUnit = 0x1p20f;
  __device__ static RowLoss none() { return {}; }
  __device__ void add(const matrix::UpperTriangle& lost) {
    sums[0] = __hadd2(sums[0], __floats2half2_rn(lost.xx * kUnit, lost.xy * kUnit));
    sums[1] = __hadd2(sums[1], __floats2half2_rn(lost.xz * kUnit, lost.yy * kUnit));
    sums[2] = __hadd2(sums[2], __floats2half2_rn(lost.yz * kUnit, lost.zz * kUnit));
  }
  __device__ matrix::UpperTriangle sum() const {
    const float2 a = __half22float2(sums[0]), b = __half22float2(sums[1]), c = __half22float2(sums[2]);
    constexpr float kFactor = 1 / kUnit;
    return {a.x * kFactor, a.y * kFactor, b.x * kFactor, b.y * kFactor, c.x * kFactor, c.y * kFactor};
  }
};
static_assert(sizeof(RowLoss) == sizeof(float4));

/// Replaces A by packed Â in the columns of a tile that a solve reads. The tile's warp must call it.
/// losses: one for each row of the tile, in shared memory.
template <class Word>
__device__ void scale_tile(const SceneView<float>& s, const view::Patch& patch, std::uint32_t first, std::uint32_t last,
                           RowLoss* losses) {
  const std::uint32_t lane = threadIdx.x % kWarp;
  for (std::uint32_t local = first + lane; local < last; local += kWarp) losses[local - first] = RowLoss::none();
  __syncwarp();
#pragma unroll 1
  for (std::uint32_t local = first + lane; local < last; local += kWarp) {
    const std::uint32_t row = patch.row_begin + local;
    const ReadColumns columns(s.matrix, row / kSliceRows);
    const Mat3<float> own = solver::load_lower<float>(s.matrix.diagonal, row);
    matrix::UpperTriangle lost_here;
    // Some at once, because each waits for memory twice.
    constexpr std::uint32_t kAtOnce = 3;
#pragma unroll 1
    for (std::uint32_t begin = columns.begin; begin < columns.end; begin += kAtOnce) {
      std::uint32_t other[kAtOnce], twice[kAtOnce];
      Mat3<float> block[kAtOnce], factor[kAtOnce];
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        const std::uint32_t column = minimum(begin + i, columns.end - 1);
        const std::size_t slot = std::size_t{column} * kSliceRows + lane;
        other[i] = s.matrix.columns[slot];
        twice[i] = s.matrix.used_twice != nullptr ? s.matrix.used_twice[column] >> lane & 1 : 0;
        block[i] = view::load_block<float>(s.matrix.edges, slot);
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        factor[i] = solver::load_lower<float>(s.matrix.diagonal, view::global_row(s.patches, patch, other[i]));
      }
      __syncwarp();  // each lane has read what others write over
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        if (begin + i >= columns.end) break;
        const Mat3<float> scaled = own * block[i] * factor[i].transpose();
        float numbers[9], unpacked[9];
        for (int c = 0; c < 9; ++c) numbers[c] = scaled(c / 3, c % 3);
        const auto packed = matrix::PackedBlock::of(numbers);
        const PackedColumn<Word, uint2> to(s.matrix.edges, begin + i);
        for (int pair = 0; pair < 3; ++pair) {
          *to.pair(pair, lane) = {packed.words[2 * pair], packed.words[2 * pair + 1]};
        }
        *to.neighbour(lane) = Neighbour<Word>::of(other[i], twice[i] != 0);
        packed.unpack(unpacked);
        const matrix::UpperTriangle lost = matrix::lost(numbers, unpacked);
        lost_here += lost;
        if (twice[i] != 0) losses[other[i] - first].add(lost);
        __syncwarp();  // the next column adds to the same rows
      }
    }
    losses[local - first].add(lost_here);
    __syncwarp();
  }
  for (std::uint32_t local = first + lane; local < last; local += kWarp) {
    const std::uint32_t slice = (patch.row_begin + local) / kSliceRows;
    if (s.matrix.slice_begin[slice] == s.matrix.slice_begin[slice + 1]) continue;  // rows without neighbours
    const auto packed = matrix::PackedDiagonal::of(losses[local - first].sum());
    *PackedColumn<Word, uint2>(s.matrix.edges, s.matrix.slice_begin[slice]).diagonal(lane) = {packed.words[0],
                                                                                              packed.words[1]};
  }
  __syncwarp();
}

/// A warp's order of reading its tiles, over and over. The columns that it multiplies next are always on their way from
/// memory.
template <unsigned Warps, class Word>
class TileWalk {
 public:
  /// A warp without a tile must not call multiply().
  __device__ TileWalk(const SceneView<float>& s, const view::Patch& patch, std::uint32_t tile_rows)
      : s_(s), patch_(patch), steps_(tile_rows, patch.own(), threadIdx.x / kWarp) {
    if (!steps_.has_tile()) return;
    begin_tile(steps_.begin);
    load();
  }

  /// Computes q = Â p on the rows of the current tile and continues with the warp's next tile. The tile's columns hold
  /// every block of these rows, also those that couple them to other tiles.
  /// p: of the patch, four floats a row.
  /// q: of the tile, in shared memory, four floats a row; overwritten.
  __device__ void multiply(const float4* p, float4* q) {
    const std::uint32_t first = steps_.first, last = steps_.last();
    for (std::uint32_t local = first + lane(); local < last; local += kWarp)
      q[local - first] = p[local];  // unit diagonal
    __syncwarp();
#pragma unroll 1
    for (std::uint32_t local = first + lane(); local < last; local += kWarp) {
      const float4 own = p[local];
      Vec3<float> sum = diagonal_.unpacked() * three_of(own);
      bool ends = false;
#pragma unroll 1
      do {
        float4 direction[kAtOnce];
#pragma unroll
        for (std::uint32_t i = 0; i < kAtOnce; ++i) direction[i] = p[Neighbour<Word>::local(neighbour_[i])];
#pragma unroll
        for (std::uint32_t i = 0; i < kAtOnce; ++i) {
          float a[9];
          block_[i].unpack(a);
          const float4 v = direction[i];
          for (int c = 0; c < 3; ++c) sum[c] += a[3 * c] * v.x + a[3 * c + 1] * v.y + a[3 * c + 2] * v.z;
          if (Neighbour<Word>::serves_both(neighbour_[i])) {
            float4& other = q[Neighbour<Word>::local(neighbour_[i]) - first];
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
  /// Starts a tile. Each lane reads the columns of one of its slices.
  __device__ void begin_tile(std::uint32_t first) {
    steps_.begin_tile(first);
    const std::uint32_t slice = (patch_.row_begin + first) / kSliceRows + minimum(lane(), steps_.slices - 1);
    const ReadColumns columns(s_.matrix, slice);
    begin_of_ = columns.begin;
    end_of_ = columns.end;
    begin_slice();
  }
  __device__ void begin_slice() {
    next_ = __shfl_sync(0xFFFFFFFFu, begin_of_, steps_.slice);
    end_ = __shfl_sync(0xFFFFFFFFu, end_of_, steps_.slice);
    // Slices without columns have no PackedDiagonals.
    const uint2 words =
        next_ < end_ ? __ldcs(PackedColumn<Word, uint2>(s_.matrix.edges, next_).diagonal(lane())) : uint2{0, 0};
    diagonal_.words[0] = words.x;
    diagonal_.words[1] = words.y;
  }
  __device__ void next_slice() {
    steps_.next([this] { begin_slice(); }, [this](std::uint32_t first) { begin_tile(first); });
  }
  /// Starts the next reads, all together.
  __device__ void load() {
#pragma unroll
    for (std::uint32_t i = 0; i < kAtOnce; ++i) {
      // The matrix is read once an iteration, so __ldcs marks it as the first to evict: the cache is for other data.
      const bool more = next_ + i < end_;
      const PackedColumn<Word, uint2> from(s_.matrix.edges, next_ + i);
      neighbour_[i] = more ? __ldcs(from.neighbour(lane())) : Word(0);
      for (int pair = 0; pair < 3; ++pair) {
        constexpr uint2 kZero{matrix::PackedBlock::kZeroWords[0], matrix::PackedBlock::kZeroWords[1]};
        const uint2 words = more ? __ldcs(from.pair(pair, lane())) : kZero;
        block_[i].words[2 * pair] = words.x;
        block_[i].words[2 * pair + 1] = words.y;
      }
    }
  }

  const SceneView<float>& s_;
  const view::Patch& patch_;
  TileSteps<Warps> steps_;
  std::uint32_t next_, end_;         // next column to read, and end of the slice's columns
  std::uint32_t begin_of_, end_of_;  // columns of the slice that this lane has read
  matrix::PackedDiagonal diagonal_;  // the diagonal of the lane's row in the slice
  matrix::PackedBlock block_[kAtOnce];
  Word neighbour_[kAtOnce];
};

}  // namespace tensormass::backend::cuda
