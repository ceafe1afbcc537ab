#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "model/model.h"

namespace tensormass::world {

/// A line that cuts, from position to position: consecutive points of an edge, in a body at rest.
struct SweptWay {
  std::uint32_t body;                                  ///< place in Model::bodies
  std::vector<std::vector<Vec3<double>>> positions_m;  ///< [position][point] two or more of each
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
  /// Goes on with what another world of the scene has swept.
  void go_on_with(const BladeSweeps& before);

 private:
  static constexpr std::uint32_t kNoBody = 0xFFFFFFFFu;
  struct Point {
    Vec3<double> rest_m = Vec3<double>::Zero();
    std::uint32_t body = kNoBody;  ///< kNoBody: it cuts nothing
  };
  struct Blade {
    std::size_t points = 0;
    double step_m = 0;          ///< a way that makes a position of its own
    std::vector<Point> room;    ///< [position][point]
    std::size_t positions = 0;  ///< the last one may be replaced by the next if `open`
    bool open = false;
    Point* at(std::size_t position) { return room.data() + position * points; }
  };
  static bool same_run(const Blade& blade, const Point* a, const Point* b);
  static void add_ways(Blade& blade, std::vector<SweptWay>& out);

  std::vector<Blade> blades_;
  std::vector<Point> now_;  // the present position of one blade
  bool news_ = false;
  double fracture_j_ = 0;
};

}  // namespace tensormass::world
