#pragma once

#include <cstdint>

namespace tensormass::world {

/// Who sends a pose. A client moves a tool that no other client claims (pose_inbox.h); the operator takes it over.
enum class PoseSource : std::uint8_t { kClient, kOperator };

}  // namespace tensormass::world
