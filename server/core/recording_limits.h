#pragma once

#include <chrono>
#include <cstddef>

/// Limits of recordings, with their unit and what happens beyond them. A file of their own, because limits.h is part of
/// every kernel.
namespace tensormass::limits {

/// Steps that one ReplayScene call may make; a call for more is refused.
inline constexpr int kMaxReplayedSteps = 1000;
/// Steps of a recording that may wait for its reader: eight seconds at 1 kHz. A further step is lost, and the stream
/// says so.
inline constexpr std::size_t kRecordedSteps = 8192;
/// Checks of a recording that may wait for its reader; each holds a copy of the scene's state. A further check is lost.
inline constexpr std::size_t kRecordedChecks = 8;
/// Edits of a recording that may wait for its reader, and their bytes: a restored snapshot is one. The step after a
/// further edit is lost, and the stream says so. One edit always fits.
inline constexpr std::size_t kRecordedEdits = 256;
inline constexpr std::size_t kMaxRecordedEditBytes = std::size_t{256} << 20;
/// Time in which the reader of a recording must take something. After it, a client that wants to record the scene ends
/// the recording.
inline constexpr std::chrono::milliseconds kRecordingLease{10'000};
/// Nodes whose displacement a check of a recording contains.
inline constexpr std::size_t kSampledNodes = 256;

}  // namespace tensormass::limits
