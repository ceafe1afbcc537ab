#pragma once

#include <cstdint>
#include <initializer_list>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/scene.pb.h"

namespace tensormass::daemon {

/// The files of `--state`: each loaded scene, and the newest snapshots of it.
///
///     DIR/NAME.scene          the scene as it was loaded
///     DIR/NAME.17.snapshot    a generation; the newest has the highest number
///     DIR/aside/              what was damaged or could not be loaded, the last of each scene
///
/// A file is a header of 96 bytes, little-endian, and a content with a SHA-256 of both (`FileHeader` in the source).
///
/// - Atomic: a file is written under another name, synced and renamed. So a process or a machine that ends midway
/// leaves
///   the files before it as they were. Older generations go when the new one is complete.
/// - Untrusted: sizes are bounded, and sum and form are checked before anything is parsed. A damaged file is an error
///   that names it, and the caller takes the next one.
/// - One daemon: the folder is locked while it is open.
///
/// All methods may be called from any thread.
class StateStore {
 public:
  struct Snapshot {
    std::string version;  ///< the daemon that made it had this one
    bool paused = false;
    v1::SceneAdjustments adjustments;
    std::string snapshot;  ///< as SnapshotScene answers it
  };
  /// The right to write snapshots of a scene, which ends when the scene is removed.
  using Ticket = std::uint64_t;

  /// Opens the folder, which is made if only its last part is missing. Removes what a process left half-written.
  /// version: of this daemon, at most 31 characters. max_bytes: of all files together.
  /// Fails with kInvalidArgument if others can write the folder, and with kUnavailable if another daemon has it.
  static Result<std::unique_ptr<StateStore>> open(const std::string& folder, std::string version,
                                                  std::uint64_t max_bytes);
  ~StateStore();
  StateStore(const StateStore&) = delete;
  StateStore& operator=(const StateStore&) = delete;

  /// Names of the scenes that have a file, sorted.
  std::vector<std::string> scenes() const;
  Result<v1::Scene> read_scene(const std::string& name) const;
  /// Numbers of a scene's snapshots, the newest first.
  std::vector<std::uint64_t> generations(const std::string& name) const;
  Result<Snapshot> read_snapshot(const std::string& name, std::uint64_t generation) const;

  /// Writes the scene. What was there under its name is removed before. Fails with kUnavailable if the disk takes it
  /// not, and with kResourceExhausted beyond `max_bytes`; the name has no files then.
  Result<Ticket> add(const v1::Scene& scene);
  /// The ticket of a scene that has files already.
  Ticket ticket(const std::string& name) const;
  /// Writes a generation, and removes those beyond limits::kStateGenerations. If it fails, the generations before it
  /// are as they were. Does nothing if the ticket has ended.
  Result<void> write(const std::string& name, Ticket ticket, const Snapshot& snapshot);
  /// Removes the files of a scene.
  void remove(const std::string& name);
  /// Moves a snapshot, or a scene with its newest snapshot, to `aside`. The other snapshots of that scene are removed.
  void move_to_aside(const std::string& name, std::uint64_t generation);
  void move_to_aside(const std::string& name);

  const std::string& version() const { return version_; }
  std::string path_of(const std::string& file) const { return folder_ + "/" + file; }

 private:
  struct Scene {
    Ticket ticket = 0;
    std::uint64_t bytes = 0;
    std::map<std::uint64_t, std::uint64_t> generations;  // number -> bytes
    std::uint64_t next_generation = 1;
  };

  StateStore(std::string folder, std::string version, std::uint64_t max_bytes);
  Result<void> scan();
  Result<void> reserve(std::uint64_t bytes);
  void release(std::uint64_t bytes);
  /// Writes a complete file under a temporary name. Returns its size.
  Result<std::string> write_unfinished(std::uint32_t kind, bool paused, std::string_view first,
                                       std::string_view second);
  void remove_generation(const std::string& name, Scene& scene, std::uint64_t generation);
  void move_aside(const std::string& file, const std::string& to, std::uint64_t bytes);
  void remove_locked(const std::string& name);

  const std::string folder_, version_;
  const std::uint64_t max_bytes_;
  int directory_ = -1, aside_ = -1;
  mutable std::mutex mutex_;  // guards all below; held while files are renamed and removed, never while one is written
  std::map<std::string, Scene> scenes_;
  std::map<std::string, std::uint64_t> aside_bytes_;
  std::uint64_t bytes_ = 0;  // all files, and those that are being written
  std::uint64_t next_ticket_ = 1, next_unfinished_ = 1;
};

}  // namespace tensormass::daemon
