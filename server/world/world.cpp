#include "world/world.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "physics/contact/hertz.h"
#include "world/yielding.h"

namespace tensormass::world {

namespace {

/// Trials of a step, with tools that give way before each but the first.
constexpr std::uint32_t kMaxTrials = 8;
/// Trials after the first that aim at the slower of two rises of the load (Hold::kAims).
constexpr std::uint32_t kAimingTrials = 3;
/// How a step that cannot be made is made with tools that back off: by how much, as Hold::back_off counts it, and in
/// how many parts. A tool that lets go is behind the surface, or has tissue around it that no small way relieves.
struct Recovery {
  double distance;
  std::uint32_t parts;
  bool lets_go;
};
constexpr std::array<Recovery, 3> kRecoveries{{{0, 2, false}, {0.25, 2, false}, {1, 1, true}}};
/// Distances by which tools back off while the tissue is held.
constexpr std::array<double, 4> kBacksOffHeld{0, 0.25, 1, 2};
/// Tools let go where recoveries take more than every fifth step: each adds kWeightOfRecovery steps to a time that
/// falls otherwise, and kStuckS is its bound.
constexpr double kWeightOfRecovery = 4, kStuckS = 0.2;
/// Simulated time between two looks for tools that are inside tissue.
constexpr double kBetweenLooksS = 0.05;
/// Parts of the finest retry while a hand feels tissue. Its tools back off sooner than a hand can wait for more.
constexpr std::uint32_t kMaxPartsForAHand = 2;

}  // namespace

Result<std::unique_ptr<World>> World::create(std::shared_ptr<const model::Model> model,
                                             const backend::Backend& backend) {
  // Other threads read the model, so edits change a copy.
  auto edited = model->edit_tables ? std::make_unique<model::Model>(*model) : nullptr;
  TM_ASSIGN_OR_RETURN(state, backend.create(edited ? *edited : *model));
  return std::unique_ptr<World>(new World(std::move(model), std::move(edited), std::move(state)));
}

World::World(std::shared_ptr<const model::Model> loaded, std::unique_ptr<model::Model> edited,
             std::unique_ptr<backend::SceneState> state)
    : first_(std::move(loaded)),
      loaded_(first_),
      edited_(std::move(edited)),
      model_(edited_ ? edited_.get() : loaded_.get()),
      state_(std::move(state)),
      tools_(model_->tools.begin(), model_->tools.end()),
      published_(model_->tools.size()),
      inputs_(model_->tools.size()),
      touches_(model_->tools.size()),
      forces_(model_->tools.size()),
      tried_(model_->tools.size()),
      readings_(model_->tools.size()),
      diagnostics_(model_->groups.size()),
      enclosure_(*model_),
      guard_(*model_),
      energy_(*model_),
      cg_limit_(model_->cg_max_iterations),
      broken_(model_->links.spring_count()),
      broken_bits_((broken_.size() + 7) / 8),
      fronts_(model_->links.blades.point_count()),
      sweeps_(*model_) {
  if (model_->edit_tables != nullptr) editor_.emplace(*model_);
  severed_.severed.reserve(broken_.size());
  newly_broken_.reserve(std::max<std::size_t>(model_->attachments.size(), 1) * (2 + tools_.size()));
  if (editor_) removed_.resize(model_->bodies.size());
  unspent_j_.assign(tools_.size(), 0.0);
  spared_.assign(tools_.size(), mesh::kNone);
  if (!model_->initial_displacement.empty() || !model_->initial_velocity.empty()) write_start();
  place_tools();
  if (model_->visible.count() > 0) state_->gather_visible();
}

void World::write_start() {
  const std::vector<double> rest(4 * std::size_t{model_->layout.row_count}, 0.0);
  std::size_t histories = 0;
  for (const model::ElementGroup& group : model_->groups) histories += group.internal_variable_reals();
  const auto or_rest = [&](const std::vector<double>& start) { return start.empty() ? rest : start; };
  state_->write(
      {or_rest(model_->initial_displacement), or_rest(model_->initial_velocity), std::vector<double>(histories, 0.0)});
  double kinetic_j = 0;
  for (std::size_t i = 0; i < model_->initial_velocity.size(); ++i) {
    const double v = i % 4 < 3 ? model_->initial_velocity[i] : 0;
    kinetic_j += model_->row_mass[i / 4] * v * v / 2;
  }
  energy_.start(kinetic_j, model_->initial_displacement.empty() ? 0 : diagnose_elastic_energy());
}

void World::place_tools() {
  contact_jumped_ = false;
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    tools_[i].place();
    published_[i] = {};
    readings_[i] = {};
    readings_[i].pose = tools_[i].pose();
    readings_[i].hand_m = tools_[i].hand_m();
    unspent_j_[i] = 0;
    spared_[i] = mesh::kNone;
  }
}

void World::read_tools() {
  contact_jumped_ = trial_jumped_;
  published_ = forces_;
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    const model::ToolModel& tool = model_->tools[i];
    ToolReading& reading = readings_[i];
    reading.pose = tools_[i].pose();
    reading.hand_m = reading.pose.position_m;
    reading.gives_way = tools_[i].gives_way();
    reading.recovering = recovering_ || tools_[i].comes_back();
    reading.retired = tools_[i].retired() && !tools_[i].leaves();
    reading.touching = touches({&forces_[i], 1});
    reading.level = tools_[i].level();
    reading.force_n = forces_[i].force_n;
    reading.torque_n_m = forces_[i].torque_n_m + tools_[i].lever().cross(forces_[i].force_n);
    reading.friction_n = forces_[i].friction_n;
    reading.joint_loads = forces_[i].joints;
    // Between two steps the local model follows the normal force; friction stays as it is.
    const Vec3<double> pressing = reading.force_n - reading.friction_n;
    const double force = pressing.norm();
    reading.stiffness_n_per_m.setZero();
    reading.yielding = {};
    if (const double modulus_pa = forces_[i].plane_strain_modulus_pa; force > 0 && modulus_pa > 0) {
      const Vec3<double> normal = pressing / force;
      reading.stiffness_n_per_m =
          physics::hertz_tangent_stiffness(force, modulus_pa, tool.radius_m) * normal * normal.transpose();
    }
    if (tools_[i].has_mass()) {
      tools_[i].feel(reading.force_n, reading.stiffness_n_per_m, forces_[i].young_modulus_pa);
      reading.hand_m = tools_[i].hand_m();
      reading.force_n = tools_[i].force_on_hand_n();
      reading.stiffness_n_per_m = in_series(tool.coupling_stiffness_n_per_m, reading.stiffness_n_per_m);
    }
    if (reading.gives_way) {
      // A hand that is ahead of its tool feels no more by moving on.
      reading.hand_m = tools_[i].target().position_m;
      reading.stiffness_n_per_m.setZero();
    }
  }
}

bool World::step(bool gather_visible) {
  has_event_ = recovering_ = false;
  evaluates_all_ = std::exchange(evaluates_all_next_, false);
  newly_broken_.clear();
  const bool begins_to_leave = take_tools_out();
  by_euler_ = asks_for_euler(published_, bodies_touch_);
  for (std::size_t i = 0; i < tools_.size(); ++i) tools_[i].move(model_->dt_s, published_[i]);
  const Projection before = projection_;
  const solver::StepResult last_good = last_;
  BoundCheck check = plan_step(gather_visible);
  if (!check.good()) check = retry(check);
  if (check.good()) check = check_loads(Hold::kAims);
  const bool moves_tools = !check.good();
  if (moves_tools) {
    check = step_with_tools_moved(check);
    if (!check.good()) {
      state_->restore();
      projection_ = before;
      const bool may_hold = (held_steps_ + 1) * model_->dt_s <= std::max(kLongestHeldS, model_->dt_s);
      if (!may_recover(check) || !may_hold) {
        event_.outcome = GuardEvent::Outcome::kStopped;
        recovering_ = false;
        for (ToolMotion& tool : tools_) tool.take_back();
        return false;
      }
      last_ = last_good;
      hold_tissue();
    }
  }
  if (check.good()) {
    held_steps_ = 0;
    if (!recovering_) {
      for (ToolMotion& tool : tools_) tool.end_step();
    }
  }
  recovering_ = recovering_ || begins_to_leave;
  stuck_s_ = std::max(0.0, stuck_s_ + (recovering_ ? kWeightOfRecovery : -1) * model_->dt_s);
  if (gather_visible && (has_event_ || moves_tools)) state_->gather_visible();
  if (check.good()) bodies_touch_ = last_.touching_nodes > 0;  // a held step leaves contact as it was
  energy_.add_step(last_.kinetic_energy_j, last_.work_j, tools_work_j_);
  ++step_count_;
  // No spring heals between two steps, so an equal count means the same springs.
  if (last_.broken_springs != broken_count_) read_broken();
  read_tools();
  burn();
  if (check.good() && !fronts_.empty()) {  // a held step leaves blades as they were
    state_->read_blades(fronts_);
    sweeps_.take(*model_, fronts_);
    read_yielding(*model_, fronts_, readings_);
  }
  return true;
}

/// Takes tools that are inside tissue out of it. A tool that feels tissue fades out first. Returns whether a tool
/// begins to leave in this step, which then has an event.
bool World::take_tools_out() {
  if (enclosure_.empty()) return false;
  const auto steps = static_cast<std::uint64_t>(std::max(1L, std::lround(kBetweenLooksS / model_->dt_s)));
  const bool looks = step_count_ % steps == 0;
  bool begins = false, updated = false;
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    const model::ToolModel& tool = model_->tools[i];
    ToolMotion& motion = tools_[i];
    const bool comes_out = motion.leaves() && motion.retired();
    if (tool.fixed || !(comes_out || (looks && motion.present()))) continue;
    if (!updated) {
      state_->gather_visible();
      enclosure_.update(state_->visible_positions());
      updated = true;
    }
    if (comes_out) {
      motion.come_out(place_outside(i), model_->dt_s);
    } else if (enclosure_.encloses(tool, motion.shape_of(motion.pose()))) {
      take_event({Breach::kEnclosed, static_cast<double>(i), 0});
      event_.outcome = GuardEvent::Outcome::kTakenOut;
      begins = true;
      if (touches({&published_[i], 1})) {
        motion.leave(model_->dt_s);
      } else {
        motion.come_out(place_outside(i), model_->dt_s);
      }
    }
  }
  return begins;
}

/// Returns the pose of the hand, moved out of the tissue if the tool would be inside there.
Pose World::place_outside(std::size_t i) const {
  Pose out = tools_[i].target();
  if (!enclosure_.is_outside(model_->tools[i], tools_[i].shape_of(out))) {
    out.position_m += enclosure_.way_out(model_->tools[i], tools_[i].shape_of(out)).value_or(Vec3<double>::Zero());
  }
  return out;
}

/// Checks that the hands bear the loads of the last trial. rise: as in Hold::share.
BoundCheck World::check_loads(double rise) const {
  double share = 0;
  bool too_far_back = false;
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    share = std::max(share, tools_[i].share(forces_[i], rise));
    too_far_back = too_far_back || (rise == Hold::kAims && tools_[i].too_far_back(forces_[i]));
  }
  if (share <= 1 && !too_far_back) return {};
  return {Breach::kToolLoad, share, 1};
}

/// Repeats a step that left a bound: with tools that give way while their load is too large, then with tools that back
/// off.
BoundCheck World::step_with_tools_moved(BoundCheck check) {
  for (std::uint32_t trial = 1; check.breach == Breach::kToolLoad && trial < kMaxTrials; ++trial) {
    for (std::size_t i = 0; i < tools_.size(); ++i) {
      if (model_->tools[i].fixed) continue;
      if (tools_[i].share(forces_[i], Hold::kAims) > 1 || tools_[i].too_far_back(forces_[i]))
        tools_[i].give_way(forces_[i]);
    }
    check = repeat_step(1);
    if (check.good()) check = check_loads(trial <= kAimingTrials ? Hold::kAims : Hold::kBears);
  }
  if (check.good()) return check;
  take_event(check);
  return may_recover(check) ? recover(check) : check;
}

/// Repeats a step with tools that back off, or let go. Tools that feel nothing stay with the hand.
BoundCheck World::recover(BoundCheck check) {
  tried_ = forces_;
  for (const Recovery& how : kRecoveries) {
    if (stuck_s_ > kStuckS && !how.lets_go) continue;
    bool moves = false;
    for (std::size_t i = 0; i < tools_.size(); ++i) {
      if (!can_back_off(i)) continue;
      moves = true;
      tools_[i].back_off(how.distance, tried_[i]);
      if (how.lets_go) tools_[i].let_go();
    }
    if (!moves) return check;
    check = repeat_step(how.parts);
    if (check.good()) check = check_loads(how.lets_go ? Hold::kAtOnce : Hold::kBears);
    if (check.good()) {
      if (how.lets_go) stuck_s_ = 0;
      recovering_ = true;
      event_.outcome = how.lets_go ? GuardEvent::Outcome::kLetGo : GuardEvent::Outcome::kBackedOff;
      break;
    }
    take_event(check);
  }
  return check;
}

/// Repeats a step from the checkpoint, with its planned settings.
BoundCheck World::repeat_step(std::uint32_t parts) {
  state_->restore();
  return make_step({parts, 1, false, Breach::kNone}, !model_->iterates(), cg_limit_, false, false);
}

/// Takes the bound that a trial left into the event of the step.
void World::take_event(const BoundCheck& check) {
  if (!has_event_) event_ = {.step = step_count_ + 1, .first = check, .last = check};
  if (!has_event_ && check.breach == Breach::kEnclosed) {
    event_.tool = FixedName(model_->tools[static_cast<std::size_t>(check.value)].name);
  }
  has_event_ = true;
  event_.last = check;
}

/// Whether a hand holds the tool, and it felt tissue before the step or in the trial that failed.
bool World::can_back_off(std::size_t i) const {
  return !model_->tools[i].fixed && (touches({&published_[i], 1}) || touches({&tried_[i], 1}));
}

/// Whether the scene goes on where a step left this bound. No hand bears too large a load.
bool World::may_recover(const BoundCheck& check) const { return model_->goes_on || check.breach == Breach::kToolLoad; }

/// Ends a step that could not be made with the tissue as it was, at rest, and with tools that back off.
void World::hold_tissue() {
  recovering_ = true;
  event_.outcome = GuardEvent::Outcome::kHeld;
  state_->come_to_rest();
  projection_.begin();
  forces_ = published_;
  trial_jumped_ = false;
  tools_work_j_ = last_.work_j = last_.kinetic_energy_j = 0;
  const std::size_t again = held_steps_++;
  const bool lets_go = held_steps_ * model_->dt_s > kLongestHeldS / 2;
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    if (!can_back_off(i)) continue;
    tools_[i].back_off(kBacksOffHeld[std::min(again, kBacksOffHeld.size() - 1)], tried_[i]);
    if (lets_go) tools_[i].let_go();
  }
}

/// Whether a tool feels tissue.
bool World::touches(std::span<const backend::ToolForce> forces) {
  return std::any_of(forces.begin(), forces.end(),
                     [](const backend::ToolForce& force) { return !force.force_n.isZero(0); });
}

/// Whether a tool's force changed by more than a share of itself.
bool World::jumps(const Vec3<double>& from_n, const Vec3<double>& to_n) {
  return (to_n - from_n).norm() > solver::kContactJump * std::max(to_n.norm(), from_n.norm());
}

/// Whether BDF2 makes a step as its first one, by implicit Euler, after one in which contact jumped. It would take the
/// acceleration of an impact into the step after it, and throw the tissue off.
bool World::starts_anew(bool jumped) const { return model_->integrator == model::Integrator::kBdf2 && jumped; }

/// Whether contact that acts makes a step one of implicit Euler. The midpoint rule would keep the energy that contact
/// should take out, and BDF2 with kept forces alternates between two of them.
bool World::asks_for_euler(std::span<const backend::ToolForce> forces, bool bodies_touch) const {
  switch (model_->integrator) {
    case model::Integrator::kImplicitMidpoint:
      return bodies_touch || touches(forces);
    case model::Integrator::kBdf2:
      for (std::size_t i = 0; i < forces.size(); ++i) {
        if (model_->tools[i].keeps_force && touches({&forces[i], 1})) return true;
      }
      return false;
    default:
      return false;
  }
}

/// Makes the step as planned: in one part, with the consistent stiffness unless that failed lately or a tool touches.
BoundCheck World::plan_step(bool gather_visible) {
  constexpr Retry kAsPlanned{1, 1, false, Breach::kNone};
  if (model_->iterates()) return make_step(kAsPlanned, false, cg_limit_, true, gather_visible);  // newton.h projects
  const bool projects = projection_.active() || touches(published_);
  BoundCheck check = make_step(kAsPlanned, projects, cg_limit_, true, gather_visible);
  bool consistent = !projects;
  const bool failed =
      last_.negative_curvature || !trusted_ || (!check.good() && check.breach != Breach::kLinearResidual);
  if (consistent && model_->has_refreshed_tensors() && (failed || touches(forces_))) {
    if (failed) projection_.begin();
    consistent = false;
    state_->restore();
    check = make_step(kAsPlanned, true, cg_limit_, false, gather_visible);
  }
  projection_.end_step(consistent);
  return check;
}

/// Restores the checkpoint and repeats the step as `retries` say, until one of them stays within the bounds.
BoundCheck World::retry(const BoundCheck& first) {
  event_ = {.step = step_count_ + 1, .first = first, .last = first};
  has_event_ = true;
  for (const Retry& how : retries(*model_)) {
    if (how.only_for != Breach::kNone && (first.breach != how.only_for || cg_limit_ == model_->cg_max_iterations)) {
      continue;
    }
    if (model_->goes_on && how.steps > kMaxPartsForAHand && touches(published_)) break;
    state_->restore();
    // A step whose iterations were too few is repeated as it was; any other, linearized once, in the safer way.
    const bool as_planned = first.breach == Breach::kLinearResidual && !projection_.active() && !touches(published_);
    const bool projects = how.fallback_settings || (!model_->iterates() && !as_planned);
    event_.last = make_step(how, projects, how.iteration_factor * model_->cg_max_iterations, false, false);
    event_.steps = how.steps;
    ++event_.retries;
    if (event_.last.good()) break;
  }
  if (event_.last.good()) event_.outcome = GuardEvent::Outcome::kRepeated;
  return event_.last;
}

/// Makes a step, and makes it again by implicit Euler if contact that begins in it asks for that.
/// saves_checkpoint: the state before the step becomes the checkpoint. A retry starts from the checkpoint that is
/// there.
BoundCheck World::make_step(const Retry& how, bool projects_stiffness, std::uint32_t cg_max_iterations,
                            bool saves_checkpoint, bool gather_visible) {
  const bool was_by_euler = by_euler_;
  const BoundCheck check = make_parts(how, projects_stiffness, cg_max_iterations, saves_checkpoint, gather_visible);
  if (was_by_euler || !by_euler_) return check;
  state_->restore();
  return make_parts(how, projects_stiffness, cg_max_iterations, false, gather_visible);
}

/// Makes a step in equal parts. Each part must stay within the bounds; the first that does not ends the step, and so
/// does one after which the step must be made by implicit Euler.
BoundCheck World::make_parts(const Retry& how, bool projects_stiffness, std::uint32_t cg_max_iterations,
                             bool saves_checkpoint, bool gather_visible) {
  // The midpoint rule balances forces in the middle of a step, so its loads are there. Contact is that of the end.
  const double balanced_at = model_->extrapolates() && !by_euler_ ? 0.5 : 1;
  const bool loads_grow = model_->quasi_static() && step_count_ == 0;
  // One product, so that halves of a step end at bitwise the same time as steps of half its length.
  const auto time_s = [&](double share) { return (static_cast<double>(step_count_) + share) * model_->dt_s; };
  // All parts of a dynamic step have the scheduled loads of the whole step. These are then constant over the step,
  // which makes StepResult::work_j, force times the move from the checkpoint, their work. Parts of a quasi-static step
  // need gentler loads, and nobody counts its energy.
  const auto loads_time_s = [&](double share) { return time_s(model_->quasi_static() ? share : balanced_at); };
  tools_work_j_ = 0;
  trial_jumped_ = contact_jumped_;
  TM_ASSERT(how.steps > 0, "a step has parts");
  solver::StepResult before;  // sums and maxima over the previous parts
  before.newton_iterations = 0;
  for (std::size_t i = 0; i < tools_.size(); ++i) touches_[i] = {tools_[i].shape_at(0), published_[i]};
  for (std::uint32_t part = 1; part <= how.steps; ++part) {
    const double share = static_cast<double>(part) / how.steps;
    for (std::size_t i = 0; i < tools_.size(); ++i) {
      inputs_[i] = {tools_[i].shape_at(share), tools_[i].shape_at(static_cast<double>(part - 1) / how.steps),
                    tools_[i].presence_at(share)};
    }
    last_ = state_->step({.tools = inputs_,
                          .end_time_s = time_s(share),
                          .dt_s = model_->dt_s / how.steps,
                          .cg_max_iterations = cg_max_iterations,
                          .saves_checkpoint = saves_checkpoint,
                          .first_order = how.fallback_settings || starts_anew(trial_jumped_),
                          .by_euler = by_euler_,
                          .projects_stiffness = projects_stiffness,
                          .loads_time_s = loads_time_s(share),
                          .load_factor = loads_grow ? share : 1,
                          .evaluates_all = evaluates_all_ || how.steps > 1,
                          .gather_visible = gather_visible},
                         forces_);
    if (!by_euler_ && asks_for_euler(forces_, last_.touching_nodes > 0)) {
      by_euler_ = true;
      return {};
    }
    StepEnergy energy{.available_j = energy_.available_j()};
    trial_jumped_ = last_.bodies_jumped;
    for (std::size_t i = 0; i < tools_.size(); ++i) {
      const auto& [shape, load] = touches_[i];
      trial_jumped_ = trial_jumped_ || jumps(load.force_n, forces_[i].force_n);
      const Pose& now = inputs_[i].shape;
      tools_work_j_ -= (load.force_n + forces_[i].force_n).dot(now.position_m - shape.position_m) / 2;
      tools_work_j_ -= (load.torque_n_m + forces_[i].torque_n_m).dot(physics::rotation_vector(shape, now)) / 2;
      for (std::size_t j = 0; j < load.joints.size(); ++j) {
        tools_work_j_ -= (load.joints[j] + forces_[i].joints[j]) * (now.joint_values[j] - shape.joint_values[j]) / 2;
      }
      energy.contacts_j += std::max(load.force_n.norm(), forces_[i].force_n.norm()) * model_->tools[i].radius_m;
      touches_[i] = {now, forces_[i]};
    }
    energy.tools_work_j = tools_work_j_;
    const BoundCheck check = guard_.check(last_, energy);
    trusted_ = guard_.trusts(last_, energy);
    last_.cg_iterations += before.cg_iterations;
    last_.newton_iterations += before.newton_iterations;
    last_.converged = last_.converged && before.converged;
    last_.newton_residual = std::max(last_.newton_residual, before.newton_residual);
    last_.cg_relative_residual = std::max(last_.cg_relative_residual, before.cg_relative_residual);
    before = last_;
    if (!check.good()) return check;
    event_.reached = std::max(event_.reached, share);
  }
  return {};
}

/// Runs the diagnostics and returns the elastic energy of all elements [J].
double World::diagnose_elastic_energy() {
  state_->diagnose(diagnostics_);
  double elastic_j = 0;
  for (const backend::GroupDiagnostics& group : diagnostics_) elastic_j += group.elastic_energy_j;
  return elastic_j;
}

void World::diagnose() { energy_.take_elastic(diagnose_elastic_energy()); }

void World::reset() {
  if (editor_) {
    editor_->heal(*edited_, [&](const model::ModelEdit& edit) { state_->apply(edit); });
    enclosure_.take(*model_, *editor_);
    std::fill(removed_.begin(), removed_.end(), RemovedTissue{});
  }
  write_start();
  std::fill(diagnostics_.begin(), diagnostics_.end(), backend::GroupDiagnostics{});
  step_count_ = 0;
  last_ = {};
  projection_ = {};
  has_event_ = recovering_ = bodies_touch_ = false;
  held_steps_ = 0;
  stuck_s_ = 0;
  read_broken();
  newly_broken_.clear();
  sweeps_.clear();
  place_tools();
  if (model_->visible.count() > 0) state_->gather_visible();
}

World::Copied World::copy() {
  Copied out;
  out.step_count = step_count_;
  out.tissue = {state_->read(), state_->read_history()};
  if (starts_anew(contact_jumped_)) out.tissue.history.last_dt_s = 0;
  out.energy = energy_.entries();
  out.cg_limit = cg_limit_;
  out.held_steps = held_steps_;
  out.recovering = recovering_;
  out.stuck_s = stuck_s_;
  out.bodies_touch = bodies_touch_ && model_->extrapolates();  // other schemes do not ask
  projection_.save(out);
  if (editor_) out.shares = editor_->shares();
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    out.tools.push_back({tools_[i].save(), readings_[i].newest, published_[i], unspent_j_[i]});
  }
  return out;
}

void World::restore(const Copied& saved) {
  TM_ASSERT(saved.tools.size() == tools_.size(), "a saved state is of the same scene");
  take_shares(saved.shares);
  state_->write(saved.tissue.rows);
  state_->write_history(saved.tissue.history);
  read_broken();
  newly_broken_.clear();
  sweeps_.clear();
  std::fill(diagnostics_.begin(), diagnostics_.end(), backend::GroupDiagnostics{});
  step_count_ = saved.step_count;
  last_ = {};
  last_.broken_springs = broken_count_;
  has_event_ = false;
  contact_jumped_ = trial_jumped_ = false;  // saved as a history that starts anew; read_tools copies the second
  held_steps_ = saved.held_steps;
  recovering_ = saved.recovering;
  stuck_s_ = saved.stuck_s;
  bodies_touch_ = saved.bodies_touch;
  projection_.restore(saved);
  energy_.set_entries(saved.energy);
  set_cg_limit(saved.cg_limit);
  for (std::size_t i = 0; i < tools_.size(); ++i) {
    tools_[i].restore(saved.tools[i].motion);
    forces_[i] = saved.tools[i].force;
    readings_[i] = {};
    readings_[i].newest = saved.tools[i].newest;
    unspent_j_[i] = saved.tools[i].unspent_j;
    spared_[i] = mesh::kNone;
  }
  read_tools();
  // Reading them has made tools with a mass feel their contact a second time.
  for (std::size_t i = 0; i < tools_.size(); ++i) tools_[i].restore(saved.tools[i].motion);
  if (model_->visible.count() > 0) state_->gather_visible();
}

void World::take_over(const Saved& saved) {
  restore(saved);
  energy_.start(saved.energy.kinetic_j, diagnose_elastic_energy());
}

std::vector<double> World::positions(const model::BodyModel& body) {
  const backend::RowState state = state_->read();
  TM_ASSERT(body.node_begin + body.node_count <= model_->layout.row_of_node.size(), "a body of this model");
  std::vector<double> out(3 * std::size_t{body.loaded_node_count});
  for (std::uint32_t node = 0; node < body.loaded_node_count; ++node) {
    const std::size_t row = model_->layout.row_of_node[body.node_begin + node];
    for (std::size_t c = 0; c < 3; ++c) out[3 * node + c] = model_->rest[4 * row + c] + state.displacement[4 * row + c];
  }
  return out;
}

}  // namespace tensormass::world
