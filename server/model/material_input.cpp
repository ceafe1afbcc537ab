#include "model/material_input.h"

#include <array>
#include <cmath>

#include <fmt/format.h>

#include "model/scene_input.h"
#include "physics/element/prony.h"
#include "physics/lists.h"

namespace tensormass::model {

namespace {

constexpr double kMinModulusPa = 1e-3, kMaxModulusPa = 1e13;
/// Beyond, single precision cannot tell the change of volume from rounding.
constexpr double kMinPoissonRatio = -0.999, kMaxPoissonRatio = 0.4999;

Result<double> read_modulus(double value, std::string_view where, std::string_view field) {
  return read_number(value, kMinModulusPa, kMaxModulusPa, fmt::format("{}.{}", where, field));
}

Result<double> read_poisson_ratio(double value, std::string_view where) {
  return read_number(value, kMinPoissonRatio, kMaxPoissonRatio, fmt::format("{}.poisson_ratio", where));
}

/// Of a law that may be given by other constants, but for their rounding.
Result<void> check_compressibility(const physics::Moduli& moduli, double poisson_ratio, std::string_view where) {
  constexpr double kRounding = 1e-9;
  if (poisson_ratio >= kMinPoissonRatio - kRounding && poisson_ratio <= kMaxPoissonRatio + kRounding) return {};
  return invalid(fmt::format(
      "{}: a bulk modulus of {:g} Pa beside a shear modulus of {:g} Pa makes a Poisson's ratio of {:.6g}, which is not "
      "within [{:g}, {:g}]; bring the two moduli closer together",
      where, moduli.bulk_pa, moduli.shear_pa, poisson_ratio, kMinPoissonRatio, kMaxPoissonRatio));
}

/// A law's message, and what the law stores of it. A law with constants of its own needs a specialization; this is for
/// all others.
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
    TM_ASSIGN_OR_RETURN(c10, read_number(p.c10_pa(), 0, kMaxModulusPa, fmt::format("{}.c10_pa", where)));
    TM_ASSIGN_OR_RETURN(c01, read_number(p.c01_pa(), 0, kMaxModulusPa, fmt::format("{}.c01_pa", where)));
    TM_RETURN_IF_ERROR(read_modulus(c10 + c01, where, "c10_pa + c01_pa"));
    TM_ASSIGN_OR_RETURN(bulk, read_modulus(p.bulk_modulus_pa(), where, "bulk_modulus_pa"));
    return physics::MooneyRivlin::parameters(c10, c01, bulk);
  }
};

template <>
struct Constants<physics::Ogden> {
  using Message = v1::Ogden;
  static Result<std::array<double, 3>> read(const Message& p, std::string_view where) {
    TM_ASSIGN_OR_RETURN(alpha, read_number(p.alpha(), -50, 50, fmt::format("{}.alpha", where)));
    TM_ASSIGN_OR_RETURN(mu, read_number(p.mu_pa(), -kMaxModulusPa, kMaxModulusPa, fmt::format("{}.mu_pa", where)));
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
    TM_ASSIGN_OR_RETURN(fibre,
                        read_number(p.fibre_modulus_pa(), 0, kMaxModulusPa, fmt::format("{}.fibre_modulus_pa", where)));
    TM_ASSIGN_OR_RETURN(direction, read_vector(p.fibre_direction(), fmt::format("{}.fibre_direction", where)));
    if (!(direction.norm() > 1e-12)) {
      return invalid(fmt::format("{}.fibre_direction: has no length; give the direction of the fibres", where));
    }
    return physics::TransverselyIsotropic::parameters(young, poisson, fibre, direction.normalized());
  }
};

/// What an element's own values are written over: not used, and yet no number that is none.
Result<void> check_shadowed(double value, std::string_view where, const char* name) {
  if (std::isfinite(value)) return {};
  return invalid(
      fmt::format("{}.{}: {} is not finite; element_fields stand in its place, leave it out", where, name, value));
}

/// Writes an element's own values over the law's message.
Result<void> override_values(google::protobuf::Message& constants, const ElementValues& values,
                             std::string_view where) {
  const auto* descriptor = constants.GetDescriptor();
  const auto* reflection = constants.GetReflection();
  const auto field = [&](const char* name) -> Result<const google::protobuf::FieldDescriptor*> {
    if (const auto* found = descriptor->FindFieldByName(name)) return found;
    return invalid(fmt::format("{}: the law has no {}; leave element_fields.{} out", where, name, name));
  };
  if (values.young_modulus_pa) {
    TM_ASSIGN_OR_RETURN(young, field("young_modulus_pa"));
    TM_RETURN_IF_ERROR(check_shadowed(reflection->GetDouble(constants, young), where, "young_modulus_pa"));
    reflection->SetDouble(&constants, young, *values.young_modulus_pa);
  }
  if (values.poisson_ratio) {
    TM_ASSIGN_OR_RETURN(poisson, field("poisson_ratio"));
    TM_RETURN_IF_ERROR(check_shadowed(reflection->GetDouble(constants, poisson), where, "poisson_ratio"));
    reflection->SetDouble(&constants, poisson, *values.poisson_ratio);
  }
  if (values.fibre_direction) {
    TM_ASSIGN_OR_RETURN(direction, field("fibre_direction"));
    auto& vector = static_cast<v1::Vector3&>(*reflection->MutableMessage(&constants, direction));
    for (const double component : {vector.x(), vector.y(), vector.z()}) {
      TM_RETURN_IF_ERROR(check_shadowed(component, where, "fibre_direction"));
    }
    vector.set_x((*values.fibre_direction)[0]);
    vector.set_y((*values.fibre_direction)[1]);
    vector.set_z((*values.fibre_direction)[2]);
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

}  // namespace

Result<Material> read_law(const v1::Law& law, const ElementValues& values, std::string_view where) {
  const auto* kind = law.GetReflection()->GetOneofFieldDescriptor(law, law.GetDescriptor()->FindOneofByName("kind"));
  std::string known;
  physics::for_each_type(physics::Laws{}, [&](auto tag, int) {
    known += (known.empty() ? "" : ", ") + std::string(decltype(tag)::Type::kName);
  });
  Result<Material> result = invalid(fmt::format("{}: no law that this server knows; give one of {}", where, known));
  physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
    using Law = typename decltype(tag)::Type;
    if (kind == nullptr || kind->name() != Law::kName) return;
    result = [&]() -> Result<Material> {
      v1::Law own = law;
      auto* constants = own.GetReflection()->MutableMessage(&own, kind);
      const std::string at = fmt::format("{}.{}", where, Law::kName);
      TM_RETURN_IF_ERROR(override_values(*constants, values, at));
      using Reader = Constants<Law>;
      // Throws where the protocol has another message than Constants: in the first scene with the law.
      TM_ASSIGN_OR_RETURN(parameters, Reader::read(dynamic_cast<const typename Reader::Message&>(*constants), at));
      const physics::Moduli moduli = Law::moduli_at_rest(parameters.data());
      const physics::YoungPoisson elastic = physics::young_poisson_from(moduli);
      TM_RETURN_IF_ERROR(check_compressibility(moduli, elastic.poisson_ratio, at));
      TM_ASSIGN_OR_RETURN(prony, read_prony(law, where));
      return Material{index,
                      {parameters.begin(), parameters.end()},
                      std::move(prony),
                      elastic.young_modulus_pa,
                      elastic.poisson_ratio,
                      Law::kConstantStiffness && law.prony().empty()};
    }();
  });
  return result;
}

}  // namespace tensormass::model
