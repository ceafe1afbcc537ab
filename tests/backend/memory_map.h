#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include <gtest/gtest.h>

/// What tests of CUDA's memory layouts share: types that stand for CUDA's, and a check that no byte has two owners.
namespace tensormass::tests {

/// Stands for float4, uint2 and float2.
struct alignas(16) Cell {
  float x, y, z, w;
};
struct alignas(8) Words {
  std::uint32_t x, y;
};

/// A block of memory in which each byte may be taken once.
class MemoryMap {
 public:
  explicit MemoryMap(std::size_t bytes) : cells_(bytes / sizeof(Cell) + 1), taken_(bytes, 0) {}

  Cell* begin() { return cells_.data(); }
  /// Takes `count` items at `items`. They must be aligned, within the memory, and not taken yet.
  template <class Item>
  void take(const Item* items, std::size_t count, const char* what) {
    const auto* const memory = reinterpret_cast<const std::byte*>(cells_.data());
    const auto first = static_cast<std::size_t>(reinterpret_cast<const std::byte*>(items) - memory);
    const std::size_t bytes = count * sizeof(Item);
    ASSERT_EQ(first % alignof(Item), 0u) << what << " is not aligned";
    ASSERT_LE(first + bytes, taken_.size()) << what << " ends beyond the memory";
    for (std::size_t i = first; i < first + bytes; ++i) {
      ASSERT_EQ(taken_[i], 0) << what << " overlaps at byte " << i;
      taken_[i] = 1;
    }
  }
  bool takes_all() const {
    for (const char byte : taken_) {
      if (byte == 0) return false;
    }
    return true;
  }

 private:
  std::vector<Cell> cells_;
  std::vector<char> taken_;
};

}  // namespace tensormass::tests
