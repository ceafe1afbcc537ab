#include "control/http2_meter.h"

#include <algorithm>
#include <utility>

#include "core/assert.h"

namespace tensormass::control {
namespace {

// RFC 9113, sections 3.4 and 6.
constexpr std::size_t kPrefaceBytes = 24;
constexpr std::uint8_t kData = 0, kHeaders = 1, kPriority = 2, kResetStream = 3, kSettings = 4, kPing = 6,
                       kContinuation = 9;
constexpr std::uint8_t kEndStream = 0x1, kEndHeaders = 0x4, kPadded = 0x8;

}  // namespace

bool Http2Meter::Bucket::take(double most, double per_s, Time now) {
  (void)spend(0, most, per_s, now);
  if (left < 1) return false;
  left -= 1;
  return true;
}

bool Http2Meter::Bucket::spend(double cost, double most, double per_s, Time now) {
  left = std::min(most, left + per_s * std::chrono::duration<double>(now - since).count()) - cost;
  since = now;
  return left >= 0;
}

Http2Meter::Http2Meter(std::atomic<std::uint64_t>& half_sent, const Messages& messages, Time now)
    : half_sent_(half_sent),
      messages_(messages),
      preface_left_(kPrefaceBytes),
      budget_(std::make_shared<Budget>(now)) {}

Http2Meter::~Http2Meter() {
  while (!streams_.empty()) close(streams_.begin());
}

void Http2Meter::share(std::shared_ptr<Budget> budget) {
  TM_ASSERT(streams_.empty(), "calls are counted where they end");
  budget_ = std::move(budget);
}

template <class Begins, class Payload>
std::string_view Http2Meter::read(Reader& reader, std::string_view bytes, const Begins& begins,
                                  const Payload& payload) {
  while (!bytes.empty()) {
    if (reader.header_size < reader.header.size()) {
      const std::size_t size = std::min(bytes.size(), reader.header.size() - reader.header_size);
      std::copy_n(bytes.begin(), size, reader.header.begin() + static_cast<std::ptrdiff_t>(reader.header_size));
      bytes.remove_prefix(size);
      reader.header_size += size;
      if (reader.header_size < reader.header.size()) return {};
      const auto& h = reader.header;
      reader.payload_left = std::uint32_t{h[0]} << 16 | std::uint32_t{h[1]} << 8 | h[2];
      reader.type = h[3];
      reader.flags = h[4];
      reader.stream =
          (std::uint32_t{h[5]} << 24 | std::uint32_t{h[6]} << 16 | std::uint32_t{h[7]} << 8 | h[8]) & ~(1u << 31);
      if (const std::string_view why = begins(); !why.empty()) return why;
    }
    const std::size_t size = std::min<std::size_t>(bytes.size(), reader.payload_left);
    if (size > 0) {
      if (const std::string_view why = payload(bytes.substr(0, size)); !why.empty()) return why;
    }
    bytes.remove_prefix(size);
    reader.payload_left -= static_cast<std::uint32_t>(size);
    if (reader.payload_left == 0) reader.header_size = 0;
  }
  return {};
}

std::string_view Http2Meter::from_client(std::string_view bytes, Time now) {
  const std::size_t preface = std::min(bytes.size(), preface_left_);
  preface_left_ -= preface;
  return read(
      client_, bytes.substr(preface), [&] { return begin_client_frame(now); },
      [&](std::string_view payload) { return client_.type == kData ? take_data(payload, now) : std::string_view(); });
}

std::string_view Http2Meter::begin_client_frame(Time now) {
  const std::uint32_t id = client_.stream;
  switch (client_.type) {
    case kHeaders: {
      const auto [stream, is_new] = streams_.try_emplace(id);
      if (is_new) {
        stream->second.progress = now;
        ++budget_->streams;
      }
      if (budget_->streams > limits::kMaxStreamsPerConnection)
        return "more than kMaxStreamsPerConnection calls at once";
      header_block_ = 0;
      [[fallthrough]];
    }
    case kContinuation:
      header_block_ += client_.payload_left;
      // An empty frame costs its header.
      header_block_ += client_.header.size();
      if (header_block_ > limits::kMaxHeaderBlockBytes) return "headers of more than kMaxHeaderBlockBytes";
      if ((client_.flags & kEndHeaders) != 0) header_block_ = 0;
      break;
    case kResetStream:
      if (!budget_->resets.take(limits::kMaxResetsAtOnce, limits::kMaxResetsPerS, now)) {
        return "more than kMaxResetsAtOnce calls given up";
      }
      if (const auto stream = streams_.find(id); stream != streams_.end()) close(stream);
      return {};
    case kPing:
    case kSettings:
    case kPriority:
      if (!budget_->control_frames.take(limits::kMaxControlFramesAtOnce, limits::kMaxControlFramesPerS, now)) {
        return "more than kMaxControlFramesAtOnce frames without a call";
      }
      return {};
    case kData:
      // No client of gRPC pads, and a message's prefix would be hidden behind it.
      if ((client_.flags & kPadded) != 0) return "a padded frame";
      break;
    default:
      return {};
  }
  // The end comes with the frame's header, before its payload.
  if (client_.type != kContinuation && (client_.flags & kEndStream) != 0) end(id, true);
  return {};
}

std::string_view Http2Meter::take_data(std::string_view bytes, Time now) {
  const auto found = streams_.find(client_.stream);
  if (found == streams_.end()) return {};
  Stream& stream = found->second;
  stream.progress = now;
  while (!bytes.empty()) {
    if (stream.prefix_size < stream.prefix.size()) {
      stream.prefix[stream.prefix_size++] = static_cast<unsigned char>(bytes.front());
      bytes.remove_prefix(1);
      if (stream.prefix_size < stream.prefix.size()) continue;
      const auto& p = stream.prefix;
      stream.message_left =
          std::uint64_t{p[1]} << 24 | std::uint64_t{p[2]} << 16 | std::uint64_t{p[3]} << 8 | std::uint64_t{p[4]};
      if (stream.message_left > messages_.max_bytes) {
        return "a message larger than --max-message-mib; start the daemon with a larger one";
      }
      if (stream.message_left > limits::kSmallMessageBytes && messages_.has_room &&
          !messages_.has_room(stream.message_left)) {
        return "a message for which --max-memory-mib leaves no memory; unload a scene, or start the daemon with a "
               "larger one";
      }
    }
    const std::uint64_t size = std::min<std::uint64_t>(bytes.size(), stream.message_left);
    take_half_sent(stream, size);
    stream.message_left -= size;
    bytes.remove_prefix(size);
    if (stream.message_left > 0) continue;
    half_sent_.fetch_sub(stream.half_sent, std::memory_order_relaxed);
    stream.half_sent = 0;
    stream.prefix_size = 0;
    stream.had_message = true;
  }
  return {};
}

double Http2Meter::held_byte_s(Time now) const {
  double held = 0;
  for (const auto& [id, stream] : streams_) {
    held += static_cast<double>(stream.half_sent) * std::chrono::duration<double>(now - stream.progress).count();
  }
  return held;
}

void Http2Meter::from_server(std::string_view bytes) {
  static_cast<void>(read(
      server_, bytes,
      [&] {
        const bool ends = (server_.type == kData || server_.type == kHeaders) && (server_.flags & kEndStream) != 0;
        if (ends) end(server_.stream, false);
        if (server_.type == kResetStream) {
          if (const auto stream = streams_.find(server_.stream); stream != streams_.end()) close(stream);
        }
        return std::string_view();
      },
      [](std::string_view) { return std::string_view(); }));
}

std::string_view Http2Meter::at(Time now) const {
  for (const auto& [id, stream] : streams_) {
    const bool waits = stream.prefix_size > 0 || (!stream.had_message && !stream.client_ended);
    if (waits && now - stream.progress > limits::kMaxMessagePause) return "nothing for kMaxMessagePause in a message";
  }
  return {};
}

void Http2Meter::end(std::uint32_t id, bool by_client) {
  const auto found = streams_.find(id);
  if (found == streams_.end()) return;
  (by_client ? found->second.client_ended : found->second.server_ended) = true;
  // The server's end is the end of the call, whatever the client still sends.
  if (found->second.server_ended) close(found);
}

void Http2Meter::close(std::map<std::uint32_t, Stream>::iterator stream) {
  half_sent_.fetch_sub(stream->second.half_sent, std::memory_order_relaxed);
  streams_.erase(stream);
  --budget_->streams;
}

void Http2Meter::take_half_sent(Stream& stream, std::uint64_t bytes) {
  stream.half_sent += bytes;
  half_sent_.fetch_add(bytes, std::memory_order_relaxed);
}

}  // namespace tensormass::control
