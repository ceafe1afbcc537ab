#pragma once

#include <array>
#include <cmath>
#include <concepts>
#include <cstdint>
#include <string_view>

#include "core/limits.h"
#include "core/scalar.h"

/// The interface of a tool's kind: the shape that touches tissue.
///
/// There are three families. A *thin* tool is a rigid core and a radius r: its surface is at the distance r from the
/// core. A point makes a sphere, a segment a capsule, a bent line a retractor. A *solid* (physics/tool/solid.h) is a
/// volume, given by its signed distance alone: a box, a plane, a mesh. A *blade* (physics/tool/edge.h) has no contact
/// points: it cuts. It is also one of the others: a solid, or thin if it dissects by its core.
///
///        r  ______________          c0, c1  core points
///       ___/              \___      x       a point of the scene [m]
///      /                      \     d       distance from the core to x [m]
///     |   c0 ------------ c1   |    φ       signed distance d − r: negative inside the tool [m]
///      \___                ___/     ∇φ      unit vector, from the core to x
///          \______________/
///
/// 1. A kind is a struct of static functions of a placed tool. They are pure, for host and device. Contact
///    (contact/tools.h), the compiler and the tests take all kinds from one list, `Tools` in physics/lists.h.
/// 2. Contact needs the core, not only φ. Tissue that is deeper inside than the core must still be pushed outwards, and
///    ∇φ points the other way there.
///
/// Constants of a kind:
///
///   kName            the protocol's name for it, in Tool.kind
///   kParameters      numbers that its message has besides radius_m, tip_offset_m and penalty_stiffness_pa_per_m
///   kJoints          joints that its pose has [rad or m], with their ranges
///   kIsSolid         whether it is a solid
///   kCorePoints      number of its core points; a solid has none. Contact finds out for each whether it is inside the
///                    tissue
///   kContactPoints   number of points at which it may touch one triangle
///
/// Functions of a kind; `tool` is placed in the scene, `x` is a point of the scene:
///
///   distance(tool, x)             returns φ
///   gradient(tool, x)             returns ∇φ; zero where it is undefined
///   joint_motion(tool, j, core, x)
///                                 returns the derivative by joint j of the point of the tool that is at x. `core` is
///                                 the point of the core that x belongs to. Only for a kind with joints
///
/// Functions of a thin kind:
///
///   core_point(tool, i)           returns core point i
///   closest_core_point(tool, x)   returns the point of the core that is closest to x
///   for_each_candidate(tool, a, b, c, visit)
///                                 visits pairs of a point of the triangle abc and a point of the core. The contact is
///                                 one of them
///                                 visit(weights, core): called at least once; barycentric coordinates, CorePoint
///
/// Functions of a solid kind:
///
///   length_m(parameters)          returns half of its thickness [m], by which the depth of contact is judged
///   reach_m(parameters)           returns the largest distance of its surface from the origin of its frame [m]
///   middle_m(tool)                returns how deep its middle is inside [m]. Contact looks for the point of a triangle
///                                 that is closest to there
namespace tensormass::physics {

/// A number in the message of a tool's kind, or a joint in its poses.
struct ToolParameter {
  std::string_view name;  ///< that of the field
  double least, most;
};

/// The numbers of a tool's message, as its kind's kParameters lists them; zero beyond them.
using ToolParameters = std::array<double, limits::kMaxToolParameters>;

/// Depth from which on the contact of a thin tool hardens (contact/tools.h), in radii.
inline constexpr double kHardeningBegins = 0.25;

/// A point of a tool's core.
template <class Real>
struct CorePoint {
  Vec3<Real> position;
  Real place;  ///< i at core point i; linear between two of them
};

/// A tool in the scene, as stages see it.
template <class Real>
struct PlacedTool {
  Real position_m[3];  // origin of the shape's frame: the tool's own frame, moved by tip_offset_m
  Real rotation[9];    // row-major; its columns are the axes of the shape's frame
  Real joint_values[limits::kMaxToolJoints];
  Real radius_m;                                // for a solid length_m
  const float* samples;                         // distances of mesh_solid.h; others do not read it
  Real parameters[limits::kMaxToolParameters];  // as kParameters lists them
  Real penalty_pa_per_m;                        // as the scene gives it; else 0
  Real penalty_per_m;      // else this times the modulus of what the tool touches; 0 if the scene gives it
  Real presence;           // share of the tool that is there while it is retired, 0 to 1; both penalties contain it
  Real friction;           // Coulomb's coefficient μ; 0: none
  Real severs_m;           // springs this near to its core are severed (contact/severing.h); 0: none
  Real severing_length_m;  // length of the core that severs, from the tip on
  Real steepest;           // where a thin tool's contact hardens no further (contact/tools.h)
  Real moved_m[3];         // motion of position_m in this step
  Real turned[9];          // I − R₀Rᵀ with the rotations R₀ at the start of the step and R now; row-major
  Real joints_moved[limits::kMaxToolJoints];  // change of joint_values in this step
  std::uint32_t kind;                         // place in Tools
  std::uint32_t first_core_point;             // its core points among those of all tools
  std::uint32_t contact_points;               // kContactPoints of the kind
  std::uint32_t first_contact_point;          // its contact points among those of all tools
  std::uint32_t keeps_force;                  // 1: augmented Lagrangian method (contact/tools.h)
  std::uint32_t remembers;                    // 1: its contacts remember the last step (view::ContactView::slips)

  TM_HOST_DEVICE Vec3<Real> position() const { return {position_m[0], position_m[1], position_m[2]}; }
  TM_HOST_DEVICE Vec3<Real> axis(int c) const { return {rotation[c], rotation[3 + c], rotation[6 + c]}; }
  /// Returns how far the point of the tool that is now at `x` has moved in this step [m], without its joints.
  TM_HOST_DEVICE Vec3<Real> motion_at(const Vec3<Real>& x) const {
    const Vec3<Real> arm = x - position();
    Vec3<Real> motion;
    for (int c = 0; c < 3; ++c) {
      motion[c] = moved_m[c] + turned[3 * c] * arm[0] + turned[3 * c + 1] * arm[1] + turned[3 * c + 2] * arm[2];
    }
    return motion;
  }
  /// Returns a vector of the shape's frame in the scene's frame, and back.
  TM_HOST_DEVICE Vec3<Real> to_scene(const Vec3<Real>& v) const {
    return axis(0) * v[0] + axis(1) * v[1] + axis(2) * v[2];
  }
  TM_HOST_DEVICE Vec3<Real> to_shape(const Vec3<Real>& v) const {
    return {axis(0).dot(v), axis(1).dot(v), axis(2).dot(v)};
  }
};

/// A visit of for_each_candidate that does nothing. nvcc does not take a lambda within a concept.
struct IgnoreCandidate {
  template <class Real>
  TM_HOST_DEVICE void operator()(const Vec3<Real>&, const CorePoint<Real>&) const {}
};

template <class T>
concept ThinTool = requires(const PlacedTool<double>& tool, const Vec3<double>& x) {
  requires !T::kIsSolid;
  { T::core_point(tool, 0) } -> std::same_as<Vec3<double>>;
  { T::closest_core_point(tool, x) } -> std::same_as<CorePoint<double>>;
  T::for_each_candidate(tool, x, x, x, IgnoreCandidate{});
};

template <class T>
concept SolidTool = requires(const PlacedTool<double>& tool, const ToolParameters& parameters) {
  requires T::kIsSolid && T::kCorePoints == 0;
  { T::length_m(parameters) } -> std::same_as<double>;
  { T::reach_m(parameters) } -> std::same_as<double>;
  { T::middle_m(tool) } -> std::same_as<double>;
};

template <class T>
concept Tool = (ThinTool<T> || SolidTool<T>)&&requires(const PlacedTool<double>& tool, const Vec3<double>& x) {
  { T::kName } -> std::convertible_to<std::string_view>;
  { T::kParameters.size() } -> std::convertible_to<std::size_t>;
  { T::kJoints.size() } -> std::convertible_to<std::size_t>;
  { T::kCorePoints } -> std::convertible_to<std::uint32_t>;
  { T::kContactPoints } -> std::convertible_to<std::uint32_t>;
  { T::distance(tool, x) } -> std::same_as<double>;
  { T::gradient(tool, x) } -> std::same_as<Vec3<double>>;
  { T::joint_motion(tool, 0, x, x) } -> std::same_as<Vec3<double>>;
};

/// Returns how far the point of a tool that is now at `x` has moved in this step [m].
/// core: point of the core that x belongs to.
template <class Kind, class Real>
TM_HOST_DEVICE Vec3<Real> motion_with_joints(const PlacedTool<Real>& tool, const Vec3<Real>& core,
                                             const Vec3<Real>& x) {
  Vec3<Real> motion = tool.motion_at(x);
  for (std::size_t j = 0; j < Kind::kJoints.size(); ++j) {
    motion += Kind::joint_motion(tool, j, core, x) * tool.joints_moved[j];
  }
  return motion;
}

/// Signed distance and gradient of a kind whose core has no volume, from its closest_core_point. It has no joints
/// unless the kind states them.
template <class Kind>
struct ThinCore {
  static constexpr std::array<ToolParameter, 0> kJoints{};
  static constexpr bool kIsSolid = false;
  static constexpr std::uint32_t kContactPoints = 1;

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> joint_motion(const PlacedTool<Real>&, std::size_t, const Vec3<Real>&,
                                                const Vec3<Real>&) {
    return Vec3<Real>::Zero();
  }
  template <class Real>
  TM_HOST_DEVICE static Real distance(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    using std::sqrt;
    const Vec3<Real> away = x - Kind::closest_core_point(tool, x).position;
    return sqrt(away.dot(away)) - tool.radius_m;
  }
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> gradient(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    using std::sqrt;
    const Vec3<Real> away = x - Kind::closest_core_point(tool, x).position;
    const Real squared = away.dot(away);
    return squared > 0 ? Vec3<Real>(away * (1 / sqrt(squared))) : Vec3<Real>(Vec3<Real>::Zero());
  }
};

}  // namespace tensormass::physics
