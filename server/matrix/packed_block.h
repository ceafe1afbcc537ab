#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

#include "core/scalar.h"

/// The scaled matrix (solver/jacobi_scaling.h) in two thirds of its bytes.
///
/// Why: a solve that streams the matrix from memory is as fast as its reads. Blocks off the diagonal are stored as
/// block floating point: nine integers and a common exponent.
///
/// Rounding blocks independently breaks the row sums, so rigid motion becomes stiff. In a mesh of equal cells all
/// blocks are rounded alike, and a beam's motion had ten times the error of float (docs/performance.md). Each row
/// therefore adds the rounding errors of its blocks to its diagonal block, which scaling has made the unit matrix:
///
///   Â_ii = I + Σ_j lost(Â_ij)        neighbours that move together then feel the exact row
///
/// The error that remains is below that of float (tests/backend/agreement_test.cpp).
///
///   Â     the scaled matrix; its diagonal blocks are I, and no entry exceeds 1 if it is positive definite
///   lost  a block minus its packed value
namespace tensormass::matrix {

namespace detail {

#if defined(__CUDA_ARCH__)
__device__ inline std::uint32_t bits_of(float x) { return __float_as_uint(x); }
__device__ inline float float_of(std::uint32_t bits) { return __uint_as_float(bits); }
#else
inline std::uint32_t bits_of(float x) { return std::bit_cast<std::uint32_t>(x); }
inline float float_of(std::uint32_t bits) { return std::bit_cast<float>(bits); }
#endif

TM_HOST_DEVICE inline float power_of_two(int exponent) {
  return float_of(static_cast<std::uint32_t>(127 + exponent) << 23);
}
/// Returns the largest n with 2ⁿ ≤ x for x > 0; -127 for zero.
TM_HOST_DEVICE inline int exponent_of(float x) { return static_cast<int>(bits_of(x) >> 23) - 127; }
/// Returns the integer nearest to x, clamped to [−most − 1, most], in two's complement.
TM_HOST_DEVICE inline std::uint32_t rounded(float x, std::int32_t most) {
  constexpr float kShift = 1.5f * (1 << 23);  // adding it rounds to an integer, which is then in the low bits
  const float within = minimum(maximum(x, static_cast<float>(-most - 1)), static_cast<float>(most));
  return bits_of(within + kShift) - bits_of(kShift);
}

}  // namespace detail

/// A block off the diagonal in 24 bytes instead of 36: nine integers of 21 bits and an exponent of 3 bits. An entry is
/// an integer times 2⁻²⁰ R. R is a power of two between 2⁻⁶ and 2, above the largest entry.
///
/// Entries beyond ±2 become ±2. Only an indefinite matrix has such entries, and it stays indefinite. NaN packs to a
/// finite value, but the row's diagonal block sums up all blocks and is then NaN. So is the right-hand side, and the
/// solve still reports it.
struct PackedBlock {
  /// Three pairs of words, one for each row (a, b, c) of the block. The bits of a pair, lowest first:
  ///
  ///   low word    21 bits of a, lower 11 bits of c
  ///   high word   upper 10 bits of c, 1 bit of the exponent, 21 bits of b
  std::uint32_t words[6];

  /// block: row by row.
  TM_HOST_DEVICE static PackedBlock of(const float* block) {
    using std::abs;
    float largest = 0;
    for (int c = 0; c < 9; ++c) largest = maximum(largest, abs(block[c]));
    // R = 2^(1 − halvings)
    const int halvings = minimum(maximum(-detail::exponent_of(largest), 0), kMaxHalvings);
    const float steps = detail::power_of_two(20 - 1 + halvings);  // 1 in multiples of 2⁻²⁰ R
    PackedBlock packed;
    for (int pair = 0; pair < 3; ++pair) {
      std::uint32_t field[3];
      for (int c = 0; c < 3; ++c) {
        field[c] = (detail::rounded(block[3 * pair + c] * steps, kZero - 1) + kZero) & kMask;
      }
      packed.words[2 * pair] = field[0] | field[2] << 21;
      packed.words[2 * pair + 1] =
          field[2] >> 11 | (static_cast<std::uint32_t>(halvings) >> pair & 1) << 10 | field[1] << 11;
    }
    return packed;
  }

  /// Each pair of words of a zero block.
  static constexpr std::uint32_t kZeroWords[2] = {1u << 20, 1u << 9 | 1u << 31};

  /// block: row by row. Takes few instructions, because every iteration unpacks every block: an integer becomes the low
  /// bits of a float with the right exponent. Subtracting the float that stands for zero leaves the entry.
  TM_HOST_DEVICE void unpack(float* block) const {
    const std::uint32_t halvings = (words[1] >> 10 & 1) | (words[3] >> 9 & 2) | (words[5] >> 8 & 4);
    const std::uint32_t exponent = (127 + 3 + 1 - halvings) << 23;
    const float zero = detail::float_of(exponent | kZero);
    for (int pair = 0; pair < 3; ++pair) {
      const std::uint32_t low = words[2 * pair], high = words[2 * pair + 1];
      block[3 * pair] = detail::float_of((low & kMask) | exponent) - zero;
      block[3 * pair + 1] = detail::float_of(high >> 11 | exponent) - zero;
      block[3 * pair + 2] = detail::float_of(((high << 11 | low >> 21) & kMask) | exponent) - zero;
    }
  }

 private:
  static constexpr std::uint32_t kMask = (1u << 21) - 1, kZero = 1u << 20;
  static constexpr int kMaxHalvings = 7;
};

/// The upper triangle of a symmetric 3×3 matrix.
struct UpperTriangle {
  float xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;

  TM_HOST_DEVICE void operator+=(const UpperTriangle& o) {
    xx += o.xx;
    xy += o.xy;
    xz += o.xz;
    yy += o.yy;
    yz += o.yz;
    zz += o.zz;
  }
  TM_HOST_DEVICE Vec3<float> operator*(const Vec3<float>& v) const {
    return {xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2], xz * v[0] + yz * v[1] + zz * v[2]};
  }
};

/// Returns the symmetric part of the error that packing made. It is the same for a block and its transpose.
TM_HOST_DEVICE inline UpperTriangle lost(const float* block, const float* unpacked) {
  const auto of = [&](int a, int b) { return ((block[a] - unpacked[a]) + (block[b] - unpacked[b])) / 2; };
  return {of(0, 0), of(1, 3), of(2, 6), of(4, 4), of(5, 7), of(8, 8)};
}

/// The sum of the errors of a row's blocks in 8 bytes: six integers of 10 bits and an exponent of 4 bits. The integers
/// count a power of two from 2⁻⁴⁰ to 2⁻²⁵. Sums reach 2⁻¹⁶, which is enough for blocks with entries up to 1.
struct PackedDiagonal {
  std::uint32_t words[2];

  TM_HOST_DEVICE static PackedDiagonal of(const UpperTriangle& sum) {
    using std::abs;
    const float numbers[6] = {sum.xx, sum.xy, sum.xz, sum.yy, sum.yz, sum.zz};
    float largest = 0;
    for (const float number : numbers) largest = maximum(largest, abs(number));
    const int exponent = minimum(maximum(detail::exponent_of(largest) + 1 - kBits + 1 - kLeast, 0), kMaxDoublings);
    const float steps = detail::power_of_two(-kLeast - exponent);
    PackedDiagonal packed{};
    for (int c = 0; c < 6; ++c) {
      packed.words[c / 3] |= (detail::rounded(numbers[c] * steps, kMask / 2) & kMask) << c % 3 * kBits;
    }
    packed.words[0] |= static_cast<std::uint32_t>(exponent) << 3 * kBits;
    packed.words[1] |= static_cast<std::uint32_t>(exponent) >> 2 << 3 * kBits;
    return packed;
  }
  TM_HOST_DEVICE UpperTriangle unpacked() const {
    const auto exponent = static_cast<int>(words[0] >> 3 * kBits | words[1] >> 3 * kBits << 2);
    const float step = detail::power_of_two(kLeast + exponent);
    const auto number = [&](int c) {
      const std::uint32_t at_top = words[c / 3] << (32 - kBits - c % 3 * kBits);
      return static_cast<float>(static_cast<std::int32_t>(at_top) >> (32 - kBits)) * step;
    };
    return {number(0), number(1), number(2), number(3), number(4), number(5)};
  }

 private:
  static constexpr int kBits = 10, kMask = (1 << kBits) - 1, kLeast = -40, kMaxDoublings = 15;
};

}  // namespace tensormass::matrix
