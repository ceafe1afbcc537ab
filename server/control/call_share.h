#pragma once

#include <atomic>
#include <string>
#include <utility>

#include <fmt/format.h>
#include <grpcpp/support/status.h>

#include "control/refusals.h"
#include "control/status.h"

namespace tensormass::control {

/// A share of gRPC's threads, for calls that hold one for long. A call beyond the share is refused at once, so its
/// thread is free again for calls that are short.
///
///     threads of the control server, limits::kMaxControlThreads
///     ├─ calls that load, step, replay or record     at most limits::kMaxLongCalls
///     ├─ calls that wait for the end of a step       at most limits::kMaxWaitingCalls
///     └─ the rest: status, list, unload, reset, move, topology, version, health
///
/// All methods may be called from any thread.
class CallShare {
 public:
  /// limit: the most calls at once; name: of that limit, for the refusal. refusals: counts those as `counted`. All must
  /// outlive the share.
  CallShare(int limit, const char* name, Refusals& refusals, Limit counted)
      : limit_(limit), name_(name), refusals_(refusals), counted_(counted) {}

  /// The place of one call in a share, as long as it lives. False if there was none left.
  class Place {
   public:
    explicit Place(CallShare& share) : share_(share), taken_(share.taken_.fetch_add(1) < share.limit_) {
      if (taken_) return;
      share_.taken_.fetch_sub(1);
      share_.refusals_.count(share_.counted_);
    }
    ~Place() {
      if (taken_) share_.taken_.fetch_sub(1);
    }
    Place(const Place&) = delete;
    Place& operator=(const Place&) = delete;

    explicit operator bool() const { return taken_; }
    /// The answer to a call without a place.
    grpc::Status refusal() const {
      return to_status({ErrorCode::kResourceExhausted,
                        fmt::format("limits::{} = {} calls of this kind run already; call again when one has ended",
                                    share_.name_, share_.limit_)});
    }

   private:
    CallShare& share_;
    const bool taken_;
  };

 private:
  const int limit_;
  const char* const name_;
  Refusals& refusals_;
  const Limit counted_;
  std::atomic<int> taken_{0};
};

}  // namespace tensormass::control
