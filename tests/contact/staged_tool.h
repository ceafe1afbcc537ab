#pragma once

#include "backend/step_reports.h"
#include "support/staged_scene.h"

/// The first tool of a staged scene, between the steps that a test runs.
namespace tensormass::contact {

/// Puts the shape of the tool at a pose. start: its pose at the start of the coming step.
inline void place(tests::StagedScene<double>& staged, const physics::Pose& shape, const physics::Pose& start) {
  physics::PlacedTool<double>& tool = staged.inputs.tools[0];
  tool = staged.model.tools[0].placed<double>(shape, start);
  tool.samples = staged.view.contact.samples;
}
/// Puts it there without motion in the coming step.
inline void place(tests::StagedScene<double>& staged, const physics::Pose& shape) { place(staged, shape, shape); }

inline backend::ToolForce measured(const tests::StagedScene<double>& staged) {
  backend::ToolForce force;
  backend::read_forces<double>({staged.view.contact.tool_loads, staged.view.patches.patch_count}, {&force, 1});
  return force;
}

}  // namespace tensormass::contact
