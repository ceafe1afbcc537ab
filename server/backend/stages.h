#pragma once

#include "contact/spherical_probe.h"
#include "model/model.h"
#include "physics/lists.h"
#include "solver/advance.h"
#include "solver/conjugate_gradients.h"
#include "solver/jacobi_scaling.h"
#include "tensor/assembly.h"
#include "tensor/visible.h"

/// The stages as types, so that every backend runs the same functions: the CPU calls `run` with the team of a thread,
/// CUDA instantiates a kernel for each type. kExchanges marks the stages whose patches talk to each other while they
/// run.
namespace tensormass::backend {

using tensor::ElementView;
using tensor::SceneView;

#define TM_STAGE(Name, exchanges, call)                                                              \
  struct Name {                                                                                      \
    static constexpr bool kExchanges = exchanges;                                                    \
    template <class Team, class Real>                                                                \
    TM_HOST_DEVICE static void run(Team& team, const SceneView<Real>& s, const ElementView<Real>&) { \
      call(team, s);                                                                                 \
    }                                                                                                \
  }

TM_STAGE(DetectContact, false, contact::detect);
TM_STAGE(RespondContact, false, contact::respond);
TM_STAGE(AssembleConstant, false, (tensor::assemble<true, false>));
TM_STAGE(AssemblePartial, false, (tensor::assemble<false, true>));
TM_STAGE(AssembleBoth, false, (tensor::assemble<true, true>));
TM_STAGE(ExternalForces, false, tensor::add_external_forces);
TM_STAGE(AssembleContact, false, contact::assemble);
TM_STAGE(Factorize, false, solver::factorize);
TM_STAGE(ScaleEdges, false, solver::scale_edges);
TM_STAGE(Solve, true, solver::conjugate_gradients);
TM_STAGE(Advance, false, solver::advance);
TM_STAGE(MeasureContact, false, contact::measure);
TM_STAGE(GatherVisible, false, tensor::gather_visible);

#undef TM_STAGE

template <class Shape, class Law>
struct Elements {
  static constexpr bool kExchanges = false;
  template <class Team, class Real>
  TM_HOST_DEVICE static void run(Team& team, const SceneView<Real>& s, const ElementView<Real>& e) {
    tensor::element_pass<Shape, Law>(team, s, e);
  }
};

/// Calls visit(stage type) for a stage of a model.
template <class Visit>
void with_stage(const model::Model& m, const model::Stage& stage, Visit&& visit) {
  using model::StageKind;
  switch (stage.kind) {
    case StageKind::kDetectContact:
      return visit(DetectContact{});
    case StageKind::kRespondContact:
      return visit(RespondContact{});
    case StageKind::kElements:
      return physics::with_shape_and_law(m.groups[stage.group].shape, m.groups[stage.group].law,
                                         [&](auto shape, auto law) {
                                           using Law = typename decltype(law)::Type;
                                           if constexpr (!Law::kConstantStiffness)
                                             visit(Elements<typename decltype(shape)::Type, Law>{});
                                         });
    case StageKind::kAssemble:
      if (m.groups.empty()) return visit(AssembleConstant{});
      if (m.constant_edges.empty()) return visit(AssemblePartial{});
      return visit(AssembleBoth{});
    case StageKind::kExternalForces:
      return visit(ExternalForces{});
    case StageKind::kAssembleContact:
      return visit(AssembleContact{});
    case StageKind::kFactorize:
      return visit(Factorize{});
    case StageKind::kScaleEdges:
      return visit(ScaleEdges{});
    case StageKind::kSolve:
      return visit(Solve{});
    case StageKind::kAdvance:
      return visit(Advance{});
    case StageKind::kMeasureContact:
      return visit(MeasureContact{});
  }
}

}  // namespace tensormass::backend
