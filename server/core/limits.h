#pragma once

#include <cstddef>
#include <cstdint>

/// Every limit of the server, with its unit and what happens beyond it. Reaching one is reported by this name.
namespace tensormass::limits {

/// Scenes loaded at once in one daemon; a further load is refused.
inline constexpr std::size_t kMaxScenes = 256;
/// Bodies of one scene; a scene with more is refused.
inline constexpr std::size_t kMaxBodies = 64;
/// Tools of one scene; a scene with more is refused.
inline constexpr std::size_t kMaxTools = 16;
/// Nodes of one scene. Rows and positions are indexed with 32 bits; larger scenes are refused.
inline constexpr std::uint32_t kMaxNodes = 1u << 26;
/// Elements of one scene; a scene with more is refused.
inline constexpr std::uint32_t kMaxElements = 50'000'000;
/// Characters of a scene's, body's or tool's name.
inline constexpr std::size_t kMaxNameLength = 64;
/// Bytes of one gRPC message; a larger scene is refused by the transport. 24 bytes a node + 16 a tetrahedron (32 a
/// hexahedron): ten million tetrahedra fit.
inline constexpr std::size_t kMaxControlMessageBytes = std::size_t{512} << 20;
/// Bytes of one message from a client on the data plane; a larger one is dropped and counted as malformed. ZeroMQ cuts
/// the connection at 1 MiB, uncounted.
inline constexpr std::size_t kMaxPoseMessageBytes = 4096;
/// Steps that one StepScene call may ask for.
inline constexpr std::uint32_t kMaxStepsPerCall = 1'000'000;
/// Steps, frames and status messages a second that a scene may ask for [Hz].
inline constexpr double kMinRateHz = 1e-3;
inline constexpr double kMaxRateHz = 20'000.0;
/// Simulated time of a step [s].
inline constexpr double kMinTimeStepS = 1e-6;
inline constexpr double kMaxTimeStepS = 10.0;
/// Conjugate-gradient iterations of one solve; a step has as many solves as outer iterations.
inline constexpr std::uint32_t kMaxCgIterations = 100'000;
/// Time that a scene may ask its steps to take [s].
inline constexpr double kMinBudgetS = 1e-6;
inline constexpr double kMaxBudgetS = 10.0;
/// CPU threads of one scene.
inline constexpr std::uint32_t kMaxCpuThreads = 256;
/// Scenes that a daemon is told to make room for on one GPU.
inline constexpr std::uint32_t kMaxGpuScenes = 4096;
/// Largest coordinate, pose or velocity input that is accepted [m, m/s]; beyond it single precision has no metres left.
inline constexpr double kMaxLength = 1e6;

/// Named sets of a body, which each hold their nodes; a body with more is refused.
inline constexpr std::size_t kMaxSets = 256;
/// Regions of one set; a set with more is refused. Reading one looks at every node.
inline constexpr std::size_t kMaxRegionsOfSet = 1024;
/// Parts of a body with a law of their own; each may become a pass of its own. A body with more is refused.
inline constexpr std::size_t kMaxLawRegions = 64;
/// Entries of fixed, of prescribed and of loads of a body; a body with more is refused. Reading one looks at every
/// node.
inline constexpr std::size_t kMaxBoundaryConditions = 65'536;
/// Points of one schedule.
inline constexpr int kMaxSchedulePoints = 100'000;
/// Largest force of a load and largest pressure that is accepted [N, Pa].
inline constexpr double kMaxForceN = 1e12;
inline constexpr double kMaxPressurePa = 1e12;
/// Outer iterations of one step.
inline constexpr std::uint32_t kMaxNewtonIterations = 10'000;

}  // namespace tensormass::limits
