#include "model/model.h"

#include <algorithm>

namespace tensormass::model {

namespace {

/// Returns the place of the last body that begins at an item or before it. begin: where each body's items begin.
std::size_t body_of(const std::vector<BodyModel>& bodies, std::uint32_t BodyModel::*begin, std::uint32_t item) {
  const auto after = std::upper_bound(bodies.begin(), bodies.end(), item,
                                      [&](std::uint32_t i, const BodyModel& body) { return i < body.*begin; });
  return static_cast<std::size_t>(after - bodies.begin()) - 1;
}

}  // namespace

double Schedule::at(double time) const {
  if (empty()) return 1;
  const auto after = std::upper_bound(time_s.begin(), time_s.end(), time);
  if (after == time_s.begin()) return factor.front();
  if (after == time_s.end()) return factor.back();
  const std::size_t i = static_cast<std::size_t>(after - time_s.begin());
  const double share = (time - time_s[i - 1]) / (time_s[i] - time_s[i - 1]);
  return factor[i - 1] + share * (factor[i] - factor[i - 1]);
}

std::size_t Model::body_of_node(std::uint32_t node) const { return body_of(bodies, &BodyModel::node_begin, node); }

std::size_t Model::body_of_element(std::uint32_t element) const {
  return body_of(bodies, &BodyModel::element_begin, element);
}

}  // namespace tensormass::model
