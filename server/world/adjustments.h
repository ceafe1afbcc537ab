#pragma once

#include "core/result.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/scene.pb.h"

/// What can change in a scene that steps: gravity, stiffness and damping of each body, cuts (cuts.h), tools
/// (tool_changes.h), and attachments beside those that were loaded (attachment_changes.h).
///
/// An adjusted scene is the loaded scene's message with other values. model/values.h makes its numbers, and a compile
/// those that need other buffers. So nothing but this file knows which values may change, and no backend does.
namespace tensormass::world {

/// Range of a body's stiffness factor.
inline constexpr double kMinStiffnessFactor = 1e-3;
inline constexpr double kMaxStiffnessFactor = 1e3;

/// Factor by which stiffness changes at once while a tool touches tissue: what touches holds energy, and stiffer tissue
/// holds more of it. A larger change comes in parts, kBetweenPartsS of simulated time apart.
inline constexpr double kMaxStiffnessFactorOfPart = 1.25;
inline constexpr double kBetweenPartsS = 0.01;

/// Returns the values of a scene as it was loaded. All factors are 1.
v1::SceneAdjustments adjustments_of(const v1::Scene& loaded);
/// Returns `present` with the fields that `changes` has. Fails for a body that is unknown or named twice, and for a
/// factor outside its range. The compiler of scenes checks all other values.
Result<v1::SceneAdjustments> with_changes(v1::SceneAdjustments present, const v1::SceneAdjustments& changes);
/// Returns `wanted` with the cuts, tools and attachments of `present`.
v1::SceneAdjustments with_edits_of(const v1::SceneAdjustments& present, v1::SceneAdjustments wanted);
/// The same, but with stiffness factors that differ from those of `present` by at most kMaxStiffnessFactorOfPart.
v1::SceneAdjustments next_part(const v1::SceneAdjustments& present, const v1::SceneAdjustments& wanted);
/// Returns whether two values of a scene have the same tools and attachments.
bool same_parts(const v1::SceneAdjustments& one, const v1::SceneAdjustments& other);
/// Returns the loaded scene with these values.
v1::Scene adjusted(const v1::Scene& loaded, const v1::SceneAdjustments& adjustments);

}  // namespace tensormass::world
