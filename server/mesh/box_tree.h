#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include <Eigen/Geometry>

#include "mesh/partition.h"

namespace tensormass::mesh {

/// Returns the point of triangle abc nearest to p. It tells by the signs of six products to which vertex, edge or
/// interior region p projects (Ericson, Real-Time Collision Detection, 5.1.5).
inline Eigen::Vector3d nearest_on_triangle(const Eigen::Vector3d& p, const Eigen::Vector3d& a, const Eigen::Vector3d& b,
                                           const Eigen::Vector3d& c) {
  const Eigen::Vector3d ab = b - a, ac = c - a, ap = p - a;
  const double d1 = ab.dot(ap), d2 = ac.dot(ap);
  if (d1 <= 0.0 && d2 <= 0.0) return a;
  const Eigen::Vector3d bp = p - b;
  const double d3 = ab.dot(bp), d4 = ac.dot(bp);
  if (d3 >= 0.0 && d4 <= d3) return b;
  const double vc = d1 * d4 - d3 * d2;
  if (vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0) return a + d1 / (d1 - d3) * ab;
  const Eigen::Vector3d cp = p - c;
  const double d5 = ab.dot(cp), d6 = ac.dot(cp);
  if (d6 >= 0.0 && d5 <= d6) return c;
  const double vb = d5 * d2 - d1 * d6;
  if (vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0) return a + d2 / (d2 - d6) * ac;
  const double va = d3 * d6 - d5 * d4;
  if (va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0) return b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b);
  return a + (vb * ab + vc * ac) / (va + vb + vc);
}

/// A bounding box tree over items, for the item nearest to a point.
///
/// Items are sorted in bisection order (partition.h), and each box is cut where bisection_cut cut the order. A box
/// therefore covers a contiguous range of items, and boxes are stored in depth-first order:
///
///   parts_:  [ root | left subtree ... | right subtree ... ]
///                     ^ root + 1         ^ root.right
///
///   Item::corners   an array of points; the item lies in the box around them
template <class Item>
class BoxTree {
 public:
  /// Needs at least one item.
  explicit BoxTree(std::vector<Item> items) {
    std::vector<Eigen::Vector3d> centers(items.size());
    std::transform(items.begin(), items.end(), centers.begin(), [](const Item& item) {
      Eigen::Vector3d sum = Eigen::Vector3d::Zero();
      for (const Eigen::Vector3d& corner : item.corners) sum += corner;
      return Eigen::Vector3d(sum / static_cast<double>(item.corners.size()));
    });
    items_.reserve(items.size());
    for (const std::uint32_t i : bisection_order(centers, kLeafSize)) items_.push_back(items[i]);
    build(0, static_cast<std::uint32_t>(items_.size()));
  }

  /// Returns the best of the items near a point.
  ///
  ///   Best::offer(item, point)     is called with each item that may be the nearest; keeps the better one
  ///   Best::squared_distance       of the item kept; infinite at first. At 0 the search ends
  template <class Best>
  Best nearest(const Eigen::Vector3d& point) const {
    Best best;
    visit(0, point, best);
    return best;
  }

 private:
  static constexpr std::uint32_t kLeafSize = 4;

  struct Part {
    Eigen::AlignedBox3d box;
    std::uint32_t first = 0;
    std::uint32_t count = 0;  // number of items in a leaf; 0 for an inner box
    std::uint32_t right = 0;  // index of the right child; the left child follows its parent
  };

  /// Appends the box over items [first, first + count) and those below it; returns its index.
  std::uint32_t build(std::uint32_t first, std::uint32_t count) {
    const auto index = static_cast<std::uint32_t>(parts_.size());
    parts_.emplace_back();
    const std::uint32_t cut = bisection_cut(count, kLeafSize);
    if (cut == count) {
      Part& leaf = parts_[index];
      leaf.first = first;
      leaf.count = count;
      for (std::uint32_t i = first; i < first + count; ++i) {
        for (const Eigen::Vector3d& corner : items_[i].corners) leaf.box.extend(corner);
      }
      return index;
    }
    const std::uint32_t left = build(first, cut);
    const std::uint32_t right = build(first + cut, count - cut);
    parts_[index].right = right;
    parts_[index].box = parts_[left].box.merged(parts_[right].box);
    return index;
  }

  /// Offers all items below a box that could be better than `best`; visits the nearer child first.
  template <class Best>
  void visit(std::uint32_t index, const Eigen::Vector3d& point, Best& best) const {
    const Part& part = parts_[index];
    if (part.count > 0) {
      for (std::uint32_t i = part.first; i < part.first + part.count; ++i) best.offer(items_[i], point);
      return;
    }
    std::uint32_t near = index + 1, far = part.right;
    double near_distance = parts_[near].box.squaredExteriorDistance(point);
    double far_distance = parts_[far].box.squaredExteriorDistance(point);
    if (far_distance < near_distance) {
      std::swap(near, far);
      std::swap(near_distance, far_distance);
    }
    if (worth(near_distance, best)) visit(near, point, best);
    if (worth(far_distance, best)) visit(far, point, best);
  }

  /// Returns whether a box at this distance may hold a better item. The slack lets Best choose among items that are
  /// equally near within rounding.
  template <class Best>
  static bool worth(double squared_distance, const Best& best) {
    return best.squared_distance > 0.0 && squared_distance <= best.squared_distance * (1.0 + 1e-12);
  }

  std::vector<Item> items_;
  std::vector<Part> parts_;
};

}  // namespace tensormass::mesh
