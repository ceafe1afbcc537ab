#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/limits.h"
#include "core/result.h"
#include "core/scalar.h"
#include "mesh/elevate.h"
#include "mesh/mesh.h"
#include "model/schedule.h"
#include "physics/tool/tool.h"

namespace google::protobuf {
template <class Element>
class RepeatedField;
}
namespace tensormass::v1 {
class Body;
class Quaternion;
class Region;
class Schedule;
class Skin;
class Vector3;
enum ContactMethod : int;
}  // namespace tensormass::v1

/// Turns untrusted messages into checked values. Every error says where in the scene it is and what to do.
///
/// where, what: the place for messages, as in "scene.name", "scene.bodies[2].name" or "body 'liver'.density_kg_per_m3".
namespace tensormass::model {

struct ToolModel;

/// Refuses names that is_valid_name (core/names.h) does not allow.
Result<void> check_name(std::string_view name, std::string_view what);

/// Reads a vector of finite components, none larger than `largest`.
Result<Vec3<double>> read_vector(const v1::Vector3& vector, std::string_view where,
                                 double largest = limits::kMaxLength);

/// Reads a unit quaternion w x y z; all zero is the identity.
Result<std::array<double, 4>> read_orientation(const v1::Quaternion& q, std::string_view where);
/// Returns a value for each joint, within the joint's range. Fails if there are more or fewer.
Result<std::array<double, limits::kMaxToolJoints>> read_joints(const google::protobuf::RepeatedField<double>& values,
                                                               std::span<const physics::ToolParameter> joints,
                                                               std::string_view where);

/// Reads the level of a pose: the share of its power that a tool uses, 0 to 1. Only a tool with power has one.
Result<double> read_level(double level, const ToolModel& tool, std::string_view where);

/// Reads a number in [low, high]. Refuses NaN.
Result<double> read_number(double value, double low, double high, std::string_view where);
/// Reads a method of contact. Returns whether contacts keep their force from step to step.
Result<bool> keeps_force(v1::ContactMethod method, std::string_view where);
/// Reads a factor over time. A schedule without points is empty.
Result<Schedule> read_schedule(const v1::Schedule& schedule, std::string_view where);
/// Reads the rate of a stream [Hz]; 0 switches it off.
Result<double> read_rate(double value_hz, std::string_view where);

/// Reads the body's mesh, scaled and moved. mesh::admit has not checked it yet.
Result<mesh::Mesh> read_mesh(const v1::Body& body, std::string_view where);

struct SkinMesh {
  std::vector<Eigen::Vector3d> vertices;  ///< m
  std::vector<mesh::Triangle> triangles;
};
/// Reads a triangle surface as it stands. mesh::admit_skin has not checked it yet.
Result<SkinMesh> read_triangles(const v1::Skin& surface, std::string_view where);
/// Reads the body's skin, scaled and moved like its mesh.
Result<SkinMesh> read_skin(const v1::Body& body, std::string_view where);

/// Reads a packed array of float64 with `width` values a row.
Result<std::vector<double>> read_reals(const std::string& bytes, std::size_t width, std::string_view where);

/// The nodes of a body, from which regions choose.
struct BodyNodes {
  std::span<const Eigen::Vector3d> positions;  ///< [node_count] m, at rest
  /// Edges in whose middles the last nodes are, if the mesh was made quadratic. A region that has both ends of such an
  /// edge has its middle too, so it has the same elements and faces as in the linear mesh.
  std::span<const mesh::EdgeEnds> middle_of;
};

/// The named sets of a body, each a list of nodes, ascending.
using NodeSets = std::map<std::string, std::vector<std::uint32_t>, std::less<>>;
Result<NodeSets> read_sets(const v1::Body& body, const BodyNodes& nodes, std::string_view where);

/// Returns the nodes of a region, ascending. A region without nodes is an error, because nobody means that.
Result<std::vector<std::uint32_t>> read_region(const v1::Region& region, const BodyNodes& nodes, const NodeSets& sets,
                                               std::string_view where);

}  // namespace tensormass::model
