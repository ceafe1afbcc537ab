#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <numeric>
#include <optional>
#include <tuple>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/parallel.h"
#include "matrix/patch_elements.h"
#include "matrix/row_elements.h"
#include "mesh/shapes.h"
#include "model/clusters.h"
#include "model/compile_parts.h"
#include "model/cut_bodies.h"
#include "model/scene_input.h"
#include "physics/element/element.h"

/// Turns elements into what a step reads: groups of elements that one kernel evaluates.
///
///   element of a body  --ElementAtRest-->  gradients and weights of its quadrature points
///                                          |
///                           linear law     |     other laws
///                                v         v
///     tensors at rest, added once to    group by (shape, law, quadrature, ..),
///     Model::constant_edges             sorted by row, padded, transposed to [component][stride]
///
/// Elements of linear laws form groups as well: the diagnostics evaluate them.
///
/// Symbols:
///   place   index of an element within its group, after sorting and padding
///   stride  places of a group, a multiple of kSliceRows
///   K_kl    ∂f_k/∂u_l at rest, the constant tensor of an edge (k, l) [N/m]
namespace tensormass::model {

namespace {

using physics::Quadrature;
using view::kSliceRows;

/// What a cut must leave of an element for its volume to be checked. A smaller part is a splinter at the cut's face. It
/// may turn over unseen, and a law that does not recover from that need not stop the scene for it.
constexpr double kLeastCheckedPart = 0.1;

/// Elements that a thread takes at once.
constexpr std::size_t kGrain = 16384;

/// The part of an element's energy that a group integrates.
enum class Share : std::uint8_t {
  kWhole,
  kMember,      // an element of a cluster: what it keeps (clusters.h)
  kDilatation,  // a cluster: the volumetric part of its elements
  kMean,        // a cluster: the volumetric part and a part of the deviatoric one
};

/// Elements with equal keys form a group. The order puts groups whose tensors change in each step first.
///
/// Linear and viscoelastic groups belong to one body: diagnostics check the range of a linear law body by body, and
/// internal variables are stored body by body.
struct GroupKey {
  bool constant;
  int shape, law;
  Quadrature quadrature;
  Share share;
  bool is_splinter;  // kLeastCheckedPart
  std::size_t body;
  std::size_t series;  // index of the Prony series; 0: the law is elastic
  auto order() const { return std::tie(constant, shape, law, quadrature, share, is_splinter, body, series); }
  bool operator<(const GroupKey& other) const { return order() < other.order(); }
};

/// The elements of a group in the order of the bodies.
struct Collected {
  std::vector<std::uint32_t> elements;
  std::vector<std::uint32_t> members;  // [element][member], see ElementGroup; empty: no clusters
  std::vector<double> member_parts;
  std::vector<std::uint32_t> rows;  // [element][node]
  std::vector<double> rest;         // [element][point][rest real]
  std::vector<double> parameters;   // [element][law parameter]
  std::vector<physics::ModuliWeights> shares;
  std::size_t nodes = 0;
  std::optional<double> deviatoric_part;  // ValueTables::Group
};

/// Returns the order of elements by their lowest row, so that neighbours in space are neighbours in memory.
/// rows: [element][width]
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

/// Transposes [element][component] to [component][stride]. order: [place] the element; padding becomes zero.
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

/// Returns the scene's element of each place; kNone for padding, and for an element that an earlier place has already
/// (with kEdges, patches share elements).
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

/// Sorts, pads and transposes the collected elements of a group. Leaves prony and row_lists empty.
/// order: [place] index in `elements`, or mesh::kNone; written
ElementGroup make_group(const GroupKey& key, const Collected& elements, const matrix::Layout& layout,
                        std::vector<std::uint32_t>& order) {
  ElementGroup group;
  group.shape = key.shape;
  group.law = key.law;
  physics::for_each_type(physics::Laws{}, [&](auto law, int index) {
    using Law = typename decltype(law)::Type;
    if (index != key.law) return;
    group.checks_volume =
        Law::kInversion == physics::Inversion::kCaught && elements.members.empty() && !key.is_splinter;
  });
  group.element_count = static_cast<std::uint32_t>(elements.elements.size());
  const bool edges = layout.storage == matrix::Storage::kEdges;
  const auto by_patch = edges ? matrix::order_by_patch(layout, elements.rows, elements.nodes) : matrix::PatchElements{};
  order = edges ? by_patch.order : order_by_first_row(elements.rows, elements.nodes);
  group.stride = static_cast<std::uint32_t>((order.size() + kSliceRows - 1) / kSliceRows * kSliceRows);
  group.is_constant = key.constant;
  group.point_count = static_cast<std::uint32_t>(elements.shares.size());
  const auto divided = [](const physics::ModuliWeights& one) { return one.deviatoric != 1 || one.volumetric != 1; };
  if (std::any_of(elements.shares.begin(), elements.shares.end(), divided)) group.shares = elements.shares;
  const auto components = [&](const auto& items) { return items.size() / group.element_count; };
  const auto placed = [&](const auto& items) { return transpose(items, components(items), order, group.stride); };
  group.elements = elements_of_places(elements.elements, order);
  group.members = placed(elements.members);
  group.member_parts = placed(elements.member_parts);
  group.rows = placed(elements.rows);
  group.rest = placed(elements.rest);
  group.parameters = placed(elements.parameters);
  group.patch_elements = by_patch.ranges;
  if (edges && !key.constant) {
    group.pair_places = matrix::pair_places(layout, by_patch, group.rows, elements.nodes);
  }
  return group;
}

/// Returns the error for a folded element. element: numbered in the scene.
Result<GroupedElements> refuse_folded(std::span<const ReadBody> bodies, std::uint32_t element) {
  const ReadBody& body = bodies[body_of_element(bodies, element)];
  return invalid(
      fmt::format("body '{}': element {} is folded between its nodes (a quadrature point has no positive "
                  "volume); move its nodes towards a regular shape",
                  body.name, element - body.element_begin));
}

}  // namespace

Result<GroupedElements> group_elements(const ReadBodies& all, std::span<const Cluster> clusters,
                                       const matrix::Layout& layout) {
  const std::vector<ReadBody>& bodies = all.bodies;
  GroupedElements out;
  std::vector<std::vector<physics::PronyTerm>> all_series{{}};  // each once; the first is that of elastic laws
  const auto series_of = [&](const std::vector<physics::PronyTerm>& terms) {
    const auto found = std::find(all_series.begin(), all_series.end(), terms);
    const auto index = static_cast<std::size_t>(found - all_series.begin());
    if (found == all_series.end()) all_series.push_back(terms);
    return index;
  };

  std::map<GroupKey, Collected> collected;
  std::vector<std::pair<const Collected*, std::uint32_t>> linear;  // elements of linear laws: group, index in it
  const auto collect = [&]<class Shape>(const physics::ElementAtRest<Shape>& rest, Share share, std::size_t b,
                                        std::uint32_t element, const Material& material,
                                        std::span<const std::uint32_t> nodes) -> Collected& {
    const ReadBody& body = bodies[b];
    const mesh::PartShares* const part = part_of(body, element).shares;
    const bool is_element = share == Share::kWhole || share == Share::kMember;
    const bool is_splinter = is_element && part != nullptr && part->volume < kLeastCheckedPart;
    const bool alone = material.constant_stiffness || !material.prony.empty();
    Collected& group =
        collected[{material.constant_stiffness, physics::index_of<Shape>(physics::Shapes{}), material.law,
                   body.quadrature, share, is_splinter, alone ? b : 0, series_of(material.prony)}];
    if (material.constant_stiffness) linear.emplace_back(&group, static_cast<std::uint32_t>(group.elements.size()));
    if (group.elements.empty()) {  // reserves for the whole body: growing would copy large vectors many times
      const std::size_t most = body.element_count;
      group.elements.reserve(most);
      group.rows.reserve(most * Shape::kNodes);
      group.rest.reserve(most * rest.points.size() * physics::kRestReals<Shape>);
      group.parameters.reserve(most * material.parameters.size());
    }
    group.nodes = Shape::kNodes;
    group.shares = rest.shares;
    group.elements.push_back(body.element_begin + element);
    for (const std::uint32_t node : nodes) group.rows.push_back(layout.row_of_node[node]);
    for (const auto& point : rest.points) group.rest.insert(group.rest.end(), point.begin(), point.end());
    group.parameters.insert(group.parameters.end(), material.parameters.begin(), material.parameters.end());
    return group;
  };

  std::vector<const Cluster*> cluster_of(mesh::element_count(all.merged), nullptr);
  for (const Cluster& cluster : clusters) {
    const std::uint32_t begin = bodies[cluster.body].element_begin;
    const Material& material = bodies[cluster.body].material(cluster.elements[0]);
    const Share share = cluster.deviatoric_part > 0 ? Share::kMean : Share::kDilatation;
    Collected& group =
        collect(mean_at_rest(cluster), share, cluster.body, cluster.elements[0], material, cluster.nodes);
    for (const std::uint32_t element : cluster.elements) {
      group.members.push_back(element == mesh::kNone ? element : begin + element);
      if (element != mesh::kNone) cluster_of[begin + element] = &cluster;
    }
    group.member_parts.insert(group.member_parts.end(), cluster.parts.begin(), cluster.parts.end());
  }
  std::uint32_t folded = mesh::kNone;
  for_each_element(
      all, [&](auto tag, std::size_t b, std::uint32_t element, std::span<const std::uint32_t> nodes, const auto& x) {
        using Shape = typename decltype(tag)::Type;
        const std::uint32_t of_scene = bodies[b].element_begin + element;
        physics::ElementAtRest<Shape> rest(x, bodies[b].quadrature);
        for (const auto& point : rest.points) {
          if (!(point.back() > 0)) folded = std::min(folded, of_scene);
        }
        take_part(bodies[b], element, rest);
        const Material& material = bodies[b].material(element);
        if (cluster_of[of_scene] == nullptr) {
          collect(rest, Share::kWhole, b, element, material, nodes);
        } else if constexpr (Shape::kSinglePoint) {
          const double part = cluster_of[of_scene]->deviatoric_part;
          Collected& group = collect(rest, Share::kMember, b, element, kept_by_member(material, part), nodes);
          TM_ASSERT(!group.deviatoric_part || *group.deviatoric_part == part, "clusters of a shape take equal parts");
          group.deviatoric_part = part;
        } else {  // the last point is the volumetric one, which the cluster has instead
          rest.points.pop_back();
          rest.shares.pop_back();
          collect(rest, Share::kMember, b, element, material, nodes);
        }
      });

  if (folded != mesh::kNone) return refuse_folded(bodies, folded);

  struct Made {
    std::uint32_t group;
    std::vector<std::uint32_t> places;  // [element of the group] its first one
  };
  std::map<const Collected*, Made> made;
  for (const auto& [key, elements] : collected) {
    std::vector<std::uint32_t> order;
    Made& of = made[&elements];
    of = {static_cast<std::uint32_t>(out.groups.size()), std::vector(elements.elements.size(), mesh::kNone)};
    out.groups.push_back(make_group(key, elements, layout, order));
    ElementGroup& group = out.groups.back();
    group.prony = all_series[key.series];
    ValueTables::Group& source = out.sources.emplace_back();
    source.shares_deviatoric = elements.deviatoric_part.has_value();
    source.deviatoric_part = elements.deviatoric_part.value_or(0);
    source.elements.assign(group.stride, mesh::kNone);
    for (std::uint32_t place = 0; place < order.size(); ++place) {
      if (order[place] == mesh::kNone) continue;
      source.elements[place] = elements.elements[order[place]];
      of.places[order[place]] = std::min(of.places[order[place]], place);
    }
  }
  out.linear.reserve(linear.size());
  for (const auto& [group, index] : linear) {
    const Made& of = made[group];
    out.linear.push_back({of.group, of.places[index]});
  }
  out.constant_edges = add_up_constant_tensors(layout, out.groups, out.linear);
  return out;
}

}  // namespace tensormass::model
