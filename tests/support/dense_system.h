#pragma once

#include <cstdint>
#include <random>
#include <stdexcept>
#include <string>

#include <Eigen/Dense>

#include "mesh/shapes.h"
#include "model/scene_input.h"
#include "physics/element/element.h"
#include "physics/lists.h"
#include "support/scenes.h"

/// The system of one step straight from its definitions, densely and node by node: the oracle for layouts, gather maps,
/// assembly and solver.
namespace tensormass::tests {

struct DenseSystem {
  Eigen::VectorXd force;    ///< elastic, [3 node_count] N
  Eigen::MatrixXd k;        ///< the solver's (positive) stiffness [N/m]
  Eigen::VectorXd mass;     ///< lumped, [3 node_count] kg
  Eigen::VectorXd alpha;    ///< [3 node_count] 1/s
  Eigen::VectorXd beta;     ///< [3 node_count] s
  Eigen::VectorXd gravity;  ///< [3 node_count] N

  /// A = (1 + α dt) M + dt (β + dt) K
  Eigen::MatrixXd a(double dt) const {
    Eigen::MatrixXd out = (dt * (beta.array() + dt)).matrix().asDiagonal() * k;
    out.diagonal() += ((1 + dt * alpha.array()) * mass.array()).matrix();
    return out;
  }
  /// b = dt (f + f_ext − α M v − (β + dt) K v)
  Eigen::VectorXd b(double dt, const Eigen::VectorXd& v) const {
    return dt * (force + gravity - Eigen::VectorXd(alpha.array() * mass.array() * v.array()) -
                 Eigen::VectorXd((beta.array() + dt) * (k * v).array()));
  }
};

/// For tetrahedra of a scene without loads, at displacement u [3 node_count].
inline DenseSystem dense_system(const v1::Scene& scene, const Eigen::VectorXd& u) {
  using Shape = physics::LinearTetrahedron;
  const Eigen::Index size = u.size();
  DenseSystem out{Eigen::VectorXd::Zero(size), Eigen::MatrixXd::Zero(size, size), Eigen::VectorXd::Zero(size),
                  Eigen::VectorXd::Zero(size), Eigen::VectorXd::Zero(size),       Eigen::VectorXd::Zero(size)};
  std::uint32_t first = 0;
  for (const v1::Body& body : scene.bodies()) {
    const mesh::Mesh mesh = model::read_mesh(body, body.name()).value();
    const bool linear = body.law().has_hooke();
    const v1::IsotropicElastic& elastic = linear ? body.law().hooke() : body.law().st_venant_kirchhoff();
    const physics::Lame lame = physics::lame_from_young(elastic.young_modulus_pa(), elastic.poisson_ratio());
    const double parameters[] = {lame.lambda_pa, lame.mu_pa};
    out.alpha.segment(3 * first, 3 * static_cast<Eigen::Index>(mesh.nodes.size()))
        .setConstant(body.rayleigh_mass_per_s());
    out.beta.segment(3 * first, 3 * static_cast<Eigen::Index>(mesh.nodes.size()))
        .setConstant(body.rayleigh_stiffness_s());
    mesh::for_each_element(mesh, [&](std::uint32_t, const mesh::Topology&, std::span<const std::uint32_t> nodes) {
      Vec3<double> x[4], displacement[4];
      for (std::size_t k = 0; k < 4; ++k) {
        x[k] = mesh.nodes[nodes[k]];
        displacement[k] = u.segment<3>(3 * (first + nodes[k]));
      }
      double rest[1][Shape::kRestReals];
      Shape::rest(x, 0, rest[0]);
      const auto tensors =
          linear ? physics::element_tensors<Shape, physics::Hooke, physics::Stiffness::kPositive>(displacement, rest,
                                                                                                  parameters)
                 : physics::element_tensors<Shape, physics::StVenantKirchhoff, physics::Stiffness::kPositive>(
                       displacement, rest, parameters);
      for (std::size_t k = 0; k < 4; ++k) {
        const Eigen::Index row = 3 * (first + nodes[k]);
        out.force.segment<3>(row) += tensors.force[k];
        out.mass.segment<3>(row).array() += body.density_kg_per_m3() * rest[0][9] / 4;
        out.k.block<3, 3>(row, row) += physics::vertex_stiffness(tensors, k);
        for (std::size_t l = k + 1; l < 4; ++l) {
          const Eigen::Index column = 3 * (first + nodes[l]);
          const Mat3<double>& edge =
              tensors.edge_stiffness[physics::pair_index(4, static_cast<int>(k), static_cast<int>(l))];
          out.k.block<3, 3>(row, column) += edge;
          out.k.block<3, 3>(column, row) += edge.transpose();
        }
      }
    });
    first += static_cast<std::uint32_t>(mesh.nodes.size());
  }
  const v1::Vector3& g = scene.gravity_m_per_s2();
  out.gravity = out.mass.cwiseProduct(Eigen::Vector3d(g.x(), g.y(), g.z()).replicate(size / 3, 1));
  return out;
}

/// Uniform in [-scale, scale], the same for the same seed.
inline Eigen::VectorXd random_field(Eigen::Index size, double scale, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(-scale, scale);
  return Eigen::VectorXd::NullaryExpr(size, [&] { return uniform(random); });
}

/// A scene of one body that sends `mesh` as packed arrays, in lockstep and double precision, without gravity.
inline v1::Scene packed_scene(const mesh::Mesh& mesh, bool linear) {
  Beam beam;
  beam.linear = linear;
  beam.double_precision = true;
  v1::Scene scene = beam_scene(beam);
  scene.clear_gravity_m_per_s2();
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_fixed();
  v1::PackedTetrahedra& packed = *body.mutable_mesh()->mutable_packed();
  for (const Eigen::Vector3d& x : mesh.nodes) {
    packed.mutable_node_positions()->append(reinterpret_cast<const char*>(x.data()), 3 * sizeof(double));
  }
  const auto& nodes = mesh.blocks.at(0).nodes;
  packed.set_tetrahedra(nodes.data(), nodes.size() * sizeof(std::uint32_t));
  return scene;
}

}  // namespace tensormass::tests
