#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <optional>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "core/scalar.h"
#include "physics/element/prony.h"

namespace tensormass::v1 {
class Law;
}

/// Reads material laws from untrusted messages.
namespace tensormass::model {

/// A material of the scene, checked.
struct Material {
  int law = 0;                            ///< index into physics::Laws
  std::vector<double> parameters;         ///< in the order in which the law stores them
  std::vector<physics::PronyTerm> prony;  ///< viscoelastic terms; empty: elastic
  double young_modulus_pa = 0;            ///< at zero strain, under a sudden load
  double poisson_ratio = 0;               ///< at zero strain
  bool constant_stiffness = false;        ///< its stiffness does not change with deformation
};

/// Returns E and E / (1 − ν²) of a material, as contact asks for them (view::ContactView::triangle_moduli) [Pa].
std::array<double, 2> contact_moduli(const Material& material);

/// The values of one element that replace constants of its law.
struct ElementValues {
  std::optional<double> young_modulus_pa, poisson_ratio;
  std::optional<Vec3<double>> fibre_direction;
};

/// Makes the material of one element of a law.
///
/// values:  the values that replace constants of the law.
/// returns: the material, or the error that read_law reports.
using ElementLaw = std::function<Result<Material>(const ElementValues& values)>;

/// Reads a law once for all of its elements, because scenes have millions of elements with their own values.
ElementLaw element_law(const v1::Law& law, std::string_view where);

/// Reads the law whose field is set; fields are named as the laws in physics/lists.h. A law that is given by Young's
/// modulus and Poisson's ratio needs no code here.
///
/// Errors: no law, a modulus or ratio outside its range, an element value that the law does not have.
Result<Material> read_law(const v1::Law& law, const ElementValues& values, std::string_view where);

}  // namespace tensormass::model
