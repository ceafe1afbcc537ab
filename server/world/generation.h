#pragma once

#include <cstdint>
#include <memory>

#include "model/compile.h"
#include "model/model.h"
#include "tensormass/v1/adjustment.pb.h"

namespace tensormass::world {

/// A scene between two adjustments, or cuts. Constant: a thread that has it knows the values of a state.
struct Generation {
  std::uint64_t number = 0;  ///< counts the adjustments and cuts
  std::shared_ptr<const model::Model> model;
  std::uint64_t scene_hash = 0;
  v1::SceneAdjustments adjustments;
  bool is_adjusted = false;  ///< its values are not those of the load
  model::SceneCuts cuts;     ///< what its bodies have; also in `adjustments`
};
using GenerationPointer = std::shared_ptr<const Generation>;

}  // namespace tensormass::world
