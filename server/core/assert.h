#pragma once

/// TM_ASSERT(condition, "what must hold"): an invariant of our own code. A user's mistake is a Result instead.
///
/// The check stays on in release builds, because a wrong index found late costs more than a branch. It prints the
/// place, the condition and the words, then aborts. In device code it expands to nothing: a kernel cannot say which
/// scene it belongs to, and its inputs are asserted on the host before they are uploaded.
///
/// Keep it out of loops over nodes or elements within a step; assert once before the loop.
namespace tensormass {

[[noreturn]] void assertion_failed(const char* condition, const char* words, const char* file, int line) noexcept;

}  // namespace tensormass

#if defined(__CUDA_ARCH__)
#define TM_ASSERT(condition, words) static_cast<void>(0)
#else
#define TM_ASSERT(condition, words) \
  ((condition) ? static_cast<void>(0) : ::tensormass::assertion_failed(#condition, words, __FILE__, __LINE__))
#endif
