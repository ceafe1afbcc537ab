#include "core/pack.h"

#include <cmath>
#include <limits>
#include <numeric>
#include <vector>

#include <gtest/gtest.h>

/// Each lane of a pack computes bitwise what a number computes, and moves to and from memory without mixing lanes.
namespace tensormass {
namespace {

template <class Lanes>
class EveryWidth : public ::testing::Test {};
using Widths = ::testing::Types<NativeLanes<float>, NativeLanes<double>>;
TYPED_TEST_SUITE(EveryWidth, Widths);

TYPED_TEST(EveryWidth, MovesVectorsWithoutMixingLanesOrTouchingNeighbours) {
  using Real = typename TypeParam::Real;
  constexpr std::uint32_t kWidth = TypeParam::kWidth;
  std::vector<Real> vectors(4 * 4 * kWidth);
  std::iota(vectors.begin(), vectors.end(), Real(1));
  std::uint32_t index[kWidth];
  for (std::uint32_t lane = 0; lane < kWidth; ++lane) index[lane] = (7 * lane + 3) % (4 * kWidth);

  const auto loaded = TypeParam::load3(vectors.data(), 2);
  const auto gathered = TypeParam::gather3(vectors.data(), index);
  for (std::uint32_t lane = 0; lane < kWidth; ++lane) {
    for (std::uint32_t c = 0; c < 3; ++c) {
      EXPECT_EQ(loaded[c].v[lane], vectors[4 * (2 + lane) + c]);
      EXPECT_EQ(gathered[c].v[lane], vectors[4 * index[lane] + c]);
    }
  }

  std::vector<Real> out(vectors.size(), Real(-1));
  TypeParam::store3(out.data(), 2, loaded);
  for (std::size_t i = 0; i < out.size(); ++i) {
    if (i % 4 == 3) continue;  // padding
    const bool written = i / 4 >= 2 && i / 4 < 2 + kWidth;
    EXPECT_EQ(out[i], written ? vectors[i] : Real(-1)) << "at " << i;
  }
}

TYPED_TEST(EveryWidth, ScattersEachLaneIntoItsOwnRecord) {
  using Real = typename TypeParam::Real;
  constexpr std::uint32_t kWidth = TypeParam::kWidth, kCount = 2 * kWidth, kStride = kCount + 3;
  typename TypeParam::Scalar values[kCount];
  for (std::uint32_t c = 0; c < kCount; ++c) {
    for (std::uint32_t lane = 0; lane < kWidth; ++lane) values[c].v[lane] = static_cast<Real>(100 * lane + c);
  }
  std::vector<Real> records(kStride * kWidth, Real(-1));
  TypeParam::scatter(records.data(), kStride, values);
  for (std::uint32_t i = 0; i < records.size(); ++i) {
    const std::uint32_t lane = i / kStride, c = i % kStride;
    EXPECT_EQ(records[i], c < kCount ? static_cast<Real>(100 * lane + c) : Real(-1)) << "lane " << lane << ", " << c;
  }
}

TYPED_TEST(EveryWidth, SumsItsLanes) {
  using Real = typename TypeParam::Real;
  std::vector<Real> values(TypeParam::kWidth);
  std::iota(values.begin(), values.end(), Real(1));
  EXPECT_EQ(TypeParam::sum(TypeParam::load(values.data())), std::accumulate(values.begin(), values.end(), Real(0)));
}

TYPED_TEST(EveryWidth, FindsTheLargestOfItsLanes) {
  using Real = typename TypeParam::Real;
  for (std::uint32_t lane = 0; lane < TypeParam::kWidth; ++lane) {
    typename TypeParam::Scalar values(-2);
    values.v[lane] = Real(-1);
    EXPECT_EQ(TypeParam::largest(values), Real(-1)) << "lane " << lane;
  }
}

TYPED_TEST(EveryWidth, ComparesAsNumbersDo) {
  using Real = typename TypeParam::Real;
  const Real nan = std::numeric_limits<Real>::quiet_NaN();
  const std::pair<Real, Real> cases[] = {{1, 2}, {2, 1}, {-1, 1}, {3, 3}, {nan, 1}, {1, nan}};
  const auto same = [](Real a, Real b) { return a == b || (std::isnan(a) && std::isnan(b)); };
  for (const auto& [a, b] : cases) {
    const typename TypeParam::Scalar pa(a), pb(b);
    EXPECT_TRUE(same(minimum(pa, pb).v[0], minimum(a, b))) << a << " " << b;
    EXPECT_TRUE(same(maximum(pa, pb).v[1], maximum(a, b))) << a << " " << b;
    EXPECT_TRUE(same(absolute(pa).v[0], absolute(a))) << a;
  }
}

TYPED_TEST(EveryWidth, ComputesElementaryFunctionsInEachLane) {
  using Real = typename TypeParam::Real;
  using T = typename TypeParam::Scalar;
  T a, b;
  for (std::uint32_t lane = 0; lane < TypeParam::kWidth; ++lane) {
    a.v[lane] = Real(0.3) * static_cast<Real>(lane * lane);
    b.v[lane] = static_cast<Real>(lane) / 2;
  }
  const T root = square_root(a), power = exponential(a), log = logarithm(a), sine = hyperbolic_sine(a);
  const T selected = select_greater(a, b, T(1), b);
  for (std::uint32_t lane = 0; lane < TypeParam::kWidth; ++lane) {
    const Real x = a.v[lane];
    EXPECT_EQ(root.v[lane], std::sqrt(x));
    EXPECT_EQ(power.v[lane], std::exp(x));
    EXPECT_EQ(log.v[lane], std::log(x));
    EXPECT_EQ(sine.v[lane], std::sinh(x));
    EXPECT_EQ(selected.v[lane], select_greater(x, Real(b.v[lane]), Real(1), Real(b.v[lane])));
  }
  EXPECT_TRUE(std::isnan(square_root(T(-1)).v[0]));
  const T nan(std::numeric_limits<Real>::quiet_NaN());
  EXPECT_EQ(select_greater(nan, a, T(1), T(2)).v[1], 2);
  EXPECT_EQ(select_greater(a, nan, T(1), T(2)).v[1], 2);
}

}  // namespace
}  // namespace tensormass
