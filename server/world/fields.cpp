#include "world/fields.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <numeric>
#include <set>
#include <utility>

#include <fmt/format.h>
#include <Eigen/Eigenvalues>

#include "model/loads.h"
#include "physics/element/element.h"
#include "physics/element/face.h"
#include "physics/lists.h"

namespace tensormass::world {

namespace {

/// Forces, stresses, strains and energies of a body, summed over its elements.
struct Measured {
  std::vector<Vec3<double>> force;            // [row] internal and pressure forces, N
  std::vector<std::array<double, 6>> cauchy;  // [element] Pa, xx yy zz yz xz xy
  std::vector<Mat3<double>> strain;           // [element] as the law defines it
  std::vector<double> det_f, energy;          // [element] det F, energy in J
};

/// Adds force, stress, strain, det F and energy of element `e` to `measured`, summed over its quadrature points. A
/// cluster adds its sums to all of its elements. history: the group's viscoelastic internal variables. first_element:
/// index of the body's first element, which is entry 0 of `measured`.
template <class Shape, class Law>
void measure_element(const model::ElementGroup& group, std::span<const double> history, double internal_dt_s,
                     std::uint32_t e, const std::vector<double>& displacement, std::uint32_t first_element,
                     Measured& measured) {
  const auto at = [&](const std::vector<double>& items, std::size_t component) {
    return items[component * group.stride + e];
  };
  Vec3<double> u[Shape::kNodes];
  std::uint32_t rows[Shape::kNodes];
  for (std::size_t k = 0; k < Shape::kNodes; ++k) {
    rows[k] = group.rows[k * group.stride + e];
    u[k] = view::load3<double>(displacement.data(), rows[k]);
  }
  physics::ModuliWeights volume{0, 0};
  double weight = 0;
  Mat3<double> cauchy = Mat3<double>::Zero(), strain = Mat3<double>::Zero();
  double det_f = std::numeric_limits<double>::infinity(), energy = 0;
  for (std::uint32_t q = 0; q < group.point_count; ++q) {
    const auto gradients = physics::PointGradients<Shape, double>::read([&](int c) {
      return at(group.rest, std::size_t{q} * physics::kRestReals<Shape> + static_cast<std::size_t>(c));
    });
    std::array<double, Law::kParameterCount> parameters;
    for (std::size_t c = 0; c < parameters.size(); ++c) parameters[c] = at(group.parameters, c);
    const physics::ModuliWeights shares = group.shares.empty() ? physics::ModuliWeights{} : group.shares[q];
    if (!group.shares.empty()) Law::scale_moduli(parameters.data(), shares.deviatoric, shares.volumetric);
    const Mat3<double> f = gradients.deformation_gradient(u);
    const auto point = Law::at(f, parameters.data());
    Mat3<double> stress = Law::stress(point);
    if (!group.prony.empty()) {
      physics::Viscous<double> viscous{1, Mat3<double>::Zero()};
      for (std::size_t i = 0; i < group.prony.size(); ++i) {
        double gamma[physics::kSymmetricReals];
        for (std::size_t c = 0; c < physics::kSymmetricReals; ++c) {
          gamma[c] =
              history[((std::size_t{q} * group.prony.size() + i) * physics::kSymmetricReals + c) * group.stride + e];
        }
        const physics::PronyTerm& term = group.prony[i];
        const auto step = physics::prony_step(term.share, term.relaxation_time_s, internal_dt_s);
        viscous.instant -= step.gain;
        viscous.memory += physics::symmetric(gamma) * step.decay;
      }
      stress = viscous.template stress<Law>(f, stress);
    }
    for (int k = 0; k < Shape::kNodes; ++k) {
      measured.force[rows[k]] -= stress * gradients.a[k] * gradients.weight;
    }
    const double j = f.determinant();
    det_f = std::min(det_f, j);
    // A linear law does not distinguish Cauchy stress from the first Piola-Kirchhoff stress.
    const Mat3<double> true_stress = Law::kConstantStiffness ? stress : Mat3<double>(stress * f.transpose() / j);
    cauchy += true_stress * gradients.weight;
    const Mat3<double> identity = Mat3<double>::Identity();
    strain += Law::kConstantStiffness ? Mat3<double>(((f + f.transpose()) / 2 - identity) * gradients.weight)
                                      : Mat3<double>((f.transpose() * f - identity) * (gradients.weight / 2));
    weight += gradients.weight;
    // Selective reduced integration covers the volume once for each kind of moduli, or for one kind only.
    volume.deviatoric += shares.deviatoric * gradients.weight;
    volume.volumetric += shares.volumetric * gradients.weight;
    energy += Law::energy(point) * gradients.weight;
  }
  cauchy /= std::max(volume.deviatoric, volume.volumetric);
  const auto add = [&](std::uint32_t element, double part) {
    const std::uint32_t out = element - first_element;
    constexpr std::pair<int, int> kComponents[] = {{0, 0}, {1, 1}, {2, 2}, {1, 2}, {0, 2}, {0, 1}};
    for (std::size_t c = 0; c < std::size(kComponents); ++c) {
      measured.cauchy[out][c] += cauchy(kComponents[c].first, kComponents[c].second);
    }
    measured.det_f[out] = std::min(measured.det_f[out], det_f);
    measured.energy[out] += part * energy;
  };
  if (!group.has_clusters()) {
    add(group.elements[e], 1);
    measured.strain[group.elements[e] - first_element] = strain / weight;
  }
  for (std::size_t i = e; i < group.members.size(); i += group.stride) {
    if (group.members[i] != mesh::kNone) add(group.members[i], group.member_parts[i]);
  }
}

/// Gravity, loads and pressure at a time.
struct Loads {
  std::vector<double> external;  // [row_count, 4]; empty: neither gravity nor forces
  std::vector<view::PressureFace<double>> faces;
};

Loads loads_at(const model::Model& m, double time_s) {
  std::vector<double> factors;
  for (const model::Schedule& schedule : m.scheduled.schedules) factors.push_back(schedule.at(time_s));
  Loads loads{std::vector<double>(m.external.size()), std::vector<view::PressureFace<double>>(m.pressure.faces.size())};
  model::write_external(m, 1, factors, loads.external.data());
  model::write_pressure(m, 1, factors, loads.faces.data());
  return loads;
}

Measured measure(const model::Model& m, const backend::RowState& state,
                 std::span<const view::PressureFace<double>> faces, const model::BodyModel& body) {
  Measured measured;
  measured.force.assign(m.layout.row_count, Vec3<double>::Zero());
  measured.cauchy.assign(body.element_count, {});
  measured.strain.assign(body.element_count, Mat3<double>::Zero());
  measured.det_f.assign(body.element_count, std::numeric_limits<double>::infinity());
  measured.energy.assign(body.element_count, 0);
  std::span<const double> histories = state.internal_variables;
  for (const model::ElementGroup& group : m.groups) {
    const std::span<const double> history = histories.first(group.internal_variable_reals());
    histories = histories.subspan(group.internal_variable_reals());
    physics::with_shape_and_law(group.shape, group.law, [&](auto shape, auto law) {
      for (std::uint32_t e = 0; e < group.elements.size(); ++e) {
        // Unsigned: wraps around for elements of earlier bodies, and kNone belongs to no body.
        if (group.elements[e] - body.element_begin >= body.element_count) continue;
        measure_element<typename decltype(shape)::Type, typename decltype(law)::Type>(
            group, history, state.internal_dt_s, e, state.displacement, body.element_begin, measured);
      }
    });
  }
  // The law gives the stress of raw tissue.
  for (std::uint32_t e = 0; !m.stiffening.empty() && e < body.element_count; ++e) {
    for (double& stress : measured.cauchy[e]) stress *= m.stiffening[body.element_begin + e];
  }
  for (double& det_f : measured.det_f) {
    if (std::isinf(det_f)) det_f = 1;  // an edit took all of its material
  }
  // An element that cuts have split has what its part with the lowest corner has, and all of its energy.
  for (std::size_t i = 0; i < body.element_copies.size(); ++i) {
    const std::size_t loaded = body.element_copies[i].loaded, copy = body.loaded_element_count + i;
    measured.det_f[loaded] = std::min(measured.det_f[loaded], measured.det_f[copy]);
    measured.energy[loaded] += measured.energy[copy];
  }
  measured.cauchy.resize(body.loaded_element_count);
  measured.strain.resize(body.loaded_element_count);
  measured.det_f.resize(body.loaded_element_count);
  measured.energy.resize(body.loaded_element_count);
  for (const auto& face : faces) {
    Vec3<double> x[physics::kMaxFaceNodes];
    for (std::uint32_t k = 0; k < face.node_count; ++k) {
      x[k] = view::load3<double>(m.rest.data(), face.rows[k]) +
             view::load3<double>(state.displacement.data(), face.rows[k]);
    }
    for (std::uint32_t k = 0; k < face.node_count; ++k) {
      measured.force[face.rows[k]] -=
          physics::face_area_vector(x, static_cast<int>(face.node_count), static_cast<int>(k)) * face.pressure_pa;
    }
  }
  return measured;
}

double von_mises(const std::array<double, 6>& s) {
  const double xy = s[0] - s[1], yz = s[1] - s[2], zx = s[2] - s[0];
  return std::sqrt(0.5 * (xy * xy + yz * yz + zx * zx) + 3 * (s[3] * s[3] + s[4] * s[4] + s[5] * s[5]));
}

/// Kinetic energy ½ vᵀ M v of a body [J]; M: mass matrix, lumped or with edges.
double kinetic_energy(const model::Model& m, const std::vector<double>& velocity, const model::BodyModel& body) {
  double twice = 0;
  for (std::uint32_t node = 0; node < body.node_count; ++node) {
    const std::uint32_t row = m.layout.row_of_node[body.node_begin + node];
    const Vec3<double> v = view::load3<double>(velocity.data(), row);
    twice += m.inertia[4 * std::size_t{row}] * v.squaredNorm();
    if (m.mass_edges.empty()) continue;
    const std::uint32_t height = m.layout.slice_rows(), slice = row / height;
    for (std::uint32_t j = m.layout.slice_begin[slice]; j < m.layout.slice_begin[slice + 1]; ++j) {
      const std::size_t slot = std::size_t{j} * height + row % height;
      const std::uint32_t other = m.layout.neighbour_rows[slot];
      if (other == mesh::kNone) continue;
      const double uses = !m.layout.slice_halo.empty() && j < m.layout.slice_halo[slice] ? 2 : 1;  // matrix/edges.h
      twice += uses * m.mass_edges[slot] * v.dot(view::load3<double>(velocity.data(), other));
    }
  }
  return twice / 2;
}

}  // namespace

Result<v1::GetFieldsResponse> measure_fields(const model::Model& m, const backend::RowState& state, double time_s,
                                             const model::BodyModel& body, const v1::GetFieldsRequest& request) {
  std::set<int> asked;
  for (const int field : request.fields()) {
    if (field == v1::FIELD_UNSPECIFIED || !v1::Field_IsValid(field)) {
      return invalid(fmt::format("fields: {} is unknown", field));
    }
    if (!asked.insert(field).second) {
      return invalid(fmt::format("fields: {} is asked for twice", v1::Field_Name(static_cast<v1::Field>(field))));
    }
  }
  const Loads loads = loads_at(m, time_s);
  const Measured measured = measure(m, state, loads.faces, body);
  // A quasi-static scene stores the displacement of the last step in place of a velocity.
  const std::vector<double> still(m.quasi_static() ? state.velocity.size() : 0, 0.0);
  const std::vector<double>& velocity = still.empty() ? state.velocity : still;

  v1::GetFieldsResponse response;
  for (const int field : request.fields()) {
    std::vector<double> values;
    const auto by_node = [&](const auto& of_row) {
      for (std::uint32_t node = 0; node < body.loaded_node_count; ++node) {
        const Vec3<double> v = of_row(std::size_t{m.layout.row_of_node[body.node_begin + node]});
        values.insert(values.end(), v.data(), v.data() + 3);
      }
    };
    std::uint32_t components = 1;
    switch (field) {
      case v1::FIELD_DISPLACEMENT:
        components = 3;
        by_node([&](std::size_t row) { return view::load3<double>(state.displacement.data(), row); });
        break;
      case v1::FIELD_VELOCITY:
        components = 3;
        by_node([&](std::size_t row) { return view::load3<double>(velocity.data(), row); });
        break;
      case v1::FIELD_REACTION_FORCE:
        components = 3;
        by_node([&](std::size_t row) {
          const auto free = static_cast<std::uint32_t>(m.rest[4 * row + 3]);
          Vec3<double> force = -measured.force[row];
          if (!loads.external.empty()) force -= view::load3<double>(loads.external.data(), row);
          for (int c = 0; c < 3; ++c) {
            if ((free >> c & 1) != 0) force[c] = 0;
          }
          return force;
        });
        break;
      case v1::FIELD_CAUCHY_STRESS:
        components = 6;
        for (const auto& stress : measured.cauchy) values.insert(values.end(), stress.begin(), stress.end());
        break;
      case v1::FIELD_VON_MISES_STRESS:
        for (const auto& stress : measured.cauchy) values.push_back(von_mises(stress));
        break;
      case v1::FIELD_LARGEST_STRAIN:
        for (const Mat3<double>& strain : measured.strain) {
          values.push_back(
              Eigen::SelfAdjointEigenSolver<Mat3<double>>(strain, Eigen::EigenvaluesOnly).eigenvalues()[2]);
        }
        break;
      case v1::FIELD_DET_F:
        values = measured.det_f;
        break;
      case v1::FIELD_ELASTIC_ENERGY:
        values = measured.energy;
        break;
      default:  // refused above
        break;
    }
    v1::FieldValues& out = *response.add_fields();
    out.set_field(static_cast<v1::Field>(field));
    out.set_components(components);
    out.set_values(values.data(), values.size() * sizeof(double));
  }
  response.set_elastic_energy_j(std::accumulate(measured.energy.begin(), measured.energy.end(), 0.0));
  response.set_kinetic_energy_j(kinetic_energy(m, velocity, body));
  response.set_min_det_f(*std::min_element(measured.det_f.begin(), measured.det_f.end()));
  return response;
}

}  // namespace tensormass::world
