#pragma once

#include <string_view>

#include "core/findings.h"

namespace tensormass::v1 {
class Finding;
class SceneReport;
class SceneStatus;
}  // namespace tensormass::v1

/// Findings as messages. A warning is the text of a finding that the scene does not accept, so that no text is written
/// twice.
namespace tensormass::step {

v1::Finding to_message(const Finding& finding);

/// Adds a finding of the load, with its warning.
void add(const Finding& finding, v1::SceneReport& report);
/// Adds a finding about the results, with its warning.
void add(const Finding& finding, v1::SceneStatus& status);
/// Adds a finding of the load. Its warning is in the report.
void add_of_load(const Finding& finding, v1::SceneStatus& status);

/// Returns the name of a finding's kind, as in kFindingKinds.
std::string_view name_of(const v1::Finding& finding);
/// Returns whether a finding is about results of steps, not about the scene as it was loaded.
bool is_of_results(const v1::Finding& finding);

}  // namespace tensormass::step
