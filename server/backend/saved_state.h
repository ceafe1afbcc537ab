#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "backend/step_inputs.h"
#include "core/assert.h"
#include "view/scene.h"

/// The state of a scene and the history of its steps, between the buffers of a device and the host.
namespace tensormass::backend {

/// Number of reals in ContactView::slips and in LinksView::slips; 0 if contacts remember nothing.
template <class Real>
std::size_t slip_reals(const view::ContactView<Real>& contact) {
  return contact.slips == nullptr ? 0 : 4 * std::size_t{contact.contact_points} * contact.triangle_count;
}
template <class Real>
std::size_t slip_reals(const view::LinksView<Real>& links) {
  if (links.slips == nullptr) return 0;
  return 4 * std::size_t{links.candidate_count} + view::kEdgeMemory * std::size_t{links.edges.slot_count()} +
         links.blades.reals();
}

/// Reads the state of all rows.
///
///   download(from, count) -> std::vector<double>   copies reals to the host
template <class Real, class Download>
RowState read_state(const model::Model& m, const view::SceneView<Real>& view,
                    std::span<const view::ElementView<Real>> groups, double internal_dt_s, const Download& download) {
  const std::size_t reals = 4 * std::size_t{view.patches.row_count};
  RowState state{download(view.state.displacement, reals), download(view.state.velocity, reals), {}, internal_dt_s};
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const std::vector<double> history = download(groups[g].internal_variables, m.groups[g].internal_variable_reals());
    state.internal_variables.insert(state.internal_variables.end(), history.begin(), history.end());
  }
  return state;
}

/// Writes the state of all rows.
///
///   upload(to, std::span<const double> from)   copies reals to the device
template <class Real, class Upload>
void write_state(const model::Model& m, const view::SceneView<Real>& view,
                 std::span<const view::ElementView<Real>> groups, const RowState& state, const Upload& upload) {
  upload(view.state.displacement, state.displacement);
  upload(view.state.velocity, state.velocity);
  if (view.state.previous_displacement != nullptr) {
    upload(view.state.previous_displacement, state.displacement);
    upload(view.state.previous_velocity, state.velocity);
  }
  // Friction starts anew and attachments are whole: a state from outside says nothing about them.
  upload(view.contact.slips, std::vector<double>(slip_reals(view.contact), 0.0));
  upload(view.links.slips, std::vector<double>(slip_reals(view.links), 0.0));
  upload(view.links.broken, std::vector<double>(view.links.spring_count, 0.0));
  std::span<const double> histories = state.internal_variables;
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const std::size_t count = m.groups[g].internal_variable_reals();
    upload(groups[g].internal_variables, histories.first(count));
    histories = histories.subspan(count);
  }
}

/// Reads the history of the steps. download: as in read_state.
template <class Real, class Download>
StepHistory read_history(const view::SceneView<Real>& view, const StepRecord& past, std::uint32_t coarse_solves,
                         const Download& download) {
  const std::size_t reals = 4 * std::size_t{view.patches.row_count};
  StepHistory history;
  history.last_dt_s = past.dt_s;
  history.largest_force_squared = past.largest_force_squared;
  history.coarse_solves = coarse_solves;
  if (view.state.previous_displacement != nullptr) {
    history.previous_displacement = download(view.state.previous_displacement, reals);
    history.previous_velocity = download(view.state.previous_velocity, reals);
  }
  history.slips = download(view.contact.slips, slip_reals(view.contact));
  history.link_slips = download(view.links.slips, slip_reals(view.links));
  history.broken = download(view.links.broken, view.links.spring_count);
  if (view.solve.kept != nullptr) history.solution = download(view.solve.kept + past.solution * reals, reals);
  return history;
}

/// Writes the history of the steps; the last solution goes to the first place of SolveView::kept. upload: as in
/// write_state.
template <class Real, class Upload>
void write_history(const view::SceneView<Real>& view, const StepHistory& history, const Upload& upload) {
  if (view.state.previous_displacement != nullptr) {
    upload(view.state.previous_displacement, history.previous_displacement);
    upload(view.state.previous_velocity, history.previous_velocity);
  }
  TM_ASSERT(history.slips.size() == slip_reals(view.contact) && history.link_slips.size() == slip_reals(view.links) &&
                history.broken.size() == view.links.spring_count,
            "a history is of the same model");
  upload(view.contact.slips, history.slips);
  upload(view.links.slips, history.link_slips);
  upload(view.links.broken, history.broken);
  if (view.solve.kept != nullptr) upload(view.solve.kept, history.solution);
}

}  // namespace tensormass::backend
