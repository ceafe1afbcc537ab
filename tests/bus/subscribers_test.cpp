#include "bus/zeromq/subscribers.h"

#include <array>
#include <string>
#include <vector>

#include <gtest/gtest.h>

namespace tensormass::bus {
namespace {

using Verdict = Subscribers::Verdict;

class SubscribersTest : public testing::Test {
 protected:
  /// The n-th connection, under a descriptor.
  Subscribers::Connection connection(std::size_t n, int descriptor) { return {&ids_[n], descriptor}; }
  Verdict subscribe(const Subscribers::Connection& from, const std::string& key) {
    zmq::message_t request(key);
    return subscribers_.subscribe(from, request, key);
  }
  static std::string feedback(std::size_t number) {
    return feedback_key("host", "demo", std::to_string(number)) + '\0';
  }
  /// Asks for one subscription too many.
  Verdict fill(const Subscribers::Connection& from) {
    Verdict last = Verdict::kAccepted;
    for (std::size_t i = 0; i <= limits::kMaxSubscriptionsPerPeer; ++i) {
      EXPECT_EQ(last, Verdict::kAccepted) << i;
      last = subscribe(from, feedback(i));
    }
    return last;
  }

  Subscribers subscribers_{"host"};
  std::array<char, 4> ids_{};
  Subscribers::Time now_{};
};

TEST_F(SubscribersTest, AcceptsAsManyDifferentKeysAsTheLimit) {
  EXPECT_EQ(fill(connection(0, 5)), Verdict::kTooMany);
  // Another peer has its own count, and a key counts once.
  for (int i = 0; i < 1000; ++i) EXPECT_EQ(subscribe(connection(1, 6), feedback(1)), Verdict::kAccepted);
}

TEST_F(SubscribersTest, AllConnectionsOfAKeyHaveABound) {
  std::vector<char> ids(limits::kMaxSubscriptionsPerKey);
  const auto of = [&](std::size_t n, std::string_view client) {
    return Subscribers::Connection{&ids[n], 10 + static_cast<int>(n), client};
  };
  std::size_t count = 0;
  while (subscribe(of(count / 32, "alice"), feedback(count % 32)) == Verdict::kAccepted) ++count;
  EXPECT_EQ(count, limits::kMaxSubscriptionsPerKey);
  const std::size_t last = count / 32;
  EXPECT_EQ(subscribe(of(last, "alice"), feedback(1)), Verdict::kIgnored) << "that connection was refused";
  EXPECT_EQ(subscribe(of(last + 1, "alice"), feedback(1)), Verdict::kTooManyOfKey);
  EXPECT_EQ(subscribe(of(last + 2, "bob"), feedback(1)), Verdict::kAccepted) << "another key has its own";
  subscribers_.forget(10, now_);
  EXPECT_EQ(subscribe(of(last + 3, "alice"), feedback(1)), Verdict::kAccepted) << "a connection that ended made room";
}

TEST_F(SubscribersTest, AnEndedSubscriptionMakesRoom) {
  for (std::size_t i = 0; i < 1000; ++i) {
    EXPECT_EQ(subscribe(connection(0, 5), feedback(i)), Verdict::kAccepted);
    subscribers_.unsubscribe(connection(0, 5), feedback(i));
  }
}

TEST_F(SubscribersTest, RefusesAPeerOnceAndIgnoresTheRest) {
  EXPECT_EQ(subscribe(connection(0, 5), "tensormass/"), Verdict::kWrongKey);
  EXPECT_EQ(subscribe(connection(0, 5), feedback(0)), Verdict::kIgnored);
  zmq::message_t request(std::string("x"));
  EXPECT_FALSE(subscribers_.refuse(connection(0, 5), request));
  EXPECT_TRUE(subscribers_.refuse(connection(1, 6), request));
}

TEST_F(SubscribersTest, WhatAnEndedConnectionSentDoesNotHarmTheNextOneUnderItsDescriptor) {
  ASSERT_EQ(fill(connection(0, 5)), Verdict::kTooMany);
  subscribers_.forget(5, now_);
  EXPECT_EQ(subscribe(connection(0, 5), feedback(0)), Verdict::kIgnored);
  EXPECT_EQ(subscribe(connection(1, 5), feedback(0)), Verdict::kAccepted);
  EXPECT_EQ(subscribe(connection(0, 5), feedback(1)), Verdict::kIgnored);
  EXPECT_EQ(subscribe(connection(1, 5), feedback(1)), Verdict::kAccepted);
}

TEST_F(SubscribersTest, RefusesWhoseClientOrSubscriptionDoesNotCountAnyMore) {
  const auto as = [&](std::size_t n, std::string_view client) {
    return Subscribers::Connection{&ids_[n], static_cast<int>(n), client};
  };
  for (const std::size_t key : {0u, 1u}) {
    subscribe(as(0, "stays"), feedback(key));
    subscribe(as(1, "removed"), feedback(key));
    subscribe(as(2, "other role"), feedback(key));
  }
  const auto counts = [](std::string_view client) { return client != "removed"; };
  const auto may = [](std::string_view client, std::string_view subscription) {
    return client != "other role" || subscription != feedback(1);
  };
  std::vector<std::string> refused;
  for (const auto& each : subscribers_.refuse_removed(counts, may)) {
    refused.push_back(std::to_string(each.descriptor) + " " + std::string(each.client));
  }
  EXPECT_EQ(refused, (std::vector<std::string>{"1 removed", "2 other role"}));
  EXPECT_TRUE(subscribers_.refuse_removed(counts, may).empty()) << "once";
  EXPECT_EQ(subscribe(as(0, "stays"), feedback(2)), Verdict::kAccepted);
  EXPECT_EQ(subscribe(as(2, "other role"), feedback(0)), Verdict::kIgnored);
}

TEST_F(SubscribersTest, KeepsNothingOfConnectionsThatEnded) {
  subscribe(connection(0, 5), feedback(0));
  subscribe(connection(1, 6), feedback(0));
  subscribers_.forget(5, now_);
  subscribers_.clean_up(now_);
  EXPECT_EQ(subscribers_.peer_count(), 2u);
  subscribers_.clean_up(now_ + std::chrono::seconds(1));
  EXPECT_EQ(subscribers_.peer_count(), 1u);
  subscribers_.forget(6, now_ + std::chrono::seconds(1));
  subscribers_.clean_up(now_ + std::chrono::seconds(3));
  EXPECT_EQ(subscribers_.peer_count(), 0u);
}

}  // namespace
}  // namespace tensormass::bus
