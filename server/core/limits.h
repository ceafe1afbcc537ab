#pragma once

#include <cstddef>
#include <cstdint>

/// Every limit of the server, with its unit and what happens beyond it. Error messages name the limit by its
/// identifier.
namespace tensormass::limits {

/// Scenes loaded at once in one daemon; a further load is refused.
inline constexpr std::size_t kMaxScenes = 256;
/// Bodies of one scene; a scene with more is refused.
inline constexpr std::size_t kMaxBodies = 64;
/// Triangles, or vertices, by which a scene may let its surface grow; a scene with more is refused.
inline constexpr std::uint32_t kMaxNewSurface = 10'000'000;
/// Elements in one edit of a scene; an edit of more is refused. Each takes some microseconds between two steps.
inline constexpr std::size_t kMaxElementsOfEdit = 1024;
/// Tools of one scene; a scene with more is refused.
inline constexpr std::size_t kMaxTools = 16;
/// Joints of a tool, numbers that describe its shape, and points of its core; a kind with more does not compile.
inline constexpr std::size_t kMaxToolJoints = 4;
inline constexpr std::size_t kMaxToolParameters = 4;
inline constexpr std::size_t kMaxCorePoints = 4;
/// Contacts between bodies, and attachments, of one scene; a scene with more is refused.
inline constexpr std::size_t kMaxBodyContacts = 256;
inline constexpr std::size_t kMaxAttachments = 256;
/// Findings of a load that are kept: each status has them. The last one says how many more there are.
inline constexpr std::size_t kMaxFindings = 64;
/// Findings that a scene accepts, and bytes of the reason for one; a scene with more is refused.
inline constexpr std::size_t kMaxAcceptedFindings = 256;
inline constexpr std::size_t kMaxReasonLength = 1024;
/// Pairs of nodes of an attachment's two regions; an attachment with more is refused. The reader tests every pair.
inline constexpr std::size_t kMaxAttachmentPairs = 100'000'000;
/// Bytes of a body's picture; a body with a larger one is refused. Each late subscriber is sent it with the topology.
inline constexpr std::size_t kMaxTextureBytes = std::size_t{8} << 20;
/// Largest texture coordinate; a picture that repeats more often is refused.
inline constexpr float kMaxTextureCoordinate = 1000;
/// Triangles of a tool's surface; a tool with more is refused.
inline constexpr std::size_t kMaxToolTriangles = 100'000;
/// Range of ToolPose.valid_for_s [s].
inline constexpr double kMinPoseValidForS = 0.02, kMaxPoseValidForS = 3600;
/// Nodes of one scene; a scene with more is refused. Node indices have 32 bits.
inline constexpr std::uint32_t kMaxNodes = 1u << 26;
/// Elements of one scene; a scene with more is refused.
inline constexpr std::uint32_t kMaxElements = 50'000'000;
/// Characters of a scene's, body's or tool's name; a longer name is refused.
inline constexpr std::size_t kMaxNameLength = 64;
/// Bytes of one gRPC message; the transport refuses a larger scene. A node takes 24 bytes, a tetrahedron 16, a
/// hexahedron 32: ten million tetrahedra fit.
inline constexpr std::size_t kMaxControlMessageBytes = std::size_t{512} << 20;
/// Bytes of one message from a client on the data plane. A larger message is dropped and counted as malformed. Beyond 1
/// MiB ZeroMQ closes the connection instead, and nothing is counted.
inline constexpr std::size_t kMaxPoseMessageBytes = 4096;
/// Steps that one StepScene call may ask for; a call for more is refused.
inline constexpr std::uint32_t kMaxStepsPerCall = 1'000'000;
/// Rates of steps, frames and status messages that a scene may ask for [Hz].
inline constexpr double kMinRateHz = 1e-3;
inline constexpr double kMaxRateHz = 20'000.0;
/// Simulated time that one step advances [s].
inline constexpr double kMinTimeStepS = 1e-6;
inline constexpr double kMaxTimeStepS = 10.0;
/// Conjugate-gradient iterations of one linear solve. A step makes one linear solve for each Newton iteration.
inline constexpr std::uint32_t kMaxCgIterations = 100'000;
/// Wall time that a scene may allow for one step [s].
inline constexpr double kMinBudgetS = 1e-6;
inline constexpr double kMaxBudgetS = 10.0;
/// CPU threads of one scene.
inline constexpr std::uint32_t kMaxCpuThreads = 256;
/// Largest number of concurrent scenes among which a daemon can be configured to share one GPU.
inline constexpr std::uint32_t kMaxGpuScenes = 4096;
/// Largest coordinate [m] or velocity [m/s] accepted as input. Single precision resolves only 6 cm there.
inline constexpr double kMaxLength = 1e6;

/// Named sets of a body; a body with more is refused. Each set stores a list of its nodes.
inline constexpr std::size_t kMaxSets = 256;
/// Regions of one set; a set with more is refused. The reader tests every node against each region.
inline constexpr std::size_t kMaxRegionsOfSet = 1024;
/// Parts of a body with a law of their own; a body with more is refused. Each part may become a separate pass over
/// elements.
inline constexpr std::size_t kMaxLawRegions = 64;
/// Entries in each of a body's lists of fixed, prescribed and loaded nodes; a body with more is refused. The reader
/// tests every node against each entry.
inline constexpr std::size_t kMaxBoundaryConditions = 65'536;
/// Points of one schedule; a schedule with more is refused.
inline constexpr int kMaxSchedulePoints = 100'000;
/// Largest force [N] and largest pressure [Pa] accepted as a load.
inline constexpr double kMaxForceN = 1e12;
inline constexpr double kMaxPressurePa = 1e12;
/// Largest coefficient of Coulomb friction.
inline constexpr double kMaxFriction = 10;
/// Newton iterations of one step.
inline constexpr std::uint32_t kMaxNewtonIterations = 10'000;
inline constexpr std::uint32_t kMaxTangentLagSteps = 64;

}  // namespace tensormass::limits
