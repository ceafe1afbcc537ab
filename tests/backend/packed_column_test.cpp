#include "backend/cuda/packed_column.h"

#include <map>
#include <set>
#include <vector>

#include <gtest/gtest.h>

#include "backend/memory_map.h"
#include "matrix/layout.h"
#include "mesh/random_mesh.h"

/// The packed matrix: which bytes of a column hold what, and which slots a warp reads, against the layout.
namespace tensormass::backend::cuda {
namespace {

using matrix::Layout;
using tests::MemoryMap;
using tests::Words;

template <class Word>
class PackedColumns : public testing::Test {};
using NeighbourWords = testing::Types<std::uint16_t, std::uint32_t>;
TYPED_TEST_SUITE(PackedColumns, NeighbourWords);

TYPED_TEST(PackedColumns, LieWithinTheMemoryOfTheirUnpackedBlocks) {
  constexpr std::uint32_t kColumns = 3;
  MemoryMap map(kColumns * 9 * kSliceRows * sizeof(float));
  auto* const edges = reinterpret_cast<float*>(map.begin());
  for (std::uint32_t column = 0; column < kColumns; ++column) {
    const PackedColumn<TypeParam, Words> packed(edges, column);
    const auto* const begin = reinterpret_cast<const std::byte*>(edges + view::block_begin(column * kSliceRows));
    const auto* const end = reinterpret_cast<const std::byte*>(edges + view::block_begin((column + 1) * kSliceRows));
    for (std::uint32_t lane = 0; lane < kSliceRows; ++lane) {
      for (std::uint32_t pair = 0; pair < 3; ++pair) map.take(packed.pair(pair, lane), 1, "a pair");
      map.take(packed.neighbour(lane), 1, "a neighbour");
      map.take(packed.diagonal(lane), 1, "a diagonal");
    }
    EXPECT_EQ(reinterpret_cast<const std::byte*>(packed.pair(0, 0)), begin);
    EXPECT_LE(reinterpret_cast<const std::byte*>(packed.diagonal(kSliceRows - 1) + 1), end);
  }
}

TYPED_TEST(PackedColumns, NeighboursKeepTheirRowAndTheirBit) {
  using Of = Neighbour<TypeParam>;
  for (const std::uint32_t local : {0u, 1u, 255u, Of::kMaxLocals - 1}) {
    for (const bool serves_both : {false, true}) {
      const TypeParam word = Of::of(local, serves_both);
      EXPECT_EQ(Of::local(word), local);
      EXPECT_EQ(Of::serves_both(word), serves_both);
    }
  }
}

/// The view of a layout's matrix, as far as a walk reads it.
view::MatrixView<float> view_of(const Layout& layout) {
  view::MatrixView<float> matrix{};
  matrix.slice_begin = layout.slice_begin.data();
  matrix.columns = layout.columns.data();
  matrix.tile_rows = layout.tile_rows;
  if (layout.storage == matrix::Storage::kTiles) {
    matrix.slice_read = layout.slice_read.data();
    matrix.used_twice = layout.used_twice.data();
  }
  return matrix;
}

constexpr unsigned kWarps = 4;  // fewer than streamed_solve has, so that small meshes have several tiles a warp

/// A slice that a warp visits in its walk.
struct Visit {
  std::uint32_t tile_first, tile_last, slice;
};
/// Walks as TileWalk of packed_matrix.cuh does, from the first tile on.
std::vector<Visit> walk_of(std::uint32_t own, std::uint32_t tile_rows, std::uint32_t warp, std::size_t visits) {
  TileSteps<kWarps> steps(tile_rows, own, warp);
  std::vector<Visit> walk;
  if (!steps.has_tile()) return walk;
  const auto visit = [&] { walk.push_back({steps.first, steps.last(), steps.first / kSliceRows + steps.slice}); };
  steps.begin_tile(steps.begin);
  visit();
  while (walk.size() < visits) {
    steps.next(visit, [&](std::uint32_t first) {
      steps.begin_tile(first);
      visit();
    });
  }
  return walk;
}

TEST(TileSteps, WarpsVisitEachSliceOnceARoundInTheOrderOfTheSolve) {
  for (const std::uint32_t tile_rows : {32u, 64u, 256u}) {
    for (std::uint32_t slices = 1; slices <= 40; ++slices) {
      const std::uint32_t own = slices * kSliceRows;
      std::vector<int> visits(slices, 0);
      for (std::uint32_t warp = 0; warp < kWarps; ++warp) {
        // streamed_solve's own order: its loops over tiles, and multiply's over rows.
        std::vector<Visit> expected;
        for (std::uint32_t first = warp * tile_rows; first < own; first += kWarps * tile_rows) {
          const std::uint32_t last = std::min(first + tile_rows, own);
          for (std::uint32_t row = first; row < last; row += kSliceRows) {
            expected.push_back({first, last, row / kSliceRows});
            ++visits[row / kSliceRows];
          }
        }
        const std::vector<Visit> walk = walk_of(own, tile_rows, warp, 2 * expected.size());
        ASSERT_EQ(walk.size(), 2 * expected.size());
        for (std::size_t i = 0; i < walk.size(); ++i) {  // twice: the walk starts again after its last tile
          const Visit& wanted = expected[i % expected.size()];
          EXPECT_EQ(walk[i].slice, wanted.slice) << own << " rows in tiles of " << tile_rows;
          EXPECT_EQ(walk[i].tile_first, wanted.tile_first);
          EXPECT_EQ(walk[i].tile_last, wanted.tile_last);
        }
      }
      EXPECT_EQ(visits, std::vector<int>(slices, 1));
    }
  }
}

/// Pairs of rows of the scene, and how often a solve multiplies the block of the first with the vector of the second.
using Products = std::map<std::pair<std::uint32_t, std::uint32_t>, int>;

/// The products of a walk over the read columns, as TileWalk::multiply makes them.
Products walked_products(const Layout& layout, std::uint32_t tile_rows) {
  const view::MatrixView<float> matrix = view_of(layout);
  Products products;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::uint32_t begin = layout.patch_rows[patch], own = layout.patch_rows[patch + 1] - begin;
    for (std::uint32_t warp = 0; warp < kWarps; ++warp) {
      std::set<std::uint32_t> seen;
      std::size_t slices = 0;
      for (std::uint32_t first = warp * tile_rows; first < own; first += kWarps * tile_rows) {
        slices += (std::min(first + tile_rows, own) - first) / kSliceRows;
      }
      for (const Visit& visit : walk_of(own, tile_rows, warp, slices)) {
        const ReadColumns columns(matrix, begin / kSliceRows + visit.slice);
        for (std::uint32_t column = columns.begin; column < columns.end; ++column) {
          EXPECT_TRUE(seen.insert(column).second) << "a column is read twice";
          for (std::uint32_t lane = 0; lane < kSliceRows; ++lane) {
            const std::uint32_t slot = column * kSliceRows + lane;
            const bool twice = matrix.used_twice != nullptr && (matrix.used_twice[column] >> lane & 1) != 0;
            const auto word = Neighbour<std::uint16_t>::of(matrix.columns[slot], twice);
            if (layout.neighbour_rows[slot] == mesh::kNone) {
              EXPECT_FALSE(twice) << "padding serves no row";
              continue;
            }
            const std::uint32_t row = begin + visit.slice * kSliceRows + lane, other = layout.neighbour_rows[slot];
            ++products[{row, other}];
            if (!Neighbour<std::uint16_t>::serves_both(word)) continue;
            ++products[{other, row}];
            const std::uint32_t local = Neighbour<std::uint16_t>::local(word);
            EXPECT_EQ(begin + local, other);
            EXPECT_GE(local, visit.tile_first) << "a block serves only rows of its tile";
            EXPECT_LT(local, visit.tile_last);
          }
        }
      }
    }
  }
  return products;
}

TEST(TileWalk, MultipliesEachBlockOfTheLayoutOnce) {
  for (unsigned seed = 1; seed <= 3; ++seed) {
    const mesh::Mesh mesh = mesh::testing::random_mesh(seed, 8, 0.9);
    for (const matrix::Storage storage : {matrix::Storage::kRows, matrix::Storage::kTiles}) {
      const Layout layout = matrix::make_layout(mesh, 2, storage);
      const std::uint32_t tile_rows = layout.tile_rows != 0 ? layout.tile_rows : matrix::kMaxTileRows;
      Products expected;
      for (std::uint32_t row = 0; row < layout.row_count; ++row) {
        for (std::uint32_t j = layout.slice_begin[row / kSliceRows]; j < layout.slice_begin[row / kSliceRows + 1];
             ++j) {
          const std::uint32_t other = layout.neighbour_rows[j * kSliceRows + row % kSliceRows];
          if (other != mesh::kNone) ++expected[{row, other}];
        }
      }
      ASSERT_FALSE(expected.empty());
      EXPECT_EQ(walked_products(layout, tile_rows), expected);
    }
  }
}

}  // namespace
}  // namespace tensormass::backend::cuda
