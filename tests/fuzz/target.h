#pragma once

#include <cstddef>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "fuzz/mutate.h"

/// Targets of fuzzing: decoders, and inputs that they take. decoders_test.cpp runs all of them.
namespace tensormass::fuzz {

/// A decoder with inputs that it takes.
class Target {
 public:
  virtual ~Target() = default;
  virtual std::string mutated(Random& random) const = 0;
  /// Fails the test if the decoder neither takes nor refuses it.
  virtual void run(const std::string& input) = 0;
};

inline std::string changed(std::string bytes, Random& random) {
  for (std::size_t i = 0, count = std::size_t{1} << random.below(4); i < count; ++i) mutate(bytes, random);
  return bytes;
}

/// Inputs that are messages: most are changed field by field, so that they pass protobuf's parser.
template <class Message>
class MessageTarget : public Target {
 public:
  std::string mutated(Random& random) const override {
    Message message = random.one_of(seeds_);
    for (std::size_t i = 0, count = std::size_t{1} << random.below(4); i < count; ++i) mutate(message, random);
    std::string bytes = message.SerializeAsString();
    return random.below(6) == 0 ? changed(bytes, random) : bytes;
  }
  void run(const std::string& input) override {
    Message message;
    if (message.ParseFromString(input)) take(message);
  }

 protected:
  virtual void take(Message& message) = 0;
  std::vector<Message> seeds_;
};

struct Case {
  const char* name;
  std::size_t count;  // inputs, in about a second at most
  std::function<std::unique_ptr<Target>()> make;
};
template <class T>
Case of(const char* name, std::size_t count) {
  return {name, count, [] { return std::make_unique<T>(); }};
}

/// Decoders of the daemon's files: client list and `--state`.
std::vector<Case> file_cases();
/// Decoders of the haptic client: what the daemon and the services of devices send, and its key file.
std::vector<Case> haptic_cases();

}  // namespace tensormass::fuzz
