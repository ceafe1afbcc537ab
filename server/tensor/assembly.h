#pragma once

#include "physics/element/element.h"
#include "tensor/view.h"

/// Elements to tensors to the linear system of one implicit step. Each function does one patch's share; the elements of
/// a group are shared out among the patches evenly, without regard to who owns their nodes.
///
///   A = (1 + α dt) M + dt (β + dt) K        b = dt (f + f_ext − α M v − (β + dt) K v)
///
/// (Baraff, Witkin 1998, with Rayleigh damping C = α M + β K.)
namespace tensormass::tensor {

/// Reads displacement, writes partials.
template <class Shape, class Law, class Team, class Real>
TM_HOST_DEVICE void element_pass(const Team& team, const SceneView<Real>& s, const ElementView<Real>& e) {
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  constexpr std::uint32_t kRecord = record_reals(Shape::kNodes);
  const std::uint32_t slices = e.count / kSliceRows;
  const std::uint32_t begin = static_cast<std::uint32_t>(std::uint64_t{slices} * team.patch() / s.patch_count);
  const std::uint32_t end = static_cast<std::uint32_t>(std::uint64_t{slices} * (team.patch() + 1) / s.patch_count);
  team.template for_lanes<Lanes::kWidth>(begin * kSliceRows, end * kSliceRows, [&](std::uint32_t first) {
    Vec3<T> u[Shape::kNodes];
    for (int k = 0; k < Shape::kNodes; ++k) {
      u[k] = Lanes::gather3(s.displacement, e.rows + std::size_t{static_cast<std::uint32_t>(k)} * e.count + first);
    }
    T rest[Shape::kQuadraturePoints][Shape::kRestReals];
    for (int q = 0; q < Shape::kQuadraturePoints; ++q) {
      for (int c = 0; c < Shape::kRestReals; ++c) {
        rest[q][c] = Lanes::load(e.rest + static_cast<std::size_t>(q * Shape::kRestReals + c) * e.count + first);
      }
    }
    T parameters[Law::kParameterCount];
    for (int c = 0; c < Law::kParameterCount; ++c) {
      parameters[c] = Lanes::load(e.parameters + static_cast<std::size_t>(c) * e.count + first);
    }
    const auto tensors = physics::element_tensors<Shape, Law, physics::Stiffness::kPositive>(u, rest, parameters);

    T record[kRecord];
    for (std::uint32_t k = 0; k < Shape::kNodes; ++k) {
      for (std::uint32_t c = 0; c < 3; ++c) record[force_offset(k) + c] = tensors.force[k][c];
    }
    for (std::uint32_t pair = 0; pair < physics::kPairs<Shape::kNodes>; ++pair) {
      for (std::uint32_t c = 0; c < 9; ++c) {
        record[edge_offset(Shape::kNodes, pair) + c] = tensors.edge_stiffness[pair](c % 3, c / 3);
      }
    }
    for (std::uint32_t c = edge_offset(Shape::kNodes, physics::kPairs<Shape::kNodes>); c < kRecord; ++c)
      record[c] = T(0);
    Lanes::scatter(s.partials + e.partial_begin + std::size_t{first} * kRecord, kRecord, record);
  });
}

/// The 3×3 block at `p`, column-major.
template <class Real>
TM_HOST_DEVICE Eigen::Map<const Mat3<Real>> dense(const Real* p) {
  return Eigen::Map<const Mat3<Real>>(p);
}

/// Gathers the tensors of each row in a fixed order and forms the row of A and b.
/// Reads partials and constant tensors, displacement, velocity; writes edges, diagonal, rhs.
template <bool HasConstant, bool HasPartial, class Team, class Real>
TM_HOST_DEVICE void assemble(const Team& team, const SceneView<Real>& s) {
  const Patch patch = patch_of(s, team.patch());
  const Real dt = s.dt_s;
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Real mass = s.inertia[4 * row], alpha = s.inertia[4 * row + 1], beta = s.inertia[4 * row + 2];
    const Vec3<Real> velocity = load3<Real>(s.velocity, row);

    Vec3<Real> force = Vec3<Real>::Zero();
    if constexpr (HasPartial) {
      for (std::uint32_t i = s.force_gather_begin[row]; i < s.force_gather_begin[row + 1]; ++i) {
        force += Eigen::Map<const Vec3<Real>>(s.partials + s.force_gather[i]);
      }
    }
    // K_kk = −Σ K_kl, so K v and K u of the row are sums over its edges of K_kl (v_l − v_k).
    const Vec3<Real> displacement = load3<Real>(s.displacement, row);
    Mat3<Real> vertex = Mat3<Real>::Zero();
    Vec3<Real> stiffness_velocity = Vec3<Real>::Zero();
    for_each_slot(s, row, [&](std::size_t slot, std::uint32_t column) {
      const std::uint32_t other = global_row(s, patch, column);
      Mat3<Real> edge = Mat3<Real>::Zero();
      if constexpr (HasConstant) {
        edge = load_block(s.constant_edges, slot);
        force -= edge * (load3<Real>(s.displacement, other) - displacement);
      }
      if constexpr (HasPartial) {
        const std::uint32_t* begin = s.edge_gather_begin + 2 * slot;
        Mat3<Real> transposed = Mat3<Real>::Zero();
        for (std::uint32_t i = begin[0]; i < begin[1]; ++i) edge += dense(s.partials + s.edge_gather[i]);
        for (std::uint32_t i = begin[1]; i < begin[2]; ++i) transposed += dense(s.partials + s.edge_gather[i]);
        edge += transposed.transpose();
      }
      vertex -= edge;
      stiffness_velocity += edge * (load3<Real>(s.velocity, other) - velocity);
      store_block<Real>(s.edges, slot, edge * (dt * (beta + dt)));
    });

    const Mat3<Real> diagonal = vertex * (dt * (beta + dt)) + Mat3<Real>::Identity() * (mass * (1 + alpha * dt));
    store_symmetric(s.diagonal, row, diagonal);
    store3<Real>(s.rhs, row, (force - velocity * (alpha * mass) - stiffness_velocity * (beta + dt)) * dt);
  });
}

/// Adds constant forces: gravity and loads. Only scenes that name them have this stage.
template <class Team, class Real>
TM_HOST_DEVICE void add_external_forces(const Team& team, const SceneView<Real>& s) {
  const Patch patch = patch_of(s, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    store3<Real>(s.rhs, row, load3<Real>(s.rhs, row) + load3<Real>(s.external, row) * s.dt_s);
  });
}

}  // namespace tensormass::tensor
