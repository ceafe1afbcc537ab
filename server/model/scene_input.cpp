#include "model/scene_input.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>

#include <fmt/format.h>

#include "core/limits.h"
#include "core/names.h"
#include "mesh/grid.h"
#include "mesh/shapes.h"
#include "model/model.h"
#include "tensormass/v1/scene.pb.h"

namespace tensormass::model {

static_assert(std::endian::native == std::endian::little, "packed arrays are little-endian and are read as they lie");

namespace {

/// Reads a packed array with `width` items a row.
template <class Item>
Result<std::vector<Item>> read_packed(const std::string& bytes, std::size_t width, std::string_view where) {
  const std::size_t row = width * sizeof(Item);
  if (bytes.empty() || bytes.size() % row != 0) {
    return invalid(fmt::format("{}: {} bytes is not a positive multiple of {} ({} little-endian {}-bit values a row)",
                               where, bytes.size(), row, width, 8 * sizeof(Item)));
  }
  if (bytes.size() / row > std::numeric_limits<std::uint32_t>::max() / 4) {
    return fail(ErrorCode::kResourceExhausted, fmt::format("{}: too many rows", where));
  }
  std::vector<Item> items(bytes.size() / sizeof(Item));
  std::memcpy(items.data(), bytes.data(), bytes.size());
  return items;
}

Result<std::vector<Eigen::Vector3d>> read_points(const std::string& bytes, std::string_view where) {
  return read_packed<double>(bytes, 3, where).map([](const std::vector<double>& values) {
    std::vector<Eigen::Vector3d> points(values.size() / 3);
    for (std::size_t i = 0; i < points.size(); ++i) points[i] = {values[3 * i], values[3 * i + 1], values[3 * i + 2]};
    return points;
  });
}

/// The scale and translation of a body, for its mesh and its skin.
struct Placement {
  double scale = 1;
  Vec3<double> translation_m = Vec3<double>::Zero();

  void apply(std::vector<Eigen::Vector3d>& points) const {
    for (Eigen::Vector3d& point : points) point = scale * point + translation_m;
  }
};

Result<Placement> read_placement(const v1::Mesh& mesh, std::string_view where) {
  Placement placement;
  if (mesh.has_scale()) {
    TM_ASSIGN_OR_RETURN(scale, read_number(mesh.scale(), 1e-9, 1e9, fmt::format("{}.mesh.scale", where)));
    placement.scale = scale;
  }
  TM_ASSIGN_OR_RETURN(translation, read_vector(mesh.translation_m(), fmt::format("{}.mesh.translation_m", where)));
  placement.translation_m = translation;
  return placement;
}

Result<mesh::Shape> read_shape(v1::Shape shape, std::string_view where) {
  switch (shape) {
    case v1::SHAPE_UNSPECIFIED:
    case v1::SHAPE_TETRAHEDRON:
      return mesh::Shape::kTetrahedron;
    case v1::SHAPE_PYRAMID:
      return mesh::Shape::kPyramid;
    case v1::SHAPE_WEDGE:
      return mesh::Shape::kWedge;
    case v1::SHAPE_HEXAHEDRON:
      return mesh::Shape::kHexahedron;
    case v1::SHAPE_QUADRATIC_TETRAHEDRON:
      return mesh::Shape::kQuadraticTetrahedron;
    case v1::SHAPE_QUADRATIC_HEXAHEDRON:
      return mesh::Shape::kQuadraticHexahedron;
    default:
      return invalid(fmt::format("{}.shape: {} is unknown", where, static_cast<int>(shape)));
  }
}

Result<mesh::Mesh> read_source(const v1::Mesh& source, std::string_view where) {
  switch (source.source_case()) {
    case v1::Mesh::kPacked: {
      TM_ASSIGN_OR_RETURN(
          nodes, read_points(source.packed().node_positions(), fmt::format("{}.mesh.packed.node_positions", where)));
      mesh::Mesh mesh;
      mesh.nodes = std::move(nodes);
      if (source.packed().elements().empty()) return invalid(fmt::format("{}.mesh.packed.elements: none", where));
      for (int i = 0; i < source.packed().elements_size(); ++i) {
        const v1::PackedElements& block = source.packed().elements(i);
        const std::string at = fmt::format("{}.mesh.packed.elements[{}]", where, i);
        TM_ASSIGN_OR_RETURN(shape, read_shape(block.shape(), at));
        TM_ASSIGN_OR_RETURN(indices,
                            read_packed<std::uint32_t>(block.nodes(), mesh::topology(shape).node_count, at + ".nodes"));
        mesh.blocks.push_back({shape, std::move(indices)});
      }
      return mesh;
    }
    case v1::Mesh::kGrid: {
      const v1::Grid& grid = source.grid();
      TM_ASSIGN_OR_RETURN(origin, read_vector(grid.origin_m(), fmt::format("{}.mesh.grid.origin_m", where)));
      TM_ASSIGN_OR_RETURN(size, read_vector(grid.size_m(), fmt::format("{}.mesh.grid.size_m", where)));
      TM_ASSIGN_OR_RETURN(shape, read_shape(grid.shape(), fmt::format("{}.mesh.grid", where)));
      return mesh::make_grid(origin, size, grid.cells_x(), grid.cells_y(), grid.cells_z(), shape)
          .map_error([&](Error error) {
            error.message = fmt::format("{}.mesh.grid: {}", where, error.message);
            return error;
          });
    }
    case v1::Mesh::kFile:
      return invalid(
          fmt::format("{}.mesh.file: the server reads no files; load the scene with the Python SDK or the "
                      "`tensormass` command, which send the mesh along",
                      where));
    case v1::Mesh::SOURCE_NOT_SET:
      break;
  }
  return invalid(fmt::format("{}.mesh: no source; give packed or grid", where));
}

/// Adds the nodes in the middle of edges that have both ends among the selected nodes. `selected` stays ascending.
void add_middles(std::vector<std::uint32_t>& selected, const BodyNodes& nodes) {
  if (nodes.middle_of.empty() || selected.size() < 2) return;
  std::vector<bool> is_in(nodes.positions.size(), false);
  for (const std::uint32_t node : selected) is_in[node] = true;
  auto middle = static_cast<std::uint32_t>(nodes.positions.size() - nodes.middle_of.size());
  const std::size_t before = selected.size();
  for (const auto& [low, high] : nodes.middle_of) {
    if (is_in[low] && is_in[high] && !is_in[middle]) selected.push_back(middle);
    ++middle;
  }
  const auto added = selected.begin() + static_cast<std::ptrdiff_t>(before);
  std::inplace_merge(selected.begin(), added, selected.end());
}

}  // namespace

Result<void> check_name(std::string_view name, std::string_view what) {
  if (is_valid_name(name)) return {};
  return invalid(
      fmt::format("{}: the name must be 1 to {} characters out of [A-Za-z0-9_-]", what, limits::kMaxNameLength));
}

Result<Vec3<double>> read_vector(const v1::Vector3& vector, std::string_view where, double largest) {
  const Vec3<double> v(vector.x(), vector.y(), vector.z());
  if (!v.allFinite() || v.cwiseAbs().maxCoeff() > largest) {
    return invalid(fmt::format("{}: ({}, {}, {}) is not finite or beyond ±{:g}", where, vector.x(), vector.y(),
                               vector.z(), largest));
  }
  return v;
}

Result<std::array<double, 4>> read_orientation(const v1::Quaternion& q, std::string_view where) {
  const std::array<double, 4> values{q.w(), q.x(), q.y(), q.z()};
  // Tests the values: the sum of squares of (1e-300, 0, 0, 0) is zero too.
  if (values == std::array<double, 4>{}) return std::array<double, 4>{1, 0, 0, 0};
  double squared = 0;
  for (const double value : values) squared += value * value;
  const double length = std::sqrt(squared);
  if (!(std::abs(length - 1) < 1e-2)) {  // also refuses NaN and infinity
    return invalid(fmt::format("{}: a quaternion of length {} is not a rotation; normalize it", where,
                               std::hypot(std::hypot(q.w(), q.x()), std::hypot(q.y(), q.z()))));
  }
  return std::array<double, 4>{q.w() / length, q.x() / length, q.y() / length, q.z() / length};
}

Result<std::array<double, limits::kMaxToolJoints>> read_joints(const google::protobuf::RepeatedField<double>& values,
                                                               std::span<const physics::ToolParameter> joints,
                                                               std::string_view where) {
  if (static_cast<std::size_t>(values.size()) != joints.size()) {
    return invalid(fmt::format("{}: {} values for a tool of {} joints", where, values.size(), joints.size()));
  }
  std::array<double, limits::kMaxToolJoints> out{};
  for (std::size_t i = 0; i < joints.size(); ++i) {
    const physics::ToolParameter& joint = joints[i];
    TM_ASSIGN_OR_RETURN(value, read_number(values.Get(static_cast<int>(i)), joint.least, joint.most,
                                           fmt::format("{}[{}] ({})", where, i, joint.name)));
    out[i] = value;
  }
  return out;
}

Result<double> read_level(double level, const ToolModel& tool, std::string_view where) {
  TM_ASSIGN_OR_RETURN(share, read_number(level, 0, 1, where));
  if (share > 0 && !(tool.cautery_w > 0)) {
    return invalid(
        fmt::format("{}: tool '{}' has no power; give it Tool.cautery, or leave level out", where, tool.name));
  }
  return share;
}

Result<double> read_number(double value, double low, double high, std::string_view where) {
  if (value >= low && value <= high) return value;
  return invalid(fmt::format("{}: {} is not within [{:g}, {:g}]", where, value, low, high));
}

Result<bool> keeps_force(v1::ContactMethod method, std::string_view where) {
  switch (method) {
    case v1::CONTACT_METHOD_UNSPECIFIED:
    case v1::CONTACT_METHOD_PENALTY:
      return false;
    case v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN:
      return true;
    default:
      return invalid(fmt::format("{}: {} is unknown", where, static_cast<int>(method)));
  }
}

Result<Schedule> read_schedule(const v1::Schedule& schedule, std::string_view where) {
  if (schedule.time_s_size() > limits::kMaxSchedulePoints) {
    return invalid(fmt::format("{}: {} points exceed limits::kMaxSchedulePoints = {}", where, schedule.time_s_size(),
                               limits::kMaxSchedulePoints));
  }
  if (schedule.time_s_size() != schedule.factor_size()) {
    return invalid(fmt::format("{}: {} times and {} factors; give one factor a time", where, schedule.time_s_size(),
                               schedule.factor_size()));
  }
  Schedule out;
  for (int i = 0; i < schedule.time_s_size(); ++i) {
    TM_ASSIGN_OR_RETURN(time, read_number(schedule.time_s(i), -1e9, 1e9, fmt::format("{}.time_s[{}]", where, i)));
    TM_ASSIGN_OR_RETURN(factor, read_number(schedule.factor(i), -1e9, 1e9, fmt::format("{}.factor[{}]", where, i)));
    if (!out.empty() && !(time > out.time_s.back())) {
      return invalid(fmt::format("{}.time_s[{}]: {} does not come after {}", where, i, time, out.time_s.back()));
    }
    out.time_s.push_back(time);
    out.factor.push_back(factor);
  }
  return out;
}

Result<double> read_rate(double value_hz, std::string_view where) {
  if (value_hz == 0) return 0.0;
  if (value_hz >= limits::kMinRateHz && value_hz <= limits::kMaxRateHz) return value_hz;
  return invalid(fmt::format("{}: {} is neither 0 nor within [{:g}, {:g}]", where, value_hz, limits::kMinRateHz,
                             limits::kMaxRateHz));
}

Result<mesh::Mesh> read_mesh(const v1::Body& body, std::string_view where) {
  TM_ASSIGN_OR_RETURN(placement, read_placement(body.mesh(), where));
  return read_source(body.mesh(), where).map([&](mesh::Mesh mesh) {
    placement.apply(mesh.nodes);
    return mesh;
  });
}

Result<SkinMesh> read_skin(const v1::Body& body, std::string_view where) {
  TM_ASSIGN_OR_RETURN(placement, read_placement(body.mesh(), where));
  return read_triangles(body.skin(), fmt::format("{}.skin", where)).map([&](SkinMesh skin) {
    placement.apply(skin.vertices);
    return skin;
  });
}

Result<SkinMesh> read_triangles(const v1::Skin& surface, std::string_view where) {
  if (surface.source_case() != v1::Skin::kPacked) {
    return invalid(fmt::format("{}: give packed triangles; the server reads no files", where));
  }
  const v1::PackedTriangles& packed = surface.packed();
  TM_ASSIGN_OR_RETURN(vertices,
                      read_points(packed.vertex_positions(), fmt::format("{}.packed.vertex_positions", where)));
  TM_ASSIGN_OR_RETURN(indices,
                      read_packed<std::uint32_t>(packed.triangles(), 3, fmt::format("{}.packed.triangles", where)));
  SkinMesh skin;
  skin.vertices = std::move(vertices);
  skin.triangles.resize(indices.size() / 3);
  std::memcpy(skin.triangles.data(), indices.data(), indices.size() * sizeof(std::uint32_t));
  return skin;
}

Result<std::vector<double>> read_reals(const std::string& bytes, std::size_t width, std::string_view where) {
  return read_packed<double>(bytes, width, where);
}

Result<NodeSets> read_sets(const v1::Body& body, const BodyNodes& nodes, std::string_view where) {
  NodeSets sets;
  for (int i = 0; i < body.sets_size(); ++i) {
    const std::string at = fmt::format("{}.sets[{}]", where, i);
    TM_RETURN_IF_ERROR(check_name(body.sets(i).name(), at + ".name"));
    const int regions = body.sets(i).regions_size();
    if (regions == 0) return invalid(fmt::format("{}: no region; give the nodes of the set", at));
    if (static_cast<std::size_t>(regions) > limits::kMaxRegionsOfSet) {
      return fail(ErrorCode::kResourceExhausted, fmt::format("{}.regions: {} exceed limits::kMaxRegionsOfSet = {}", at,
                                                             regions, limits::kMaxRegionsOfSet));
    }
    std::vector<bool> is_in(nodes.positions.size(), false);
    for (int r = 0; r < regions; ++r) {
      // A set may refer to earlier sets.
      TM_ASSIGN_OR_RETURN(some,
                          read_region(body.sets(i).regions(r), nodes, sets, fmt::format("{}.regions[{}]", at, r)));
      for (const std::uint32_t node : some) is_in[node] = true;
    }
    std::vector<std::uint32_t> all;
    for (std::uint32_t node = 0; node < nodes.positions.size(); ++node) {
      if (is_in[node]) all.push_back(node);
    }
    add_middles(all, nodes);
    if (!sets.emplace(body.sets(i).name(), std::move(all)).second) {
      return invalid(fmt::format("{}: the name '{}' is taken by another set", at, body.sets(i).name()));
    }
  }
  return sets;
}

Result<std::vector<std::uint32_t>> read_region(const v1::Region& region, const BodyNodes& nodes, const NodeSets& sets,
                                               std::string_view where) {
  std::vector<std::uint32_t> selected;
  const auto select = [&](const auto& contains) {
    for (std::uint32_t i = 0; i < nodes.positions.size(); ++i) {
      if (contains(nodes.positions[i])) selected.push_back(i);
    }
  };
  switch (region.kind_case()) {
    case v1::Region::kBox: {
      TM_ASSIGN_OR_RETURN(low, read_vector(region.box().min_m(), fmt::format("{}.box.min_m", where)));
      TM_ASSIGN_OR_RETURN(high, read_vector(region.box().max_m(), fmt::format("{}.box.max_m", where)));
      select([&](const Eigen::Vector3d& x) {
        return (x.array() >= low.array()).all() && (x.array() <= high.array()).all();
      });
      break;
    }
    case v1::Region::kSphere: {
      TM_ASSIGN_OR_RETURN(center, read_vector(region.sphere().center_m(), fmt::format("{}.sphere.center_m", where)));
      TM_ASSIGN_OR_RETURN(radius, read_number(region.sphere().radius_m(), 0, limits::kMaxLength,
                                              fmt::format("{}.sphere.radius_m", where)));
      select([&](const Eigen::Vector3d& x) { return (x - center).norm() <= radius; });
      break;
    }
    case v1::Region::kNodes: {
      for (const std::uint32_t index : region.nodes().indices()) {
        if (index >= nodes.positions.size()) {
          return invalid(
              fmt::format("{}.nodes: node {} does not exist; the body has {}", where, index, nodes.positions.size()));
        }
        selected.push_back(index);
      }
      std::sort(selected.begin(), selected.end());
      selected.erase(std::unique(selected.begin(), selected.end()), selected.end());
      break;
    }
    case v1::Region::kSet: {
      const auto found = sets.find(region.set());
      if (found == sets.end()) {
        return invalid(fmt::format("{}.set: the body has no set '{}' (or it comes later)", where, region.set()));
      }
      return found->second;
    }
    case v1::Region::KIND_NOT_SET:
      return invalid(fmt::format("{}: give box, sphere, nodes or set", where));
  }
  if (selected.empty()) {
    return invalid(
        fmt::format("{}: no node of the body lies in it; its coordinates are metres after scale and "
                    "translation",
                    where));
  }
  add_middles(selected, nodes);
  return selected;
}

}  // namespace tensormass::model
