#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <concepts>
#include <cstdint>
#include <cstdio>
#include <initializer_list>
#include <optional>
#include <string>
#include <string_view>

#include <spdlog/spdlog.h>

/// Structured log lines: an event in words and its fields, written to stderr as text for people or as JSON for
/// machines.
namespace tensormass::log {

enum class Format { kText, kJson };

/// Returns the text as a JSON string with its quotes. Escapes quotes, backslashes and control characters.
inline std::string json_quoted(std::string_view text) {
  std::string quoted = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') {
      quoted.append(1, '\\').append(1, c);
    } else if (static_cast<unsigned char>(c) < 0x20 || c == 0x7f) {
      char escape[8];
      std::snprintf(escape, sizeof escape, "\\u%04x", static_cast<unsigned>(static_cast<unsigned char>(c)));
      quoted.append(escape);
    } else {
      quoted.append(1, c);
    }
  }
  return quoted.append(1, '"');
}

/// A named value of a log line. Does not own the key; converts the value to text when it is made.
struct Field {
  Field(std::string_view field_key, std::string_view text) : key(field_key), value(text), is_text(true) {}
  template <class Number>
  requires std::integral<Number> || std::floating_point<Number> Field(std::string_view field_key, Number number)
      : key(field_key), value(fmt::format("{}", number)), is_text(false) {}

  std::string_view key;
  std::string value;
  bool is_text;
};

namespace detail {
inline std::atomic<Format> format{Format::kText};
}

/// Sets the lowest level that is written, and the format. Call it once, before the first line and before other threads
/// start.
inline void configure(spdlog::level::level_enum level, Format format) {
  detail::format = format;
  spdlog::set_level(level);
  spdlog::set_pattern(format == Format::kJson ? R"({"time":"%Y-%m-%dT%H:%M:%S.%e%z","level":"%l",%v})"
                                              : "%Y-%m-%d %H:%M:%S.%e %^%-7l%$ %v");
}

/// Returns a line without its time and level. Values that a client chose can forge neither a line nor a field.
inline std::string line_of(Format format, std::string_view event, std::initializer_list<Field> fields) {
  const bool json = format == Format::kJson;
  const auto is_plain = [](char c) { return static_cast<unsigned char>(c) > 0x20 && c != 0x7f && c != '"'; };
  std::string line = json ? "\"event\":" + json_quoted(event) : std::string(event);
  for (const Field& field : fields) {
    if (json) {
      line.append(",").append(json_quoted(field.key)).append(":");
      line.append(field.is_text ? json_quoted(field.value) : field.value);
    } else {
      const bool plain =
          !field.is_text || (!field.value.empty() && std::all_of(field.value.begin(), field.value.end(), is_plain));
      line.append(" ").append(field.key).append("=").append(plain ? field.value : json_quoted(field.value));
    }
  }
  return line;
}

/// Writes one line, or nothing if the level is disabled.
inline void write(spdlog::level::level_enum level, std::string_view event, std::initializer_list<Field> fields = {}) {
  if (!spdlog::should_log(level)) return;
  // The line is an argument, never the format string: its text may come from a client.
  spdlog::log(level, "{}", line_of(detail::format, event, fields));
}

inline void debug(std::string_view event, std::initializer_list<Field> fields = {}) {
  write(spdlog::level::debug, event, fields);
}
inline void info(std::string_view event, std::initializer_list<Field> fields = {}) {
  write(spdlog::level::info, event, fields);
}
inline void warn(std::string_view event, std::initializer_list<Field> fields = {}) {
  write(spdlog::level::warn, event, fields);
}
inline void error(std::string_view event, std::initializer_list<Field> fields = {}) {
  write(spdlog::level::err, event, fields);
}

/// Limits log lines that a client can cause at any rate to one a second.
class Limiter {
 public:
  /// Returns the number of lines suppressed since the last admitted one, or nullopt if this line must be suppressed
  /// too. Thread-safe.
  std::optional<std::uint64_t> admit() {
    const std::int64_t now = std::chrono::steady_clock::now().time_since_epoch().count();
    std::int64_t next = next_.load(std::memory_order_relaxed);
    if (now < next || !next_.compare_exchange_strong(next, now + kInterval, std::memory_order_relaxed)) {
      suppressed_.fetch_add(1, std::memory_order_relaxed);
      return std::nullopt;
    }
    return suppressed_.exchange(0, std::memory_order_relaxed);
  }

 private:
  static constexpr std::int64_t kInterval = std::chrono::steady_clock::duration(std::chrono::seconds(1)).count();
  std::atomic<std::int64_t> next_{std::chrono::steady_clock::time_point::min().time_since_epoch().count()};
  std::atomic<std::uint64_t> suppressed_{0};
};

}  // namespace tensormass::log
