#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <span>
#include <vector>

#include "backend/devices.h"
#include "core/result.h"

/// Which GPU a scene steps on.
///
///     load: compile ──needs──> Placement::place ──> Place: the number of a GPU, for the life of the scene
///                                   │    ^
///                    free memory of │    │ share of its GPU that each scene takes, measured
///                    each GPU <─────┘    │
///                                   the scenes that step
///
/// A scene never moves: its next worlds, as after a cut, are made on the same GPU. Two scenes on one GPU take time from
/// each other, so a scene goes where the resource that is scarcest after it, time or memory, is least taken. A GPU that
/// is lost (device_loss.h) ends the process with all of its scenes.
namespace tensormass::world {

/// What a scene takes of a GPU.
struct DeviceNeeds {
  std::uint64_t bytes = 0;  ///< buffers in its memory
  double share = 0;         ///< share of its time and multiprocessors, from 0 to 1 (share_of_device)
};

/// A GPU as the choice sees it.
struct DeviceLoad {
  std::uint64_t free = 0;   ///< memory that neither a process nor a load under way has taken [bytes]
  std::uint64_t total = 0;  ///< memory [bytes]; 0: it does not answer
  double share = 0;         ///< sum of the shares of its scenes
};

/// Returns the place in `devices` for a scene: least of max(share of time, share of memory) with the scene on it. Of
/// those that are equal, the one with more free memory, then the first. A GPU without room is chosen only if none has
/// room; the load then fails and says so. Needs one GPU at least.
std::size_t choose_device(std::span<const DeviceLoad> devices, const DeviceNeeds& needs);

/// Returns the share of a GPU that a scene takes: the part of the multiprocessors that its blocks can occupy, times the
/// part of the time in which they do.
/// rate_hz: steps a second; 0: it steps when it is asked, as fast as it can. step_s: time of a step
double share_of_device(std::uint32_t patches, std::uint32_t multiprocessors, double rate_hz, double step_s);

/// The GPUs of a process. All methods may be called from any thread.
class Placement : public std::enable_shared_from_this<Placement> {
 public:
  using ReadShare = std::function<double()>;  ///< DeviceNeeds::share of a scene that steps; waits for no step
  using ReadMemory = std::function<Result<backend::DeviceMemory>(std::uint32_t device)>;

  /// devices: their numbers, one at least. read_memory: outlives every place.
  explicit Placement(std::vector<std::uint32_t> devices, ReadMemory read_memory = backend::read_cuda_memory);
  /// Returns the placement over the GPUs of this machine, or nullptr if it has none.
  static std::shared_ptr<Placement> of_this_machine();

  /// The place of a scene, as long as it lives.
  class Place {
   public:
    ~Place();
    Place(const Place&) = delete;
    Place& operator=(const Place&) = delete;
    /// Number of the GPU.
    std::uint32_t device() const { return device_; }
    /// Call it when the buffers are allocated: from then on the GPU itself counts them. share: called by later
    /// placements, until the place ends.
    void follow(ReadShare share);

   private:
    friend class Placement;
    Place(std::shared_ptr<Placement> of, std::uint32_t device, DeviceNeeds needs)
        : of_(std::move(of)), device_(device), needs_(needs) {}
    const std::shared_ptr<Placement> of_;
    const std::uint32_t device_;
    // Guarded by of_->mutex_.
    DeviceNeeds needs_;
    ReadShare share_;
  };
  /// Chooses a GPU and takes a place on it.
  std::unique_ptr<Place> place(const DeviceNeeds& needs);
  /// Returns the GPU that a scene with these needs would get now, without taking a place.
  std::uint32_t preview(const DeviceNeeds& needs);

  std::size_t device_count() const { return devices_.size(); }

 private:
  std::uint32_t choose(const DeviceNeeds& needs);

  const std::vector<std::uint32_t> devices_;
  const ReadMemory read_memory_;
  std::mutex mutex_;
  std::vector<Place*> places_;  // guarded by mutex_
};

}  // namespace tensormass::world
