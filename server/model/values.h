#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "core/result.h"
#include "model/edit_buffers.h"
#include "model/material_input.h"
#include "model/model.h"
#include "model/spare_model.h"

namespace tensormass::v1 {
class Scene;
}

/// Other values of a scene: gravity, and moduli and damping of its bodies.
///
///   with_values   another Model of the same mesh, with the numbers that a compile of the adjusted scene would have
///   changed       the buffers in which the two differ ──> SceneState::prepare, then apply, between two steps
///
/// A compile also reads and admits meshes, orders nodes, groups elements and makes surfaces. None of that depends on
/// these values, so only vectors of numbers are computed anew, by the functions that a compile calls.
namespace tensormass::model {

/// The place of an element or a cluster among all groups.
struct RecordPlace {
  std::uint32_t group, place;
};

/// The sources of a scene's values, which compiling would throw away otherwise. Constant for the life of the scene.
struct ValueTables {
  struct Body {
    std::uint32_t element_count = 0;               ///< AdmittedBody::loaded_element_count
    std::vector<std::uint32_t> element_laws;       ///< as in ReadBody
    std::vector<std::uint32_t> element_materials;  ///< likewise
  };
  struct Group {
    std::vector<std::uint32_t> elements;  ///< [stride] of the scene; of a cluster its first; mesh::kNone: padding
    bool shares_deviatoric = false;       ///< its elements leave a part of their moduli to clusters
    double deviatoric_part = 0;           ///< that part (Cluster::deviatoric_part)
  };
  std::vector<Body> bodies;
  std::vector<Group> groups;
  std::vector<RecordPlace> linear;  ///< records of linear laws, in the order in which their tensors are added up
  /// [row_count, 4] Model::external without gravity; empty: zeros, or gravity has a schedule.
  std::vector<double> loads;
};

/// Returns a model of the same scene with the gravity, moduli and damping of another message, or nullptr if that must
/// be compiled: where gravity comes into a scene without any, has a schedule, or changes in a quasi-static scene, whose
/// loads grow. Fails as a compile of the message does.
///
///   present   the scene's model without edits
///   scene     the same scene with other values
///   spare     gives the memory of the new model, and gets it back
Result<std::shared_ptr<const Model>> with_values(const Model& present, const v1::Scene& scene, SpareModel& spare);

/// Lists the buffers, each as a whole, in which two models differ that with_values has made.
std::vector<EditRange> changed(const Model& present, const Model& next);

/// Returns a material with the moduli that a linear tetrahedron keeps in a cluster.
Material kept_by_member(Material material, double deviatoric_part);

/// Returns K_kl of a record with a linear law, from its rest shape and its moduli as they are now [N/m].
Mat3<double> constant_tensor(const ElementGroup& group, std::uint32_t place, std::uint32_t k, std::uint32_t l);

/// Returns Model::constant_edges: the tensors of records, added up in this order. Empty without records.
std::vector<double> add_up_constant_tensors(const matrix::Layout& layout, std::span<const ElementGroup> groups,
                                            std::span<const RecordPlace> records);

/// Writes loads and weights of all rows. loads: ValueTables::loads. external: [row_count, 4] N
void write_weights(std::span<const double> loads, std::span<const double> row_mass,
                   const Vec3<double>& gravity_m_per_s2, std::span<double> external);

/// Writes the moduli behind the contact surface of each body. Bodies without triangles keep what they have.
void write_surface_moduli(const matrix::Layout& layout, const ContactSurface& contact, std::span<BodyModel> bodies);

/// Returns areas and moduli at the vertices of the contact surface: a third of each triangle around them.
struct VertexSums {
  std::vector<double> area_m2;    ///< [surface vertex]
  std::vector<double> stiffness;  ///< [surface vertex] E times area, summed [N]
};
VertexSums sums_at_vertices(const ContactSurface& contact);
/// Returns E behind an edge between two triangles, weighted by their areas [Pa].
double modulus_of_edge(const ContactSurface& contact, std::uint32_t triangle, std::uint32_t across);

}  // namespace tensormass::model
