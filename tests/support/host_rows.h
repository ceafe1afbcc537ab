#pragma once

#include <algorithm>
#include <array>
#include <vector>

#include "physics/lists.h"
#include "tensor/rows.h"

/// tensor/rows.h on the host, where a test can look at it: one row after the other.
namespace tensormass::tests {

/// What a device keeps in near memory. A small capacity makes rows come in turns.
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
  void clear(std::uint32_t place, const Vec3<Real>& stretch) { at(place) = {Mat3<Real>::Zero(), stretch}; }
  void add(std::uint32_t place, const Mat3<Real>& block) { at(place).block += block; }
  Vec3<Real> stretch(std::uint32_t place) { return at(place).stretch; }
  Mat3<Real> block(std::uint32_t place) { return at(place).block; }
  void meet() const {}
  bool leads(const tensor::RowSums<Real>&) const { return true; }

 private:
  struct Column {
    Mat3<Real> block;
    Vec3<Real> stretch;
  };
  Column& at(std::uint32_t place) { return columns_.at(place - first_); }
  std::vector<Column> columns_;
  std::uint32_t first_ = 0, held_ = 0;
};

/// All rows of a group. shape, law: indices of physics::Shapes and Laws.
template <class Real>
void assemble_rows(int shape, int law, const tensor::SceneView<Real>& s, const tensor::ElementView<Real>& e,
                   std::uint32_t capacity) {
  physics::with_shape_and_law(shape, law, [&](auto shape_tag, auto law_tag) {
    for (std::uint32_t index = 0; index < e.slice_count; ++index) {
      for (std::uint32_t lane = 0; lane < tensor::kSliceRows; ++lane) {
        HostBlocks<Real> blocks(capacity);
        tensor::assemble_row<typename decltype(shape_tag)::Type, typename decltype(law_tag)::Type>(s, e, index, lane,
                                                                                                   blocks);
      }
    }
  });
}

/// A patch, its rows one by one.
struct RowTeam {
  std::uint32_t index;
  std::uint32_t patch() const { return index; }
  template <class Body>
  void for_each(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    for (std::uint32_t i = begin; i < end; ++i) body(i);
  }
};

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

}  // namespace tensormass::tests
