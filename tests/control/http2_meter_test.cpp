#include "control/http2_meter.h"

#include <string>

#include <gtest/gtest.h>

#include "support/http2.h"

namespace tensormass::control {
namespace {

using namespace std::chrono_literals;
using tests::http2::frame;
using tests::http2::message;

constexpr std::string_view kPreface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
constexpr int kData = 0, kHeaders = 1, kReset = 3, kPing = 6, kContinuation = 9;
constexpr int kEndStream = 1, kEndHeaders = 4, kPadded = 8;

class Http2MeterTest : public testing::Test {
 protected:
  Http2MeterTest() { EXPECT_EQ(send(std::string(kPreface)), ""); }
  std::string_view send(const std::string& bytes) { return meter.from_client(bytes, now); }

  std::atomic<std::uint64_t> half_sent{0};
  Http2Meter::Time now{};
  Http2Meter::Messages messages;
  Http2Meter meter{half_sent, messages, now};
};

TEST_F(Http2MeterTest, FollowsACallInPiecesOfAnySize) {
  const std::string call = frame(kHeaders, 0, 1, "abc") + frame(kContinuation, kEndHeaders, 1, "d") +
                           frame(kData, 0, 1, message(100, 40)) + frame(kData, 0, 1, std::string(50, 'x'));
  for (std::size_t piece = 1; piece < call.size(); ++piece) {
    Http2Meter one(half_sent, messages, now);
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

TEST_F(Http2MeterTest, BoundsAMessageByWhatItAnnounces) {
  messages.max_bytes = 10 << 20;
  EXPECT_EQ(send(frame(kHeaders, kEndHeaders, 1, "h") + frame(kData, 0, 1, message(10 << 20, 100))), "");
  EXPECT_TRUE(send(frame(kHeaders, kEndHeaders, 3, "h") + frame(kData, 0, 3, message((10 << 20) + 1, 0)))
                  .starts_with("a message larger than --max-message-mib"));
}

TEST_F(Http2MeterTest, ALargeMessageNeedsRoom) {
  std::uint64_t asked = 0;
  bool room = true;
  messages.has_room = [&](std::uint64_t bytes) {
    asked = bytes;
    return room;
  };
  EXPECT_EQ(send(frame(kHeaders, kEndHeaders, 1, "h") + frame(kData, 0, 1, message(2 << 20, 100))), "");
  EXPECT_EQ(asked, 2u << 20);
  room = false;
  EXPECT_EQ(send(frame(kHeaders, kEndHeaders, 3, "h") + frame(kData, 0, 3, message(1 << 20, 100))), "");
  EXPECT_TRUE(send(frame(kHeaders, kEndHeaders, 5, "h") + frame(kData, 0, 5, message((1 << 20) + 1, 100)))
                  .starts_with("a message for which --max-memory-mib leaves no memory"));
}

TEST_F(Http2MeterTest, SaysHowMuchIsHeldForHowLong) {
  ASSERT_EQ(send(frame(kHeaders, kEndHeaders, 1, "h") + frame(kData, 0, 1, message(1000, 100))), "");
  EXPECT_EQ(meter.held_byte_s(now), 0) << "of a client that sends";
  EXPECT_EQ(meter.held_byte_s(now + 3s), 300);
  now += 3s;
  ASSERT_EQ(send(frame(kData, 0, 1, "x")), "");
  EXPECT_EQ(meter.held_byte_s(now + 1s), 101);
  ASSERT_EQ(send(frame(kData, kEndStream, 1, std::string(899, 'x'))), "");
  EXPECT_EQ(meter.held_byte_s(now + 1s), 0) << "of a message that is complete";
}

TEST_F(Http2MeterTest, ConnectionsOfAKeyShareOneBudget) {
  const auto budget = std::make_shared<Http2Meter::Budget>(now);
  Http2Meter one(half_sent, messages, now);
  {
    Http2Meter other(half_sent, messages, now);
    for (Http2Meter* of_key : {&one, &other}) {
      of_key->share(budget);
      ASSERT_EQ(of_key->from_client(kPreface, now), "");
    }
    std::uint32_t id = 1;
    for (std::size_t i = 0; i < limits::kMaxStreamsPerConnection / 2; ++i, id += 2) {
      ASSERT_EQ(one.from_client(frame(kHeaders, kEndHeaders, id, "h"), now), "");
      ASSERT_EQ(other.from_client(frame(kHeaders, kEndHeaders, id, "h"), now), "");
    }
    EXPECT_NE(one.from_client(frame(kHeaders, kEndHeaders, id, "h"), now), "");
  }
  EXPECT_EQ(budget->streams, limits::kMaxStreamsPerConnection / 2 + 1) << "a connection that ends gives back";
  Http2Meter next(half_sent, messages, now);
  next.share(budget);
  ASSERT_EQ(next.from_client(kPreface, now), "");
  int resets = 0;
  for (std::uint32_t id = 1; next.from_client(frame(kReset, 0, id, "xxxx"), now).empty(); id += 2) ++resets;
  EXPECT_EQ(resets, limits::kMaxResetsAtOnce);
  Http2Meter later(half_sent, messages, now);
  later.share(budget);
  EXPECT_NE(later.from_client(std::string(kPreface) + frame(kReset, 0, 1, "xxxx"), now), "") << "by another connection";
}

TEST_F(Http2MeterTest, AConnectionThatEndsHoldsNothing) {
  {
    Http2Meter other(half_sent, messages, now);
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
