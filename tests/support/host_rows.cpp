// GCC does not see that a row without elements uses none of the values that it reads ahead.
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"

#include "support/host_rows.h"

#include <algorithm>
#include <vector>

#include "matrix/rows.h"
#include "physics/lists.h"

// The build defines TM_REAL as float or double.
namespace tensormass::tests {

namespace {

/// The blocks of a row, which a GPU keeps in shared memory.
template <class Real>
class HostBlocks {
 public:
  explicit HostBlocks(std::uint32_t capacity) : columns_(capacity) {}
  std::uint32_t parts() const { return 1; }
  std::uint32_t part() const { return 0; }
  std::uint32_t begin(std::uint32_t column, std::uint32_t count) {
    first_ = column;
    held_ = std::min(count, static_cast<std::uint32_t>(columns_.size()));
    return held_;
  }
  bool holds(std::uint32_t place) const { return place - first_ < held_; }
  void clear(std::uint32_t place, const matrix::RowNeighbour<Real>& neighbour) {
    at(place) = {Mat3<Real>::Zero(), neighbour};
  }
  template <std::size_t Count>
  void add(const std::uint32_t (&places)[Count], const Mat3<Real> (&blocks)[Count], bool adds) {
    for (std::size_t i = 0; adds && i < Count; ++i) {
      if (holds(places[i])) at(places[i]).block += blocks[i];
    }
  }
  Vec3<Real> displacement(std::uint32_t place) const {
    return at(holds(place) ? place : first_).neighbour.displacement;
  }
  Vec3<Real> ahead(std::uint32_t place) const { return at(place).neighbour.ahead; }
  Mat3<Real> block(std::uint32_t place) const { return at(place).block; }
  void meet() const {}
  bool leads(const matrix::RowSums<Real>&) const { return true; }

 private:
  struct Column {
    Mat3<Real> block;
    matrix::RowNeighbour<Real> neighbour;
  };
  Column& at(std::uint32_t place) { return columns_.at(place - first_); }
  const Column& at(std::uint32_t place) const { return columns_.at(place - first_); }
  std::vector<Column> columns_;
  std::uint32_t first_ = 0, held_ = 0;
};

}  // namespace

template <class Real>
void assemble_rows(int shape, int law, const view::SceneView<Real>& s, const view::ElementView<Real>& e,
                   std::uint32_t capacity) {
  physics::with_shape_and_law(shape, law, [&](auto shape_tag, auto law_tag) {
    for (std::uint32_t index = 0; index < e.slice_count; ++index) {
      for (std::uint32_t lane = 0; lane < view::kSliceRows; ++lane) {
        HostBlocks<Real> blocks(capacity);
        matrix::assemble_row<typename decltype(shape_tag)::Type, typename decltype(law_tag)::Type>(
            s.patches, s.state, s.matrix, s.newton, e, index, lane, blocks);
      }
    }
  });
}

template void assemble_rows(int, int, const view::SceneView<TM_REAL>&, const view::ElementView<TM_REAL>&,
                            std::uint32_t);

}  // namespace tensormass::tests
