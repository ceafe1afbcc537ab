#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "physics/lists.h"
#include "tensormass/v1/scene.pb.h"

/// Laws by name and all shapes, for tests that run over all of them.
namespace tensormass::tests {

inline std::vector<std::string> law_names() {
  std::vector<std::string> names;
  physics::for_each_type(physics::Laws{}, [&](auto tag, int) { names.emplace_back(decltype(tag)::Type::kName); });
  return names;
}

inline std::vector<v1::Shape> shapes() {
  return {v1::SHAPE_TETRAHEDRON,
          v1::SHAPE_PYRAMID,
          v1::SHAPE_WEDGE,
          v1::SHAPE_HEXAHEDRON,
          v1::SHAPE_QUADRATIC_TETRAHEDRON,
          v1::SHAPE_QUADRATIC_HEXAHEDRON};
}

/// Returns the law of this name with these moduli at rest, plus fibres if it has them. A law with parameters of its own
/// needs a branch here.
inline v1::Law law(const std::string& name, double young_modulus_pa, double poisson_ratio) {
  v1::Law out;
  const double shear = young_modulus_pa / (2 * (1 + poisson_ratio));
  const double bulk = young_modulus_pa / (3 * (1 - 2 * poisson_ratio));
  if (name == "mooney_rivlin") {
    out.mutable_mooney_rivlin()->set_c10_pa(0.35 * shear);
    out.mutable_mooney_rivlin()->set_c01_pa(0.15 * shear);
    out.mutable_mooney_rivlin()->set_bulk_modulus_pa(bulk);
  } else if (name == "ogden") {
    out.mutable_ogden()->set_alpha(-4);
    out.mutable_ogden()->set_mu_pa(-shear / 2);
    out.mutable_ogden()->set_bulk_modulus_pa(bulk);
  } else if (name == "transversely_isotropic") {
    v1::TransverselyIsotropic& fibres = *out.mutable_transversely_isotropic();
    fibres.set_young_modulus_pa(young_modulus_pa);
    fibres.set_poisson_ratio(poisson_ratio);
    fibres.set_fibre_modulus_pa(2 * young_modulus_pa);
    fibres.mutable_fibre_direction()->set_x(1);
    fibres.mutable_fibre_direction()->set_y(0.5);
  } else {
    const auto* field = v1::Law::descriptor()->FindFieldByName(name);
    if (field == nullptr) throw std::invalid_argument(name + " is not a kind of Law in scene.proto");
    auto* moduli = dynamic_cast<v1::IsotropicElastic*>(out.GetReflection()->MutableMessage(&out, field));
    if (moduli == nullptr) throw std::invalid_argument(name + " needs a branch in tests/support/laws.h");
    moduli->set_young_modulus_pa(young_modulus_pa);
    moduli->set_poisson_ratio(poisson_ratio);
  }
  return out;
}

}  // namespace tensormass::tests
