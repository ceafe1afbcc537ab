#include "model/edit_tables.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <string>
#include <utility>

#include "core/assert.h"
#include "mesh/adjacency.h"
#include "mesh/faces.h"
#include "mesh/surface.h"
#include "model/edit.h"

namespace tensormass::model {

namespace {

using mesh::kNone;

/// Room for triangles around a vertex beyond those that it has.
constexpr std::uint32_t kSpareIncidences = 8;
/// Triangles of a patch for each of its rows. A closed surface has two for each of its vertices.
constexpr std::uint32_t kTrianglesOfRow = 2;
/// Part of the visible surface by which it may grow if the scene does not say, and how much more.
constexpr std::uint32_t kGrowthDivisor = 2, kLeastGrowth = 1024;

/// Sorts pairs of (list, item) that come in any order into lists, each in the order in which its items came.
template <class T>
Lists<T> sorted_into_lists(std::size_t count, std::span<const std::pair<std::uint32_t, T>> pairs) {
  Lists<T> out;
  out.begin.assign(count + 1, 0);
  for (const auto& pair : pairs) ++out.begin[pair.first + 1];
  for (std::size_t i = 0; i < count; ++i) out.begin[i + 1] += out.begin[i];
  std::vector<std::uint32_t> next(out.begin.begin(), out.begin.end() - 1);
  out.items.resize(pairs.size());
  for (const auto& [list, item] : pairs) out.items[next[list]++] = item;
  return out;
}

class TablesMaker {
 public:
  TablesMaker(const EditTablesInput& input, Model& model) : in_(input), bodies_(input.bodies.bodies), m_(model) {}

  EditTables make() {
    read_elements();
    find_records();
    list_linear();
    copy_rows();
    list_pressed();
    find_checked();
    find_faces();
    make_room_for_contact();
    make_room_for_clients();
    return std::move(out_);
  }

 private:
  using Corner = EditTables::Corner;

  /// Masses and volumes of the elements, in the order of row_fields.cpp, and what clusters have of them.
  void read_elements() {
    std::vector<std::pair<std::uint32_t, Corner>> corners;
    out_.cluster_of.assign(mesh::element_count(in_.bodies.merged), kNone);
    const auto elements = static_cast<std::uint32_t>(out_.cluster_of.size());
    std::vector<std::pair<std::uint32_t, EditTables::Member>> members;
    for (std::uint32_t c = 0; c < in_.clusters.size(); ++c) {
      for (const std::uint32_t e : in_.clusters[c].elements) {
        if (e != kNone) out_.cluster_of[bodies_[in_.clusters[c].body].element_begin + e] = elements + c;
      }
    }
    for_each_element(
        in_.bodies, [&](auto tag, std::size_t b, std::uint32_t, std::span<const std::uint32_t> nodes, const auto& x) {
          using Shape = typename decltype(tag)::Type;
          const ReadBody& body = bodies_[b];
          const double density = body.density_kg_per_m3;
          const auto element = static_cast<std::uint32_t>(out_.volumes.size());
          const auto integrals = physics::mass_integrals<Shape>(x);
          const auto volumes = physics::lumped_volumes<Shape>(x);
          double volume = 0;
          for (std::uint32_t k = 0; k < nodes.size(); ++k) {
            const std::uint32_t row = m_.layout.row_of_node[nodes[k]];
            out_.rows.items.push_back(row);
            corners.push_back({row, {element, k}});
            volume += volumes[k];
            const auto i = static_cast<Eigen::Index>(k);
            out_.masses.push_back(density * (body.consistent_mass ? integrals.row(i).sum() : volumes[k]));
            out_.inertias.push_back(density * (body.consistent_mass ? integrals(i, i) : volumes[k]));
            for (auto l = i + 1; body.consistent_mass && !m_.mass_edges.empty() && l < Shape::kNodes; ++l) {
              out_.pair_masses.items.push_back(density * integrals(i, l));
            }
          }
          out_.rows.end_list();
          out_.pair_masses.end_list();
          out_.volumes.push_back(volume);
          const Material& material = body.material(element - body.element_begin);
          const std::array<double, 2> moduli = contact_moduli(material);
          m_.element_moduli.insert(m_.element_moduli.end(), moduli.begin(), moduli.end());
          if (out_.cluster_of[element] == kNone) return;
          const Cluster& cluster = in_.clusters[out_.cluster_of[element] - elements];
          const auto point = physics::rest_points<Shape>(x, physics::Quadrature::kReduced).front();
          const auto mean = physics::PointGradients<Shape, double>::read([&](int i) { return point[std::size_t(i)]; });
          const auto begin = static_cast<std::uint32_t>(out_.gradients.size());
          for (std::size_t k = 0; k < nodes.size(); ++k) {
            const auto place = std::find(cluster.nodes.begin(), cluster.nodes.end(), nodes[k]) - cluster.nodes.begin();
            out_.gradient_nodes.push_back(static_cast<std::uint8_t>(place));
            out_.gradients.push_back(mean.a[k] * mean.weight);
          }
          members.push_back({out_.cluster_of[element] - elements,
                             {element, mean.weight, begin, static_cast<std::uint32_t>(out_.gradients.size())}});
        });
    out_.corners = sorted_into_lists<Corner>(m_.layout.row_count, corners);
    // The members of a cluster in its own order.
    out_.members = sorted_into_lists<EditTables::Member>(in_.clusters.size(), members);
    for (std::size_t c = 0; c < in_.clusters.size(); ++c) {
      const auto& order = in_.clusters[c].elements;
      const std::uint32_t begin = bodies_[in_.clusters[c].body].element_begin;
      const auto place = [&](const EditTables::Member& member) {
        return std::find(order.begin(), order.end(), member.element - begin);
      };
      std::sort(out_.members.items.begin() + out_.members.begin[c],
                out_.members.items.begin() + out_.members.begin[c + 1],
                [&](const auto& a, const auto& b) { return place(a) < place(b); });
    }
  }

  /// Calls visit(place) for each place of a group that is not padding.
  template <class Visit>
  static void for_each_place(const ElementGroup& group, const Visit& visit) {
    if (group.patch_elements.empty()) {
      for (std::uint32_t place = 0; place < group.element_count; ++place) visit(place);
    }
    for (std::size_t i = 0; i < group.patch_elements.size(); i += 2) {
      for (std::uint32_t place = group.patch_elements[i]; place < group.patch_elements[i + 1]; ++place) visit(place);
    }
  }

  /// Finds the places of each record.
  void find_records() {
    const std::size_t records = out_.volumes.size() + in_.clusters.size();
    out_.record_group.assign(records, kNone);
    std::vector<std::pair<std::uint32_t, std::uint32_t>> places;
    for (std::uint32_t g = 0; g < m_.groups.size(); ++g) {
      const ElementGroup& group = m_.groups[g];
      out_.groups.push_back({group.elements, group.rows, group.rest});
      const auto add = [&](std::uint32_t record, std::uint32_t place) {
        out_.record_group[record] = g;
        places.emplace_back(record, place);
      };
      if (group.has_clusters()) {
        for_each_place(group, [&](std::uint32_t place) { add(out_.cluster_of[group.members[place]], place); });
        continue;
      }
      for_each_place(group, [&](std::uint32_t place) {
        if (place < group.elements.size() && group.elements[place] != kNone) add(group.elements[place], place);
      });
      for_each_place(group, [&](std::uint32_t place) {
        if (place < group.elements.size() && group.elements[place] != kNone) return;
        add(element_at(g, place), place);  // computed for another patch as well
      });
    }
    TM_ASSERT(std::find(out_.record_group.begin(), out_.record_group.end(), kNone) == out_.record_group.end(),
              "each element and each cluster is in a group");
    out_.places = sorted_into_lists<std::uint32_t>(records, places);
  }

  /// Returns the element of a group that has the rows of a place.
  std::uint32_t element_at(std::uint32_t g, std::uint32_t place) const {
    const ElementGroup& group = m_.groups[g];
    for (const Corner& corner : out_.corners[group.rows[place]]) {
      const std::span<const std::uint32_t> rows = out_.rows[corner.item];
      if (out_.record_group[corner.item] != g || corner.node != 0) continue;
      bool same = true;
      for (std::size_t k = 0; same && k < rows.size(); ++k) same = group.rows[k * group.stride + place] == rows[k];
      if (same) return corner.item;
    }
    TM_ASSERT(false, "a place of a group has an element of the scene");
    return kNone;
  }

  void list_linear() {
    if (m_.constant_edges.empty()) return;
    std::vector<std::pair<std::uint32_t, Corner>> linear;
    const auto elements = static_cast<std::uint32_t>(out_.volumes.size());
    const auto records = static_cast<std::uint32_t>(out_.record_group.size());
    for (std::uint32_t i = 0; i < records; ++i) {
      const std::uint32_t record = i < records - elements ? elements + i : i - (records - elements);  // clusters first
      const ElementGroup& group = m_.groups[out_.record_group[record]];
      if (!group.is_constant) continue;
      const std::uint32_t place = out_.places[record].front();
      for (std::uint32_t k = 0; k * std::size_t{group.stride} < group.rows.size(); ++k) {
        linear.push_back({group.rows[k * std::size_t{group.stride} + place], {record, k}});
      }
    }
    out_.linear = sorted_into_lists<Corner>(m_.layout.row_count, linear);
  }

  /// Loads without gravity: they stay when the mass goes.
  void copy_rows() {
    const std::size_t rows = m_.layout.row_count;
    for (std::size_t row = 0; row < rows; ++row) out_.free_bits.push_back(m_.rest[4 * row + 3]);
    out_.row_bodies = m_.free_bodies.row_body;
    out_.center_rows = m_.free_bodies.center_rows;
    out_.pressures.reserve(m_.pressure.faces.size());
    for (const auto& face : m_.pressure.faces) out_.pressures.push_back(face.pressure_pa);
    out_.checked_rows = m_.checked.rows;
    std::vector<std::pair<std::uint32_t, std::uint32_t>> springs;
    for (std::uint32_t i = 0; i < m_.links.spring_rows.size(); ++i)
      springs.emplace_back(m_.links.spring_rows[i], i / 2);
    out_.springs = sorted_into_lists<std::uint32_t>(rows, springs);
    if (!m_.has_gravity || m_.external.empty()) return;
    out_.loads.assign(3 * rows, 0);
    const std::vector<Schedule>& schedules = m_.scheduled.schedules;
    if (!m_.gravity_schedule.empty()) {
      const auto schedule = std::find(schedules.begin(), schedules.end(), m_.gravity_schedule) - schedules.begin();
      out_.gravity_entries.assign(rows, kNone);
      for (std::uint32_t i = 0; i < m_.scheduled.rows.size(); ++i) {
        if (m_.scheduled.of_entry[i] == schedule) out_.gravity_entries[m_.scheduled.rows[i]] = i;
      }
    }
    const std::vector<double>& loads = m_.value_tables->loads;
    for (std::size_t row = 0; row < rows; ++row) {
      const std::uint32_t entry = out_.gravity_entries.empty() ? kNone : out_.gravity_entries[row];
      if (out_.gravity_entries.empty()) {
        for (std::size_t c = 0; c < 3 && !loads.empty(); ++c) out_.loads[3 * row + c] = loads[4 * row + c];
        continue;
      }
      if (entry == kNone) continue;
      for (std::size_t c = 0; c < 3; ++c) {
        const double weight = m_.row_mass[row] * m_.gravity_m_per_s2[static_cast<Eigen::Index>(c)];
        // A row without a load is left with rounding.
        constexpr double kRounding = 1e-14;
        const double load = m_.scheduled.forces[3 * std::size_t{entry} + c] - weight;
        out_.loads[3 * row + c] = std::abs(load) > kRounding * std::abs(weight) ? load : 0;
      }
    }
  }

  void list_pressed() {
    std::vector<std::pair<std::uint32_t, std::uint32_t>> pressed;
    for (std::uint32_t f = 0; f < m_.pressure.faces.size(); ++f) {
      const auto& face = m_.pressure.faces[f];
      for (const Corner& corner : out_.corners[face.rows[0]]) {
        const std::span<const std::uint32_t> rows = out_.rows[corner.item];
        const bool has_all = std::all_of(face.rows, face.rows + face.node_count, [&](std::uint32_t row) {
          return std::find(rows.begin(), rows.end(), row) != rows.end();
        });
        if (!has_all) continue;
        pressed.emplace_back(corner.item, f);
        break;  // a face of the boundary has one element
      }
    }
    out_.pressed = sorted_into_lists<std::uint32_t>(out_.volumes.size(), pressed);
  }

  /// Finds the elements of Model::checked by their rows.
  void find_checked() {
    out_.checked.assign(out_.volumes.size(), kNone);
    const matrix::Layout& layout = m_.layout;
    for (std::uint32_t part = 0; part + 1 < m_.checked.begin.size(); ++part) {
      const std::uint32_t patch = part / 2, first = layout.patch_rows[patch],
                          own = layout.patch_rows[patch + 1] - first;
      for (std::uint32_t t = m_.checked.begin[part]; t < m_.checked.begin[part + 1]; ++t) {
        std::array<std::uint32_t, 4> rows;
        for (std::size_t k = 0; k < 4; ++k) {
          const std::uint32_t local = m_.checked.rows[4 * std::size_t{t} + k];
          rows[k] = local < own ? first + local : layout.halo[layout.patch_halo[patch] + local - own];
        }
        std::sort(rows.begin(), rows.end());
        for (const Corner& corner : out_.corners[rows[0]]) {
          const std::span<const std::uint32_t> of_element = out_.rows[corner.item];
          if (of_element.size() != 4) continue;
          std::array<std::uint32_t, 4> sorted;
          std::copy(of_element.begin(), of_element.end(), sorted.begin());
          std::sort(sorted.begin(), sorted.end());
          if (sorted == rows) out_.checked[corner.item] = t;
        }
      }
    }
  }

  bool needs_faces() const { return m_.contact.triangle_count() > 0 || m_.visible.count() > 0; }

  /// Numbers the faces of all elements and finds what lies behind each.
  void find_faces() {
    out_.max_new_triangles = out_.max_new_vertices = 0;
    if (!needs_faces()) return;
    const mesh::Mesh& merged = in_.bodies.merged;
    mesh::for_each_element(
        merged, [&](std::uint32_t element, const mesh::Topology& shape, std::span<const std::uint32_t> nodes) {
          for (const mesh::Face& face : shape.faces) {
            out_.faces.items.push_back(static_cast<std::uint32_t>(out_.face_element.size()));
            out_.face_element.push_back(element);
            for (const mesh::Triangle& triangle : mesh::face_triangles(mesh::face_nodes(face, nodes))) {
              std::array<std::uint32_t, 3> rows;
              for (std::size_t c = 0; c < 3; ++c) rows[c] = m_.layout.row_of_node[triangle[c]];
              out_.pieces.items.push_back(rows);
            }
            out_.pieces.end_list();
          }
          out_.faces.end_list();
        });
    out_.face_behind.assign(out_.face_element.size(), kNone);
    mesh::match_faces(merged, [&](std::span<const mesh::ElementFace> same) {
      if (same.size() != 2) return;
      const std::uint32_t a = out_.faces[same[0].element][same[0].face], b = out_.faces[same[1].element][same[1].face];
      out_.face_behind[a] = b;
      out_.face_behind[b] = a;
    });
  }

  /// Spreads the contact surface out, so that each patch has room behind its triangles and its vertices.
  void make_room_for_contact() {
    out_.surface_vertex.assign(m_.layout.row_count, kNone);
    out_.piece_triangle.assign(out_.pieces.items.size(), kNone);
    ContactSurface& old = m_.contact;
    if (old.triangle_count() == 0) return;
    const matrix::Layout& layout = m_.layout;
    ContactSurface out;
    out.patch_triangles.assign(1, 0);
    out.patch_surface.assign(1, 0);
    out.incidence_begin.assign(1, 0);
    std::vector<std::uint32_t> triangle_at(old.triangle_count()), vertex_at(old.surface_rows.size());
    for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
      const std::uint32_t rows = layout.patch_rows[patch + 1] - layout.patch_rows[patch];
      const std::uint32_t triangles = old.patch_triangles[patch + 1] - old.patch_triangles[patch];
      const std::uint32_t vertices = old.patch_surface[patch + 1] - old.patch_surface[patch];
      for (std::uint32_t i = 0; i < triangles; ++i)
        triangle_at[old.patch_triangles[patch] + i] = out.patch_triangles.back() + i;
      for (std::uint32_t i = 0; i < vertices; ++i)
        vertex_at[old.patch_surface[patch] + i] = out.patch_surface.back() + i;
      out.triangles_end.push_back(out.patch_triangles.back() + triangles);
      out.surface_end.push_back(out.patch_surface.back() + vertices);
      out.patch_triangles.push_back(out.patch_triangles.back() + std::max(triangles, kTrianglesOfRow * rows));
      out.patch_surface.push_back(out.patch_surface.back() + std::max(vertices, rows));
    }
    const std::size_t triangles = out.patch_triangles.back(), vertices = out.patch_surface.back();
    out.triangle_rows.assign(3 * triangles, 0);
    out.triangle_neighbours.assign(3 * triangles, view::kNoTriangle);
    out.triangle_area.assign(triangles, 0);
    out.triangle_moduli.assign(2 * triangles, 0);
    out.triangle_elements.assign(triangles, kNone);
    out.vertex_of_corner.assign(3 * triangles, 0);
    for (std::size_t t = 0; t < triangle_at.size(); ++t) {
      const std::size_t to = triangle_at[t];
      for (std::size_t c = 0; c < 3; ++c) {
        const std::uint32_t neighbour = old.triangle_neighbours[3 * t + c];
        out.triangle_rows[3 * to + c] = old.triangle_rows[3 * t + c];
        out.triangle_neighbours[3 * to + c] = neighbour == view::kNoTriangle ? neighbour : triangle_at[neighbour];
        out.vertex_of_corner[3 * to + c] = vertex_at[old.vertex_of_corner[3 * t + c]];
      }
      out.triangle_area[to] = old.triangle_area[t];
      out.triangle_elements[to] = old.triangle_elements[t];
      for (std::size_t c = 0; c < 2; ++c) out.triangle_moduli[2 * to + c] = old.triangle_moduli[2 * t + c];
    }
    std::vector<std::uint32_t> old_vertex(vertices, kNone);
    for (std::uint32_t v = 0; v < vertex_at.size(); ++v) old_vertex[vertex_at[v]] = v;
    out.surface_rows.assign(vertices, 0);
    for (std::size_t v = 0; v < vertices; ++v) {
      const std::uint32_t from = old_vertex[v];
      const std::uint32_t begin = out.incidence_begin.back();
      std::uint32_t count = 0;
      if (from != kNone) {
        out.surface_rows[v] = old.surface_rows[from];
        out_.surface_vertex[old.surface_rows[from]] = static_cast<std::uint32_t>(v);
        count = old.incidence_begin[from + 1] - old.incidence_begin[from];
      }
      const std::uint32_t room = std::max(count + kSpareIncidences, kRoomOfNewVertex);
      out.incidence.resize(4 * std::size_t{begin + room}, 0);
      for (std::uint32_t i = 0; i < 4 * count; ++i) {
        const std::uint32_t item = old.incidence[4 * std::size_t{old.incidence_begin[from]} + i];
        out.incidence[4 * std::size_t{begin} + i] = i % 4 == 0 ? triangle_at[item] : item;
      }
      out.incidence_end.push_back(begin + count);
      out.incidence_begin.push_back(begin + room);
    }
    for (std::uint32_t face = 0; face < out_.face_element.size(); ++face) {
      if (out_.face_behind[face] != kNone) continue;
      for (std::uint32_t p = out_.pieces.begin[face]; p < out_.pieces.begin[face + 1]; ++p) {
        const auto& rows = out_.pieces.items[p];
        const std::uint32_t vertex = out_.surface_vertex[rows[0]];
        for (std::uint32_t i = out.incidence_begin[vertex]; i < out.incidence_end[vertex]; ++i) {
          const std::uint32_t t = out.incidence[4 * std::size_t{i}];
          if (std::equal(rows.begin(), rows.end(), out.triangle_rows.begin() + 3 * std::ptrdiff_t{t}))
            out_.piece_triangle[p] = t;
        }
        TM_ASSERT(out_.piece_triangle[p] != kNone, "each face of the boundary is a part of the contact surface");
      }
    }
    m_.contact = out;
    out_.contact = std::move(out);
  }

  /// Numbers the visible triangles as clients see them, and reserves points for new vertices.
  void make_room_for_clients() {
    out_.piece_visible.assign(out_.pieces.items.size(), kNone);
    out_.visible_vertex.assign(m_.layout.row_count, kNone);
    if (m_.visible.count() == 0) return;
    std::size_t triangles = 0;
    for (std::size_t b = 0; b < m_.bodies.size(); ++b) {
      const BodyModel& body = m_.bodies[b];
      triangles += body.triangles.size();
      if (body.has_skin) continue;  // clients see nothing of the boundary
      for (std::uint32_t v = 0; v < body.vertex_nodes.size(); ++v) {
        out_.visible_vertex[m_.layout.row_of_node[body.node_begin + body.vertex_nodes[v]]] = v;
      }
      std::uint32_t next = 0;
      for (std::uint32_t e = body.element_begin; e < body.element_begin + body.element_count; ++e) {
        for (const std::uint32_t face : out_.faces[e]) {
          if (out_.face_behind[face] != kNone) continue;
          for (std::uint32_t p = out_.pieces.begin[face]; p < out_.pieces.begin[face + 1]; ++p)
            out_.piece_visible[p] = next++;
        }
      }
      TM_ASSERT(next == body.triangles.size(), "clients see the boundary");
    }
    out_.skin = make_skin_tables(m_, out_);
    const Editing& editing = *m_.editing;
    const auto growth = [](std::size_t now) { return static_cast<std::uint32_t>(now / kGrowthDivisor + kLeastGrowth); };
    // Until a reset each face comes to light once, and each row becomes a vertex once. So does each edge of a skin, as
    // two triangles, and the foot of each of its vertices.
    const std::size_t edges = 3 * out_.skin.neighbours.size();
    out_.max_new_triangles = std::min(editing.max_new_triangles.value_or(growth(triangles)),
                                      static_cast<std::uint32_t>(out_.pieces.items.size() + edges));
    out_.max_new_vertices = std::min(editing.max_new_vertices.value_or(growth(m_.visible.vertex_count)),
                                     m_.layout.row_count + static_cast<std::uint32_t>(out_.skin.feet.size()));
    m_.visible.room = out_.max_new_vertices;
    m_.visible.rows.resize(m_.visible.rows.size() + 4 * std::size_t{out_.max_new_vertices}, 0);
    m_.visible.weights.resize(m_.visible.rows.size(), 0);
  }

  const EditTablesInput& in_;
  const std::vector<ReadBody>& bodies_;
  Model& m_;
  EditTables out_;
};

/// Returns what a scene with editing has and cannot have yet.
const char* unsupported(const Model& m) {
  if (!m.body_contacts.empty()) return "body_contacts";
  return nullptr;
}

}  // namespace

Result<void> make_editable(const EditTablesInput& input, Model& model) {
  if (const char* what = unsupported(model)) {
    return invalid(std::string("scene.editing: a scene with editing cannot have ") + what +
                   " yet; leave one of the two out");
  }
  model.edit_tables = std::make_shared<const EditTables>(TablesMaker(input, model).make());
  const auto stiffens = [](const BodyModel& body) { return body.coagulated_stiffness_factor > 1; };
  if (std::any_of(model.bodies.begin(), model.bodies.end(), stiffens)) {
    model.stiffening.assign(model.edit_tables->element_count(), 1);
  }
  Editor(model).write_all(model);
  return {};
}

}  // namespace tensormass::model
