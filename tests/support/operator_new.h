#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <new>

/// Replaces operator new in the program that includes this file, once. The program says what an allocation does:
///
///   may_allocate(size) -> bool   called for each allocation, in every thread; false: there is no memory for it
namespace tensormass::tests {

bool may_allocate(std::size_t size) noexcept;

inline constexpr std::size_t kUsualAlignment = __STDCPP_DEFAULT_NEW_ALIGNMENT__;

/// Returns nullptr if there is no memory.
inline void* take(std::size_t size, std::size_t alignment) noexcept {
  if (!may_allocate(size)) return nullptr;
  const std::size_t rounded = (std::max<std::size_t>(size, 1) + alignment - 1) / alignment * alignment;
  return std::aligned_alloc(alignment, rounded);
}
inline void* taken_or_thrown(std::size_t size, std::size_t alignment) {
  if (void* memory = take(size, alignment)) return memory;
  throw std::bad_alloc();
}

}  // namespace tensormass::tests

// Every form, or a sanitizer sees memory that one allocator gave and another took.
void* operator new(std::size_t size) {
  return tensormass::tests::taken_or_thrown(size, tensormass::tests::kUsualAlignment);
}
void* operator new[](std::size_t size) {
  return tensormass::tests::taken_or_thrown(size, tensormass::tests::kUsualAlignment);
}
void* operator new(std::size_t size, std::align_val_t alignment) {
  return tensormass::tests::taken_or_thrown(size, static_cast<std::size_t>(alignment));
}
void* operator new[](std::size_t size, std::align_val_t alignment) {
  return tensormass::tests::taken_or_thrown(size, static_cast<std::size_t>(alignment));
}
void* operator new(std::size_t size, const std::nothrow_t&) noexcept {
  return tensormass::tests::take(size, tensormass::tests::kUsualAlignment);
}
void* operator new[](std::size_t size, const std::nothrow_t&) noexcept {
  return tensormass::tests::take(size, tensormass::tests::kUsualAlignment);
}
void* operator new(std::size_t size, std::align_val_t alignment, const std::nothrow_t&) noexcept {
  return tensormass::tests::take(size, static_cast<std::size_t>(alignment));
}
void* operator new[](std::size_t size, std::align_val_t alignment, const std::nothrow_t&) noexcept {
  return tensormass::tests::take(size, static_cast<std::size_t>(alignment));
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete[](void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }
void operator delete[](void* memory, std::size_t) noexcept { std::free(memory); }
void operator delete(void* memory, std::align_val_t) noexcept { std::free(memory); }
void operator delete[](void* memory, std::align_val_t) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t, std::align_val_t) noexcept { std::free(memory); }
void operator delete[](void* memory, std::size_t, std::align_val_t) noexcept { std::free(memory); }
void operator delete(void* memory, const std::nothrow_t&) noexcept { std::free(memory); }
void operator delete[](void* memory, const std::nothrow_t&) noexcept { std::free(memory); }
void operator delete(void* memory, std::align_val_t, const std::nothrow_t&) noexcept { std::free(memory); }
void operator delete[](void* memory, std::align_val_t, const std::nothrow_t&) noexcept { std::free(memory); }
