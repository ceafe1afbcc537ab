#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>

/// Limits of the daemon's own endpoint for Prometheus.
namespace tensormass::limits {

/// Connections at once; when one more comes, the oldest is closed. A scraper needs one.
inline constexpr std::size_t kMaxMetricsConnections = 8;
/// Bytes of a request's headers; a longer one is refused.
inline constexpr std::uint32_t kMaxMetricsHeaderBytes = 8192;
/// Time in which a request must have come, and again in which its answer must be taken. The connection is closed then.
inline constexpr std::chrono::seconds kMaxMetricsTime{5};

}  // namespace tensormass::limits
