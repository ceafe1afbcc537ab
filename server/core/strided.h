#pragma once

#include <cstdint>

#include "core/scalar.h"

namespace tensormass {

/// Calls use(i, read(i)) for i = begin, begin + step, ... below end, in this order.
///
/// Why: on a GPU each read is a chain of dependent loads, and the compiler cannot move a read above a write that `use`
/// makes. So `kAtOnce` reads are issued before the first of them is used, which hides their latency.
///
///   read(i)         returns a value. Called for up to kAtOnce indices before the first is used. In the last,
///                   incomplete batch it is called again with the first index: it must have no side effects
///   use(i, value)   is called once for each i, in increasing order. It must not change what `read` returns
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
