#include <gtest/gtest.h>
#include <Eigen/Geometry>

#include "physics/element/face.h"

namespace tensormass::physics {
namespace {

/// Returns a face on the unit square or triangle, bent by `bend`.
std::vector<Vec3<double>> face(int nodes, double bend = 0) {
  if (nodes == 4) return {{0, 0, 0}, {1, 0, bend}, {1, 1, 0}, {0, 1, bend}};
  std::vector<Vec3<double>> x{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
  if (nodes == 8) x = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};
  const auto corners = static_cast<int>(x.size());
  for (int k = 0; corners + k < nodes; ++k) {
    x.push_back((x[k] + x[(k + 1) % corners]) / 2 + Vec3<double>(0, 0, k % 2 == 0 ? bend : bend / 2));
  }
  return x;
}

bool is_quadrilateral(int nodes) { return nodes % 4 == 0; }

class EveryFace : public testing::TestWithParam<int> {};

TEST_P(EveryFace, PlaneFacesGiveTheirArea) {
  const auto x = face(GetParam());
  double area = 0;
  Vec3<double> vector = Vec3<double>::Zero();
  for (int k = 0; k < GetParam(); ++k) {
    area += face_area(x.data(), GetParam(), k);
    vector += face_area_vector(x.data(), GetParam(), k);
  }
  const double exact = is_quadrilateral(GetParam()) ? 1 : 0.5;
  EXPECT_NEAR(area, exact, 1e-14);
  EXPECT_LT((vector - Vec3<double>(0, 0, exact)).norm(), 1e-14);
  // The moment of a linear pressure field about the origin is exact, because shape functions reproduce it.
  double first = 0;
  for (int k = 0; k < GetParam(); ++k) first += face_area(x.data(), GetParam(), k) * x[static_cast<std::size_t>(k)][0];
  EXPECT_NEAR(first, is_quadrilateral(GetParam()) ? 0.5 : 1.0 / 6, 1e-14);
}

/// The vector area of a surface depends only on its rim.
TEST_P(EveryFace, BentFacesHaveTheVectorAreaOfTheirRim) {
  const auto x = face(GetParam(), 0.3);
  Vec3<double> vector = Vec3<double>::Zero();
  for (int k = 0; k < GetParam(); ++k) vector += face_area_vector(x.data(), GetParam(), k);
  Vec3<double> rim = Vec3<double>::Zero();
  if (GetParam() > 4) {
    // The rim gives ½ ∮ x × dx: a parabola for each side, integrated at Gauss points.
    const std::size_t corners = x.size() / 2;
    for (std::size_t e = 0; e < corners; ++e) {
      const Vec3<double>&a = x[e], &b = x[(e + 1) % corners], &m = x[corners + e];
      for (const double t : {0.21132486540518713, 0.78867513459481287}) {
        const Vec3<double> at = (1 - t) * (1 - 2 * t) * a + 4 * t * (1 - t) * m + t * (2 * t - 1) * b;
        const Vec3<double> slope = (4 * t - 3) * a + (4 - 8 * t) * m + (4 * t - 1) * b;
        rim += 0.25 * at.cross(slope);
      }
    }
  } else {
    for (std::size_t k = 0; k < x.size(); ++k) rim += 0.5 * x[k].cross(x[(k + 1) % x.size()]);
  }
  EXPECT_LT((vector - rim).norm(), 1e-13);
}

TEST_P(EveryFace, AreaVectorsChangeAsTheirDerivativeSays) {
  const int nodes = GetParam();
  const auto x = face(nodes, 0.3);
  const Vec3<double> step(1e-6, -2e-6, 3e-6);
  for (int k = 0; k < nodes; ++k) {
    for (int l = 0; l < nodes; ++l) {
      auto ahead = x, behind = x;
      ahead[static_cast<std::size_t>(l)] += step;
      behind[static_cast<std::size_t>(l)] -= step;
      const Vec3<double> change = face_area_vector(ahead.data(), nodes, k) - face_area_vector(behind.data(), nodes, k);
      EXPECT_LT((cross_matrix(face_area_change(x.data(), nodes, k, l)) * step * 2 - change).norm(), 1e-15);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Nodes, EveryFace, testing::Values(3, 4, 6, 8));

}  // namespace
}  // namespace tensormass::physics
