#pragma once

#include <concepts>

#include "core/scalar.h"
#include "physics/decomposition.h"
#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"

/// The interface of a law of elasticity.
///
/// A law is a struct of static functions of the deformation gradient F and of its parameters. They are pure. No branch
/// on a value changes a result, because T is a number or a pack of numbers. The element pass (element/element.h) calls
/// them for each quadrature point:
///
///   parameters ─► at(F, p) ─► Point ─┬─► energy, stress, second_piola
///                                    ├─► project_to_psd      (solver only; changes the Point)
///                                    └─► at_node(point, a), at_axis(point, c) ─► Node ─► traction, stiffness
///
/// Symbols and units:
///
///   F         deformation gradient; J = det F                                     no unit
///   W         energy density                                                      J for each m³ at rest
///   P         first Piola-Kirchhoff stress, ∂W/∂F                                 Pa
///   S         second Piola-Kirchhoff stress, F⁻¹ P                                Pa
///   a, b      shape gradients of two nodes, often times the weight                1/m, or m²
///   K         stiffness between two nodes                                         Pa times the units of a and b
///
/// Constants of a law:
///
///   kName                the protocol's name for it
///   kConstantStiffness   true if the stiffness does not depend on F: its tensors are assembled once
///   kInversion           what it promises where det F ≤ 0
///   kMaxStrain, kMaxRotation   only for Inversion::kOutOfRange: largest strain and rotation [rad] of its range
///   kLeastStretch        optional: the principal stretch below which the law is not valid
///   kParameterCount      number of parameters stored for each element
///
/// Functions of a law:
///
///   parameters(...)        makes the parameters on the host from the protocol's numbers, as many as it has. The caller
///                          checks their ranges (model/material_input.cpp)
///   moduli_at_rest(p)      returns bulk and shear modulus of the small-strain limit, without fibres
///   scale_moduli(p, d, v)  multiplies the deviatoric part of the energy by d and the volumetric part by v. Selective
///                          reduced integration evaluates the two at different points. Energy is linear in the moduli,
///                          so the parts add up to the whole
///   at(F, p)               returns the Point: what the functions below share at a quadrature point
///   energy(point)          returns W, which is zero at rest
///   stress(point)          returns P
///   second_piola(point)    returns S; finite also where F is singular
///   at_node(point, a)      returns the Node: what `stiffness` and `traction` need of one gradient
///   at_axis(point, c)      returns at_node of the unit vector along axis c, with little or no arithmetic. Stiffness is
///                          linear in each gradient, so its values at the axes give those of any number of nodes
///   stiffness(point, na, nb)  returns K_ij = Σ_KL ∂²W / ∂F_iK ∂F_jL a_K b_L; na and nb are the Nodes of a and b
///   traction(point, na)    returns P a; cheaper than the stress if only one node is needed. Valid before and after
///                          project_to_psd
///   project_to_psd(point)  makes the stiffness positive semi-definite for the solver. Laws in principal stretches take
///                          the absolute values of its eigenvalues (Chen et al. 2024): with zeros instead, only
///                          inertia would hold a collapsed element, and a step could throw its nodes far. Energy,
///                          stress and the other parts are unchanged. Forces stay exact, so only the path to the
///                          equilibrium changes, not the equilibrium
///
/// A law that is undefined for some F (a logarithm of J ≤ 0) returns NaN there. The step's guard then reports it.
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

/// True if a law's at() decomposes F and also accepts a ready decomposition. The decomposition costs more than the rest
/// of the law, so threads that share an element compute it once.
template <class L>
inline constexpr bool kDecomposes = requires(const SignedSingularValues<double>& f, const double* p) {
  L::template at<double>(f, p);
};

}  // namespace tensormass::physics
