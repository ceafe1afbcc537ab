#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "core/limits.h"
#include "core/result.h"
#include "core/scalar.h"
#include "mesh/mesh.h"
#include "tensormass/v1/scene.pb.h"

/// From untrusted messages to checked values. Every error says where in the scene it is and what to do.
namespace tensormass::model {

/// is_valid_name (core/names.h). `what` as in "scene.name", "scene.bodies[2].name".
Result<void> check_name(std::string_view name, std::string_view what);

/// Finite and no component beyond `largest`.
Result<Vec3<double>> read_vector(const v1::Vector3& vector, std::string_view where,
                                 double largest = limits::kMaxLength);

/// Unit quaternion w x y z; all zero is the identity.
Result<std::array<double, 4>> read_orientation(const v1::Quaternion& q, std::string_view where);

/// A number in [low, high]; NaN is in no range.
Result<double> read_number(double value, double low, double high, std::string_view where);
/// Of a stream, 0 for none [Hz].
Result<double> read_rate(double value_hz, std::string_view where);

/// The body's mesh, scaled and moved, not yet admitted.
Result<mesh::Mesh> read_mesh(const v1::Body& body, std::string_view where);

struct SkinMesh {
  std::vector<Eigen::Vector3d> vertices;  ///< m, scaled and moved as the mesh
  std::vector<mesh::Triangle> triangles;
};
Result<SkinMesh> read_skin(const v1::Body& body, std::string_view where);

/// A packed array of float64 with `width` a row.
Result<std::vector<double>> read_reals(const std::string& bytes, std::size_t width, std::string_view where);

/// A body's named sets: nodes, ascending.
using NodeSets = std::map<std::string, std::vector<std::uint32_t>, std::less<>>;
Result<NodeSets> read_sets(const v1::Body& body, const std::vector<Eigen::Vector3d>& nodes, std::string_view where);

/// Nodes of the region, ascending. A region without nodes is an error: it is never what was meant.
Result<std::vector<std::uint32_t>> read_region(const v1::Region& region, const std::vector<Eigen::Vector3d>& nodes,
                                               const NodeSets& sets, std::string_view where);

}  // namespace tensormass::model
