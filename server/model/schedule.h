#pragma once

#include <compare>
#include <vector>

namespace tensormass::model {

/// A factor over simulated time, in points of a curve.
struct Schedule {
  std::vector<double> time_s, factor;  ///< [point]; empty: the factor is 1
  bool empty() const { return time_s.empty(); }
  /// Returns the factor, which is linear between points and constant before and after them.
  double at(double time_s) const;
  auto operator<=>(const Schedule&) const = default;
};

}  // namespace tensormass::model
