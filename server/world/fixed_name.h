#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <string_view>

#include "core/assert.h"
#include "core/limits.h"

namespace tensormass::world {

/// The name of a tool or an attachment that may be gone when somebody reads it. A value of fixed size: copies allocate
/// nothing.
class FixedName {
 public:
  FixedName() = default;
  explicit FixedName(std::string_view name) : size_(name.size()) {
    TM_ASSERT(size_ <= text_.size(), "names have been checked");
    std::copy(name.begin(), name.end(), text_.begin());
  }
  std::string_view view() const { return {text_.data(), size_}; }
  bool empty() const { return size_ == 0; }

 private:
  std::array<char, limits::kMaxNameLength> text_{};
  std::size_t size_ = 0;
};

}  // namespace tensormass::world
