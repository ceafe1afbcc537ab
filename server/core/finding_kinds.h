#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <string_view>

#include "core/findings.h"

/// One list, kFindingKinds, has every kind of finding with its threshold. The protocol's FindingCode and
/// docs/findings.md follow it; tests compare them. A threshold has a name and, beside it, where it comes from.
namespace tensormass {

namespace thresholds {

/// Longest side of a body [m]. `tensormass mesh` takes larger meshes as millimetres, too (mesh_units.py).
inline constexpr double kLargeBodyM = 5;
/// Poisson's ratio of linear tetrahedra in full quadrature, and of other linear shapes. A beam is then about twice too
/// stiff (docs/findings.md).
inline constexpr double kLockingPoisson = 0.47, kLockingPoissonOfOthers = 0.498;
/// Fraction of a body's elements that may lock without a finding. An irregular mesh leaves up to 0.02 without a
/// partner.
inline constexpr double kLockingPart = 0.1;
/// Depth of tissue inside a tool at the start, in radii (of a solid in halves of its thickness). From there on the
/// contact of a tool hardens (physics::kHardeningBegins).
inline constexpr double kStartDepthInRadii = 0.25;
/// Way of a free body in a step where it reaches a thin tool (physics/tool/tool.h), as a part of the tool's thickness.
/// Rods hold a cube that moves by 0.7 of their thickness, and cut into one that moves by 1.3 of it. Solids follow the
/// way of the tissue (physics/tool/solid.h), so nothing passes them.
inline constexpr double kPassingWay = 1;
/// Edge of a surface's triangles, as a part of a tool's width. A ball then feels 15 % more or less force from place to
/// place, if it is pressed in by 0.8 of its radius, and 40 % if by 0.3 (docs/findings.md).
inline constexpr double kCoarseEdge = 0.65;
/// Depth of a node inside another body, as a part of the smaller mean edge of the two surfaces. A contact begins to
/// push there, unless the scene says otherwise.
inline constexpr double kOverlapInEdges = 0.1;
/// Smallest dihedral angle of an element [degrees]. Slivers make the system ill-conditioned and the result inaccurate.
inline constexpr double kSliverDihedralDeg = 5;
/// Thickness of a tool's surface, in cubes of the grid that samples its distance.
inline constexpr double kThinToolCubes = 3;
/// Fraction of the last solves, or steps.
inline constexpr double kMax = 0.5;

}  // namespace thresholds

/// A kind of finding.
struct FindingKind {
  /// A finding is shown if its value is above, or below, its limit.
  enum class Shown : std::uint8_t { kAbove, kBelow };

  FindingCode code;
  std::string_view name;  ///< that of the protocol without its prefix, in lower case
  bool at_load;           ///< else while the scene steps
  std::string_view value;
  std::string_view unit;  ///< unit of value and limit; empty: a ratio or a count
  Shown shown;
  double limit;               ///< NaN: the scene gives it, or its law
  std::string_view limit_is;  ///< where the limit comes from, for docs/findings.md
};

namespace detail {
inline constexpr auto kAbove = FindingKind::Shown::kAbove, kBelow = FindingKind::Shown::kBelow;
inline constexpr double kNoLimit = std::numeric_limits<double>::quiet_NaN();
using enum FindingCode;
}  // namespace detail

/// Every kind of finding, in the order of the protocol.
inline constexpr std::array<FindingKind, 24> kFindingKinds{{
    {detail::kMeshUnit, "mesh_unit", true, "longest side of a body", "m", detail::kAbove, thresholds::kLargeBodyM,
     "as `tensormass mesh` guesses: no organ is longer, and no organ in millimetres is shorter"},
    {detail::kLocking, "locking", true,
     "Poisson's ratio of more than a tenth of a body's elements: linear tetrahedra in full quadrature", "",
     detail::kAbove, thresholds::kLockingPoisson,
     "a beam is twice too stiff, [measured](#locking); other linear shapes: 0.498"},
    {detail::kToolInsideTissue, "tool_inside_tissue", true,
     "depth of tissue inside a tool at the start, in radii or halves of its thickness", "", detail::kAbove,
     thresholds::kStartDepthInRadii, "contact hardens from there on; a middle inside the tissue counts as 1"},
    {detail::kBodyPassesTool, "body_passes_tool", true,
     "way of a free body in the step in which it reaches a sphere, a rod or jaws, in thicknesses of the tool", "",
     detail::kAbove, thresholds::kPassingWay,
     "a rod cuts into a cube that moves by 1.3 thicknesses a step, and holds it at 0.7; nothing passes a solid"},
    {detail::kCoarseSurface, "coarse_surface", true, "edge of the surface's triangles, in widths of a tool", "",
     detail::kAbove, thresholds::kCoarseEdge,
     "the force differs by 15 % from place to place, [measured](#coarse-triangles)"},
    {detail::kSofteningLaw, "softening_law", true, "stretch below which a law gets softer, if a tool moves", "",
     detail::kAbove, 0, "1/√3 for St-Venant-Kirchhoff; an ordinary press goes below"},
    {detail::kOverlap, "overlap", true, "depth of a node inside another body", "m", detail::kAbove, detail::kNoLimit,
     "a tenth of the smaller mean edge; with a contact between the two its `distance_m`"},
    {detail::kSlivers, "slivers", true, "smallest dihedral angle", "degree", detail::kBelow,
     thresholds::kSliverDihedralDeg, "such elements slow the solver down"},
    {detail::kSeparateParts, "separate_parts", true, "parts of a body that share no node", "", detail::kAbove, 1, ""},
    {detail::kFlatSkinTriangles, "flat_skin_triangles", true, "triangles of a skin without area", "", detail::kAbove, 0,
     ""},
    {detail::kUnusedSkinVertices, "unused_skin_vertices", true, "vertices of a skin without triangle", "",
     detail::kAbove, 0, ""},
    {detail::kUnpairedElements, "unpaired_elements", true,
     "part of a body's elements above ν = 0.49 that selective quadrature finds no partner for", "", detail::kAbove,
     thresholds::kLockingPart, "an irregular mesh leaves up to 0.02"},
    {detail::kThinTool, "thin_tool", true, "thickness of a tool's surface, in cubes of its grid", "", detail::kBelow,
     thresholds::kThinToolCubes, "tissue may pass through"},
    {detail::kReducedQuadrature, "reduced_quadrature", true, "bodies in reduced quadrature", "", detail::kAbove, 0,
     "the mesh may fold in zigzag"},
    {detail::kLooseBody, "loose_body", true, "bodies without fixed nodes at equilibrium", "", detail::kAbove, 0, ""},
    {detail::kSolveAboveTolerance, "solve_above_tolerance", false,
     "part of the last solves (at most 64) that end above `cg_tolerance`", "", detail::kAbove, thresholds::kMax,
     "most of them"},
    {detail::kUnconvergedStep, "unconverged_step", false, "residual of Newton's method in the last step", "",
     detail::kAbove, detail::kNoLimit, "`newton_tolerance`"},
    {detail::kNegativeCurvature, "negative_curvature", false, "directions of negative curvature in the last solve", "",
     detail::kAbove, 0, "the solve ends there"},
    {detail::kLawRange, "law_range", false, "part of the strains or rotations that a law stands", "", detail::kAbove, 1,
     "the law states them"},
    {detail::kLawSoftens, "law_softens", false, "smallest stretch of an element", "", detail::kBelow, detail::kNoLimit,
     "1/√3 for St-Venant-Kirchhoff"},
    {detail::kInvertedElements, "inverted_elements", false, "smallest det F of an element", "", detail::kBelow, 0, ""},
    {detail::kRepeatedSteps, "repeated_steps", false, "part of the last 64 steps that the guard repeats", "",
     detail::kAbove, thresholds::kMax, "most of them"},
    {detail::kLoweredIterations, "lowered_iterations", false, "limit of iterations that the budget leaves", "",
     detail::kBelow, detail::kNoLimit, "`cg_max_iterations`"},
    {detail::kBudgetExceeded, "budget_exceeded", false, "time of a step", "s", detail::kAbove, detail::kNoLimit,
     "`budget_s`"},
}};

/// Returns what the list says of a kind.
constexpr const FindingKind& kind_of(FindingCode code) {
  return *std::find_if(kFindingKinds.begin(), kFindingKinds.end(),
                       [code](const FindingKind& kind) { return kind.code == code; });
}

}  // namespace tensormass
