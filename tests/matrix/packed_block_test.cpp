#include "matrix/packed_block.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

#include <gtest/gtest.h>

namespace tensormass::matrix {
namespace {

struct Block {
  float numbers[9];
  float largest() const {
    float largest = 0;
    for (const float number : numbers) largest = std::max(largest, std::abs(number));
    return largest;
  }
  Block unpacked() const {
    Block out;
    PackedBlock::of(numbers).unpack(out.numbers);
    return out;
  }
};

Block random_block(std::mt19937& random, float scale) {
  std::uniform_real_distribution<float> number(-scale, scale);
  Block block;
  for (float& n : block.numbers) n = number(random);
  return block;
}

TEST(PackedBlock, ErrorIsAMillionthOfTheLargestEntry) {
  std::mt19937 random(1);
  for (const float scale : {2.0f, 1.0f, 0.5f, 0.3f, 0.1f, 0.01f}) {
    double worst = 0;
    for (int i = 0; i < 10'000; ++i) {
      const Block block = random_block(random, scale), back = block.unpacked();
      const float unit = std::max(block.largest(), 0x1p-7f);
      for (int c = 0; c < 9; ++c) {
        // The largest representable entry is one step below R.
        const double allowed = block.numbers[c] > 0.999f * block.largest() ? 0x1p-19 : 0x1p-20;
        EXPECT_LE(std::abs(back.numbers[c] - block.numbers[c]), allowed * unit);
        worst = std::max(worst, std::abs(double{back.numbers[c]} - double{block.numbers[c]}) / double{unit});
      }
    }
    EXPECT_GT(worst, 0x1p-22) << "else it is not what this test takes it for";
  }
}

TEST(PackedBlock, KeepsRepresentableEntriesExactly) {
  for (const float number : {0.0f, 1.0f, -1.0f, -2.0f, 0.5f, 0.75f, -0.0625f, 0x1p-25f, 3 * 0x1p-20f}) {
    const Block back = Block{{0, number, 0, -number / 2, 0, 0, 0, 0, number}}.unpacked();
    EXPECT_EQ(back.numbers[1], number);
    EXPECT_EQ(back.numbers[3], -number / 2);
    EXPECT_EQ(back.numbers[8], number);
    for (const int c : {0, 2, 4, 5, 6, 7}) EXPECT_EQ(back.numbers[c], 0);
  }
}

TEST(PackedBlock, PacksTheTransposeAsTheTranspose) {
  std::mt19937 random(2);
  for (int i = 0; i < 1000; ++i) {
    const Block block = random_block(random, 0.4f), back = block.unpacked();
    Block transposed;
    for (int c = 0; c < 9; ++c) transposed.numbers[c] = block.numbers[c % 3 * 3 + c / 3];
    const Block other = transposed.unpacked();
    for (int c = 0; c < 9; ++c) EXPECT_EQ(other.numbers[c], back.numbers[c % 3 * 3 + c / 3]);
  }
}

TEST(PackedBlock, ClampsLargeEntriesToTwo) {
  for (const float number : {2.0f, 17.0f, 1e30f, std::numeric_limits<float>::infinity()}) {
    const Block back = Block{{number, -number, 0.5f, 0, 0, 0, 0, 0, 0}}.unpacked();
    EXPECT_NEAR(back.numbers[0], 2, 1e-5);
    EXPECT_EQ(back.numbers[1], -2);
    EXPECT_EQ(back.numbers[2], 0.5f);
  }
}

TEST(PackedBlock, ZerosAreZeros) {
  PackedBlock zeros;
  for (int word = 0; word < 6; ++word) zeros.words[word] = PackedBlock::kZeroWords[word % 2];
  Block block;
  zeros.unpack(block.numbers);
  for (const float number : block.numbers) EXPECT_EQ(number, 0);
}

TEST(PackedDiagonal, ErrorIsAFiveHundredthOfTheLargestEntry) {
  std::mt19937 random(3);
  for (const float scale : {0x1p-17f, 1e-6f, 3e-8f, 1e-9f}) {
    std::uniform_real_distribution<float> number(-scale, scale);
    for (int i = 0; i < 1000; ++i) {
      const UpperTriangle sum{number(random), number(random), number(random),
                              number(random), number(random), number(random)};
      const UpperTriangle back = PackedDiagonal::of(sum).unpacked();
      for (const auto of : {&UpperTriangle::xx, &UpperTriangle::xy, &UpperTriangle::xz, &UpperTriangle::yy,
                            &UpperTriangle::yz, &UpperTriangle::zz}) {
        EXPECT_NEAR(back.*of, sum.*of, scale / 500);
      }
    }
  }
  EXPECT_EQ(PackedDiagonal{}.unpacked().xx, 0);
  EXPECT_EQ(PackedDiagonal::of({}).unpacked().zz, 0);
}

TEST(PackedDiagonal, StaysFiniteWhereBlocksAreOutOfRange) {
  const float infinity = std::numeric_limits<float>::infinity();
  const UpperTriangle back = PackedDiagonal::of({infinity, -infinity, 1, 0, 0, -1e20f}).unpacked();
  for (const float number : {back.xx, -back.xy, back.xz, -back.zz}) EXPECT_NEAR(number, 0x1p-16f, 0x1p-24f);
  EXPECT_EQ(back.yy, 0);
}

/// Neighbours that move together feel the exact row, although each block is rounded.
TEST(PackedDiagonal, CancelsTheRoundingErrorsOfARow) {
  std::mt19937 random(4);
  double worst_with = 0, worst_without = 0;
  for (int i = 0; i < 1000; ++i) {
    // A row of a structured mesh: the blocks of both sides are equal, and so are their errors.
    UpperTriangle sum;
    Vec3<double> exact(0, 0, 0), without(0, 0, 0);
    const Vec3<float> motion(1, -0.5f, 0.25f);
    for (int pair = 0; pair < 7; ++pair) {
      Block block = random_block(random, 0.2f);
      for (int a = 0; a < 3; ++a) {
        for (int b = 0; b < a; ++b) block.numbers[3 * a + b] = block.numbers[3 * b + a];
      }
      const Block back = block.unpacked();
      for (int side = 0; side < 2; ++side) {
        sum += lost(block.numbers, back.numbers);
        for (int c = 0; c < 9; ++c) {
          exact[c / 3] += double{block.numbers[c]} * double{motion[c % 3]};
          without[c / 3] += double{back.numbers[c]} * double{motion[c % 3]};
        }
      }
    }
    const Vec3<double> with = without + (PackedDiagonal::of(sum).unpacked() * motion).cast<double>();
    worst_with = std::max(worst_with, (with - exact).norm());
    worst_without = std::max(worst_without, (without - exact).norm());
  }
  EXPECT_LT(worst_with, 1e-8);
  EXPECT_GT(worst_without, 1e-6);
}

}  // namespace
}  // namespace tensormass::matrix
