#include <algorithm>
#include <map>
#include <numeric>
#include <set>
#include <utility>

#include <fmt/format.h>

#include "core/limits.h"
#include "mesh/surface.h"
#include "model/compile_parts.h"
#include "model/scene_input.h"
#include "physics/element/face.h"
#include "tensormass/v1/scene.pb.h"

/// Reads boundary conditions, loads and the initial state of each body: fixed and prescribed nodes, forces, tractions,
/// pressures, gravity, initial displacements and velocities.
namespace tensormass::model {

namespace {

constexpr std::uint32_t kAllDirections = 7;
static_assert(mesh::kMaxFaceNodes == physics::kMaxFaceNodes);

/// A row with a prescribed displacement in some directions.
struct PrescribedDirections {
  std::uint32_t row;
  std::uint32_t prescribed;  // index into Model::prescribed
  std::uint32_t bits;        // the directions x, y, z
};

/// A force on a row that follows a schedule.
struct ScheduledForce {
  std::uint32_t row;
  std::uint32_t schedule;  // index into ScheduledLoads::schedules
  Vec3<double> force_n;    // at a factor of 1
};

class BoundaryReader {
 public:
  BoundaryReader(const v1::Scene& scene, const ReadBodies& all, const Settings& settings, const matrix::Layout& layout,
                 std::span<const double> row_mass)
      : scene_(scene),
        all_(all),
        bodies_(all.bodies),
        settings_(settings),
        layout_(layout),
        row_mass_(row_mass),
        external_(4 * std::size_t{layout.row_count}, 0),
        fixed_(layout.row_count, false) {
    out_.held.assign(layout.row_count, 0);
  }

  Result<BoundaryConditions> read() {
    for (std::size_t b = 0; b < bodies_.size(); ++b) {
      const v1::Body& body = scene_.bodies(static_cast<int>(b));
      const std::string where = fmt::format("body '{}'", body.name());
      TM_ASSIGN_OR_RETURN(sets, read_sets(body, bodies_[b].nodes(), where));
      TM_RETURN_IF_ERROR(fix(body, b, sets, where));
      TM_RETURN_IF_ERROR(prescribe(body, b, sets, where));
      TM_RETURN_IF_ERROR(load(body, b, sets, where));
      TM_RETURN_IF_ERROR(start(body, b, where));
      std::uint32_t& fixed_nodes = out_.fixed_node_count.emplace_back(0);
      for (std::uint32_t node = 0; node < bodies_[b].node_count; ++node) {
        if (out_.held[row(b, node)] != 0) ++fixed_nodes;
      }
    }
    add_gravity();
    if (any_external_) {
      out_.external = std::move(external_);
    } else {
      scheduled_.clear();
    }
    list_scheduled();
    group_prescribed_rows();
    group_pressure();
    return std::move(out_);
  }

 private:
  std::size_t row(std::size_t body, std::uint32_t node) const {
    return layout_.row_of_node[bodies_[body].node_begin + node];
  }
  void fix_directions(std::size_t row, std::uint32_t bits) {
    out_.held[row] = static_cast<std::uint8_t>(out_.held[row] | bits);
  }

  Result<void> fix(const v1::Body& body, std::size_t b, const NodeSets& sets, std::string_view where) {
    for (int i = 0; i < body.fixed_size(); ++i) {
      TM_ASSIGN_OR_RETURN(nodes,
                          read_region(body.fixed(i), bodies_[b].nodes(), sets, fmt::format("{}.fixed[{}]", where, i)));
      for (const std::uint32_t node : nodes) {
        fix_directions(row(b, node), kAllDirections);
        fixed_[row(b, node)] = true;
      }
    }
    return {};
  }

  Result<void> prescribe(const v1::Body& body, std::size_t b, const NodeSets& sets, std::string_view where) {
    for (int i = 0; i < body.prescribed_size(); ++i) {
      const std::string at = fmt::format("{}.prescribed[{}]", where, i);
      const v1::PrescribedDisplacement& p = body.prescribed(i);
      TM_ASSIGN_OR_RETURN(nodes, read_region(p.region(), bodies_[b].nodes(), sets, at + ".region"));
      v1::Vector3 vector;
      vector.set_x(p.x_m());
      vector.set_y(p.y_m());
      vector.set_z(p.z_m());
      TM_ASSIGN_OR_RETURN(displacement, read_vector(vector, at));
      const std::uint32_t bits = (p.has_x_m() ? 1u : 0) | (p.has_y_m() ? 2u : 0) | (p.has_z_m() ? 4u : 0);
      if (bits == 0) return invalid(fmt::format("{}: no direction; give x_m, y_m or z_m", at));
      TM_ASSIGN_OR_RETURN(schedule, read_schedule(p.schedule(), at + ".schedule"));
      out_.prescribed.push_back({displacement, std::move(schedule)});
      const auto index = static_cast<std::uint32_t>(out_.prescribed.size() - 1);
      for (const std::uint32_t node : nodes) {
        TM_RETURN_IF_ERROR(
            prescribe_directions(row(b, node), index, bits, [&] { return fmt::format("{}: node {}", at, node); }));
      }
    }
    return {};
  }

  /// Prescribes a displacement to some directions of a row. Nodes at edges and corners belong to several regions, so
  /// the same displacement may be given twice; two different ones are an error.
  template <class Where>
  Result<void> prescribe_directions(std::size_t row, std::uint32_t index, std::uint32_t bits, const Where& where) {
    const Prescribed& mine = out_.prescribed[index];
    std::uint32_t open = bits;  // directions that no earlier entry has
    std::vector<PrescribedDirections>& of_row = prescribed_[static_cast<std::uint32_t>(row)];
    for (const PrescribedDirections& other : of_row) {
      for (std::uint32_t c = 0; c < 3; ++c) {
        const auto axis = static_cast<Eigen::Index>(c);
        if ((other.bits & bits & 1u << c) == 0) continue;
        open &= ~(1u << c);
        const Prescribed& theirs = out_.prescribed[other.prescribed];
        const bool same = mine.displacement_m[axis] == theirs.displacement_m[axis] &&
                          (mine.displacement_m[axis] == 0 || mine.schedule == theirs.schedule);
        if (!same)
          return invalid(fmt::format("{} has two prescribed displacements in {}; choose one", where(), "xyz"[c]));
      }
    }
    for (std::uint32_t c = 0; c < 3; ++c) {
      if (fixed_[row] && (bits >> c & 1) != 0 && mine.displacement_m[static_cast<Eigen::Index>(c)] != 0) {
        return invalid(fmt::format("{} is fixed and prescribed in {}; choose one", where(), "xyz"[c]));
      }
    }
    if (open != 0) of_row.push_back({static_cast<std::uint32_t>(row), index, open});
    fix_directions(row, bits);
    return {};
  }

  Result<void> load(const v1::Body& body, std::size_t b, const NodeSets& sets, std::string_view where) {
    std::vector<mesh::BoundaryFace> faces;
    for (int i = 0; i < body.loads_size(); ++i) {
      const std::string at = fmt::format("{}.loads[{}]", where, i);
      const v1::Load& load = body.loads(i);
      TM_ASSIGN_OR_RETURN(nodes, read_region(load.region(), bodies_[b].nodes(), sets, at + ".region"));
      TM_ASSIGN_OR_RETURN(read, read_schedule(load.schedule(), at + ".schedule"));
      const std::uint32_t schedule = index_of(std::move(read));
      if (load.kind_case() == v1::Load::kForceN) {
        TM_ASSIGN_OR_RETURN(force, read_vector(load.force_n(), at + ".force_n", limits::kMaxForceN));
        for (const std::uint32_t node : nodes) {
          add_external(row(b, node), force / static_cast<double>(nodes.size()), schedule);
        }
        continue;
      }
      if (load.kind_case() == v1::Load::KIND_NOT_SET) {
        return invalid(fmt::format("{}: no load; give force_n, traction_pa or pressure_pa", at));
      }
      if (bodies_[b].cut != nullptr) {
        return invalid(fmt::format("{}: a body with loads on its surface cannot be cut yet; give force_n", at));
      }
      if (faces.empty()) faces = mesh::boundary_faces(bodies_[b].mesh);
      const std::set<std::uint32_t> chosen(nodes.begin(), nodes.end());
      std::vector<mesh::FaceNodes> loaded;
      for (const mesh::BoundaryFace& face : faces) {
        if (std::all_of(face.nodes.begin(), face.nodes.end(), [&](std::uint32_t n) { return chosen.contains(n); })) {
          loaded.push_back(face.nodes);
        }
      }
      if (loaded.empty()) {
        return invalid(fmt::format("{}.region: {} nodes lie in it, but no whole face of the boundary; make it larger",
                                   at, nodes.size()));
      }
      if (load.kind_case() == v1::Load::kTractionPa) {
        TM_ASSIGN_OR_RETURN(traction, read_vector(load.traction_pa(), at + ".traction_pa", limits::kMaxPressurePa));
        for (const mesh::FaceNodes& face : loaded) add_traction(b, face, traction, schedule);
      } else {
        TM_ASSIGN_OR_RETURN(pressure, read_number(load.pressure_pa(), -limits::kMaxPressurePa, limits::kMaxPressurePa,
                                                  at + ".pressure_pa"));
        for (const mesh::FaceNodes& face : loaded) add_pressure(b, face, pressure, schedule);
      }
    }
    return {};
  }

  /// Returns the index of a schedule among ScheduledLoads::schedules, and adds it if it is new. mesh::kNone: it is
  /// empty.
  std::uint32_t index_of(Schedule schedule) {
    if (schedule.empty()) return mesh::kNone;
    std::vector<Schedule>& all = out_.scheduled.schedules;
    const auto [known, is_new] = schedules_.try_emplace(schedule, static_cast<std::uint32_t>(all.size()));
    if (is_new) all.push_back(std::move(schedule));
    return known->second;
  }

  /// schedule: index into ScheduledLoads::schedules, or mesh::kNone
  void add_external(std::size_t row, const Vec3<double>& force, std::uint32_t schedule) {
    any_external_ = any_external_ || force.squaredNorm() > 0;
    if (schedule != mesh::kNone) {
      scheduled_.push_back({static_cast<std::uint32_t>(row), schedule, force});
      return;
    }
    for (std::size_t c = 0; c < 3; ++c) external_[4 * row + c] += force[static_cast<Eigen::Index>(c)];
  }

  void add_traction(std::size_t b, const mesh::FaceNodes& face, const Vec3<double>& traction, std::uint32_t schedule) {
    Vec3<double> x[physics::kMaxFaceNodes];
    for (std::uint32_t k = 0; k < face.count; ++k) x[k] = bodies_[b].mesh.nodes[face[k]];
    for (std::uint32_t k = 0; k < face.count; ++k) {
      add_external(row(b, face[k]), traction * physics::face_area(x, static_cast<int>(face.count), static_cast<int>(k)),
                   schedule);
    }
  }

  void add_pressure(std::size_t b, const mesh::FaceNodes& face, double pressure, std::uint32_t schedule) {
    view::PressureFace<double> out;
    out.node_count = face.count;
    out.pressure_pa = pressure;
    for (std::uint32_t k = 0; k < physics::kMaxFaceNodes; ++k) {
      out.rows[k] = k < face.count ? static_cast<std::uint32_t>(row(b, face[k])) : 0;
    }
    out_.pressure.faces.push_back(out);
    schedules_of_faces_.push_back(schedule);
    bodies_of_faces_.push_back(b);
  }

  Result<void> start(const v1::Body& body, std::size_t b, std::string_view where) {
    TM_RETURN_IF_ERROR(read_start(body.initial_displacement_m(), b, fmt::format("{}.initial_displacement_m", where),
                                  out_.initial_displacement));
    const std::string at = fmt::format("{}.initial_velocity_m_per_s", where);
    if (!body.initial_velocity_m_per_s().empty() && settings_.quasi_static()) {
      return invalid(fmt::format("{}: a quasi-static step has no velocity; leave it out", at));
    }
    return read_start(body.initial_velocity_m_per_s(), b, at, out_.initial_velocity);
  }

  /// Reads three values a node; those of the mesh's own nodes are enough. out: [row_count, 4].
  Result<void> read_start(const std::string& bytes, std::size_t b, std::string_view where, std::vector<double>& out) {
    if (bytes.empty()) return {};
    TM_ASSIGN_OR_RETURN(values, read_reals(bytes, 3, where));
    const std::vector<mesh::EdgeEnds>& middle_of = bodies_[b].middle_of;
    const std::size_t node_count = bodies_[b].loaded_node_count, own_count = node_count - middle_of.size();
    if (values.size() == 3 * own_count) {
      interpolate(values, b);
    } else if (values.size() != 3 * node_count) {
      const std::string or_own =
          middle_of.empty() ? "" : fmt::format(", or for the {} of the mesh before element_order", own_count);
      return invalid(
          fmt::format("{}: {} values for {} nodes{}; give three a node", where, values.size(), node_count, or_own));
    }
    out.resize(4 * std::size_t{layout_.row_count}, 0);
    for (std::uint32_t node = 0; node < node_count; ++node) {
      for (std::size_t c = 0; c < 3; ++c) {
        const double value = values[3 * std::size_t{node} + c];
        const auto at = [&] { return fmt::format("{}, node {}", where, node); };
        TM_RETURN_IF_ERROR(read_number(value, -limits::kMaxLength, limits::kMaxLength, at()));
        if (fixed_[row(b, node)] && value != 0) {
          return invalid(fmt::format("{} is fixed and starts at rest; give it zero", at()));
        }
        out[4 * row(b, node) + c] = value;
      }
    }
    return {};
  }

  /// Adds the values of nodes that element_order added: the mean of both ends of their edge, or zero where fixed.
  /// values: [own node count, 3], grows to [node_count, 3].
  void interpolate(std::vector<double>& values, std::size_t b) {
    for (const auto& [low, high] : bodies_[b].middle_of) {
      const bool held = fixed_[row(b, static_cast<std::uint32_t>(values.size() / 3))];
      for (std::size_t c = 0; c < 3; ++c) {
        values.push_back(held ? 0 : 0.5 * (values[3 * std::size_t{low} + c] + values[3 * std::size_t{high} + c]));
      }
    }
  }

  void add_gravity() {
    if (!settings_.has_gravity) return;
    const std::uint32_t schedule = index_of(settings_.gravity_schedule);
    if (schedule == mesh::kNone) {
      if (any_external_) out_.loads = external_;
      write_weights(out_.loads, row_mass_, settings_.gravity_m_per_s2, external_);
      any_external_ = true;  // also without weight: gravity may change while the scene steps
      return;
    }
    for (std::size_t i = 0; i < layout_.row_count; ++i) {
      add_external(i, row_mass_[i] * settings_.gravity_m_per_s2, schedule);
    }
  }

  /// Lists the scheduled forces by row, and the schedules of the faces if one has any.
  void list_scheduled() {
    ScheduledLoads& out = out_.scheduled;
    const auto place = [](const ScheduledForce& force) { return std::pair(force.row, force.schedule); };
    std::stable_sort(scheduled_.begin(), scheduled_.end(),
                     [&](const ScheduledForce& a, const ScheduledForce& b) { return place(a) < place(b); });
    for (std::size_t i = 0; i < scheduled_.size(); ++i) {
      const ScheduledForce& one = scheduled_[i];
      if (i == 0 || place(one) != place(scheduled_[i - 1])) {
        out.rows.push_back(one.row);
        out.of_entry.push_back(one.schedule);
        out.forces.resize(out.forces.size() + 3, 0);
      }
      Eigen::Map<Vec3<double>>(&out.forces[out.forces.size() - 3]) += one.force_n;
    }
    const auto is_scheduled = [](std::uint32_t schedule) { return schedule != mesh::kNone; };
    if (std::any_of(schedules_of_faces_.begin(), schedules_of_faces_.end(), is_scheduled)) {
      out.of_face = std::move(schedules_of_faces_);
    }
  }

  /// Lists the prescribed rows by patch.
  void group_prescribed_rows() {
    if (prescribed_.empty()) return;
    PrescribedRows& out = out_.prescribed_rows;
    out.patch_begin.assign(layout_.patch_count + 1, 0);
    for (const auto& [row, all] : prescribed_) {  // a map: rows ascend, and so do their patches
      for (const PrescribedDirections& one : all) {
        out.rows.insert(out.rows.end(), {one.row, one.prescribed, one.bits});
        ++out.patch_begin[layout_.patch_of_row(row) + 1];
      }
    }
    std::partial_sum(out.patch_begin.begin(), out.patch_begin.end(), out.patch_begin.begin());
  }

  /// Returns for each body whether the pressure on it conserves energy: −∂f_k/∂x_l = (−∂f_l/∂x_k)ᵀ for all nodes, in
  /// their free directions. It does if the pressed surface is closed and its pressure uniform. A rim may lie in fixed
  /// nodes or in planes of symmetry. Checked at rest.
  std::vector<bool> conserving_bodies() const {
    struct Coupling {
      Vec3<double> skew = Vec3<double>::Zero();  // v, where −∂f_k/∂x_l − (−∂f_l/∂x_k)ᵀ = [v]×
      double size = 0;
      std::size_t body = 0;
    };
    std::map<std::pair<std::uint32_t, std::uint32_t>, Coupling> couplings;  // [row k < row l]
    const std::vector<view::PressureFace<double>>& faces = out_.pressure.faces;
    for (std::size_t f = 0; f < faces.size(); ++f) {
      const int nodes = static_cast<int>(faces[f].node_count);
      Vec3<double> x[physics::kMaxFaceNodes];
      for (int k = 0; k < nodes; ++k) {
        x[k] = all_.merged.nodes[layout_.node_of_row[faces[f].rows[static_cast<std::size_t>(k)]]];
      }
      for (int k = 0; k < nodes; ++k) {
        for (int l = 0; l < nodes; ++l) {
          if (faces[f].rows[k] >= faces[f].rows[l]) continue;
          Coupling& coupling = couplings[{faces[f].rows[k], faces[f].rows[l]}];
          const Vec3<double> of_k = physics::face_area_change(x, nodes, k, l) * faces[f].pressure_pa;
          const Vec3<double> of_l = physics::face_area_change(x, nodes, l, k) * faces[f].pressure_pa;
          coupling.skew += of_k + of_l;
          coupling.size += of_k.norm() + of_l.norm();
          coupling.body = bodies_of_faces_[f];
        }
      }
    }
    constexpr double kRounding = 1e-9;
    std::vector<bool> conserves(bodies_.size(), true);
    for (const auto& [rows, coupling] : couplings) {
      const Mat3<double> skew = cross_matrix(coupling.skew);
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
          const bool moves = is_free(rows.first, i) && is_free(rows.second, j);
          if (moves && std::abs(skew(i, j)) > kRounding * coupling.size) conserves[coupling.body] = false;
        }
      }
    }
    return conserves;
  }
  bool is_free(std::size_t row, int direction) const { return (out_.held[row] >> direction & 1u) == 0; }

  /// Lists the rows under pressure by patch, and for each row its corners in the faces with their slots.
  void group_pressure() {
    PressureSurface& out = out_.pressure;
    if (out.faces.empty()) return;
    const std::vector<bool> conserves = conserving_bodies();
    std::map<std::uint32_t, std::vector<std::uint32_t>> corners;  // [row] pairs of face, corner
    for (std::uint32_t f = 0; f < out.faces.size(); ++f) {
      for (std::uint32_t k = 0; k < out.faces[f].node_count; ++k) {
        auto& list = corners[out.faces[f].rows[k]];
        list.insert(list.end(), {f, k});
      }
    }
    out.conserves_energy =
        std::all_of(bodies_of_faces_.begin(), bodies_of_faces_.end(), [&](std::size_t b) { return conserves[b]; });
    out.patch_begin.assign(layout_.patch_count + 1, 0);
    out.corner_begin.assign(1, 0);
    for (const auto& [row, list] : corners) {
      out.rows.push_back(row);
      out.corners.insert(out.corners.end(), list.begin(), list.end());
      for (std::size_t i = 0; i < list.size(); i += 2) {
        const view::PressureFace<double>& face = out.faces[list[i]];
        for (std::uint32_t l = 0; l < physics::kMaxFaceNodes; ++l) {
          const bool couples = l < face.node_count && l != list[i + 1] && conserves[bodies_of_faces_[list[i]]];
          out.slots.push_back(couples ? layout_.slot(row, face.rows[l]) : view::kNoPlace);
        }
      }
      out.corner_begin.push_back(static_cast<std::uint32_t>(out.corners.size() / 2));
      ++out.patch_begin[layout_.patch_of_row(row) + 1];
    }
    std::partial_sum(out.patch_begin.begin(), out.patch_begin.end(), out.patch_begin.begin());
  }

  const v1::Scene& scene_;
  const ReadBodies& all_;
  const std::vector<ReadBody>& bodies_;
  const Settings& settings_;
  const matrix::Layout& layout_;
  std::span<const double> row_mass_;  // [row]
  BoundaryConditions out_{};
  std::vector<double> external_;
  std::vector<bool> fixed_;  // [row_count]
  bool any_external_ = false;
  std::map<Schedule, std::uint32_t> schedules_;  // index among all schedules
  std::vector<ScheduledForce> scheduled_;
  std::vector<std::uint32_t> schedules_of_faces_;  // [face]
  std::vector<std::size_t> bodies_of_faces_;       // [face]
  std::map<std::uint32_t, std::vector<PrescribedDirections>> prescribed_;
};

}  // namespace

Result<BoundaryConditions> make_boundary_conditions(const v1::Scene& scene, const ReadBodies& bodies,
                                                    const Settings& settings, const matrix::Layout& layout,
                                                    std::span<const double> row_mass) {
  return BoundaryReader(scene, bodies, settings, layout, row_mass).read();
}

void hold_directions(std::span<const std::uint8_t> held, std::span<double> rest) {
  for (std::size_t row = 0; row < held.size(); ++row) {
    double& free = rest[4 * row + 3];
    free = static_cast<std::uint32_t>(free) & ~std::uint32_t{held[row]};
  }
}

}  // namespace tensormass::model
