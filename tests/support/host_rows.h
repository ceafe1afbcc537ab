#pragma once

#include "view/scene.h"

/// matrix/rows.h on the host, where a test can check it: one row after the other.
namespace tensormass::tests {

/// Assembles all rows of a group. shape, law: indices of physics::Shapes and Laws. capacity: columns that a row holds
/// at once; a wider row comes in turns.
template <class Real>
void assemble_rows(int shape, int law, const view::SceneView<Real>& s, const view::ElementView<Real>& e,
                   std::uint32_t capacity);

}  // namespace tensormass::tests
