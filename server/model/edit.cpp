#include "model/edit.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "core/assert.h"
#include "model/coagulation.h"
#include "model/values.h"
#include "physics/element/element.h"
#include "physics/lists.h"

namespace tensormass::model {

namespace {

using mesh::kNone;

/// Ranges that an edit has room for from the start.
constexpr std::size_t kUsualRanges = std::size_t{1} << 16;
/// Triangles and vertices that a surface has room for from the start.
constexpr std::uint32_t kUsualSurface = 1u << 16;
/// Elements that write_all computes at once.
constexpr std::size_t kElementsAtOnce = 16384;

}  // namespace

void ModelEdit::clear() {
  ranges.clear();
  held_rows.clear();
  severed.clear();
  moved_triangles.clear();
  changes_loads = false;
}

Editor::Editor(const Model& m)
    : tables_(m.edit_tables),
      live_of_body_(m.bodies.size()),
      has_material_(m.layout.row_count, 0),
      row_met_(m.layout.row_count, 0),
      mass_met_(m.mass_edges.empty() ? 0 : m.layout.slot_count(), 0),
      linear_met_(m.constant_edges.empty() ? 0 : m.layout.slot_count(), 0) {
  TM_ASSERT(tables_ != nullptr, "the scene has editing");
  kept_.assign(tables().element_count(), 1);
  for (std::size_t b = 0; b < m.bodies.size(); ++b) live_of_body_[b] = m.bodies[b].element_count;
  for (const std::uint32_t row : m.layout.row_of_node) has_material_[row] = 1;
  record_met_.assign(tables().record_group.size(), 0);
  vertex_met_.assign(tables().contact.surface_rows.size(), 0);
  named_.assign(kept_.size(), 0);
  change_.assign(m.layout.patch_count + 2 * std::size_t{m.layout.row_count}, 0);
  piece_triangle_ = tables().piece_triangle;
  piece_visible_ = tables().piece_visible;
  surface_vertex_ = tables().surface_vertex;
  visible_vertex_ = tables().visible_vertex;
  triangle_piece_.resize(tables().contact.triangle_count());
  triangle_element_.resize(triangle_piece_.size());
  place_loaded_triangles();
  if (m.visible.count() > 0) surfaces_.resize(m.bodies.size());
  const SkinTables& skin = tables().skin;
  for (std::size_t b = 0; b < surfaces_.size(); ++b) {
    BodySurface& surface = surfaces_[b];
    const auto of_skin = m.bodies[b].has_skin ? static_cast<std::uint32_t>(m.bodies[b].triangles.size()) : 0;
    surface.dead_triangles.reserve(std::min(tables().max_new_triangles + of_skin, kUsualSurface));
    surface.appended_vertices.reserve(std::min(tables().max_new_vertices, kUsualSurface));
    surface.appended_triangles.reserve(std::min(tables().max_new_triangles, kUsualSurface));
    surface.appended_kinds.reserve(std::min(tables().max_new_triangles, kUsualSurface));
    surface.coagulation.reserve(m.bodies[b].vertex_count + std::min(tables().max_new_vertices, kUsualSurface));
  }
  if (!skin.empty()) {
    heal_skin();
    exposed_.reserve(std::min(tables().max_new_triangles, kUsualSurface));
    torn_.reserve(is_torn_.size());
    tearing_.reserve(is_torn_.size());
    tearing_met_.assign(is_torn_.size(), 0);
    foot_met_.assign(skin.feet.size(), 0);
    piece_met_.assign(skin.piece_element.size(), 0);
  }
  if (has_clients()) {
    element_coagulation_.assign(kept_.size(), 0);
    row_coagulation_.assign(m.layout.row_count, 0);
  }
  gone_.reserve(kept_.size());
  batches_.reserve(kept_.size());
  edit_.ranges.reserve(kUsualRanges);
  edit_.held_rows.reserve(m.layout.row_count);
  edit_.severed.reserve(m.links.spring_count());
  edit_.moved_triangles.reserve(triangle_piece_.size());
  elements_.reserve(limits::kMaxElementsOfEdit);
  went_.reserve(limits::kMaxElementsOfEdit);
  rows_.reserve(m.layout.row_count);
  vertices_.reserve(vertex_met_.size());
  records_.reserve(2 * limits::kMaxElementsOfEdit);
}

Result<void> Editor::check(const Model& m, std::span<const Ablation> ablations) const {
  if (ablations.size() > limits::kMaxElementsOfEdit) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("{} elements in one edit, more than limits::kMaxElementsOfEdit = {}; make several edits",
                            ablations.size(), limits::kMaxElementsOfEdit));
  }
  std::array<std::uint32_t, limits::kMaxBodies> going{};  // [body] elements that lose all of their material
  ++check_number_;
  for (const Ablation& one : ablations) {
    if (one.element >= kept_.size()) {
      return fail(ErrorCode::kNotFound, fmt::format("element {} does not exist; the scene has {} elements, from 0 on",
                                                    one.element, kept_.size()));
    }
    const std::size_t body = m.body_of_element(one.element);
    const auto name = [&] {
      return fmt::format("body '{}': element {}", m.bodies[body].name, one.element - m.bodies[body].element_begin);
    };
    if (!(one.kept >= 0 && one.kept <= 1)) {
      return invalid(fmt::format("{}: a kept share of {} is not within [0, 1]", name(), one.kept));
    }
    if (named_[one.element] / 2 == check_number_)
      return invalid(fmt::format("{} is named twice; name it once", name()));
    if (is_gone(one.element)) {
      return fail(ErrorCode::kFailedPrecondition,
                  fmt::format("{} is gone already; only a reset brings it back", name()));
    }
    if (!(one.kept < kept_[one.element])) {
      return fail(ErrorCode::kFailedPrecondition,
                  fmt::format("{} has a share of {} left; give less, only a reset brings material back", name(),
                              kept_[one.element]));
    }
    const bool goes = !(one.kept > 0);
    named_[one.element] = 2 * check_number_ + (goes ? 1 : 0);
    if (goes && ++going[body] == live_of_body_[body]) {
      return fail(ErrorCode::kFailedPrecondition,
                  fmt::format("{} is the last one that the body has; leave one, or unload the scene", name()));
    }
  }
  return check_surfaces(m, ablations);
}

const ModelEdit& Editor::ablate(Model& m, std::span<const Ablation> ablations) {
  write(m, ablations);
  write_surfaces(m);
  coagulate(m);
  return edit_;
}

Editor::Shares Editor::shares() const {
  Shares out;
  out.batches = batches_;
  for (const std::uint32_t element : gone_) out.ablations.push_back({element, 0});
  for (std::uint32_t e = 0; e < kept_.size(); ++e) {
    if (kept_[e] < 1 && !is_gone(e)) out.ablations.push_back({e, kept_[e]});
  }
  return out;
}

Result<void> Editor::check_shares(const Model& m, const Shares& shares) const {
  Model copy = m;
  Editor trial = *this;
  trial.heal(copy, [](const ModelEdit&) {});
  Result<void> result;
  for_each_batch(shares, [&](std::span<const Ablation> batch) {
    if (result) result = trial.check(copy, batch);
    if (result) trial.ablate(copy, batch);
  });
  return result;
}

std::vector<std::span<const Ablation>> Editor::parts_to_heal() {
  to_heal_.clear();
  for (std::uint32_t e = 0; e < kept_.size(); ++e) {
    if (kept_[e] < 1) to_heal_.push_back({e, 1});
  }
  gone_.clear();
  batches_.clear();
  removed_mass_kg_ = removed_volume_m3_ = 0;
  std::vector<std::span<const Ablation>> parts;
  for (std::span<const Ablation> left = to_heal_; !left.empty(); left = left.subspan(parts.back().size())) {
    parts.push_back(left.first(std::min(left.size(), limits::kMaxElementsOfEdit)));
  }
  return parts;
}

void Editor::write_all(Model& m) {
  std::vector<Ablation> all;
  for (std::uint32_t e = 0; e < kept_.size(); ++e) all.push_back({e, 1});
  for (std::span<const Ablation> left = all; !left.empty();
       left = left.subspan(std::min(left.size(), kElementsAtOnce))) {
    write(m, left.first(std::min(left.size(), kElementsAtOnce)));
  }
  edit_ = {};
}

void Editor::write_values(Model& m) {
  ++number_;
  for (std::uint32_t row = 0; row < m.layout.row_count; ++row) write_external(m, row);
  for (std::uint32_t record = 0; record < record_met_.size(); ++record) write_linear(m, record);
  edit_ = {};
}

const ModelEdit& Editor::take_values(Model& m, const Model& next, EditedValues& values) {
  edit_.clear();
  ++number_;
  rows_.clear();
  records_.clear();
  m.gravity_m_per_s2 = next.gravity_m_per_s2;
  m.external.swap(values.external);
  m.constant_edges.swap(values.constant_edges);
  m.element_moduli.swap(values.element_moduli);
  for (std::size_t i = 0; i < m.inertia.size(); i += 4) {
    for (const std::size_t c : {1, 2}) m.inertia[i + c] = next.inertia[i + c];
  }
  for (std::size_t g = 0; g < m.groups.size(); ++g) m.groups[g].parameters.swap(values.parameters[g]);
  for (std::size_t b = 0; b < m.bodies.size(); ++b) static_cast<SurfaceModuli&>(m.bodies[b]) = next.bodies[b];
  write_triangle_moduli(m);
  if (m.contact.triangle_moduli != next.contact.triangle_moduli) {
    add(EditBuffer::kTriangleModuli, 0, m.contact.triangle_moduli.size());
  }
  const auto meet = [&](std::vector<std::uint32_t>& met, std::uint32_t item, std::vector<std::uint32_t>& list) {
    if (std::exchange(met[item], number_) != number_) list.push_back(item);
  };
  for (std::uint32_t e = 0; e < kept_.size(); ++e) {
    if (!(kept_[e] < 1)) continue;
    meet(record_met_, e, records_);
    if (tables().cluster_of[e] != kNone) meet(record_met_, tables().cluster_of[e], records_);
    for (const std::uint32_t row : tables().rows[e]) meet(row_met_, row, rows_);
  }
  for (const std::uint32_t row : rows_) {
    write_external(m, row);
    if (!m.quasi_static()) add(EditBuffer::kInertia, 4 * std::size_t{row}, 1);
  }
  for (const std::uint32_t record : records_) write_linear(m, record);
  return edit_;
}

/// Writes the moduli behind all contact triangles. Room keeps those of the last triangle that was there.
void Editor::write_triangle_moduli(Model& m) const {
  for (std::uint32_t t = 0; t < triangle_piece_.size(); ++t) {
    const std::uint32_t element = element_behind(t);
    for (std::size_t c = 0; element != kNone && c < 2; ++c) {
      m.contact.triangle_moduli[2 * std::size_t{t} + c] = m.element_moduli[2 * std::size_t{element} + c];
    }
  }
}

void Editor::add(EditBuffer buffer, std::size_t begin, std::size_t count, std::size_t step, std::uint32_t group) {
  edit_.ranges.push_back({buffer, group, static_cast<std::uint32_t>(begin), static_cast<std::uint32_t>(count),
                          static_cast<std::uint32_t>(step)});
}

/// Sets the shares of some elements and writes what follows from them, without the surfaces.
const ModelEdit& Editor::write(Model& m, std::span<const Ablation> shares) {
  edit_.clear();
  ++number_;
  elements_.clear();
  rows_.clear();
  records_.clear();
  went_.clear();
  const auto meet = [&](std::vector<std::uint32_t>& met, std::uint32_t item, std::vector<std::uint32_t>& list) {
    if (std::exchange(met[item], number_) != number_) list.push_back(item);
  };
  for (const Ablation& one : shares) {
    const std::uint32_t e = one.element;
    const bool was_gone = is_gone(e);
    const double lost = kept_[e] - one.kept;
    kept_[e] = one.kept;
    if (!m.stiffening.empty()) {
      m.stiffening[e] = stiffening(one.kept, m.bodies[m.body_of_element(e)].coagulated_stiffness_factor);
    }
    if (is_gone(e) != was_gone) live_of_body_[m.body_of_element(e)] += was_gone ? 1u : ~0u;
    if (is_gone(e) && !was_gone) went_.push_back(e);
    elements_.push_back(e);
    meet(record_met_, e, records_);
    if (tables().cluster_of[e] != kNone) meet(record_met_, tables().cluster_of[e], records_);
    double mass = 0;
    const std::uint32_t begin = tables().rows.begin[e];
    for (std::uint32_t k = begin; k < tables().rows.begin[e + 1]; ++k) {
      meet(row_met_, tables().rows.items[k], rows_);
      mass += tables().masses[k];
    }
    if (lost > 0) {
      removed_mass_kg_ += lost * mass;
      removed_volume_m3_ += lost * tables().volumes[e];
    }
  }
  if (!went_.empty()) {
    gone_.insert(gone_.end(), went_.begin(), went_.end());
    batches_.push_back(static_cast<std::uint32_t>(went_.size()));
  }
  for (const std::uint32_t record : records_) {
    if (record < kept_.size()) {
      write_record(m, record);
    } else {
      write_cluster(m, record);
    }
  }
  for (const std::uint32_t row : rows_) write_row(m, row);
  for (const std::uint32_t element : elements_) {
    write_pair_masses(m, element);
    write_face_pressures(m, element);
    write_checked(m, element);
  }
  for (const std::uint32_t record : records_) write_linear(m, record);
  return edit_;
}

/// Returns κ C(κ) of an element: the share of its energy and force that is left.
double Editor::stiffness_left(const Model& m, std::uint32_t element) const {
  const double kept = kept_[element];
  return kept * stiffening(kept, m.bodies[m.body_of_element(element)].coagulated_stiffness_factor);
}

/// Writes an element's own record: its rest shape with weights times the share of its stiffness.
void Editor::write_record(Model& m, std::uint32_t element) {
  const std::uint32_t g = tables().record_group[element];
  const EditTables::Group& loaded = tables().groups[g];
  const ElementGroup& group = m.groups[g];
  const std::size_t components = loaded.rest.size() / group.stride, reals = components / group.point_count;
  const std::uint32_t place = tables().places[element].front();
  const double left = stiffness_left(m, element);
  rest_.assign(components, 0);
  for (std::size_t c = 0; !is_gone(element) && c < components; ++c) {
    const double value = loaded.rest[c * group.stride + place];
    rest_[c] = c % reals == reals - 1 ? left * value : value;
  }
  store_rest(m, element, is_gone(element));
}

/// Writes the record of a cluster: the mean over what is left of its elements.
void Editor::write_cluster(Model& m, std::uint32_t record) {
  const std::uint32_t g = tables().record_group[record];
  ElementGroup& group = m.groups[g];
  std::array<Vec3<double>, kClusterNodes> mean;
  for (Vec3<double>& a : mean) a.setZero();
  std::array<std::uint32_t, kMaxClusterElements> members;
  std::array<double, kMaxClusterElements> parts{};
  members.fill(kNone);
  double volume = 0;
  std::size_t count = 0;
  for (const EditTables::Member& member : tables().members[record - tables().element_count()]) {
    const double left = stiffness_left(m, member.element);
    if (!(left > 0)) continue;
    for (std::uint32_t i = member.gradient_begin; i < member.gradient_end; ++i) {
      mean[tables().gradient_nodes[i]] += tables().gradients[i] * left;
    }
    members[count] = member.element;
    parts[count++] = left * member.volume_m3;
    volume += left * member.volume_m3;
  }
  rest_.assign(physics::kRestReals<ClusterShape>, 0);
  if (volume > 0) {
    for (std::size_t k = 1; k < kClusterNodes; ++k) {
      for (std::size_t c = 0; c < 3; ++c) rest_[3 * (k - 1) + c] = mean[k][static_cast<Eigen::Index>(c)] / volume;
    }
    rest_.back() = volume;
  }
  store_rest(m, record, count == 0);
  for (const std::uint32_t place : tables().places[record]) {
    for (std::size_t i = 0; i < kMaxClusterElements; ++i) {
      group.members[i * group.stride + place] = members[i];
      group.member_parts[i * group.stride + place] = i < count ? parts[i] / volume : 0;
    }
    if (place < group.elements.size() && tables().groups[g].elements[place] != kNone)
      group.elements[place] = members[0];
  }
}

/// Writes rest_ to all places of a record. is_gone: it has no material, and all of its rows become the first one.
void Editor::store_rest(Model& m, std::uint32_t record, bool gone) {
  const std::uint32_t g = tables().record_group[record];
  const EditTables::Group& loaded = tables().groups[g];
  ElementGroup& group = m.groups[g];
  const std::size_t stride = group.stride, nodes = loaded.rows.size() / stride;
  for (const std::uint32_t place : tables().places[record]) {
    for (std::size_t c = 0; c < rest_.size(); ++c) group.rest[c * stride + place] = rest_[c];
    add(EditBuffer::kElementRest, place, rest_.size(), stride, g);
    for (std::size_t k = 0; k < nodes; ++k) {
      group.rows[k * stride + place] = loaded.rows[(gone ? 0 : k) * stride + place];
    }
    add(EditBuffer::kElementRows, place, nodes, stride, g);
    if (place < group.elements.size()) group.elements[place] = gone ? kNone : loaded.elements[place];
  }
}

/// Writes mass, weight and freedom of a row.
void Editor::write_row(Model& m, std::uint32_t row) {
  double mass = 0, inertia = 0;
  bool has_material = false;
  for (const EditTables::Corner& corner : tables().corners[row]) {
    const double kept = kept_[corner.item];
    if (!(kept > 0)) continue;
    const std::size_t entry = std::size_t{tables().rows.begin[corner.item]} + corner.node;
    has_material = true;
    mass += kept * tables().masses[entry];
    inertia += kept * tables().inertias[entry];
  }
  m.row_mass[row] = mass;
  if (!m.quasi_static()) {
    m.inertia[4 * std::size_t{row}] = inertia;
    add(EditBuffer::kInertia, 4 * std::size_t{row}, 1);
  }
  write_external(m, row);
  if (has_material_[row] != 0 && !has_material) {
    edit_.held_rows.push_back(row);
    const std::span<const std::uint32_t> springs = tables().springs[row];
    edit_.severed.insert(edit_.severed.end(), springs.begin(), springs.end());
  }
  has_material_[row] = has_material ? 1 : 0;
  m.rest[4 * std::size_t{row} + 3] = has_material ? tables().free_bits[row] : 0;
  add(EditBuffer::kRest, 4 * std::size_t{row} + 3, 1);
  write_free_body(m, row);
}

void Editor::write_external(Model& m, std::uint32_t row) {
  if (tables().loads.empty()) return;
  const std::vector<std::uint32_t>& entries = tables().gravity_entries;
  if (!entries.empty() && entries[row] == kNone) return;
  double* const to =
      entries.empty() ? &m.external[4 * std::size_t{row}] : &m.scheduled.forces[3 * std::size_t{entries[row]}];
  for (std::size_t c = 0; c < 3; ++c) {
    to[c] =
        tables().loads[3 * std::size_t{row} + c] + m.row_mass[row] * m.gravity_m_per_s2[static_cast<Eigen::Index>(c)];
  }
  if (entries.empty()) add(EditBuffer::kExternal, 4 * std::size_t{row}, 3);
  edit_.changes_loads = true;
}

/// Takes a row without material out of its free body, and gives the body another centre if that was the row.
void Editor::write_free_body(Model& m, std::uint32_t row) {
  if (tables().row_bodies.empty() || tables().row_bodies[row] == view::kNoBody) return;
  const std::uint32_t body = tables().row_bodies[row];
  m.free_bodies.row_body[row] = has_material_[row] != 0 ? body : view::kNoBody;
  add(EditBuffer::kRowBodies, row, 1);
  const std::uint32_t loaded = tables().center_rows[body];
  std::uint32_t& center = m.free_bodies.center_rows[body];
  if (row != center && row != loaded) return;
  center = loaded;
  double nearest = std::numeric_limits<double>::infinity();
  const Vec3<double> at = view::load3<double>(m.rest.data(), loaded);
  for (std::uint32_t other = 0; has_material_[loaded] == 0 && other < m.layout.row_count; ++other) {
    if (tables().row_bodies[other] != body || has_material_[other] == 0) continue;
    const double distance = (view::load3<double>(m.rest.data(), other) - at).squaredNorm();
    if (!(distance < nearest)) continue;
    nearest = distance;
    center = other;
  }
  add(EditBuffer::kCenterRows, body, 1);
}

/// Writes the consistent mass between the nodes of an element, summed over all elements that have both.
void Editor::write_pair_masses(Model& m, std::uint32_t element) {
  if (tables().pair_masses[element].empty()) return;
  const std::span<const std::uint32_t> rows = tables().rows[element];
  const auto pair_of = [&](std::uint32_t of, std::uint32_t k, std::uint32_t l) {
    const int nodes = static_cast<int>(tables().rows[of].size());
    return tables().pair_masses[of][static_cast<std::size_t>(
        physics::pair_index(nodes, static_cast<int>(std::min(k, l)), static_cast<int>(std::max(k, l))))];
  };
  for (std::size_t k = 0; k < rows.size(); ++k) {
    for (std::size_t l = k + 1; l < rows.size(); ++l) {
      double mass = 0;
      bool summed = false;
      m.layout.for_each_place(rows[k], rows[l], [&](std::uint32_t slot, bool) {
        if (mass_met_[slot] == number_) return;
        for (const EditTables::Corner& corner : tables().corners[rows[k]]) {
          if (summed || is_gone(corner.item)) continue;
          const std::span<const std::uint32_t> others = tables().rows[corner.item];
          const auto other = std::find(others.begin(), others.end(), rows[l]);
          if (other == others.end()) continue;
          mass += kept_[corner.item] *
                  pair_of(corner.item, corner.node, static_cast<std::uint32_t>(other - others.begin()));
        }
        summed = true;
        mass_met_[slot] = number_;
        m.mass_edges[slot] = mass;
        add(EditBuffer::kMassEdges, slot, 1);
      });
    }
  }
}

/// Writes the constant tensors between the nodes of a record, summed over all records of linear laws that have both.
void Editor::write_linear(Model& m, std::uint32_t record) {
  const std::uint32_t g = tables().record_group[record];
  if (!m.groups[g].is_constant) return;
  const auto rows_of = [&](std::uint32_t of, std::size_t k) {
    const EditTables::Group& loaded = tables().groups[tables().record_group[of]];
    return loaded.rows[k * m.groups[tables().record_group[of]].stride + tables().places[of].front()];
  };
  const auto nodes_of = [&](std::uint32_t of) {
    return tables().groups[tables().record_group[of]].rows.size() / m.groups[tables().record_group[of]].stride;
  };
  const std::size_t step = m.layout.component(0, 1) - m.layout.component(0, 0), nodes = nodes_of(record);
  for (std::size_t k = 0; k < nodes; ++k) {
    for (std::size_t l = k + 1; l < nodes; ++l) {
      const std::uint32_t row_k = rows_of(record, k), row_l = rows_of(record, l);
      Mat3<double> edge = Mat3<double>::Zero();
      bool summed = false;
      m.layout.for_each_place(row_k, row_l, [&](std::uint32_t slot, bool transposed) {
        if (linear_met_[slot] == number_) return;
        for (const EditTables::Corner& corner : tables().linear[row_k]) {
          if (summed) break;
          for (std::size_t other = 0; other < nodes_of(corner.item); ++other) {
            if (rows_of(corner.item, other) != row_l) continue;
            edge += constant_tensor(m.groups[tables().record_group[corner.item]], tables().places[corner.item].front(),
                                    corner.node, static_cast<std::uint32_t>(other));
          }
        }
        summed = true;
        linear_met_[slot] = number_;
        for (std::uint32_t i = 0; i < 9; ++i) {
          m.constant_edges[m.layout.component(slot, i)] = transposed ? edge(i % 3, i / 3) : edge(i / 3, i % 3);
        }
        add(EditBuffer::kConstantEdges, m.layout.component(slot, 0), 9, step);
      });
    }
  }
}

void Editor::write_face_pressures(Model& m, std::uint32_t element) {
  for (const std::uint32_t face : tables().pressed[element]) {
    m.pressure.faces[face].pressure_pa = is_gone(element) ? 0 : tables().pressures[face];
    add(EditBuffer::kPressures, face, 1);
    edit_.changes_loads = true;
  }
}

void Editor::write_checked(Model& m, std::uint32_t element) {
  if (tables().checked[element] == kNone) return;
  const std::size_t first = 4 * std::size_t{tables().checked[element]};
  for (std::size_t k = 0; k < 4; ++k) {
    m.checked.rows[first + k] = tables().checked_rows[first + (is_gone(element) ? 0 : k)];
  }
  add(EditBuffer::kCheckedTetrahedra, first, 4);
}

}  // namespace tensormass::model
