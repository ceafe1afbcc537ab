#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include "core/result.h"
#include "model/model.h"
#include "world/world.h"

/// Snapshots of a scene: bytes for a file or a call (SnapshotState in recording.proto has their form).
namespace tensormass::world {

/// The state of a scene's loop between two steps.
///   world   World::Saved, or World::Copied in the order of its layout
template <class OfWorld>
struct LoopStateOf {
  OfWorld world;
  std::uint64_t next_diagnostics = 0;  ///< step after which the elements are checked next
};
using LoopState = LoopStateOf<World::Saved>;
using LoopCopy = LoopStateOf<World::Copied>;

inline LoopState by_node(const model::Model& model, const LoopCopy& copy) {
  return {World::by_node(model, copy.world), copy.next_diagnostics};
}
inline LoopCopy in_layout(const model::Model& model, const LoopState& state) {
  return {World::in_layout(model, state.world), state.next_diagnostics};
}

/// Puts the header in front of a content (SnapshotState).
std::string seal_snapshot(const std::string& content);
/// Returns a header and the state. scene_hash: hash_of the scene that the model was compiled from.
std::string write_snapshot(const model::Model& model, std::uint64_t scene_hash, const LoopState& state);
/// Reads a snapshot for a loaded scene, whatever backend or number of threads it was made on. Refuses with the reason
/// what is not a snapshot, damaged, of another version or scene, or has numbers that no step of the scene ends with.
Result<LoopState> read_snapshot(const model::Model& model, std::uint64_t scene_hash, std::string_view bytes);

}  // namespace tensormass::world
