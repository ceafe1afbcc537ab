#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>

/// Limits of what a client of the control plane may do with HTTP/2, beside what it asks of gRPC. A connection that
/// passes one is closed.
namespace tensormass::limits {

/// Connections at once; a further one is closed. With keys, a connection counts when its handshake is done.
inline constexpr std::size_t kMaxControlConnections = 512;
/// Connections that shake hands of TLS at once. When one more comes, the oldest is closed.
inline constexpr std::size_t kMaxShaking = 64;
/// Calls that a connection may have open at once.
inline constexpr std::size_t kMaxStreamsPerConnection = 256;
/// Bytes of the headers of a call, in all frames. gRPC itself takes 8 KiB after it has put them together.
inline constexpr std::size_t kMaxHeaderBlockBytes = std::size_t{64} << 10;
/// Calls that a connection may give up: so many at once, and so many a second [1/s] after that. Fewer than gRPC has
/// threads: each of them may hold one for a moment, and a call that finds none is refused.
inline constexpr double kMaxResetsAtOnce = 48, kMaxResetsPerS = 24;
/// Frames of PING, SETTINGS and PRIORITY, in the same way.
inline constexpr double kMaxControlFramesAtOnce = 1000, kMaxControlFramesPerS = 100;
/// Bytes of messages that have not arrived as a whole, of all connections. The largest message fits, and another half.
inline constexpr std::uint64_t kMaxHalfSentBytes = std::uint64_t{768} << 20;
/// Time in which the next bytes of a message must come.
inline constexpr std::chrono::seconds kMaxMessagePause{30};

}  // namespace tensormass::limits
