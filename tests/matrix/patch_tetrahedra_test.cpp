#include "matrix/patch_tetrahedra.h"

#include <algorithm>
#include <array>
#include <set>

#include <gtest/gtest.h>

#include "mesh/random_mesh.h"
#include "mesh/shapes.h"
#include "step/inversion_check.h"

namespace tensormass::matrix {
namespace {

using Tetrahedron = std::array<std::uint32_t, 4>;

/// Returns the same nodes for all of their orders that give the volume the same sign.
Tetrahedron canonical(Tetrahedron nodes) {
  bool odd = false;
  for (std::size_t i = 0; i < 4; ++i) {
    for (std::size_t k = 3; k > i; --k) {
      if (nodes[k] > nodes[k - 1]) continue;
      std::swap(nodes[k], nodes[k - 1]);
      odd = !odd;
    }
  }
  if (odd) std::swap(nodes[2], nodes[3]);
  return nodes;
}

/// Returns how many reads queue on average when eight threads each read a node. Equal rows are one read.
double reads_at_once(const PatchTetrahedra& shared, std::uint32_t part) {
  std::size_t reads = 0, phases = 0;
  for (std::size_t first = shared.begin[part]; first + 8 <= shared.begin[part + 1]; first += 8) {
    for (std::size_t k = 0; k < 4; ++k) {
      std::array<std::set<std::uint16_t>, 8> at_bank;
      for (std::size_t t = first; t < first + 8; ++t)
        at_bank[shared.rows[4 * t + k] % 8].insert(shared.rows[4 * t + k]);
      std::size_t most = 0;
      for (const auto& rows : at_bank) most = std::max(most, rows.size());
      reads += most;
      ++phases;
    }
  }
  return phases == 0 ? 0 : static_cast<double>(reads) / static_cast<double>(phases);
}

/// Expects each tetrahedron once, with the local numbers of its nodes in its patch.
void check(const mesh::Mesh& mesh, std::uint32_t patches, Storage storage) {
  const Layout layout = make_layout(mesh, patches, storage);
  std::multiset<Tetrahedron> wanted, found;
  std::array<std::vector<std::uint32_t>, 2> rows;  // [group]
  std::array<std::vector<Tetrahedron>, 2> groups;
  for (const auto& nodes : mesh::element_nodes(mesh)) {
    Tetrahedron one{};
    std::transform(nodes.begin(), nodes.end(), one.begin(),
                   [&](std::uint32_t node) { return layout.row_of_node[node]; });
    groups[wanted.size() % 3 == 0 ? 0 : 1].push_back(one);
    wanted.insert(canonical(one));
  }
  std::vector<ElementRows> views;
  for (std::size_t g = 0; g < 2; ++g) {
    for (std::size_t k = 0; k < 4; ++k) {
      for (const Tetrahedron& one : groups[g]) rows[g].push_back(one[k]);
    }
    const auto count = static_cast<std::uint32_t>(groups[g].size());
    views.push_back({4, count, count, rows[g]});
  }
  const PatchTetrahedra shared = share_out_tetrahedra(layout, views);
  ASSERT_EQ(shared.begin.size(), 2 * layout.patch_count + 1);
  std::uint32_t most = 0;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::uint32_t first = layout.patch_rows[patch], own = layout.patch_rows[patch + 1] - first;
    const std::uint32_t halo = layout.patch_halo[patch], locals = own + layout.patch_halo[patch + 1] - halo;
    most = std::max(most, shared.begin[2 * patch + 2] - shared.begin[2 * patch]);
    for (std::uint32_t t = shared.begin[2 * patch]; t < shared.begin[2 * patch + 2]; ++t) {
      Tetrahedron one{};
      bool has_halo = false;
      for (std::size_t k = 0; k < 4; ++k) {
        const std::uint32_t local = shared.rows[std::size_t{4} * t + k];
        ASSERT_LT(local, locals);
        has_halo = has_halo || local >= own;
        one[k] = local < own ? first + local : layout.halo[halo + local - own];
      }
      found.insert(canonical(one));
      EXPECT_EQ(has_halo, t >= shared.begin[2 * patch + 1]) << "own rows first";
    }
  }
  EXPECT_EQ(found, wanted);
  const auto mean = static_cast<double>(wanted.size()) / layout.patch_count;
  EXPECT_LT(most, 1.5 * mean + 1) << "the patch with the most is waited for";
}

TEST(PatchTetrahedra, AreSharedOutOnceAndAboutEvenly) {
  for (const Storage storage : {Storage::kRows, Storage::kTiles}) {
    for (const std::uint32_t patches : {1u, 2u, 5u, 16u}) {
      SCOPED_TRACE(patches);
      check(mesh::testing::random_mesh(3, 8, 0.7), patches, storage);
      check(mesh::testing::unit_grid(10), patches, storage);
    }
  }
}

/// In the order of the mesh 1.7 reads queue on average.
TEST(PatchTetrahedra, HaveFewBankConflicts) {
  const mesh::Mesh mesh = mesh::testing::unit_grid(20);
  const Layout layout = make_layout(mesh, 4, Storage::kTiles);
  std::vector<std::uint32_t> rows;
  const auto elements = mesh::element_nodes(mesh);
  for (std::size_t k = 0; k < 4; ++k) {
    for (const auto& nodes : elements) rows.push_back(layout.row_of_node[nodes[k]]);
  }
  const auto count = static_cast<std::uint32_t>(elements.size());
  const std::vector<ElementRows> groups{{4, count, count, rows}};
  const PatchTetrahedra shared = share_out_tetrahedra(layout, groups);
  for (std::uint32_t part = 0; part < 2 * layout.patch_count; ++part) {
    EXPECT_LT(reads_at_once(shared, part), 1.2) << part;
    EXPECT_GE(reads_at_once(shared, part), 1);
  }
}

/// det F in single precision against double precision, of tetrahedra that get flat at rest, now, or both.
TEST(PatchTetrahedra, VolumesHaveTheRightSignHoweverFlat) {
  for (const double height : {1.0, 1e-2, 1e-4, 1e-6}) {
    for (const double det_f : {2.0, 0.5, 1e-3, 1e-6, 0.0, -1e-6, -1e-3, -0.5}) {
      // Exact in single precision: powers of two, and far from the origin only where edges stay exact.
      const auto flat = static_cast<float>(std::exp2(std::round(std::log2(height))));
      const auto now = static_cast<float>(det_f) * flat;
      const Vec3<float> rest[4] = {{1, 1, 0}, {2, 1, 0}, {1, 2, 0}, {1.25f, 1.25f, flat}};
      const Vec3<float> moved[4] = {{8, 0, 0}, {8, 0, 0}, {8, 0, 0}, {8, 0, now - flat}};
      const double exact = static_cast<double>(flat + (now - flat)) / static_cast<double>(flat);
      const float computed = step::det_f_of_nodes(rest, moved);
      EXPECT_NEAR(computed, exact, 1e-6 * std::abs(exact)) << height << ", " << det_f;
      EXPECT_EQ(computed > 0, exact > 0) << height << ", " << det_f;
    }
  }
}

TEST(PatchTetrahedra, PaddingIsAtRest) {
  const Vec3<float> zero = Vec3<float>::Zero();
  const Vec3<float> rest[4] = {zero, zero, zero, zero};
  EXPECT_EQ(step::det_f_of_nodes(rest, rest), 1);
}

}  // namespace
}  // namespace tensormass::matrix
