#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <string_view>
#include <vector>

#include <sys/mman.h>

namespace tensormass::backend::cpu {

/// Buffers of a scene in host memory, each on cache lines of its own (model/bind.h says what an arena is).
class Arena {
 public:
  template <class T, class U>
  T* constant(std::string_view name, const std::vector<U>& items) {
    T* copy = remember(name, zeros<T>(name, items.size()), items.size());
    std::transform(items.begin(), items.end(), copy, [](U item) { return static_cast<T>(item); });
    return copy;
  }
  template <class T, class Fill>
  T* generated(std::string_view name, std::size_t count, const Fill& fill) {
    T* items = remember(name, zeros<T>(name, count), count);
    if (count > 0) fill(items);
    return items;
  }
  template <class T>
  T* zeros(std::string_view /*name*/, std::size_t count) {
    if (count == 0) return nullptr;
    const bool large = count * sizeof(T) >= kHugePage;
    const std::size_t alignment = large ? kHugePage : kCacheLine;
    const std::size_t bytes = (count * sizeof(T) + alignment - 1) / alignment * alignment;
    blocks_.emplace_back(static_cast<std::byte*>(std::aligned_alloc(alignment, bytes)));
    if (!blocks_.back()) throw std::bad_alloc();
    if (large) (void)madvise(blocks_.back().get(), bytes, MADV_HUGEPAGE);  // only a hint
    std::memset(blocks_.back().get(), 0, bytes);
    return reinterpret_cast<T*>(blocks_.back().get());
  }
  /// A buffer that steps only read.
  struct Constant {
    std::string_view name;
    const void* items;
    std::size_t bytes;
  };
  const std::vector<Constant>& constants() const { return constants_; }

 private:
  template <class T>
  T* remember(std::string_view name, T* items, std::size_t count) {
    if (count > 0) constants_.push_back({name, items, count * sizeof(T)});
    return items;
  }
  static constexpr std::size_t kCacheLine = 64, kHugePage = std::size_t{2} << 20;
  struct Free {
    void operator()(std::byte* p) const { std::free(p); }
  };
  std::vector<std::unique_ptr<std::byte, Free>> blocks_;
  std::vector<Constant> constants_;
};

}  // namespace tensormass::backend::cpu
