#pragma once

#include <cstddef>
#include <cstdint>
#include <string>

/// What a client of gRPC sends.
namespace tensormass::tests::http2 {

/// Returns the bytes of a frame (RFC 9113, section 4.1).
inline std::string frame(int type, int flags, std::uint32_t stream, const std::string& payload = {}) {
  std::string out;
  for (const int shift : {16, 8, 0}) out += static_cast<char>(payload.size() >> shift);
  out += static_cast<char>(type);
  out += static_cast<char>(flags);
  for (const int shift : {24, 16, 8, 0}) out += static_cast<char>(stream >> shift);
  return out + payload;
}

/// Returns the start of a message of gRPC, or all of it.
/// size: that its head names. sent: bytes that follow the head.
inline std::string message(std::size_t size, std::size_t sent) {
  std::string out(1, '\0');
  for (const int shift : {24, 16, 8, 0}) out += static_cast<char>(size >> shift);
  return out + std::string(sent, 'x');
}

}  // namespace tensormass::tests::http2
