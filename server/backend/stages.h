#pragma once

#include "contact/spherical_probe.h"
#include "model/model.h"
#include "physics/lists.h"
#include "solver/advance.h"
#include "solver/conjugate_gradients.h"
#include "solver/jacobi_scaling.h"
#include "tensor/assembly.h"
#include "tensor/check_volume.h"
#include "tensor/rows.h"
#include "tensor/visible.h"

/// The stages as types, so that every backend runs the same functions: the CPU calls `run` with the team of a thread,
/// CUDA instantiates a kernel for each type.
namespace tensormass::backend {

using tensor::ElementView;
using tensor::SceneView;

/// What the patches of a stage do beyond their own loops.
enum class Communication {
  kNone,
  kReduces,         ///< a patch reduces over its own items
  kReducesInParts,  ///< as many times as the team has parts of a patch, over the items of each
  kExchanges,       ///< patches talk to each other while they run
};

#define TM_STAGE(Name, communication, call)                                                          \
  struct Name {                                                                                      \
    static constexpr Communication kCommunication = Communication::communication;                    \
    template <class Team, class Real>                                                                \
    TM_HOST_DEVICE static void run(Team& team, const SceneView<Real>& s, const ElementView<Real>&) { \
      call(team, s);                                                                                 \
    }                                                                                                \
  }

TM_STAGE(Predict, kNone, solver::predict);
TM_STAGE(Drive, kNone, solver::drive);
TM_STAGE(DetectContact, kReduces, contact::detect);
TM_STAGE(RespondContact, kNone, contact::respond);
TM_STAGE(ExternalForces, kNone, tensor::add_external_forces);
TM_STAGE(Pressure, kNone, tensor::add_pressure);
TM_STAGE(AssembleContact, kNone, contact::assemble);
TM_STAGE(MeasureResidual, kReduces, solver::measure_residual);
TM_STAGE(Factorize, kNone, solver::factorize);
TM_STAGE(ScaleEdges, kNone, solver::scale_edges);
TM_STAGE(Solve, kExchanges, solver::conjugate_gradients);
TM_STAGE(Advance, kReduces, solver::advance);
TM_STAGE(Backtrack, kReduces, solver::backtrack);
TM_STAGE(MeasureContact, kReduces, contact::measure);
TM_STAGE(GatherVisible, kNone, tensor::gather_visible);

#undef TM_STAGE

/// The part of the system that is not refreshed: before the elements where they add to it, else behind them.
template <bool HasConstant>
struct Assemble {
  static constexpr Communication kCommunication = Communication::kNone;
  template <class Team, class Real>
  TM_HOST_DEVICE static void run(Team& team, const SceneView<Real>& s, const ElementView<Real>&) {
    if constexpr (requires { Team::kOneThread; }) {
      tensor::begin_edges<HasConstant>(team, s);
    } else {
      tensor::finish_rows<HasConstant>(team, s);
    }
  }
};

/// Of the elements of one shape.
#define TM_STAGE_OF_SHAPE(Name, communication, call)                                                   \
  template <class Shape>                                                                               \
  struct Name {                                                                                        \
    static constexpr Communication kCommunication = Communication::communication;                      \
    template <class Team, class Real>                                                                  \
    TM_HOST_DEVICE static void run(Team& team, const SceneView<Real>& s, const ElementView<Real>& e) { \
      call<Shape>(team, s, e);                                                                         \
    }                                                                                                  \
  }

TM_STAGE_OF_SHAPE(CheckVolume, kReducesInParts, tensor::check_volume);
/// Before kElements, for a group with decompositions.
TM_STAGE_OF_SHAPE(Decompose, kNone, tensor::decompose);

#undef TM_STAGE_OF_SHAPE

/// Calls visit(stage type) for a stage of a model. Not for kElements and kWatch, which are many: each backend compiles
/// them law by law (elements.h of its folder).
template <class Visit>
void with_stage(const model::Model& m, const model::Stage& stage, Visit&& visit) {
  using model::StageKind;
  switch (stage.kind) {
    case StageKind::kPredict:
      return visit(Predict{});
    case StageKind::kDrive:
      return visit(Drive{});
    case StageKind::kDetectContact:
      return visit(DetectContact{});
    case StageKind::kRespondContact:
      return visit(RespondContact{});
    case StageKind::kElements:
    case StageKind::kWatch:
      return;
    case StageKind::kAssemble:
      return m.constant_edges.empty() ? visit(Assemble<false>{}) : visit(Assemble<true>{});
    case StageKind::kExternalForces:
      return visit(ExternalForces{});
    case StageKind::kPressure:
      return visit(Pressure{});
    case StageKind::kAssembleContact:
      return visit(AssembleContact{});
    case StageKind::kMeasureResidual:
      return visit(MeasureResidual{});
    case StageKind::kFactorize:
      return visit(Factorize{});
    case StageKind::kScaleEdges:
      return visit(ScaleEdges{});
    case StageKind::kSolve:
      return visit(Solve{});
    case StageKind::kAdvance:
      return visit(Advance{});
    case StageKind::kBacktrack:
      return visit(Backtrack{});
    case StageKind::kMeasureContact:
      return visit(MeasureContact{});
    case StageKind::kCheckVolume:
      return physics::for_each_type(physics::Shapes{}, [&](auto shape, int index) {
        if (index == m.groups[stage.group].shape) visit(CheckVolume<typename decltype(shape)::Type>{});
      });
  }
}

}  // namespace tensormass::backend
