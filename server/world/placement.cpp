#include "world/placement.h"

#include <algorithm>
#include <tuple>
#include <utility>

#include "core/assert.h"

namespace tensormass::world {

std::size_t choose_device(std::span<const DeviceLoad> devices, const DeviceNeeds& needs) {
  TM_ASSERT(!devices.empty(), "scenes are placed on GPUs");
  std::size_t best = 0;
  // Ascending: no room, taken share, taken memory.
  std::tuple<bool, double, double> least;
  for (std::size_t i = 0; i < devices.size(); ++i) {
    const DeviceLoad& device = devices[i];
    const bool has_room = device.free >= needs.bytes && device.total > 0;
    const std::uint64_t left = device.free - std::min(device.free, needs.bytes);
    const double memory = device.total > 0 ? 1 - static_cast<double>(left) / static_cast<double>(device.total) : 1;
    const std::tuple taken{!has_room, std::max(device.share + needs.share, memory), memory};
    if (i > 0 && taken >= least) continue;
    best = i;
    least = taken;
  }
  return best;
}

double share_of_device(std::uint32_t patches, std::uint32_t multiprocessors, double rate_hz, double step_s) {
  TM_ASSERT(multiprocessors > 0 && rate_hz >= 0 && step_s >= 0, "a device and a step");
  const double blocks = std::min(1.0, static_cast<double>(patches) / multiprocessors);
  return rate_hz > 0 ? blocks * std::min(1.0, rate_hz * step_s) : blocks;
}

Placement::Placement(std::vector<std::uint32_t> devices, ReadMemory read_memory)
    : devices_(std::move(devices)), read_memory_(std::move(read_memory)) {
  TM_ASSERT(!devices_.empty(), "scenes are placed on GPUs");
}

std::shared_ptr<Placement> Placement::of_this_machine() {
  std::vector<std::uint32_t> devices = backend::list_cuda_devices();
  return devices.empty() ? nullptr : std::make_shared<Placement>(std::move(devices));
}

std::uint32_t Placement::choose(const DeviceNeeds& needs) {
  if (devices_.size() == 1) return devices_.front();  // no choice, and no need to ask it
  std::vector<DeviceLoad> loads(devices_.size());
  std::vector<std::uint64_t> promised(devices_.size());
  for (const Place* place : places_) {
    const auto device = std::find(devices_.begin(), devices_.end(), place->device_);
    const auto at = static_cast<std::size_t>(device - devices_.begin());
    loads[at].share += place->share_ ? place->share_() : place->needs_.share;
    promised[at] += place->needs_.bytes;
  }
  for (std::size_t i = 0; i < devices_.size(); ++i) {
    const auto memory = read_memory_(devices_[i]);
    if (!memory) continue;
    loads[i].total = memory->total;
    loads[i].free = memory->free - std::min(memory->free, promised[i]);
  }
  return devices_[choose_device(loads, needs)];
}

std::unique_ptr<Placement::Place> Placement::place(const DeviceNeeds& needs) {
  const std::lock_guard lock(mutex_);
  std::unique_ptr<Place> place(new Place(shared_from_this(), choose(needs), needs));
  places_.push_back(place.get());
  return place;
}

std::uint32_t Placement::preview(const DeviceNeeds& needs) {
  const std::lock_guard lock(mutex_);
  return choose(needs);
}

Placement::Place::~Place() {
  const std::lock_guard lock(of_->mutex_);
  std::erase(of_->places_, this);
}

void Placement::Place::follow(ReadShare share) {
  const std::lock_guard lock(of_->mutex_);
  needs_.bytes = 0;
  share_ = std::move(share);
}

}  // namespace tensormass::world
