#include "solver/jacobi_scaling.h"

#include <limits>

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "support/dense_system.h"
#include "support/staged_scene.h"

namespace tensormass::solver {
namespace {

template <class Real>
Mat3<Real> inverse_factor(const Mat3<Real>& d) {
  const Real upper[6] = {d(0, 0), d(0, 1), d(0, 2), d(1, 1), d(1, 2), d(2, 2)};
  Real out[8] = {};
  inverse_cholesky(upper, out);
  return load_lower<Real>(out, 0);
}

TEST(InverseCholesky, TurnsTheBlockIntoTheIdentity) {
  for (int trial = 0; trial < 100; ++trial) {
    const Mat3<double> root = Mat3<double>::Random() + 2 * Mat3<double>::Identity();
    const Mat3<double> d = root * root.transpose();
    const Mat3<double> l = inverse_factor<double>(d);
    EXPECT_LT((l * d * l.transpose() - Mat3<double>::Identity()).norm(), 1e-12);
    EXPECT_EQ(l(0, 1), 0);
  }
}

TEST(InverseCholesky, StaysFiniteWhereRoundingMadeAPivotNegative) {
  // One stiff direction, the others lost to rounding: contact on a light node.
  const Vec3<float> n = Vec3<float>(1, 2, 3).normalized();
  const Mat3<float> d = 1e6f * n * n.transpose() - 1e-3f * Mat3<float>::Identity();
  const Mat3<float> l = inverse_factor<float>(d);
  EXPECT_TRUE(l.allFinite());
  EXPECT_GT(l.diagonal().minCoeff(), 0);
  EXPECT_TRUE(inverse_factor<float>(Mat3<float>::Zero()).allFinite()) << "a padding row";
}

TEST(Scaling, GivesUnitBlocksAndTheScaledMatrix) {
  v1::Scene scene = tests::beam_scene({.cells_x = 3, .cells_y = 2, .cells_z = 2, .double_precision = true});
  tests::StagedScene<double> staged(scene, 2);
  staged.put(staged.view.state.displacement, tests::random_field(3 * staged.node_count(), 0.02, 5));
  staged.run_through(step::StageKind::kExternalForces);
  const Eigen::MatrixXd a = staged.matrix();
  const Eigen::VectorXd b = staged.by_node(staged.view.matrix.rhs);
  staged.run(step::StageKind::kFactorize);
  staged.run(step::StageKind::kScaleEdges);

  Eigen::MatrixXd l = Eigen::MatrixXd::Zero(a.rows(), a.cols());
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    if (staged.is_fixed(node)) continue;  // L⁻¹ = 0 takes a fixed node out
    const Mat3<double> block = a.block<3, 3>(3 * node, 3 * node);
    const Mat3<double> factor = Eigen::LLT<Mat3<double>>(block).matrixL();
    l.block<3, 3>(3 * node, 3 * node) = factor.inverse();
  }
  Eigen::MatrixXd scaled = l * a * l.transpose();
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) scaled.block<3, 3>(3 * node, 3 * node).setZero();
  EXPECT_LT((staged.matrix(false) - scaled).norm(), 1e-12 * scaled.norm());
  EXPECT_LT((staged.by_node(staged.view.matrix.rhs) - l * b).norm(), 1e-12 * (l * b).norm());
}

}  // namespace
}  // namespace tensormass::solver
