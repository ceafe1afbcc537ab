#include "model/compile.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <set>
#include <span>

#include <fmt/format.h>

#include "core/limits.h"
#include "mesh/admission.h"
#include "mesh/embedding.h"
#include "mesh/shapes.h"
#include "mesh/surface.h"
#include "model/scene_input.h"
#include "physics/element/element.h"
#include "physics/lists.h"

namespace tensormass::model {

namespace {

using tensor::kSliceRows;

/// What a body says of its material, checked.
struct Material {
  int law = 0;  ///< index into physics::Laws
  double young_modulus_pa = 0, poisson_ratio = 0;
  std::vector<double> parameters;  ///< as the law stores them
};

/// A body read and admitted, before it becomes part of the scene's mesh.
struct ReadBody {
  mesh::Mesh mesh;
  Material material;
};

/// Host-side access to an element list by its indices.
struct ShapeTraits {
  int nodes = 0, quadrature_points = 0, rest_reals = 0;
};
ShapeTraits shape_traits(int shape) {
  ShapeTraits traits;
  physics::for_each_type(physics::Shapes{}, [&](auto tag, int index) {
    using Shape = typename decltype(tag)::Type;
    if (index == shape) traits = {Shape::kNodes, Shape::kQuadraturePoints, Shape::kRestReals};
  });
  return traits;
}

template <class Law>
int law_index() {
  int result = -1;
  physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
    if (std::is_same_v<typename decltype(tag)::Type, Law>) result = index;
  });
  return result;
}

bool has_constant_stiffness(int law) {
  bool result = false;
  physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
    if (index == law) result = decltype(tag)::Type::kConstantStiffness;
  });
  return result;
}

Result<Material> read_material(const v1::Law& law, std::string_view where) {
  const auto isotropic = [&](const v1::IsotropicElastic& p, int index, std::string_view name) -> Result<Material> {
    TM_TRY(young, read_number(p.young_modulus_pa(), 1e-3, 1e13, fmt::format("{}.{}.young_modulus_pa", where, name)));
    TM_TRY(poisson, read_number(p.poisson_ratio(), -0.999, 0.4999, fmt::format("{}.{}.poisson_ratio", where, name)));
    const physics::Lame lame = physics::lame_from_young(young, poisson);
    return Material{index, young, poisson, {lame.lambda_pa, lame.mu_pa}};
  };
  switch (law.kind_case()) {
    case v1::Law::kHooke:
      return isotropic(law.hooke(), law_index<physics::Hooke>(), "hooke");
    case v1::Law::kStVenantKirchhoff:
      return isotropic(law.st_venant_kirchhoff(), law_index<physics::StVenantKirchhoff>(), "st_venant_kirchhoff");
    case v1::Law::KIND_NOT_SET:
      break;
  }
  return invalid(fmt::format("{}: no law that this server knows; give hooke or st_venant_kirchhoff", where));
}

/// Compiles one scene; the model grows step by step.
class Compiler {
 public:
  Compiler(const v1::Scene& scene, const PatchPolicy& policy) : scene_(scene), policy_(policy) {}

  Result<Model> run() {
    TM_CHECK(read_header());
    TM_CHECK(read_bodies());
    TM_CHECK(read_tools());
    model_.layout = tensor::make_layout(merged_, policy_.count(static_cast<std::uint32_t>(merged_.nodes.size())));
    TM_CHECK(fill_row_fields());
    group_elements();
    if (!model_.tools.empty()) make_contact_surface();
    if (model_.frame_rate_hz > 0) {
      TM_CHECK(make_visible_surface());
    }
    list_stages();
    return std::move(model_);
  }

 private:
  Result<void> read_header() {
    TM_CHECK(check_name(scene_.name(), "scene.name"));
    model_.name = scene_.name();
    const v1::Stepping& stepping = scene_.stepping();
    TM_TRY(dt, read_number(stepping.has_dt_s() ? stepping.dt_s() : 1.0 / 60, limits::kMinTimeStepS,
                           limits::kMaxTimeStepS, "scene.stepping.dt_s"));
    model_.dt_s = dt;
    TM_TRY(rate, read_number(stepping.has_rate_hz() ? stepping.rate_hz() : std::min(1 / dt, limits::kMaxRateHz), 1e-3,
                             limits::kMaxRateHz, "scene.stepping.rate_hz"));
    model_.rate_hz = rate;
    model_.lockstep = stepping.lockstep();

    const v1::Solver& solver = scene_.solver();
    switch (solver.precision()) {
      case v1::Solver::PRECISION_UNSPECIFIED:
      case v1::Solver::PRECISION_FLOAT:
        break;
      case v1::Solver::PRECISION_DOUBLE:
        model_.double_precision = true;
        break;
      default:
        return invalid(fmt::format("scene.solver.precision: {} is unknown", static_cast<int>(solver.precision())));
    }
    TM_TRY(iterations, read_number(solver.has_cg_max_iterations() ? solver.cg_max_iterations() : 100, 1,
                                   limits::kMaxCgIterations, "scene.solver.cg_max_iterations"));
    model_.cg_max_iterations = static_cast<std::uint32_t>(iterations);
    TM_TRY(tolerance,
           read_number(solver.has_cg_tolerance() ? solver.cg_tolerance() : 1e-3, 0, 0.5, "scene.solver.cg_tolerance"));
    model_.cg_tolerance = tolerance;
    if (solver.has_cpu_threads()) {
      TM_CHECK(read_number(solver.cpu_threads(), 1, limits::kMaxCpuThreads, "scene.solver.cpu_threads"));
    }

    const v1::Streams& streams = scene_.streams();
    TM_TRY(frames, read_number(streams.has_frame_rate_hz() ? streams.frame_rate_hz() : 60, 0, limits::kMaxRateHz,
                               "scene.streams.frame_rate_hz"));
    model_.frame_rate_hz = frames;
    TM_TRY(status, read_number(streams.has_status_rate_hz() ? streams.status_rate_hz() : 4, 0, limits::kMaxRateHz,
                               "scene.streams.status_rate_hz"));
    model_.status_rate_hz = status;

    TM_TRY(gravity, read_vector(scene_.gravity_m_per_s2(), "scene.gravity_m_per_s2"));
    model_.gravity_m_per_s2 = gravity;
    model_.has_gravity = gravity.squaredNorm() > 0;
    return {};
  }

  Result<void> read_bodies() {
    if (scene_.bodies().empty()) return invalid("scene.bodies: a scene needs at least one body");
    if (static_cast<std::size_t>(scene_.bodies_size()) > limits::kMaxBodies) {
      return fail(ErrorCode::kResourceExhausted, fmt::format("scene.bodies: {} exceed limits::kMaxBodies = {}",
                                                             scene_.bodies_size(), limits::kMaxBodies));
    }
    std::set<std::string> names;
    for (int i = 0; i < scene_.bodies_size(); ++i) {
      const v1::Body& body = scene_.bodies(i);
      TM_CHECK(check_name(body.name(), fmt::format("scene.bodies[{}].name", i)));
      if (!names.insert(body.name()).second) {
        return invalid(fmt::format("scene.bodies[{}]: the name '{}' is taken by another body", i, body.name()));
      }
      TM_CHECK(read_body(body));
    }
    return {};
  }

  Result<void> read_body(const v1::Body& body) {
    const std::string where = fmt::format("body '{}'", body.name());
    TM_TRY(mesh, read_mesh(body, where));
    const std::uint64_t nodes = merged_.nodes.size() + mesh.nodes.size();
    const std::uint64_t elements = std::uint64_t{mesh::element_count(merged_)} + mesh::element_count(mesh);
    if (nodes > limits::kMaxNodes || elements > limits::kMaxElements) {
      return fail(ErrorCode::kResourceExhausted,
                  fmt::format("{}: the scene would have {} nodes and {} elements; limits::kMaxNodes = {}, "
                              "limits::kMaxElements = {}",
                              where, nodes, elements, limits::kMaxNodes, limits::kMaxElements));
    }
    TM_TRY(report, mesh::admit(mesh, body.name()));
    TM_TRY(material, read_material(body.law(), where + ".law"));
    TM_TRY(density, read_number(body.density_kg_per_m3(), 1e-3, 1e6, where + ".density_kg_per_m3"));

    BodyModel out;
    out.name = body.name();
    out.node_begin = static_cast<std::uint32_t>(merged_.nodes.size());
    out.node_count = report.node_count;
    out.element_count = report.element_count;
    out.component_count = report.component_count;
    out.volume_m3 = report.volume_m3;
    out.mass_kg = report.volume_m3 * density;
    out.min_dihedral_angle_deg = report.min_dihedral_angle_deg;
    model_.warnings.insert(model_.warnings.end(), report.warnings.begin(), report.warnings.end());
    if (body.has_color_srgb()) {
      const v1::Vector3& color = body.color_srgb();
      for (const double component : {color.x(), color.y(), color.z()}) {
        TM_CHECK(read_number(component, 0, 1, where + ".color_srgb"));
      }
      out.has_color = true;
      out.color_srgb = {color.x(), color.y(), color.z()};
    }

    merged_.nodes.insert(merged_.nodes.end(), mesh.nodes.begin(), mesh.nodes.end());
    for (const mesh::ElementBlock& block : mesh.blocks) {
      mesh::ElementBlock shifted = block;
      for (std::uint32_t& node : shifted.nodes) node += out.node_begin;
      merged_.blocks.push_back(std::move(shifted));
      block_bodies_.push_back(bodies_.size());
    }
    model_.bodies.push_back(std::move(out));
    bodies_.push_back({std::move(mesh), std::move(material)});
    return {};
  }

  Result<void> read_tools() {
    if (static_cast<std::size_t>(scene_.tools_size()) > limits::kMaxTools) {
      return fail(ErrorCode::kResourceExhausted,
                  fmt::format("scene.tools: {} exceed limits::kMaxTools = {}", scene_.tools_size(), limits::kMaxTools));
    }
    const auto stiffest = std::max_element(bodies_.begin(), bodies_.end(), [](const ReadBody& a, const ReadBody& b) {
                            return a.material.young_modulus_pa < b.material.young_modulus_pa;
                          })->material;
    std::set<std::string> names;
    for (int i = 0; i < scene_.tools_size(); ++i) {
      const v1::Tool& tool = scene_.tools(i);
      TM_CHECK(check_name(tool.name(), fmt::format("scene.tools[{}].name", i)));
      if (!names.insert(tool.name()).second) {
        return invalid(fmt::format("scene.tools[{}]: the name '{}' is taken by another tool", i, tool.name()));
      }
      const std::string where = fmt::format("tool '{}'", tool.name());
      if (tool.kind_case() != v1::Tool::kSphericalProbe) {
        return invalid(fmt::format("{}: no kind that this server knows; give spherical_probe", where));
      }
      const v1::SphericalProbe& probe = tool.spherical_probe();
      ToolModel out;
      out.name = tool.name();
      TM_TRY(radius, read_number(probe.radius_m(), 1e-6, 1e3, where + ".spherical_probe.radius_m"));
      out.radius_m = radius;
      TM_TRY(tip, read_vector(probe.tip_offset_m(), where + ".spherical_probe.tip_offset_m"));
      out.tip_offset_m = tip;
      const double default_penalty = 20 * stiffest.young_modulus_pa / radius;
      TM_TRY(penalty,
             read_number(probe.has_penalty_stiffness_pa_per_m() ? probe.penalty_stiffness_pa_per_m() : default_penalty,
                         1e-3, 1e18, where + ".spherical_probe.penalty_stiffness_pa_per_m"));
      out.penalty_pa_per_m = penalty;
      TM_TRY(speed, read_number(tool.has_max_speed_m_per_s() ? tool.max_speed_m_per_s() : 0.5, 1e-6, 1e3,
                                where + ".max_speed_m_per_s"));
      out.max_speed_m_per_s = speed;
      out.plane_strain_modulus_pa = stiffest.young_modulus_pa / (1 - stiffest.poisson_ratio * stiffest.poisson_ratio);
      TM_TRY(position, read_vector(tool.position_m(), where + ".position_m"));
      out.initial_position_m = position;
      TM_TRY(orientation, read_orientation(tool.orientation(), where + ".orientation"));
      out.initial_orientation = orientation;
      model_.tools.push_back(std::move(out));
    }
    return {};
  }

  /// Positions at rest, masses, damping, fixed rows, constant forces.
  Result<void> fill_row_fields() {
    const tensor::Layout& layout = model_.layout;
    model_.rest.assign(4 * std::size_t{layout.row_count}, 0);
    model_.inertia.assign(4 * std::size_t{layout.row_count}, 0);
    std::vector<double> external(4 * std::size_t{layout.row_count}, 0);
    bool any_external = false;

    for (std::size_t b = 0; b < bodies_.size(); ++b) {
      const v1::Body& body = scene_.bodies(static_cast<int>(b));
      BodyModel& out = model_.bodies[b];
      const std::string where = fmt::format("body '{}'", out.name);
      TM_TRY(alpha, read_number(body.rayleigh_mass_per_s(), 0, 1e9, where + ".rayleigh_mass_per_s"));
      TM_TRY(beta, read_number(body.rayleigh_stiffness_s(), 0, 1e9, where + ".rayleigh_stiffness_s"));
      const auto row = [&](std::uint32_t node) { return std::size_t{layout.row_of_node[out.node_begin + node]}; };
      for (std::uint32_t node = 0; node < out.node_count; ++node) {
        for (int c = 0; c < 3; ++c) model_.rest[4 * row(node) + c] = bodies_[b].mesh.nodes[node][c];
        model_.rest[4 * row(node) + 3] = 1;
        model_.inertia[4 * row(node) + 1] = alpha;
        model_.inertia[4 * row(node) + 2] = beta;
      }
      for (int i = 0; i < body.fixed_size(); ++i) {
        TM_TRY(nodes, read_region(body.fixed(i), bodies_[b].mesh.nodes, fmt::format("{}.fixed[{}]", where, i)));
        for (const std::uint32_t node : nodes) model_.rest[4 * row(node) + 3] = 0;
      }
      for (std::uint32_t node = 0; node < out.node_count; ++node) {
        if (model_.rest[4 * row(node) + 3] == 0) ++out.fixed_node_count;
      }
      for (int i = 0; i < body.loads_size(); ++i) {
        const std::string load = fmt::format("{}.loads[{}]", where, i);
        TM_TRY(nodes, read_region(body.loads(i).region(), bodies_[b].mesh.nodes, load + ".region"));
        TM_TRY(force, read_vector(body.loads(i).force_n(), load + ".force_n"));
        any_external = any_external || force.squaredNorm() > 0;
        for (const std::uint32_t node : nodes) {
          for (int c = 0; c < 3; ++c) external[4 * row(node) + c] += force[c] / static_cast<double>(nodes.size());
        }
      }
    }

    for_each_body_element(
        [&](std::size_t body, int /*shape*/, auto shape_tag, std::span<const std::uint32_t> nodes, const auto& rest) {
          using Shape = typename decltype(shape_tag)::Type;
          double volume = 0;
          for (int q = 0; q < Shape::kQuadraturePoints; ++q) {
            Vec3<double> a[Shape::kNodes];
            double weight;
            Shape::gradients(rest[q], a, weight);
            volume += weight;
          }
          for (int k = 0; k < Shape::kNodes; ++k) {
            model_.inertia[4 * std::size_t{layout.row_of_node[nodes[static_cast<std::size_t>(k)]]}] +=
                volume * scene_.bodies(static_cast<int>(body)).density_kg_per_m3() * Shape::mass_share(k);
          }
        });

    if (model_.has_gravity) {
      any_external = true;
      for (std::size_t i = 0; i < layout.row_count; ++i) {
        for (int c = 0; c < 3; ++c) external[4 * i + c] += model_.inertia[4 * i] * model_.gravity_m_per_s2[c];
      }
    }
    if (any_external) model_.external = std::move(external);
    return {};
  }

  /// Calls visit(body, index into physics::Shapes, shape tag, scene nodes of the element,
  /// rest[quadrature points][rest reals]). mesh::Shape counts as physics::Shapes does.
  template <class Visit>
  void for_each_body_element(const Visit& visit) const {
    for (std::size_t b = 0; b < merged_.blocks.size(); ++b) {
      const mesh::ElementBlock& block = merged_.blocks[b];
      physics::for_each_type(physics::Shapes{}, [&](auto tag, int index) {
        using Shape = typename decltype(tag)::Type;
        if (index != static_cast<int>(block.shape)) return;
        for (std::size_t first = 0; first < block.nodes.size(); first += Shape::kNodes) {
          const std::span<const std::uint32_t> nodes(block.nodes.data() + first, Shape::kNodes);
          Vec3<double> x[Shape::kNodes];
          for (int k = 0; k < Shape::kNodes; ++k) x[k] = merged_.nodes[nodes[static_cast<std::size_t>(k)]];
          double rest[Shape::kQuadraturePoints][Shape::kRestReals];
          for (int q = 0; q < Shape::kQuadraturePoints; ++q) Shape::rest(x, q, rest[q]);
          visit(block_bodies_[b], index, tag, nodes, rest);
        }
      });
    }
  }

  /// Linear laws go into constant tensors, the others into groups of one (shape, law) each.
  void group_elements() {
    const tensor::Layout& layout = model_.layout;
    const bool any_constant = std::any_of(
        bodies_.begin(), bodies_.end(), [](const ReadBody& body) { return has_constant_stiffness(body.material.law); });
    if (any_constant) {
      model_.constant_edges.assign(9 * std::size_t{layout.slot_count()}, 0);
    }

    struct Collected {
      std::vector<std::uint32_t> rows;  // [element][node]
      std::vector<double> rest;         // [element][..]
      std::vector<double> parameters;   // [element][..]
    };
    std::map<std::pair<int, int>, Collected> collected;
    for_each_body_element(
        [&](std::size_t body, int shape, auto shape_tag, std::span<const std::uint32_t> nodes, const auto& rest) {
          using Shape = typename decltype(shape_tag)::Type;
          const Material& material = bodies_[body].material;
          if (has_constant_stiffness(material.law)) {
            add_constant_tensors<Shape>(material, nodes, rest);
            return;
          }
          Collected& group = collected[{shape, material.law}];
          for (const std::uint32_t node : nodes) group.rows.push_back(layout.row_of_node[node]);
          group.rest.insert(group.rest.end(), &rest[0][0], &rest[0][0] + Shape::kQuadraturePoints * Shape::kRestReals);
          group.parameters.insert(group.parameters.end(), material.parameters.begin(), material.parameters.end());
        });

    std::uint32_t partial_begin = 0;
    for (const auto& [key, elements] : collected) {
      const ShapeTraits traits = shape_traits(key.first);
      ElementGroup group;
      group.shape = key.first;
      group.law = key.second;
      group.element_count = static_cast<std::uint32_t>(elements.rows.size()) / static_cast<std::uint32_t>(traits.nodes);
      group.stride = (group.element_count + kSliceRows - 1) / kSliceRows * kSliceRows;
      group.partial_begin = partial_begin;
      group.record_reals = tensor::record_reals(static_cast<std::uint32_t>(traits.nodes));
      const std::vector<std::uint32_t> order = order_by_first_row(elements.rows, traits.nodes);
      group.rows = transpose(elements.rows, order, group.stride);
      group.rest = transpose(elements.rest, order, group.stride);
      group.parameters = transpose(elements.parameters, order, group.stride);
      partial_begin += group.stride * group.record_reals;
      model_.groups.push_back(std::move(group));
    }

    std::vector<tensor::ElementRows> rows;
    for (const ElementGroup& group : model_.groups) {
      rows.push_back({static_cast<std::uint32_t>(shape_traits(group.shape).nodes), group.element_count, group.stride,
                      group.rows, group.partial_begin});
    }
    if (!rows.empty()) model_.gather = tensor::make_gather_map(layout, rows);
  }

  /// Elements in the order of their lowest row: neighbours in space are neighbours in memory.
  static std::vector<std::uint32_t> order_by_first_row(const std::vector<std::uint32_t>& rows, int nodes) {
    const std::size_t width = static_cast<std::size_t>(nodes);
    std::vector<std::uint32_t> order(rows.size() / width), lowest(rows.size() / width);
    std::iota(order.begin(), order.end(), 0);
    for (std::size_t e = 0; e < lowest.size(); ++e) {
      lowest[e] = *std::min_element(rows.begin() + static_cast<std::ptrdiff_t>(e * width),
                                    rows.begin() + static_cast<std::ptrdiff_t>((e + 1) * width));
    }
    std::stable_sort(order.begin(), order.end(),
                     [&](std::uint32_t a, std::uint32_t b) { return lowest[a] < lowest[b]; });
    return order;
  }

  /// [element][component] to [component][stride] in the given order; the padding is zero.
  template <class T>
  static std::vector<T> transpose(const std::vector<T>& items, const std::vector<std::uint32_t>& order,
                                  std::uint32_t stride) {
    const std::size_t components = items.size() / order.size();
    std::vector<T> out(components * stride, T{});
    for (std::size_t e = 0; e < order.size(); ++e) {
      for (std::size_t c = 0; c < components; ++c) out[c * stride + e] = items[order[e] * components + c];
    }
    return out;
  }

  template <class Shape, class Rest>
  void add_constant_tensors(const Material& material, std::span<const std::uint32_t> nodes, const Rest& rest) {
    const tensor::Layout& layout = model_.layout;
    physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
      if (index != material.law) return;
      Vec3<double> at_rest[Shape::kNodes];
      for (Vec3<double>& u : at_rest) u.setZero();
      const auto tensors =
          physics::element_tensors<Shape, typename decltype(tag)::Type, physics::Stiffness::kConsistent>(
              at_rest, rest, material.parameters.data());
      for (int k = 0; k < Shape::kNodes; ++k) {
        const std::uint32_t row_k = layout.row_of_node[nodes[static_cast<std::size_t>(k)]];
        for (int l = k + 1; l < Shape::kNodes; ++l) {
          const std::uint32_t row_l = layout.row_of_node[nodes[static_cast<std::size_t>(l)]];
          const Mat3<double>& edge = tensors.edge_stiffness[physics::pair_index(Shape::kNodes, k, l)];
          add_edge(layout.slot(row_k, row_l), edge);
          add_edge(layout.slot(row_l, row_k), edge.transpose());
        }
      }
    });
  }

  void add_edge(std::uint32_t slot, const Mat3<double>& block) {
    double* edges = model_.constant_edges.data();
    tensor::store_block<double>(edges, slot, tensor::load_block<double>(edges, slot) + block);
  }

  void make_contact_surface() {
    const tensor::Layout& layout = model_.layout;
    const mesh::Surface surface = mesh::boundary(merged_);
    ContactSurface& out = model_.contact;
    const auto row_of = [&](std::uint32_t vertex) { return layout.row_of_node[surface.nodes[vertex]]; };

    // Surface vertices in the order of their rows, which groups them by patch.
    std::vector<std::uint32_t> vertices(surface.nodes.size()), place(surface.nodes.size());
    std::iota(vertices.begin(), vertices.end(), 0);
    std::sort(vertices.begin(), vertices.end(),
              [&](std::uint32_t a, std::uint32_t b) { return row_of(a) < row_of(b); });
    for (std::uint32_t i = 0; i < vertices.size(); ++i) place[vertices[i]] = i;
    // Triangles belong to the patch of their first corner.
    std::vector<std::uint32_t> triangles(surface.triangles.size()), triangle_place(surface.triangles.size());
    std::iota(triangles.begin(), triangles.end(), 0);
    std::stable_sort(triangles.begin(), triangles.end(), [&](std::uint32_t a, std::uint32_t b) {
      return row_of(surface.triangles[a][0]) < row_of(surface.triangles[b][0]);
    });
    for (std::uint32_t i = 0; i < triangles.size(); ++i) triangle_place[triangles[i]] = i;

    out.patch_triangles.assign(layout.patch_count + 1, 0);
    for (const std::uint32_t triangle : triangles) {
      const mesh::Triangle& corners = surface.triangles[triangle];
      Vec3<double> x[3];
      for (std::size_t c = 0; c < 3; ++c) {
        out.triangle_rows.push_back(row_of(corners[c]));
        out.vertex_of_corner.push_back(place[corners[c]]);
        const std::uint32_t neighbour = surface.neighbours[triangle][c];
        out.triangle_neighbours.push_back(neighbour == mesh::kNone ? tensor::kNoTriangle : triangle_place[neighbour]);
        x[c] = merged_.nodes[surface.nodes[corners[c]]];
      }
      out.triangle_area.push_back(0.5 * (x[1] - x[0]).cross(x[2] - x[0]).norm());
      ++out.patch_triangles[layout.patch_of_row(row_of(corners[0])) + 1];
    }
    std::partial_sum(out.patch_triangles.begin(), out.patch_triangles.end(), out.patch_triangles.begin());

    out.patch_surface.assign(layout.patch_count + 1, 0);
    out.incidence_begin.assign(1, 0);
    for (const std::uint32_t vertex : vertices) {
      const std::uint32_t row = row_of(vertex);
      out.surface_rows.push_back(row);
      ++out.patch_surface[layout.patch_of_row(row) + 1];
      for (const std::uint32_t triangle : surface.vertex_triangles[vertex]) {
        const mesh::Triangle& corners = surface.triangles[triangle];
        const auto corner =
            static_cast<std::uint32_t>(std::find(corners.begin(), corners.end(), vertex) - corners.begin());
        out.incidence.push_back(triangle_place[triangle]);
        out.incidence.push_back(corner);
        out.incidence.push_back(layout.slot(row, row_of(corners[(corner + 1) % 3])));
        out.incidence.push_back(layout.slot(row, row_of(corners[(corner + 2) % 3])));
      }
      out.incidence_begin.push_back(static_cast<std::uint32_t>(out.incidence.size() / 4));
    }
    std::partial_sum(out.patch_surface.begin(), out.patch_surface.end(), out.patch_surface.begin());
  }

  Result<void> make_visible_surface() {
    for (std::size_t b = 0; b < bodies_.size(); ++b) {
      BodyModel& body = model_.bodies[b];
      const v1::Body& source = scene_.bodies(static_cast<int>(b));
      body.vertex_begin = model_.visible.count();
      const auto add = [&](const std::array<std::uint32_t, 4>& nodes, const std::array<double, 4>& weights) {
        for (std::size_t c = 0; c < 4; ++c) {
          model_.visible.rows.push_back(model_.layout.row_of_node[body.node_begin + nodes[c]]);
          model_.visible.weights.push_back(weights[c]);
        }
      };
      if (source.has_skin()) {
        const std::string where = fmt::format("body '{}'", body.name);
        TM_TRY(skin, read_skin(source, where));
        TM_TRY(report, mesh::admit_skin(skin.vertices, skin.triangles, body.name));
        model_.warnings.insert(model_.warnings.end(), report.warnings.begin(), report.warnings.end());
        TM_TRY(embedding, mesh::embed(bodies_[b].mesh, skin.vertices, fmt::format("the skin of {}", where)));
        for (std::size_t i = 0; i < skin.vertices.size(); ++i) add(embedding.nodes[i], embedding.weights[i]);
        body.triangles = std::move(skin.triangles);
        body.has_skin = true;
      } else {
        mesh::Surface surface = mesh::boundary(bodies_[b].mesh);
        for (const std::uint32_t node : surface.nodes) add({node, node, node, node}, {1, 0, 0, 0});
        body.triangles = std::move(surface.triangles);
        body.vertex_nodes = std::move(surface.nodes);
      }
      body.vertex_count = model_.visible.count() - body.vertex_begin;
    }
    return {};
  }

  /// Exactly what this scene needs, in order.
  void list_stages() {
    auto& stages = model_.stages;
    const bool tools = !model_.tools.empty();
    if (tools) stages.push_back({StageKind::kDetectContact});
    if (tools) stages.push_back({StageKind::kRespondContact});
    for (std::uint32_t g = 0; g < model_.groups.size(); ++g) stages.push_back({StageKind::kElements, g});
    stages.push_back({StageKind::kAssemble});
    if (!model_.external.empty()) stages.push_back({StageKind::kExternalForces});
    if (tools) stages.push_back({StageKind::kAssembleContact});
    stages.push_back({StageKind::kFactorize});
    stages.push_back({StageKind::kScaleEdges});
    stages.push_back({StageKind::kSolve});
    stages.push_back({StageKind::kAdvance});
    if (tools) stages.push_back({StageKind::kMeasureContact});
  }

  const v1::Scene& scene_;
  const PatchPolicy policy_;
  Model model_;
  mesh::Mesh merged_;                      // all bodies
  std::vector<std::size_t> block_bodies_;  // the body of each block of merged_
  std::vector<ReadBody> bodies_;
};

}  // namespace

std::uint32_t PatchPolicy::count(std::uint32_t node_count) const {
  return std::clamp(node_count / std::max(min_nodes_per_patch, 1u), 1u, std::max(max_patches, 1u));
}

Result<Model> compile(const v1::Scene& scene, const PatchPolicy& policy) { return Compiler(scene, policy).run(); }

std::uint32_t requested_cpu_threads(const v1::Scene& scene, std::uint32_t otherwise) {
  return scene.solver().has_cpu_threads() ? scene.solver().cpu_threads() : otherwise;
}

}  // namespace tensormass::model
