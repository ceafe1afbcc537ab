#pragma once

#include <algorithm>
#include <cstddef>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include <cuda_runtime.h>

/// Memory of a scene on a device, and its exchange with the host.
///
///   host                                    device
///   Pinned, inside StepInputs ── one copy ─> StepInputs::device       inputs of a step
///   Pinned <───────────────────── kernels write                       reports of a step
///                                           DeviceArena               all other buffers of a scene
///
/// 1. All inputs of a step travel in one copy, because each copy takes time to start.
/// 2. Kernels write reports straight to page-locked host memory. No copy follows the last kernel.
/// 3. Small buffers share blocks, because an allocation or a release may wait for the work of other scenes.
namespace tensormass::backend::cuda {

struct CudaFailure : std::runtime_error {
  using std::runtime_error::runtime_error;
};

inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw CudaFailure(std::string(what) + ": " + cudaGetErrorString(status));
}

/// Buffers of a scene in device memory (model/bind.h says what an arena is). Small ones share blocks of kBlockBytes,
/// the size in which the driver hands out memory.
class DeviceArena {
 public:
  DeviceArena() = default;
  DeviceArena(const DeviceArena&) = delete;
  DeviceArena& operator=(const DeviceArena&) = delete;
  ~DeviceArena() {
    for (void* block : blocks_) cudaFree(block);
  }

  template <class T, class U>
  T* constant(std::string_view name, const std::vector<U>& items) {
    return filled<T>(name, items.size(), [&](T* to) {
      std::transform(items.begin(), items.end(), to, [](U item) { return static_cast<T>(item); });
    });
  }
  template <class T, class Fill>
  T* generated(std::string_view name, std::size_t count, const Fill& fill) {
    return filled<T>(name, count, fill);
  }
  template <class T>
  T* zeros(std::string_view, std::size_t count) {
    if (count == 0) return nullptr;
    return static_cast<T*>(take(count * sizeof(T)));
  }
  /// A buffer that steps only read.
  struct Constant {
    std::string_view name;
    const void* items;
    std::size_t bytes;
  };
  const std::vector<Constant>& constants() const { return constants_; }

 private:
  template <class T, class Fill>
  T* filled(std::string_view name, std::size_t count, const Fill& fill) {
    T* copy = zeros<T>(name, count);
    if (count == 0) return copy;
    constants_.push_back({name, copy, count * sizeof(T)});
    std::vector<T> items(count);
    fill(items.data());
    check(cudaMemcpy(copy, items.data(), count * sizeof(T), cudaMemcpyHostToDevice), "upload");
    return copy;
  }
  /// Returns cleared memory that is aligned for every type.
  void* take(std::size_t bytes) {
    constexpr std::size_t kAlignment = 256, kBlockBytes = std::size_t{2} << 20;
    bytes = (bytes + kAlignment - 1) / kAlignment * kAlignment;
    if (bytes > left_) {
      const std::size_t size = std::max(bytes, kBlockBytes);
      void* block = nullptr;
      check(cudaMalloc(&block, size), "device memory of the scene's buffers");
      blocks_.push_back(block);
      check(cudaMemset(block, 0, size), "clear");
      if (size - bytes < left_) return block;  // the previous block has more room left
      next_ = static_cast<char*>(block);
      left_ = size;
    }
    void* taken = next_;
    next_ += bytes;
    left_ -= bytes;
    return taken;
  }

  std::vector<void*> blocks_;
  std::vector<Constant> constants_;
  char* next_ = nullptr;
  std::size_t left_ = 0;
};

/// Page-locked host memory. Copies to and from it run while kernels do, and kernels can write to it.
template <class T>
class Pinned {
 public:
  explicit Pinned(std::size_t count, const T& value = {}) : count_(count) {
    if (count > 0) check(cudaMallocHost(&data_, count * sizeof(T)), "page-locked host memory");
    std::fill_n(data_, count, value);
  }
  Pinned(const Pinned&) = delete;
  Pinned& operator=(const Pinned&) = delete;
  ~Pinned() { cudaFreeHost(data_); }
  T* data() const { return data_; }
  std::size_t size() const { return count_; }
  std::span<T> span() const { return {data_, count_}; }
  std::size_t bytes() const { return count_ * sizeof(T); }

 private:
  std::size_t count_;
  T* data_ = nullptr;
};

/// Copies from or to page-locked memory. May return before the copy has ended.
template <class T>
void copy_to_device(T* to, const Pinned<T>& from, cudaStream_t stream, const char* what) {
  if (from.size() == 0) return;
  check(cudaMemcpyAsync(to, from.data(), from.bytes(), cudaMemcpyHostToDevice, stream), what);
}
template <class T>
void copy_to_host(const Pinned<T>& to, const T* from, cudaStream_t stream) {
  if (to.size() == 0) return;
  check(cudaMemcpyAsync(to.data(), from, to.bytes(), cudaMemcpyDeviceToHost, stream), "results");
}

/// The inputs of a step, in host memory and in device memory. One copy brings them all.
class StepInputs {
 public:
  template <class T>
  struct Item {
    T* host;
    T* device;
  };
  /// bytes: the sum of bytes_of() over all items that add() will be asked for.
  explicit StepInputs(std::size_t bytes, DeviceArena& arena)
      : host_(bytes), device_(arena.zeros<std::byte>("what a step is told", bytes)) {}
  template <class T>
  /// Bytes that an item of `count` values takes.
  static std::size_t bytes_of(std::size_t count) {
    return (count * sizeof(T) + kAlignment - 1) / kAlignment * kAlignment;
  }
  template <class T>
  /// Reserves the next item.
  Item<T> add(std::size_t count) {
    const std::size_t at = used_;
    used_ += bytes_of<T>(count);
    return {reinterpret_cast<T*>(host_.data() + at), reinterpret_cast<T*>(device_ + at)};
  }
  cudaError_t upload(cudaStream_t stream) const {
    return cudaMemcpyAsync(device_, host_.data(), host_.bytes(), cudaMemcpyHostToDevice, stream);
  }

 private:
  static constexpr std::size_t kAlignment = 64;
  Pinned<std::byte> host_;
  std::byte* device_;
  std::size_t used_ = 0;
};

}  // namespace tensormass::backend::cuda
