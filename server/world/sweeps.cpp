#include "world/sweeps.h"

#include <algorithm>

#include "core/assert.h"
#include "core/cut_limits.h"

namespace tensormass::world {

namespace {
/// Ways of a front that are shorter than this share of the distance between blade points make no position of their own.
constexpr double kShortWay = 0.25;
/// A tool cuts in a step if the area is more than this share of the square of that distance. Less is creep.
constexpr double kLeastCut = 1e-6;
}  // namespace

BladeSweeps::BladeSweeps(const model::Model& model) {
  const model::Blades& blades = model.links.blades;
  for (std::size_t b = 0; b < blades.count(); ++b) {
    Blade& blade = blades_.emplace_back();
    blade.points = blades.first_points[b + 1] - blades.first_points[b];
    blade.step_m = kShortWay * model.tools[blades.tools[b]].parameters[2];
    blade.room.resize(limits::kMaxBladePositions * blade.points);
    now_.resize(std::max(now_.size(), blade.points));
    if (courses_.empty() || courses_.back().tool != blades.tools[b]) {
      const double spacing_m = model.tools[blades.tools[b]].parameters[2];
      courses_.push_back({.tool = blades.tools[b], .least_m2 = kLeastCut * spacing_m * spacing_m});
    }
    blade.course = courses_.size() - 1;
  }
  news_of_courses_.resize(courses_.size());
}

void BladeSweeps::clear() {
  for (Blade& blade : blades_) {
    blade.positions = 0;
    blade.open = false;
  }
  for (Course& course : courses_) course = {.tool = course.tool, .least_m2 = course.least_m2};
  course_count_ = 0;
  news_ = false;
  fracture_j_ = 0;
}

void BladeSweeps::go_on_with(const BladeSweeps& before, std::span<const std::size_t> places) {
  for (std::size_t c = 0, first = 0; c < courses_.size(); ++c) {
    const std::uint32_t tool = courses_[c].tool;
    const auto course = std::find_if(before.courses_.begin(), before.courses_.end(),
                                     [&](const Course& one) { return one.tool == places[tool]; });
    while (blades_[first].course != c) ++first;
    if (course == before.courses_.end()) continue;  // a new tool
    courses_[c] = *course;
    courses_[c].tool = tool;
    const auto place = static_cast<std::size_t>(course - before.courses_.begin());
    std::size_t b = first;  // blades of a tool follow each other
    for (const Blade& blade : before.blades_) {
      if (blade.course != place) continue;
      TM_ASSERT(b < blades_.size() && blades_[b].course == c, "a tool keeps its blades");
      blades_[b].positions = blade.positions;
      blades_[b].open = blade.open;
      std::copy(blade.room.begin(), blade.room.end(), blades_[b].room.begin());
      ++b;
    }
  }
  news_ = before.news_ && !blades_.empty();
  fracture_j_ = before.fracture_j_;
}

bool BladeSweeps::same_run(const Blade& blade, const Point* a, const Point* b) {
  return std::equal(a, a + blade.points, b, [](const Point& x, const Point& y) { return x.body == y.body; });
}

/// Takes what tools have cut in this step into their courses.
void BladeSweeps::end_step(double dt_s) {
  course_count_ = 0;
  for (Course& course : courses_) {
    const bool cuts = course.step_m2 > course.least_m2 && course.step_body != kNoBody;
    if (cuts && !course.cuts) {
      course.cuts = true;
      course.area_m2 = course.work_j = 0;
      course.body = course.step_body;
      news_of_courses_[course_count_++] = {.tool = course.tool, .body = course.body};
    }
    if (course.cuts) {
      course.area_m2 += course.step_m2;
      course.work_j += course.step_j;
      course.idle_s = cuts ? 0 : course.idle_s + dt_s;
    }
    if (course.cuts && course.idle_s >= kApartS) {
      course.cuts = false;
      news_of_courses_[course_count_++] = {course.tool, course.body, true, course.area_m2, course.work_j};
    }
    course.step_m2 = course.step_j = 0;
    course.step_body = kNoBody;
  }
}

void BladeSweeps::take(const model::Model& model, std::span<const backend::BladeFront> fronts) {
  for (Blade& blade : blades_) {
    bool any = false;
    for (std::size_t i = 0; i < blade.points; ++i) {
      const backend::BladeFront& front = fronts[i];
      now_[i] = {front.rest_m, kNoBody};
      fracture_j_ += front.dissipated_j;
      Course& course = courses_[blade.course];
      course.step_m2 += front.cut_m2;
      course.step_j += front.dissipated_j;
      if (front.element == view::kNoTetrahedron) continue;
      now_[i].body = static_cast<std::uint32_t>(model.body_of_element(front.element));
      if (front.cut_m2 > 0) course.step_body = now_[i].body;
      any = true;
    }
    fronts = fronts.subspan(blade.points);
    if (blade.positions == 0) {
      if (!any) continue;
      std::copy_n(now_.data(), blade.points, blade.at(blade.positions++));
      blade.open = false;
      continue;
    }
    const Point* last = blade.at(blade.positions - 1);
    if (same_run(blade, last, now_.data())) {
      if (!any) continue;
      // The position before an open one is that from which the way counts.
      const Point* from = blade.open ? blade.at(blade.positions - 2) : last;
      bool moved = false, far = !same_run(blade, from, now_.data());
      for (std::size_t i = 0; i < blade.points; ++i) {
        if (now_[i].body == kNoBody) continue;
        moved = moved || now_[i].rest_m != last[i].rest_m;
        far = far || (now_[i].rest_m - from[i].rest_m).squaredNorm() > blade.step_m * blade.step_m;
      }
      if (!moved) continue;
      news_ = true;
      if (!blade.open && blade.positions < limits::kMaxBladePositions) ++blade.positions;
      std::copy_n(now_.data(), blade.points, blade.at(blade.positions - 1));
      blade.open = !far || blade.positions == limits::kMaxBladePositions;
      continue;
    }
    news_ = true;
    if (blade.positions < limits::kMaxBladePositions) ++blade.positions;
    std::copy_n(now_.data(), blade.points, blade.at(blade.positions - 1));
    blade.open = false;
  }
  end_step(model.dt_s);
}

/// Appends the ways of one blade: for each run of points that cut the same body in two positions, as long as it stays.
void BladeSweeps::add_ways(Blade& blade, std::vector<SweptWay>& out) {
  struct Run {
    std::size_t begin, end;
    std::uint32_t body;
    bool operator==(const Run&) const = default;
  };
  std::vector<Run> open;  // those of `ways`, which end at the position before
  std::vector<std::size_t> ways;
  for (std::size_t position = 1; position < blade.positions; ++position) {
    const Point *a = blade.at(position - 1), *b = blade.at(position);
    std::vector<Run> runs;
    for (std::size_t i = 0; i < blade.points; ++i) {
      if (a[i].body == kNoBody || a[i].body != b[i].body) continue;
      if (!runs.empty() && runs.back().end == i && runs.back().body == a[i].body) {
        ++runs.back().end;
      } else {
        runs.push_back({i, i + 1, a[i].body});
      }
    }
    std::erase_if(runs, [](const Run& run) { return run.end - run.begin < 2; });
    std::vector<std::size_t> of_runs;
    for (const Run& run : runs) {
      const auto same = std::find(open.begin(), open.end(), run);
      const auto points = [&](const Point* at) {
        std::vector<Vec3<double>> line;
        for (std::size_t i = run.begin; i < run.end; ++i) line.push_back(at[i].rest_m);
        return line;
      };
      if (same == open.end()) {
        of_runs.push_back(out.size());
        out.push_back({run.body, {points(a), points(b)}});
      } else {
        of_runs.push_back(ways[static_cast<std::size_t>(same - open.begin())]);
        out[of_runs.back()].positions_m.push_back(points(b));
      }
    }
    open = std::move(runs);
    ways = std::move(of_runs);
  }
}

std::vector<SweptWay> BladeSweeps::take_ways() {
  std::vector<SweptWay> out;
  for (Blade& blade : blades_) {
    add_ways(blade, out);
    if (blade.positions > 1) std::copy_n(blade.at(blade.positions - 1), blade.points, blade.at(0));
    blade.positions = std::min<std::size_t>(blade.positions, 1);
    blade.open = false;
    const bool ends = blade.positions == 1 && std::all_of(blade.at(0), blade.at(0) + blade.points,
                                                          [](const Point& point) { return point.body == kNoBody; });
    if (ends) blade.positions = 0;
  }
  news_ = false;
  return out;
}

}  // namespace tensormass::world
