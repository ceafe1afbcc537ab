#include "core/pack.h"

#include <cmath>
#include <limits>
#include <numeric>

#include "physics/pairs.h"

/// A pack must compute in each lane what a number computes.
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
    if (i % 4 == 3) continue;  // nobody's
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

template <class P>
class EveryLawInPacks : public ::testing::Test {};
TYPED_TEST_SUITE(EveryLawInPacks, physics::testing::AllPairs, physics::testing::PairNames);

TYPED_TEST(EveryLawInPacks, EachLaneIsTheScalarResult) {
  using Shape = typename TypeParam::Shape;
  using Law = typename TypeParam::Law;
  using Lanes = NativeLanes<double>;
  using T = typename Lanes::Scalar;
  constexpr int kWidth = Lanes::kWidth;

  std::mt19937 random(23);
  std::vector<physics::testing::Element<Shape>> elements;
  std::vector<physics::testing::Displacement<Shape>> states;
  T rest[Shape::kQuadraturePoints][Shape::kRestReals], parameters[Law::kParameterCount];
  Vec3<T> u[Shape::kNodes];
  for (int lane = 0; lane < kWidth; ++lane) {
    elements.emplace_back(random);
    // From mild to severe, so that some lanes are indefinite before the shift and others are not.
    states.push_back(physics::testing::Displacement<Shape>::random(random, 2e-3 * (lane + 1)));
    for (int q = 0; q < Shape::kQuadraturePoints; ++q) {
      for (int c = 0; c < Shape::kRestReals; ++c) rest[q][c].v[lane] = elements[lane].rest[q][c];
    }
    for (int c = 0; c < Law::kParameterCount; ++c) {
      parameters[c].v[lane] = (1 + 0.1 * lane) * physics::testing::parameters<Law>()[c];
    }
    for (int i = 0; i < states[lane].kSize; ++i) u[i / 3][i % 3].v[lane] = states[lane][i];
  }
  const auto packed = physics::element_tensors<Shape, Law, physics::Stiffness::kPositive>(u, rest, parameters);

  for (int lane = 0; lane < kWidth; ++lane) {
    auto own = physics::testing::parameters<Law>();
    for (double& parameter : own) parameter *= 1 + 0.1 * lane;
    const auto expected = physics::element_tensors<Shape, Law, physics::Stiffness::kPositive>(
        states[lane].u, elements[lane].rest, own.data());
    physics::ElementTensors<Shape, double> actual;
    for (int k = 0; k < Shape::kNodes; ++k) {
      for (int c = 0; c < 3; ++c) actual.force[k][c] = packed.force[k][c].v[lane];
    }
    for (int pair = 0; pair < physics::kPairs<Shape::kNodes>; ++pair) {
      for (int c = 0; c < 9; ++c) actual.edge_stiffness[pair](c) = packed.edge_stiffness[pair](c).v[lane];
    }
    // Equal but for where the compiler fuses a multiplication with an addition.
    const Eigen::MatrixXd k = physics::testing::stiffness(expected);
    EXPECT_LT((physics::testing::stiffness(actual) - k).norm(), 1e-14 * k.norm());
    const Eigen::VectorXd f = physics::testing::force(expected);
    EXPECT_LT((physics::testing::force(actual) - f).norm(), 1e-13 * k.norm() * 1e-2 + 1e-14 * f.norm());
  }
}

}  // namespace
}  // namespace tensormass
