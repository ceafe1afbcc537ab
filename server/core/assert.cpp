#include "core/assert.h"

#include <cstdio>
#include <cstdlib>

namespace tensormass {

void assertion_failed(const char* condition, const char* words, const char* file, int line) noexcept {
  std::fprintf(stderr, "%s:%d: assertion failed: %s (%s)\n", file, line, condition, words);
  std::fflush(stderr);
  std::abort();
}

}  // namespace tensormass
