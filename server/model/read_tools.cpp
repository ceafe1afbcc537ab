#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <set>
#include <stdexcept>

#include <fmt/format.h>

#include "core/finding_kinds.h"
#include "core/limits.h"
#include "mesh/admission.h"
#include "model/distance_field.h"
#include "model/read_parts.h"
#include "model/scene_input.h"
#include "physics/lists.h"
#include "tensormass/v1/scene.pb.h"

/// Reads the tools of a scene. The kinds are those of physics::Tools: a kind's name and the names of its parameters say
/// which fields of the protocol hold it.
namespace tensormass::model {

namespace {

using google::protobuf::FieldDescriptor;
using google::protobuf::Message;

/// Contact pressure per depth, unless the scene gives it: this factor times E / radius, with E of the element that the
/// tool touches. A solid's radius is half its thickness; that of a plane is this share of the scene's size.
constexpr double kDefaultToolPenalty = 20;
constexpr double kPlaneRadiusInScenes = 0.1;
constexpr double kDefaultMaxSpeedMPerS = 0.5;
/// Largest way of a tool in a step, in its radii. A tool that moves farther may be past a thin sheet before any step
/// has seen it touch: docs/decisions/contact.md has the measurement.
constexpr double kMaxRadiiPerStep = 0.5;
/// The largest ToolModel::steepest: there the slope of contact is a hundred times that at the surface.
constexpr double kSteepestContact = 0.9;
/// About half of what the haptic client lets a device render.
constexpr double kDefaultCouplingNPerM = 1000;
/// A hand pushes an instrument by up to about 30 N before it slips.
constexpr double kDefaultMaxForceN = 30, kDefaultMaxTorqueNM = 1, kDefaultMaxJointLoad = 1;
/// Share of its power that a monopolar instrument brings into tissue; the rest heats what lies around
/// (docs/choosing.md).
constexpr double kDefaultCauteryEfficiency = 0.3;

/// The field of a kind's message. Throws if the protocol lacks it: every scene with that kind then fails.
const FieldDescriptor& field_of(const Message& kind, std::string_view name) {
  const FieldDescriptor* field = kind.GetDescriptor()->FindFieldByName(std::string(name));
  if (field == nullptr) throw std::logic_error(fmt::format("{} has no {}", kind.GetDescriptor()->full_name(), name));
  return *field;
}

Result<double> read_field(const Message& kind, std::string_view name, double least, double most,
                          std::string_view where) {
  return read_number(kind.GetReflection()->GetDouble(kind, &field_of(kind, name)), least, most,
                     fmt::format("{}.{}", where, name));
}

/// Returns the second largest of three sizes.
double middle_of(const Eigen::Vector3d& sizes) { return sizes.sum() - sizes.minCoeff() - sizes.maxCoeff(); }

/// Reads the surface of a sampled solid. Appends to the samples and findings of all tools.
Result<void> read_surface(const v1::MeshSolid& message, std::string_view owner, ReadTools& all, ToolModel& out) {
  const std::string where = fmt::format("{}.mesh", owner);
  TM_ASSIGN_OR_RETURN(surface, read_triangles(message.surface(), where + ".surface"));
  if (surface.triangles.size() > limits::kMaxToolTriangles) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("{}.surface: {} triangles exceed limits::kMaxToolTriangles = {}; simplify it", where,
                            surface.triangles.size(), limits::kMaxToolTriangles));
  }
  TM_ASSIGN_OR_RETURN(report, mesh::admit_skin(surface.vertices, surface.triangles, owner));
  for (Finding& finding : report.findings) {
    finding.place = where + ".surface";
    finding.tool = out.name;
    all.findings.push_back(std::move(finding));
  }
  TM_ASSIGN_OR_RETURN(scale, read_number(message.has_scale() ? message.scale() : 1, 1e-9, 1e9, where + ".scale"));
  for (Eigen::Vector3d& vertex : surface.vertices) vertex *= scale;
  TM_ASSIGN_OR_RETURN(field, sample_distance(surface.vertices, surface.triangles, where + ".surface"));
  const double thickness_m = field.box.sizes().minCoeff(), cube_m = field.box.sizes().maxCoeff() / kDistanceCubes;
  if (thickness_m < thresholds::kThinToolCubes * cube_m) {
    all.findings.push_back(
        {.code = FindingCode::kThinTool,
         .value = thickness_m / cube_m,
         .limit = thresholds::kThinToolCubes,
         .place = where + ".surface",
         .tool = out.name,
         .message = fmt::format("{}.surface is {:.3g} m thin, and its distance is sampled every {:.3g} m", where,
                                thickness_m, cube_m),
         .remedy = "tissue may pass through it, so make it thicker or take another kind of tool"});
  }
  out.parameters[0] = thickness_m / 2;
  out.parameters[1] = field.reach_m;
  out.width_m = middle_of(field.box.sizes());
  out.first_sample = all.samples.size();
  all.samples.insert(all.samples.end(), field.samples.begin(), field.samples.end());
  return {};
}

/// Returns the diagonal of the box around all nodes [m].
double size_of(std::span<const Eigen::Vector3d> nodes) {
  Eigen::AlignedBox3d box;
  for (const Eigen::Vector3d& node : nodes) box.extend(node);
  return box.diagonal().norm();
}

/// Reads what the message of a kind says about the shape.
///
///   kind    message of Kind
///   owner   the tool, for messages
///   nodes   as in read_tools
///   all     the tools before this one; gets the samples of a sampled solid
template <class Kind>
Result<void> read_shape(const Message& kind, std::string_view owner, std::span<const Eigen::Vector3d> nodes,
                        ReadTools& all, ToolModel& out) {
  const std::string where = fmt::format("{}.{}", owner, Kind::kName);
  out.core_points = Kind::kCorePoints;
  out.contact_points = Kind::kContactPoints;
  out.joints = Kind::kJoints;
  for (std::size_t i = 0; i < Kind::kParameters.size(); ++i) {
    const physics::ToolParameter& parameter = Kind::kParameters[i];
    TM_ASSIGN_OR_RETURN(value, read_field(kind, parameter.name, parameter.least, parameter.most, where));
    out.parameters[i] = value;
  }
  if constexpr (std::is_same_v<Kind, physics::BoxSolid>) {
    TM_RETURN_IF_ERROR(
        read_number(out.parameters[3], 0, Kind::length_m(out.parameters), fmt::format("{}.edge_radius_m", where)));
  }
  if constexpr (std::is_same_v<Kind, physics::MeshSolid>) {
    TM_RETURN_IF_ERROR(read_surface(dynamic_cast<const v1::MeshSolid&>(kind), owner, all, out));
  }
  if constexpr (Kind::kIsSolid) {
    out.radius_m = Kind::length_m(out.parameters);
    out.reach_m = Kind::reach_m(out.parameters);
    if constexpr (std::is_same_v<Kind, physics::Plane>) out.width_m = std::numeric_limits<double>::infinity();
    if constexpr (std::is_same_v<Kind, physics::BoxSolid>) {
      out.width_m = middle_of({out.parameters[0], out.parameters[1], out.parameters[2]});
    }
    if (!(out.radius_m > 0)) out.radius_m = kPlaneRadiusInScenes * size_of(nodes);
  } else {
    TM_ASSIGN_OR_RETURN(radius, read_field(kind, "radius_m", 1e-6, 1e3, where));
    out.radius_m = radius;
    out.width_m = 2 * radius;
  }
  if constexpr (Kind::kContactPoints == 0) out.width_m = std::numeric_limits<double>::infinity();  // it touches nothing
  const Message& tip_message = kind.GetReflection()->GetMessage(kind, &field_of(kind, "tip_offset_m"));
  TM_ASSIGN_OR_RETURN(
      tip, read_vector(dynamic_cast<const v1::Vector3&>(tip_message), fmt::format("{}.tip_offset_m", where)));
  out.tip_offset_m = tip;
  if constexpr (Kind::kContactPoints == 0) return {};
  constexpr std::string_view kPenalty = "penalty_stiffness_pa_per_m";
  if (!kind.GetReflection()->HasField(kind, &field_of(kind, kPenalty))) {
    out.penalty_per_m = kDefaultToolPenalty / out.radius_m;
    return {};
  }
  TM_ASSIGN_OR_RETURN(penalty, read_field(kind, kPenalty, 1e-3, 1e18, where));
  out.penalty_pa_per_m = penalty;
  return {};
}

/// Reads the mass of a tool and its coupling to the hand.
Result<void> read_coupling(const v1::Tool& tool, const std::string& where, ToolModel& out) {
  if (!tool.has_mass_kg()) {
    if (!tool.has_coupling_stiffness_n_per_m() && !tool.has_coupling_damping_n_s_per_m()) return {};
    return invalid(fmt::format("{}: a coupling needs mass_kg, so state it or leave the coupling out", where));
  }
  if (tool.fixed()) return invalid(fmt::format("{}: a fixed tool does not move, so leave mass_kg out", where));
  TM_ASSIGN_OR_RETURN(mass, read_number(tool.mass_kg(), 1e-6, 1e3, where + ".mass_kg"));
  const double given_k =
      tool.has_coupling_stiffness_n_per_m() ? tool.coupling_stiffness_n_per_m() : kDefaultCouplingNPerM;
  TM_ASSIGN_OR_RETURN(stiffness, read_number(given_k, 1e-3, 1e9, where + ".coupling_stiffness_n_per_m"));
  const double critical = 2 * std::sqrt(stiffness * mass);
  const double given_c = tool.has_coupling_damping_n_s_per_m() ? tool.coupling_damping_n_s_per_m() : critical;
  TM_ASSIGN_OR_RETURN(damping, read_number(given_c, 0, 1e9, where + ".coupling_damping_n_s_per_m"));
  out.mass_kg = mass;
  out.coupling_stiffness_n_per_m = stiffness;
  out.coupling_damping_n_s_per_m = damping;
  return {};
}

/// Reads the largest loads of a tool.
Result<void> read_largest_loads(const v1::Tool& tool, const std::string& where, ToolModel& out) {
  struct Load {
    bool has;
    double given, standard;
    const char* name;
    double* to;
  };
  for (const Load& load :
       {Load{tool.has_max_force_n(), tool.max_force_n(), kDefaultMaxForceN, "max_force_n", &out.max_force_n},
        Load{tool.has_max_torque_n_m(), tool.max_torque_n_m(), kDefaultMaxTorqueNM, "max_torque_n_m",
             &out.max_torque_n_m},
        Load{tool.has_max_joint_load(), tool.max_joint_load(), kDefaultMaxJointLoad, "max_joint_load",
             &out.max_joint_load}}) {
    if (load.has && tool.fixed()) {
      return invalid(fmt::format("{}: no hand holds a fixed tool, so leave {} out", where, load.name));
    }
    TM_ASSIGN_OR_RETURN(
        value, read_number(load.has ? load.given : load.standard, 1e-6, 1e6, fmt::format("{}.{}", where, load.name)));
    *load.to = value;
  }
  return {};
}

/// Reads the power of a tool that burns tissue. Its tip must be a point of a core, because there it burns.
Result<void> read_cautery(const v1::Tool& tool, const std::string& where, ToolModel& out) {
  if (!tool.has_cautery()) return {};
  if (out.core_points == 0 || out.fixed) {
    return invalid(fmt::format("{}.cautery: only a thin tool that moves has a tip that burns", where));
  }
  TM_ASSIGN_OR_RETURN(power, read_number(tool.cautery().power_w(), 1e-3, 1e4, where + ".cautery.power_w"));
  const double given = tool.cautery().has_efficiency() ? tool.cautery().efficiency() : kDefaultCauteryEfficiency;
  TM_ASSIGN_OR_RETURN(efficiency, read_number(given, 1e-3, 1, where + ".cautery.efficiency"));
  out.cautery_w = power * efficiency;
  return {};
}

/// Reads how far a tool severs springs. It needs a core, because reach is counted from there.
Result<void> read_dissection(const v1::Tool& tool, const std::string& where, std::span<const Eigen::Vector3d> nodes,
                             ToolModel& out) {
  if (!tool.has_dissection()) return {};
  if (out.core_points == 0 || out.fixed) {
    return invalid(fmt::format("{}.dissection: only a thin tool that moves has a tip that severs", where));
  }
  const double size_m = size_of(nodes);
  const auto read = [&](double value_m, const char* name) -> Result<double> {
    if (value_m >= 0 && value_m <= size_m) return value_m;
    return invalid(fmt::format("{}.dissection.{}: {} is not within 0 and the scene's size, {:.4g} m; give it in metres",
                               where, name, value_m, size_m));
  };
  TM_ASSIGN_OR_RETURN(reach_m, read(tool.dissection().reach_m(), "reach_m"));
  TM_ASSIGN_OR_RETURN(length_m, read(tool.dissection().length_m(), "length_m"));
  out.severs_m = out.radius_m + reach_m;
  out.severing_length_m = length_m;
  return {};
}

/// all: the tools before this one. The others: as in read_tools.
Result<ToolModel> read_tool(const v1::Tool& tool, std::span<const Eigen::Vector3d> nodes, double dt_s, ReadTools& all) {
  const std::string where = fmt::format("tool '{}'", tool.name());
  const auto* field =
      tool.GetReflection()->GetOneofFieldDescriptor(tool, tool.GetDescriptor()->FindOneofByName("kind"));
  ToolModel out;
  out.name = tool.name();
  out.description = std::make_shared<const v1::Tool>(tool);
  out.fixed = tool.fixed();
  std::string known;
  std::optional<Result<void>> shape;
  physics::for_each_type(physics::Tools{}, [&](auto tag, int index) {
    using Kind = typename decltype(tag)::Type;
    known += fmt::format("{}{}", known.empty() ? "" : ", ", Kind::kName);
    if (field == nullptr || field->name() != Kind::kName) return;
    out.kind = static_cast<std::uint32_t>(index);
    shape = read_shape<Kind>(tool.GetReflection()->GetMessage(tool, field), where, nodes, all, out);
  });
  if (!shape) return invalid(fmt::format("{}: no kind that this server knows; give one of {}", where, known));
  TM_RETURN_IF_ERROR(*shape);
  double safe_speed = kDefaultMaxSpeedMPerS;
  if (out.contact_points > 0) {  // anchors of a blade follow any way
    safe_speed = std::min(safe_speed, kMaxRadiiPerStep * out.radius_m / dt_s);
  }
  TM_ASSIGN_OR_RETURN(speed, read_number(tool.has_max_speed_m_per_s() ? tool.max_speed_m_per_s() : safe_speed, 1e-6,
                                         1e3, where + ".max_speed_m_per_s"));
  out.max_speed_m_per_s = speed;
  // A step is linearized once. Its contact may harden only as far as the tool cannot cross what is left in two steps.
  const double left = 2 * speed * dt_s / (out.radius_m * (1 - physics::kHardeningBegins));
  out.steepest = std::clamp(1 - left, 0.0, kSteepestContact);
  TM_ASSIGN_OR_RETURN(
      friction, read_number(tool.friction_coefficient(), 0, limits::kMaxFriction, where + ".friction_coefficient"));
  out.friction = friction;
  TM_ASSIGN_OR_RETURN(keeps, keeps_force(tool.contact_method(), where + ".contact_method"));
  out.keeps_force = keeps;
  TM_RETURN_IF_ERROR(read_coupling(tool, where, out));
  TM_RETURN_IF_ERROR(read_largest_loads(tool, where, out));
  TM_RETURN_IF_ERROR(read_cautery(tool, where, out));
  TM_RETURN_IF_ERROR(read_dissection(tool, where, nodes, out));
  TM_ASSIGN_OR_RETURN(position, read_vector(tool.position_m(), where + ".position_m"));
  TM_ASSIGN_OR_RETURN(orientation, read_orientation(tool.orientation(), where + ".orientation"));
  out.initial_pose = {position, orientation, {}};
  if (tool.joint_values_size() > 0) {
    TM_ASSIGN_OR_RETURN(joints, read_joints(tool.joint_values(), out.joints, where + ".joint_values"));
    out.initial_pose.joint_values = joints;
  } else {
    for (std::size_t i = 0; i < out.joints.size(); ++i) out.initial_pose.joint_values[i] = out.joints[i].least;
  }
  return out;
}

}  // namespace

Result<ReadTools> read_tools(const v1::Scene& scene, std::span<const Eigen::Vector3d> nodes, double dt_s) {
  if (static_cast<std::size_t>(scene.tools_size()) > limits::kMaxTools) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("scene.tools: {} exceed limits::kMaxTools = {}", scene.tools_size(), limits::kMaxTools));
  }
  ReadTools all;
  std::uint32_t core_points = 0, contact_points = 0;
  std::set<std::string> names;
  for (int i = 0; i < scene.tools_size(); ++i) {
    const v1::Tool& tool = scene.tools(i);
    TM_RETURN_IF_ERROR(check_name(tool.name(), fmt::format("scene.tools[{}].name", i)));
    if (!names.insert(tool.name()).second) {
      return invalid(fmt::format("scene.tools[{}]: the name '{}' is taken by another tool", i, tool.name()));
    }
    TM_ASSIGN_OR_RETURN(out, read_tool(tool, nodes, dt_s, all));
    if (tool.has_dissection() && scene.attachments().empty()) {
      return invalid(fmt::format(
          "tool '{}'.dissection: the scene has no springs to sever; add attachments, or leave it out", tool.name()));
    }
    out.first_core_point = core_points;
    out.first_contact_point = contact_points;
    core_points += out.core_points;
    contact_points += out.contact_points;
    all.tools.push_back(std::move(out));
  }
  return all;
}

}  // namespace tensormass::model
