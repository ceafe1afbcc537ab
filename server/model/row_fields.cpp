#include <algorithm>
#include <cmath>

#include "model/compile_parts.h"
#include "model/cut_bodies.h"
#include "model/scene_input.h"
#include "physics/element/element.h"
#include "tensormass/v1/scene.pb.h"

/// Makes the vectors that have an entry for each row: rest positions, masses and damping.
///
///   rest     [row] X, Y, Z, bits of the free directions: 7, until boundary conditions fix some
///   inertia  [row] m_kk, α, β, √(ρ_max / ρ); the last is 1 if links couple bodies; quasi-static scenes: 0, 0, 0, 1
///   gap row  zeros, and 1 as the last entry of inertia
///
/// Symbols:
///   m_kl   ρ ∫ N_k N_l dV, consistent mass [kg]; lumped mass has m_kk only
///   α, β   Rayleigh damping: C = α M + β K [1/s, s]
///   ρ      density of the body; ρ_max that of the densest body [kg/m³]
namespace tensormass::model {

Result<std::vector<Damping>> read_damping(const v1::Scene& scene) {
  std::vector<Damping> all;
  for (const v1::Body& body : scene.bodies()) {
    const std::string where = "body '" + body.name() + "'";
    TM_ASSIGN_OR_RETURN(alpha, read_number(body.rayleigh_mass_per_s(), 0, 1e9, where + ".rayleigh_mass_per_s"));
    TM_ASSIGN_OR_RETURN(beta, read_number(body.rayleigh_stiffness_s(), 0, 1e9, where + ".rayleigh_stiffness_s"));
    all.push_back({alpha, beta});
  }
  return all;
}

RowFields make_row_fields(const ReadBodies& all, std::span<const Damping> damping, const ReadLinks& links,
                          const Settings& settings, const matrix::Layout& layout) {
  const std::vector<ReadBody>& bodies = all.bodies;
  const std::size_t rows = layout.row_count;
  const bool inertia = !settings.quasi_static();
  RowFields out;
  out.rest.assign(4 * rows, 0);
  out.inertia.assign(4 * rows, 0);
  out.row_mass.assign(rows, 0);
  for (std::size_t row = 0; row < rows; ++row) out.inertia[4 * row + 3] = 1;  // gap rows too: stages divide by it
  Vec3<double> low = all.merged.nodes.front(), high = low;
  for (const auto& node : all.merged.nodes) {
    low = low.cwiseMin(node);
    high = high.cwiseMax(node);
  }
  out.size_m = (high - low).norm();
  double densest = 0;
  for (const ReadBody& body : bodies) densest = std::max(densest, body.density_kg_per_m3);
  bool consistent = false;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    const ReadBody& body = bodies[b];
    consistent = consistent || (body.consistent_mass && inertia);
    for (std::uint32_t node = 0; node < body.node_count; ++node) {
      const std::size_t row = layout.row_of_node[body.node_begin + node];
      for (std::size_t i = 0; i < 3; ++i)
        out.rest[4 * row + i] = all.merged.nodes[body.node_begin + node][static_cast<Eigen::Index>(i)];
      out.rest[4 * row + 3] = 7;  // all directions are free
      if (!inertia) continue;
      out.inertia[4 * row + 1] = damping[b].mass_per_s;
      out.inertia[4 * row + 2] = damping[b].stiffness_s;
      if (links.empty()) out.inertia[4 * row + 3] = std::sqrt(densest / body.density_kg_per_m3);
    }
  }
  if (consistent) out.mass_edges.assign(layout.slot_count(), 0);

  for_each_element(
      all, [&](auto tag, std::size_t b, std::uint32_t element, std::span<const std::uint32_t> nodes, const auto& x) {
        using Shape = typename decltype(tag)::Type;
        const double density = bodies[b].density_kg_per_m3;
        const mesh::PartShares* const part = part_of(bodies[b], element).shares;
        const auto row = [&](int k) { return std::size_t{layout.row_of_node[nodes[static_cast<std::size_t>(k)]]}; };
        if (!bodies[b].consistent_mass) {
          const auto volumes = physics::lumped_volumes<Shape>(x);
          for (int k = 0; k < Shape::kNodes; ++k) {
            const double whole = density * volumes[static_cast<std::size_t>(k)];
            const double mass = part == nullptr ? whole : whole * part->nodes[static_cast<std::size_t>(k)];
            out.row_mass[row(k)] += mass;
            if (inertia) out.inertia[4 * row(k)] += mass;
          }
          return;
        }
        auto integrals = physics::mass_integrals<Shape>(x);
        if (part != nullptr) integrals *= part->volume;
        for (int k = 0; k < Shape::kNodes; ++k) {
          out.row_mass[row(k)] += density * integrals.row(k).sum();
          if (!inertia) continue;
          out.inertia[4 * row(k)] += density * integrals(k, k);
          for (int l = k + 1; l < Shape::kNodes; ++l) {
            layout.for_each_place(static_cast<std::uint32_t>(row(k)), static_cast<std::uint32_t>(row(l)),
                                  [&](std::uint32_t slot, bool) { out.mass_edges[slot] += density * integrals(k, l); });
          }
        }
      });
  return out;
}

}  // namespace tensormass::model
