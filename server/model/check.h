#pragma once

#include "model/model.h"

namespace tensormass::model {

/// Asserts what stages rely on without checking: that vectors have the sizes that Model states, that offsets ascend,
/// and that elements name rows of the layout. compile() calls it once a scene; matrix::check_layout checks the layout.
void check_model(const Model& model);

}  // namespace tensormass::model
