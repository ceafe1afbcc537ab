#pragma once

#include "backend/cuda/exchange.cuh"
#include "backend/cuda/resident_memory.h"
#include "contact/links.h"
#include "solver/conjugate_gradients.h"
#include "solver/jacobi_scaling.h"

/// Links in the resident solve (resident_solve.cuh): blocks of the scaled matrix that the mesh has no edge for.
///
///   B_ij = w_i w_j h² L_i⁻¹ S L_j⁻ᵀ     of each link of row i and each of its other rows j    (solver/link_product.h)
///
///   links of a patch's rows ──> blocks, row by row ──> q_i += B_ij p_j
///                          └──> guests: rows j of other patches, with r and p, which every iteration updates as it
///                               updates those of the halo
///
/// 1. A guest is a copy for one block. A row that several blocks name has several guests: links differ from step to
///    step, and to find equal ones would take longer than to wait for a few cells more.
/// 2. Every row already publishes q for the halo of others, so a guest costs no exchange and no barrier.
/// 3. The order in which threads take places in the lists differs from run to run. Each sum runs over the blocks of one
///    row, whose order is that of its links, so results repeat bitwise.
namespace tensormass::backend::cuda {

/// A block and where p_j is.
struct LinkBlock {
  static constexpr std::uint32_t kGuest = 0x80000000u;
  float block[9];
  std::uint32_t column;  ///< an offset into `direction` [bytes], or kGuest and the place of a guest
};

/// A row of another patch, seen from one block.
struct alignas(16) LinkGuest {
  float4 direction, residual, product;
  std::uint32_t row;
};

/// The blocks of a row.
struct LinkRange {
  std::uint32_t begin, count;
};

/// Device memory for links of a resident solve.
struct LinkRoom {
  /// A link has four rows, and each has three others.
  static constexpr std::uint32_t kBlocksOfLink = 12;

  LinkBlock* blocks;    // [12 links]
  LinkGuest* guests;    // [12 links]
  LinkRange* of_row;    // [row_count] of rows that may have links; others stay empty
  std::uint32_t* used;  // [2] blocks and guests that patches have taken; zero between two solves
};

/// The part of the lists that belongs to a patch. In shared memory.
struct PatchLinks {
  std::uint32_t blocks, guests;              // how many
  std::uint32_t first_block, first_guest;    // where they begin
  std::uint32_t taken_blocks, taken_guests;  // by the threads that fill them
};

/// Lists the blocks of a patch. All threads must call it when `inverse_of` is valid for own rows, and then meet at a
/// barrier.
///
///   inverse_of(local, out)   six reals of L⁻¹ of an own row
template <unsigned Threads, class InverseOf>
__device__ void list_link_blocks(const view::SceneView<float>& s, const view::Patch& patch, const LinkRoom& room,
                                 bool starts_from_last, PatchLinks& mine, const InverseOf& inverse_of) {
  const auto for_each_own = [&](const auto& visit) {
    const std::uint32_t end = s.links.patch_rows[patch.index + 1];
    for (std::uint32_t i = s.links.patch_rows[patch.index] + threadIdx.x; i < end; i += Threads) {
      visit(s.links.rows[i]);
    }
  };
  const auto is_own = [&](std::uint32_t row) { return row >= patch.row_begin && row < patch.row_end; };
  /// visit(link, role, r): each other row r of each link of a row
  const auto for_each_other = [&](std::uint32_t row, const auto& visit) {
    contact::for_each_link(s.links, row, [&](const view::Link<float>& link, std::uint32_t role) {
      for (std::uint32_t r = 0; r < 4; ++r) {
        if (r != role && link.weight[r] != 0) visit(link, role, r);
      }
    });
  };

  if (threadIdx.x == 0) mine = {};
  __syncthreads();
  for_each_own([&](std::uint32_t row) {
    std::uint32_t blocks = 0, guests = 0;
    for_each_other(row, [&](const view::Link<float>& link, std::uint32_t, std::uint32_t r) {
      ++blocks;
      guests += is_own(link.rows[r]) ? 0 : 1;
    });
    if (blocks > 0) atomicAdd(&mine.blocks, blocks);
    if (guests > 0) atomicAdd(&mine.guests, guests);
    room.of_row[row] = {0, blocks};
  });
  __syncthreads();
  if (threadIdx.x == 0) {
    mine.first_block = atomicAdd(room.used, mine.blocks);
    mine.first_guest = atomicAdd(room.used + 1, mine.guests);
  }
  __syncthreads();
  const float factor = view::contact_factor(s.state);
  const float* const last = starts_from_last ? solver::last_solution(s.patches, s.state, s.solve) : nullptr;
  for_each_own([&](std::uint32_t row) {
    const std::uint32_t count = room.of_row[row].count;
    if (count == 0) return;
    std::uint32_t place = mine.first_block + atomicAdd(&mine.taken_blocks, count);
    room.of_row[row].begin = place;
    float own[6];
    inverse_of(row - patch.row_begin, own);
    for_each_other(row, [&](const view::Link<float>& link, std::uint32_t role, std::uint32_t r) {
      const std::uint32_t other = link.rows[r];
      float inverse[6];
      LinkBlock& out = room.blocks[place++];
      if (is_own(other)) {
        out.column = (other - patch.row_begin) * kCellBytes;
        inverse_of(other - patch.row_begin, inverse);
      } else {
        const std::uint32_t guest = mine.first_guest + atomicAdd(&mine.taken_guests, 1u);
        out.column = LinkBlock::kGuest | guest;
        solver::inverse_factor(s.matrix.diagonal + std::size_t{8} * other, view::free_bits(s.state, other), inverse);
        const Vec3<float> b = solver::scaled_rhs(s.state, s.matrix, other, solver::lower(inverse));
        LinkGuest& copy = room.guests[guest];
        copy.row = other;
        copy.residual = cell_of(b);
        copy.direction = last == nullptr ? copy.residual : cell_of(view::load3<float>(last, other));
      }
      const Mat3<float> stiffness = contact::stiffness_of(link) * (link.weight[role] * link.weight[r] * factor);
      for (int i = 0; i < 9; ++i) out.block[i] = stiffness(i / 3, i % 3);
      solver::scale_block(own, out.block, inverse);
    });
  });
}

/// Adds the blocks of a row to its q.
/// direction: p of own rows.
__device__ inline void add_link_blocks(const LinkRoom& room, const LinkRange& of_row, const float4* direction,
                                       Vec3<float>& q) {
  for (std::uint32_t i = 0; i < of_row.count; ++i) {
    const LinkBlock& b = room.blocks[of_row.begin + i];
    const float4 p = (b.column & LinkBlock::kGuest) != 0
                         ? room.guests[b.column & ~LinkBlock::kGuest].direction
                         : *reinterpret_cast<const float4*>(reinterpret_cast<const char*>(direction) + b.column);
    for (int c = 0; c < 3; ++c) q[c] += b.block[3 * c] * p.x + b.block[3 * c + 1] * p.y + b.block[3 * c + 2] * p.z;
  }
}

/// Waits for q of the guests and keeps it. Threads `thread`, `thread` + threads, .. share the guests.
__device__ inline void wait_for_guests(const Exchange& exchange, const LinkRoom& room, const PatchLinks& mine,
                                       std::uint32_t thread, std::uint32_t threads) {
  constexpr std::uint32_t kAtOnce = 4;
  LinkGuest* const guests = room.guests + mine.first_guest;
  for (std::uint32_t g = thread; g < mine.guests; g += kAtOnce * threads) {
    Exchange::Cell cells[kAtOnce];
    exchange.wait_for_rows(
        g, threads, mine.guests, [&](int i) { return guests[g + i * threads].row; }, cells);
    for (std::uint32_t i = 0; i < kAtOnce; ++i) {
      if (g + i * threads < mine.guests) guests[g + i * threads].product = {cells[i].x, cells[i].y, cells[i].z, 0};
    }
  }
}

/// Updates r and p of the guests, as those of the halo.
template <unsigned Threads>
__device__ void update_guests(const LinkRoom& room, const PatchLinks& mine, float alpha, float beta) {
  for (std::uint32_t g = threadIdx.x; g < mine.guests; g += Threads) {
    LinkGuest& guest = room.guests[mine.first_guest + g];
    const Vec3<float> r = solver::next_residual(three_of(guest.residual), three_of(guest.product), alpha);
    guest.residual = cell_of(r);
    guest.direction = cell_of(solver::next_direction(r, three_of(guest.direction), beta));
  }
}

}  // namespace tensormass::backend::cuda
