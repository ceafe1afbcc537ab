#include "support/dense_system.h"

#include "model/material_input.h"
#include "physics/lists.h"

namespace tensormass::tests {

DenseSystem dense_system(const v1::Scene& scene, const Eigen::VectorXd& u, physics::Stiffness kind) {
  const Eigen::Index size = u.size();
  DenseSystem out{Eigen::VectorXd::Zero(size), Eigen::MatrixXd::Zero(size, size), Eigen::VectorXd::Zero(size),
                  Eigen::VectorXd::Zero(size), Eigen::VectorXd::Zero(size),       Eigen::VectorXd::Zero(size)};
  std::uint32_t first = 0;
  for (const v1::Body& body : scene.bodies()) {
    const mesh::Mesh mesh = model::read_mesh(body, body.name()).value();
    const model::Material material = model::read_law(body.law(), {}, body.name()).value();
    out.alpha.segment(3 * first, 3 * static_cast<Eigen::Index>(mesh.nodes.size()))
        .setConstant(body.rayleigh_mass_per_s());
    out.beta.segment(3 * first, 3 * static_cast<Eigen::Index>(mesh.nodes.size()))
        .setConstant(body.rayleigh_stiffness_s());
    for (const mesh::ElementBlock& block : mesh.blocks) {
      physics::with_shape_and_law(static_cast<int>(block.shape), material.law, [&](auto shape, auto law) {
        using Shape = typename decltype(shape)::Type;
        using Law = typename decltype(law)::Type;
        for (std::size_t begin = 0; begin < block.nodes.size(); begin += Shape::kNodes) {
          Vec3<double> x[Shape::kNodes], displacement[Shape::kNodes];
          const auto row = [&](int k) {
            return 3 * Eigen::Index{first + block.nodes[begin + static_cast<std::size_t>(k)]};
          };
          for (int k = 0; k < Shape::kNodes; ++k) {
            x[k] = mesh.nodes[block.nodes[begin + static_cast<std::size_t>(k)]];
            displacement[k] = u.segment<3>(row(k));
          }
          const physics::ElementAtRest<Shape> rest(x, physics::Quadrature::kFull);
          const auto tensors = physics::element_tensors<Law>(rest, displacement, material.parameters.data(), kind);
          const auto volumes = physics::lumped_volumes<Shape>(x);
          for (int k = 0; k < Shape::kNodes; ++k) {
            out.force.segment<3>(row(k)) += tensors.force[k];
            out.mass.segment<3>(row(k)).array() += body.density_kg_per_m3() * volumes[static_cast<std::size_t>(k)];
            out.k.block<3, 3>(row(k), row(k)) += physics::vertex_stiffness(tensors, k);
            for (int l = k + 1; l < Shape::kNodes; ++l) {
              const Mat3<double>& edge = tensors.edge_stiffness[physics::pair_index(Shape::kNodes, k, l)];
              out.k.block<3, 3>(row(k), row(l)) += edge;
              out.k.block<3, 3>(row(l), row(k)) += edge.transpose();
            }
          }
        }
      });
    }
    first += static_cast<std::uint32_t>(mesh.nodes.size());
  }
  const v1::Vector3& g = scene.gravity_m_per_s2();
  out.gravity = out.mass.cwiseProduct(Eigen::Vector3d(g.x(), g.y(), g.z()).replicate(size / 3, 1));
  return out;
}

}  // namespace tensormass::tests
