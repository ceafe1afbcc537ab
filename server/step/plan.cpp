#include "step/plan.h"

#include <algorithm>
#include <limits>
#include <numeric>

#include <fmt/format.h>

#include "model/bind.h"
#include "physics/lists.h"
#include "step/finding_message.h"
#include "tensormass/v1/control.pb.h"

namespace tensormass::step {

namespace {

/// An arena that allocates nothing and lists the buffers that a scene asks for.
class CountingArena {
 public:
  explicit CountingArena(v1::SceneReport& report) : report_(report) {}

  template <class T, class U>
  T* constant(std::string_view name, const std::vector<U>& items) {
    return zeros<T>(name, items.size());
  }
  template <class T, class Fill>
  T* generated(std::string_view name, std::size_t count, const Fill&) {
    return zeros<T>(name, count);
  }
  template <class T>
  T* zeros(std::string_view name, std::size_t count) {
    if (count == 0) return nullptr;
    v1::PlanBuffer& buffer = *report_.add_buffers();
    buffer.set_name(std::string(name));
    buffer.set_bytes(count * sizeof(T));
    report_.set_bytes_total(report_.bytes_total() + count * sizeof(T));
    return nullptr;
  }

 private:
  v1::SceneReport& report_;
};

template <class Real>
void bind_all(const model::Model& model, CountingArena& arena) {
  model::bind<Real>(model, arena);
  for (std::size_t group = 0; group < model.groups.size(); ++group) model::bind<Real>(model, group, arena);
  model::bind_coarse<Real>(model, arena);
}

std::string_view own_damping(model::Integrator integrator) {
  switch (integrator) {
    case model::Integrator::kBdf2:
      return "BDF2 hardly damps by itself";
    case model::Integrator::kImplicitMidpoint:
      return "the implicit midpoint rule does not damp by itself";
    default:
      return "implicit Euler damps by itself";
  }
}

void list_without_self_contact(const model::Model& m, v1::SceneReport& report) {
  for (std::size_t side = 0; side < m.links.side_groups.size(); side += 3) {
    if (m.links.side_groups[side + 2] != 0) return;
  }
  report.add_not_modelled("self-contact: no body_contacts of a body with itself");
}

void list_not_modelled(const model::Model& m, v1::SceneReport& report) {
  if (m.tools.empty())
    report.add_not_modelled("contact with tools: the scene has none; no contact stage, no contact buffer");
  if (m.bodies.size() > 1 && m.links.candidate_count() == 0)
    report.add_not_modelled("contact between bodies: no body_contacts, so they pass through each other");
  list_without_self_contact(m, report);
  if (!m.tools.empty() && !m.has_friction()) report.add_not_modelled("friction: no tool has a friction_coefficient");
  if (m.external.empty() && m.pressure.faces.empty())
    report.add_not_modelled("gravity and loads: the scene names none");
  bool damped = false;
  for (std::size_t row = 0; row < m.layout.row_count; ++row) {
    damped = damped || m.inertia[4 * row + 1] != 0 || m.inertia[4 * row + 2] != 0;
  }
  if (m.quasi_static()) {
    report.add_not_modelled("inertia and damping: each step is an equilibrium");
  } else if (!damped) {
    // Not as an argument: without memory for an element, protobuf 3.21 would destroy one that it does not have.
    *report.add_not_modelled() = fmt::format("Rayleigh damping: the scene names none; {}", own_damping(m.integrator));
  }
  if (std::all_of(m.groups.begin(), m.groups.end(), [](const model::ElementGroup& g) { return g.prony.empty(); })) {
    report.add_not_modelled("viscosity: no law has prony terms");
  }
  if (!m.pressure.conserves_energy) {
    report.add_not_modelled(
        "the stiffness of pressure where the pressed surface has a free rim: Newton's method takes more iterations");
  }
  const bool is_cut = m.editing && m.edit_tables == nullptr;  // scenes that are cut have no tables to be edited with
  report.add_not_modelled(is_cut ? "plasticity and tearing" : "plasticity, cutting and tearing");
  if (is_cut) report.add_not_modelled("contact of the flaps of a cut with each other: they pass through");
  if (m.frame_rate_hz == 0) report.add_not_modelled("frames: frame_rate_hz is 0; no surface is gathered");
}

/// Lists how stiff contact is where surfaces can touch.
void list_contacts(const model::Model& m, v1::SceneReport& report) {
  const auto add = [&](const auto& contact, double least_pa, double most_pa) {
    v1::ContactReport& out = *report.add_contacts();
    out.set_least_penalty_pa_per_m(contact.penalty_pa_per_m + contact.penalty_per_m * least_pa);
    out.set_most_penalty_pa_per_m(contact.penalty_pa_per_m + contact.penalty_per_m * most_pa);
    out.set_is_default(contact.penalty_per_m > 0);
    return &out;
  };
  double least_pa = std::numeric_limits<double>::infinity(), most_pa = 0;
  for (const model::BodyModel& body : m.bodies) {
    least_pa = std::min(least_pa, body.least_surface_modulus_pa);
    most_pa = std::max(most_pa, body.most_surface_modulus_pa);
  }
  for (const model::ToolModel& tool : m.tools) add(tool, least_pa, most_pa)->set_tool(tool.name);
  for (const model::BodyContactModel& contact : m.body_contacts) {
    const model::BodyModel &a = m.bodies[contact.body], &b = m.bodies[contact.other];
    v1::ContactReport& out = *add(contact, std::min(a.least_surface_modulus_pa, b.least_surface_modulus_pa),
                                  std::min(a.most_surface_modulus_pa, b.most_surface_modulus_pa));
    out.set_body(a.name);
    out.set_other(b.name);
  }
}

}  // namespace

v1::SceneReport make_report(const model::Model& model, const MachineRates& machine) {
  v1::SceneReport report;
  report.set_scene(model.name);
  for (const model::BodyModel& body : model.bodies) {
    v1::BodyReport& out = *report.add_bodies();
    out.set_name(body.name);
    out.set_node_count(body.node_count);
    out.set_element_count(body.element_count);
    out.set_fixed_node_count(body.fixed_node_count);
    out.set_component_count(body.component_count);
    out.set_volume_m3(body.volume_m3);
    out.set_mass_kg(body.mass_kg);
    out.set_min_dihedral_angle_deg(body.min_dihedral_angle_deg);
    out.set_surface_vertex_count(body.vertex_count);
    out.set_surface_triangle_count(static_cast<std::uint32_t>(body.triangles.size()));
  }

  double step_s = 0;
  for (const Stage& stage : list_stages(model)) {
    const StageInfo& info = *stage.info;
    const Cost one = cost(model, stage);
    v1::PlanStage& out = *report.add_stages();
    out.set_name(std::string(info.name));
    if (is_of_group(info.scope)) {
      const model::ElementGroup& group = model.groups[stage.group];
      physics::with_shape_and_law(group.shape, group.law, [&](auto shape, auto law) {
        out.set_name(fmt::format("{}: {}, {}", info.name,
                                 group.has_clusters() ? "clusters" : decltype(shape)::Type::kName,
                                 decltype(law)::Type::kName));
      });
    }
    out.set_reads(std::string(info.reads));
    out.set_writes(std::string(info.writes));
    out.set_bytes(static_cast<std::uint64_t>(one.bytes));
    out.set_operations(static_cast<std::uint64_t>(one.operations));
    const double once_s = std::max(one.bytes / machine.bytes_per_s, one.operations / machine.operations_per_s);
    // A tolerance ends most solves early. Half of the iterations is a guess, and the report says so.
    const double iterations = model.cg_tolerance > 0 ? 0.5 * model.cg_max_iterations : model.cg_max_iterations;
    if (!runs_every_step(info)) continue;
    const bool repeats = info.phase == Phase::kEvaluate || info.phase == Phase::kSolve;
    // Newton converges quadratically: a handful of iterations, whatever the limit.
    const double solves = repeats ? std::min(model.newton_max_iterations, 5u) : 1;
    step_s += solves * (machine.stage_latency_s +
                        (costs_an_iteration(info) ? iterations * (once_s + machine.iteration_latency_s) : once_s));
  }
  report.set_expected_rate_hz(1 / step_s);

  CountingArena arena(report);
  if (model.double_precision) {
    bind_all<double>(model, arena);
  } else {
    bind_all<float>(model, arena);
  }
  list_not_modelled(model, report);
  list_contacts(model, report);
  for (const Finding& finding : model.findings) add(finding, report);
  return report;
}

}  // namespace tensormass::step
