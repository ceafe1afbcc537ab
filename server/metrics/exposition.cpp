#include "metrics/exposition.h"

#include <cmath>
#include <iterator>

#include <fmt/format.h>

namespace tensormass::metrics {
namespace {

void append_escaped(std::string_view value, std::string& out) {
  for (const char c : value) {
    if (c == '\n') {
      out += "\\n";
      continue;
    }
    if (c == '\\' || c == '"') out += '\\';
    out += c;
  }
}

}  // namespace

void Exposition::begin(const Family& family) {
  name_ = family.name;
  fmt::format_to(std::back_inserter(text_), "# HELP {0} {1}\n# TYPE {0} {2}\n", family.name, family.help,
                 kTypeNames[static_cast<std::size_t>(family.type)]);
}

void Exposition::sample(Labels labels, double value) {
  write_name({}, labels);
  write_value(value);
}

void Exposition::sample(Labels labels, std::uint64_t value) {
  write_name({}, labels);
  fmt::format_to(std::back_inserter(text_), " {}\n", value);
}

void Exposition::histogram(Labels labels, const world::DurationCounts& counts) {
  // Read before the buckets, so that it never exceeds what they hold.
  const double sum_s = 1e-9 * static_cast<double>(counts.sum_ns());
  std::uint64_t total = 0;
  std::size_t next = 0;
  for (const double bound_s : kBucketsS) {
    for (; next < DurationBuckets::kCount; ++next) {
      if (static_cast<double>(DurationBuckets::upper_ns(next)) > 1e9 * bound_s) break;
      total += counts.count(next);
    }
    write_name("_bucket", labels, fmt::format("{}", bound_s));
    fmt::format_to(std::back_inserter(text_), " {}\n", total);
  }
  for (; next < DurationBuckets::kCount; ++next) total += counts.count(next);
  write_name("_bucket", labels, "+Inf");
  fmt::format_to(std::back_inserter(text_), " {}\n", total);
  write_name("_sum", labels);
  write_value(sum_s);
  write_name("_count", labels);
  fmt::format_to(std::back_inserter(text_), " {}\n", total);
}

void Exposition::write_name(std::string_view suffix, Labels labels, std::string_view le) {
  text_ += name_;
  text_ += suffix;
  char separator = '{';
  const auto write_label = [&](std::string_view name, std::string_view value) {
    text_ += std::exchange(separator, ',');
    text_ += name;
    text_ += "=\"";
    append_escaped(value, text_);
    text_ += '"';
  };
  for (const auto& [name, value] : labels) write_label(name, value);
  if (!le.empty()) write_label("le", le);
  if (separator == ',') text_ += '}';
}

void Exposition::write_value(double value) {
  if (std::isfinite(value)) {
    fmt::format_to(std::back_inserter(text_), " {}\n", value);
  } else {
    text_ += std::isnan(value) ? " NaN\n" : value > 0 ? " +Inf\n" : " -Inf\n";
  }
}

}  // namespace tensormass::metrics
