#pragma once

#include "view/balance.h"
#include "view/boundary.h"
#include "view/contact.h"
#include "view/elements.h"
#include "view/guard.h"
#include "view/links.h"
#include "view/matrix.h"
#include "view/newton.h"
#include "view/patches.h"
#include "view/solve.h"
#include "view/state.h"
#include "view/surface.h"

/// The data of a scene that stages read and write: plain pointers to host or device memory, in one precision.
///
/// 1. A stage takes the parts that it may touch, not the whole. Its signature then says what it may read and write.
///    step/run.h passes exactly those parts.
/// 2. A scene that does not use a part has null pointers there. No buffer exists for it, and no stage reads it.
/// 3. model/bind.h fills a view and allocates its buffers, for host memory, device memory and the plan of `tensormass
///    inspect` alike. They can therefore not disagree.
///
///   patches ──────> who owns which rows
///   state ────────> u, v, rest positions, masses        a StateView reads, a StateWriter moves rows
///   elements ─────> groups of (shape, law)              one ElementView each, beside the scene
///   matrix ───────> A and b                             elements, loads and contact add to it
///   solve ────────> conjugate gradients                 Â x = b̂
///   newton, guard, contact, links, balance, prescribed, pressure, surface: only in scenes that use them
///
/// A kernel takes the view by value, as its parameter.
namespace tensormass::view {

template <class Real>
struct SceneView {
  PatchesView patches;
  StateWriter<Real> state;
  MatrixView<Real> matrix;
  SolveView<Real> solve;
  NewtonView<Real> newton;
  GuardView<Real> guard;
  ContactView<Real> contact;
  LinksView<Real> links;
  BalanceView<Real> balance;
  PrescribedView<Real> prescribed;
  PressureView<Real> pressure;
  SurfaceView<Real> surface;
};

}  // namespace tensormass::view
