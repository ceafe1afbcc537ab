#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "contact/blades.h"
#include "support/scissors.h"

/// Scissors in tissue that cannot move: what is left is the geometry of their edges, and the springs of their points.
namespace tensormass::contact {
namespace {

using tests::kBladeLengthM;
using tests::ScissorsScene;

/// A team of one thread, which is all of the one patch.
struct OneThread {
  static std::uint32_t patch() { return 0; }
  static bool leads_patch() { return true; }
  static void sync() {}
  template <class Visit>
  static void for_each(std::uint32_t begin, std::uint32_t end, const Visit& visit) {
    for (std::uint32_t i = begin; i < end; ++i) visit(i);
  }
  template <class Sums>
  static void patch_sum(Sums&) {}
  template <class Most, class Sums>
  static void patch_reduce(Most&, Sums&) {}
};

/// The sheet of support/scissors.h, of six tetrahedra a cell, and the scissors in their place.
class RigidSheet {
 public:
  explicit RigidSheet(const ScissorsScene& of) : scene_(of) {
    mesh_sheet();
    control_.scheme = {.step_s = of.dt_s, .reach = 1, .displacement_weights = {}, .velocity_weights = {}};
    state_.control = &control_;
    state_.rest = rest_.data();
    state_.displacement = state_.velocity = zeros_.data();
    tool_.kind = static_cast<std::uint32_t>(physics::index_of<physics::Scissors>(physics::Tools{}));
    const double parameters[] = {kBladeLengthM, tests::kScissorsThicknessM, kBladeLengthM / (tests::kPointsOfEdge - 1),
                                 tests::kEdgeOffsetM};
    std::copy_n(parameters, 4, tool_.parameters);
    tool_.presence = 1;
    const double rotation[] = {0, 0, -1, 0, 1, 0, 1, 0, 0};  // its z axis is −x of the scene, its x axis the z axis
    std::copy_n(rotation, 9, tool_.rotation);
    tool_.position_m[0] = kBladeLengthM - of.before_m;
    tool_.position_m[1] = of.width_m / 2 + 0.3e-3;
    tool_.position_m[2] = of.thickness_m / 2;
    tool_.joint_values[0] = of.opening_rad;
    contact_.tools = &tool_;
    contact_.tool_count = 1;
    contact_.tool_loads = &load_;
    view::BladesView<double>& blades = links_.blades;
    blades.blade_count = 2;
    blades.point_count = kPoints;
    blades.patch_count = 1;
    blades.tools = tools_.data();
    blades.first_points = first_points_.data();
    blades.rows = rows_.data();
    blades.neighbours = neighbours_.data();
    blades.toughness = toughness_.data();
    blades.patch_tetrahedra = patch_tetrahedra_.data();
    blades.tetrahedra = tetrahedra_.data();
    blades.memory = memory_.data();
    blades.checkpoint_memory = checkpoint_.data();
    blades.reports = reports_.data();
    links_.links = list_.data();
  }

  /// Turns the blades by an angle and makes a step.
  void turn(double by_rad) {
    tool_.joints_moved[0] = by_rad;
    tool_.joint_values[0] += by_rad;
    for (std::uint32_t p = 0; p < kPoints; ++p) {
      const PinLinks<double> pin = links_of_pin(state_, contact_, links_.blades, p);
      list_[view::kPinLinks * p] = pin.cuts;
      list_[view::kPinLinks * p + 1] = pin.sideways;
    }
    load_ = {};
    OneThread team;
    measure_blades(team, state_, contact_, links_);
    for (const view::BladeReport<double>& report : reports_) {
      fracture_j += report.dissipated_j;
      cut_m2 += report.cut_m2;
    }
  }
  double opening_rad() const { return tool_.joint_values[0]; }
  double torque_n_m() const { return load_.joints[0]; }
  Vec3<double> force_n() const { return {load_.force_n[0], load_.force_n[1], load_.force_n[2]}; }
  const std::vector<view::BladeReport<double>>& reports() const { return reports_; }

  static constexpr std::uint32_t kPoints = 2 * tests::kPointsOfEdge;
  double fracture_j = 0, cut_m2 = 0;

 private:
  void mesh_sheet() {
    constexpr std::array<int, 3> kCells{12, 4, 2};
    const auto node = [&](const std::array<int, 3>& i) {
      return static_cast<std::uint32_t>((i[0] * (kCells[1] + 1) + i[1]) * (kCells[2] + 1) + i[2]);
    };
    for (int x = 0; x <= kCells[0]; ++x) {
      for (int y = 0; y <= kCells[1]; ++y) {
        for (int z = 0; z <= kCells[2]; ++z) {
          rest_.insert(rest_.end(), {scene_.length_m * x / kCells[0], scene_.width_m * y / kCells[1],
                                     scene_.thickness_m * z / kCells[2], 7});
        }
      }
    }
    zeros_.assign(rest_.size(), 0);
    std::map<std::array<std::uint32_t, 3>, std::vector<std::size_t>> sides;  // places in neighbours_ by nodes of a face
    for (int cell = 0; cell < kCells[0] * kCells[1] * kCells[2]; ++cell) {
      std::array<std::size_t, 3> axes{0, 1, 2};
      do {  // along the edges of the cell from its lowest corner to its highest
        std::array<int, 3> at{cell / (kCells[1] * kCells[2]), cell / kCells[2] % kCells[1], cell % kCells[2]};
        std::array<std::uint32_t, 4> nodes{node(at)};
        for (std::size_t k = 0; k < 3; ++k) {
          ++at[axes[k]];
          nodes[k + 1] = node(at);
        }
        for (std::size_t corner = 0; corner < 4; ++corner) {
          std::array<std::uint32_t, 3> face{};
          for (std::size_t k = 0, i = 0; k < 4; ++k) {
            if (k != corner) face[i++] = nodes[k];
          }
          std::sort(face.begin(), face.end());
          sides[face].push_back(rows_.size() + corner);
        }
        rows_.insert(rows_.end(), nodes.begin(), nodes.end());
      } while (std::next_permutation(axes.begin(), axes.end()));
    }
    neighbours_.assign(rows_.size(), view::kNoTetrahedron);
    for (const auto& [face, places] : sides) {
      if (places.size() < 2) continue;
      neighbours_[places[0]] = static_cast<std::uint32_t>(places[1] / 4);
      neighbours_[places[1]] = static_cast<std::uint32_t>(places[0] / 4);
    }
    const auto count = static_cast<std::uint32_t>(rows_.size() / 4);
    for (std::uint32_t e = 0; e < count; ++e) tetrahedra_.push_back(e);
    toughness_.assign(count, scene_.toughness_j_per_m2);
    patch_tetrahedra_ = {0, count};
  }

  const ScissorsScene scene_;
  std::vector<double> rest_, zeros_, toughness_;
  std::vector<std::uint32_t> rows_, neighbours_, tetrahedra_, patch_tetrahedra_;
  const std::vector<std::uint32_t> tools_{0, 0}, first_points_{0, tests::kPointsOfEdge, kPoints};
  std::vector<double> memory_ = std::vector<double>(std::size_t{kPoints} * (view::kBladeMemory + 1));
  std::vector<double> checkpoint_ = memory_;
  std::vector<view::BladeReport<double>> reports_{kPoints};
  std::vector<view::Link<double>> list_{view::kPinLinks * kPoints};
  view::StepControl<double> control_{};
  view::StateView<double> state_{};
  view::ContactView<double> contact_{};
  view::LinksView<double> links_{};
  view::ToolLoad<double> load_{};
  physics::PlacedTool<double> tool_{};
};

/// torque = Gc · dA/dθ, and all work is that of fracture, however far the blades turn in a step.
TEST(ScissorsInRigidTissue, NeedTheTorqueOfTheAreaThatTheySweep) {
  const ScissorsScene of;
  for (const double turn_rad : {3e-4, 0.01}) {
    SCOPED_TRACE(turn_rad);
    RigidSheet sheet(of);
    while (sheet.opening_rad() > 0.31) sheet.turn(-turn_rad);
    const double from_rad = sheet.opening_rad(), cut_m2 = sheet.cut_m2, fracture_j = sheet.fracture_j;
    double work_j = 0;
    while (sheet.opening_rad() > 0.19) {
      sheet.turn(-turn_rad);
      work_j += turn_rad * sheet.torque_n_m();
      EXPECT_LT(std::abs(sheet.force_n()[1]), 1e-9) << "across the blades";
      EXPECT_LT(std::abs(sheet.force_n()[2]), 1e-9) << "both edges push as much";
    }
    const double swept_m2 = tests::swept_m2(of, sheet.opening_rad()) - tests::swept_m2(of, from_rad);
    const double expected_j = of.toughness_j_per_m2 * swept_m2;
    EXPECT_NEAR(work_j, expected_j, (turn_rad < 1e-3 ? 0.01 : 0.06) * expected_j);
    EXPECT_NEAR(sheet.cut_m2 - cut_m2, swept_m2, (turn_rad < 1e-3 ? 0.01 : 0.06) * swept_m2);
    EXPECT_NEAR(sheet.fracture_j - fracture_j, expected_j, (turn_rad < 1e-3 ? 0.01 : 0.06) * expected_j);
  }
}

/// The quads between two positions of the edges' fronts cover what is between the edges, and nothing beside it.
TEST(ScissorsInRigidTissue, SweepAllThatIsBetweenTheirEdges) {
  const ScissorsScene of{.opening_rad = 0.9};
  constexpr double kCellM = 0.1e-3, kEndRad = 0.11;
  const auto cells_x = static_cast<int>(of.length_m / kCellM), cells_z = static_cast<int>(of.thickness_m / kCellM);
  for (const double turn_rad : {1e-3, 0.01, 0.03}) {
    SCOPED_TRACE(turn_rad);
    RigidSheet sheet(of);
    std::vector<char> swept(static_cast<std::size_t>(cells_x * cells_z), 0);
    const auto mark = [&](const std::array<Eigen::Vector2d, 3>& corners) {
      Eigen::AlignedBox2d box;
      for (const auto& corner : corners) box.extend(corner);
      const auto side = [](const Eigen::Vector2d& a, const Eigen::Vector2d& b, const Eigen::Vector2d& p) {
        return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
      };
      const auto first = [&](int axis) { return std::max(static_cast<int>(box.min()[axis] / kCellM) - 1, 0); };
      const auto last = [&](int axis, int cells) {
        return std::min(static_cast<int>(box.max()[axis] / kCellM) + 1, cells - 1);
      };
      for (int x = first(0); x <= last(0, cells_x); ++x) {
        for (int z = first(1); z <= last(1, cells_z); ++z) {
          const Eigen::Vector2d p((x + 0.5) * kCellM, (z + 0.5) * kCellM);
          const double s[] = {side(corners[0], corners[1], p), side(corners[1], corners[2], p),
                              side(corners[2], corners[0], p)};
          const bool inside = std::all_of(s, s + 3, [](double one) { return one >= 0; }) ||
                              std::all_of(s, s + 3, [](double one) { return one <= 0; });
          if (inside) swept[static_cast<std::size_t>(x * cells_z + z)] = 1;
        }
      }
    };
    std::vector<view::BladeReport<double>> before(RigidSheet::kPoints);
    for (auto& report : before) report.tetrahedron = view::kNoTetrahedron;
    while (sheet.opening_rad() > kEndRad) {
      sheet.turn(-turn_rad);
      const auto& now = sheet.reports();
      const auto cuts = [&](std::size_t i) {
        return before[i].tetrahedron != view::kNoTetrahedron && now[i].tetrahedron != view::kNoTetrahedron;
      };
      const auto at = [](const view::BladeReport<double>& r) { return Eigen::Vector2d(r.rest_m[0], r.rest_m[2]); };
      for (std::size_t i = 0; i + 1 < now.size(); ++i) {
        if (i + 1 == tests::kPointsOfEdge || !cuts(i) || !cuts(i + 1)) continue;
        mark({at(before[i]), at(before[i + 1]), at(now[i])});
        mark({at(before[i + 1]), at(now[i]), at(now[i + 1])});
      }
      before = now;
    }
    const double half = sheet.opening_rad() / 2;
    int between = 0, covered = 0, beside = 0;
    for (int x = 0; x < cells_x; ++x) {
      for (int z = 0; z < cells_z; ++z) {
        const double forwards = of.before_m + (x + 0.5) * kCellM;
        const double aside = std::abs((z + 0.5) * kCellM - of.thickness_m / 2);
        const bool was_between = tests::kEdgeOffsetM + aside * std::cos(half) > forwards * std::sin(half) &&
                                 forwards < kBladeLengthM * std::cos(half);
        const bool is_swept = swept[static_cast<std::size_t>(x * cells_z + z)] != 0;
        between += was_between;
        covered += was_between && is_swept;
        beside += !was_between && is_swept;
      }
    }
    EXPECT_GT(covered, 0.995 * between);
    EXPECT_LT(beside, 0.02 * between);
  }
}

}  // namespace
}  // namespace tensormass::contact
