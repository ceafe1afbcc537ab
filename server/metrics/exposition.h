#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <string>
#include <string_view>
#include <utility>

#include "world/duration_counts.h"

namespace tensormass::metrics {

enum class Type : std::uint8_t { kCounter, kGauge, kHistogram };
inline constexpr std::array<std::string_view, 3> kTypeNames{"counter", "gauge", "histogram"};

/// All samples of one name.
struct Family {
  std::string_view name;
  Type type;
  std::string_view help;  ///< a sentence without line breaks and backslashes
};

/// Upper bounds of the buckets of each histogram [s]; a last bucket has what is longer.
inline constexpr std::array<double, 14> kBucketsS{5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3,
                                                  1e-2, 2e-2, 5e-2, 0.1,  0.2,  0.5,  1};

/// Writes the text format of Prometheus, version 0.0.4. The samples of a family follow its `begin`.
class Exposition {
 public:
  using Labels = std::initializer_list<std::pair<std::string_view, std::string_view>>;

  void begin(const Family& family);
  void sample(Labels labels, double value);
  void sample(Labels labels, std::uint64_t value);
  /// Sums the fine buckets of `counts` up to each of kBucketsS. A duration counts as up to 1/32 longer than it was.
  void histogram(Labels labels, const world::DurationCounts& counts);

  const std::string& text() const { return text_; }

 private:
  /// Begins a line: the family's name and a suffix, the labels, and `le` unless it is empty.
  void write_name(std::string_view suffix, Labels labels, std::string_view le = {});
  void write_value(double value);

  std::string_view name_;
  std::string text_;
};

}  // namespace tensormass::metrics
