#pragma once

#include "tensor/view.h"

/// Runs tensor/rows.h on the host, one row after the other, so that tests can inspect the result.
namespace tensormass::tests {

/// Assembles all rows of an element group.
///
///   shape, law   indices in physics::Shapes and physics::Laws
///   capacity     number of columns that a row's block buffer holds; a row with more columns needs several passes
template <class Real>
void assemble_rows(int shape, int law, const tensor::SceneView<Real>& s, const tensor::ElementView<Real>& e,
                   std::uint32_t capacity);

template <class Real>
void finish_rows(bool has_constant, const tensor::SceneView<Real>& s);

}  // namespace tensormass::tests
