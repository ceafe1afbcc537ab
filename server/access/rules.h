#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string_view>

/// Who may do what: the only table of rules. gRPC, ZeroMQ and zenoh all ask it.
///
///     a client's key ──> its role, its scene and tool (client_list.h)
///                             ├─ a call of the control plane ──> kCalls
///                             ├─ a subscription, or a get ─────> kStreams
///                             └─ a put ────────────────────────> kPuts
///
/// What is not in the table is refused. tests/access holds it against every call of control.proto and every key of
/// stream.proto. docs/security.md says what each role is for.
namespace tensormass::access {

enum class Role : std::uint8_t { kOperator, kHand, kViewer, kRecorder, kMetrics };
inline constexpr std::array<std::string_view, 5> kRoleNames{"operator", "hand", "viewer", "recorder", "metrics"};

/// How far a right goes. A hand has a scene and a tool; other roles have no right that is limited to their own.
enum class Reach : std::uint8_t { kNone, kOwnTool, kOwnScene, kAll };

struct Rule {
  /// A call's full name, or the end of a key after its scene, with * for a tool.
  std::string_view what;
  std::array<Reach, kRoleNames.size()> reach;
};

namespace detail {
inline constexpr Reach NO = Reach::kNone, TOOL = Reach::kOwnTool, SCENE = Reach::kOwnScene, ALL = Reach::kAll;
}  // namespace detail

// clang-format off
/// Calls. A call without a scene in its request needs ALL.
inline constexpr auto kCalls = [] {
  using namespace detail;
  return std::to_array<Rule>({
      //                                               operator hand   viewer recorder metrics
      {"tensormass.v1.Control/GetVersion",            {ALL,     ALL,   ALL,   ALL,     ALL}},
      {"tensormass.v1.Control/ListScenes",            {ALL,     NO,    ALL,   ALL,     ALL}},
      {"tensormass.v1.Control/GetStatus",             {ALL,     SCENE, ALL,   ALL,     ALL}},
      {"tensormass.v1.Control/GetMetrics",            {ALL,     NO,    NO,    NO,      ALL}},
      {"tensormass.v1.Control/GetTopology",           {ALL,     SCENE, ALL,   ALL,     NO}},
      {"tensormass.v1.Control/GetFrame",              {ALL,     SCENE, ALL,   ALL,     NO}},
      {"tensormass.v1.Control/GetFeedback",           {ALL,     TOOL,  ALL,   ALL,     NO}},
      {"tensormass.v1.Control/GetPositions",          {ALL,     NO,    ALL,   ALL,     NO}},
      {"tensormass.v1.Control/GetFields",             {ALL,     NO,    ALL,   ALL,     NO}},
      {"tensormass.v1.Control/RecordScene",           {ALL,     NO,    NO,    ALL,     NO}},
      {"tensormass.v1.Control/SnapshotScene",         {ALL,     NO,    NO,    ALL,     NO}},
      {"tensormass.v1.Control/LoadScene",             {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/LoadSceneWithProgress", {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/InspectScene",          {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/UnloadScene",           {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/PauseScene",            {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/ResumeScene",           {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/StepScene",             {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/ResetScene",            {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/MoveTool",              {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/ReplayScene",           {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/RestoreScene",          {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/AdjustScene",           {ALL,     NO,    NO,    NO,      NO}},
      {"tensormass.v1.Control/EditScene",             {ALL,     NO,    NO,    NO,      NO}},
  });
}();

/// Keys that a client may subscribe to, and ask for with zenoh's get.
inline constexpr auto kStreams = [] {
  using namespace detail;
  return std::to_array<Rule>({
      //                  operator hand   viewer recorder metrics
      {"topology",        {ALL,    SCENE, ALL,   ALL,     NO}},
      {"frame",           {ALL,    SCENE, ALL,   ALL,     NO}},
      {"changes",         {ALL,    SCENE, ALL,   ALL,     NO}},
      {"status",          {ALL,    SCENE, ALL,   ALL,     ALL}},
      {"events",          {ALL,    SCENE, ALL,   ALL,     NO}},
      {"tool/*/feedback", {ALL,    TOOL,  ALL,   ALL,     NO}},
  });
}();

/// Keys that a client may put.
inline constexpr auto kPuts = [] {
  using namespace detail;
  return std::to_array<Rule>({
      //              operator hand  viewer recorder metrics
      {"tool/*/pose", {ALL,    TOOL, NO,    NO,      NO}},
  });
}();
// clang-format on

/// Who asks: a role, and the scene and tool of a hand.
struct Subject {
  Role role;
  std::string_view scene;
  std::string_view tool;
};

/// Returns the rule of a call or key; nullptr if the table has none.
template <std::size_t kCount>
constexpr const Rule* find_rule(const std::array<Rule, kCount>& rules, std::string_view what) {
  for (const Rule& rule : rules) {
    if (rule.what == what) return &rule;
  }
  return nullptr;
}

/// Returns whether `who` has the right of `rule` for a scene and a tool. Empty names: the request names none.
constexpr bool allows(const Rule* rule, const Subject& who, std::string_view scene, std::string_view tool) {
  if (rule == nullptr) return false;
  switch (rule->reach[static_cast<std::size_t>(who.role)]) {
    case Reach::kAll:
      return true;
    case Reach::kOwnScene:
      return who.role == Role::kHand && !scene.empty() && scene == who.scene;
    case Reach::kOwnTool:
      return who.role == Role::kHand && !scene.empty() && !tool.empty() && scene == who.scene && tool == who.tool;
    case Reach::kNone:
      break;
  }
  return false;
}

constexpr bool may_call(const Subject& who, std::string_view call, std::string_view scene, std::string_view tool) {
  return allows(find_rule(kCalls, call), who, scene, tool);
}

}  // namespace tensormass::access
