#include "world/placement.h"

#include <algorithm>
#include <limits>
#include <tuple>
#include <utility>

#include "core/assert.h"

namespace tensormass::world {

std::optional<std::size_t> choose_device(std::span<const DeviceLoad> devices, const DeviceNeeds& needs) {
  std::optional<std::size_t> best;
  // Ascending: no room, taken share, taken memory.
  std::tuple<bool, double, double> least{true, std::numeric_limits<double>::infinity(), 0};
  for (std::size_t i = 0; i < devices.size(); ++i) {
    const DeviceLoad& device = devices[i];
    if (device.lost) continue;
    const bool has_room = device.free >= needs.bytes && device.total > 0;
    const std::uint64_t left = device.free - std::min(device.free, needs.bytes);
    const double memory = device.total > 0 ? 1 - static_cast<double>(left) / static_cast<double>(device.total) : 1;
    const std::tuple taken{!has_room, std::max(device.share + needs.share, memory), memory};
    if (best && taken >= least) continue;
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
    : read_memory_(std::move(read_memory)) {
  TM_ASSERT(!devices.empty(), "scenes are placed on GPUs");
  for (const std::uint32_t number : devices) devices_.push_back({number});
}

std::shared_ptr<Placement> Placement::of_this_machine() {
  std::vector<std::uint32_t> devices = backend::list_cuda_devices();
  return devices.empty() ? nullptr : std::make_shared<Placement>(std::move(devices));
}

Result<std::uint32_t> Placement::choose(const DeviceNeeds& needs) {
  std::vector<DeviceLoad> loads(devices_.size());
  std::vector<std::uint64_t> promised(devices_.size());
  for (const Place* place : places_) {
    const auto device =
        std::find_if(devices_.begin(), devices_.end(), [&](const Device& one) { return one.number == place->device_; });
    const auto at = static_cast<std::size_t>(device - devices_.begin());
    const Use use = place->use_ ? place->use_() : Use{place->needs_.share, false};
    loads[at].share += use.share;
    device->lost |= use.lost;
    promised[at] += place->needs_.bytes;
  }
  for (std::size_t i = 0; i < devices_.size(); ++i) {
    loads[i].lost = devices_[i].lost;
    if (loads[i].lost || devices_.size() == 1) continue;  // with one there is no choice, and no need to ask it
    const auto memory = read_memory_(devices_[i].number);
    if (!memory) continue;
    loads[i].total = memory->total;
    loads[i].free = memory->free - std::min(memory->free, promised[i]);
  }
  const auto chosen = choose_device(loads, needs);
  if (chosen) return devices_[*chosen].number;
  return fail(ErrorCode::kUnavailable, "every GPU has failed in this process; start the daemon again");
}

Result<std::unique_ptr<Placement::Place>> Placement::place(const DeviceNeeds& needs) {
  const std::lock_guard lock(mutex_);
  TM_ASSIGN_OR_RETURN(device, choose(needs));
  std::unique_ptr<Place> place(new Place(shared_from_this(), device, needs));
  places_.push_back(place.get());
  return place;
}

Result<std::uint32_t> Placement::preview(const DeviceNeeds& needs) {
  const std::lock_guard lock(mutex_);
  return choose(needs);
}

Placement::Place::~Place() {
  const std::lock_guard lock(of_->mutex_);
  std::erase(of_->places_, this);
}

void Placement::Place::lose() noexcept {
  const std::lock_guard lock(of_->mutex_);
  for (Device& device : of_->devices_) device.lost |= device.number == device_;
}

void Placement::Place::follow(ReadUse use) {
  const std::lock_guard lock(of_->mutex_);
  needs_.bytes = 0;
  use_ = std::move(use);
}

}  // namespace tensormass::world
