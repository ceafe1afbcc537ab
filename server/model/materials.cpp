#include <algorithm>
#include <cmath>
#include <numeric>

#include <fmt/format.h>

#include "mesh/shapes.h"
#include "model/read_parts.h"
#include "model/scene_input.h"
#include "tensormass/v1/scene.pb.h"

namespace tensormass::model {

namespace {

/// Returns the elements that have all of their nodes in the region.
std::vector<std::uint32_t> elements_in(const mesh::Mesh& mesh, const std::vector<std::uint32_t>& nodes) {
  std::vector<bool> chosen(mesh.nodes.size(), false);
  for (const std::uint32_t node : nodes) chosen[node] = true;
  std::vector<std::uint32_t> elements;
  mesh::for_each_element(mesh, [&](std::uint32_t element, const mesh::Topology&, std::span<const std::uint32_t> of) {
    if (std::all_of(of.begin(), of.end(), [&](std::uint32_t node) { return chosen[node]; }))
      elements.push_back(element);
  });
  return elements;
}

/// Reads a field of element_fields: [element_count, components]; empty if the scene does not give it.
Result<std::vector<double>> read_field(const std::string& bytes, std::size_t components, std::size_t element_count,
                                       std::string_view where) {
  if (bytes.empty()) return std::vector<double>{};
  TM_ASSIGN_OR_RETURN(values, read_reals(bytes, components, where));
  if (values.size() != components * element_count) {
    return invalid(
        fmt::format("{}: {} values for {} elements; give {} each", where, values.size(), element_count, components));
  }
  for (std::size_t i = 0; i < values.size(); ++i) {
    if (!std::isfinite(values[i])) {
      return invalid(fmt::format("{}: value {} of element {} is not finite", where, values[i], i / components));
    }
  }
  return values;
}

/// Says whether elements of the body have values of their own.
bool has_fields(const v1::Body& body) {
  const v1::ElementFields& fields = body.element_fields();
  return !(fields.young_modulus_pa().empty() && fields.poisson_ratio().empty() && fields.fibre_directions().empty());
}

}  // namespace

Result<void> read_materials(const v1::Body& body, ReadBody& out, std::string_view where) {
  const std::size_t element_count = mesh::element_count(out.mesh);
  TM_ASSIGN_OR_RETURN(sets, read_sets(body, out.nodes(), where));
  for (int i = 0; i < body.law_regions_size(); ++i) {
    const std::string at = fmt::format("{}.law_regions[{}]", where, i);
    TM_ASSIGN_OR_RETURN(nodes, read_region(body.law_regions(i).region(), out.nodes(), sets, at + ".region"));
    const std::vector<std::uint32_t> elements = elements_in(out.mesh, nodes);
    if (elements.empty()) {
      return invalid(fmt::format("{}.region: no element has all of its nodes in it; make it larger", at));
    }
    out.element_laws.resize(element_count, 0);
    for (const std::uint32_t element : elements) out.element_laws[element] = static_cast<std::uint32_t>(i) + 1;
  }
  TM_ASSIGN_OR_RETURN(materials, read_materials(body, out.element_laws, element_count, where));
  out.element_materials = out.element_laws;
  if (has_fields(body)) {
    out.element_materials.resize(element_count);
    std::iota(out.element_materials.begin(), out.element_materials.end(), 0u);
  }
  out.materials = std::move(materials);
  return {};
}

Result<std::vector<Material>> read_materials(const v1::Body& body, std::span<const std::uint32_t> element_laws,
                                             std::size_t element_count, std::string_view where) {
  std::vector<const v1::Law*> laws{&body.law()};
  std::vector<std::string> law_where{fmt::format("{}.law", where)};
  for (int i = 0; i < body.law_regions_size(); ++i) {
    laws.push_back(&body.law_regions(i).law());
    law_where.push_back(fmt::format("{}.law_regions[{}].law", where, i));
  }
  const v1::ElementFields& fields = body.element_fields();
  const std::string at = fmt::format("{}.element_fields", where);
  TM_ASSIGN_OR_RETURN(young, read_field(fields.young_modulus_pa(), 1, element_count, at + ".young_modulus_pa"));
  TM_ASSIGN_OR_RETURN(poisson, read_field(fields.poisson_ratio(), 1, element_count, at + ".poisson_ratio"));
  TM_ASSIGN_OR_RETURN(fibres, read_field(fields.fibre_directions(), 3, element_count, at + ".fibre_directions"));
  std::vector<Material> materials;
  if (!has_fields(body)) {
    for (std::size_t i = 0; i < laws.size(); ++i) {
      TM_ASSIGN_OR_RETURN(material, read_law(*laws[i], {}, law_where[i]));
      materials.push_back(std::move(material));
    }
    return materials;
  }
  std::vector<ElementLaw> by_law;
  for (std::size_t i = 0; i < laws.size(); ++i) by_law.push_back(element_law(*laws[i], law_where[i]));
  materials.reserve(element_count);
  for (std::uint32_t e = 0; e < element_count; ++e) {
    ElementValues values;
    if (!young.empty()) values.young_modulus_pa = young[e];
    if (!poisson.empty()) values.poisson_ratio = poisson[e];
    if (!fibres.empty()) values.fibre_direction = Vec3<double>(fibres[3 * e], fibres[3 * e + 1], fibres[3 * e + 2]);
    auto material = by_law[element_laws.empty() ? 0 : element_laws[e]](values);
    if (!material) return invalid(fmt::format("{}, element {}: {}", at, e, material.error().message));
    materials.push_back(std::move(*material));
  }
  return materials;
}

}  // namespace tensormass::model
