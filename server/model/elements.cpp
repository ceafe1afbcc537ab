#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <tuple>

#include <fmt/format.h>

#include "core/parallel.h"
#include "matrix/patch_elements.h"
#include "matrix/row_elements.h"
#include "mesh/shapes.h"
#include "model/compile_parts.h"
#include "model/scene_input.h"
#include "model/wedge_pairs.h"
#include "physics/element/element.h"

namespace tensormass::model {

namespace {

using physics::Quadrature;
using view::kSliceRows;

/// Elements that a thread takes at a time.
constexpr std::size_t kGrain = 16384;

/// What of an element's energy a group holds.
enum class Share : std::uint8_t { kWhole, kWithoutDilatation, kDilatationOfPair };

/// What must be equal for elements to be in one group. Groups with refreshed tensors come first; a linear law's range
/// and a memory are watched and kept body by body.
struct GroupKey {
  bool constant;
  int shape, law;
  Quadrature quadrature;
  Share share;
  std::size_t body;
  std::size_t memory;  // index into the Prony series met so far; 0: none
  auto order() const { return std::tie(constant, shape, law, quadrature, share, body, memory); }
  bool operator<(const GroupKey& other) const { return order() < other.order(); }
};

struct Collected {
  std::vector<std::uint32_t> elements, partners;
  std::vector<double> first_parts;
  std::vector<std::uint32_t> rows;  // [element][node]
  std::vector<double> rest;         // [element][..]
  std::vector<double> parameters;   // [element][..]
  std::vector<physics::ModuliWeights> shares;
  std::size_t nodes = 0;
};

/// Elements in the order of their lowest row: neighbours in space are neighbours in memory.
std::vector<std::uint32_t> order_by_first_row(const std::vector<std::uint32_t>& rows, std::size_t width) {
  std::vector<std::uint32_t> order(rows.size() / width), lowest(rows.size() / width);
  std::iota(order.begin(), order.end(), 0);
  for (std::size_t e = 0; e < lowest.size(); ++e) {
    lowest[e] = *std::min_element(rows.begin() + static_cast<std::ptrdiff_t>(e * width),
                                  rows.begin() + static_cast<std::ptrdiff_t>((e + 1) * width));
  }
  std::stable_sort(order.begin(), order.end(), [&](std::uint32_t a, std::uint32_t b) { return lowest[a] < lowest[b]; });
  return order;
}

/// [element][component] to [component][stride] in the given order; the padding is zero.
template <class T>
std::vector<T> transpose(const std::vector<T>& items, std::size_t components, const std::vector<std::uint32_t>& order,
                         std::uint32_t stride) {
  std::vector<T> out(components * stride, T{});
  parallel_ranges(order.size(), kGrain, [&](std::size_t begin, std::size_t end) {
    for (std::size_t e = begin; e < end; ++e) {
      if (order[e] == mesh::kNone) continue;
      for (std::size_t c = 0; c < components; ++c) out[c * stride + e] = items[order[e] * components + c];
    }
  });
  return out;
}

/// The elements of each place, where a patch computes them for the first time; kNone elsewhere.
std::vector<std::uint32_t> elements_of_places(const std::vector<std::uint32_t>& elements,
                                              const std::vector<std::uint32_t>& order) {
  std::vector<std::uint32_t> out(order.size(), mesh::kNone);
  std::vector<bool> met(elements.size(), false);
  for (std::size_t place = 0; place < order.size(); ++place) {
    if (order[place] == mesh::kNone || met[order[place]]) continue;
    met[order[place]] = true;
    out[place] = elements[order[place]];
  }
  return out;
}

matrix::ElementRows rows_of(const ElementGroup& group) {
  return {static_cast<std::uint32_t>(group.rows.size() / group.stride), group.element_count, group.stride, group.rows};
}

/// Adds the element's tensors, which for a linear law are those at rest, to the constant edges.
template <class Shape>
void add_constant_tensors(Compilation& c, const Material& material, std::span<const std::uint32_t> nodes,
                          const physics::ElementAtRest<Shape>& rest) {
  const matrix::Layout& layout = c.model.layout;
  physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
    using Law = typename decltype(tag)::Type;
    if constexpr (Law::kConstantStiffness) {
      if (index != material.law) return;
      Vec3<double> at_rest[Shape::kNodes];
      for (Vec3<double>& u : at_rest) u.setZero();
      const auto tensors =
          physics::element_tensors<Law>(rest, at_rest, material.parameters.data(), physics::Stiffness::kConsistent);
      const auto add = [&](std::uint32_t slot, const Mat3<double>& block) {
        double* edges = c.model.constant_edges.data();
        for (std::uint32_t i = 0; i < 9; ++i) edges[layout.component(slot, i)] += block(i / 3, i % 3);
      };
      for (int k = 0; k < Shape::kNodes; ++k) {
        const std::uint32_t row_k = layout.row_of_node[nodes[static_cast<std::size_t>(k)]];
        for (int l = k + 1; l < Shape::kNodes; ++l) {
          const std::uint32_t row_l = layout.row_of_node[nodes[static_cast<std::size_t>(l)]];
          const Mat3<double>& edge = tensors.edge_stiffness[physics::pair_index(Shape::kNodes, k, l)];
          layout.for_each_place(row_k, row_l, [&](std::uint32_t slot, bool transposed) {
            add(slot, transposed ? Mat3<double>(edge.transpose()) : edge);
          });
        }
      }
    }
  });
}

}  // namespace

Result<void> fill_row_fields(Compilation& c) {
  const matrix::Layout& layout = c.model.layout;
  const std::size_t rows = layout.row_count;
  const bool inertia = c.model.integrator != Integrator::kQuasiStatic;
  c.model.rest.assign(4 * rows, 0);
  c.model.inertia.assign(4 * rows, 0);
  c.model.row_mass.assign(rows, 0);
  for (std::size_t row = 0; row < rows; ++row) c.model.inertia[4 * row + 3] = 1;  // also of padding, to divide by
  Vec3<double> low = c.merged.nodes.front(), high = low;
  for (const auto& node : c.merged.nodes) {
    low = low.cwiseMin(node);
    high = high.cwiseMax(node);
  }
  c.model.size_m = (high - low).norm();
  double densest = 0;
  for (const ReadBody& body : c.bodies) densest = std::max(densest, body.density_kg_per_m3);
  bool consistent = false;
  for (std::size_t b = 0; b < c.bodies.size(); ++b) {
    const v1::Body& body = c.scene.bodies(static_cast<int>(b));
    const BodyModel& out = c.model.bodies[b];
    TM_ASSIGN_OR_RETURN(alpha,
                        read_number(body.rayleigh_mass_per_s(), 0, 1e9, "body '" + out.name + "'.rayleigh_mass_per_s"));
    TM_ASSIGN_OR_RETURN(
        beta, read_number(body.rayleigh_stiffness_s(), 0, 1e9, "body '" + out.name + "'.rayleigh_stiffness_s"));
    consistent = consistent || (c.bodies[b].consistent_mass && inertia);
    for (std::uint32_t node = 0; node < out.node_count; ++node) {
      const std::size_t row = layout.row_of_node[out.node_begin + node];
      for (std::size_t i = 0; i < 3; ++i)
        c.model.rest[4 * row + i] = c.merged.nodes[out.node_begin + node][static_cast<Eigen::Index>(i)];
      c.model.rest[4 * row + 3] = 7;
      if (!inertia) continue;
      c.model.inertia[4 * row + 1] = alpha;
      c.model.inertia[4 * row + 2] = beta;
      c.model.inertia[4 * row + 3] = std::sqrt(densest / c.bodies[b].density_kg_per_m3);
    }
  }
  if (consistent) c.model.mass_edges.assign(layout.slot_count(), 0);

  for_each_element(c, [&](auto tag, std::size_t b, std::uint32_t, std::span<const std::uint32_t> nodes, const auto& x) {
    using Shape = typename decltype(tag)::Type;
    const double density = c.bodies[b].density_kg_per_m3;
    const auto row = [&](int k) { return std::size_t{layout.row_of_node[nodes[static_cast<std::size_t>(k)]]}; };
    if (!c.bodies[b].consistent_mass) {
      const auto volumes = physics::lumped_volumes<Shape>(x);
      for (int k = 0; k < Shape::kNodes; ++k) {
        const double mass = density * volumes[static_cast<std::size_t>(k)];
        c.model.row_mass[row(k)] += mass;
        if (inertia) c.model.inertia[4 * row(k)] += mass;
      }
      return;
    }
    const auto integrals = physics::mass_integrals<Shape>(x);
    for (int k = 0; k < Shape::kNodes; ++k) {
      c.model.row_mass[row(k)] += density * integrals.row(k).sum();
      if (!inertia) continue;
      c.model.inertia[4 * row(k)] += density * integrals(k, k);
      for (int l = k + 1; l < Shape::kNodes; ++l) {
        layout.for_each_place(static_cast<std::uint32_t>(row(k)), static_cast<std::uint32_t>(row(l)),
                              [&](std::uint32_t slot, bool) { c.model.mass_edges[slot] += density * integrals(k, l); });
      }
    }
  });
  return {};
}

Result<void> group_elements(Compilation& c) {
  const matrix::Layout& layout = c.model.layout;
  std::vector<std::vector<physics::PronyTerm>> memories{{}};
  const auto memory_of = [&](const std::vector<physics::PronyTerm>& terms) {
    const auto found = std::find(memories.begin(), memories.end(), terms);
    if (found == memories.end()) memories.push_back(terms);
    return static_cast<std::size_t>(std::find(memories.begin(), memories.end(), terms) - memories.begin());
  };

  std::map<GroupKey, Collected> collected;
  const auto collect = [&]<class Shape>(const physics::ElementAtRest<Shape>& rest, Share share, std::size_t b,
                                        std::uint32_t element, std::span<const std::uint32_t> nodes) -> Collected& {
    const ReadBody& body = c.bodies[b];
    const Material& material = body.material(element);
    const bool alone = material.constant_stiffness || !material.prony.empty();
    Collected& group = collected[{material.constant_stiffness, physics::index_of<Shape>(physics::Shapes{}),
                                  material.law, body.quadrature, share, alone ? b : 0, memory_of(material.prony)}];
    if (material.constant_stiffness) {
      if (c.model.constant_edges.empty()) c.model.constant_edges.assign(9 * std::size_t{layout.slot_count()}, 0);
      add_constant_tensors(c, material, nodes, rest);
    }
    if (group.elements.empty()) {  // room for all that may come: growing step by step would copy them again and again
      const std::size_t most = c.model.bodies[b].element_count;
      group.elements.reserve(most);
      group.rows.reserve(most * Shape::kNodes);
      group.rest.reserve(most * rest.points.size() * physics::kRestReals<Shape>);
      group.parameters.reserve(most * material.parameters.size());
    }
    group.nodes = Shape::kNodes;
    group.shares = rest.shares;
    group.elements.push_back(c.model.bodies[b].element_begin + element);
    for (const std::uint32_t node : nodes) group.rows.push_back(layout.row_of_node[node]);
    for (const auto& point : rest.points) group.rest.insert(group.rest.end(), point.begin(), point.end());
    group.parameters.insert(group.parameters.end(), material.parameters.begin(), material.parameters.end());
    return group;
  };

  std::vector<bool> paired(mesh::element_count(c.merged), false);
  for (const WedgePair& pair : c.wedge_pairs) {
    const std::uint32_t begin = c.model.bodies[pair.body].element_begin;
    for (const std::uint32_t element : pair.elements) paired[begin + element] = true;
    const WedgePairAtRest at_rest = wedge_pair_at_rest(c, pair);
    Collected& group = collect(at_rest.rest, Share::kDilatationOfPair, pair.body, pair.elements[0], pair.nodes);
    group.partners.push_back(begin + pair.elements[1]);
    group.first_parts.push_back(at_rest.first_part);
  }
  std::uint32_t folded = mesh::kNone;
  for_each_element(
      c, [&](auto tag, std::size_t b, std::uint32_t element, std::span<const std::uint32_t> nodes, const auto& x) {
        using Shape = typename decltype(tag)::Type;
        const std::uint32_t of_scene = c.model.bodies[b].element_begin + element;
        physics::ElementAtRest<Shape> rest(x, c.bodies[b].quadrature);
        for (const auto& point : rest.points) {
          if (!(point.back() > 0)) folded = std::min(folded, of_scene);
        }
        if (paired[of_scene]) {  // the volumetric point, which is the last one, is the pair's
          rest.points.pop_back();
          rest.shares.pop_back();
        }
        collect(rest, paired[of_scene] ? Share::kWithoutDilatation : Share::kWhole, b, element, nodes);
      });

  if (folded != mesh::kNone) {
    const auto body = std::find_if(c.model.bodies.begin(), c.model.bodies.end(), [&](const BodyModel& one) {
      return folded - one.element_begin < one.element_count;
    });
    return invalid(
        fmt::format("body '{}': element {} is folded between its nodes (a quadrature point has no positive "
                    "volume); move its nodes towards a regular shape",
                    body->name, folded - body->element_begin));
  }

  for (const auto& [key, elements] : collected) {
    ElementGroup group;
    group.shape = key.shape;
    group.law = key.law;
    physics::for_each_type(physics::Laws{}, [&](auto law, int index) {
      using Law = typename decltype(law)::Type;
      if (index != key.law) return;
      group.checks_volume = Law::kInversion == physics::Inversion::kCaught && elements.partners.empty();
    });
    group.element_count = static_cast<std::uint32_t>(elements.elements.size());
    const bool edges = layout.storage == matrix::Storage::kEdges;
    const auto by_patch =
        edges ? matrix::order_by_patch(layout, elements.rows, elements.nodes) : matrix::PatchElements{};
    const std::vector<std::uint32_t> order = edges ? by_patch.order : order_by_first_row(elements.rows, elements.nodes);
    group.stride = static_cast<std::uint32_t>((order.size() + kSliceRows - 1) / kSliceRows * kSliceRows);
    group.is_constant = key.constant;
    group.point_count = static_cast<std::uint32_t>(elements.shares.size());
    const auto divided = [](const physics::ModuliWeights& one) { return one.deviatoric != 1 || one.volumetric != 1; };
    if (std::any_of(elements.shares.begin(), elements.shares.end(), divided)) group.shares = elements.shares;
    group.prony = memories[key.memory];
    const auto components = [&](const auto& items) { return items.size() / group.element_count; };
    const auto placed = [&](const auto& items) { return transpose(items, components(items), order, group.stride); };
    group.elements = elements_of_places(elements.elements, order);
    group.partners = placed(elements.partners);
    group.first_parts = placed(elements.first_parts);
    group.rows = placed(elements.rows);
    group.rest = placed(elements.rest);
    group.parameters = placed(elements.parameters);
    group.patch_elements = by_patch.ranges;
    if (edges && !key.constant) {
      group.pair_places = matrix::pair_places(layout, by_patch, group.rows, elements.nodes);
    }
    c.model.groups.push_back(std::move(group));
  }
  return {};
}

void equip_solve(Compilation& c, const PatchPolicy& policy) {
  Model& model = c.model;
  if (model.layout.storage == matrix::Storage::kEdges || model.double_precision) return;
  const std::uint32_t rows = model.layout.largest_patch();
  if (policy.solve_of) model.solve = policy.solve_of(model.layout);
  model.solve_keeps_vectors = rows <= policy.solve_keeps_rows;
  // With Newton iterations a solve does not know whether it is the step's last. PatchTetrahedra has 16 bits for a row.
  if (model.iterates() || !model.solve_keeps_vectors || rows > 0xFFFF) return;
  std::vector<matrix::ElementRows> tetrahedra;
  for (ElementGroup& group : model.groups) {
    if (!group.checks_volume || group.shape != physics::index_of<physics::LinearTetrahedron>(physics::Shapes{}))
      continue;
    group.solve_checks_volume = true;
    tetrahedra.push_back(rows_of(group));
  }
  if (!tetrahedra.empty()) model.checked = matrix::share_out_tetrahedra(model.layout, tetrahedra);
}

Result<void> list_elements_of_rows(Compilation& c) {
  Model& model = c.model;
  if (model.layout.storage == matrix::Storage::kEdges) return {};  // elements write into the matrix
  if (const std::uint32_t widest = model.layout.widest_slice(); widest >= matrix::own_place(16)) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("a node has {} neighbours, and rows of the matrix hold fewer than {}; "
                            "split the elements around it",
                            widest, matrix::own_place(16)));
  }
  std::vector<matrix::ElementRows> rows;  // the first groups, as those are refreshed
  for (const ElementGroup& group : model.groups) {
    if (!group.is_constant) rows.push_back(rows_of(group));
  }
  matrix::GroupRowLists lists = matrix::make_row_lists(model.layout, rows, model.constant_edges.empty());
  for (std::size_t g = 0; g < rows.size(); ++g) model.groups[g].row_lists = std::move(lists.groups[g]);
  model.begun_slices = std::move(lists.begun_slices);
  return {};
}

}  // namespace tensormass::model
