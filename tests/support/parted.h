#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "mesh/components.h"
#include "support/cutting.h"

/// Bodies that are cut in two, with the pieces apart.
namespace tensormass::tests {

/// Returns what hangs together: [row of the body] the lowest row of its piece.
inline std::vector<std::uint32_t> pieces_by_row(const mesh::Cut& cut) {
  const mesh::CutTopology& topology = cut.topology();
  mesh::Components components(topology.node_count() + cut.virtual_nodes().size());
  const auto join = [&](const auto& rows, std::size_t count) {
    for (std::size_t k = 1; k < count; ++k) components.join(rows[0], rows[k]);
  };
  for (std::uint32_t element = 0; element < topology.element_count(); ++element) {
    const std::size_t count = topology.nodes(element).size();
    std::uint32_t part = cut.first_part(element);
    if (part == mesh::kNone) join(topology.nodes(element), count);
    for (; part != mesh::kNone; part = cut.parts()[part].next) join(cut.parts()[part].rows, count);
  }
  std::vector<std::uint32_t> out(topology.node_count() + cut.virtual_nodes().size());
  for (std::uint32_t row = 0; row < out.size(); ++row) out[row] = components.root(row);
  return out;
}

/// Cuts a body along a plane that is normal to an axis, all through it.
inline void cut_across(CutBody& body, int axis, double at_m) {
  constexpr double kFarM = 1;
  const Eigen::Vector3d middle = at_m * Eigen::Vector3d::Unit(axis);
  const Eigen::Vector3d along = kFarM * Eigen::Vector3d::Unit((axis + 1) % 3),
                        way = kFarM * Eigen::Vector3d::Unit((axis + 2) % 3);
  body.move({middle - along - way, middle + along - way}, {middle - along + way, middle + along + way});
}

/// Fixture for scenes of one body that starts cut, with its pieces at other places than where they were cut.
class OnBackendWithParts : public OnBackendWithCuts {
 protected:
  /// moved_m(piece): how far a piece is away. piece: its lowest row
  template <class Moved>
  std::unique_ptr<world::World> start_apart(const v1::Scene& scene, const CutBody& body, const Moved& moved_m) const {
    const auto before = start(scene);
    std::unique_ptr<world::World> after = start_cut(scene, body.cuts());
    world::World::Saved saved = before->save();
    auto tissue = world::cut_state(before->model(), saved.tissue, after->model());
    if (!tissue) throw std::runtime_error(tissue.error().message);
    saved.tissue = std::move(*tissue);
    const std::vector<std::uint32_t> pieces = pieces_by_row(body.body().cut());
    for (std::size_t row = 0; row < pieces.size(); ++row) {
      const Eigen::Vector3d way = moved_m(pieces[row]);
      for (std::size_t c = 0; c < 3; ++c) {
        saved.tissue.displacement[3 * row + c] += way[static_cast<Eigen::Index>(c)];
      }
    }
    after->take_over(saved);
    return after;
  }
};

}  // namespace tensormass::tests
