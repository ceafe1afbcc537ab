#pragma once

#include <cstdint>
#include <string>
#include <vector>

/// Findings: what is probably a mistake in a scene, or wrong with its results.
///
///     mesh, model   make findings while a scene is compiled   --> Model::findings --+
///     world         makes findings about the last steps       ----------------------+--> step/finding_message.h:
///                                                                   report, status, log, and the warnings in words
///
/// core/finding_kinds.h lists every kind with its threshold.
namespace tensormass {

/// The kinds of findings, with the numbers of v1::FindingCode.
enum class FindingCode : std::uint8_t {
  kMeshUnit = 1,
  kLocking = 2,
  kToolInsideTissue = 3,
  kBodyPassesTool = 4,
  kCoarseSurface = 5,
  kSofteningLaw = 6,
  kOverlap = 7,
  kSlivers = 8,
  kSeparateParts = 9,
  kFlatSkinTriangles = 10,
  kUnusedSkinVertices = 11,
  kUnpairedElements = 12,
  kThinTool = 13,
  kReducedQuadrature = 14,
  kLooseBody = 15,
  kSolveAboveTolerance = 32,
  kUnconvergedStep = 33,
  kNegativeCurvature = 34,
  kLawRange = 35,
  kLawSoftens = 36,
  kInvertedElements = 37,
  kRepeatedSteps = 38,
  kLoweredIterations = 39,
  kBudgetExceeded = 40,
};

/// One finding. Names are empty where it concerns none.
struct Finding {
  FindingCode code{};
  double value = 0;
  double limit = 0;     ///< in the unit of its kind, as the value
  std::string place{};  ///< field of the scene, such as "body 'liver'.quadrature"
  std::string body{}, other{}, tool{};
  std::string message{};
  std::string remedy{};
  std::string accepted{};  ///< why the scene accepts it; empty: it does not

  /// Returns one line for people.
  std::string text() const { return message + "; " + remedy; }
};

/// A finding that the author of a scene accepts. An empty name stands for any.
struct AcceptedFinding {
  FindingCode code{};
  std::string body{}, tool{};
  std::string reason{};
};

/// Writes the reason into a finding that the scene accepts.
inline void accept(Finding& finding, const std::vector<AcceptedFinding>& accepted) {
  for (const AcceptedFinding& one : accepted) {
    const bool same_body = one.body.empty() || one.body == finding.body || one.body == finding.other;
    const bool same_tool = one.tool.empty() || one.tool == finding.tool;
    if (one.code == finding.code && same_body && same_tool) finding.accepted = one.reason;
  }
}

}  // namespace tensormass
