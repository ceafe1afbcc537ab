#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>

#include "backend/backend.h"
#include "model/model.h"

/// What a step must hold to be published, and what is tried before a scene is stopped. docs/decisions/guards.md says
/// why these bounds and not others.
namespace tensormass::world {

enum class Breach : std::uint8_t {
  kNone,
  kNotFinite,
  kMove,            ///< a node moved too far in the step
  kDistance,        ///< a node is too far from rest
  kEnergy,          ///< more kinetic energy than there can be
  kLinearResidual,  ///< of the linear solve
  kNewtonResidual,  ///< of the outer iteration
  kVolume,          ///< det F of an element whose law does not recover
};

struct BoundCheck {
  Breach breach = Breach::kNone;
  double value = 0, bound = 0;
  bool good() const { return breach == Breach::kNone; }
};

/// In words: "a node is 0.3 m from where it rests, where 0.15 m is the most".
std::string to_text(const BoundCheck& check);

/// Whether all work that is done on the scene is counted: displacements that are prescribed and pressure do some that
/// is not. And whether all energy is that it holds: not with memory, consistent mass, or without inertia.
bool counts_all_work(const model::Model& model);
bool counts_all_energy(const model::Model& model);

/// Energy that came in, and where it is. Elastic energy is known at a look at the elements; between two of them the
/// kinetic energy cannot pass what was there at the last plus what has come in since.
class EnergyBalance {
 public:
  explicit EnergyBalance(const model::Model& model);

  /// A step that was published. Work since the step before.
  void add_step(double kinetic_j, double loads_work_j, double tools_work_j);
  void take_elastic(double elastic_j);
  /// What the scene has to begin with.
  void start(double kinetic_j, double elastic_j);

  /// What there was at the last look and came in since.
  double available_j() const { return available_j_; }
  double kinetic_j() const { return kinetic_j_; }
  double elastic_j() const { return elastic_j_; }
  double work_j() const { return work_j_; }
  /// Work less the energy that is left of it, at the last look. Not where some of either is not counted.
  std::optional<double> dissipated_j() const { return complete_ ? std::optional(dissipated_j_) : std::nullopt; }

 private:
  const bool complete_;
  double kinetic_j_ = 0, elastic_j_ = 0, work_j_ = 0, dissipated_j_ = 0, available_j_ = 0;
};

/// What a step is judged by besides its result.
struct StepEnergy {
  double available_j = 0;  ///< EnergyBalance::available_j
  double tools_work_j = 0;
  double contacts_j = 0;  ///< the most that contacts with tools can hold
};

class Guard {
 public:
  explicit Guard(const model::Model& model);
  BoundCheck check(const solver::StepResult& result, const StepEnergy& energy) const;

 private:
  double max_move_m_, max_distance_m_, max_residual_, least_energy_j_;
  bool checks_energy_;
};

/// How a step that left its bounds is done again, from the state that it began with.
struct Retry {
  std::uint32_t steps;             ///< equal parts of dt
  std::uint32_t iteration_factor;  ///< of cg_max_iterations
  bool fallback_settings;          ///< StepInput::careful
  Breach only_for;                 ///< kNone: any
};
/// In this order. The first where iterations were lowered for a budget.
std::span<const Retry> retries();

/// A step that left its bounds.
struct GuardEvent {
  std::uint64_t step = 0;
  BoundCheck first, last;     ///< of the step itself, and of the last retry
  std::uint32_t retries = 0;  ///< that were made
  std::uint32_t steps = 0;    ///< of the last one
  bool recovered = false;
};
/// What happened; where nothing helped also where the scene stands and what to do.
std::string to_text(const GuardEvent& event);

}  // namespace tensormass::world
