#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include <fmt/format.h>

namespace tensormass::mesh {

/// One kind of problem: how often it occurs, and the first occurrence in words.
struct Problem {
  std::uint64_t count = 0;
  std::string first;

  /// Counts an occurrence.
  ///
  ///   describe()   returns the occurrence in words. Called for the first occurrence only.
  template <class Describe>
  void add(Describe&& describe) {
    if (count++ == 0) first = describe();
  }

  /// Returns one line: the first occurrence, the number of others, what to do.
  std::string text(std::string_view what_to_do) const {
    const std::string others = count > 1 ? fmt::format(" ({} of this kind)", count) : std::string();
    return fmt::format("{}{}; {}", first, others, what_to_do);
  }
};

}  // namespace tensormass::mesh
