#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "model/edit.h"
#include "model/model.h"
#include "physics/tool/pose.h"

/// Finds tools that are inside tissue, and the way out.
///
/// A surface that gives way under a tool stays outside of it. A tool is inside tissue if it begins there, or if the
/// surface has been forced past it. Contact then works the wrong way round: the tissue holds a tool that the hand draws
/// back. So such a tool is taken out (world.h).
///
/// A point is inside a closed surface if a ray from it leaves the surface once more than it enters it. Rays along the
/// axes need only signs of areas; all crossings of one line give the ways out in both of its directions.
///
///     ------|=====p=====|-------|===|----->    | crossing; = inside
///           <---->                             way out backwards
///                 <---->                       and forwards
namespace tensormass::world {

class Enclosure {
 public:
  /// Keeps a reference to the model. A scene that stops on faults has nothing to look at.
  explicit Enclosure(const model::Model& model);

  /// Whether there is no body to look at.
  bool empty() const { return bodies_.empty(); }
  /// Takes over surfaces that edits have changed. A skin that was torn is not closed any more, so the boundary of what
  /// is left takes its place.
  void take(const model::Model& model, const model::Editor& editor);
  /// Takes the visible positions [visible_count, 3] m of this moment, which must stay until the next call.
  void update(std::span<const float> visible_m);
  /// Returns whether a body encloses a point of the tool's core with half a radius of tissue around it. The core of a
  /// solid is its middle; a plane has none.
  bool encloses(const model::ToolModel& tool, const physics::Pose& shape);
  /// Returns whether no body encloses a point of the tool's core.
  bool is_outside(const model::ToolModel& tool, const physics::Pose& shape) const;
  /// Returns the shortest move along an axis after which the tool is outside, with its diameter between, or nullopt.
  std::optional<Vec3<double>> way_out(const model::ToolModel& tool, const physics::Pose& shape) const;

 private:
  /// Triangles of a body for each second of a step. A look reads all of them if a core is among them, which would take
  /// too much of the step if they were more.
  static constexpr double kMaxTrianglesPerS = 4e7;
  /// Surfaces with more crossings on one line are too torn to tell inside from outside.
  static constexpr std::size_t kMaxCrossings = 64;
  struct Crossings {
    struct One {
      double at_m;
      int leaves;  ///< 1, or −1: enters
    };
    std::array<One, kMaxCrossings> all;
    std::size_t count = 0;
  };
  /// A body whose visible surface is closed and small enough to be looked at.
  struct Body {
    std::size_t place;                       ///< in Model::bodies
    std::uint32_t vertex_begin, vertex_end;  ///< visible points of its topology
    std::vector<mesh::Triangle> triangles;   ///< those that exist; corners are visible points
    std::vector<std::uint32_t> appended;     ///< visible points that edits have appended
    Vec3<double> least = Vec3<double>::Zero(), most = Vec3<double>::Zero();
  };
  struct Core {
    std::array<Vec3<double>, limits::kMaxCorePoints> points;
    std::size_t count = 0;
  };

  static Core core_of(const model::ToolModel& tool, const physics::Pose& shape);
  Vec3<double> position(std::uint32_t point) const;
  std::span<const mesh::Triangle> triangles_between(const Body& body, const Vec3<double>& least,
                                                    const Vec3<double>& most);
  bool cross(std::span<const mesh::Triangle> triangles, const Vec3<double>& point, int axis, Crossings& out) const;
  bool is_inside(const Body& body, std::span<const mesh::Triangle> triangles, const Vec3<double>& point) const;

  std::vector<Body> bodies_;
  std::span<const float> visible_m_;
  // A look's own, reserved.
  std::vector<std::uint8_t> sides_;  // [visible point] see triangles_between
  std::vector<mesh::Triangle> triangles_;
};

}  // namespace tensormass::world
