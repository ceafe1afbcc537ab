#pragma once

namespace tensormass::limits {

/// Threads of the control server. gRPC answers a call beyond them with RESOURCE_EXHAUSTED.
inline constexpr int kMaxControlThreads = 72;
/// Calls at once that may take as long as their client likes: loads, inspections, steps, replays, recordings,
/// snapshots, adjustments and fields. A further one is refused.
inline constexpr int kMaxLongCalls = 40;
/// Calls at once that wait for the end of a step: frames, positions, feedback, pause, resume. A further one is refused.
inline constexpr int kMaxWaitingCalls = 12;
/// ResetScene calls at once, which wait for the end of a step, too. They have a share of their own: a reset ends what
/// others do to a scene.
inline constexpr int kMaxResetCalls = 4;
/// Threads of the health server, and bytes of a question to it. A further call, or a longer one, is refused.
inline constexpr int kMaxHealthThreads = 4, kMaxHealthMessageBytes = 4096;

}  // namespace tensormass::limits
