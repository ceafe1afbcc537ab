#pragma once

/// Sizes of thread blocks that both the host, which launches, and the kernels know.
namespace tensormass::backend::cuda {

inline constexpr unsigned kMaxBlockThreads = 512;
inline constexpr unsigned kWarp = 32;
/// Threads of a block, for stages whose patches neither reduce nor exchange.
inline constexpr unsigned kStageThreads = 128;

}  // namespace tensormass::backend::cuda
