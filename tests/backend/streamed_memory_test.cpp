#include "backend/cuda/streamed_memory.h"

#include <gtest/gtest.h>

#include "backend/cuda/solve_room.h"
#include "backend/memory_map.h"

/// Which vectors a streamed solve keeps in shared memory, and where.
namespace tensormass::backend::cuda {
namespace {

using tests::Cell;
using tests::MemoryMap;

constexpr std::uint32_t kTileRows = 64;

/// Takes the places of a patch's vectors as streamed_solve does, in memory for the largest patch.
void place_patch(const StreamedRoom& room, std::uint32_t own, std::uint32_t halo) {
  const std::uint32_t locals = own + halo, held = streamed_tile_rows(own, kTileRows);
  MemoryMap map(room.bytes);
  StreamedMemory<Cell> memory(map.begin(), held, room.near_vectors);
  map.take(map.begin(), held, "q of the tiles");
  if ((room.near_vectors & kNearDirection) != 0) map.take(memory.place_direction(locals), locals, "p");
  float in_device_memory = 0;
  float* const r = memory.place(kNearResidual, locals, &in_device_memory);
  float* const x = memory.place(kNearSolution, own, &in_device_memory);
  EXPECT_EQ(r == &in_device_memory, (room.near_vectors & kNearResidual) == 0);
  EXPECT_EQ(x == &in_device_memory, (room.near_vectors & kNearSolution) == 0);
  if (r != &in_device_memory) map.take(r, std::size_t{3} * locals, "r");
  if (x != &in_device_memory) map.take(x, std::size_t{3} * own, "x");
}

TEST(StreamedMemory, HasAPlaceOfItsOwnForEachVectorOfEveryPatch) {
  constexpr std::uint32_t kRows = 2048, kHalo = 301;
  const std::size_t tiles = std::size_t{16} * 16 * kTileRows, p = 16 * (kRows + kHalo), r = 12 * (kRows + kHalo) + 4,
                    x = 12 * kRows;
  const std::pair<std::size_t, std::uint32_t> cases[] = {
      {tiles, 0},
      {tiles + p - 1, kNearResidual},  // a vector that does not fit leaves its room to a smaller one
      {tiles + p, kNearDirection},
      {tiles + p + r, kNearDirection | kNearResidual},
      {tiles + p + r + x - 1, kNearDirection | kNearResidual},
      {tiles + p + r + x, kNearDirection | kNearResidual | kNearSolution}};
  for (const auto& [bytes, expected] : cases) {
    const StreamedRoom room = streamed_room(kRows, kRows + kHalo, kTileRows, bytes);
    EXPECT_LE(room.bytes, bytes);
    EXPECT_EQ(room.near_vectors, expected) << bytes;
    for (const std::uint32_t own : {32u, 1024u, 1056u, kRows}) {
      for (const std::uint32_t halo : {0u, 1u, 2u, 3u, kHalo}) place_patch(room, own, halo);
    }
  }
}

TEST(StreamedMemory, KeepsDirectionAndResidualOfAsManyRowsAsPromised) {
  for (const std::size_t bytes : {99u * 1024, 227u * 1024}) {
    const std::uint32_t locals = most_kept_rows(bytes);
    ASSERT_GT(locals, 1000u);
    for (std::uint32_t own = locals / 32 * 32; own >= 32; own /= 2) {
      for (const std::uint32_t tile_rows : {32u, 256u}) {
        const StreamedRoom room = streamed_room(own, locals, tile_rows, bytes - 2048);
        EXPECT_EQ(room.near_vectors & (kNearDirection | kNearResidual), kNearDirection | kNearResidual) << own;
        // PatchVolume overwrites the first cells with the positions of all rows, but not x.
        const std::size_t before_x =
            room.bytes - ((room.near_vectors & kNearSolution) != 0 ? round_to_cells(12 * std::size_t{own}) : 0);
        EXPECT_GE(before_x, 16 * std::size_t{locals});
      }
    }
  }
}

}  // namespace
}  // namespace tensormass::backend::cuda
