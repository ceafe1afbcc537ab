#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <span>

#include "core/assert.h"

namespace tensormass {

/// Asserts that offsets divide `size` items into `count` ranges: there are count + 1, from 0 to `size`, never
/// descending.
///
///   offsets = {0, 3, 3, 7}: ranges [0, 3), [3, 3), [3, 7)      count = 3, size = 7
inline void assert_offsets(std::span<const std::uint32_t> offsets, std::size_t count, std::size_t size) {
  TM_ASSERT(offsets.size() == count + 1, "each range has an offset, and so has the end of the last");
  TM_ASSERT(offsets.front() == 0 && offsets.back() == size, "the ranges cover all items");
  TM_ASSERT(std::is_sorted(offsets.begin(), offsets.end()), "offsets do not descend");
}

}  // namespace tensormass
