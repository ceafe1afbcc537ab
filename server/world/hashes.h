#pragma once

#include <bit>
#include <cstdint>
#include <span>
#include <string_view>

#include "backend/backend.h"
#include "model/model.h"

namespace tensormass::v1 {
class Scene;
}

/// Hashes of 64 bits that tell whether two scenes, layouts or states are the same. They find mistakes and damage; they
/// do not protect against somebody who looks for a collision.
namespace tensormass::world {

/// Mixes words one after the other: h' = mix(h ^ word), with the finalizer of SplitMix64 (Steele, Lea, Flood 2014).
class Hash {
 public:
  void add(std::uint64_t word) {
    std::uint64_t x = (value_ ^ word) + 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    value_ = x ^ (x >> 31);
  }
  /// Adds every bit of the number, so that 0.0 and -0.0 differ.
  void add(double number) { add(std::bit_cast<std::uint64_t>(number)); }
  /// Adds the length and the bytes.
  void add(std::string_view bytes);

  std::uint64_t value() const { return value_; }

 private:
  std::uint64_t value_ = 0;
};

/// Hash of a scene without what a step does not depend on: its name, its clock, its streams and its number of threads.
std::uint64_t hash_of(const v1::Scene& scene);
/// Hash of the order of a model's nodes in memory, its patches and its precision.
std::uint64_t hash_of_layout(const model::Model& model);
/// Hash of displacements, velocities and internal variables. row_of_node: matrix::Layout::row_of_node.
std::uint64_t hash_of(const backend::RowState& state, std::span<const std::uint32_t> row_of_node);

}  // namespace tensormass::world
