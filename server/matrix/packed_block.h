#pragma once

#include <bit>
#include <cmath>
#include <cstdint>

#include "core/scalar.h"

/// A scaled matrix (solver/jacobi_scaling.h) in two thirds of its bytes, where a solve reads it from memory in every
/// iteration and waits for little else: block floating point, and a diagonal that takes back what rounding does to
/// motions of many rows together.
///
/// Rounded by itself, a matrix resists what it should let pass: where all cells are alike their blocks are rounded
/// alike, a row's blocks no longer add up to its mass, and that was ten times the error that float makes of a beam's
/// motion (docs/performance.md). So each row adds up what its blocks have lost, and its diagonal block, which is the
/// unit matrix, is given that: neighbours that move together then find the row as it was. What is left is less than
/// float's own (tests/gpu/agreement_test.cpp).
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
/// The largest n for which 2ⁿ is not above x; far below zero for zero.
TM_HOST_DEVICE inline int exponent_of(float x) { return static_cast<int>(bits_of(x) >> 23) - 127; }
/// The whole number next to x in [−most − 1, most], in two's complement.
TM_HOST_DEVICE inline std::uint32_t rounded(float x, std::int32_t most) {
  constexpr float kShift = 1.5f * (1 << 23);  // adding it leaves whole numbers, in the low bits
  const float within = minimum(maximum(x, static_cast<float>(-most - 1)), static_cast<float>(most));
  return bits_of(within + kShift) - bits_of(kShift);
}

}  // namespace detail

/// A block off the diagonal in 24 bytes for 36: nine numbers of 21 bits and an exponent of three. The numbers are
/// multiples of 2⁻²⁰ R, where R is a power of two from 2⁻⁶ to 2 and above the largest of them.
///
/// Of a positive definite matrix with unit diagonal blocks no number is beyond 1. What is beyond 2 becomes ±2, which
/// leaves the matrix indefinite, as it was. What is no number becomes one: the row's diagonal block, which sums up the
/// others, is none either, and with it the right-hand side that the solve begins with.
struct PackedBlock {
  /// By pairs, low word first: 21 bits of the first number, the lower 11 of the third; the upper 10 of the third, a bit
  /// of the exponent, 21 bits of the second.
  std::uint32_t words[6];

  /// block: row by row.
  TM_HOST_DEVICE static PackedBlock of(const float* block) {
    using std::abs;
    float largest = 0;
    for (int c = 0; c < 9; ++c) largest = maximum(largest, abs(block[c]));
    // R = 2^(1 − halvings)
    const int halvings = minimum(maximum(-detail::exponent_of(largest), 0), kMostHalvings);
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

  /// The words of each pair of a block of zeros.
  static constexpr std::uint32_t kZeroWords[2] = {1u << 20, 1u << 9 | 1u << 31};

  /// block: row by row. In few instructions, as this is done in every iteration: a field becomes the low bits of a
  /// float of the right exponent, from which the one is taken that stands for zero.
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
  static constexpr int kMostHalvings = 7;
};

/// Symmetric 3×3: its upper triangle, xx xy xz yy yz zz.
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

/// What a block has lost when it was packed: its symmetric part, which is that of the transposed block, too.
TM_HOST_DEVICE inline UpperTriangle lost(const float* block, const float* unpacked) {
  const auto of = [&](int a, int b) { return ((block[a] - unpacked[a]) + (block[b] - unpacked[b])) / 2; };
  return {of(0, 0), of(1, 3), of(2, 6), of(4, 4), of(5, 7), of(8, 8)};
}

/// The sum of what a row's blocks have lost, in 8 bytes: six numbers of ten bits and an exponent of four. They are
/// multiples of a power of two from 2⁻⁴⁰ to 2⁻²⁵, up to 2⁻¹⁶: blocks whose numbers are not beyond 1 lose no more.
struct PackedDiagonal {
  std::uint32_t words[2];

  TM_HOST_DEVICE static PackedDiagonal of(const UpperTriangle& sum) {
    using std::abs;
    const float numbers[6] = {sum.xx, sum.xy, sum.xz, sum.yy, sum.yz, sum.zz};
    float largest = 0;
    for (const float number : numbers) largest = maximum(largest, abs(number));
    const int exponent = minimum(maximum(detail::exponent_of(largest) + 1 - kBits + 1 - kLeast, 0), kMostDoublings);
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
  static constexpr int kBits = 10, kMask = (1 << kBits) - 1, kLeast = -40, kMostDoublings = 15;
};

}  // namespace tensormass::matrix
