#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "backend/backend.h"
#include "model/model.h"

namespace tensormass::world {

/// A line that cuts, from position to position: consecutive points of an edge, in a body at rest.
struct SweptWay {
  std::uint32_t body;                                  ///< place in Model::bodies
  std::vector<std::vector<Vec3<double>>> positions_m;  ///< [position][point] two or more of each
};

/// A tool that begins to cut, or that ends.
struct CutCourse {
  std::uint32_t tool = 0, body = 0;  ///< places in Model::tools, Model::bodies
  bool ended = false;                ///< else it begins
  double area_m2 = 0, work_j = 0;    ///< since it began
};

/// The ways of the fronts of blades at rest, from step to step, until a cut is made of them (cuts.h).
///
///   step ──BladeFront of each point──> take ──a position of the edge──> ways ──> cut_along
///
/// A step allocates nothing: room for kMaxBladePositions positions of each blade is reserved. A position that is near
/// the last one replaces it, and so does one that comes while the room is full; a sweep is then coarser.
class BladeSweeps {
 public:
  explicit BladeSweeps(const model::Model& model);

  /// Takes the fronts of a step. [points of all blades]
  void take(const model::Model& model, std::span<const backend::BladeFront> fronts);
  void clear();
  /// Whether a front has moved since the last call of take_ways.
  bool has_news() const { return news_; }
  /// Returns what was swept since the last call. Its last positions are the first ones of what comes. Allocates.
  std::vector<SweptWay> take_ways();
  /// Work of fracture since the start or the last reset [J].
  double fracture_j() const { return fracture_j_; }
  /// Returns, once, what tools began or ended in the last step. A course ends when its tool has cut nothing for
  /// kApartS.
  std::span<const CutCourse> take_courses() {
    return {news_of_courses_.data(), std::exchange(course_count_, std::size_t{0})};
  }
  /// Goes on with what another world of the scene has swept.
  ///
  ///   places   of this world's tools among those before; others are new
  void go_on_with(const BladeSweeps& before, std::span<const std::size_t> places);

 private:
  static constexpr std::uint32_t kNoBody = 0xFFFFFFFFu;
  static constexpr double kApartS = 0.25;
  struct Point {
    Vec3<double> rest_m = Vec3<double>::Zero();
    std::uint32_t body = kNoBody;  ///< kNoBody: it cuts nothing
  };
  struct Blade {
    std::size_t points = 0;
    std::size_t course = 0;     ///< that of its tool
    double step_m = 0;          ///< a way that makes a position of its own
    std::vector<Point> room;    ///< [position][point]
    std::size_t positions = 0;  ///< the last one may be replaced by the next if `open`
    bool open = false;
    Point* at(std::size_t position) { return room.data() + position * points; }
  };
  /// What a tool cuts, from its first step that cuts to the last.
  struct Course {
    std::uint32_t tool = 0, body = kNoBody;
    bool cuts = false;
    double area_m2 = 0, work_j = 0, idle_s = 0;
    double least_m2 = 0;             ///< a step that cuts less cuts nothing
    double step_m2 = 0, step_j = 0;  ///< in the present step
    std::uint32_t step_body = kNoBody;
  };
  void end_step(double dt_s);
  static bool same_run(const Blade& blade, const Point* a, const Point* b);
  static void add_ways(Blade& blade, std::vector<SweptWay>& out);

  std::vector<Blade> blades_;
  std::vector<Course> courses_;             // a course for each tool that is a blade
  std::vector<CutCourse> news_of_courses_;  // [course]; those of the last step come first
  std::size_t course_count_ = 0;
  std::vector<Point> now_;  // the present position of one blade
  bool news_ = false;
  double fracture_j_ = 0;
};

}  // namespace tensormass::world
