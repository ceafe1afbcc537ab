#include "solver/vector_updates.h"

#include <cmath>
#include <random>
#include <vector>

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "core/pack.h"

/// The updates that all solves share, in a plain solve of a dense system: with the update of x in every iteration, and
/// postponed as in the streamed solve.
namespace tensormass::solver {
namespace {

using Vectors = std::vector<Vec3<double>>;

double dot(const Vectors& a, const Vectors& b) {
  double sum = 0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i].dot(b[i]);
  return sum;
}

/// A random symmetric positive definite system of vectors of three.
struct System {
  Eigen::MatrixXd a;
  Vectors b;

  /// condition: the largest eigenvalue; the smallest is 1.
  System(std::size_t size, double condition, unsigned seed) : b(size) {
    std::mt19937 random(seed);
    std::normal_distribution<double> normal;
    const auto n = static_cast<Eigen::Index>(3 * size);
    const Eigen::MatrixXd noise = Eigen::MatrixXd::NullaryExpr(n, n, [&] { return normal(random); });
    const Eigen::MatrixXd q = noise.householderQr().householderQ();
    a = q * Eigen::VectorXd::LinSpaced(n, 1, condition).asDiagonal() * q.transpose();
    for (Vec3<double>& v : b) v = {normal(random), normal(random), normal(random)};
  }
  Vectors product(const Vectors& p) const {
    Vectors q(p.size(), Vec3<double>::Zero());
    for (std::size_t i = 0; i < p.size(); ++i) {
      for (std::size_t j = 0; j < p.size(); ++j) {
        q[i] += a.block<3, 3>(static_cast<Eigen::Index>(3 * i), static_cast<Eigen::Index>(3 * j)) * p[j];
      }
    }
    return q;
  }
  Eigen::VectorXd dense_solution() const {
    Eigen::VectorXd rhs(3 * static_cast<Eigen::Index>(b.size()));
    for (std::size_t i = 0; i < b.size(); ++i) rhs.segment<3>(static_cast<Eigen::Index>(3 * i)) = b[i];
    return a.ldlt().solve(rhs);
  }
};

/// Returns x after some iterations; postponed: how many of them have postponed the update.
Vectors solve(const System& system, int iterations, bool postpones, int* postponed = nullptr) {
  Vectors x(system.b.size(), Vec3<double>::Zero()), r = system.b, p = r;
  double gamma = 0;
  for (int i = 0; i < iterations; ++i) {
    const Vectors q = system.product(p);
    const double rr = dot(r, r), alpha = rr / dot(p, q);
    Vectors next = r;
    for (std::size_t k = 0; k < r.size(); ++k) next[k] = next_residual(r[k], q[k], alpha);
    const double beta = dot(next, next) / rr;
    const bool later = postpones && may_postpone(gamma, beta);
    for (std::size_t k = 0; k < r.size(); ++k) {
      if (!postpones) {
        x[k] = next_solution(x[k], p[k], alpha);
      } else if (!later) {
        x[k] = solution_with_postponed(x[k], p[k], r[k], alpha, gamma);
      }
      p[k] = next_direction(next[k], p[k], beta);
    }
    r = next;
    gamma = later ? alpha / beta : 0;
    if (postponed != nullptr) *postponed += later ? 1 : 0;
  }
  if (gamma != 0) {
    for (std::size_t k = 0; k < r.size(); ++k) x[k] = postponed_solution(x[k], p[k], r[k], gamma);
  }
  return x;
}

double largest_difference(const Vectors& a, const Vectors& b) {
  double largest = 0;
  for (std::size_t i = 0; i < a.size(); ++i) largest = std::max(largest, (a[i] - b[i]).norm());
  return largest;
}

TEST(VectorUpdates, SolveADenseSystem) {
  const System system(8, 30, 1);
  const Eigen::VectorXd expected = system.dense_solution();
  for (const bool postpones : {false, true}) {
    const Vectors x = solve(system, 24, postpones);  // as many as unknowns: the exact solution but for rounding
    for (std::size_t i = 0; i < x.size(); ++i) {
      EXPECT_LT((x[i] - expected.segment<3>(static_cast<Eigen::Index>(3 * i))).norm(), 1e-10 * expected.norm());
    }
  }
}

TEST(VectorUpdates, PostponingGivesTheSameSolutionAfterAnyNumberOfIterations) {
  // A condition near 1 makes β small, and then nothing is postponed.
  for (const double condition : {1.1, 30.0, 1000.0}) {
    const System system(8, condition, 2);
    for (int iterations = 0; iterations <= 9; ++iterations) {
      int postponed = 0;
      const Vectors x = solve(system, iterations, false), later = solve(system, iterations, true, &postponed);
      EXPECT_LT(largest_difference(x, later), 1e-13 * (1 + std::sqrt(dot(x, x)))) << iterations << " iterations";
      EXPECT_EQ(postponed, condition < 2 ? 0 : (iterations + 1) / 2);
    }
  }
}

TEST(VectorUpdates, PostponeOnlyEveryOtherUpdateAndNoneWithASmallBeta) {
  EXPECT_TRUE(may_postpone(0.0f, 0.5f));
  EXPECT_FALSE(may_postpone(2.0f, 0.5f));
  EXPECT_FALSE(may_postpone(0.0f, 0.04f));
}

TEST(VectorUpdates, ComputeTheSameForNumbersAndInEachLaneOfAPack) {
  using Lanes = NativeLanes<float>;
  std::mt19937 random(3);
  std::normal_distribution<float> normal;
  std::vector<float> x(Lanes::kWidth), r(x), p(x), q(x);
  for (std::vector<float>* values : {&x, &r, &p, &q}) {
    for (float& value : *values) value = normal(random);
  }
  const float alpha = 0.7f, beta = 0.3f;
  const Lanes::Scalar lanes_p = Lanes::load(p.data());
  const Lanes::Scalar lanes_x = next_solution(Lanes::load(x.data()), lanes_p, Lanes::Scalar(alpha));
  const Lanes::Scalar lanes_r = next_residual(Lanes::load(r.data()), Lanes::load(q.data()), Lanes::Scalar(alpha));
  const Lanes::Scalar next = next_direction(lanes_r, lanes_p, Lanes::Scalar(beta));
  for (std::uint32_t lane = 0; lane < Lanes::kWidth; ++lane) {
    const float residual = next_residual(r[lane], q[lane], alpha);
    EXPECT_EQ(lanes_x.v[lane], next_solution(x[lane], p[lane], alpha));
    EXPECT_EQ(lanes_r.v[lane], residual);
    EXPECT_EQ(next.v[lane], next_direction(residual, p[lane], beta));
  }
}

}  // namespace
}  // namespace tensormass::solver
