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
/// Connections that were told why they end, and so long for each until it has read that. A further one is closed at
/// once.
inline constexpr std::size_t kMaxLeaving = 64;
inline constexpr std::chrono::seconds kLeaveTime{1};
/// Connections of one key at once; a further one is closed. A program has one for each daemon that it talks to.
inline constexpr std::size_t kMaxConnectionsPerKey = 64;
/// Calls that a connection may have open at once. With keys, all connections of a key together.
inline constexpr std::size_t kMaxStreamsPerConnection = 256;
/// Bytes of the headers of a call, in all frames. gRPC itself takes 8 KiB after it has put them together.
inline constexpr std::size_t kMaxHeaderBlockBytes = std::size_t{64} << 10;
/// Calls that a connection, or a key, may give up: so many at once, and so many a second [1/s] after that. Fewer than
/// gRPC has threads: each of them may hold one for a moment, and a call that finds none is refused.
inline constexpr double kMaxResetsAtOnce = 48, kMaxResetsPerS = 24;
/// Frames of PING, SETTINGS and PRIORITY, in the same way.
inline constexpr double kMaxControlFramesAtOnce = 1000, kMaxControlFramesPerS = 100;
/// CPU time of the relay's thread that the connections of a key may cost: so much at once [s], and after that such a
/// share of it. All bytes, frames and handshakes of a client cost it. Beyond it the key's connections are closed.
inline constexpr double kMaxRelayCpuAtOnceS = 10, kMaxRelayCpuShare = 0.5;
/// Bytes of messages that have not arrived as a whole, of all connections, unless `--max-message-mib` says otherwise;
/// and so of the largest message. Beyond it the connection ends that holds most for longest. Ten million tetrahedra
/// fit.
inline constexpr std::uint64_t kDefaultHalfSentBytes = std::uint64_t{200} << 20;
/// A message up to so many bytes is let in whatever the daemon holds, so that one without room can be told to unload.
inline constexpr std::uint64_t kSmallMessageBytes = std::uint64_t{1} << 20;
/// Time in which the next bytes of a message must come.
inline constexpr std::chrono::seconds kMaxMessagePause{30};

}  // namespace tensormass::limits
