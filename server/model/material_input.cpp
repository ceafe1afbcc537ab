#include "model/material_input.h"

#include <array>
#include <cmath>

#include <fmt/format.h>

#include "model/scene_input.h"
#include "physics/element/prony.h"
#include "physics/lists.h"
#include "tensormass/v1/scene.pb.h"

namespace tensormass::model {

namespace {

constexpr double kMinModulusPa = 1e-3, kMaxModulusPa = 1e13;
/// Above the maximum, single precision cannot tell the change of volume from rounding.
constexpr double kMinPoissonRatio = -0.999, kMaxPoissonRatio = 0.4999;

/// Does what read_number does, but formats the place only for an error, because scenes have millions of elements.
Result<double> read_constant(double value, double low, double high, std::string_view where, std::string_view field) {
  if (value >= low && value <= high) return value;
  return read_number(value, low, high, fmt::format("{}.{}", where, field));
}

Result<double> read_modulus(double value, std::string_view where, std::string_view field) {
  return read_constant(value, kMinModulusPa, kMaxModulusPa, where, field);
}

Result<double> read_poisson_ratio(double value, std::string_view where) {
  return read_constant(value, kMinPoissonRatio, kMaxPoissonRatio, where, "poisson_ratio");
}

/// Refuses moduli whose Poisson's ratio is outside its range. Laws may be given by other constants, so their rounding
/// is allowed for.
Result<void> check_compressibility(const physics::Moduli& moduli, double poisson_ratio, std::string_view where) {
  constexpr double kRounding = 1e-9;
  if (poisson_ratio >= kMinPoissonRatio - kRounding && poisson_ratio <= kMaxPoissonRatio + kRounding) return {};
  return invalid(fmt::format(
      "{}: a bulk modulus of {:g} Pa beside a shear modulus of {:g} Pa makes a Poisson's ratio of {:.6g}, which is not "
      "within [{:g}, {:g}]; bring the two moduli closer together",
      where, moduli.bulk_pa, moduli.shear_pa, poisson_ratio, kMinPoissonRatio, kMaxPoissonRatio));
}

/// Maps the message of a law to the parameters that the law stores. This template serves all laws that are given by
/// Young's modulus and Poisson's ratio; a law with other constants needs a specialization.
template <class Law>
struct Constants {
  using Message = v1::IsotropicElastic;
  static Result<std::array<double, Law::kParameterCount>> read(const Message& p, std::string_view where) {
    static_assert(
        requires { Law::parameters(1.0, 0.0); }, "constants of its own: specialize Constants for this law");
    TM_ASSIGN_OR_RETURN(young, read_modulus(p.young_modulus_pa(), where, "young_modulus_pa"));
    TM_ASSIGN_OR_RETURN(poisson, read_poisson_ratio(p.poisson_ratio(), where));
    return Law::parameters(young, poisson);
  }
};

template <>
struct Constants<physics::MooneyRivlin> {
  using Message = v1::MooneyRivlin;
  static Result<std::array<double, 3>> read(const Message& p, std::string_view where) {
    TM_ASSIGN_OR_RETURN(c10, read_constant(p.c10_pa(), 0, kMaxModulusPa, where, "c10_pa"));
    TM_ASSIGN_OR_RETURN(c01, read_constant(p.c01_pa(), 0, kMaxModulusPa, where, "c01_pa"));
    TM_RETURN_IF_ERROR(read_modulus(c10 + c01, where, "c10_pa + c01_pa"));
    TM_ASSIGN_OR_RETURN(bulk, read_modulus(p.bulk_modulus_pa(), where, "bulk_modulus_pa"));
    return physics::MooneyRivlin::parameters(c10, c01, bulk);
  }
};

template <>
struct Constants<physics::Ogden> {
  using Message = v1::Ogden;
  static Result<std::array<double, 3>> read(const Message& p, std::string_view where) {
    TM_ASSIGN_OR_RETURN(alpha, read_constant(p.alpha(), -50, 50, where, "alpha"));
    TM_ASSIGN_OR_RETURN(mu, read_constant(p.mu_pa(), -kMaxModulusPa, kMaxModulusPa, where, "mu_pa"));
    TM_RETURN_IF_ERROR(read_modulus(mu * alpha / 2, where, "mu_pa * alpha / 2"));
    TM_ASSIGN_OR_RETURN(bulk, read_modulus(p.bulk_modulus_pa(), where, "bulk_modulus_pa"));
    return physics::Ogden::parameters(mu, alpha, bulk);
  }
};

template <>
struct Constants<physics::TransverselyIsotropic> {
  using Message = v1::TransverselyIsotropic;
  static Result<std::array<double, 6>> read(const Message& p, std::string_view where) {
    TM_ASSIGN_OR_RETURN(young, read_modulus(p.young_modulus_pa(), where, "young_modulus_pa"));
    TM_ASSIGN_OR_RETURN(poisson, read_poisson_ratio(p.poisson_ratio(), where));
    TM_ASSIGN_OR_RETURN(fibre, read_constant(p.fibre_modulus_pa(), 0, kMaxModulusPa, where, "fibre_modulus_pa"));
    TM_ASSIGN_OR_RETURN(direction, read_vector(p.fibre_direction(), fmt::format("{}.fibre_direction", where)));
    if (!(direction.norm() > 1e-12)) {
      return invalid(fmt::format("{}.fibre_direction: has no length; give the direction of the fibres", where));
    }
    return physics::TransverselyIsotropic::parameters(young, poisson, fibre, direction.normalized());
  }
};

/// Refuses a constant that is not finite although element_fields replace it.
Result<void> check_shadowed(double value, std::string_view where, const char* name) {
  if (std::isfinite(value)) return {};
  return invalid(
      fmt::format("{}.{}: {} is not finite; element_fields stand in its place, leave it out", where, name, value));
}

/// Writes an element's own values over the law's constants.
template <class Message>
Result<void> override_values(Message& constants, const ElementValues& values, std::string_view where) {
  const auto missing = [&](const char* name) {
    return invalid(fmt::format("{}: the law has no {}; leave element_fields.{} out", where, name, name));
  };
  if (values.young_modulus_pa) {
    if constexpr (requires { constants.set_young_modulus_pa(0.0); }) {
      TM_RETURN_IF_ERROR(check_shadowed(constants.young_modulus_pa(), where, "young_modulus_pa"));
      constants.set_young_modulus_pa(*values.young_modulus_pa);
    } else {
      return missing("young_modulus_pa");
    }
  }
  if (values.poisson_ratio) {
    if constexpr (requires { constants.set_poisson_ratio(0.0); }) {
      TM_RETURN_IF_ERROR(check_shadowed(constants.poisson_ratio(), where, "poisson_ratio"));
      constants.set_poisson_ratio(*values.poisson_ratio);
    } else {
      return missing("poisson_ratio");
    }
  }
  if (values.fibre_direction) {
    if constexpr (requires { constants.mutable_fibre_direction(); }) {
      v1::Vector3& vector = *constants.mutable_fibre_direction();
      for (const double component : {vector.x(), vector.y(), vector.z()}) {
        TM_RETURN_IF_ERROR(check_shadowed(component, where, "fibre_direction"));
      }
      vector.set_x((*values.fibre_direction)[0]);
      vector.set_y((*values.fibre_direction)[1]);
      vector.set_z((*values.fibre_direction)[2]);
    } else {
      return missing("fibre_direction");
    }
  }
  return {};
}

Result<std::vector<physics::PronyTerm>> read_prony(const v1::Law& law, std::string_view where) {
  std::vector<physics::PronyTerm> terms;
  if (law.prony_size() > physics::kMaxPronyTerms) {
    return invalid(fmt::format("{}.prony: {} terms; physics::kMaxPronyTerms is {}", where, law.prony_size(),
                               physics::kMaxPronyTerms));
  }
  double sum = 0;
  for (int i = 0; i < law.prony_size(); ++i) {
    const std::string term = fmt::format("{}.prony[{}]", where, i);
    TM_ASSIGN_OR_RETURN(share, read_number(law.prony(i).share(), 1e-9, 1 - 1e-9, term + ".share"));
    TM_ASSIGN_OR_RETURN(time, read_number(law.prony(i).relaxation_time_s(), 1e-9, 1e9, term + ".relaxation_time_s"));
    terms.push_back({share, time});
    sum += share;
  }
  if (!(sum < 1 - 1e-9)) {
    return invalid(
        fmt::format("{}.prony: the shares add up to {}; below 1, or nothing of the stress remains", where, sum));
  }
  return terms;
}

/// Makes the material of one element.
///
/// constants: the constants of the law; the element's own values replace some of them.
/// prony:     the terms of the law, equal for all of its elements. Their error is reported after errors in constants.
template <class Law>
Result<Material> read_material(int index, typename Constants<Law>::Message constants, const ElementValues& values,
                               const Result<std::vector<physics::PronyTerm>>& prony, std::string_view where) {
  TM_RETURN_IF_ERROR(override_values(constants, values, where));
  TM_ASSIGN_OR_RETURN(parameters, Constants<Law>::read(constants, where));
  const physics::Moduli moduli = Law::moduli_at_rest(parameters.data());
  const physics::YoungPoisson elastic = physics::young_poisson_from(moduli);
  TM_RETURN_IF_ERROR(check_compressibility(moduli, elastic.poisson_ratio, where));
  if (!prony) return tl::make_unexpected(prony.error());
  return Material{index,
                  {parameters.begin(), parameters.end()},
                  prony.value(),
                  elastic.young_modulus_pa,
                  elastic.poisson_ratio,
                  Law::kConstantStiffness && prony.value().empty()};
}

}  // namespace

ElementLaw element_law(const v1::Law& law, std::string_view where) {
  const auto* kind = law.GetReflection()->GetOneofFieldDescriptor(law, law.GetDescriptor()->FindOneofByName("kind"));
  std::string known;
  physics::for_each_type(physics::Laws{}, [&](auto tag, int) {
    known += (known.empty() ? "" : ", ") + std::string(decltype(tag)::Type::kName);
  });
  ElementLaw result = [error = fmt::format("{}: no law that this server knows; give one of {}", where, known)](
                          const ElementValues&) -> Result<Material> { return invalid(error); };
  physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
    using Law = typename decltype(tag)::Type;
    if (kind == nullptr || kind->name() != Law::kName) return;
    // Throws if the protocol and Constants disagree about the message: every scene with the law then fails.
    const auto& constants =
        dynamic_cast<const typename Constants<Law>::Message&>(law.GetReflection()->GetMessage(law, kind));
    result = [index, constants, prony = read_prony(law, where), at = fmt::format("{}.{}", where, Law::kName)](
                 const ElementValues& values) { return read_material<Law>(index, constants, values, prony, at); };
  });
  return result;
}

std::array<double, 2> contact_moduli(const Material& material) {
  const double young_pa = material.young_modulus_pa, poisson = material.poisson_ratio;
  return {young_pa, young_pa / (1 - poisson * poisson)};
}

Result<Material> read_law(const v1::Law& law, const ElementValues& values, std::string_view where) {
  return element_law(law, where)(values);
}

}  // namespace tensormass::model
