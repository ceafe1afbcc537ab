#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

#include <cuda_runtime.h>

#include "backend/backend.h"
#include "backend/cuda/current_device.cuh"
#include "backend/cuda/graph.cuh"
#include "backend/cuda/memory.cuh"
#include "backend/edited_state.h"
#include "core/assert.h"

/// An edit of a scene on the device: the host lists what to write, one kernel writes it.
///
///   for_each_write ──> EditQueue, page-locked ──> scatter: a thread for each entry reads it and writes it
///
/// 1. The entries of an edit lie anywhere, so a copy for each would take far longer than all of them.
/// 2. An edit runs between two launches of the step's graph, in the same stream. No buffer moves, so the graph stays as
///    it was captured.
namespace tensormass::backend::cuda {

/// A value of at most four bytes, and where it goes.
struct Scattered {
  void* to;
  std::uint32_t value;
  std::uint32_t bytes;  ///< 1, 2 or 4
};

/// A template, because several sources include it.
template <class Entry>
__global__ void scatter(const Entry* entries, std::uint32_t count) {
  const std::uint32_t i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= count) return;
  const Entry entry = entries[i];
  if (entry.bytes == 4) *static_cast<std::uint32_t*>(entry.to) = entry.value;
  if (entry.bytes == 2) *static_cast<std::uint16_t*>(entry.to) = static_cast<std::uint16_t>(entry.value);
  if (entry.bytes == 1) *static_cast<std::uint8_t*>(entry.to) = static_cast<std::uint8_t>(entry.value);
}
template <class Real>
__global__ void hold_rows(const view::SceneView<Real> scene, const std::uint32_t* rows, std::uint32_t count) {
  const std::uint32_t i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i < count) hold_row(scene, rows[i]);
}
/// moves: [count, 2] from, to; a triangle may move more than once, so each thread makes all of them in order
template <class Real>
__global__ void move_slips(const view::SceneView<Real> scene, const std::uint32_t* moves, std::uint32_t count) {
  const std::uint32_t i = blockIdx.x * blockDim.x + threadIdx.x;
  if (i >= slips_of_triangle(scene.contact)) return;
  for (std::uint32_t m = 0; m < count; ++m) move_slip(scene.contact, i, moves[2 * m], moves[2 * m + 1]);
}

/// Returns the entries that write some bytes. to: on the device
template <class Add>
void split_into_entries(void* to, const void* from, std::size_t bytes, const Add& add) {
  for (std::size_t at = 0; at < bytes; at += 4) {
    Scattered entry{static_cast<char*>(to) + at, 0, static_cast<std::uint32_t>(std::min<std::size_t>(bytes - at, 4))};
    std::memcpy(&entry.value, static_cast<const char*>(from) + at, entry.bytes);
    add(entry);
  }
}

/// A stream and memory for edits that are brought to the device while the scene steps. cudaFree would wait for the
/// work of all streams, and the device's own pool gives memory back to the system whenever a stream is waited for, a
/// step's too. This pool keeps what it once had, and so does the page-locked memory on the host.
class EditMemory {
 public:
  EditMemory() {
    cudaMemPoolProps of{};
    of.allocType = cudaMemAllocationTypePinned;
    of.location.type = cudaMemLocationTypeDevice;
    of.location.id = device_;
    check(cudaMemPoolCreate(&pool_, &of), "memory of edits");
    std::uint64_t kept_bytes = std::numeric_limits<std::uint64_t>::max();
    if (const cudaError_t set = cudaMemPoolSetAttribute(pool_, cudaMemPoolAttrReleaseThreshold, &kept_bytes);
        set != cudaSuccess) {
      cudaMemPoolDestroy(pool_);
      check(set, "memory of edits");
    }
  }
  EditMemory(const EditMemory&) = delete;
  EditMemory& operator=(const EditMemory&) = delete;
  ~EditMemory() {
    use_device_if_possible(device_);
    cudaMemPoolDestroy(pool_);
  }

  /// Brings entries to the device and waits until they are there. Any thread may call it. Returns memory of the pool,
  /// and writes how many entries it has.
  ///
  ///   fill(entries)   writes at most `room` entries and returns their number
  template <class Fill>
  Scattered* bring(std::size_t room, const Fill& fill, std::uint32_t& count) {
    const std::lock_guard lock(mutex_);
    if (!staging_ || staging_->size() < room) staging_.emplace(room);
    count = static_cast<std::uint32_t>(fill(staging_->data()));
    TM_ASSERT(count <= room, "entries have room");
    if (count == 0) return nullptr;
    const std::size_t bytes = count * sizeof(Scattered);
    Scattered* entries = nullptr;
    check(cudaMallocFromPoolAsync(reinterpret_cast<void**>(&entries), bytes, pool_, stream_.get()),
          "memory of an edit");
    try {
      check(cudaMemcpyAsync(entries, staging_->data(), bytes, cudaMemcpyHostToDevice, stream_.get()), "edit");
      check(cudaStreamSynchronize(stream_.get()), "edit");
    } catch (...) {
      cudaFreeAsync(entries, stream_.get());
      throw;
    }
    return entries;
  }

  /// Gives memory back that `bring` returned.
  void release(Scattered* entries) const {
    use_device_if_possible(device_);
    cudaFreeAsync(entries, stream_.get());
  }

 private:
  const int device_ = current_device();
  const Stream stream_ = make_stream();
  cudaMemPool_t pool_ = nullptr;
  std::mutex mutex_;
  std::optional<Pinned<Scattered>> staging_;  // guarded by mutex_
};

/// Entries in device memory, brought there while the scene steps.
class DeviceEntries final : public PreparedEdit {
 public:
  /// room, fill: see EditMemory::bring
  template <class Fill>
  DeviceEntries(std::shared_ptr<EditMemory> memory, std::size_t room, const Fill& fill)
      : memory_(std::move(memory)), entries_(memory_->bring(room, fill, count_)) {}
  DeviceEntries(const DeviceEntries&) = delete;
  DeviceEntries& operator=(const DeviceEntries&) = delete;
  /// Needs the kernel of `run` to have ended.
  ~DeviceEntries() override {
    if (entries_ != nullptr) memory_->release(entries_);
  }
  void run(cudaStream_t stream) const {
    constexpr unsigned kThreads = 256;
    if (count_ == 0) return;
    scatter<<<(count_ + kThreads - 1) / kThreads, kThreads, 0, stream>>>(static_cast<const Scattered*>(entries_),
                                                                         count_);
    check(cudaGetLastError(), "edit");
  }

 private:
  const std::shared_ptr<EditMemory> memory_;
  std::uint32_t count_ = 0;
  Scattered* const entries_;
};

/// Brings what some ranges of a model say to the device. scene, groups: the buffers that will take it
template <class Real>
std::unique_ptr<PreparedEdit> bring_entries(const std::shared_ptr<EditMemory>& memory, const model::Model& model,
                                            const std::vector<model::EditRange>& ranges,
                                            const model::SceneBuffers& scene,
                                            const std::vector<model::GroupBuffers<Real>>& groups) {
  std::size_t values = 0;
  for (const model::EditRange& range : ranges) values += range.count;
  const auto fill = [&](Scattered* entries) {
    std::size_t count = 0;
    const auto add = [&](const Scattered& entry) { entries[count++] = entry; };
    model::for_each_write<Real>(model, ranges, scene, groups, [&](void* to, const void* from, std::size_t bytes) {
      split_into_entries(to, from, bytes, add);
    });
    return count;
  };
  // No type of a buffer that edits write has more than 8 bytes.
  return std::make_unique<DeviceEntries>(memory, 2 * values, fill);
}

/// Collects entries and numbers in page-locked memory and launches the kernels that read them there.
class EditQueue {
 public:
  /// editable: false if the scene never changes; it then has no memory.
  explicit EditQueue(bool editable) : entries_(editable ? kEntries : 0), numbers_(editable ? kNumbers : 0) {}

  /// Starts an edit: waits for the kernels of the last one, which read the same memory.
  void begin(cudaStream_t stream) {
    if (running_ || numbers_running_) check(cudaStreamSynchronize(stream), "edit");
    running_ = numbers_running_ = false;
    used_ = 0;
  }
  void write(void* to, const void* from, std::size_t bytes, cudaStream_t stream) {
    split_into_entries(to, from, bytes, [&](const Scattered& entry) {
      if (used_ == entries_.size()) flush(stream);
      entries_.data()[used_++] = entry;
    });
  }
  /// Launches what has been collected.
  void end(cudaStream_t stream) {
    if (used_ == 0) return;
    const auto count = static_cast<std::uint32_t>(used_);
    scatter<<<(count + kThreads - 1) / kThreads, kThreads, 0, stream>>>(entries_.data(), count);
    check(cudaGetLastError(), "edit");
    running_ = true;
  }
  /// Calls launch(numbers, count) with numbers in page-locked memory, part by part; each part has whole groups.
  template <class Launch>
  void with_numbers(const std::uint32_t* from, std::size_t count, std::size_t group, cudaStream_t stream,
                    const Launch& launch) {
    const std::size_t most = numbers_.size() / group * group;
    for (std::size_t at = 0; at < count; at += most) {
      if (numbers_running_) check(cudaStreamSynchronize(stream), "edit");
      const std::size_t part = std::min(most, count - at);
      std::copy_n(from + at, part, numbers_.data());
      launch(numbers_.data(), static_cast<std::uint32_t>(part / group));
      check(cudaGetLastError(), "edit");
      numbers_running_ = true;
    }
  }
  static constexpr unsigned kThreads = 128;

 private:
  static constexpr std::size_t kEntries = std::size_t{1} << 15, kNumbers = std::size_t{1} << 13;

  void flush(cudaStream_t stream) {
    end(stream);
    check(cudaStreamSynchronize(stream), "edit");
    running_ = false;
    used_ = 0;
  }

  Pinned<Scattered> entries_;
  Pinned<std::uint32_t> numbers_;
  std::size_t used_ = 0;
  bool running_ = false, numbers_running_ = false;  // kernels may still read that memory
};

}  // namespace tensormass::backend::cuda
