#include "physics/pairs.h"

/// What every law in every shape must satisfy. The list of pairs is physics/lists.h's own: a new line there is tested
/// here without a change.
namespace tensormass::physics {
namespace {

using testing::Element;
using testing::kPoissonRatio;
using testing::kYoungModulusPa;

template <class P>
class EveryLaw : public ::testing::Test {
 protected:
  using S = typename P::Shape;
  using L = typename P::Law;
  using Displacement = testing::Displacement<S>;

  double energy(const Displacement& d) const { return element_energy<S, L>(d.u, element_.rest, parameters_.data()); }
  template <Stiffness Kind = Stiffness::kConsistent>
  ElementTensors<S, double> tensors(const Displacement& d) const {
    return element_tensors<S, L, Kind>(d.u, element_.rest, parameters_.data());
  }
  Displacement affine(const Mat3<double>& f) const { return Displacement::affine(element_, f); }
  /// E V^(1/3), a stiffness to measure others by [N/m].
  double scale() const { return kYoungModulusPa * 0.02; }

  std::mt19937 random_{11};
  const Element<S> element_{random_};
  const std::array<double, L::kParameterCount> parameters_ = testing::parameters<L>();
};

TYPED_TEST_SUITE(EveryLaw, testing::AllPairs, testing::PairNames);

TYPED_TEST(EveryLaw, ForceIsMinusTheGradientOfTheEnergy) {
  for (int trial = 0; trial < 20; ++trial) {
    auto d = TestFixture::Displacement::random(this->random_, 4e-3);
    const Eigen::VectorXd force = testing::force(this->tensors(d));
    const double h = 1e-7;
    for (int i = 0; i < d.kSize; ++i) {
      const double at = d[i];
      d[i] = at + h;
      const double above = this->energy(d);
      d[i] = at - h;
      const double below = this->energy(d);
      d[i] = at;
      ASSERT_NEAR(force[i], -(above - below) / (2 * h), 1e-6 * force.norm()) << "component " << i;
    }
  }
}

TYPED_TEST(EveryLaw, StiffnessIsMinusTheDerivativeOfTheForce) {
  for (int trial = 0; trial < 20; ++trial) {
    auto d = TestFixture::Displacement::random(this->random_, 4e-3);
    const Eigen::MatrixXd k = testing::stiffness(this->tensors(d));
    EXPECT_LT((k - k.transpose()).norm(), 1e-12 * k.norm());
    const double h = 1e-7;
    for (int i = 0; i < d.kSize; ++i) {
      const double at = d[i];
      d[i] = at + h;
      const Eigen::VectorXd above = testing::force(this->tensors(d));
      d[i] = at - h;
      const Eigen::VectorXd below = testing::force(this->tensors(d));
      d[i] = at;
      ASSERT_LT((k.col(i) + (above - below) / (2 * h)).norm(), 1e-6 * k.norm()) << "column " << i;
    }
  }
}

TYPED_TEST(EveryLaw, RestIsFreeOfForceAndEnergy) {
  const auto d = this->affine(Mat3<double>::Identity());
  EXPECT_EQ(this->energy(d), 0);
  EXPECT_EQ(testing::force(this->tensors(d)).norm(), 0);
}

TYPED_TEST(EveryLaw, RigidMotionGivesNoForce) {
  using Law = typename TypeParam::Law;
  for (int trial = 0; trial < 10; ++trial) {
    Mat3<double> rotation = testing::random_rotation(this->random_);
    if constexpr (Law::kConstantStiffness) {
      // A linear law knows rotations to first order only: x + ω × x.
      const Vec3<double> w = 0.1 * rotation.col(0);
      rotation << 1, -w[2], w[1], w[2], 1, -w[0], -w[1], w[0], 1;
    }
    auto d = this->affine(rotation);
    for (Vec3<double>& u : d.u) u += Vec3<double>(0.3, -0.1, 0.2);
    const Eigen::VectorXd force = testing::force(this->tensors(d));
    EXPECT_LT(force.norm(), 1e-12 * this->scale());
    EXPECT_NEAR(this->energy(d), 0, 1e-14 * this->scale());
  }
}

/// Only a law whose stiffness is constant may know left from right: it is linear, and that is its stated limit.
TYPED_TEST(EveryLaw, RotatedStateHasRotatedForcesUnlessTheLawIsLinear) {
  const auto d = TestFixture::Displacement::random(this->random_, 4e-3);
  const Mat3<double> rotation = testing::random_rotation(this->random_);
  auto turned = d;
  for (int k = 0; k < TypeParam::Shape::kNodes; ++k) {
    turned.u[k] = rotation * (this->element_.x[k] + d.u[k]) - this->element_.x[k];
  }
  const auto force = this->tensors(d).force, turned_force = this->tensors(turned).force;
  double difference = 0;
  for (int k = 0; k < TypeParam::Shape::kNodes; ++k) difference += (rotation * force[k] - turned_force[k]).norm();
  const double size = testing::force(this->tensors(d)).norm();
  if constexpr (TypeParam::Law::kConstantStiffness) {
    EXPECT_GT(difference, 0.1 * size);
  } else {
    EXPECT_LT(difference, 1e-10 * size);
    EXPECT_NEAR(this->energy(d), this->energy(turned), 1e-10 * this->energy(d));
  }
}

/// Forces of an element on itself: no net force; no net torque about the deformed shape of an objective law.
TYPED_TEST(EveryLaw, ForcesBalance) {
  const auto d = TestFixture::Displacement::random(this->random_, 4e-3);
  const auto tensors = this->tensors(d);
  Vec3<double> net = Vec3<double>::Zero(), torque = Vec3<double>::Zero();
  for (int k = 0; k < TypeParam::Shape::kNodes; ++k) {
    net += tensors.force[k];
    const Vec3<double> deformed = TypeParam::Law::kConstantStiffness ? Vec3<double>::Zero() : d.u[k];
    torque += (this->element_.x[k] + deformed).cross(tensors.force[k]);
  }
  const double size = testing::force(tensors).norm();
  EXPECT_LT(net.norm(), 1e-12 * size);
  EXPECT_LT(torque.norm(), 1e-12 * size);
}

/// For small strain every isotropic law is Hooke's of the same E and ν.
TYPED_TEST(EveryLaw, SmallStrainIsHooke) {
  using Shape = typename TypeParam::Shape;
  const auto hooke = [&](const typename TestFixture::Displacement& d) {
    return element_tensors<Shape, Hooke, Stiffness::kConsistent>(d.u, this->element_.rest,
                                                                 testing::parameters<Hooke>().data());
  };
  const auto rest = this->affine(Mat3<double>::Identity());
  const Eigen::MatrixXd expected = testing::stiffness(hooke(rest));
  EXPECT_LT((testing::stiffness(this->tensors(rest)) - expected).norm(), 1e-12 * expected.norm());

  // The difference of the forces is of second order: a tenth of the strain, a hundredth of the difference.
  const auto direction = TestFixture::Displacement::random(this->random_, 1e-6);
  auto tenth = direction;
  for (Vec3<double>& u : tenth.u) u *= 0.1;
  const auto difference = [&](const typename TestFixture::Displacement& d) {
    return (testing::force(this->tensors(d)) - testing::force(hooke(d))).norm() / testing::force(hooke(d)).norm();
  };
  EXPECT_LT(difference(direction), 1e-3);
  EXPECT_LE(difference(tenth), 0.11 * difference(direction) + 1e-12);
}

/// A bar pulled by its ends with free sides: stress E ε, contraction ν ε.
TYPED_TEST(EveryLaw, UniaxialStressGivesYoungAndPoisson) {
  using Law = typename TypeParam::Law;
  const double strain = 1e-7;
  Mat3<double> f = Mat3<double>::Identity();
  f.diagonal() += strain * Vec3<double>(1, -kPoissonRatio, -kPoissonRatio);
  const Mat3<double> stress = Law::stress(Law::at(f, this->parameters_.data()));
  EXPECT_NEAR(stress(0, 0), kYoungModulusPa * strain, 1e-5 * kYoungModulusPa * strain);
  EXPECT_NEAR(stress(1, 1), 0, 1e-5 * kYoungModulusPa * strain);
  EXPECT_NEAR(stress(2, 2), 0, 1e-5 * kYoungModulusPa * strain);
}

TYPED_TEST(EveryLaw, PositiveStiffnessIsPositive) {
  std::uniform_real_distribution<double> stretch(0.1, 1.5);
  int indefinite = 0;
  for (int trial = 0; trial < 500; ++trial) {
    const Vec3<double> stretches(stretch(this->random_), stretch(this->random_), stretch(this->random_));
    const Mat3<double> f = testing::random_rotation(this->random_) * stretches.asDiagonal() *
                           testing::random_rotation(this->random_).transpose();
    const auto d = this->affine(f);
    const auto smallest = [&](const ElementTensors<typename TypeParam::Shape, double>& tensors) {
      return Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(testing::stiffness(tensors), Eigen::EigenvaluesOnly)
          .eigenvalues()[0];
    };
    EXPECT_GT(smallest(this->template tensors<Stiffness::kPositive>(d)), -1e-9 * this->scale()) << "F =\n" << f;
    if (smallest(this->tensors(d)) < -1e-6 * this->scale()) ++indefinite;
  }
  if constexpr (!TypeParam::Law::kConstantStiffness) {
    EXPECT_GT(indefinite, 50) << "compression that makes the consistent stiffness indefinite was met";
  }
}

TYPED_TEST(EveryLaw, PositiveStiffnessLeavesTheForceAndTensionAsTheyAre) {
  // A stretch of 1.1 and more along every axis, a little shear, any rotation: S is diagonally dominant and positive.
  std::uniform_real_distribution<double> stretch(1.1, 1.6), shear(-0.01, 0.01);
  for (int trial = 0; trial < 50; ++trial) {
    Mat3<double> f = Mat3<double>::NullaryExpr([&] { return shear(this->random_); });
    for (int i = 0; i < 3; ++i) f(i, i) = stretch(this->random_);
    f = (testing::random_rotation(this->random_) * f).eval();
    const auto d = this->affine(f);
    const auto consistent = this->tensors(d), positive = this->template tensors<Stiffness::kPositive>(d);
    EXPECT_EQ(testing::force(consistent), testing::force(positive));
    EXPECT_EQ(testing::stiffness(consistent), testing::stiffness(positive));

    const auto pressed = this->affine(0.5 * Mat3<double>::Identity());
    EXPECT_EQ(testing::force(this->tensors(pressed)),
              testing::force(this->template tensors<Stiffness::kPositive>(pressed)));
  }
}

TEST(PairIndex, NumbersTheUpperTriangleRowByRow) {
  for (const int nodes : {2, 4, 8, 10}) {
    int expected = 0;
    for (int k = 0; k < nodes; ++k) {
      for (int l = k + 1; l < nodes; ++l) EXPECT_EQ(pair_index(nodes, k, l), expected++);
    }
  }
}

TEST(Lists, WithShapeAndLawVisitsExactlyThePairNamed) {
  for_each_type(Shapes{}, [](auto, int shape) {
    for_each_type(Laws{}, [&](auto law_tag, int law) {
      int visits = 0;
      with_shape_and_law(shape, law, [&](auto, auto visited) {
        ++visits;
        EXPECT_STREQ(decltype(visited)::Type::kName, decltype(law_tag)::Type::kName);
      });
      EXPECT_EQ(visits, 1);
    });
  });
}

TEST(LinearTetrahedron, GradientsReproduceAffineFieldsAndTheVolume) {
  std::mt19937 random(3);
  for (int trial = 0; trial < 20; ++trial) {
    const Element<LinearTetrahedron> element(random);
    Vec3<double> a[4];
    double weight;
    LinearTetrahedron::gradients(element.rest[0], a, weight);
    const Mat3<double> f = Mat3<double>::Random();
    Mat3<double> gradient = Mat3<double>::Zero();
    for (int k = 0; k < 4; ++k) gradient += (f * element.x[k]) * a[k].transpose();
    EXPECT_LT((gradient - f).norm(), 1e-11);
    Mat3<double> edges;
    for (int k = 0; k < 3; ++k) edges.col(k) = element.x[k + 1] - element.x[0];
    EXPECT_NEAR(weight, edges.determinant() / 6, 1e-18);
  }
}

}  // namespace
}  // namespace tensormass::physics
