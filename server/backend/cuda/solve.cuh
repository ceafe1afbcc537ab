#pragma once

#include <bit>

#include <cuda_pipeline.h>

#include "backend/cuda/exchange.cuh"
#include "solver/advance.h"
#include "solver/conjugate_gradients.h"
#include "solver/jacobi_scaling.h"
#include "tensor/rows.h"

/// The solve of solver/conjugate_gradients.h for single precision, where a patch is a thread block for the whole
/// solve. What differs is where numbers are kept and how patches exchange them (exchange.cuh).
///
///   resident_solve   one or two rows a thread: matrix, vectors and direction stay in registers and shared memory
///   streamed_solve   more rows than threads: the matrix comes from memory in each iteration, vectors stay as near as
///                    they fit
namespace tensormass::backend::cuda {

using tensor::kSliceRows;
using tensor::SceneView;

/// The sums of all patches. Each warp leaves its own in shared memory; the last warp of the block adds them up,
/// publishes them, waits for those of all patches and adds those up, while the other warps wait for the halo. In a
/// fixed order, and so the same to the last bit in every patch.
template <unsigned Threads>
class PatchSums {
 public:
  /// By all threads.
  __device__ void exchange(const Exchange& exchange, std::uint32_t patches, Exchange::Cell own) {
    const unsigned lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
    own = Exchange::sum_lanes(own);
    if (lane == 0) warps_[warp] = own;
    __syncthreads();
    if (warp + 1 < kWarps) return;
    constexpr unsigned kLanes = std::bit_ceil(kWarps);
    const Exchange::Cell mine =
        Exchange::sum_lanes<kLanes>(lane % kLanes < kWarps ? warps_[lane % kLanes] : Exchange::Cell{0, 0, 0, 0});
    if (lane == 0) exchange.publish_sums(mine.x, mine.y, mine.z);
    Exchange::Cell sum{0, 0, 0, 0};
    constexpr std::uint32_t kAtOnce = 5;  // 160 patches: one a multiprocessor
    for (std::uint32_t first = lane; first < patches; first += kAtOnce * kWarp) {
      Exchange::Cell cells[kAtOnce];
      exchange.wait_for_sums(first, kWarp, patches, cells);
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        if (first + i * kWarp >= patches) break;
        sum.x += cells[i].x;
        sum.y += cells[i].y;
        sum.z += cells[i].z;
      }
    }
    __syncwarp();
    sum = Exchange::sum_lanes(sum);
    if (lane == 0) total_ = sum;
  }
  /// After a barrier.
  __device__ Exchange::Cell total() const { return total_; }

 private:
  static constexpr unsigned kWarps = Threads / kWarp;
  static_assert(kWarps <= kWarp);
  Exchange::Cell warps_[kWarps];
  Exchange::Cell total_;
};

/// Rows of a patch in resident_solve, at most.
inline constexpr std::uint32_t kMostResidentRows = 512;

/// Shared memory of resident_solve [bytes].
inline constexpr std::size_t kResidentBytesPerRow = 16 + 6 * 4;  // own or of the halo: direction, L⁻¹
inline constexpr std::size_t kResidentBytesPerHaloRow = 2 * 16;  // residual, product
inline constexpr std::size_t kResidentBytesPerColumn = kSliceRows * (9 * 4 + 2);

/// A thread has `Rows` rows, Threads apart. `Held`: blocks of a row in registers. column_capacity: columns of a slice's
/// further blocks that shared memory holds; what is left over is read from memory in each iteration.
template <unsigned Threads, int Rows, int Held>
__global__ void __launch_bounds__(Threads, 1)
    resident_solve(const __grid_constant__ SceneView<float> s, std::uint32_t column_capacity) {
  static_assert(Held % 2 == 0);
  extern __shared__ float4 shared[];
  __shared__ PatchSums<Threads> sums;
  const tensor::Patch patch = tensor::patch_of(s, blockIdx.x);
  const std::uint32_t own = patch.own(), locals = own + patch.halo_count;
  float4* const direction = shared;                                                  // [locals]
  float4* const halo_residual = direction + locals;                                  // [halo]
  float4* const halo_product = halo_residual + patch.halo_count;                     // [halo]
  float* const inverse = reinterpret_cast<float*>(halo_product + patch.halo_count);  // [6][locals]
  float* const blocks = inverse + tensor::round_to_four(6 * locals);                 // [column][9][kSliceRows]
  auto* const columns = reinterpret_cast<std::uint16_t*>(blocks + 9 * kSliceRows * column_capacity);

  const std::uint32_t thread = threadIdx.x, lane = thread % kWarp, warp = thread / kWarp;
  // The last warp waits for sums, the others for the halo.
  constexpr std::uint32_t kWarps = Threads / kWarp, kHaloThreads = Threads - kWarp;

  // Where the blocks of each row's slice are: from `first` on, `width` of them, of which shared memory has
  // `shared_width` behind those that are held [columns]. A lane for each slice of the patch, then what is the warp's.
  static_assert(kWarps * Rows <= kWarp && kSliceRows == kWarp);
  bool has_row[Rows];
  std::uint32_t row[Rows], first[Rows], width[Rows], shared_begin[Rows], shared_width[Rows];
  {
    const std::uint32_t slices = own / kSliceRows, slice = patch.row_begin / kSliceRows + minimum(lane, slices - 1);
    const std::uint32_t begin = s.slice_begin[slice], columns = s.slice_begin[slice + 1] - begin;
    const std::uint32_t further = lane < slices && columns > Held ? columns - Held : 0;
    std::uint32_t up_to = further;
    for (unsigned distance = 1; distance < kWarp; distance *= 2) {
      const std::uint32_t before = __shfl_up_sync(0xFFFFFFFFu, up_to, distance);
      if (lane >= distance) up_to += before;
    }
    const std::uint32_t place = minimum(up_to - further, column_capacity);
    for (int k = 0; k < Rows; ++k) {
      const std::uint32_t of = warp + k * kWarps;
      has_row[k] = of < slices;
      row[k] = patch.row_begin + (has_row[k] ? thread + k * Threads : 0);
      first[k] = __shfl_sync(0xFFFFFFFFu, begin, of);
      width[k] = __shfl_sync(0xFFFFFFFFu, lane < slices ? columns : 0, of);
      shared_begin[k] = __shfl_sync(0xFFFFFFFFu, place, of);
      shared_width[k] = minimum(width[k] > Held ? width[k] - Held : 0, column_capacity - shared_begin[k]);
    }
  }

  // The matrix is on its way while the factors are computed. Beyond the width blocks are zero.
  const auto slot_of = [&first, lane](int k, std::uint32_t j) {
    return (std::size_t{first[k]} + j) * kSliceRows + lane;
  };
  // Of a column in shared memory each row has two float4 and a float.
  constexpr std::uint32_t kColumnReals = 9 * kSliceRows;
  const auto place_of = [lane](std::uint32_t c) {
    return c / 4 * (4 * kSliceRows) + (c < 8 ? 4 * lane + c % 4 : lane);
  };
  float held[Rows][Held][9];
  std::uint32_t held_column[Rows][Held];
#pragma unroll
  for (int k = 0; k < Rows; ++k) {
    for (std::uint32_t j = 0; j < shared_width[k]; ++j) {
      const float* from = s.edges + tensor::block_begin(slot_of(k, Held + j));
      float* const to = blocks + (shared_begin[k] + j) * kColumnReals;
      for (int c = 0; c < 9; ++c) __pipeline_memcpy_async(to + place_of(c), from + c * kSliceRows, sizeof(float));
    }
#pragma unroll
    for (int j = 0; j < Held; ++j) {
      held_column[k][j] = j < width[k] ? s.columns[slot_of(k, j)] : 0;
      const float* block = s.edges + tensor::block_begin(slot_of(k, j));
      for (int c = 0; c < 9; ++c) held[k][j][c] = j < width[k] ? block[c * kSliceRows] : 0;
    }
  }
  __pipeline_commit();

  // b̂ and L⁻¹ of own rows and of the halo
  struct Row {
    std::uint32_t free_bits;
    float diagonal[6], weight;
    Vec3<float> rhs;
  };
  constexpr std::uint32_t kRowsAtOnce = 3;
  tensor::each_column<kRowsAtOnce>(
      thread, locals, Threads,
      [&](std::uint32_t i) {
        const std::uint32_t global = tensor::global_row(s, patch, i);
        Row row;
        row.free_bits = tensor::free_bits(s, global);
        for (int c = 0; c < 6; ++c) row.diagonal[c] = s.diagonal[std::size_t{8} * global + c];
        row.rhs = tensor::load3<float>(s.rhs, global);
        row.weight = solver::body_weight(s, global);
        return row;
      },
      [&](std::uint32_t i, const Row& row) {
        float factor[6];
        solver::inverse_factor(row.diagonal, row.free_bits, factor);
        for (int c = 0; c < 6; ++c) inverse[c * locals + i] = factor[c];
        const Vec3<float> b = solver::lower(factor) * row.rhs * row.weight;
        direction[i] = {b[0], b[1], b[2], 0};
        if (i >= own) halo_residual[i - own] = direction[i];
      });
  __pipeline_wait_prior(0);
  __syncthreads();
  const auto read_inverse = [&](std::uint32_t local, float(&factor)[6]) {
    for (int c = 0; c < 6; ++c) factor[c] = inverse[c * locals + local];
  };

  std::uint32_t held_columns[Rows][Held / 2];  // two 16-bit offsets into direction [bytes]
#pragma unroll
  for (int k = 0; k < Rows; ++k) {
    float own_inverse[6];
    read_inverse(has_row[k] ? thread + k * Threads : 0, own_inverse);
    const auto scale = [&](float(&block)[9], std::uint32_t column) {
      float other[6];
      read_inverse(column, other);
      solver::scale_block(own_inverse, block, other);
    };
#pragma unroll
    for (int j = 0; j < Held; ++j) {
      scale(held[k][j], held_column[k][j]);
      held_columns[k][j / 2] = (j % 2 == 0 ? 0 : held_columns[k][j / 2]) | (held_column[k][j] * 16) << (16 * (j % 2));
    }
#pragma unroll 2
    for (std::uint32_t j = 0; j < shared_width[k]; ++j) {
      const std::uint32_t column = s.columns[slot_of(k, Held + j)], place = shared_begin[k] + j;
      float* const at = blocks + place * kColumnReals;
      float block[9];
      for (int c = 0; c < 9; ++c) block[c] = at[place_of(c)];
      scale(block, column);
      for (int c = 0; c < 9; ++c) at[place_of(c)] = block[c];
      columns[place * kSliceRows + lane] = static_cast<std::uint16_t>(column * 16);
    }
    for (std::uint32_t j = Held + shared_width[k]; j < width[k]; ++j) {
      float* const from = s.edges + tensor::block_begin(slot_of(k, j));
      float block[9];
      for (int c = 0; c < 9; ++c) block[c] = from[c * kSliceRows];
      scale(block, s.columns[slot_of(k, j)]);
      for (int c = 0; c < 9; ++c) from[c * kSliceRows] = block[c];
    }
  }

  Vec3<float> p[Rows], r[Rows], x[Rows], q[Rows];
  for (int k = 0; k < Rows; ++k) {
    const float4 start = has_row[k] ? direction[thread + k * Threads] : float4{};
    p[k] = r[k] = Vec3<float>(start.x, start.y, start.z);
    x[k].setZero();
  }
  // Rows of the halo that this thread waits for; a patch seldom has more than two for each of its own.
  constexpr std::uint32_t kHaloAtOnce = 2 * Rows;
  std::uint32_t halo_rows[kHaloAtOnce];
  for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) {
    const std::uint32_t h = thread + i * kHaloThreads;
    halo_rows[i] = h < patch.halo_count ? s.halo[patch.halo_begin + h] : 0;
  }
  Exchange exchange(s, patch.index);
  solver::Recurrence<float> recurrence(s);
  do {
    exchange.begin();
    Exchange::Cell own_sums{0, 0, 0, 0};
#pragma unroll
    for (int k = 0; k < Rows; ++k) {
      q[k] = p[k];
      const auto add = [&](const float* block, std::uint32_t stride, std::uint32_t offset) {
        const float4 v = *reinterpret_cast<const float4*>(reinterpret_cast<const char*>(direction) + offset);
        for (int i = 0; i < 3; ++i) {
          q[k][i] +=
              block[(3 * i) * stride] * v.x + block[(3 * i + 1) * stride] * v.y + block[(3 * i + 2) * stride] * v.z;
        }
      };
      // By fours without a branch between, so that reads are under way together; what is beyond the width is zero.
#pragma unroll
      for (int j = 0; j < Held; j += 4) {
        if (j >= width[k]) break;
#pragma unroll
        for (int i = j; i < j + 4 && i < Held; ++i) {
          add(held[k][i], 1, held_columns[k][i / 2] >> (16 * (i % 2)) & 0xFFFF);
        }
      }
#pragma unroll 2
      for (std::uint32_t j = 0; j < shared_width[k]; ++j) {
        const std::uint32_t place = shared_begin[k] + j;
        const float* from = blocks + place * kColumnReals;
        const float4 a = reinterpret_cast<const float4*>(from)[lane],
                     b = reinterpret_cast<const float4*>(from)[kSliceRows + lane];
        const float block[9] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, from[8 * kSliceRows + lane]};
        add(block, 1, columns[place * kSliceRows + lane]);
      }
      for (std::uint32_t j = Held + shared_width[k]; j < width[k]; ++j) {
        const std::size_t slot = slot_of(k, j);
        add(s.edges + tensor::block_begin(slot), kSliceRows, s.columns[slot] * 16);
      }
      if (has_row[k]) exchange.publish_row(row[k], q[k][0], q[k][1], q[k][2]);
      own_sums.x += p[k].dot(q[k]);
      own_sums.y += q[k].dot(q[k]);
      own_sums.z += r[k].dot(r[k]);
    }
    sums.exchange(exchange, s.patch_count, own_sums);
    if (thread < kHaloThreads) {
      for (std::uint32_t h = thread; h < patch.halo_count; h += kHaloAtOnce * kHaloThreads) {
        Exchange::Cell cells[kHaloAtOnce];
        exchange.wait_for_rows(
            h, kHaloThreads, patch.halo_count,
            [&](int i) { return h == thread ? halo_rows[i] : s.halo[patch.halo_begin + h + i * kHaloThreads]; }, cells);
        for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) {
          const std::uint32_t place = h + i * kHaloThreads;
          if (place < patch.halo_count) halo_product[place] = {cells[i].x, cells[i].y, cells[i].z, 0};
        }
      }
    }
    __syncthreads();
    const Exchange::Cell all = sums.total();
    if (!recurrence.take(all.x, all.y, all.z)) break;
    const float alpha = recurrence.alpha(), beta = recurrence.beta();
#pragma unroll
    for (int k = 0; k < Rows; ++k) {
      x[k] += p[k] * alpha;
      r[k] -= q[k] * alpha;
      p[k] = r[k] + p[k] * beta;
      if (has_row[k]) direction[thread + k * Threads] = {p[k][0], p[k][1], p[k][2], 0};
    }
    // Two at a time, so that they do not wait for each other's reads.
    constexpr std::uint32_t kUpdatesAtOnce = 2;
    for (std::uint32_t h = thread; h < patch.halo_count; h += kUpdatesAtOnce * Threads) {
      float4 hq[kUpdatesAtOnce], hr[kUpdatesAtOnce], hp[kUpdatesAtOnce];
#pragma unroll
      for (std::uint32_t i = 0; i < kUpdatesAtOnce; ++i) {
        const std::uint32_t place = h + i * Threads < patch.halo_count ? h + i * Threads : h;
        hq[i] = halo_product[place];
        hr[i] = halo_residual[place];
        hp[i] = direction[own + place];
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kUpdatesAtOnce; ++i) {
        const std::uint32_t place = h + i * Threads;
        if (place >= patch.halo_count) break;
        hr[i].x -= alpha * hq[i].x;
        hr[i].y -= alpha * hq[i].y;
        hr[i].z -= alpha * hq[i].z;
        halo_residual[place] = hr[i];
        direction[own + place] = {hr[i].x + beta * hp[i].x, hr[i].y + beta * hp[i].y, hr[i].z + beta * hp[i].z, 0};
      }
    }
    __syncthreads();
  } while (recurrence.goes_on());

  if (thread == 0) {
    exchange.remember();
    if (patch.index == 0) recurrence.report(s);
  }
  Vec3<float> change[Rows];
  for (int k = 0; k < Rows; ++k) {
    float factor[6];
    read_inverse(has_row[k] ? thread + k * Threads : 0, factor);
    change[k] = solver::unscaled(s, row[k], solver::lower(factor), x[k]);
  }
  solver::advance_by(Team(), s, [&](std::uint32_t moved) -> Vec3<float> {
    Vec3<float> of = change[0];
    for (int k = 1; k < Rows; ++k) of = moved == row[k] ? change[k] : of;
    return of;
  });
}

/// A patch's vectors, in shared memory or in the scene's buffers, `stride` floats a row.
struct Vectors {
  float* data;
  std::uint32_t stride;
  __device__ Vec3<float> operator[](std::uint32_t local) const {
    const float* v = data + std::size_t{local} * stride;
    return {v[0], v[1], v[2]};
  }
  __device__ void set(std::uint32_t local, const Vec3<float>& value) const {
    float* v = data + std::size_t{local} * stride;
    v[0] = value[0];
    v[1] = value[1];
    v[2] = value[2];
  }
};

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
#pragma unroll 2
    for (std::uint32_t j = columns.begin; j < columns.end; ++j) {
      const std::size_t slot = std::size_t{j} * kSliceRows + row % kSliceRows;
      const auto other = solver::load_lower<float>(s.diagonal, tensor::global_row(s, patch, s.columns[slot]));
      const Mat3<float> block = own * tensor::load_block<float>(s.edges, slot) * other.transpose();
      tensor::store_block<float>(s.edges, slot, block);
    }
  }
}

/// q = Â p on a tile's rows, all of it: what other tiles' rows have to do with them is read here (tensor/tiles.h). By
/// its warp. p: of the patch; q: of the tile, in shared memory; four floats a row.
__device__ inline void multiply_tile(const SceneView<float>& s, const tensor::Patch& patch, std::uint32_t first,
                                     std::uint32_t last, const float4* p, float4* q) {
  constexpr std::uint32_t kAtOnce = 5;  // two rounds for most rows
  const unsigned lane = threadIdx.x % kWarp;
  for (std::uint32_t local = first + lane; local < last; local += kWarp) q[local - first] = p[local];  // unit diagonal
  __syncwarp();
#pragma unroll 1
  for (std::uint32_t local = first + lane; local < last; local += kWarp) {
    const ReadColumns columns(s, (patch.row_begin + local) / kSliceRows);
    const float4 own = p[local];
    Vec3<float> sum = Vec3<float>::Zero();
#pragma unroll 1
    for (std::uint32_t begin = columns.begin; begin < columns.end; begin += kAtOnce) {
      float block[kAtOnce][9];
      std::uint32_t column[kAtOnce], twice[kAtOnce];
      // Reads are under way together.
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        const std::uint32_t j = begin + i;
        column[i] = j < columns.end ? s.columns[std::size_t{j} * kSliceRows + lane] : 0;
        twice[i] = j < columns.end && s.used_twice != nullptr ? s.used_twice[j] : 0;
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        // The matrix passes by in every iteration: it is not to drive out of the cache what stays.
        const float* from = s.edges + tensor::block_begin(std::size_t{begin + i} * kSliceRows + lane);
        for (int c = 0; c < 9; ++c) block[i][c] = begin + i < columns.end ? __ldcs(from + c * kSliceRows) : 0;
      }
      float4 direction[kAtOnce];
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) direction[i] = p[column[i]];
#pragma unroll
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        const float* a = block[i];
        const float4 v = direction[i];
        for (int c = 0; c < 3; ++c) sum[c] += a[3 * c] * v.x + a[3 * c + 1] * v.y + a[3 * c + 2] * v.z;
        if ((twice[i] >> lane & 1) != 0) {
          float4& other = q[column[i] - first];
          const float4 before = other;
          other = {before.x + a[0] * own.x + a[3] * own.y + a[6] * own.z,
                   before.y + a[1] * own.x + a[4] * own.y + a[7] * own.z,
                   before.z + a[2] * own.x + a[5] * own.y + a[8] * own.z, 0};
        }
        __syncwarp();  // the next column adds to the same rows
      }
    }
    float4& mine = q[local - first];
    const float4 before = mine;
    mine = {before.x + sum[0], before.y + sum[1], before.z + sum[2], 0};
    __syncwarp();
  }
}

/// Vectors that streamed_solve keeps in shared memory, one bit each, in this order. Beside them tiles add up their q
/// there (kStreamedBytesPerCell a row): all of q where each warp has one tile.
enum StreamedVectors : std::uint32_t { kNearDirection = 1, kNearResidual = 2, kNearSolution = 4 };

/// Factors L⁻¹ and b̂ are in `diagonal` and `rhs` (solver::factorize).
template <unsigned Threads>
__global__ void __launch_bounds__(Threads, 1)
    streamed_solve(const __grid_constant__ SceneView<float> s, std::uint32_t near_vectors) {
  extern __shared__ float4 shared[];
  __shared__ PatchSums<Threads> sums;
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
    if ((near_vectors & which) == 0) return Vectors{otherwise, 4};
    float* const begin = next;
    next += (bytes_per_row * rows + 15) / 16 * 4;
    return Vectors{begin, static_cast<std::uint32_t>(bytes_per_row / 4)};
  };
  const Vectors p = place(kNearDirection, kStreamedBytesPerCell, locals, s.direction + 4 * patch.local_begin);
  const Vectors r = place(kNearResidual, kStreamedBytesPerVector, locals, s.residual + 4 * patch.local_begin);
  const Vectors x = place(kNearSolution, kStreamedBytesPerVector, own, s.solution + std::size_t{4} * patch.row_begin);

  for (std::uint32_t i = thread; i < locals; i += Threads) {
    const Vec3<float> b = tensor::load3<float>(s.rhs, tensor::global_row(s, patch, i));
    p.set(i, b);
    r.set(i, b);
    if (i < own) x.set(i, Vec3<float>::Zero());
  }
  __syncthreads();

  Exchange exchange(s, patch.index);
  solver::Recurrence<float> recurrence(s);
  for (std::uint32_t first = warp * tile_rows; first < own; first += kWarps * tile_rows) {
    scale_tile(s, patch, first, minimum(first + tile_rows, own));
  }
  do {
    exchange.begin();
    // Without room for it, q is read back from the cells that this patch has just published.
    const Vectors q = held_rows == own ? Vectors{&shared->x, 4} : Vectors{exchange.rows(patch.row_begin), 4};
    Exchange::Cell own_sums{0, 0, 0, 0};
    for (std::uint32_t first = warp * tile_rows; first < own; first += kWarps * tile_rows) {
      const std::uint32_t last = minimum(first + tile_rows, own);
      multiply_tile(s, patch, first, last, reinterpret_cast<const float4*>(p.data), tile);
      for (std::uint32_t local = first + lane; local < last; local += kWarp) {
        const float4 sum = tile[local - first];
        const Vec3<float> product(sum.x, sum.y, sum.z), residual = r[local];
        exchange.publish_row(patch.row_begin + local, product[0], product[1], product[2]);
        own_sums.x += p[local].dot(product);
        own_sums.y += product.dot(product);
        own_sums.z += residual.dot(residual);
      }
      __syncwarp();  // the next tile is added up in the same place
    }
    sums.exchange(exchange, s.patch_count, own_sums);
    __syncthreads();
    const Exchange::Cell all = sums.total();
    if (!recurrence.take(all.x, all.y, all.z)) break;
    const float alpha = recurrence.alpha(), beta = recurrence.beta();
    constexpr std::uint32_t kRowsAtOnce = 4;
    for (std::uint32_t begin = thread; begin < own; begin += kRowsAtOnce * Threads) {
      Vec3<float> direction[kRowsAtOnce], residual[kRowsAtOnce], product[kRowsAtOnce], solution[kRowsAtOnce];
#pragma unroll
      for (std::uint32_t i = 0; i < kRowsAtOnce; ++i) {
        // Beyond the end the thread's own first row again: others may be writing theirs.
        const std::uint32_t local = begin + i * Threads < own ? begin + i * Threads : begin;
        direction[i] = p[local];
        residual[i] = r[local];
        product[i] = q[local];
        solution[i] = x[local];
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kRowsAtOnce; ++i) {
        const std::uint32_t local = begin + i * Threads;
        if (local >= own) break;
        residual[i] -= product[i] * alpha;
        x.set(local, solution[i] + direction[i] * alpha);
        r.set(local, residual[i]);
        p.set(local, residual[i] + direction[i] * beta);
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
        p.set(local, residual + p[local] * beta);
      }
    }
    __syncthreads();
  } while (recurrence.goes_on());

  if (thread == 0) {
    exchange.remember();
    if (patch.index == 0) recurrence.report(s);
  }
  solver::advance_by(Team(), s, [&](std::uint32_t row) -> Vec3<float> {
    return solver::unscaled(s, row, solver::load_lower<float>(s.diagonal, row), x[row - patch.row_begin]);
  });
}

}  // namespace tensormass::backend::cuda
