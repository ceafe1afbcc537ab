#include <numeric>
#include <vector>

#include <gtest/gtest.h>
#include <Eigen/Dense>
#include <Eigen/Geometry>

#include "mesh/grid.h"
#include "physics/element/element.h"
#include "physics/laws.h"
#include "support/meshes.h"

/// Properties that every shape must have, and every law in every shape. The lists of physics/lists.h drive all tests: a
/// new entry there is tested here without a change.
namespace tensormass::physics {
namespace {

constexpr Quadrature kQuadratures[] = {Quadrature::kFull, Quadrature::kReduced, Quadrature::kSelective};

/// An element of 2 cm whose nodes were moved a little at random.
template <class Shape>
struct Element {
  Vec3<double> x[Shape::kNodes];

  explicit Element(std::mt19937& random, double shift = 0.1) {
    const mesh::Mesh mesh = tests::reference_element(static_cast<mesh::Shape>(index_of<Shape>(Shapes{})));
    std::uniform_real_distribution<double> uniform(-shift, shift);
    for (int k = 0; k < Shape::kNodes; ++k) {
      const std::uint32_t corners = mesh::topology(mesh.blocks[0].shape).corner_count;
      const double share = k >= static_cast<int>(corners) ? 0.3 : 1;  // a mid-edge node stays near the middle
      x[k] = 0.02 * (mesh.nodes[static_cast<std::size_t>(k)] +
                     share * Vec3<double>(uniform(random), uniform(random), uniform(random)));
    }
  }
};

template <class Shape>
using Nodes = Vec3<double>[Shape::kNodes];

/// Sets the displacements of an affine motion, u_k = F x_k − x_k.
template <class Shape>
void affine(const Element<Shape>& element, const Mat3<double>& f, Nodes<Shape>& u) {
  for (int k = 0; k < Shape::kNodes; ++k) u[k] = f * element.x[k] - element.x[k];
}

template <class Shape>
Eigen::VectorXd force(const ElementTensors<Shape, double>& tensors) {
  Eigen::VectorXd out(3 * Shape::kNodes);
  for (int k = 0; k < Shape::kNodes; ++k) out.segment<3>(3 * k) = tensors.force[k];
  return out;
}

template <class Shape>
Eigen::MatrixXd stiffness(const ElementTensors<Shape, double>& tensors) {
  Eigen::MatrixXd out(3 * Shape::kNodes, 3 * Shape::kNodes);
  for (int k = 0; k < Shape::kNodes; ++k) {
    out.block<3, 3>(3 * k, 3 * k) = vertex_stiffness(tensors, k);
    for (int l = k + 1; l < Shape::kNodes; ++l) {
      const Mat3<double>& edge = tensors.edge_stiffness[pair_index(Shape::kNodes, k, l)];
      out.block<3, 3>(3 * k, 3 * l) = edge;
      out.block<3, 3>(3 * l, 3 * k) = edge.transpose();
    }
  }
  return out;
}

template <class... Types>
::testing::Types<Types...> as_types(TypeList<Types...>);
struct Names {
  template <class T>
  static std::string GetName(int) {
    return T::kName;
  }
};

// -- shapes ---------------------------------------------------------------------------------------------------------

template <class Shape>
class EveryShape : public ::testing::Test {
 protected:
  std::mt19937 random_{5};
};
TYPED_TEST_SUITE(EveryShape, decltype(as_types(Shapes{})), Names);

TYPED_TEST(EveryShape, FunctionsAreOneAtTheirNodeAndAddUpToOne) {
  using Shape = TypeParam;
  for (const QuadraturePoint& point : Shape::mass_rule()) {
    double n[Shape::kNodes];
    Nodes<Shape> dn;
    Shape::values(point.at, n);
    Shape::gradients(point.at, dn);
    EXPECT_NEAR(std::accumulate(std::begin(n), std::end(n), 0.0), 1, 1e-14);
    Vec3<double> sum = Vec3<double>::Zero();
    for (const Vec3<double>& gradient : dn) sum += gradient;
    EXPECT_LT(sum.norm(), 1e-12);
    const double h = 1e-6;
    for (int c = 0; c < 3; ++c) {
      double above[Shape::kNodes], below[Shape::kNodes];
      Shape::values(point.at + h * Vec3<double>::Unit(c), above);
      Shape::values(point.at - h * Vec3<double>::Unit(c), below);
      for (int k = 0; k < Shape::kNodes; ++k) {
        EXPECT_NEAR(dn[k][c], (above[k] - below[k]) / (2 * h), 1e-7 * (1 + std::abs(dn[k][c])));
      }
    }
  }
}

/// The bound of rounding in step/inversion_check.h assumes these sums.
TYPED_TEST(EveryShape, GradientsAtThePointsHaveABoundedSum) {
  using Shape = TypeParam;
  for (const QuadraturePoint& point : Shape::full_rule()) {
    Nodes<Shape> dn;
    Shape::gradients(point.at, dn);
    Vec3<double> sum = Vec3<double>::Zero();
    for (int k = 1; k < Shape::kNodes; ++k) sum += dn[k].cwiseAbs();  // positions are relative to node 0
    EXPECT_LE(sum.maxCoeff(), Shape::kNodes > 10 ? 12 + 1e-12 : 7);
  }
}

/// Checks ∫∇(F x) dV = F V for every rule. The patch test needs it, for distorted elements too.
TYPED_TEST(EveryShape, GradientsReproduceAffineFieldsAndTheVolume) {
  using Shape = TypeParam;
  const Element<Shape> element(this->random_);
  const Mat3<double> f = Mat3<double>::Random();
  double exact = 0;
  for (const QuadraturePoint& point : Shape::mass_rule()) {
    Nodes<Shape> dn;
    Shape::gradients(point.at, dn);
    exact += point.weight * jacobian<Shape>(element.x, dn).determinant();
  }
  for (const Quadrature quadrature : kQuadratures) {
    const ElementAtRest<Shape> rest(element.x, quadrature);
    double deviatoric = 0, volumetric = 0;
    ASSERT_EQ(rest.points.size(), rest.shares.size());
    for (std::size_t q = 0; q < rest.points.size(); ++q) {
      const auto point =
          PointGradients<Shape, double>::read([&](int c) { return rest.points[q][static_cast<std::size_t>(c)]; });
      Mat3<double> gradient = Mat3<double>::Zero();
      for (int k = 0; k < Shape::kNodes; ++k) gradient += f * element.x[k] * point.a[k].transpose();
      EXPECT_LT((gradient - f).norm(), 1e-11);
      deviatoric += rest.shares[q].deviatoric * point.weight;
      volumetric += rest.shares[q].volumetric * point.weight;
    }
    // Rules for elements with curved or rational maps are not exact for their volume.
    const double tolerance = Shape::kOrder == 2 || Shape::kNodes == 5 ? 1e-2 : 1e-12;
    EXPECT_NEAR(deviatoric, exact, tolerance * exact);
    EXPECT_NEAR(volumetric, deviatoric, 1e-12 * exact);
  }
}

/// The force of a constant stress is σ ∫∇N_k. A full rule of low degree must still integrate it exactly in an element
/// with straight edges, or a patch of distorted elements does not keep a constant strain.
TYPED_TEST(EveryShape, FullRuleIntegratesAConstantStressInStraightElements) {
  using Shape = TypeParam;
  if constexpr (kHasReducedRule<Shape>) {
    Element<Shape> element(this->random_, 0.2);
    const mesh::Topology& shape = mesh::topology(static_cast<mesh::Shape>(index_of<Shape>(Shapes{})));
    for (std::uint32_t i = shape.corner_count; i < shape.node_count; ++i) {
      const auto [a, b] = shape.edges[i - shape.corner_count].nodes;
      element.x[i] = (element.x[a] + element.x[b]) / 2;
    }
    Eigen::Matrix<double, 3, Shape::kNodes> exact = Eigen::Matrix<double, 3, Shape::kNodes>::Zero();
    for (const QuadraturePoint& point : Shape::mass_rule()) {
      const detail::RestPoint<Shape> at(element.x, point);
      exact += at.weight * at.a;
    }
    for (const Quadrature quadrature : kQuadratures) {
      const ElementAtRest<Shape> rest(element.x, quadrature);
      Eigen::Matrix<double, 3, Shape::kNodes> deviatoric = -exact, volumetric = -exact;
      for (std::size_t q = 0; q < rest.points.size(); ++q) {
        const auto point =
            PointGradients<Shape, double>::read([&](int c) { return rest.points[q][static_cast<std::size_t>(c)]; });
        for (int k = 0; k < Shape::kNodes; ++k) {
          deviatoric.col(k) += rest.shares[q].deviatoric * point.weight * point.a[k];
          volumetric.col(k) += rest.shares[q].volumetric * point.weight * point.a[k];
        }
      }
      EXPECT_LT(deviatoric.norm(), 1e-13 * exact.norm());
      EXPECT_LT(volumetric.norm(), 1e-13 * exact.norm());
    }
  }
}

/// A row of quadratic hexahedra: modes without energy may pass through it, though two elements side by side have none.
TEST(QuadraticHexahedra, OnlyReducedQuadratureHasModesWithoutEnergyInARow) {
  using Shape = QuadraticHexahedron;
  constexpr int kElements = 3;
  const mesh::Mesh row =
      mesh::make_grid(Eigen::Vector3d::Zero(), {kElements, 1, 1}, kElements, 1, 1, mesh::Shape::kQuadraticHexahedron)
          .value();
  const auto parameters = testing::parameters<Hooke>();
  for (const Quadrature quadrature : kQuadratures) {
    Eigen::MatrixXd sum = Eigen::MatrixXd::Zero(3 * static_cast<Eigen::Index>(row.nodes.size()),
                                                3 * static_cast<Eigen::Index>(row.nodes.size()));
    for (const auto& nodes : mesh::element_nodes(row)) {
      Nodes<Shape> x, u;
      for (std::size_t k = 0; k < Shape::kNodes; ++k) x[k] = row.nodes[nodes[k]];
      for (Vec3<double>& one : u) one.setZero();
      const Eigen::MatrixXd k_element = stiffness(
          element_tensors<Hooke>(ElementAtRest<Shape>(x, quadrature), u, parameters.data(), Stiffness::kConsistent));
      for (int k = 0; k < Shape::kNodes; ++k) {
        for (int l = 0; l < Shape::kNodes; ++l) {
          sum.block<3, 3>(3 * static_cast<Eigen::Index>(nodes[static_cast<std::size_t>(k)]),
                          3 * static_cast<Eigen::Index>(nodes[static_cast<std::size_t>(l)])) +=
              k_element.block<3, 3>(3 * k, 3 * l);
        }
      }
    }
    const Eigen::VectorXd values = Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(sum).eigenvalues();
    const auto zeros = (values.array().abs() < 1e-9 * values.maxCoeff()).count();
    EXPECT_EQ(zeros, quadrature == Quadrature::kReduced ? 10 : 6) << static_cast<int>(quadrature);
  }
}

TYPED_TEST(EveryShape, MassIsPositiveAndAddsUpToTheVolume) {
  using Shape = TypeParam;
  const Element<Shape> element(this->random_);
  const auto consistent = mass_integrals<Shape>(element.x);
  const auto lumped = lumped_volumes<Shape>(element.x);
  double sum = 0;
  for (const double volume : lumped) {
    EXPECT_GT(volume, 0);
    sum += volume;
  }
  EXPECT_NEAR(sum, consistent.sum(), 1e-12 * sum);
  EXPECT_GT(testing::least_eigenvalue(consistent), 0);
  // Compares the kinetic energy of a linear velocity field with quadrature of the field itself.
  Eigen::Matrix<double, Shape::kNodes, 1> v;
  for (int k = 0; k < Shape::kNodes; ++k) v[k] = element.x[k].dot(Vec3<double>(1, 2, 3));
  double exact = 0;
  for (const QuadraturePoint& point : Shape::mass_rule()) {
    double n[Shape::kNodes];
    Nodes<Shape> dn;
    Shape::values(point.at, n);
    Shape::gradients(point.at, dn);
    Vec3<double> x = Vec3<double>::Zero();
    for (int k = 0; k < Shape::kNodes; ++k) x += n[k] * element.x[k];
    exact += point.weight * jacobian<Shape>(element.x, dn).determinant() * std::pow(x.dot(Vec3<double>(1, 2, 3)), 2);
  }
  EXPECT_NEAR(v.dot(consistent * v), exact, 1e-12 * exact);
}

/// With full quadrature only the six rigid motions cost no energy. Reduced quadrature of shapes that bend has more such
/// modes: that is its price. A point sees six.
TYPED_TEST(EveryShape, OnlyRigidModesCostNoEnergyUnlessReduced) {
  using Shape = TypeParam;
  const Element<Shape> element(this->random_);
  const auto parameters = testing::parameters<Hooke>();
  for (const Quadrature quadrature : kQuadratures) {
    Nodes<Shape> u;
    for (Vec3<double>& one : u) one.setZero();
    const ElementAtRest<Shape> rest(element.x, quadrature);
    const auto tensors = element_tensors<Hooke>(rest, u, parameters.data(), Stiffness::kConsistent);
    const Eigen::VectorXd values = Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(stiffness(tensors)).eigenvalues();
    const auto zeros = (values.array().abs() < 1e-9 * values.maxCoeff()).count();
    if (quadrature == Quadrature::kReduced && Shape::kNodes > 4) {
      EXPECT_EQ(zeros, 3 * Shape::kNodes - 6 * static_cast<int>(rest.points.size()));
    } else if (quadrature == Quadrature::kSelective && Shape::kNodes == 10) {
      // Conformal maps, 2 (c·x) x − |x|² c, change neither shape nor mean volume. Neighbouring elements cannot share
      // such a mode.
      EXPECT_EQ(zeros, 9);
    } else {
      EXPECT_EQ(zeros, 6);
    }
  }
}

TEST(PairIndex, NumbersTheUpperTriangleRowByRow) {
  for (const int nodes : {2, 4, 8, 10, 20}) {
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

// -- every law in every shape -----------------------------------------------------------------------------------------

template <class Law>
class EveryPair : public ::testing::Test {
 protected:
  /// Runs a check on a random element of each shape with each quadrature.
  ///
  ///   check(shape tag, element, element at rest, displacements)   may change the displacements
  template <class Check>
  void for_each_shape(double scale_m, const Check& check) {
    for_each_type(Shapes{}, [&](auto tag, int) {
      using Shape = typename decltype(tag)::Type;
      const Element<Shape> element(random_);
      std::uniform_real_distribution<double> uniform(-scale_m, scale_m);
      for (const Quadrature quadrature : kQuadratures) {
        SCOPED_TRACE(std::string(Shape::kName) + ", quadrature " + std::to_string(static_cast<int>(quadrature)));
        Nodes<Shape> u;
        for (Vec3<double>& one : u) one = Vec3<double>(uniform(random_), uniform(random_), uniform(random_));
        check(tag, element, ElementAtRest<Shape>(element.x, quadrature), u);
      }
    });
  }

  /// Runs a check of derivatives at u along random directions, which all components of u have a part in.
  ///
  ///   check(direction, derivative)   derivative(function) is (function(u + h d) − function(u − h d)) / 2h
  template <std::size_t count, class Check>
  void for_each_direction(const Vec3<double> (&u)[count], const Check& check) {
    for (int i = 0; i < kDirections; ++i) {
      std::uniform_real_distribution<double> uniform(-1, 1);
      Eigen::VectorXd direction(3 * count);
      for (double& component : direction) component = uniform(random_);
      check(direction, [&](const auto& function) {
        constexpr double kStep = 1e-7;
        Vec3<double> above[count], below[count];
        for (std::size_t k = 0; k < count; ++k) {
          const Vec3<double> change = kStep * direction.segment<3>(static_cast<Eigen::Index>(3 * k));
          above[k] = u[k] + change;
          below[k] = u[k] - change;
        }
        const auto high = function(above), low = function(below);
        return std::decay_t<decltype(high)>((high - low) / (2 * kStep));
      });
    }
  }

  static constexpr int kDirections = 6;
  const std::array<double, Law::kParameterCount> parameters_ = testing::parameters<Law>();
  std::mt19937 random_{11};
};
TYPED_TEST_SUITE(EveryPair, testing::AllLaws, testing::LawNames);

TYPED_TEST(EveryPair, ForceAndStiffnessAreDerivativesOfTheEnergy) {
  using Law = TypeParam;
  this->for_each_shape(1.5e-3, [&](auto, const auto&, const auto& rest, auto& u) {
    const double* p = this->parameters_.data();
    const auto tensors = element_tensors<Law>(rest, u, p, Stiffness::kConsistent);
    const Eigen::VectorXd f = force(tensors);
    const Eigen::MatrixXd k = stiffness(tensors);
    EXPECT_LT((k - k.transpose()).norm(), 1e-12 * k.norm());
    this->for_each_direction(u, [&](const Eigen::VectorXd& direction, const auto& derivative) {
      const double energy = derivative([&](const auto& at) { return element_energy<Law>(rest, at, p); });
      const Eigen::VectorXd change =
          derivative([&](const auto& at) { return force(element_tensors<Law>(rest, at, p, Stiffness::kConsistent)); });
      EXPECT_NEAR(f.dot(direction), -energy, 1e-6 * f.norm());
      EXPECT_LT((k * direction + change).norm(), 1e-6 * k.norm());
    });
  });
}

TYPED_TEST(EveryPair, RigidMotionGivesNoForce) {
  using Law = TypeParam;
  Mat3<double> rotation = testing::random_rotation(this->random_);
  if constexpr (Law::kConstantStiffness) {
    // A linear law is invariant only under infinitesimal rotations: x + ω × x.
    const Vec3<double> w = 0.1 * rotation.col(0);
    rotation << 1, -w[2], w[1], w[2], 1, -w[0], -w[1], w[0], 1;
  }
  this->for_each_shape(0, [&](auto tag, const auto& element, const auto& rest, auto& u) {
    using Shape = typename decltype(tag)::Type;
    affine<Shape>(element, rotation, u);
    for (Vec3<double>& one : u) one += Vec3<double>(0.3, -0.1, 0.2);
    const double scale = testing::kYoungModulusPa * 0.02 * 0.02;
    EXPECT_LT(force(element_tensors<Law>(rest, u, this->parameters_.data(), Stiffness::kConsistent)).norm(),
              1e-11 * scale);
    EXPECT_LT(std::abs(element_energy<Law>(rest, u, this->parameters_.data())), 1e-13 * scale);
  });
}

/// The net force of an element on itself is zero. For an objective law, so is the net torque about the deformed shape.
TYPED_TEST(EveryPair, ForcesBalance) {
  using Law = TypeParam;
  this->for_each_shape(1.5e-3, [&](auto tag, const auto& element, const auto& rest, auto& u) {
    using Shape = typename decltype(tag)::Type;
    const auto tensors = element_tensors<Law>(rest, u, this->parameters_.data(), Stiffness::kProjected);
    Vec3<double> net = Vec3<double>::Zero(), torque = Vec3<double>::Zero();
    for (int k = 0; k < Shape::kNodes; ++k) {
      net += tensors.force[k];
      const Vec3<double> moved = Law::kConstantStiffness ? Vec3<double>(0, 0, 0) : u[k];
      torque += (element.x[k] + moved).cross(tensors.force[k]);
    }
    EXPECT_LT(net.norm(), 1e-11 * force(tensors).norm());
    EXPECT_LT(torque.norm(), 1e-11 * 0.02 * force(tensors).norm());
  });
}

TYPED_TEST(EveryPair, ProjectedStiffnessIsPsdAndForcesAreUnchanged) {
  using Law = TypeParam;
  for (const double pressed : {0.6, 1.0, 1.4}) {
    this->for_each_shape(1.5e-3, [&](auto tag, const auto& element, const auto& rest, auto& u) {
      using Shape = typename decltype(tag)::Type;
      for (int k = 0; k < Shape::kNodes; ++k) u[k][0] += (pressed - 1) * element.x[k][0];
      const auto positive = element_tensors<Law>(rest, u, this->parameters_.data(), Stiffness::kProjected);
      const auto consistent = element_tensors<Law>(rest, u, this->parameters_.data(), Stiffness::kConsistent);
      EXPECT_EQ(force(positive), force(consistent));
      const Eigen::MatrixXd k = stiffness(positive);
      EXPECT_GT(testing::least_eigenvalue(k), -1e-12 * k.norm());
    });
  }
}

/// Viscoelastic internal variables H add the energy −H:E, where E is the law's own strain: the total is g W(F) − H:E.
TYPED_TEST(EveryPair, InternalVariablesAddAConstantStress) {
  using Law = TypeParam;
  Mat3<double> memory = Mat3<double>::Random();
  memory = (300 * (memory + memory.transpose())).eval();
  const Viscous<double> viscous{0.7, memory};
  this->for_each_shape(1.5e-3, [&](auto tag, const auto&, const auto& rest, auto& u) {
    using Shape = typename decltype(tag)::Type;
    const auto evaluate = [&](const Nodes<Shape>& at) {
      ElementTensors<Shape, double> out;
      bool first = true;
      rest.template for_each_point<Law>(
          at, this->parameters_.data(), [&](const auto& gradients, const Mat3<double>& f, const double* p) {
            auto point = Law::at(f, p);
            add_point<Shape, Law>(gradients, f, point, &viscous, Stiffness::kConsistent, first, out);
            first = false;
          });
      return out;
    };
    const auto energy_at = [&](const Nodes<Shape>& at) {
      double sum = 0;
      rest.template for_each_point<Law>(
          at, this->parameters_.data(), [&](const auto& gradients, const Mat3<double>& f, const double* p) {
            const Mat3<double> identity = Mat3<double>::Identity();
            const Mat3<double> strain = Law::kConstantStiffness ? Mat3<double>((f + f.transpose()) / 2 - identity)
                                                                : Mat3<double>((f.transpose() * f - identity) / 2);
            sum += gradients.weight * (0.7 * Law::energy(Law::at(f, p)) - memory.cwiseProduct(strain).sum());
          });
      return sum;
    };
    const auto tensors = evaluate(u);
    const Eigen::VectorXd f = force(tensors);
    const Eigen::MatrixXd k = stiffness(tensors);
    this->for_each_direction(u, [&](const Eigen::VectorXd& direction, const auto& derivative) {
      EXPECT_NEAR(f.dot(direction), -derivative(energy_at), 1e-6 * f.norm());
      const Eigen::VectorXd change = derivative([&](const auto& at) { return force(evaluate(at)); });
      EXPECT_LT((k * direction + change).norm(), 1e-6 * k.norm());
    });
  });
}

}  // namespace
}  // namespace tensormass::physics
