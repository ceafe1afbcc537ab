#pragma once

#include "tensor/view.h"

/// tensor/rows.h on the host, where a test can look at it: one row after the other.
namespace tensormass::tests {

/// All rows of a group. shape, law: indices of physics::Shapes and Laws. capacity: columns that a row has at once;
/// fewer than it needs make it come in turns.
template <class Real>
void assemble_rows(int shape, int law, const tensor::SceneView<Real>& s, const tensor::ElementView<Real>& e,
                   std::uint32_t capacity);

template <class Real>
void finish_rows(bool has_constant, const tensor::SceneView<Real>& s);

}  // namespace tensormass::tests
