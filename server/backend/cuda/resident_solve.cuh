#pragma once

#include <cuda_pipeline.h>

#include "backend/cuda/link_blocks.cuh"
#include "backend/cuda/patch_sums.cuh"
#include "backend/cuda/patch_volume.cuh"
#include "backend/cuda/resident_memory.h"
#include "core/strided.h"
#include "solver/conjugate_gradients.h"
#include "solver/jacobi_scaling.h"
#include "solver/time_scheme.h"
#include "solver/vector_updates.h"

/// The solve of solver/conjugate_gradients.h in single precision, for patches that fit on the chip. A thread block runs
/// one patch for the whole solve, with one or two rows a thread. Symbols (Â, b̂, x, r, p, q, α, β, L⁻¹):
/// conjugate_gradients.h and jacobi_scaling.h.
///
///   where the data of a patch are:
///     registers       x, r, p, q of own rows; the first Held blocks of each row
///     shared memory   direction (p, own and halo), r and q of the halo, L⁻¹, further blocks, as many as fit
///     device memory   the blocks that remain (Whole = false); those of links, and rows that only links name (Linked)
///
///   factorize, scale ──> q = Â p ──> exchange q and sums ──> update x, r, p ──┬──> end_solve: move rows, check volume
///                          ^                                                  │
///                          └──────────────────────────────────────────────────┘
///
/// 1. In an iteration only q of the patch's rows and three sums leave the chip (exchange.cuh).
/// 2. The last warp waits for the sums, the others for the halo.
/// 3. Reads run ahead of their use throughout, because one block a multiprocessor has few warps to hide latency.
///
/// streamed_solve.cuh serves larger patches.
namespace tensormass::backend::cuda {

using view::kSliceRows;
using view::SceneView;

/// Hides from the compiler how a value was computed. To save a register, it would otherwise compute the value again in
/// each iteration.
__device__ inline std::uint32_t computed_once(std::uint32_t value) {
  asm volatile("" : "+r"(value));
  return value;
}

/// Solves the system of a patch and moves its rows.
/// Rows: rows of a thread, Threads apart.
/// Held: blocks of a row in registers.
/// column_capacity: columns of further blocks that shared memory holds.
/// Whole: shared memory holds all further blocks. Otherwise the remaining ones are read from memory in each iteration.
/// Linked: the scene has links (link_blocks.cuh). Otherwise `room` is empty.
template <unsigned Threads, int Rows, int Held, bool Whole, bool Linked>
__global__ void __launch_bounds__(Threads, 1)
    resident_solve(const __grid_constant__ SceneView<float> s, std::uint32_t column_capacity,
                   [[maybe_unused]] const LinkRoom room) {
  static_assert(Held % 2 == 0);
  extern __shared__ float4 shared[];
  __shared__ PatchSums<Threads> sums;
  __shared__ typename PatchVolume<Threads>::Parts tetrahedra;
  __shared__ PatchLinks links;
  const view::Patch patch = view::patch_of(s.patches, blockIdx.x);
  const std::uint32_t own = patch.own(), locals = own + patch.halo_count;
  float4* const direction = shared;                                        // [locals]
  float4* const halo_residual = direction + locals;                        // [halo]
  float4* const halo_product = halo_residual + patch.halo_count;           // [halo]
  float4* const inverse = halo_product + patch.halo_count;                 // [locals] four reals of L⁻¹
  auto* const inverse_rest = reinterpret_cast<float2*>(inverse + locals);  // [locals] the other two
  float* const blocks =
      reinterpret_cast<float*>(inverse_rest) + view::round_to_four(2 * locals);  // [column][9][kSliceRows]
  auto* const columns = reinterpret_cast<std::uint16_t*>(blocks + 9 * kSliceRows * column_capacity);

  const std::uint32_t thread = computed_once(threadIdx.x), lane = thread % kWarp, warp = thread / kWarp;
  // The last warp waits for sums, the others for the halo.
  constexpr std::uint32_t kWarps = Threads / kWarp, kHaloThreads = Threads - kWarp;

  // Places of the blocks of each row's slice [columns]. In the matrix they start at `first` and are `width` columns.
  // The first Held are in registers. Shared memory holds the next `shared_width`, from `shared_begin` on. Each lane
  // computes this for one slice of the patch; then each warp takes the values of its own slices.
  static_assert(kWarps * Rows <= kWarp && kSliceRows == kWarp);
  bool has_row[Rows];
  std::uint32_t row[Rows], first[Rows], width[Rows], shared_begin[Rows], shared_width[Rows];
  {
    const std::uint32_t slices = own / kSliceRows, slice = patch.row_begin / kSliceRows + minimum(lane, slices - 1);
    const std::uint32_t begin = s.matrix.slice_begin[slice], columns = s.matrix.slice_begin[slice + 1] - begin;
    const std::uint32_t further = lane < slices && columns > Held ? columns - Held : 0;
    std::uint32_t in_shared = further;
    if constexpr (!Whole) {
      in_shared = shared_width_of(further, least_left(column_capacity, [further](std::uint32_t left) {
                                    return __reduce_add_sync(0xFFFFFFFFu, shared_width_of(further, left));
                                  }));
    }
    std::uint32_t up_to = in_shared;
    for (unsigned distance = 1; distance < kWarp; distance *= 2) {
      const std::uint32_t before = __shfl_up_sync(0xFFFFFFFFu, up_to, distance);
      if (lane >= distance) up_to += before;
    }
    const std::uint32_t place = up_to - in_shared;
    for (int k = 0; k < Rows; ++k) {
      const std::uint32_t of = warp + k * kWarps;
      has_row[k] = of < slices;
      row[k] = patch.row_begin + (has_row[k] ? thread + k * Threads : 0);
      first[k] = __shfl_sync(0xFFFFFFFFu, begin, of);
      width[k] = __shfl_sync(0xFFFFFFFFu, lane < slices ? columns : 0, of);
      shared_begin[k] = computed_once(__shfl_sync(0xFFFFFFFFu, place, of));
      shared_width[k] = computed_once(__shfl_sync(0xFFFFFFFFu, in_shared, of));
    }
  }

  // In shared memory, each row of a column has two float4 and a float (shared_component).
  const auto slot_of = [&first, lane](int k, std::uint32_t j) {
    return (std::size_t{first[k]} + j) * kSliceRows + lane;
  };
  const auto read_shared = [blocks, lane](std::uint32_t place, float(&block)[9]) {
    const float* const from = blocks + place * kSharedColumnReals;
    const float4 a = reinterpret_cast<const float4*>(from)[lane],
                 b = reinterpret_cast<const float4*>(from)[kSliceRows + lane];
    block[0] = a.x, block[1] = a.y, block[2] = a.z, block[3] = a.w;
    block[4] = b.x, block[5] = b.y, block[6] = b.z, block[7] = b.w;
    block[8] = from[8 * kSliceRows + lane];
  };

  // Computes b̂ and L⁻¹ of own rows and of the halo, while shared memory's part of the matrix is on its way.
  struct Row {
    std::uint32_t free_bits;
    float diagonal[6], weight;
    Vec3<float> rhs;
  };
  const auto read_row = [&](std::uint32_t local) {
    const std::uint32_t global = view::global_row(s.patches, patch, local);
    const auto* diagonal = reinterpret_cast<const float4*>(s.matrix.diagonal + std::size_t{8} * global);
    const float4 a = diagonal[0], b = diagonal[1];
    return Row{view::free_bits(s.state, global),
               {a.x, a.y, a.z, a.w, b.x, b.y},
               solver::body_weight(s.state, global),
               view::load3<float>(s.matrix.rhs, global)};
  };
  const auto factorize = [&](std::uint32_t local, const Row& row) {
    float factor[6];
    solver::inverse_factor(row.diagonal, row.free_bits, factor);
    inverse[local] = {factor[0], factor[1], factor[2], factor[3]};
    inverse_rest[local] = {factor[4], factor[5]};
    const Vec3<float> b = solver::lower(factor) * row.rhs * row.weight;
    direction[local] = {b[0], b[1], b[2], 0};
    if (local >= own) halo_residual[local - own] = direction[local];
  };
  constexpr std::uint32_t kRowsAtOnce = 2 * Rows;  // enough for most patches
  Row rows[kRowsAtOnce];
#pragma unroll
  for (std::uint32_t i = 0; i < kRowsAtOnce; ++i) rows[i] = read_row(minimum(thread + i * Threads, locals - 1));
  for (int k = 0; k < Rows; ++k) {
    for (std::uint32_t j = 0; j < shared_width[k]; ++j) {
      const float* from = s.matrix.edges + view::block_begin(slot_of(k, Held + j));
      float* const to = blocks + (shared_begin[k] + j) * kSharedColumnReals;
      for (std::uint32_t c = 0; c < 9; ++c) {
        __pipeline_memcpy_async(to + shared_component(c, lane), from + c * kSliceRows, sizeof(float));
      }
    }
  }
  __pipeline_commit();
  for (int k = 0; k < Rows; ++k) {
    for_each_strided(
        0, shared_width[k], 1, [&](std::uint32_t j) { return s.matrix.columns[slot_of(k, Held + j)]; },
        [&](std::uint32_t j, std::uint32_t column) {
          columns[(shared_begin[k] + j) * kSliceRows + lane] = static_cast<std::uint16_t>(column * kCellBytes);
        });
  }
#pragma unroll
  for (std::uint32_t i = 0; i < kRowsAtOnce; ++i) {
    if (thread + i * Threads < locals) factorize(thread + i * Threads, rows[i]);
  }
  for_each_strided<2>(thread + kRowsAtOnce * Threads, locals, Threads, read_row, factorize);
  __syncthreads();

  const auto read_inverse = [&](std::uint32_t local, float(&factor)[6]) {
    const float4 a = inverse[local];
    const float2 b = inverse_rest[local];
    factor[0] = a.x, factor[1] = a.y, factor[2] = a.z, factor[3] = a.w, factor[4] = b.x, factor[5] = b.y;
  };
  if constexpr (Linked) {
    list_link_blocks<Threads>(s, patch, room, solver::Recurrence<float>::may_start_from_last(s.state), links,
                              read_inverse);
  }
  const auto scale = [&](int k, float(&block)[9], std::uint32_t column) {
    float own_inverse[6], other[6];
    read_inverse(has_row[k] ? thread + k * Threads : 0, own_inverse);
    read_inverse(column, other);
    solver::scale_block(own_inverse, block, other);
  };

  // Blocks in registers: some are scaled while the next are on their way. Beyond the width they are zero.
  float held[Rows][Held][9];
  std::uint32_t held_columns[Rows][Held / 2];  // two 16-bit offsets into direction [bytes]
  {
    constexpr int kAtOnce = 4, kBlocks = Rows * Held;
    std::uint32_t column[kBlocks];
    const auto load_some = [&](int begin) {
#pragma unroll
      for (int i = begin; i < begin + kAtOnce; ++i) {
        if (i >= kBlocks) break;
        const int k = i / Held, j = i % Held;
        column[i] = j < width[k] ? s.matrix.columns[slot_of(k, j)] : 0;
        const float* block = s.matrix.edges + view::block_begin(slot_of(k, j));
        for (int c = 0; c < 9; ++c) held[k][j][c] = j < width[k] ? block[c * kSliceRows] : 0;
      }
    };
    load_some(0);
#pragma unroll
    for (int begin = 0; begin < kBlocks; begin += kAtOnce) {
      load_some(begin + kAtOnce);
#pragma unroll
      for (int i = begin; i < begin + kAtOnce; ++i) {
        if (i >= kBlocks) break;
        const int k = i / Held, j = i % Held;
        scale(k, held[k][j], column[i]);
        held_columns[k][j / 2] = with_offset(held_columns[k][j / 2], j, column[i]);
      }
    }
  }

  // Blocks in shared memory, where each thread has copied its own, and then the remaining blocks.
  __pipeline_wait_prior(0);
  for (int k = 0; k < Rows; ++k) {
#pragma unroll 2
    for (std::uint32_t j = 0; j < shared_width[k]; ++j) {
      const std::uint32_t place = shared_begin[k] + j;
      float block[9];
      read_shared(place, block);
      scale(k, block, columns[place * kSliceRows + lane] / kCellBytes);
      float* const to = blocks + place * kSharedColumnReals;
      reinterpret_cast<float4*>(to)[lane] = {block[0], block[1], block[2], block[3]};
      reinterpret_cast<float4*>(to)[kSliceRows + lane] = {block[4], block[5], block[6], block[7]};
      to[8 * kSliceRows + lane] = block[8];
    }
    for (std::uint32_t j = Held + shared_width[k]; !Whole && j < width[k]; ++j) {
      float* const from = s.matrix.edges + view::block_begin(slot_of(k, j));
      float block[9];
      for (int c = 0; c < 9; ++c) block[c] = from[c * kSliceRows];
      scale(k, block, s.matrix.columns[slot_of(k, j)]);
      for (int c = 0; c < 9; ++c) from[c * kSliceRows] = block[c];
    }
  }

  Vec3<float> p[Rows], r[Rows], x[Rows], q[Rows];
  for (int k = 0; k < Rows; ++k) {
    const float4 start = has_row[k] ? direction[thread + k * Threads] : float4{};
    p[k] = r[k] = Vec3<float>(start.x, start.y, start.z);
    x[k].setZero();
    solver::prefetch_move(s.state, s.guard, row[k]);
  }
  if (solver::Recurrence<float>::may_start_from_last(s.state)) {
    const float* const last = solver::last_solution(s.patches, s.state, s.solve);
    const auto last_of = [&](std::uint32_t row) { return cell_of(view::load3<float>(last, row)); };
    for (int k = 0; k < Rows; ++k) {
      if (has_row[k]) p[k] = three_of(direction[thread + k * Threads] = last_of(row[k]));
    }
    for (std::uint32_t h = thread; h < patch.halo_count; h += Threads) {
      direction[own + h] = last_of(s.patches.halo[patch.halo_begin + h]);
    }
    __syncthreads();
  }
  [[maybe_unused]] LinkRange row_links[Rows];
  if constexpr (Linked) {
    __syncthreads();  // all blocks are listed
    for (int k = 0; k < Rows; ++k) row_links[k] = has_row[k] ? room.of_row[row[k]] : LinkRange{0, 0};
  }
  if (s.guard.patch_tetrahedra != nullptr) {
    const auto parts = PatchVolume<Threads>::parts_of(s, patch);
    PatchVolume<Threads>::expect(s, parts);
    if (thread == 0) tetrahedra = parts;
  }
  // Rows of the halo that this thread waits for; a patch seldom has more than two for each of its own.
  constexpr std::uint32_t kHaloAtOnce = 2 * Rows;
  std::uint32_t halo_rows[kHaloAtOnce];
  for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) {
    const std::uint32_t h = thread + i * kHaloThreads;
    halo_rows[i] = h < patch.halo_count ? s.patches.halo[patch.halo_begin + h] : 0;
  }
  Exchange exchange(s, patch.index);
  solver::Recurrence<float> recurrence(s.state, s.solve);
  do {
    exchange.begin();
    const bool along_last = recurrence.is_along_last();
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
      // By fours without a branch between them, so that reads overlap. Blocks beyond the width are zero.
#pragma unroll
      for (int j = 0; j < Held; j += 4) {
        if (j >= width[k]) break;
#pragma unroll
        for (int i = j; i < j + 4 && i < Held; ++i) {
          add(held[k][i], 1, offset_of(held_columns[k][i / 2], i));
        }
      }
#pragma unroll 2
      for (std::uint32_t j = 0; j < shared_width[k]; ++j) {
        const std::uint32_t place = shared_begin[k] + j;
        // As read_shared does it. Calling read_shared here made the loop 34 instructions longer.
        const float* from = blocks + place * kSharedColumnReals;
        const float4 a = reinterpret_cast<const float4*>(from)[lane],
                     b = reinterpret_cast<const float4*>(from)[kSliceRows + lane];
        const float block[9] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, from[8 * kSliceRows + lane]};
        add(block, 1, columns[place * kSliceRows + lane]);
      }
      if constexpr (!Whole) {
        struct Far {
          std::uint32_t column;
          float block[9];
        };
        for_each_strided<2>(
            Held + shared_width[k], width[k], 1,
            [&](std::uint32_t j) {
              const std::size_t slot = slot_of(k, j);
              const float* from = s.matrix.edges + view::block_begin(slot);
              Far far;
              far.column = s.matrix.columns[slot];
              for (int c = 0; c < 9; ++c) far.block[c] = from[c * kSliceRows];
              return far;
            },
            [&](std::uint32_t, const Far& far) { add(far.block, 1, far.column * kCellBytes); });
      }
      if constexpr (Linked) add_link_blocks(room, row_links[k], direction, q[k]);
      if (has_row[k]) exchange.publish_row(row[k], q[k][0], q[k][1], q[k][2]);
      own_sums.x += p[k].dot(q[k]);
      own_sums.y += along_last ? p[k].dot(r[k]) : q[k].dot(q[k]);
      own_sums.z += r[k].dot(r[k]);
    }
    sums.exchange(exchange, s.patches.patch_count, own_sums, recurrence.iterations());
    if (thread < kHaloThreads) {
      for (std::uint32_t h = thread; h < patch.halo_count; h += kHaloAtOnce * kHaloThreads) {
        Exchange::Cell cells[kHaloAtOnce];
        exchange.wait_for_rows(
            h, kHaloThreads, patch.halo_count,
            [&](int i) { return h == thread ? halo_rows[i] : s.patches.halo[patch.halo_begin + h + i * kHaloThreads]; },
            cells);
        for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) {
          const std::uint32_t place = h + i * kHaloThreads;
          if (place < patch.halo_count) halo_product[place] = {cells[i].x, cells[i].y, cells[i].z, 0};
        }
      }
      if constexpr (Linked) wait_for_guests(exchange, room, links, thread, kHaloThreads);
    }
    __syncthreads();
    const Exchange::Cell all = sums.total();
    if (!recurrence.take(all.x, all.y, all.z)) break;
    const float alpha = recurrence.alpha(), beta = recurrence.beta();
#pragma unroll
    for (int k = 0; k < Rows; ++k) {
      x[k] = solver::next_solution(x[k], p[k], alpha);
      r[k] = solver::next_residual(r[k], q[k], alpha);
      p[k] = solver::next_direction(r[k], p[k], beta);
      if (has_row[k]) direction[thread + k * Threads] = {p[k][0], p[k][1], p[k][2], 0};
    }
    if constexpr (Linked) update_guests<Threads>(room, links, alpha, beta);
    // Two at a time, so that their reads overlap.
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
        hr[i].x = solver::next_residual(hr[i].x, hq[i].x, alpha);
        hr[i].y = solver::next_residual(hr[i].y, hq[i].y, alpha);
        hr[i].z = solver::next_residual(hr[i].z, hq[i].z, alpha);
        halo_residual[place] = hr[i];
        direction[own + place] = {solver::next_direction(hr[i].x, hp[i].x, beta),
                                  solver::next_direction(hr[i].y, hp[i].y, beta),
                                  solver::next_direction(hr[i].z, hp[i].z, beta), 0};
      }
    }
    if (thread == 0 && patch.index == 0) recurrence.report_gain(s.solve);
    __syncthreads();
  } while (recurrence.goes_on());

  if (thread == 0 && patch.index == 0) {
    recurrence.report(s.solve);
    // Every patch has taken its part: its sums of the first iteration have come.
    if constexpr (Linked) room.used[0] = room.used[1] = 0;
  }
  Vec3<float> change[Rows];
  for (int k = 0; k < Rows; ++k) {
    float factor[6];
    read_inverse(has_row[k] ? thread + k * Threads : 0, factor);
    change[k] = solver::unscaled(s.state, row[k], solver::lower(factor), x[k]);
    if (has_row[k]) solver::keep_solution(s.patches, s.state, s.solve, row[k], x[k]);
  }
  __syncthreads();  // all factors have been read
  end_solve<Threads>(s, patch, tetrahedra, exchange, shared, [&](std::uint32_t moved) -> Vec3<float> {
    Vec3<float> of = change[0];
    for (int k = 1; k < Rows; ++k) of = moved == row[k] ? change[k] : of;
    return of;
  });
}

}  // namespace tensormass::backend::cuda
