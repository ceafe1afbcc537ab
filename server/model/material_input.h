#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "core/scalar.h"
#include "physics/element/prony.h"
#include "tensormass/v1/scene.pb.h"

/// Laws from untrusted messages.
namespace tensormass::model {

/// What the scene says of a material, checked.
struct Material {
  int law = 0;                            ///< index into physics::Laws
  std::vector<double> parameters;         ///< as the law stores them
  std::vector<physics::PronyTerm> prony;  ///< empty: no memory
  double young_modulus_pa = 0;            ///< at rest, under a sudden load
  double poisson_ratio = 0;               ///< at rest
  bool constant_stiffness = false;        ///< its tensors do not change while it deforms
};

/// In place of what a law says, for one element.
struct ElementValues {
  std::optional<double> young_modulus_pa, poisson_ratio;
  std::optional<Vec3<double>> fibre_direction;
};

/// Makes the material of one element of a law.
///
/// values:  the element's own, over the law's constants.
/// returns: its material, or the error that read_law reports.
using ElementLaw = std::function<Result<Material>(const ElementValues& values)>;

/// Reads what all elements of a law share once, because scenes have millions of elements with their own values.
ElementLaw element_law(const v1::Law& law, std::string_view where);

/// The law whose field is set, by its name in physics/lists.h. A law that is given by Young's modulus and Poisson's
/// ratio needs no code here. Errors: no law, a modulus or ratio outside its range, a value that the law does not have.
Result<Material> read_law(const v1::Law& law, const ElementValues& values, std::string_view where);

}  // namespace tensormass::model
