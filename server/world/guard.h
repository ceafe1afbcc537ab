#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>

#include "backend/backend.h"
#include "model/model.h"
#include "world/fixed_name.h"

/// The guard: bounds that a step must stay within to be published, and the retries before tools back off or the scene
/// is stopped.
///
/// A time step can fail without an error: NaN, a node that flies away, energy from nowhere. A client would feel that as
/// a blow. So the world checks each step, and goes back to its checkpoint if the step left a bound:
///
///     checkpoint -> step -> check --within all bounds--> publish
///          ^                  |
///          +--- next retry <--+--no retry is left--> tools back off (world.h), or the scene stops at the checkpoint
///
/// docs/decisions/guards.md says why these bounds and not others.
///
///     E_kin      kinetic energy at the end of the step [J]
///     E_el       elastic energy at the last diagnostics [J]; a step does not compute it
///     available  energy that can be kinetic: E_kin + E_el at the last diagnostics, plus positive work since then [J]
namespace tensormass::world {

/// The bound that a step left.
enum class Breach : std::uint8_t {
  kNone,
  kNotFinite,
  kMove,            ///< a node moved too far in the step
  kDistance,        ///< a node is too far from rest
  kEnergy,          ///< more kinetic energy than is available
  kLinearResidual,  ///< relative residual of the linear solve
  kNewtonResidual,  ///< residual of Newton's method, relative to the forces
  kNoEquilibrium,   ///< the same in a quasi-static scene, above newton_tolerance
  kVolume,          ///< det F of an element whose law does not recover
  kToolLoad,        ///< load of a tool, relative to the largest that it bears
  kEnclosed,        ///< tissue encloses a tool; the value is its place
};

/// Names of the breaches in metrics (docs/metrics.md), in the order of Breach.
inline constexpr std::array<std::string_view, 11> kBreachNames{
    "none",           "not_finite", "move",      "distance",     "kinetic_energy", "linear_residual", "newton_residual",
    "no_equilibrium", "inversion",  "tool_load", "enclosed_tool"};
static_assert(static_cast<std::size_t>(Breach::kEnclosed) + 1 == kBreachNames.size(), "a name for each breach");

/// A step compared with its bounds: the first bound it left, with its value and the bound in the bound's unit.
struct BoundCheck {
  Breach breach = Breach::kNone;
  double value = 0, bound = 0;
  /// True if the step stayed within all bounds.
  bool good() const { return breach == Breach::kNone; }
};

/// Returns the largest distance of a node from its rest position [m]. Infinite if a body may fall, because it may do so
/// without end, or if the scene looks for an equilibrium.
double max_distance_m(const model::Model& model);
/// Returns the energy of a spring [J]. One that breaks pulls until the end of the step, so it may have all of it.
///
///   numbers   as in view::LinksView::spring_numbers
double spring_energy_j(const double* numbers, double length_m);

/// In words: "a node is 0.3 m from its rest position, farther than 0.15 m".
std::string to_text(const BoundCheck& check);

/// Says whether all work on the scene is counted. Prescribed displacements and pressure do work that is not.
bool counts_all_work(const model::Model& model);
/// Says whether all energy of the scene is counted. Viscoelastic internal variables and a consistent mass hold energy
/// that is not, and a quasi-static scene has no kinetic energy.
bool counts_all_energy(const model::Model& model);

/// Books of the work done on a scene and the energy in it.
///
/// Elastic energy is known only after diagnostics. Between two of them, the kinetic energy cannot exceed the energy at
/// the first plus the work done since: that sum is available_j().
class EnergyBalance {
 public:
  explicit EnergyBalance(const model::Model& model);

  /// The entries of the books [J].
  struct Entries {
    double kinetic_j = 0, elastic_j = 0, work_j = 0, dissipated_j = 0, available_j = 0;
  };
  Entries entries() const { return {kinetic_j_, elastic_j_, work_j_, dissipated_j_, available_j_}; }
  /// Goes on with the books of another time.
  void set_entries(const Entries& entries);

  /// Adds a published step: its kinetic energy, and the work of loads and tools since the step before [J].
  void add_step(double kinetic_j, double loads_work_j, double tools_work_j);
  /// Takes the elastic energy that diagnostics found after the last step, and closes the books up to it.
  void take_elastic(double elastic_j);
  /// Starts with the energy of the scene's initial state.
  void start(double kinetic_j, double elastic_j);

  /// Energy at the last diagnostics plus positive work since then [J].
  double available_j() const { return available_j_; }
  double kinetic_j() const { return kinetic_j_; }
  double elastic_j() const { return elastic_j_; }
  double work_j() const { return work_j_; }
  /// Dissipated energy [J]: work done on the scene minus the energy in it, at the last diagnostics. No value if some
  /// work or energy is not counted.
  std::optional<double> dissipated_j() const { return complete_ ? std::optional(dissipated_j_) : std::nullopt; }

 private:
  const bool complete_;
  double kinetic_j_ = 0, elastic_j_ = 0, work_j_ = 0, dissipated_j_ = 0, available_j_ = 0;
};

/// The energies that a step's kinetic energy is compared with.
struct StepEnergy {
  double available_j = 0;   ///< EnergyBalance::available_j
  double tools_work_j = 0;  ///< work of the tools in this step
  double contacts_j = 0;    ///< upper bound of the energy in the contacts with tools
};

/// The bounds of one scene. They follow from its size, its start and its tolerances, unless the scene states them.
///
/// A quasi-static step must converge instead of staying near: an equilibrium may be far from the last one.
class Guard {
 public:
  explicit Guard(const model::Model& model);
  /// Returns the first bound that the step left, if any. NaN leaves every bound.
  BoundCheck check(const solver::StepResult& result, const StepEnergy& energy) const;
  /// Returns whether a step within the bounds moved no node by more than a tenth of the bound, and has no more kinetic
  /// energy than there can be. Far from rest, a linearized step with a nearly singular stiffness does: it stays within
  /// the bounds at first and leaves them steps later.
  bool trusts(const solver::StepResult& result, const StepEnergy& energy) const;
  /// Allows the energy that springs had when they came to the scene, besides that of its own springs at rest [J].
  void allow_springs(double energy_j) { added_springs_j_ = energy_j; }
  double added_springs_j() const { return added_springs_j_; }

 private:
  double kinetic_bound_j(const solver::StepResult& result, const StepEnergy& energy, double ratio) const;

  double max_move_m_, trusted_move_m_, max_distance_m_, max_residual_, max_energy_ratio_, least_energy_j_, springs_j_,
      newton_tolerance_, added_springs_j_ = 0;
  bool checks_energy_, must_converge_;
};

/// A way to repeat a step that left its bounds, from the checkpoint at its start.
struct Retry {
  std::uint32_t steps;             ///< equal parts of dt
  std::uint32_t iteration_factor;  ///< times cg_max_iterations
  bool fallback_settings;          ///< implicit Euler instead of BDF2, and projected stiffness
  Breach only_for;                 ///< tried after this breach only; kNone: after any
};
/// All retries in the order of their trial. The first of a dynamic scene is for steps whose iterations a time budget
/// had lowered. A quasi-static scene is tried in more and more parts; in its first step they are parts of the load.
std::span<const Retry> retries(const model::Model& model);

/// A step that left its bounds.
struct GuardEvent {
  std::uint64_t step = 0;
  BoundCheck first;           ///< the step as planned
  BoundCheck last;            ///< the last retry
  std::uint32_t retries = 0;  ///< number of retries made
  std::uint32_t steps = 0;    ///< parts of dt in the last retry
  double reached = 0;         ///< largest share of the step that a retry came to
  enum class Outcome : std::uint8_t {
    kStopped,    ///< nothing helped, and the scene stopped
    kRepeated,   ///< a retry stayed within the bounds
    kBackedOff,  ///< the step could be made with tools that backed off
    kLetGo,      ///< the step could be made with tools that let go of the tissue
    kHeld,       ///< the tissue was held
    kTakenOut,   ///< tools were taken out of tissue
  } outcome = Outcome::kStopped;
  FixedName tool = {};  ///< that tissue encloses
};
/// Says what happened in a scene of this model. If nothing helped, also says where the scene stopped and what a user
/// can do.
std::string to_text(const GuardEvent& event, const model::Model& model);

}  // namespace tensormass::world
