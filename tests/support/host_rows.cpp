// GCC does not see that a row without elements uses none of the values that it reads ahead.
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"

#include "support/host_rows.h"

#include <algorithm>
#include <vector>

#include "physics/lists.h"
#include "tensor/rows.h"

// The build defines TM_REAL as float or double.
namespace tensormass::tests {

namespace {

/// The `Blocks` of tensor/rows.h with a fixed number of columns. A device keeps them in shared memory.
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
  void clear(std::uint32_t place, const tensor::RowNeighbour<Real>& neighbour) {
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
  bool leads(const tensor::RowSums<Real>&) const { return true; }

 private:
  struct Column {
    Mat3<Real> block;
    tensor::RowNeighbour<Real> neighbour;
  };
  Column& at(std::uint32_t place) { return columns_.at(place - first_); }
  const Column& at(std::uint32_t place) const { return columns_.at(place - first_); }
  std::vector<Column> columns_;
  std::uint32_t first_ = 0, held_ = 0;
};

/// A team that processes the rows of one patch one by one.
struct RowTeam {
  std::uint32_t index;
  std::uint32_t patch() const { return index; }
  template <class Body>
  void for_each(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    for (std::uint32_t i = begin; i < end; ++i) body(i);
  }
};

}  // namespace

template <class Real>
void assemble_rows(int shape, int law, const tensor::SceneView<Real>& s, const tensor::ElementView<Real>& e,
                   std::uint32_t capacity) {
  physics::with_shape_and_law(shape, law, [&](auto shape_tag, auto law_tag) {
    for (std::uint32_t patch = 0; e.decompositions != nullptr && patch < s.patch_count; ++patch) {
      tensor::decompose<typename decltype(shape_tag)::Type>(RowTeam{patch}, s, e);
    }
    for (std::uint32_t index = 0; index < e.slice_count; ++index) {
      for (std::uint32_t lane = 0; lane < tensor::kSliceRows; ++lane) {
        HostBlocks<Real> blocks(capacity);
        tensor::assemble_row<typename decltype(shape_tag)::Type, typename decltype(law_tag)::Type>(s, e, index, lane,
                                                                                                   blocks);
      }
    }
  });
}

template <class Real>
void finish_rows(bool has_constant, const tensor::SceneView<Real>& s) {
  for (std::uint32_t patch = 0; patch < s.patch_count; ++patch) {
    if (has_constant) {
      tensor::finish_rows<true>(RowTeam{patch}, s);
    } else {
      tensor::finish_rows<false>(RowTeam{patch}, s);
    }
  }
}

template void assemble_rows(int, int, const tensor::SceneView<TM_REAL>&, const tensor::ElementView<TM_REAL>&,
                            std::uint32_t);
template void finish_rows(bool, const tensor::SceneView<TM_REAL>&);

}  // namespace tensormass::tests
