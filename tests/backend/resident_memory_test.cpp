#include "backend/cuda/resident_memory.h"

#include <algorithm>
#include <set>
#include <vector>

#include <gtest/gtest.h>

#include "backend/cuda/solve_room.h"
#include "mesh/random_mesh.h"
#include "view/elements.h"

/// The places of a patch's data in a resident solve.
namespace tensormass::backend::cuda {
namespace {

TEST(ResidentMemory, HasBytesForAllArraysOfTheKernel) {
  for (const std::uint32_t own : {32u, 96u, 512u}) {
    for (const std::uint32_t halo : {0u, 1u, 2u, 3u, 255u}) {
      const std::uint32_t locals = own + halo;
      const std::size_t direction = 16 * locals, halo_vectors = 2 * 16 * halo, inverse = 16 * locals;
      const std::size_t inverse_rest = 4 * view::round_to_four(2 * locals);  // blocks start at 16 bytes
      EXPECT_GE(resident_vector_bytes(locals, halo), direction + halo_vectors + inverse + inverse_rest);
    }
  }
  constexpr std::size_t kBlocks = sizeof(float) * kSharedColumnReals, kColumns = sizeof(std::uint16_t) * kSliceRows;
  EXPECT_EQ(kResidentBytesPerColumn, kBlocks + kColumns);
}

TEST(ResidentMemory, HasOnePlaceForEachComponentOfAColumn) {
  std::set<std::uint32_t> places;
  for (std::uint32_t lane = 0; lane < kSliceRows; ++lane) {
    for (std::uint32_t c = 0; c < 9; ++c) {
      const std::uint32_t place = shared_component(c, lane);
      EXPECT_LT(place, kSharedColumnReals);
      EXPECT_TRUE(places.insert(place).second);
      // As resident_solve reads them: two Cells of the lane, then a float.
      const std::uint32_t cell = c / 4 * kSliceRows + lane;
      EXPECT_EQ(place, c < 8 ? 4 * cell + c % 4 : 8 * kSliceRows + lane);
    }
  }
  EXPECT_EQ(places.size(), kSharedColumnReals);
}

TEST(ResidentMemory, AWordHoldsTheOffsetsOfTwoBlocks) {
  constexpr std::uint32_t kMax = kMaxOffset / kCellBytes;
  for (const std::uint32_t even : {0u, 7u, kMax}) {
    for (const std::uint32_t odd : {0u, 5u, kMax}) {
      const std::uint32_t word = with_offset(with_offset(0xFFFFFFFFu, 4, even), 5, odd);
      EXPECT_EQ(offset_of(word, 4), even * kCellBytes);
      EXPECT_EQ(offset_of(word, 5), odd * kCellBytes);
    }
  }
}

/// The places of the further columns of a patch's slices, as the lanes of resident_solve compute them.
struct Places {
  std::vector<std::uint32_t> begin, width;
};
Places places_of(const std::vector<std::uint32_t>& widths, std::uint32_t held, std::uint32_t capacity) {
  const auto sum_shared = [&](std::uint32_t left) {
    std::uint32_t sum = 0;
    for (const std::uint32_t width : widths) sum += shared_width_of(further_columns(width, held), left);
    return sum;
  };
  const std::uint32_t left = least_left(capacity, sum_shared);
  Places places;
  std::uint32_t before = 0;
  for (const std::uint32_t width : widths) {
    places.begin.push_back(before);
    places.width.push_back(shared_width_of(further_columns(width, held), left));
    before += places.width.back();
  }
  return places;
}

TEST(ResidentMemory, EverySliceLeavesAsFewColumnsInDeviceMemoryAsThereIsRoomFor) {
  constexpr std::uint32_t kHeld = 8;
  const std::vector<std::uint32_t> widths{12, 0, 8, 3, 70, 9, 15};
  std::uint32_t needed = 0;
  for (const std::uint32_t width : widths) needed += further_columns(width, kHeld);
  EXPECT_EQ(needed, 4u + 62 + 1 + 7);
  for (std::uint32_t capacity = 0; capacity <= needed; ++capacity) {
    const Places places = places_of(widths, kHeld, capacity);
    std::uint32_t left = 0, end = 0;
    for (std::size_t slice = 0; slice < widths.size(); ++slice) {
      // A column is in registers, in shared memory, or in device memory.
      const std::uint32_t further = further_columns(widths[slice], kHeld);
      ASSERT_LE(places.width[slice], further);
      EXPECT_EQ(places.begin[slice], end) << "columns lie one after the other";
      end += places.width[slice];
      left = std::max(left, further - places.width[slice]);
    }
    EXPECT_LE(end, capacity);
    std::uint32_t with_one_less = 0;
    for (const std::uint32_t width : widths) {
      if (left > 0) with_one_less += shared_width_of(further_columns(width, kHeld), left - 1);
    }
    EXPECT_TRUE(left == 0 || with_one_less > capacity) << "capacity " << capacity;
  }
}

TEST(ResidentRoom, HoldsWhatTheLargestPatchNeedsAndNoMore) {
  const matrix::Layout layout = matrix::make_layout(mesh::testing::random_mesh(1, 8, 0.9), 3);
  const PatchSizes most = largest_sizes(layout);
  EXPECT_EQ(most.locals, layout.largest_patch());
  constexpr std::uint32_t kHeld = 4;
  const std::size_t vectors = resident_vector_bytes(most.locals, most.halo);
  EXPECT_FALSE(resident_room(layout, most, kHeld, vectors - 1));

  const auto all = resident_room(layout, most, kHeld, std::size_t{1} << 30);
  ASSERT_TRUE(all);
  EXPECT_TRUE(all->whole);
  std::uint32_t needed = 0;
  for (std::uint32_t p = 0; p < layout.patch_count; ++p) {
    std::vector<std::uint32_t> widths;
    for (std::uint32_t i = layout.patch_rows[p] / kSliceRows; i < layout.patch_rows[p + 1] / kSliceRows; ++i) {
      widths.push_back(layout.slice_begin[i + 1] - layout.slice_begin[i]);
    }
    const Places places = places_of(widths, kHeld, all->column_capacity);
    std::uint32_t columns = 0;
    for (std::size_t i = 0; i < widths.size(); ++i) {
      EXPECT_EQ(places.width[i], further_columns(widths[i], kHeld)) << "all further columns are in shared memory";
      columns += places.width[i];
    }
    needed = std::max(needed, columns);
  }
  ASSERT_GT(needed, 1u);
  EXPECT_EQ(all->column_capacity, needed);
  EXPECT_EQ(all->bytes, vectors + needed * kResidentBytesPerColumn);

  const auto barely = resident_room(layout, most, kHeld, all->bytes);
  ASSERT_TRUE(barely);
  EXPECT_TRUE(barely->whole);
  const auto part = resident_room(layout, most, kHeld, all->bytes - 1);
  ASSERT_TRUE(part);
  EXPECT_FALSE(part->whole);
  EXPECT_EQ(part->column_capacity, needed - 1);
  EXPECT_LE(part->bytes, all->bytes - 1);
}

TEST(ResidentRoom, IsForThePatchThatNeedsMost) {
  for (const std::vector<std::uint32_t>& widths : {std::vector<std::uint32_t>{9, 5}, {5, 9}}) {
    matrix::Layout layout;  // two patches of one slice
    layout.patch_count = 2;
    layout.patch_rows = {0, kSliceRows, 2 * kSliceRows};
    layout.patch_halo = {0, 0, 0};
    layout.slice_begin = {0, widths[0], widths[0] + widths[1]};
    EXPECT_EQ(resident_room(layout, largest_sizes(layout), 4, std::size_t{1} << 30)->column_capacity, 9u - 4);
  }
}

TEST(ResidentRoom, RefusesPatchesWhoseOffsetsExceed16Bits) {
  const matrix::Layout layout = matrix::make_layout(mesh::testing::random_mesh(1, 8, 0.9), 1);
  PatchSizes most = largest_sizes(layout);
  most.locals = kMaxOffset / kCellBytes;
  EXPECT_TRUE(resident_room(layout, most, 4, std::size_t{1} << 30));
  ++most.locals;
  EXPECT_FALSE(resident_room(layout, most, 4, std::size_t{1} << 30));
}

}  // namespace
}  // namespace tensormass::backend::cuda
