#pragma once

#include <cmath>
#include <limits>

#include "physics/element/element.h"
#include "tensor/view.h"

/// Elements to tensors to the linear system of one implicit step. Each function does one patch's share; the elements of
/// a group are shared out among the patches evenly, without regard to who owns their nodes.
///
/// The step ends at u' = û + h v', M (v' − v̂) / h = f(u') + f_ext − α M v' − β K v' (view.h says what û, v̂ and h are).
/// Linearized about u, where the elements are evaluated, and about any velocity v with d = û + h v − u:
///
///   A (v' − v) = b,   A = (1 + α h) M + h (β + h) K
///                     b = h (f + f_ext − α M v − K (β v + d)) + M (v̂ − v)
///
/// For implicit Euler, u = û, v = v̂, this is Baraff, Witkin 1998 with Rayleigh damping C = α M + β K; for a later outer
/// iteration d = 0 and b is the imbalance.
namespace tensormass::tensor {

/// The part of an element group that a patch works on: whole slices.
struct ElementRange {
  std::uint32_t begin, end;
};
template <class Real>
TM_HOST_DEVICE ElementRange element_range(const SceneView<Real>& s, const ElementView<Real>& e, std::uint32_t patch) {
  const std::uint32_t slices = e.count / kSliceRows;
  return {static_cast<std::uint32_t>(std::uint64_t{slices} * patch / s.patch_count) * kSliceRows,
          static_cast<std::uint32_t>(std::uint64_t{slices} * (patch + 1) / s.patch_count) * kSliceRows};
}

template <class Lanes, class Shape, class Real>
TM_HOST_DEVICE void load_displacement(const SceneView<Real>& s, const ElementView<Real>& e, std::uint32_t first,
                                      Vec3<typename Lanes::Scalar> (&u)[Shape::kNodes]) {
  for (int k = 0; k < Shape::kNodes; ++k) {
    u[k] = Lanes::gather3(s.displacement, e.rows + std::size_t{static_cast<std::uint32_t>(k)} * e.count + first);
  }
}

template <class Lanes, class Shape, class Real>
TM_HOST_DEVICE auto load_point(const ElementView<Real>& e, std::uint32_t point, std::uint32_t first) {
  constexpr std::uint32_t kReals = physics::kRestReals<Shape>;
  const Real* rest = e.rest + std::size_t{point} * kReals * e.count + first;
  return physics::PointGradients<Shape, typename Lanes::Scalar>::read(
      [&](int c) { return Lanes::load(rest + std::size_t{static_cast<std::uint32_t>(c)} * e.count); });
}

/// What a point integrates of the law's moduli.
template <class Lanes, class Shape, class Law, class Real, class T>
TM_HOST_DEVICE void load_parameters(const ElementView<Real>& e, std::uint32_t point, std::uint32_t first,
                                    T (&parameters)[Law::kParameterCount]) {
  for (int c = 0; c < Law::kParameterCount; ++c) {
    parameters[c] = Lanes::load(e.parameters + static_cast<std::size_t>(c) * e.count + first);
  }
  if (!Shape::kSinglePoint && e.shares != nullptr) {
    Law::take_shares(parameters, T(e.shares[point].deviatoric), T(e.shares[point].volumetric));
  }
}

/// The history of a point in a step of `dt_s` and, where history_dt_s is not zero, its move to the stress that the last
/// step ended with, which took that long.
template <class Lanes, class Law, class Point, class Real>
TM_HOST_DEVICE auto remember(const ElementView<Real>& e, std::uint32_t q, std::uint32_t first, const Point& point,
                             Real dt_s, Real history_dt_s) {
  using T = typename Lanes::Scalar;
  T stress[physics::kSymmetricReals], memory[physics::kSymmetricReals];
  physics::to_symmetric<T>(Law::second_piola(point), stress);
  for (T& value : memory) value = T(0);
  T instant = T(1);
  for (std::uint32_t term = 0; term < e.prony_count; ++term) {
    const PronyTerm<Real> t = e.prony[term];
    const auto now = physics::prony_step(t.share, t.relaxation_time_s, dt_s);
    const auto last = physics::prony_step(t.share, t.relaxation_time_s, history_dt_s);
    instant -= T(now.gain);
    for (std::uint32_t c = 0; c < physics::kSymmetricReals; ++c) {
      Real* place =
          e.history + ((std::size_t{q} * e.prony_count + term) * physics::kSymmetricReals + c) * e.count + first;
      T gamma = Lanes::load(place);
      if (history_dt_s > 0) {
        gamma = T(last.gain) * stress[c] + T(last.decay) * gamma;
        Lanes::store(place, gamma);
      }
      memory[c] += T(now.decay) * gamma;
    }
  }
  return physics::Viscous<T>{instant, physics::symmetric<T>(memory)};
}

/// Reads displacement, history; writes partials, history.
template <class Shape, class Law, class Team, class Real>
TM_HOST_DEVICE void element_pass(const Team& team, const SceneView<Real>& s, const ElementView<Real>& e) {
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  constexpr std::uint32_t kRecord = record_reals(Shape::kNodes);
  const Real dt_s = s.control->dt_s;
  const Real history_dt_s = s.newton == nullptr || s.newton->begins_step != 0 ? s.control->history_dt_s : Real(0);
  const auto kind = s.newton == nullptr || s.newton->positive_stiffness != 0 ? physics::Stiffness::kPositive
                                                                             : physics::Stiffness::kConsistent;
  const ElementRange range = element_range(s, e, team.patch());
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    Vec3<T> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(s, e, first, u);
    physics::ElementTensors<Shape, T> tensors;
    const std::uint32_t points = Shape::kSinglePoint ? 1 : e.point_count;
    TM_UNROLL(1)
    for (std::uint32_t q = 0; q < points; ++q) {
      T parameters[Law::kParameterCount];
      load_parameters<Lanes, Shape, Law>(e, q, first, parameters);
      const auto gradients = load_point<Lanes, Shape>(e, q, first);
      const Mat3<T> f = gradients.deformation_gradient(u);
      auto point = Law::at(f, parameters);
      if (e.prony_count == 0) {
        physics::add_point<Shape, Law>(gradients, f, point, nullptr, kind, q == 0, tensors);
      } else {
        const auto viscous = remember<Lanes, Law>(e, q, first, point, dt_s, history_dt_s);
        physics::add_point<Shape, Law>(gradients, f, point, &viscous, kind, q == 0, tensors);
      }
    }

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

/// The smallest det F of a group, after each step: what a law that does not recover from inversion is guarded by.
/// Reads displacement; writes min_det_f.
template <class Shape, class Team, class Real>
TM_HOST_DEVICE void check_volume(const Team& team, const SceneView<Real>& s, const ElementView<Real>& e) {
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  const ElementRange range = element_range(s, e, team.patch());
  T compression = T(-std::numeric_limits<Real>::max());  // −det F
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    Vec3<T> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(s, e, first, u);
    const std::uint32_t points = Shape::kSinglePoint ? 1 : e.point_count;
    TM_UNROLL(1)
    for (std::uint32_t q = 0; q < points; ++q) {
      const Mat3<T> f = load_point<Lanes, Shape>(e, q, first).deformation_gradient(u);  // of padding: the identity
      compression = maximum(compression, T(-f.determinant()));
    }
  });
  const Real worst = team.patch_max(Lanes::largest(compression));
  if (team.leads_patch()) s.min_det_f[e.watch_begin + team.patch()] = -worst;
}

/// How far the elements of a group are from rest, and the energy that is in them; only now and then.
/// Reads displacement; writes watch.
template <class Shape, class Law, class Team, class Real>
TM_HOST_DEVICE void watch_elements(const Team& team, const SceneView<Real>& s, const ElementView<Real>& e) {
  using std::sqrt;
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  const ElementRange range = element_range(s, e, team.patch());
  T compression = T(-std::numeric_limits<Real>::max()), flattening = T(-1);  // −det F, −least stretch
  T strain = T(0), rotation = T(0), energy = T(0);                           // the first two squared
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    Vec3<T> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(s, e, first, u);
    const std::uint32_t points = Shape::kSinglePoint ? 1 : e.point_count;
    TM_UNROLL(1)
    for (std::uint32_t q = 0; q < points; ++q) {
      T parameters[Law::kParameterCount];
      load_parameters<Lanes, Shape, Law>(e, q, first, parameters);
      const auto gradients = load_point<Lanes, Shape>(e, q, first);
      const Mat3<T> f = gradients.deformation_gradient(u);  // of padding: the identity
      // Padding has no parameters, and a law may have no energy without.
      const T own = Law::energy(Law::at(f, parameters)) * gradients.weight;
      energy += select_greater(gradients.weight, T(0), own, T(0));
      compression = maximum(compression, T(-f.determinant()));
      if constexpr (requires { Law::kLeastStretch; }) {
        flattening = maximum(flattening, T(-physics::signed_singular_values(f).sigma[2]));
      }
      for (int c = 0; c < 3; ++c) {
        const int d = (c + 1) % 3;
        const T stretch = f(c, c) - T(1), shear = (f(c, d) + f(d, c)) * T(0.5);
        strain = maximum(strain, maximum(T(stretch * stretch), T(shear * shear)));
      }
      const T x = f(2, 1) - f(1, 2), y = f(0, 2) - f(2, 0), z = f(1, 0) - f(0, 1);
      rotation = maximum(rotation, T((x * x + y * y + z * z) * T(0.25)));
    }
  });
  const Real most[4] = {team.patch_max(Lanes::largest(compression)), team.patch_max(Lanes::largest(flattening)),
                        team.patch_max(Lanes::largest(strain)), team.patch_max(Lanes::largest(rotation))};
  Real sum[1] = {Lanes::sum(energy)};
  team.patch_sum(sum);
  if (team.leads_patch()) {
    s.watch[e.watch_begin + team.patch()] = {-most[0], sqrt(most[2]), sqrt(most[3]), -most[1], sum[0]};
  }
}

/// The 3×3 block at `p`, column-major.
template <class Real>
TM_HOST_DEVICE Eigen::Map<const Mat3<Real>> dense(const Real* p) {
  return Eigen::Map<const Mat3<Real>>(p);
}

/// Gathers the tensors of each row in a fixed order and forms the row of A and b.
/// Reads partials and constant tensors, displacement, velocity, base fields; writes edges, diagonal, rhs,
/// internal_force.
template <bool HasConstant, bool HasPartial, class Team, class Real>
TM_HOST_DEVICE void assemble(const Team& team, const SceneView<Real>& s) {
  const Patch patch = patch_of(s, team.patch());
  const Real h = step_size(s);
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Real mass = s.inertia[4 * row], alpha = s.inertia[4 * row + 1], beta = s.inertia[4 * row + 2];
    // What M and K are applied to; neighbours of a row belong to the same body and have its damping.
    const auto momentum_gap = [&](std::size_t r) -> Vec3<Real> {
      const Vec3<Real> velocity = load3<Real>(s.velocity, r);
      const Vec3<Real> lost = velocity * (-alpha * h);
      if (s.base_velocity == nullptr) return lost;
      return lost + load3<Real>(s.base_velocity, r) - velocity;
    };
    const auto stretch_ahead = [&](std::size_t r) -> Vec3<Real> {
      return change_ahead(s, r) + load3<Real>(s.velocity, r) * beta;
    };

    Vec3<Real> force = Vec3<Real>::Zero();
    if constexpr (HasPartial) {
      for (std::uint32_t i = s.force_gather_begin[row]; i < s.force_gather_begin[row + 1]; ++i) {
        force += Eigen::Map<const Vec3<Real>>(s.partials + s.force_gather[i]);
      }
    }
    // K_kk = −Σ K_kl, so K d and K u of the row are sums over its edges of K_kl (d_l − d_k).
    const Vec3<Real> displacement = load3<Real>(s.displacement, row);
    const Vec3<Real> own_ahead = stretch_ahead(row);
    Mat3<Real> vertex = Mat3<Real>::Zero();
    Vec3<Real> stiffness_ahead = Vec3<Real>::Zero();
    Vec3<Real> momentum = momentum_gap(row) * mass;
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
      stiffness_ahead += edge * (stretch_ahead(other) - own_ahead);
      edge *= h * (beta + h);
      if (s.mass_edges != nullptr) {
        const Real shared = s.mass_edges[slot];
        edge += Mat3<Real>::Identity() * (shared * (1 + alpha * h));
        momentum += momentum_gap(other) * shared;
      }
      store_block<Real>(s.edges, slot, edge);
    });

    const Mat3<Real> diagonal = vertex * (h * (beta + h)) + Mat3<Real>::Identity() * (mass * (1 + alpha * h));
    store_symmetric(s.diagonal, row, diagonal);
    store3<Real>(s.rhs, row, (force - stiffness_ahead) * h + momentum);
    if (s.internal_force != nullptr) store3<Real>(s.internal_force, row, force);
  });
}

/// Adds constant forces: gravity and loads. Only scenes that name them have this stage.
template <class Team, class Real>
TM_HOST_DEVICE void add_external_forces(const Team& team, const SceneView<Real>& s) {
  const Patch patch = patch_of(s, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    store3<Real>(s.rhs, row, load3<Real>(s.rhs, row) + load3<Real>(s.external, row) * step_size(s));
  });
}

/// Pressure follows the surface; its change with the deformation stays out of the matrix, which it would make
/// unsymmetric. Reads displacement; adds to rhs.
template <class Team, class Real>
TM_HOST_DEVICE void add_pressure(const Team& team, const SceneView<Real>& s) {
  team.for_each(s.patch_pressed[team.patch()], s.patch_pressed[team.patch() + 1], [&](std::uint32_t i) {
    const std::uint32_t row = s.pressed_rows[i];
    Vec3<Real> force = Vec3<Real>::Zero();
    for (std::uint32_t c = s.pressed_begin[i]; c < s.pressed_begin[i + 1]; ++c) {
      const PressureFace<Real>& face = s.pressure_faces[s.pressed_corners[2 * c]];
      Vec3<Real> x[physics::kMaxFaceNodes];
      for (std::uint32_t k = 0; k < face.node_count; ++k) x[k] = position(s, face.rows[k]);
      force -= physics::face_area_vector(x, static_cast<int>(face.node_count),
                                         static_cast<int>(s.pressed_corners[2 * c + 1])) *
               face.pressure_pa;
    }
    store3<Real>(s.rhs, row, load3<Real>(s.rhs, row) + force * step_size(s));
  });
}

}  // namespace tensormass::tensor
