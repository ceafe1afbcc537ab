#pragma once

#include <cassert>
#include <memory>
#include <string>
#include <string_view>

#include <google/protobuf/message_lite.h>

namespace tensormass::bus {

/// One message in the bytes that ZeroMQ carries: key, one zero byte, protobuf. zenoh sends the key and the protobuf
/// separately.
///
/// The constructor serializes once. All transports, and the retained messages for late joiners, then share the bytes
/// through MessagePtr. Immutable, so any thread may read it.
class Message {
 public:
  /// `key` must not contain a zero byte. `content` must be below 2 GiB serialized, protobuf's limit.
  Message(std::string_view key, const google::protobuf::MessageLite& content) : key_size_(key.size()) {
    const std::size_t size = content.ByteSizeLong();
    bytes_.reserve(key.size() + 1 + size);
    bytes_.append(key).push_back('\0');
    [[maybe_unused]] const bool appended = content.AppendPartialToString(&bytes_);
    assert(appended);
  }

  /// Key, zero byte, protobuf.
  std::string_view bytes() const { return bytes_; }
  std::string_view key() const { return bytes().substr(0, key_size_); }
  /// The protobuf bytes alone.
  std::string_view payload() const { return bytes().substr(key_size_ + 1); }

 private:
  std::size_t key_size_;
  std::string bytes_;
};

using MessagePtr = std::shared_ptr<const Message>;

}  // namespace tensormass::bus
