#include "model/values.h"

#include <algorithm>
#include <array>
#include <string>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/parallel.h"
#include "model/edit.h"
#include "model/pair_stiffness.h"
#include "model/read_parts.h"
#include "physics/element/element.h"
#include "physics/lists.h"
#include "tensormass/v1/scene.pb.h"

namespace tensormass::model {

namespace {

/// Elements that a thread takes at once.
constexpr std::size_t kGrain = 16384;

/// Calls visit(gradients, weight, own moduli) for each quadrature point of a record.
template <class Shape, class Law, class Visit>
void for_each_point(const ElementGroup& group, std::uint32_t place, const Visit& visit) {
  for (std::size_t q = 0; q < group.point_count; ++q) {
    const auto gradients = physics::PointGradients<Shape, double>::read([&](int c) {
      return group.rest[(q * physics::kRestReals<Shape> + static_cast<std::size_t>(c)) * group.stride + place];
    });
    std::array<double, Law::kParameterCount> parameters;
    for (std::size_t c = 0; c < parameters.size(); ++c) parameters[c] = group.parameters[c * group.stride + place];
    if (!group.shares.empty()) {
      Law::scale_moduli(parameters.data(), group.shares[q].deviatoric, group.shares[q].volumetric);
    }
    visit(gradients, parameters.data());
  }
}

/// Adds the tensors of one record to all of its edges.
template <class Shape, class Law>
void add_record(const matrix::Layout& layout, const ElementGroup& group, std::uint32_t place, double* edges) {
  std::array<Mat3<double>, Shape::kNodes*(Shape::kNodes - 1) / 2> pairs;
  for (Mat3<double>& pair : pairs) pair.setZero();
  for_each_point<Shape, Law>(group, place, [&](const auto& gradients, const double* parameters) {
    for (int k = 0; k < Shape::kNodes; ++k) {
      for (int l = k + 1; l < Shape::kNodes; ++l) {
        pairs[static_cast<std::size_t>(physics::pair_index(Shape::kNodes, k, l))] +=
            pair_stiffness_at_point<Law>(gradients.a[k], gradients.a[l], gradients.weight, parameters);
      }
    }
  });
  const auto row = [&](int k) { return group.rows[static_cast<std::size_t>(k) * group.stride + place]; };
  for (int k = 0; k < Shape::kNodes; ++k) {
    for (int l = k + 1; l < Shape::kNodes; ++l) {
      const Mat3<double>& pair = pairs[static_cast<std::size_t>(physics::pair_index(Shape::kNodes, k, l))];
      layout.for_each_place(row(k), row(l), [&](std::uint32_t slot, bool transposed) {
        for (std::uint32_t i = 0; i < 9; ++i) {
          edges[layout.component(slot, i)] += transposed ? pair(i % 3, i / 3) : pair(i / 3, i % 3);
        }
      });
    }
  }
}

/// Returns the materials of a body, as a compile of the message has them.
Result<std::vector<std::vector<Material>>> read_all_materials(const ValueTables& tables, const v1::Scene& scene) {
  std::vector<std::vector<Material>> all;
  for (std::size_t b = 0; b < tables.bodies.size(); ++b) {
    const ValueTables::Body& body = tables.bodies[b];
    const v1::Body& message = scene.bodies(static_cast<int>(b));
    TM_ASSIGN_OR_RETURN(materials, read_materials(message, body.element_laws, body.element_count,
                                                  fmt::format("body '{}'", message.name())));
    all.push_back(std::move(materials));
  }
  return all;
}

/// The materials of a scene with new moduli, by the numbers of its elements.
class Materials {
 public:
  Materials(const Model& m, std::vector<std::vector<Material>> materials) : m_(m), materials_(std::move(materials)) {}

  const Material& of(std::uint32_t element) const {
    const std::size_t b = m_.body_of_element(element);
    const std::vector<std::uint32_t>& places = m_.value_tables->bodies[b].element_materials;
    return materials_[b][places.empty() ? 0 : places[element - m_.bodies[b].element_begin]];
  }

 private:
  const Model& m_;
  std::vector<std::vector<Material>> materials_;
};

void write_parameters(const Materials& materials, const ValueTables::Group& of, ElementGroup& group) {
  const std::size_t count = group.parameters.size() / group.stride;
  parallel_ranges(of.elements.size(), kGrain, [&](std::size_t begin, std::size_t end) {
    const Material* last = nullptr;
    Material kept;
    for (std::size_t place = begin; place < end; ++place) {
      if (of.elements[place] == mesh::kNone) continue;
      const Material& whole = materials.of(of.elements[place]);
      if (of.shares_deviatoric && &whole != last) kept = kept_by_member(whole, of.deviatoric_part);
      last = &whole;
      const Material& material = of.shares_deviatoric ? kept : whole;
      TM_ASSERT(material.law == group.law && material.parameters.size() == count, "values do not change laws");
      for (std::size_t c = 0; c < count; ++c) group.parameters[c * group.stride + place] = material.parameters[c];
    }
  });
}

void write_moduli(const Materials& materials, Model& m) {
  for (std::size_t g = 0; g < m.groups.size(); ++g) {
    write_parameters(materials, m.value_tables->groups[g], m.groups[g]);
  }
  ContactSurface& contact = m.contact;
  for (std::uint32_t t = 0; t < contact.triangle_count(); ++t) {
    if (contact.triangle_elements[t] == mesh::kNone) continue;
    const std::array<double, 2> moduli = contact_moduli(materials.of(contact.triangle_elements[t]));
    std::copy(moduli.begin(), moduli.end(), contact.triangle_moduli.begin() + 2 * std::ptrdiff_t{t});
  }
  write_surface_moduli(m.layout, contact, m.bodies);
  for (std::uint32_t e = 0; 2 * std::size_t{e} < m.element_moduli.size(); ++e) {
    const std::array<double, 2> moduli = contact_moduli(materials.of(e));
    std::copy(moduli.begin(), moduli.end(), m.element_moduli.begin() + 2 * std::ptrdiff_t{e});
  }
  Links& links = m.links;
  if (links.candidate_count() > 0) {
    const VertexSums sums = sums_at_vertices(contact);
    for (std::size_t i = 0; i < links.candidate_modulus.size(); ++i) {
      const std::uint32_t vertex = links.candidates[2 * i];
      links.candidate_modulus[i] = sums.stiffness[vertex] / sums.area_m2[vertex];
    }
  }
  for (std::size_t i = 0; i < links.triangle_edges.size(); ++i) {
    const std::uint32_t edge = links.triangle_edges[i];
    if (edge == view::kNoEntry) continue;
    links.edge_numbers[std::size_t{view::kEdgeNumbers} * edge + view::kEdgeModulus] =
        modulus_of_edge(contact, static_cast<std::uint32_t>(i / 3), contact.triangle_neighbours[i]);
  }
}

void write_damping(std::span<const Damping> damping, Model& m) {
  if (m.quasi_static()) return;
  for (std::uint32_t node = 0; node < m.layout.row_of_node.size(); ++node) {
    const Damping& of_body = damping[m.body_of_node(node)];
    double* const inertia = &m.inertia[4 * std::size_t{m.layout.row_of_node[node]}];
    inertia[1] = of_body.mass_per_s;
    inertia[2] = of_body.stiffness_s;
  }
}

/// Returns a component of a weight [N]. Never inlined: gcc would fuse the product with the sum of the loads, and the
/// scene would differ in last bits from one compiled by an earlier version.
[[gnu::noinline]] double weight_of(double mass_kg, double gravity_m_per_s2) { return mass_kg * gravity_m_per_s2; }

/// Copies all that with_values changes.
void copy_values(const Model& from, Model& to) {
  to.gravity_m_per_s2 = from.gravity_m_per_s2;
  to.inertia = from.inertia;
  to.external = from.external;
  to.constant_edges = from.constant_edges;
  to.element_moduli = from.element_moduli;
  to.contact.triangle_moduli = from.contact.triangle_moduli;
  to.links.candidate_modulus = from.links.candidate_modulus;
  to.links.edge_numbers = from.links.edge_numbers;
  for (std::size_t g = 0; g < from.groups.size(); ++g) to.groups[g].parameters = from.groups[g].parameters;
  for (std::size_t b = 0; b < from.bodies.size(); ++b) static_cast<SurfaceModuli&>(to.bodies[b]) = from.bodies[b];
}

/// Says whether constant tensors of two models of a scene differ: whether linear laws have other moduli.
bool have_other_tensors(std::span<const ElementGroup> present, std::span<const ElementGroup> next) {
  for (std::size_t g = 0; g < next.size(); ++g) {
    if (next[g].is_constant && next[g].parameters != present[g].parameters) return true;
  }
  return false;
}

}  // namespace

Result<std::shared_ptr<const Model>> with_values(const Model& present, const v1::Scene& scene, SpareModel& spare) {
  TM_ASSERT(present.value_tables != nullptr, "a compiled model has the sources of its values");
  TM_ASSERT(static_cast<std::size_t>(scene.bodies_size()) == present.bodies.size(), "the same scene");
  TM_ASSIGN_OR_RETURN(settings, read_settings(scene));
  TM_ASSIGN_OR_RETURN(damping, read_damping(scene));
  TM_ASSIGN_OR_RETURN(materials, read_all_materials(*present.value_tables, scene));
  const bool gravity_changes = settings.gravity_m_per_s2 != present.gravity_m_per_s2;
  const bool loads_change = present.quasi_static() || !present.scheduled.schedules.empty();
  if (settings.has_gravity != present.has_gravity || (gravity_changes && loads_change)) {
    return std::shared_ptr<const Model>();
  }
  std::unique_ptr<Model> next = spare.take(present);
  copy_values(present, *next);
  next->gravity_m_per_s2 = settings.gravity_m_per_s2;
  write_moduli(Materials(*next, std::move(materials)), *next);
  write_damping(damping, *next);
  const bool tensors_change = have_other_tensors(present.groups, next->groups);
  if (next->edit_tables != nullptr) {
    if (tensors_change || gravity_changes) Editor(*next).write_values(*next);
  } else {
    if (gravity_changes) {
      write_weights(next->value_tables->loads, next->row_mass, next->gravity_m_per_s2, next->external);
    }
    if (tensors_change) {
      next->constant_edges = add_up_constant_tensors(next->layout, next->groups, next->value_tables->linear);
    }
  }
  return spare.share(std::move(next));
}

std::vector<EditRange> changed(const Model& present, const Model& next) {
  std::vector<EditRange> out;
  const auto compare = [&](EditBuffer buffer, const std::vector<double>& a, const std::vector<double>& b,
                           std::size_t group = 0) {
    TM_ASSERT(a.size() == b.size(), "values do not change sizes");
    if (a != b) out.push_back({buffer, static_cast<std::uint32_t>(group), 0, static_cast<std::uint32_t>(b.size()), 1});
  };
  compare(EditBuffer::kInertia, present.inertia, next.inertia);
  compare(EditBuffer::kExternal, present.external, next.external);
  compare(EditBuffer::kConstantEdges, present.constant_edges, next.constant_edges);
  compare(EditBuffer::kTriangleModuli, present.contact.triangle_moduli, next.contact.triangle_moduli);
  compare(EditBuffer::kCandidateModuli, present.links.candidate_modulus, next.links.candidate_modulus);
  compare(EditBuffer::kEdgeNumbers, present.links.edge_numbers, next.links.edge_numbers);
  for (std::size_t g = 0; g < next.groups.size(); ++g) {
    compare(EditBuffer::kElementParameters, present.groups[g].parameters, next.groups[g].parameters, g);
  }
  return out;
}

Material kept_by_member(Material material, double deviatoric_part) {
  physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
    using Law = typename decltype(tag)::Type;
    if (index == material.law) Law::scale_moduli(material.parameters.data(), 1 - deviatoric_part, 0.0);
  });
  return material;
}

Mat3<double> constant_tensor(const ElementGroup& group, std::uint32_t place, std::uint32_t k, std::uint32_t l) {
  Mat3<double> out = Mat3<double>::Zero();
  physics::with_shape_and_law(group.shape, group.law, [&](auto shape, auto law) {
    using Law = typename decltype(law)::Type;
    if constexpr (Law::kConstantStiffness) {
      for_each_point<typename decltype(shape)::Type, Law>(
          group, place, [&](const auto& gradients, const double* parameters) {
            out += pair_stiffness_at_point<Law>(gradients.a[k], gradients.a[l], gradients.weight, parameters);
          });
    }
  });
  return out;
}

std::vector<double> add_up_constant_tensors(const matrix::Layout& layout, std::span<const ElementGroup> groups,
                                            std::span<const RecordPlace> records) {
  std::vector<double> edges;
  if (records.empty()) return edges;
  edges.assign(9 * std::size_t{layout.slot_count()}, 0);
  while (!records.empty()) {
    const std::uint32_t g = records.front().group;
    const auto next = std::find_if(records.begin(), records.end(), [&](const auto& one) { return one.group != g; });
    const std::span<const RecordPlace> same(records.begin(), next);
    physics::with_shape_and_law(groups[g].shape, groups[g].law, [&](auto shape, auto law) {
      using Law = typename decltype(law)::Type;
      if constexpr (Law::kConstantStiffness) {
        for (const RecordPlace& one : same) {
          add_record<typename decltype(shape)::Type, Law>(layout, groups[g], one.place, edges.data());
        }
      }
    });
    records = records.subspan(same.size());
  }
  return edges;
}

void write_weights(std::span<const double> loads, std::span<const double> row_mass,
                   const Vec3<double>& gravity_m_per_s2, std::span<double> external) {
  for (std::size_t row = 0; row < row_mass.size(); ++row) {
    for (std::size_t c = 0; c < 3; ++c) {
      const double load = loads.empty() ? 0.0 : loads[4 * row + c];
      external[4 * row + c] = load + weight_of(row_mass[row], gravity_m_per_s2[static_cast<Eigen::Index>(c)]);
    }
  }
}

void write_surface_moduli(const matrix::Layout& layout, const ContactSurface& contact, std::span<BodyModel> bodies) {
  std::vector<bool> met(bodies.size(), false);
  for (std::size_t t = 0; t < contact.triangle_count(); ++t) {
    if (contact.triangle_elements[t] == mesh::kNone) continue;
    const std::size_t b = body_of_node(bodies, layout.node_of_row[contact.row_of(t)]);
    SurfaceModuli& body = bodies[b];
    const double young_pa = contact.triangle_moduli[2 * t];
    if (!met[b]) body.least_surface_modulus_pa = body.most_surface_modulus_pa = young_pa;
    met[b] = true;
    body.least_surface_modulus_pa = std::min(body.least_surface_modulus_pa, young_pa);
    body.most_surface_modulus_pa = std::max(body.most_surface_modulus_pa, young_pa);
  }
}

VertexSums sums_at_vertices(const ContactSurface& contact) {
  VertexSums out;
  out.area_m2.assign(contact.surface_rows.size(), 0);
  out.stiffness.assign(contact.surface_rows.size(), 0);
  for (std::uint32_t t = 0; t < contact.outer_count(); ++t) {
    for (std::size_t i = 0; i < 3; ++i) {
      const std::uint32_t vertex = contact.vertex_of_corner[3 * std::size_t{t} + i];
      out.area_m2[vertex] += contact.triangle_area[t] / 3;
      out.stiffness[vertex] += contact.triangle_area[t] / 3 * contact.triangle_moduli[2 * std::size_t{t}];
    }
  }
  return out;
}

double modulus_of_edge(const ContactSurface& contact, std::uint32_t triangle, std::uint32_t across) {
  const double area = contact.triangle_area[triangle], other_area = contact.triangle_area[across];
  return (area * contact.triangle_moduli[2 * std::size_t{triangle}] +
          other_area * contact.triangle_moduli[2 * std::size_t{across}]) /
         (area + other_area);
}

}  // namespace tensormass::model
