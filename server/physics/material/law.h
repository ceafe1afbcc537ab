#pragma once

#include <concepts>

#include "core/scalar.h"
#include "physics/decomposition.h"
#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"

/// What a law of elasticity is to the rest of the engine.
///
/// A law is a struct of pure functions of the deformation gradient F and of its parameters: no state, no branch on
/// values. T is a number or a pack of numbers. Moduli are in Pa, energies in J for each m³ at rest; F has no unit.
///
///   kName                the protocol's name for it
///   kConstantStiffness   the stiffness does not depend on F: its tensors are assembled once
///   kInversion           what it promises where det F ≤ 0
///   kMaxStrain, kMaxRotation  only of Inversion::kOutOfRange: where its range ends, the rotation in radians
///   kLeastStretch        optional: the principal stretch below which the law is no good any more
///   kParameterCount      what it stores for an element. parameters(...) makes them on the host from the protocol's
///                        numbers, as many as it has; their range is the caller's to check (model/material_input.cpp)
///   moduli_at_rest(p)    bulk and shear modulus of the small strain limit, fibres left out
///   scale_moduli(p, d, v) scales the part of the energy that resists change of shape by d and the part that resists
///                        change of volume by v: selective integration evaluates them at different points. Energies are
///                        linear in the moduli, so the parts add up to the whole
///   Point, at(F, p)      what the following share at a quadrature point
///   energy(point)        W, zero at rest
///   stress(point)        first Piola-Kirchhoff stress P = ∂W/∂F
///   second_piola(point)  S = F⁻¹ P, finite also where F is singular
///   Node, at_node(point, a), stiffness(point, a, b)
///                        K_ij = ∂²W / ∂F_iK ∂F_jL a_K b_L for the shape gradients a, b of two nodes, in Pa times the
///                        gradients' unit squared; what needs one gradient only is done once for each node
///   at_axis(point, c)    at_node of the unit vector along c, for little or no arithmetic. The stiffness is linear in
///                        each gradient: from its values at the axes those of many nodes are made
///   traction(point, node)  P a for the gradient of a node: cheaper than the stress where one node is asked for. Of a
///                        point as at() made it or after project_to_psd
///   project_to_psd(point) makes the stiffness positive semi-definite for the solver: parts of it that are not are
///                        clamped, all others, energy and stress stay as they are. Forces stay exact, so that only the
///                        way to the equilibrium changes, not the equilibrium
///
/// A law that has no meaning for some F (J ≤ 0 in a logarithm) gives NaN there, which the step's guard reports.
namespace tensormass::physics {

template <class L>
concept Law = requires(const Mat3<double>& f, const Vec3<double>& a, double* p,
                       typename L::template Point<double> point, typename L::template Node<double> node) {
  { L::kName } -> std::convertible_to<const char*>;
  { L::kConstantStiffness } -> std::convertible_to<bool>;
  { L::kInversion } -> std::convertible_to<Inversion>;
  { L::kParameterCount } -> std::convertible_to<int>;
  { L::moduli_at_rest(p) } -> std::same_as<Moduli>;
  L::scale_moduli(p, 1.0, 1.0);
  { L::at(f, p) } -> std::same_as<decltype(point)>;
  { L::energy(point) } -> std::same_as<double>;
  { L::stress(point) } -> std::convertible_to<Mat3<double>>;
  { L::second_piola(point) } -> std::convertible_to<Mat3<double>>;
  { L::at_node(point, a) } -> std::same_as<decltype(node)>;
  { L::at_axis(point, 0) } -> std::same_as<decltype(node)>;
  { L::stiffness(point, node, node) } -> std::convertible_to<Mat3<double>>;
  { L::traction(point, node) } -> std::convertible_to<Vec3<double>>;
  L::project_to_psd(point);
};

/// A law whose at() decomposes F, which costs more than all the rest, and takes a decomposition as well: where several
/// threads evaluate an element it is made once.
template <class L>
inline constexpr bool kDecomposes = requires(const SignedSingularValues<double>& f, const double* p) {
  L::template at<double>(f, p);
};

}  // namespace tensormass::physics
