#pragma once

#include <string>

#include "world/fields.h"
#include "world/world.h"

namespace tensormass::tests {

/// Returns the sum of the forces by which the fixed nodes of the first body hold it [N].
inline Eigen::Vector3d reaction_of(world::World& world) {
  v1::GetFieldsRequest request;
  request.add_fields(v1::FIELD_REACTION_FORCE);
  const auto fields =
      world::measure_fields(world.model(), world.state(), world.simulated_time_s(), world.model().bodies[0], request);
  const std::string& bytes = fields->fields(0).values();
  using Rows = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;
  return Eigen::Map<const Rows>(reinterpret_cast<const double*>(bytes.data()),
                                static_cast<Eigen::Index>(bytes.size() / sizeof(double) / 3), 3)
      .colwise()
      .sum();
}

}  // namespace tensormass::tests
