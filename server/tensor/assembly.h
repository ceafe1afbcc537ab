#pragma once

#include <cmath>
#include <limits>

#include "physics/element/element.h"
#include "tensor/edges.h"
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

/// The part of an element group that a patch works on: whole slices, or what touches the patch (Storage::kEdges).
struct ElementRange {
  std::uint32_t begin, end;
};
template <class Real>
TM_HOST_DEVICE ElementRange element_range(const SceneView<Real>& s, const ElementView<Real>& e, std::uint32_t patch) {
  if (e.patch_elements != nullptr) return {e.patch_elements[2 * patch], e.patch_elements[2 * patch + 1]};
  const std::uint32_t slices = e.count / kSliceRows;
  return {static_cast<std::uint32_t>(std::uint64_t{slices} * patch / s.patch_count) * kSliceRows,
          static_cast<std::uint32_t>(std::uint64_t{slices} * (patch + 1) / s.patch_count) * kSliceRows};
}

template <class Lanes, class Shape, class Real>
TM_HOST_DEVICE void load_displacement(const SceneView<Real>& s, const ElementView<Real>& e, std::uint32_t first,
                                      Vec3<typename Lanes::Scalar> (&u)[Shape::kNodes]) {
  TM_UNROLL_ALL
  for (int k = 0; k < Shape::kNodes; ++k) {
    u[k] = Lanes::gather3(s.displacement, e.rows + std::size_t{static_cast<std::uint32_t>(k)} * e.count + first);
  }
}

/// Reals that lie together and begin at a multiple of four, as many as fill up to one. Once: see read_once.
template <bool Once = false, std::uint32_t Count, class Real>
TM_HOST_DEVICE void read_reals(const Real* from, Real (&to)[Count]) {
  static_assert(Count % 4 == 0);
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < Count; c += 4) {
      const auto* p = reinterpret_cast<const float4*>(from + c);
      const float4 v = Once ? read_once(p) : *p;
      to[c] = v.x;
      to[c + 1] = v.y;
      to[c + 2] = v.z;
      to[c + 3] = v.w;
    }
  } else
#endif
  {
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < Count; ++c) to[c] = from[c];
  }
}

/// As read_reals reads them.
template <std::uint32_t Count, class Real>
TM_HOST_DEVICE void write_reals(const Real (&from)[Count], Real* to) {
  static_assert(Count % 4 == 0);
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < Count; c += 4) {
      *reinterpret_cast<float4*>(to + c) = {from[c], from[c + 1], from[c + 2], from[c + 3]};
    }
  } else
#endif
  {
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < Count; ++c) to[c] = from[c];
  }
}

template <class Shape, class Real>
TM_HOST_DEVICE std::uint32_t points_of(const ElementView<Real>& e) {
  return Shape::kSinglePoint ? 1 : e.point_count;
}

/// Elements that are read one by one are records, those that are read by packs are structures of arrays.
template <class Lanes>
inline constexpr bool kReadsRecords = Lanes::kWidth == 1;

/// A quadrature point of elements as it is stored. Reading it waits for nothing: what follows from it is computed where
/// it is used.
template <class Lanes, class Shape, class Law>
struct StoredPoint {
  using T = typename Lanes::Scalar;
  static constexpr std::uint32_t kReals = physics::kRestReals<Shape>;
  T reals[round_to_four(kReals)];
  T parameters[maximum(Law::kParameterCount, 1)];

  StoredPoint() = default;
  template <class Real>
  TM_HOST_DEVICE StoredPoint(const ElementView<Real>& e, std::uint32_t q, std::uint32_t first) {
    if constexpr (kReadsRecords<Lanes>) {
      const std::uint32_t points = points_of<Shape>(e), stride = point_stride(kReals, points);
      const Real* record = e.records + std::size_t{first} * e.record_reals;
      // Of a single point the rows that read it lie in a few slices, which a device evaluates at about the same time.
      read_reals<Shape::kSinglePoint>(record + q * stride, reals);
      // Of a single point the first parameters have come with what fills up its reals.
      constexpr int kParameters = Law::kParameterCount;
      constexpr int kFilling = static_cast<int>(round_to_four(kReals) - kReals);
      constexpr int kRead = Shape::kSinglePoint ? minimum(kFilling, kParameters) : 0;
      TM_UNROLL_ALL
      for (int c = 0; c < kRead; ++c) parameters[c] = reals[kReals + c];
      TM_UNROLL_ALL
      for (int c = kRead; c < kParameters; ++c) parameters[c] = record[points * stride + c];
    } else {
      const Real* rest = e.rest + std::size_t{q} * kReals * e.count + first;
      TM_UNROLL_ALL
      for (std::uint32_t c = 0; c < kReals; ++c) reals[c] = Lanes::load(rest + std::size_t{c} * e.count);
      for (int c = 0; c < Law::kParameterCount; ++c) {
        parameters[c] = Lanes::load(e.parameters + static_cast<std::size_t>(c) * e.count + first);
      }
    }
  }

  TM_HOST_DEVICE auto gradients() const {
    return physics::PointGradients<Shape, T>::read([&](int c) { return reals[c]; });
  }
  /// The law at F, or at what F is decomposed to, with the part of its moduli that the point integrates.
  template <class Real, class DeformationGradient>
  TM_HOST_DEVICE auto law_at(const ElementView<Real>& e, std::uint32_t q, const DeformationGradient& f) const {
    T own[maximum(Law::kParameterCount, 1)];
    for (int c = 0; c < Law::kParameterCount; ++c) own[c] = parameters[c];
    if (!Shape::kSinglePoint && e.shares != nullptr) {
      Law::scale_moduli(own, T(e.shares[q].deviatoric), T(e.shares[q].volumetric));
    }
    return Law::at(f, own);
  }
};

/// What who looks at shapes alone reads of a law: nothing.
struct NoLaw {
  static constexpr int kParameterCount = 0;
};

/// By how much the histories of elements are to move on: the length of the last step in the first evaluation of this
/// one [s], then zero.
template <class Real>
TM_HOST_DEVICE Real history_step(const SceneView<Real>& s) {
  return s.newton == nullptr || s.newton->begins_step != 0 ? s.control->history_dt_s : Real(0);
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

/// Calls visit(gradients, F, law's point, index of the point) for each quadrature point. u: of the elements' nodes.
template <class Lanes, class Shape, class Law, class Real, class Visit>
TM_HOST_DEVICE void for_each_point(const ElementView<Real>& e, std::uint32_t first,
                                   const Vec3<typename Lanes::Scalar> (&u)[Shape::kNodes], const Visit& visit) {
  TM_UNROLL(1)
  for (std::uint32_t q = 0; q < points_of<Shape>(e); ++q) {
    const StoredPoint<Lanes, Shape, Law> stored(e, q, first);
    const auto gradients = stored.gradients();
    const Mat3<typename Lanes::Scalar> f = gradients.deformation_gradient(u);
    auto point = stored.law_at(e, q, f);
    visit(gradients, f, point, q);
  }
}

template <class Real>
TM_HOST_DEVICE physics::Stiffness stiffness_kind(const SceneView<Real>& s) {
  return s.newton == nullptr || s.newton->positive_stiffness != 0 ? physics::Stiffness::kPositive
                                                                  : physics::Stiffness::kConsistent;
}

/// Calls add(memory of a point, or nullptr for a law without). history_dt_s as of remember.
template <class Lanes, class Law, class Real, class Point, class Add>
TM_HOST_DEVICE void with_memory(const SceneView<Real>& s, const ElementView<Real>& e, std::uint32_t q,
                                std::uint32_t first, const Point& point, Real history_dt_s, const Add& add) {
  using Memory = physics::Viscous<typename Lanes::Scalar>;
  if (e.prony_count == 0) return add(static_cast<const Memory*>(nullptr));
  const Memory memory = remember<Lanes, Law>(e, q, first, point, s.control->dt_s, history_dt_s);
  add(&memory);
}

/// Moves the memories of a group to the stress that the last step ended with: where several patches evaluate an
/// element, none of them can.
/// Reads displacement, history; writes history.
template <class Shape, class Law, class Team, class Real>
TM_HOST_DEVICE void move_histories(const Team& team, const SceneView<Real>& s, const ElementView<Real>& e) {
  using Lanes = typename Team::template Lanes<Real>;
  const Real history_dt_s = history_step(s);
  if (!(history_dt_s > 0)) return;
  const ElementRange range = element_range(s, e, team.patch());
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    Vec3<typename Lanes::Scalar> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(s, e, first, u);
    for_each_point<Lanes, Shape, Law>(e, first, u, [&](const auto&, const auto&, const auto& point, std::uint32_t q) {
      remember<Lanes, Law>(e, q, first, point, s.control->dt_s, history_dt_s);
    });
  });
}

/// For a matrix that stores edges. Reads displacement, velocity, base fields, history; adds to edges, diagonal, rhs,
/// internal_force; writes history.
template <class Shape, class Law, class Team, class Real>
TM_FLATTEN void element_pass(const Team& team, const SceneView<Real>& s, const ElementView<Real>& e) {
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  const ElementRange range = element_range(s, e, team.patch());
  const Patch patch = patch_of(s, team.patch());
  const Real history_dt_s = history_step(s);  // this evaluation moves the elements' memory
  const physics::Stiffness kind = stiffness_kind(s);
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    prefetch_elements<Lanes, Shape>(s, e, first);
    Vec3<T> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(s, e, first, u);
    physics::ElementTensors<Shape, T> tensors;
    for_each_point<Lanes, Shape, Law>(
        e, first, u, [&](const auto& gradients, const auto& f, auto& point, std::uint32_t q) {
          with_memory<Lanes, Law>(s, e, q, first, point, history_dt_s, [&](const auto* memory) {
            physics::add_point<Shape, Law>(gradients, f, point, memory, kind, q == 0, tensors);
          });
        });
    const std::uint32_t left = range.end - first;
    add_to_edges<Lanes, Shape>(s, e, patch, first, left < Lanes::kWidth ? left : Lanes::kWidth, tensors);
  });
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
  const Patch patch = patch_of(s, team.patch());
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    // Where patches share elements, the energy is counted by the one that has the first node.
    T counted = T(1);
    if (e.patch_elements != nullptr) {
      Real counts[Lanes::kWidth];
      for (std::uint32_t i = 0; i < Lanes::kWidth; ++i) {
        const std::uint32_t row = e.rows[first + i];
        counts[i] = row >= patch.row_begin && row < patch.row_end ? Real(1) : Real(0);
      }
      counted = Lanes::load(counts);
    }
    Vec3<T> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(s, e, first, u);
    for_each_point<Lanes, Shape, Law>(e, first, u, [&](const auto& gradients, const auto& f, const auto& point, auto) {
      // Padding has no parameters, and a law may have no energy without; its F is the identity.
      const T own = Law::energy(point) * gradients.weight;
      energy += counted * select_greater(gradients.weight, T(0), own, T(0));
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
    });
  });
  Real most[4] = {Lanes::largest(compression), Lanes::largest(flattening), Lanes::largest(strain),
                  Lanes::largest(rotation)};
  Real sum[1] = {Lanes::sum(energy)};
  team.patch_reduce(most, sum);
  if (team.leads_patch()) {
    s.watch[e.watch_begin + team.patch()] = {-most[0], sqrt(most[2]), sqrt(most[3]), -most[1], sum[0]};
  }
}

/// What M and K are applied to in b, and what they are multiplied with in A. Neighbours of a row belong to the same
/// body and have its damping.
template <class Real>
struct RowTerms {
  const SceneView<Real>& s;
  Real h, mass, alpha, beta;

  TM_HOST_DEVICE RowTerms(const SceneView<Real>& scene, std::size_t row)
      : s(scene),
        h(step_size(scene)),
        mass(scene.inertia[4 * row]),
        alpha(scene.inertia[4 * row + 1]),
        beta(scene.inertia[4 * row + 2]) {}

  TM_HOST_DEVICE Real mass_share() const { return 1 + alpha * h; }
  TM_HOST_DEVICE Real stiffness_share() const { return h * (beta + h); }
  TM_HOST_DEVICE Vec3<Real> momentum_gap(std::size_t row) const {
    const Vec3<Real> velocity = load3<Real>(s.velocity, row);
    const Vec3<Real> lost = velocity * (-alpha * h);
    if (s.base_velocity == nullptr) return lost;
    return lost + load3<Real>(s.base_velocity, row) - velocity;
  }
  TM_HOST_DEVICE Vec3<Real> stretch_ahead(std::size_t row) const {
    return change_ahead(s, row) + load3<Real>(s.velocity, row) * beta;
  }
};

/// The part of A and b that is not refreshed: inertia and constant tensors. The element passes add theirs to it.
/// Reads constant tensors, displacement, velocity, base fields; writes edges, diagonal, rhs, internal_force.
template <bool HasConstant, class Team, class Real>
void begin_edges(const Team& team, const SceneView<Real>& s) {
  const Patch patch = patch_of(s, team.patch());
  for (std::uint32_t row = patch.row_begin; row < patch.row_end; ++row) {
    const RowTerms<Real> terms(s, row);
    store_symmetric<Real>(s.diagonal, row, Mat3<Real>::Identity() * (terms.mass * terms.mass_share()));
    store3<Real>(s.rhs, row, terms.momentum_gap(row) * terms.mass);
    if (s.internal_force != nullptr) store3<Real>(s.internal_force, row, Vec3<Real>::Zero());
  }
  if (!HasConstant && s.mass_edges == nullptr) {
    const std::size_t begin = std::size_t{s.slice_begin[patch.row_begin / kEdgeSliceRows]} * kEdgeSliceRows;
    const std::size_t end = std::size_t{s.slice_begin[patch.row_end / kEdgeSliceRows]} * kEdgeSliceRows;
    std::memset(s.edges + edge_begin(begin), 0, (edge_begin(end) - edge_begin(begin)) * sizeof(Real));
    return;
  }
  for_each_edge(s, patch, [&](std::size_t slot, std::uint32_t local, std::uint32_t column, bool both) {
    const std::size_t row = std::size_t{patch.row_begin} + local, other = global_row(s, patch, column);
    const RowTerms<Real> terms(s, row);
    Mat3<Real> block = Mat3<Real>::Zero();
    if constexpr (HasConstant) {
      const Mat3<Real> edge = load_edge(s.constant_edges, slot);
      block = edge * terms.stiffness_share();
      const Vec3<Real> stretch = load3<Real>(s.displacement, other) - load3<Real>(s.displacement, row);
      const Vec3<Real> ahead = stretch + terms.stretch_ahead(other) - terms.stretch_ahead(row);
      const auto add = [&](std::size_t to, const Mat3<Real>& of, Real sign) {
        store3<Real>(s.rhs, to, load3<Real>(s.rhs, to) - of * ahead * (sign * terms.h));
        Real* d = s.diagonal + 8 * to;
        for (int i = 0, c = 0; i < 3; ++i) {
          for (int j = i; j < 3; ++j, ++c) d[c] -= of(i, j) * terms.stiffness_share();
        }
        if (s.internal_force == nullptr) return;
        store3<Real>(s.internal_force, to, load3<Real>(s.internal_force, to) - of * stretch * sign);
      };
      add(row, edge, 1);
      if (both) add(other, edge.transpose(), -1);
    }
    if (s.mass_edges != nullptr) {
      const Real shared = s.mass_edges[slot];
      block += Mat3<Real>::Identity() * (shared * terms.mass_share());
      const auto add = [&](std::size_t to, std::size_t from) {
        store3<Real>(s.rhs, to, load3<Real>(s.rhs, to) + terms.momentum_gap(from) * shared);
      };
      add(row, other);
      if (both) add(other, row);
    }
    store_edge<Real>(s.edges, slot, block);
  });
}

/// What a row's matrix and right-hand side are summed up from.
template <class Real>
struct RowSums {
  Vec3<Real> force = Vec3<Real>::Zero();  // of the elements [N]
  Mat3<Real> vertex = Mat3<Real>::Zero();
  Vec3<Real> stiffness_ahead = Vec3<Real>::Zero();  // K (β v + d)
  Vec3<Real> momentum = Vec3<Real>::Zero();         // of the neighbours
};

/// One row of A and b from the edge tensors K_kl of its slots.
template <bool HasConstant, class Real>
class RowAssembly {
 public:
  /// Reads what is needed of the row itself, so that nothing has to wait for it later.
  TM_HOST_DEVICE RowAssembly(const SceneView<Real>& s, const PatchColumns& patch, std::uint32_t row)
      : s_(s),
        patch_(patch),
        row_(row),
        terms_(s, row),
        displacement_(load3<Real>(s.displacement, row)),
        own_ahead_(terms_.stretch_ahead(row)),
        momentum_gap_(terms_.momentum_gap(row)),
        external_(s.external != nullptr ? load3<Real>(s.external, row) : Vec3<Real>(Vec3<Real>::Zero())) {}

  /// The row behind a slot and how far it moves, and the slot's constant tensor; read before the refreshed tensors,
  /// which takes as long.
  struct Neighbour {
    std::uint32_t row;
    Vec3<Real> ahead;
    Vec3<Real> stretch;  // as the next only where there are constant tensors
    Mat3<Real> constant;
  };
  TM_HOST_DEVICE Neighbour neighbour(std::size_t slot) const {
    Neighbour out;
    out.row = global_row(s_, patch_, s_.columns[slot]);
    out.ahead = terms_.stretch_ahead(out.row);
    if constexpr (HasConstant) {
      out.stretch = load3<Real>(s_.displacement, out.row) - displacement_;
      out.constant = load_block_once(s_.constant_edges, slot);
    }
    return out;
  }
  /// The same where it is known how far the row behind the slot moves, and there are no constant tensors.
  TM_HOST_DEVICE Neighbour neighbour(std::size_t slot, const Vec3<Real>& ahead) const {
    static_assert(!HasConstant);
    Neighbour out;
    out.row = s_.mass_edges != nullptr ? global_row(s_, patch_, s_.columns[slot]) : 0;
    out.ahead = ahead;
    return out;
  }
  /// edge: of the elements whose tensors are refreshed. Returns the block of A.
  TM_HOST_DEVICE Mat3<Real> couple(std::size_t slot, const Neighbour& neighbour, Mat3<Real> edge,
                                   RowSums<Real>& sums) const {
    if constexpr (HasConstant) {
      sums.force -= neighbour.constant * neighbour.stretch;
      edge += neighbour.constant;
    }
    // K_kk = −Σ K_kl, so K d and K u of the row are sums over its edges of K_kl (d_l − d_k).
    sums.vertex -= edge;
    sums.stiffness_ahead += edge * (neighbour.ahead - own_ahead_);
    edge *= terms_.stiffness_share();
    if (s_.mass_edges != nullptr) {
      const Real shared = s_.mass_edges[slot];
      edge += Mat3<Real>::Identity() * (shared * terms_.mass_share());
      sums.momentum += terms_.momentum_gap(neighbour.row) * shared;
    }
    return edge;
  }
  TM_HOST_DEVICE void finish(const RowSums<Real>& sums) const {
    const Mat3<Real> diagonal =
        sums.vertex * terms_.stiffness_share() + Mat3<Real>::Identity() * (terms_.mass * terms_.mass_share());
    store_symmetric(s_.diagonal, row_, diagonal);
    const Vec3<Real> momentum = sums.momentum + momentum_gap_ * terms_.mass;
    const Vec3<Real> force = sums.force - sums.stiffness_ahead + external_;
    store3<Real>(s_.rhs, row_, force * terms_.h + momentum);
    if (s_.internal_force != nullptr) store3<Real>(s_.internal_force, row_, sums.force);
  }

 private:
  const SceneView<Real>& s_;
  const PatchColumns& patch_;
  const std::uint32_t row_;
  const RowTerms<Real> terms_;
  const Vec3<Real> displacement_, own_ahead_, momentum_gap_, external_;
};

/// Adds constant forces, gravity and loads, to rows that store edges; others have them when they are finished.
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
