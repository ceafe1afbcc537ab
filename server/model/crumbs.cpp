#include "model/crumbs.h"

#include <algorithm>
#include <array>
#include <map>
#include <numeric>

#include "core/assert.h"
#include "mesh/components.h"

namespace tensormass::model {

namespace {

using mesh::kNone;

/// Calls visit(element, rows, share of its volume) for each whole element and each part.
template <class Visit>
void for_each_copy(const mesh::Cut& cut, const Visit& visit) {
  const mesh::CutTopology& topology = cut.topology();
  for (std::uint32_t element = 0; element < topology.element_count(); ++element) {
    const std::span<const std::uint32_t> nodes = topology.nodes(element);
    if (cut.first_part(element) == kNone) visit(element, nodes, 1.0);
    for (std::uint32_t p = cut.first_part(element); p != kNone; p = cut.parts()[p].next) {
      const mesh::CutPart& part = cut.parts()[p];
      visit(element, std::span<const std::uint32_t>(part.rows).first(nodes.size()), part.shares.volume);
    }
  }
}

/// The pieces of a body, by rows.
class CutPieces {
 public:
  CutPieces(const mesh::Cut& cut, std::span<const double> volumes_m3) : rows_(cut.row_count()), size_(cut.row_count()) {
    for_each_copy(cut, [&](std::uint32_t, std::span<const std::uint32_t> rows, double) {
      for (const std::uint32_t row : rows) rows_.join(rows[0], row);
    });
    for_each_copy(cut, [&](std::uint32_t element, std::span<const std::uint32_t> rows, double share) {
      Size& size = size_[rows_.root(rows[0])];
      size.volume_m3 += share * volumes_m3[element];
      size.of_elements_m3 += volumes_m3[element];
      ++size.copies;
    });
  }
  /// The lowest row of what hangs together with a row.
  std::uint32_t of(std::uint32_t row) { return rows_.root(row); }
  bool is_crumb(std::uint32_t piece) const {
    const Size& size = size_[piece];
    return size.copies * size.volume_m3 < kLeastPiece * size.of_elements_m3;
  }

 private:
  struct Size {
    double volume_m3 = 0, of_elements_m3 = 0;
    std::uint32_t copies = 0;
  };
  mesh::Components rows_;
  std::vector<Size> size_;  // [lowest row]
};

/// The edge by which a crumb stays with the tissue.
struct Bond {
  std::size_t edge;  // index into the edges of the cut
  double reach;      // up to where the crumb has the edge, as part of the edge
};

}  // namespace

void raise_to_least(std::span<double> shares) {
  TM_ASSERT(static_cast<double>(shares.size()) * kLeastShare < 1, "there is enough for each");
  double lack = 0, spare = 0;
  for (const double share : shares) (share < kLeastShare ? lack : spare) += std::abs(share - kLeastShare);
  if (!(lack > 0)) return;
  for (double& share : shares) {
    share = share < kLeastShare ? kLeastShare : share - (share - kLeastShare) * lack / spare;
  }
}

std::vector<mesh::PartShares> shares_in_physics(const mesh::Cut& cut) {
  std::vector<mesh::PartShares> out;
  for (const mesh::CutPart& part : cut.parts()) out.push_back(part.shares);
  std::array<double, mesh::kMaxElementParts> shares;
  for (std::uint32_t element = 0; element < cut.topology().element_count(); ++element) {
    const auto raise = [&](auto&& share_of) {
      std::size_t count = 0;
      for (std::uint32_t p = cut.first_part(element); p != kNone; p = cut.parts()[p].next) {
        shares[count++] = share_of(out[p]);
      }
      raise_to_least(std::span(shares).first(count));
      count = 0;
      for (std::uint32_t p = cut.first_part(element); p != kNone; p = cut.parts()[p].next) {
        share_of(out[p]) = shares[count++];
      }
    };
    if (cut.first_part(element) == kNone) continue;
    raise([](mesh::PartShares& of) -> double& { return of.volume; });
    for (std::size_t k = 0; k < cut.topology().nodes(element).size(); ++k) {
      raise([k](mesh::PartShares& of) -> double& { return of.nodes[k]; });
    }
  }
  return out;
}

std::vector<std::size_t> edges_that_crumbs_keep(const mesh::Cut& cut, std::span<const double> volumes_m3,
                                                std::span<const mesh::CutEdge> edges) {
  CutPieces pieces(cut, volumes_m3);
  std::map<std::uint32_t, Bond> bonds;  // by crumb
  for (std::size_t i = 0; i < edges.size(); ++i) {
    const mesh::EdgeEnds ends = cut.topology().ends(edges[i].edge);
    for (std::size_t end = 0; end < 2; ++end) {
      const std::uint32_t piece = pieces.of(ends[end]);
      if (!pieces.is_crumb(piece) || pieces.of(ends[1 - end]) == piece) continue;
      const double crossing = cut.crossing(edges[i].edge), reach = end == 0 ? crossing : 1 - crossing;
      const auto [bond, is_first] = bonds.try_emplace(piece, Bond{i, reach});
      if (!is_first && reach > bond->second.reach) bond->second = {i, reach};
    }
  }
  std::vector<std::size_t> out;
  for (const auto& [crumb, bond] : bonds) out.push_back(bond.edge);
  std::sort(out.begin(), out.end());
  out.erase(std::unique(out.begin(), out.end()), out.end());
  return out;
}

}  // namespace tensormass::model
