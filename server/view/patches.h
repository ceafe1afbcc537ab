#pragma once

#include <cstddef>
#include <cstdint>

#include "core/scalar.h"

/// Patches: how the rows of a scene are shared out among threads of a CPU or thread blocks of a GPU.
///
///   rows   0 ......... 63 | 64 ........ 127 | 128 ....... 223      row_count = 224
///          patch 0          patch 1           patch 2
///          its last 5       its halo: rows
///          are gap rows     40 and 150
///
///   row     a node after renumbering; each patch owns a contiguous range that starts and ends at a multiple of
///           kSliceRows. Gap rows at the end of a patch fill up its last slice; no element refers to them.
///   halo    the rows of other patches to which a patch's own rows are coupled
///   column  patch-local number of a row: own rows first, then the halo
namespace tensormass::view {

/// Rows of a slice of the matrix: a GPU warp, and a multiple of a CPU's vector width.
inline constexpr std::uint32_t kSliceRows = 32;

struct PatchesView {
  std::uint32_t row_count;
  std::uint32_t patch_count;
  const std::uint32_t* patch_rows;  // [patch_count + 1] first row of each patch
  const std::uint32_t* patch_halo;  // [patch_count + 1] into halo
  const std::uint32_t* halo;        // rows of the scene
};

/// The rows behind the columns of one patch.
struct PatchColumns {
  std::uint32_t row_begin, row_end;
  std::uint32_t halo_begin;
  TM_HOST_DEVICE std::uint32_t own() const { return row_end - row_begin; }
};

/// One patch's ranges.
struct Patch : PatchColumns {
  std::uint32_t index;
  std::uint32_t halo_count;
  std::size_t local_begin;  // first of its own rows in vectors that are stored patch by patch, halos included
};

TM_HOST_DEVICE inline Patch patch_of(const PatchesView& patches, std::uint32_t index) {
  const std::uint32_t rows = patches.patch_rows[index], halo = patches.patch_halo[index];
  return {{rows, patches.patch_rows[index + 1], halo},
          index,
          patches.patch_halo[index + 1] - halo,
          std::size_t{rows} + halo};
}

/// The row of the scene behind a patch-local column.
TM_HOST_DEVICE inline std::uint32_t global_row(const PatchesView& patches, const PatchColumns& patch,
                                               std::uint32_t column) {
  return column < patch.own() ? patch.row_begin + column : patches.halo[patch.halo_begin + column - patch.own()];
}

/// Loads the vector of a row: three reals, padded to four so that a GPU reads it at once. vectors: [.., 4]
template <class Real>
TM_HOST_DEVICE Vec3<Real> load3(const Real* vectors, std::size_t row) {
  return read3(vectors + 4 * row);
}
template <class Real>
TM_HOST_DEVICE void store3(Real* vectors, std::size_t row, const Vec3<Real>& v) {
  write3(vectors + 4 * row, v);
}

}  // namespace tensormass::view
