#include "world/findings.h"

#include <algorithm>
#include <bit>
#include <limits>
#include <utility>
#include <vector>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "core/assert.h"
#include "core/finding_kinds.h"
#include "model/edit_tables.h"
#include "physics/lists.h"
#include "step/finding_message.h"

namespace tensormass::world {

namespace {
constexpr auto kRelaxed = std::memory_order_relaxed;

/// Names of the laws that recover from inversion: "one, another and a third".
std::string recovering_laws() {
  std::vector<std::string> names;
  physics::for_each_type(physics::Laws{}, [&](auto tag, int) {
    using Law = typename decltype(tag)::Type;
    if (Law::kInversion == physics::Inversion::kRecovers) names.push_back(Law::kName);
  });
  TM_ASSERT(!names.empty(), "some law recovers from inversion");
  const std::string last = names.back();
  names.pop_back();
  return names.empty() ? last : fmt::format("{} and {}", fmt::join(names, ", "), last);
}

void add(Finding finding, const model::Model& m, v1::SceneStatus& status) {
  accept(finding, m.accepted);
  step::add(finding, status);
}

/// Returns how far a step fell short whose solve missed an energy [J]; zero if that is not known.
solver::StepError shortfall(const model::Model& m, double missing_energy_j) {
  double mass_kg = 0;
  for (std::size_t row = 0; row < m.layout.row_count; ++row) {
    const double weight = m.inertia[4 * row + 3];
    if (m.rest[4 * row + 3] != 0) mass_kg += weight * weight * m.inertia[4 * row];
  }
  return solver::step_error(missing_energy_j, mass_kg, m.dt_s);
}

std::string in_words(const solver::StepError& error) {
  if (!(error.displacement_m > 0)) return {};
  return fmt::format(", by about {:.1g} mm in a step, and forces on bodies are off by up to about {:.1g} N",
                     error.displacement_m * 1e3, error.force_n);
}

const std::string& body_of_group(const model::Model& m, std::size_t group) {
  const std::uint32_t element = m.groups[group].elements.front();
  const auto holds = [&](const model::BodyModel& body) { return element - body.element_begin < body.element_count; };
  const auto body = std::find_if(m.bodies.begin(), m.bodies.end(), holds);
  TM_ASSERT(body != m.bodies.end(), "an element group is part of a body");
  return body->name;
}

}  // namespace

bool Findings::take_step(const World& world) {
  const GuardEvent* event = world.guard_event();
  const bool recovering = world.recovering();
  TM_ASSERT(!recovering || event != nullptr, "a recovery has an event");
  const bool turns = recovering != was_recovering_;
  was_recovering_ = recovering;
  recovering_.store(recovering, kRelaxed);
  if (recovering) {
    recovering_steps_.fetch_add(1, kRelaxed);
    if (turns) recoveries_.fetch_add(1, kRelaxed);
    if (event->outcome == GuardEvent::Outcome::kHeld) held_steps_.fetch_add(1, kRelaxed);
  }
  if (event != nullptr) {
    const std::lock_guard lock(event_mutex_);
    last_event_ = *event;
    guard_events_.fetch_add(1, kRelaxed);
    if (event->outcome == GuardEvent::Outcome::kStopped) return turns;  // the scene is back at its checkpoint
    guard_recoveries_.fetch_add(1, kRelaxed);
    ++window_repeated_;
  }
  if (++window_steps_ == kWindow) {
    repeated_.store(window_repeated_, kRelaxed);
    window_steps_ = window_repeated_ = 0;
  }
  const solver::StepResult& result = world.last();
  kinetic_j_.store(world.energy().kinetic_j(), kRelaxed);
  work_j_.store(world.energy().work_j(), kRelaxed);
  cg_iterations_.store(result.cg_iterations, kRelaxed);
  cg_residual_.store(result.cg_relative_residual, kRelaxed);
  if (!result.converged) unconverged_steps_.fetch_add(1, kRelaxed);
  const bool above = world.model().cg_tolerance > 0 && result.cg_relative_residual > world.model().cg_tolerance;
  solves_above_.store(solves_above_.load(kRelaxed) << 1 | (above ? 1u : 0u), kRelaxed);
  if (above) missing_energy_j_.store(result.missing_energy_j, kRelaxed);
  solves_.store(std::min(solves_.load(kRelaxed) + 1, kWindow), kRelaxed);
  newton_iterations_.store(result.newton_iterations, kRelaxed);
  newton_residual_.store(result.newton_residual, kRelaxed);
  converged_.store(result.converged, kRelaxed);
  negative_curvature_.store(result.negative_curvature, kRelaxed);
  touching_nodes_.store(result.touching_nodes, kRelaxed);
  deepest_contact_m_.store(result.deepest_contact_m, kRelaxed);
  momentum_error_.store(result.momentum_error, kRelaxed);
  broken_springs_.store(result.broken_springs, kRelaxed);
  return turns;
}

void Findings::take_edits(const World& world) { broken_springs_.store(world.last().broken_springs, kRelaxed); }

void Findings::take_diagnostics(const World& world) {
  TM_ASSERT(world.diagnostics().size() <= groups_.size(), "diagnostics of each element group");
  for (std::size_t g = 0; g < world.diagnostics().size(); ++g) {
    groups_[g].min_det_f.store(world.diagnostics()[g].min_det_f, kRelaxed);
    groups_[g].max_strain.store(world.diagnostics()[g].max_strain, kRelaxed);
    groups_[g].max_rotation_rad.store(world.diagnostics()[g].max_rotation_rad, kRelaxed);
    groups_[g].least_stretch.store(world.diagnostics()[g].least_stretch, kRelaxed);
  }
  elastic_j_.store(world.energy().elastic_j(), kRelaxed);
  dissipated_j_.store(world.energy().dissipated_j().value_or(0), kRelaxed);
}

void Findings::go_on_with(std::shared_ptr<const model::Model> model) noexcept {
  TM_ASSERT(model->groups.size() <= groups_.size(), "cuts add a group for what they leave of clusters at most");
  (void)model_.replace(std::move(model));
}

void Findings::clear() {
  for (auto* count : {&cg_iterations_, &newton_iterations_, &touching_nodes_, &broken_springs_}) {
    count->store(0, kRelaxed);
  }
  for (auto* value : {&cg_residual_, &missing_energy_j_, &newton_residual_, &kinetic_j_, &elastic_j_, &work_j_,
                      &dissipated_j_, &deepest_contact_m_, &momentum_error_}) {
    value->store(0, kRelaxed);
  }
  window_steps_ = window_repeated_ = 0;
  repeated_.store(0, kRelaxed);
  for (auto* count :
       {&unconverged_steps_, &guard_events_, &guard_recoveries_, &recoveries_, &recovering_steps_, &held_steps_}) {
    count->store(0, kRelaxed);
  }
  solves_above_ = 0;
  solves_ = 0;
  recovering_ = was_recovering_ = false;
  converged_ = true;
  negative_curvature_ = false;
  for (Group& group : groups_) {
    group.min_det_f = 1;
    group.max_strain = 0;
    group.max_rotation_rad = 0;
    group.least_stretch = 1;
  }
}

void Findings::add_to(v1::SceneStatus& status) const {
  const std::shared_ptr<const model::Model> model = model_.get();
  for (const Finding& finding : model->findings) step::add_of_load(finding, status);
  add_solve(*model, status);
  add_elements(*model, status);
  add_energy(*model, status);
  add_guard(*model, status);
  add_budget(*model, status);
  status.set_touching_nodes(touching_nodes_.load(kRelaxed));
  status.set_deepest_contact_m(deepest_contact_m_.load(kRelaxed));
  status.set_broken_springs(broken_springs_.load(kRelaxed));
  status.set_momentum_error(momentum_error_.load(kRelaxed));
}

void Findings::add_solve(const model::Model& m, v1::SceneStatus& status) const {
  status.set_cg_iterations(cg_iterations_.load(kRelaxed));
  status.set_cg_relative_residual(cg_residual_.load(kRelaxed));
  if (m.iterates()) {
    const double residual = newton_residual_.load(kRelaxed);
    status.set_newton_iterations(newton_iterations_.load(kRelaxed));
    status.set_newton_residual(residual);
    status.set_unconverged_steps(unconverged_steps_.load(kRelaxed));
    if (!converged_.load(kRelaxed)) {
      add({.code = FindingCode::kUnconvergedStep,
           .value = residual,
           .limit = m.newton_tolerance,
           .place = "scene.solver.newton_max_iterations",
           .message = fmt::format("the last step ended with a residual of {:.2g} of the forces, above newton_tolerance "
                                  "= {:.2g}",
                                  residual, m.newton_tolerance),
           .remedy = "give it more newton_max_iterations or cg_max_iterations, or reach the load in smaller steps"},
          m, status);
    }
  } else {
    // Newton's method makes up for a linear solve that ends early. Without it, the step keeps the error.
    const std::uint32_t solves = solves_.load(kRelaxed);
    const std::uint64_t all_above = solves_above_.load(kRelaxed);
    const auto above = static_cast<std::uint32_t>(std::popcount(all_above));
    const bool last_above = (all_above & 1) != 0;
    solver::StepError error;
    if (last_above) error = shortfall(m, missing_energy_j_.load(kRelaxed));
    if (solves > 0 && m.cg_tolerance > 0 && (!last_above || error.displacement_m > 0)) {
      status.set_solve_displacement_error_m(error.displacement_m);
      status.set_solve_force_error_n(error.force_n);
    }
    if (above > thresholds::kMax * solves) {
      add({.code = FindingCode::kSolveAboveTolerance,
           .value = static_cast<double>(above) / solves,
           .limit = thresholds::kMax,
           .place = "scene.solver.cg_max_iterations",
           .message = fmt::format("{} of the last {} solves ended above cg_tolerance = {:.2g}, the last one after {} "
                                  "iterations with a residual of {:.2g}: tissue moves less than it should{}",
                                  above, solves, m.cg_tolerance, status.cg_iterations(), status.cg_relative_residual(),
                                  in_words(shortfall(m, missing_energy_j_.load(kRelaxed)))),
           .remedy = "give it more cg_max_iterations, or take smaller steps"},
          m, status);
    }
  }
  if (negative_curvature_.load(kRelaxed)) {
    add({.code = FindingCode::kNegativeCurvature,
         .value = 1,
         .place = "scene.solver.precision",
         .message = "conjugate gradients met a direction of negative curvature and ended early; the matrix is at the "
                    "end of its precision",
         .remedy = "take double, or a milder ratio of stiffness to mass"},
        m, status);
  }
}

void Findings::add_elements(const model::Model& m, v1::SceneStatus& status) const {
  double min_det_f = std::numeric_limits<double>::infinity(), most_used = 0;
  for (std::size_t g = 0; g < m.groups.size(); ++g) {
    min_det_f = std::min(min_det_f, groups_[g].min_det_f.load(kRelaxed));
    const model::ElementGroup& group = m.groups[g];
    if (group.has_clusters()) continue;  // each of their elements has diagnostics of its own
    const double strain = groups_[g].max_strain.load(kRelaxed), rotation = groups_[g].max_rotation_rad.load(kRelaxed);
    const double stretch = groups_[g].least_stretch.load(kRelaxed);
    physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
      using Law = typename decltype(tag)::Type;
      if (index != group.law) return;
      if constexpr (Law::kInversion == physics::Inversion::kOutOfRange) {
        const double used = std::max(strain / Law::kMaxStrain, rotation / Law::kMaxRotation);
        most_used = std::max(most_used, used);
        if (used <= 1) return;
        add({.code = FindingCode::kLawRange,
             .value = used,
             .limit = 1,
             .place = fmt::format("body '{}'.law", body_of_group(m, g)),
             .body = body_of_group(m, g),
             .message =
                 fmt::format("body '{}': {} has left its range of strains up to {} and rotations up to {} rad: "
                             "strain {:.2g}, rotation {:.2g} rad",
                             body_of_group(m, g), Law::kName, Law::kMaxStrain, Law::kMaxRotation, strain, rotation),
             .remedy = "take corotational or another law that stands rotation"},
            m, status);
      } else if constexpr (requires { Law::kLeastStretch; }) {
        const double used = std::max(1 - stretch, 0.0) / (1 - Law::kLeastStretch);
        most_used = std::max(most_used, used);
        if (used <= 1) return;
        add({.code = FindingCode::kLawSoftens,
             .value = stretch,
             .limit = Law::kLeastStretch,
             .place = fmt::format("body '{}'.law", body_of_group(m, g)),
             .body = body_of_group(m, g),
             .message = fmt::format("body '{}': {} gets softer where it is pressed to less than {} of its length, and "
                                    "an element is pressed to {:.2g}",
                                    body_of_group(m, g), Law::kName, Law::kLeastStretch, stretch),
             .remedy = "take stable_neo_hookean or another law that stands compression"},
            m, status);
      }
    });
  }
  status.set_law_range_used(most_used);
  status.set_min_det_f(min_det_f);
  if (min_det_f <= 0) {
    add({.code = FindingCode::kInvertedElements,
         .value = min_det_f,
         .place = "scene.bodies",
         .message = fmt::format("elements are inverted (min det F {:.2g})", min_det_f),
         .remedy = fmt::format("their stresses mean nothing until they recover, and only {} recover by themselves",
                               recovering_laws())},
        m, status);
  }
}

void Findings::add_energy(const model::Model& m, v1::SceneStatus& status) const {
  status.set_kinetic_energy_j(kinetic_j_.load(kRelaxed));
  status.set_elastic_energy_j(elastic_j_.load(kRelaxed));
  status.set_work_j(work_j_.load(kRelaxed));
  if (counts_all_work(m) && counts_all_energy(m)) status.set_dissipated_energy_j(dissipated_j_.load(kRelaxed));
}

void Findings::add_guard(const model::Model& m, v1::SceneStatus& status) const {
  status.set_guard_events(guard_events_.load(kRelaxed));
  status.set_guard_recoveries(guard_recoveries_.load(kRelaxed));
  status.set_recoveries(recoveries_.load(kRelaxed));
  status.set_recovering_steps(recovering_steps_.load(kRelaxed));
  status.set_held_steps(held_steps_.load(kRelaxed));
  status.set_recovering(recovering_.load(kRelaxed));
  if (status.guard_events() == 0) return;
  const std::lock_guard lock(event_mutex_);
  status.set_guard_text(to_text(last_event_, m));
  const std::uint32_t again = repeated_.load(kRelaxed);
  if (again <= thresholds::kMax * kWindow) return;
  add({.code = FindingCode::kRepeatedSteps,
       .value = static_cast<double>(again) / kWindow,
       .limit = thresholds::kMax,
       .place = "scene.stepping.dt_s",
       .message = fmt::format("{} of {} steps left their bounds ({}) and were repeated with smaller steps or safer "
                              "settings, which takes longer",
                              again, kWindow, to_text(last_event_.first)),
       .remedy = last_event_.first.breach == Breach::kLinearResidual
                     ? "give it more cg_max_iterations, or a floor that it can keep"
                     : "take smaller steps, or a law that stands the load"},
      m, status);
}

void Findings::add_budget(const model::Model& m, v1::SceneStatus& status) const {
  status.set_floor_tolerance(m.floor_tolerance);
  if (m.budget_s == 0) return;
  const std::uint32_t limit = budget_.limit();
  status.set_step_budget_s(m.budget_s);
  status.set_floor_cg_iterations(m.floor_cg_iterations);
  status.set_cg_iteration_limit(limit);
  if (limit < m.cg_max_iterations) {
    add({.code = FindingCode::kLoweredIterations,
         .value = static_cast<double>(limit),
         .limit = static_cast<double>(m.cg_max_iterations),
         .place = "scene.solver.budget_s",
         .message = fmt::format("a solve takes {} of {} iterations at most, to keep steps within budget_s = {:.3g}",
                                limit, m.cg_max_iterations, m.budget_s),
         .remedy = "results are less accurate; give it more time, or fewer elements"},
        m, status);
  }
  if (budget_.step_s() > m.budget_s) {
    const std::string residual =
        m.floor_tolerance > 0 ? fmt::format(" and a residual of {:.2g}", m.floor_tolerance) : "";
    add({.code = FindingCode::kBudgetExceeded,
         .value = budget_.step_s(),
         .limit = m.budget_s,
         .place = "scene.solver.budget_s",
         .message = fmt::format("steps take {:.2g} s of a budget of {:.2g} s", budget_.step_s(), m.budget_s),
         .remedy = fmt::format("the floor is {} iterations{}", m.floor_cg_iterations, residual)},
        m, status);
  }
}

}  // namespace tensormass::world
