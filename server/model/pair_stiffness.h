#pragma once

#include "core/scalar.h"

/// The constant tensors of linear laws.
namespace tensormass::model {

/// Returns what a quadrature point adds to K_kl of an element with a linear law [N/m]. Compilation and edits both call
/// it, and it is never inlined: gcc would fuse other operations in each, and a healed scene would differ from the
/// loaded one in last bits.
///
///   a_k, a_l     shape gradients of the two nodes [1/m]
///   weight       of the point [m³]
///   parameters   those of the law, with the point's moduli weights applied
template <class Law>
[[gnu::noinline]] Mat3<double> pair_stiffness_at_point(const Vec3<double>& a_k, const Vec3<double>& a_l, double weight,
                                                       const double* parameters) {
  const auto point = Law::at(Mat3<double>(Mat3<double>::Identity()), parameters);
  return Law::stiffness(point, Law::at_node(point, a_k), Law::at_node(point, a_l)) * weight;
}

}  // namespace tensormass::model
