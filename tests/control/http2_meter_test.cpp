#include "control/http2_meter.h"

#include <string>

#include <gtest/gtest.h>

namespace tensormass::control {
namespace {

using namespace std::chrono_literals;

constexpr std::string_view kPreface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
constexpr int kData = 0, kHeaders = 1, kReset = 3, kPing = 6, kContinuation = 9;
constexpr int kEndStream = 1, kEndHeaders = 4, kPadded = 8;

std::string frame(int type, int flags, std::uint32_t stream, const std::string& payload = {}) {
  std::string out;
  for (const int shift : {16, 8, 0}) out += static_cast<char>(payload.size() >> shift);
  out += static_cast<char>(type);
  out += static_cast<char>(flags);
  for (const int shift : {24, 16, 8, 0}) out += static_cast<char>(stream >> shift);
  return out + payload;
}

/// The start of a message of gRPC, or all of it.
std::string message(std::size_t size, std::size_t sent) {
  std::string out(1, '\0');
  for (const int shift : {24, 16, 8, 0}) out += static_cast<char>(size >> shift);
  return out + std::string(sent, 'x');
}

class Http2MeterTest : public testing::Test {
 protected:
  Http2MeterTest() { EXPECT_EQ(send(std::string(kPreface)), ""); }
  std::string_view send(const std::string& bytes) { return meter.from_client(bytes, now); }

  std::atomic<std::uint64_t> half_sent{0};
  Http2Meter::Time now{};
  Http2Meter meter{half_sent, now};
};

TEST_F(Http2MeterTest, FollowsACallInPiecesOfAnySize) {
  const std::string call = frame(kHeaders, 0, 1, "abc") + frame(kContinuation, kEndHeaders, 1, "d") +
                           frame(kData, 0, 1, message(100, 40)) + frame(kData, 0, 1, std::string(50, 'x'));
  for (std::size_t piece = 1; piece < call.size(); ++piece) {
    Http2Meter one(half_sent, now);
    EXPECT_EQ(one.from_client(kPreface, now), "");
    for (std::size_t i = 0; i < call.size(); i += piece) EXPECT_EQ(one.from_client(call.substr(i, piece), now), "");
    EXPECT_EQ(one.stream_count(), 1u);
    EXPECT_EQ(half_sent, 90u);
    EXPECT_EQ(one.from_client(frame(kData, kEndStream, 1, std::string(10, 'x')), now), "");
    EXPECT_EQ(half_sent, 0u) << "the message is complete";
    EXPECT_EQ(one.stream_count(), 1u) << "the server has not answered yet";
    one.from_server(frame(kHeaders, kEndHeaders, 1, "ok") + frame(kHeaders, kEndHeaders | kEndStream, 1, "trailers"));
    EXPECT_EQ(one.stream_count(), 0u);
  }
}

TEST_F(Http2MeterTest, BoundsTheCallsAtOnceAndNotOneAfterTheOther) {
  std::uint32_t id = 1;
  for (int i = 0; i < 10'000; ++i, id += 2) {
    ASSERT_EQ(send(frame(kHeaders, kEndHeaders | kEndStream, id, "h")), "");
    meter.from_server(frame(kHeaders, kEndHeaders | kEndStream, id, "t"));
  }
  for (std::size_t i = 0; i < limits::kMaxStreamsPerConnection; ++i, id += 2) {
    ASSERT_EQ(send(frame(kHeaders, kEndHeaders, id, "h")), "");
  }
  EXPECT_NE(send(frame(kHeaders, kEndHeaders, id, "h")), "");
}

TEST_F(Http2MeterTest, BoundsTheHeadersOfACall) {
  ASSERT_EQ(send(frame(kHeaders, 0, 1, std::string(16'000, 'h'))), "");
  ASSERT_EQ(send(frame(kContinuation, kEndHeaders, 1, std::string(16'000, 'h'))), "");
  ASSERT_EQ(send(frame(kHeaders, 0, 3, std::string(16'000, 'h'))), "") << "each call has its own";
  std::string_view why;
  for (int i = 0; i < 100'000 && why.empty(); ++i) why = send(frame(kContinuation, 0, 3));
  EXPECT_NE(why, "") << "empty frames cost, too";
}

TEST_F(Http2MeterTest, CallsThatAreGivenUpNowAndThenPass) {
  std::uint32_t id = 1;
  const auto give_up = [&] {
    id += 2;
    return send(frame(kHeaders, kEndHeaders, id, "h") + frame(kReset, 0, id, "code"));
  };
  for (int i = 0; i < 1000; ++i) {
    now += 50ms;
    ASSERT_EQ(give_up(), "");
  }
  EXPECT_EQ(meter.stream_count(), 0u);
  int at_once = 0;
  while (give_up().empty()) ++at_once;
  EXPECT_NEAR(at_once, limits::kMaxResetsAtOnce, 1);  // rounding
}

TEST_F(Http2MeterTest, BoundsFramesWithoutACall) {
  int count = 0;
  while (send(frame(kPing, 0, 0, "12345678")).empty()) ++count;
  EXPECT_EQ(count, limits::kMaxControlFramesAtOnce);
}

TEST_F(Http2MeterTest, BoundsWhatAllConnectionsHalfSend) {
  half_sent = limits::kMaxHalfSentBytes - 100;
  ASSERT_EQ(send(frame(kHeaders, kEndHeaders, 1, "h") + frame(kData, 0, 1, message(1000, 100))), "");
  EXPECT_NE(send(frame(kData, 0, 1, "x")), "");
  half_sent = limits::kMaxHalfSentBytes + 1000;
  // A message that arrives as a whole is not held.
  Http2Meter other(half_sent, now);
  EXPECT_EQ(other.from_client(std::string(kPreface) + frame(kHeaders, kEndHeaders, 1, "h") +
                                  frame(kData, kEndStream, 1, message(100, 100)),
                              now),
            "");
}

TEST_F(Http2MeterTest, AConnectionThatEndsHoldsNothing) {
  {
    Http2Meter other(half_sent, now);
    EXPECT_EQ(
        other.from_client(
            std::string(kPreface) + frame(kHeaders, kEndHeaders, 1, "h") + frame(kData, 0, 1, message(1000, 100)), now),
        "");
    EXPECT_EQ(half_sent, 100u);
  }
  EXPECT_EQ(half_sent, 0u);
}

TEST_F(Http2MeterTest, AMessageMustGoOn) {
  const auto late = now + limits::kMaxMessagePause + 1s;
  ASSERT_EQ(send(frame(kHeaders, kEndHeaders | kEndStream, 1, "h")), "") << "a call without a message";
  ASSERT_EQ(send(frame(kHeaders, kEndHeaders, 3, "h") + frame(kData, kEndStream, 3, message(10, 10))), "");
  ASSERT_EQ(send(frame(kHeaders, kEndHeaders, 5, "h") + frame(kData, 0, 5, message(10, 10))), "");
  EXPECT_EQ(meter.at(late), "") << "a stream may be silent between two messages";
  ASSERT_EQ(send(frame(kData, 0, 5, message(10, 9))), "");
  EXPECT_NE(meter.at(late), "");
  ASSERT_EQ(send(frame(kData, 0, 5, "x") + frame(kHeaders, kEndHeaders, 7, "h")), "");
  EXPECT_NE(meter.at(late), "") << "the first message has not come";
  meter.from_server(frame(kReset, 0, 7, "code"));
  EXPECT_EQ(meter.at(late), "");
}

TEST_F(Http2MeterTest, RefusesFramesThatHideAMessage) {
  EXPECT_NE(send(frame(kHeaders, kEndHeaders, 1, "h") + frame(kData, kPadded, 1, "x")), "");
}

}  // namespace
}  // namespace tensormass::control
