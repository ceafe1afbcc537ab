#pragma once

#include <type_traits>

#include "contact/assembly.h"
#include "contact/balance.h"
#include "contact/links.h"
#include "contact/tools.h"
#include "matrix/edge_assembly.h"
#include "matrix/rows.h"
#include "physics/lists.h"
#include "solver/balance.h"
#include "solver/conjugate_gradients.h"
#include "solver/jacobi_scaling.h"
#include "solver/newton_stages.h"
#include "solver/time_scheme.h"
#include "step/diagnostics.h"
#include "step/inversion_check.h"
#include "step/loads.h"
#include "step/stages.h"
#include "step/visible_surface.h"

/// Runs the stages of the table (stages.h). Each line of RunStage passes a stage exactly the parts of the scene that it
/// may touch.
///
///   Stage (a row of the table, its group) ──with_stage──> RunStage<kind, shape> ──run(team, scene, group)──> function
///   chosen when the scene is compiled                     a type: one instance      once for each patch, by its team
///                                                         or kernel each
///
///   team   the thread (CPU, backend/cpu/team.h) or the thread block (CUDA, backend/cuda/team.cuh) that runs one patch
///
/// The coarse level and its row errors are not here either: the CPU's backend runs them while a solve needs them.
///
/// Two scopes are not here, because the backends have code of their own for them: kShapeAndLaw (element passes, which
/// are compiled in a file each) and kFusedOnDevice (kernels of a GPU). run() then does nothing.
namespace tensormass::step {

/// A stage as a type. Shape: the group's shape, for stages of Scope::kShape.
template <StageKind kKind, class Shape = void>
struct RunStage {
  static constexpr const StageInfo& kInfo = info(kKind);

  template <class Team, class Real>
  TM_HOST_DEVICE static void run(Team& team, const view::SceneView<Real>& s,
                                 [[maybe_unused]] const view::ElementView<Real>& e) {
    using K = StageKind;
    constexpr bool kIsCpu = requires { Team::kOneThread; };
    if constexpr (kKind == K::kPredict) solver::predict(team, s.patches, s.state, s.guard);
    if constexpr (kKind == K::kBeginBalance) contact::begin_balance(team, s.patches, s.state, s.balance);
    if constexpr (kKind == K::kPrescribe) solver::prescribe(team, s.state, s.prescribed);
    if constexpr (kKind == K::kQueryClosest) contact::query_closest(team, s.patches, s.state, s.contact);
    if constexpr (kKind == K::kGenerateContacts) contact::generate_contacts(team, s.patches, s.state, s.contact);
    if constexpr (kKind == K::kBeginLinks) contact::begin_links(team, s.patches, s.state, s.contact, s.links);
    if constexpr (kKind == K::kFindLinks) contact::find_links(team, s.state, s.contact, s.links);
    if constexpr (kKind == K::kBeginEdges && kIsCpu) matrix::begin_edges(team, s.patches, s.state, s.matrix, s.newton);
    if constexpr (kKind == K::kDecompose) matrix::decompose<Shape>(team, s.patches, s.state, e);
    if constexpr (kKind == K::kFinishRows) matrix::finish_rows(team, s.patches, s.state, s.matrix, s.newton);
    if constexpr (kKind == K::kExternalForces) step::add_external_forces(team, s.patches, s.state, s.matrix);
    if constexpr (kKind == K::kPressure) step::add_pressure(team, s.state, s.matrix, s.newton, s.pressure);
    if constexpr (kKind == K::kAssembleContact) contact::assemble(team, s.patches, s.state, s.matrix, s.contact);
    if constexpr (kKind == K::kAssembleLinks) contact::assemble_links(team, s.state, s.matrix, s.links);
    if constexpr (kKind == K::kMeasureResidual) solver::measure_residual(team, s.patches, s.state, s.matrix, s.newton);
    if constexpr (kKind == K::kFactorize) solver::factorize(team, s.patches, s.state, s.matrix);
    if constexpr (kKind == K::kScaleEdges) solver::scale_edges(team, s.patches, s.matrix);
    if constexpr (kKind == K::kSolve) solver::conjugate_gradients(team, s.patches, s.state, s.matrix, s.solve, s.links);
    if constexpr (kKind == K::kAdvance) solver::advance(team, s.patches, s.state, s.matrix, s.solve, s.newton, s.guard);
    if constexpr (kKind == K::kBacktrack) solver::backtrack(team, s.patches, s.state, s.newton, s.guard);
    if constexpr (kKind == K::kMeasureBalance)
      contact::measure_balance(team, s.patches, s.state, s.contact, s.links, s.balance);
    if constexpr (kKind == K::kSolveBalance) contact::solve_balance(team, s.patches, s.state, s.balance);
    if constexpr (kKind == K::kApplyBalance) solver::apply_balance(team, s.patches, s.state, s.guard, s.balance);
    if constexpr (kKind == K::kMeasureContact) contact::measure(team, s.patches, s.state, s.contact, s.balance);
    if constexpr (kKind == K::kMeasureLinks) contact::measure_links(team, s.state, s.contact, s.links);
    if constexpr (kKind == K::kExtrapolate) solver::extrapolate(team, s.patches, s.state, s.guard);
    if constexpr (kKind == K::kCheckInversion) step::check_inversion<Shape>(team, s.patches, s.state, s.guard, e);
    if constexpr (kKind == K::kGatherSurface) step::gather_surface(team, s.patches, s.state, s.surface);
  }
};

/// Finds the type of a stage.
///
///   visit(RunStage<..>{})   called once; not called for Scope::kShapeAndLaw and kFusedOnDevice, which the backends run
///                           with code of their own
template <class Visit>
void with_stage(const model::Model& m, const Stage& stage, const Visit& visit) {
  const auto try_kind = [&](auto kind) {
    constexpr auto kKind = static_cast<StageKind>(decltype(kind)::value);
    if (stage.info->kind != kKind) return;
    if constexpr (info(kKind).scope == Scope::kScene) visit(RunStage<kKind>{});
    if constexpr (info(kKind).scope == Scope::kShape) {
      physics::for_each_type(physics::Shapes{}, [&](auto shape, int index) {
        if (index == m.groups[stage.group].shape) visit(RunStage<kKind, typename decltype(shape)::Type>{});
      });
    }
  };
  [&]<int... Kind>(std::integer_sequence<int, Kind...>) { (try_kind(std::integral_constant<int, Kind>{}), ...); }
  (std::make_integer_sequence<int, kStageKinds>{});
}

}  // namespace tensormass::step
