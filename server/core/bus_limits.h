#pragma once

#include <cstddef>
#include <cstdint>

/// Limits of the data plane. A change of them recompiles only what carries messages; limits.h recompiles everything.
namespace tensormass::limits {

/// Poses a second of one client over one transport, a connection or with keys a key. Those beyond it are dropped
/// unread. A scene with every tool at 1 kHz has 16,000.
inline constexpr int kMaxPosesPerSecond = 20'000;
/// Bytes a second [B/s] of the same, with their keys. A pose with the longest key has about 400.
inline constexpr std::size_t kMaxPoseBytesPerSecond = 8 << 20;
/// Time [s] that a client may be ahead of these rates, dropped poses included. One that is further ahead floods, and
/// its connection is closed. A hand sends 5 s of 1 kHz for 16 tools within 4 s after a pause, and stays.
inline constexpr double kMaxPoseLeadS = 5;
/// Bytes of a client's message over zenoh; a larger one is dropped before it is held. zenoh sends what is smaller in
/// one piece, so a lower limit would bound nothing more.
inline constexpr std::uint32_t kMaxZenohMessageBytes = 65'536;
/// Clients connected over zenoh at once unless `--zenoh-sessions` says otherwise, and the most that it may say.
inline constexpr std::uint32_t kDefaultZenohSessions = 512, kMaxZenohSessions = 65'536;
/// Subscriptions, and interests in others' subscriptions, of one zenoh client; a client with more is disconnected. A
/// scene with every tool has 19 streams.
inline constexpr std::uint32_t kMaxZenohDeclarations = 256;
/// The same of all zenoh clients: kDefaultZenohSessions scenes with every tool, and half as many again. When one more
/// comes, the client with most is disconnected, with keys all connections of its key.
inline constexpr std::uint32_t kMaxZenohDeclarationsOfAll = 16'384;
/// Keys that zenoh keeps for the declarations of one client, and bytes of a key; a client beyond is disconnected. The
/// keys of all clients are bounded by kMaxZenohDeclarationsOfAll. The longest key of a stream has 220 bytes.
inline constexpr std::uint32_t kMaxZenohKeys = 512, kMaxZenohKeyBytes = 512;
/// Declarations and queries of one zenoh client, with keys of all connections of a key: so many at once, and so many a
/// second [1/s] after that; a client beyond is disconnected. zenoh answers each, and waits for a client that does not
/// read the answers. A gateway makes seven for each of limits::kMaxScenes scenes.
inline constexpr double kMaxZenohRequestsAtOnce = 4096, kMaxZenohRequestsPerS = 256;
/// Subscriptions of one client at the ZeroMQ publish endpoint; a client with more is disconnected. A scene with every
/// tool has 19 streams.
inline constexpr std::size_t kMaxSubscriptionsPerPeer = 64;
/// Subscriptions of all connections of one key there; a client with more is disconnected. A gateway has three for each
/// of limits::kMaxScenes scenes.
inline constexpr std::size_t kMaxSubscriptionsPerKey = 2048;
/// Connections to each ZeroMQ endpoint at once. Beyond it the oldest one ends that neither subscribed nor sent a pose.
inline constexpr std::size_t kMaxZeroMqConnections = 1024;
/// Bytes of a message to the ZeroMQ publish endpoint; ZeroMQ closes the connection of a client that sends a longer one.
/// The longest key has 220. The handshake's messages count, too, and may bring a client's own properties.
inline constexpr std::int64_t kMaxSubscriptionBytes = 1024;
/// Time between two repetitions of a retained message for late joiners over ZeroMQ [s]. Every subscriber of its key is
/// sent each of them, because ZeroMQ cannot address one.
inline constexpr double kRetainedPeriodS = 1;

}  // namespace tensormass::limits
