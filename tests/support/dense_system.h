#pragma once

#include <cstdint>
#include <random>
#include <stdexcept>
#include <string>

#include <Eigen/Dense>

#include "mesh/shapes.h"
#include "model/scene_input.h"
#include "physics/element/element.h"
#include "support/scenes.h"

/// The linear system of one step, assembled from its definitions as dense matrices node by node: the reference for
/// layouts, element lists, assembly and solver.
namespace tensormass::tests {

/// The parts of A Δv = b for one step. M is the lumped mass, K the stiffness, v the velocity, α and β the Rayleigh
/// damping of the node's body.
struct DenseSystem {
  Eigen::VectorXd force;    ///< elastic, [3 node_count] N
  Eigen::MatrixXd k;        ///< the solver's stiffness, projected to positive semi-definite [N/m]
  Eigen::VectorXd mass;     ///< lumped, [3 node_count] kg
  Eigen::VectorXd alpha;    ///< [3 node_count] 1/s
  Eigen::VectorXd beta;     ///< [3 node_count] s
  Eigen::VectorXd gravity;  ///< [3 node_count] N

  /// Returns A = (1 + α dt) M + dt (β + dt) K.
  Eigen::MatrixXd a(double dt) const {
    Eigen::MatrixXd out = (dt * (beta.array() + dt)).matrix().asDiagonal() * k;
    out.diagonal() += ((1 + dt * alpha.array()) * mass.array()).matrix();
    return out;
  }
  /// Returns b = dt (f + f_ext − α M v − (β + dt) K v).
  Eigen::VectorXd b(double dt, const Eigen::VectorXd& v) const {
    return dt * (force + gravity - Eigen::VectorXd(alpha.array() * mass.array() * v.array()) -
                 Eigen::VectorXd((beta.array() + dt) * (k * v).array()));
  }
};

/// Returns the system of a scene at displacement u [3 node_count]. The scene has no loads, full quadrature, lumped
/// mass, and one law for each body.
DenseSystem dense_system(const v1::Scene& scene, const Eigen::VectorXd& u,
                         physics::Stiffness kind = physics::Stiffness::kProjected);

/// Returns numbers uniform in [−scale, scale]; the same seed gives the same numbers.
inline Eigen::VectorXd random_field(Eigen::Index size, double scale, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(-scale, scale);
  return Eigen::VectorXd::NullaryExpr(size, [&] { return uniform(random); });
}

/// Returns a scene of one body that sends `mesh` as packed arrays: lockstep, double precision, no gravity. Its law is
/// Hooke's if `linear`, else St-Venant-Kirchhoff's.
inline v1::Scene packed_scene(const mesh::Mesh& mesh, bool linear) {
  Beam beam;
  beam.linear = linear;
  beam.double_precision = true;
  v1::Scene scene = beam_scene(beam);
  scene.clear_gravity_m_per_s2();
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_fixed();
  v1::PackedMesh& packed = *body.mutable_mesh()->mutable_packed();
  for (const Eigen::Vector3d& x : mesh.nodes) {
    packed.mutable_node_positions()->append(reinterpret_cast<const char*>(x.data()), 3 * sizeof(double));
  }
  for (const mesh::ElementBlock& block : mesh.blocks) {
    v1::PackedElements& elements = *packed.add_elements();
    // The enums list the same shapes in the same order; the protocol's starts at 1.
    elements.set_shape(static_cast<v1::Shape>(static_cast<int>(block.shape) + 1));
    elements.set_nodes(block.nodes.data(), block.nodes.size() * sizeof(std::uint32_t));
  }
  return scene;
}

}  // namespace tensormass::tests
