#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "core/result.h"

namespace tensormass::control {

/// Owns a file descriptor.
class Descriptor {
 public:
  explicit Descriptor(int descriptor = -1) : descriptor_(descriptor) {}
  Descriptor(Descriptor&& other) noexcept : descriptor_(other.release()) {}
  Descriptor& operator=(Descriptor&& other) noexcept;
  ~Descriptor();

  int get() const { return descriptor_; }
  int release();

 private:
  int descriptor_;
};

/// Listens for gRPC and lets in who opens with HTTP/2's preface. gRPC closes the others without a word; here
/// they are told of, and one that says nothing is let go after a while.
class Doorkeeper {
 public:
  /// Gets each connection that was let in; it owns the descriptor then.
  using Admit = std::function<void(int descriptor)>;
  /// Called for each that was not. Both run on the doorkeeper's thread.
  using Refuse = std::function<void()>;

  /// `address` is HOST:PORT or [HOST]:PORT; port 0 takes a free one. Nobody is let in before `open`.
  static Result<std::unique_ptr<Doorkeeper>> listen(const std::string& address);
  ~Doorkeeper();

  void open(Admit admit, Refuse refuse);
  /// HOST:PORT, with the port that was chosen.
  const std::string& endpoint() const { return endpoint_; }

 private:
  struct Visitor {
    Descriptor socket;
    std::chrono::steady_clock::time_point leaves;
  };

  Doorkeeper(Descriptor listener, std::string endpoint);
  void run();
  /// Takes in who waits. If it cannot, for lack of descriptors, it looks away for a while: poll would not wait.
  void accept_visitors(std::chrono::steady_clock::time_point now);
  /// True if the visitor is done with, one way or the other.
  bool look_at(Visitor& visitor, bool has_something, std::chrono::steady_clock::time_point now);

  Descriptor listener_;
  Descriptor stop_;
  const std::string endpoint_;
  Admit admit_;
  Refuse refuse_;
  std::vector<Visitor> visitors_;
  std::chrono::steady_clock::time_point accepts_again_{};
  std::thread thread_;
};

}  // namespace tensormass::control
