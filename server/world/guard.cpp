#include "world/guard.h"

#include <algorithm>
#include <array>
#include <limits>

#include <fmt/format.h>

#include "physics/lists.h"
#include "world/tool.h"

namespace tensormass::world {

namespace {

/// Sizes of the scene. A node that crosses the scene in one step has passed through everything it should touch.
constexpr double kMaxMove = 1;
/// The same for a scene in which a body may fall: a cube of 4 cm moves by its own size in a step of 1/60 s after 0.4 s.
constexpr double kMaxMoveOfFreeBodies = 10;
/// Share of the largest move. If a step that is linearized once moves a node farther, it is not trusted with the
/// consistent stiffness.
constexpr double kTrustedMove = 0.1;
/// Sizes of the scene. A fixed body that is stretched to ten times the scene is not tissue any more.
constexpr double kMaxDistance = 10;
/// Relative residual of the linear solve. Conjugate gradients may raise it on their way, by less than this.
constexpr double kMaxLinearResidual = 100;
/// Residual of Newton's method, relative to the forces: at 1 the forces are not balanced at all.
constexpr double kMaxNewtonResidual = 1;
/// Factor on the available energy. A step solves a linearized problem and work is summed over steps, so both energies
/// are rough.
constexpr double kEnergySlack = 4;
/// Energy of this shear strain in the whole scene is always allowed: near rest the bound would be rounding.
constexpr double kLeastStrain = 1e-3;

/// Parts of the finest retry of a quasi-static step.
constexpr std::uint32_t kMaxParts = 64;
constexpr const char* kLawsThatRecover =
    "corotational and stable_neo_hookean recover from collapse and inversion, the others do not";

constexpr std::array<Retry, 4> kDynamicRetries{{
    {1, 1, false, Breach::kLinearResidual},
    {2, 1, false, Breach::kNone},
    {8, 1, false, Breach::kNone},
    {8, 4, true, Breach::kNone},
}};
constexpr std::array<Retry, 7> kQuasiStaticRetries{{
    {2, 1, false, Breach::kNone},
    {4, 1, false, Breach::kNone},
    {8, 1, false, Breach::kNone},
    {16, 1, false, Breach::kNone},
    {32, 1, false, Breach::kNone},
    {kMaxParts, 1, false, Breach::kNone},
    {8, 4, true, Breach::kNone},
}};

/// Size of the scene at rest plus twice the largest prescribed displacement [m].
double size_of(const model::Model& m) {
  double prescribed = 0;
  for (const model::Prescribed& p : m.prescribed) {
    double largest = p.schedule.empty() ? 1 : 0;
    for (const double factor : p.schedule.factor) largest = std::max(largest, std::abs(factor));
    prescribed = std::max(prescribed, largest * p.displacement_m.norm());
  }
  return m.size_m + 2 * prescribed;
}

/// Largest initial displacement [m]. A scene may spring back as far in a step.
double largest_start(const model::Model& m) {
  double squared = 0;
  for (std::size_t i = 0; i + 2 < m.initial_displacement.size(); i += 4) {
    squared = std::max(squared, Eigen::Map<const Vec3<double>>(m.initial_displacement.data() + i).squaredNorm());
  }
  return std::sqrt(squared);
}

/// Energy of all elements in shear at kLeastStrain [J].
double least_energy(const model::Model& m) {
  double energy = 0;
  for (const model::ElementGroup& group : m.groups) {
    physics::with_shape_and_law(group.shape, group.law, [&](auto shape, auto law) {
      using Law = typename decltype(law)::Type;
      constexpr std::size_t kWeight = physics::kRestReals<typename decltype(shape)::Type> - 1;
      for (std::uint32_t e = 0; e < group.element_count; ++e) {
        std::array<double, Law::kParameterCount> parameters;
        for (std::size_t c = 0; c < parameters.size(); ++c) parameters[c] = group.parameters[c * group.stride + e];
        const double shear_pa = Law::moduli_at_rest(parameters.data()).shear_pa;
        for (std::size_t q = 0; q < group.point_count; ++q) {
          energy += shear_pa * group.rest[(q * (kWeight + 1) + kWeight) * group.stride + e];
        }
      }
    });
  }
  return energy * kLeastStrain * kLeastStrain;
}

/// Energy of springs that are longer than their length at rest when the scene is at rest [J]. They may turn it into
/// motion.
double springs_energy(const model::Model& m) {
  const model::Links& links = m.links;
  double energy = 0;
  for (std::size_t spring = 0; spring < links.spring_count(); ++spring) {
    const auto rest_of = [&](std::size_t end) {
      return Eigen::Map<const Vec3<double>>(m.rest.data() + 4 * std::size_t{links.spring_rows[2 * spring + end]});
    };
    const double* numbers = links.spring_numbers.data() + 3 * spring;
    energy += spring_energy_j(numbers, (rest_of(0) - rest_of(1)).norm());
  }
  return energy;
}

/// Says whether a step must end in an equilibrium.
bool must_converge(const model::Model& m) { return m.quasi_static() && m.iterates() && !m.allow_unconverged; }

/// Says whether a body has no fixed nodes, so that it may fall, or may lose a piece that then falls.
bool may_fall(const model::Model& m) {
  return m.editing.has_value() ||
         std::any_of(m.bodies.begin(), m.bodies.end(), [](const auto& body) { return body.fixed_node_count == 0; });
}

}  // namespace

double spring_energy_j(const double* numbers, double length_m) {
  const double longer_m = std::max(length_m - numbers[1], 0.0);
  return numbers[0] * longer_m * longer_m / 2;
}

double max_distance_m(const model::Model& m) {
  if (must_converge(m) || may_fall(m)) return std::numeric_limits<double>::infinity();
  return m.max_distance_m.value_or(kMaxDistance * (size_of(m) + largest_start(m)));
}

bool counts_all_work(const model::Model& m) { return m.prescribed_rows.rows.empty() && m.pressure.faces.empty(); }

bool counts_all_energy(const model::Model& m) {
  return !m.quasi_static() && m.mass_edges.empty() && m.links.count() == 0 &&
         std::all_of(m.groups.begin(), m.groups.end(), [](const auto& group) { return group.prony.empty(); });
}

std::string to_text(const BoundCheck& check) {
  const auto [breach, value, bound] = check;
  switch (breach) {
    case Breach::kNone:
      return "it is within its bounds";
    case Breach::kNotFinite:
      return "the state is not finite any more";
    case Breach::kMove:
      return fmt::format("a node moved {:.3g} m in it, farther than max_move_m, {:.3g} m", value, bound);
    case Breach::kDistance:
      return fmt::format("a node is {:.3g} m from its rest position, farther than {:.3g} m", value, bound);
    case Breach::kEnergy:
      return fmt::format("the kinetic energy is {:.3g} J, more than the {:.3g} J that are available", value, bound);
    case Breach::kLinearResidual:
      return fmt::format("the linear solve ended at a residual of {:.3g}, above {:.3g}", value, bound);
    case Breach::kNewtonResidual:
      return fmt::format("Newton's method ended with a residual of {:.3g} of the forces, above {:.3g}", value, bound);
    case Breach::kNoEquilibrium:
      return fmt::format(
          "Newton's method ended with a residual of {:.2g} of the forces, above newton_tolerance = {:.2g}", value,
          bound);
    case Breach::kVolume:
      return fmt::format("an element is inverted (det F {:.3g}), and its law does not recover from that", value);
    case Breach::kToolLoad:
      return fmt::format("a tool has {:.3g} times its largest load", value);
    case Breach::kEnclosed:
      return fmt::format("tissue encloses tool {:.0f}", value);
  }
  return {};
}

EnergyBalance::EnergyBalance(const model::Model& model)
    : complete_(counts_all_work(model) && counts_all_energy(model)) {}

void EnergyBalance::add_step(double kinetic_j, double loads_work_j, double tools_work_j) {
  kinetic_j_ = kinetic_j;
  work_j_ += loads_work_j + tools_work_j;
  available_j_ += std::max(loads_work_j, 0.0) + std::max(tools_work_j, 0.0);
}

void EnergyBalance::take_elastic(double elastic_j) {
  elastic_j_ = elastic_j;
  available_j_ = kinetic_j_ + elastic_j_;
  dissipated_j_ = work_j_ - available_j_;
}

void EnergyBalance::set_entries(const Entries& entries) {
  kinetic_j_ = entries.kinetic_j;
  elastic_j_ = entries.elastic_j;
  work_j_ = entries.work_j;
  dissipated_j_ = entries.dissipated_j;
  available_j_ = entries.available_j;
}

void EnergyBalance::start(double kinetic_j, double elastic_j) {
  kinetic_j_ = kinetic_j;
  elastic_j_ = elastic_j;
  work_j_ = available_j_ = kinetic_j + elastic_j;
  dissipated_j_ = 0;
}

Guard::Guard(const model::Model& m)
    : max_move_m_(m.max_move_m.value_or(kMaxMove * (size_of(m) + largest_start(m)))),
      trusted_move_m_(kTrustedMove * max_move_m_),
      max_distance_m_(max_distance_m(m)),
      max_residual_(m.floor_tolerance > 0 ? m.floor_tolerance : kMaxLinearResidual),
      max_energy_ratio_(m.max_energy_ratio.value_or(kEnergySlack)),
      least_energy_j_(least_energy(m)),
      springs_j_(springs_energy(m)),
      newton_tolerance_(m.newton_tolerance),
      checks_energy_(counts_all_work(m)),
      must_converge_(must_converge(m)) {
  // A body that falls gets faster and faster.
  if (may_fall(m) && !m.max_move_m) max_move_m_ *= kMaxMoveOfFreeBodies;
}

BoundCheck Guard::check(const solver::StepResult& result, const StepEnergy& energy) const {
  if (!result.finite) return {Breach::kNotFinite};
  if (must_converge_) {
    if (!result.converged) return {Breach::kNoEquilibrium, result.newton_residual, newton_tolerance_};
    if (!(result.min_det_f > 0)) return {Breach::kVolume, result.min_det_f, 0};
    return {};
  }
  if (!(result.max_move_m <= max_move_m_)) return {Breach::kMove, result.max_move_m, max_move_m_};
  if (!(result.max_distance_m <= max_distance_m_)) return {Breach::kDistance, result.max_distance_m, max_distance_m_};
  if (!(result.min_det_f > 0)) return {Breach::kVolume, result.min_det_f, 0};
  if (!result.converged && !(result.newton_residual <= kMaxNewtonResidual)) {
    return {Breach::kNewtonResidual, result.newton_residual, kMaxNewtonResidual};
  }
  if (!(result.cg_relative_residual <= max_residual_)) {
    return {Breach::kLinearResidual, result.cg_relative_residual, max_residual_};
  }
  const double bound = kinetic_bound_j(result, energy, max_energy_ratio_);
  if (checks_energy_ && !(result.kinetic_energy_j <= bound)) return {Breach::kEnergy, result.kinetic_energy_j, bound};
  return {};
}

bool Guard::trusts(const solver::StepResult& result, const StepEnergy& energy) const {
  if (!(result.max_move_m <= trusted_move_m_)) return false;
  return !checks_energy_ || result.kinetic_energy_j <= kinetic_bound_j(result, energy, 1);
}

/// Returns `ratio` times the energy that can be kinetic after the step, plus what is always allowed.
double Guard::kinetic_bound_j(const solver::StepResult& result, const StepEnergy& energy, double ratio) const {
  const double there = energy.available_j + energy.contacts_j + springs_j_ + added_springs_j_ +
                       std::max(result.work_j, 0.0) + std::max(energy.tools_work_j, 0.0);
  return ratio * there + least_energy_j_;
}

std::span<const Retry> retries(const model::Model& m) {
  if (m.quasi_static()) return kQuasiStaticRetries;
  return kDynamicRetries;
}

std::string to_text(const GuardEvent& event, const model::Model& m) {
  using Outcome = GuardEvent::Outcome;
  if (event.outcome == Outcome::kTakenOut) {
    return fmt::format(
        "tool '{}' was inside tissue at step {}; it fades out, and comes back from outside within {:g} s",
        event.tool.view(), event.step, 2 * ToolMotion::kFadeS);
  }
  const std::string what = fmt::format("step {} left its bounds: {}", event.step, to_text(event.first));
  switch (event.outcome) {
    case Outcome::kRepeated:
      return fmt::format("{}; repeated as {} step{}, it stayed within them", what, event.steps,
                         event.steps == 1 ? "" : "s");
    case Outcome::kBackedOff:
      return fmt::format("{}; with tools that backed off, it stayed within them", what);
    case Outcome::kLetGo:
      return fmt::format("{}; with tools that let go, it stayed within them", what);
    case Outcome::kHeld:
      return fmt::format("{}; the tissue was held for this step, and tools back off", what);
    case Outcome::kStopped:
    case Outcome::kTakenOut:
      break;
  }
  const std::string stopped =
      fmt::format("Nothing of this step was published; the scene stopped at the end of step {}", event.step - 1);
  if (m.quasi_static()) {
    return fmt::format(
        "{}. In up to {} parts it came to {:.2g} of the {}. {}. Reset the scene. Then {}fix enough nodes, lower the "
        "load, or take a law that stands it: {}",
        what, kMaxParts, event.reached, event.step == 1 ? "load" : "step", stopped,
        m.double_precision ? "" : "take precision double, in which rounding hides no equilibrium, ", kLawsThatRecover);
  }
  return fmt::format(
      "{}. {} retries with smaller steps and fallback settings did not help; the last of them: {}. {}. Reset the "
      "scene. Then make dt_s smaller or the loads gentler, or take a law that stands the load: {}",
      what, event.retries, to_text(event.last), stopped, kLawsThatRecover);
}

}  // namespace tensormass::world
