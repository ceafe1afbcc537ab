#pragma once

#include <cstdint>

#include "core/scalar.h"

/// Places of a patch's tetrahedra and of their nodes, for the inversion check at the end of a solve (patch_volume.cuh).
/// A tetrahedron is four local numbers of 16 bits (matrix/patch_tetrahedra.h), read as two words.
namespace tensormass::backend::cuda {

/// Tetrahedra in a line of the cache, 128 bytes.
inline constexpr std::uint32_t kTetrahedraInLine = 16;

/// Returns the local number of node k. low: word with the nodes 0 and 1. high: with 2 and 3.
TM_HOST_DEVICE constexpr std::uint32_t local_of_node(std::uint32_t low, std::uint32_t high, std::uint32_t k) {
  return (k < 2 ? low : high) >> (16 * (k % 2)) & 0xFFFF;
}
/// Returns the i-th tetrahedron that a thread reads at once, from t < end on. Beyond the end it is the last one again,
/// which is harmless.
TM_HOST_DEVICE constexpr std::uint32_t tetrahedron_ahead(std::uint32_t t, std::uint32_t i, std::uint32_t threads,
                                                         std::uint32_t end) {
  return minimum(t + i * threads, end - 1);
}

}  // namespace tensormass::backend::cuda
