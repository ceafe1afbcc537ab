#include <algorithm>
#include <string>

#include <fmt/format.h>

#include "core/finding_kinds.h"
#include "core/limits.h"
#include "model/compile_parts.h"
#include "tensormass/v1/scene.pb.h"

/// Finds what is probably a mistake in the bodies of a scene, and reads which findings the scene accepts.
namespace tensormass::model {

namespace {

/// A mesh in millimetres that was taken as metres.
void find_large_body(const ReadBody& body, std::vector<Finding>& findings) {
  Eigen::AlignedBox3d box;
  for (const Eigen::Vector3d& node : body.mesh.nodes) box.extend(node);
  const Eigen::Vector3d size_m = box.sizes();
  if (!(size_m.maxCoeff() > thresholds::kLargeBodyM)) return;
  findings.push_back(
      {.code = FindingCode::kMeshUnit,
       .value = size_m.maxCoeff(),
       .limit = thresholds::kLargeBodyM,
       .place = fmt::format("body '{}'.mesh.scale", body.name),
       .body = body.name,
       .message = fmt::format("body '{}' is {:.3g} × {:.3g} × {:.3g} m large and weighs {:.2g} kg, so its mesh is "
                              "probably in millimetres",
                              body.name, size_m[0], size_m[1], size_m[2], body.mass_kg),
       .remedy = "give its mesh scale: 0.001"});
}

/// Linear elements in full quadrature that cannot change their shape without changing their volume.
void find_locking(const ReadBody& body, std::vector<Finding>& findings) {
  if (body.quadrature != physics::Quadrature::kFull) return;
  std::uint32_t count = 0;
  double largest = 0, limit = 0;
  const mesh::Topology* shape = nullptr;
  const mesh::Topology& tetrahedron = mesh::topology(mesh::Shape::kTetrahedron);
  mesh::for_each_element(body.mesh, [&](std::uint32_t e, const mesh::Topology& of, std::span<const std::uint32_t>) {
    const double poisson = body.material(e).poisson_ratio;
    const double stands = &of == &tetrahedron ? thresholds::kLockingPoisson : thresholds::kLockingPoissonOfOthers;
    if (of.has_mid_edge_nodes() || !(poisson > stands)) return;
    ++count;
    shape = &of;
    limit = stands;
    largest = std::max(largest, poisson);
  });
  if (!(count > thresholds::kLockingPart * body.element_count)) return;
  findings.push_back(
      {.code = FindingCode::kLocking,
       .value = largest,
       .limit = limit,
       .place = fmt::format("body '{}'.quadrature", body.name),
       .body = body.name,
       .message = fmt::format("body '{}': linear elements ({}) in full quadrature lock at a Poisson's ratio of {:.5g}: "
                              "the body is twice too stiff or more",
                              body.name, shape->name, largest),
       .remedy = fmt::format("give it quadrature: selective{}",
                             shape == &tetrahedron ? ", or element_order: quadratic" : "")});
}

/// A law that gets softer where a tool presses it.
void find_softening_law(const ReadBody& body, std::vector<Finding>& findings) {
  physics::for_each_type(physics::Laws{}, [&](auto tag, int index) {
    using Law = typename decltype(tag)::Type;
    if constexpr (requires { Law::kLeastStretch; }) {
      const auto has_it = [index](const Material& material) { return material.law == index; };
      if (std::none_of(body.materials.begin(), body.materials.end(), has_it)) return;
      findings.push_back(
          {.code = FindingCode::kSofteningLaw,
           .value = Law::kLeastStretch,
           .limit = kind_of(FindingCode::kSofteningLaw).limit,
           .place = fmt::format("body '{}'.law", body.name),
           .body = body.name,
           .message = fmt::format("body '{}': {} gets softer where it is pressed to less than {} of its length, and a "
                                  "tool can press it so far",
                                  body.name, Law::kName, Law::kLeastStretch),
           .remedy = "take stable_neo_hookean or another law that stands compression"});
    }
  });
}

}  // namespace

Result<std::vector<AcceptedFinding>> read_accepted(const v1::Scene& scene, std::span<const ReadBody> bodies,
                                                   std::span<const ToolModel> tools) {
  if (static_cast<std::size_t>(scene.accepted_findings_size()) > limits::kMaxAcceptedFindings) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("scene.accepted_findings: {} exceed limits::kMaxAcceptedFindings = {}",
                            scene.accepted_findings_size(), limits::kMaxAcceptedFindings));
  }
  std::vector<AcceptedFinding> out;
  for (int i = 0; i < scene.accepted_findings_size(); ++i) {
    const v1::AcceptedFinding& accepted = scene.accepted_findings(i);
    const std::string where = fmt::format("scene.accepted_findings[{}]", i);
    const auto kind = std::find_if(kFindingKinds.begin(), kFindingKinds.end(), [&](const FindingKind& one) {
      return static_cast<int>(one.code) == static_cast<int>(accepted.code());
    });
    if (kind == kFindingKinds.end()) {
      return invalid(fmt::format("{}.code: {} is not given or unknown; docs/findings.md lists the codes", where,
                                 static_cast<int>(accepted.code())));
    }
    if (accepted.reason().empty()) {
      return invalid(fmt::format("{}.reason: say why {} is right for this scene", where, kind->name));
    }
    if (accepted.reason().size() > limits::kMaxReasonLength) {
      return invalid(fmt::format("{}.reason: {} bytes exceed limits::kMaxReasonLength = {}", where,
                                 accepted.reason().size(), limits::kMaxReasonLength));
    }
    const auto has = [](const auto& things, const std::string& name) {
      return name.empty() ||
             std::any_of(things.begin(), things.end(), [&](const auto& one) { return one.name == name; });
    };
    if (!has(bodies, accepted.body())) {
      return invalid(fmt::format("{}.body: the scene has no body '{}'", where, accepted.body()));
    }
    if (!has(tools, accepted.tool())) {
      return invalid(fmt::format("{}.tool: the scene has no tool '{}'", where, accepted.tool()));
    }
    out.push_back({kind->code, accepted.body(), accepted.tool(), accepted.reason()});
  }
  return out;
}

std::vector<Finding> find_mistakes_of_bodies(std::span<const ReadBody> bodies, bool has_moving_tool) {
  std::vector<Finding> findings;
  for (const ReadBody& body : bodies) {
    find_large_body(body, findings);
    find_locking(body, findings);
    if (has_moving_tool) find_softening_law(body, findings);
  }
  return findings;
}

}  // namespace tensormass::model
