#pragma once

#include <cstdint>
#include <mutex>
#include <utility>

#include "control/refusals.h"
#include "core/result.h"
#include "tensormass/v1/scene.pb.h"

namespace tensormass::control {

/// Bounds of what scenes may take.
struct AdmissionLimits {
  double scene_bytes = 0;    ///< one load may need so much at its peak; 0: as all_bytes
  double all_bytes = 0;      ///< the process may hold so much; 0: kDefaultMemoryShare of the memory that it may have
  double load_s = 0;         ///< one load may take so long; 0: kDefaultLoadS
  double message_bytes = 0;  ///< the largest message, and all that have not arrived; 0: kDefaultHalfSentBytes
};

/// Share of the machine's or the container's memory, and longest load [s], unless the user says otherwise.
inline constexpr double kDefaultMemoryShare = 0.8;
inline constexpr double kDefaultLoadS = 600;

/// Refuses loads that need too much before anything is allocated for them.
///
/// A load is admitted if what the process holds now, what the loads under way have been promised and what this one
/// needs (scene_cost.h) stay within the bound of all. All methods may be called from any thread.
class Admission {
 public:
  /// used_bytes: double(), the memory that the process holds. refusals: counts them; nullptr: nobody does.
  explicit Admission(const AdmissionLimits& limits, double (*used_bytes)() = &Admission::resident_bytes,
                     Refusals* refusals = nullptr);

  /// Memory that was promised to one load, as long as it lives.
  class Promise {
   public:
    Promise(Promise&& other) noexcept
        : admission_(std::exchange(other.admission_, nullptr)), bytes_(std::exchange(other.bytes_, 0)) {}
    ~Promise();

   private:
    friend class Admission;
    Promise(Admission& admission, double bytes) : admission_(&admission), bytes_(bytes) {}
    Admission* admission_;
    double bytes_;
  };
  /// Fails with kResourceExhausted, and names the number, the limit and the option that sets it.
  Result<Promise> admit(const v1::Scene& scene);

  /// Whether so many more bytes stay within the bound of all, as of a message that comes.
  bool has_room(double bytes);

  const AdmissionLimits& limits() const { return limits_; }

  /// Memory that this process may have [bytes]: the container's if it has a bound, else the machine's.
  static double machine_bytes();
  /// Memory that this process holds [bytes].
  static double resident_bytes();

 private:
  AdmissionLimits limits_;
  double (*const used_bytes_)();
  Refusals* const refusals_;
  std::mutex mutex_;
  double promised_ = 0;  // guarded by mutex_
};

}  // namespace tensormass::control
