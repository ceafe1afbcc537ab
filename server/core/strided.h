#pragma once

#include <cstdint>

#include "core/scalar.h"

namespace tensormass {

/// Calls use(i, read(i)) for every `step`-th i in [begin, end). Reads are under way several at a time: each is a chain
/// of reads that depend on each other, and none could begin behind what `use` writes.
template <std::uint32_t kAtOnce = 8, class Read, class Use>
TM_HOST_DEVICE void for_each_strided(std::uint32_t begin, std::uint32_t end, std::uint32_t step, const Read& read,
                                     const Use& use) {
  for (std::uint32_t first = begin; first < end; first += kAtOnce * step) {
    decltype(read(first)) values[kAtOnce];
    TM_UNROLL_ALL
    for (std::uint32_t i = 0; i < kAtOnce; ++i) values[i] = read(first + i * step < end ? first + i * step : first);
    TM_UNROLL_ALL
    for (std::uint32_t i = 0; i < kAtOnce; ++i) {
      if (first + i * step < end) use(first + i * step, values[i]);
    }
  }
}

}  // namespace tensormass
