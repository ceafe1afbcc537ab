#pragma once

#include <atomic>
#include <cstdint>
#include <limits>

#include "core/pack.h"

/// The team of the CPU: the interface between a stage and the threads that run it.
///
///   stage(team, parts of the scene)      thread 0: patch 0   thread 1: patch 1   ...
///     for_each, for_lanes   loops over a patch's items     each in its own thread, several items a vector register
///     patch_max, patch_sum  reduce over a patch            nothing to do: a patch has one thread
///     exchange              sums over all patches          meets at the barrier
///
/// 1. Stages are written once, against this interface. backend/cuda/team.cuh implements it for a thread block.
/// 2. A patch has one thread here. A stage may therefore write to its rows in any order, which is what a matrix that
///    stores edges needs (matrix/edges.h).
/// 3. Sums run in the order of the patches, so that results repeat bitwise.
namespace tensormass::backend::cpu {

/// Waits until a fixed number of threads have arrived. It spins first, because stages are short, and then sleeps.
class Barrier {
 public:
  explicit Barrier(std::uint32_t count) : count_(count) {}

  void arrive_and_wait() {
    if (count_ == 1) return;
    const std::uint32_t phase = phase_.load(std::memory_order_acquire);
    if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == count_) {
      arrived_.store(0, std::memory_order_relaxed);
      // Sequentially consistent: notify_all looks whether somebody waits, and must not do so before the store is seen.
      phase_.store(phase + 1, std::memory_order_seq_cst);
      phase_.notify_all();
      return;
    }
    for (int spin = 0; spin < kSpins; ++spin) {
      if (phase_.load(std::memory_order_acquire) != phase) return;
    }
    while (phase_.load(std::memory_order_acquire) == phase) phase_.wait(phase, std::memory_order_acquire);
  }

 private:
  static constexpr int kSpins = 4000;
  const std::uint32_t count_;
  alignas(64) std::atomic<std::uint32_t> arrived_{0};
  alignas(64) std::atomic<std::uint32_t> phase_{0};
};

/// One thread that runs one patch.
class Team {
 public:
  template <class Real>
  using Lanes = NativeLanes<Real>;

  /// Stages with code for a single thread ask for this member.
  static constexpr bool kOneThread = true;

  /// stopped: true ends the step; any thread may set it. nullptr: nobody does.
  Team(std::uint32_t patch, std::uint32_t patch_count, Barrier& barrier, const std::atomic<bool>* stopped = nullptr)
      : patch_(patch), patch_count_(patch_count), barrier_(barrier), stopped_(stopped) {}

  std::uint32_t patch() const { return patch_; }
  /// True in one thread of all patches.
  bool leads() const { return patch_ == 0; }
  /// True in one thread of each patch: here in every thread.
  bool leads_patch() const { return true; }
  /// A patch may be run in several parts on a GPU, never here.
  std::uint32_t part() const { return 0; }
  std::uint32_t parts() const { return 1; }

  template <class Body>
  void for_each(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    for (std::uint32_t i = begin; i < end; ++i) body(i);
  }
  /// Calls use(i, read(i)) for all items; up to AtOnce items may be read before the first is used.
  template <int AtOnce, class Read, class Use>
  void for_each(std::uint32_t begin, std::uint32_t end, const Read& read, const Use& use) const {
    for (std::uint32_t i = begin; i < end; ++i) use(i, read(i));
  }
  /// Calls body(i) for every Width-th item. The end must be padded, or body must handle a partial pack.
  template <std::uint32_t Width, int AtOnce = 1, class Body>
  void for_lanes(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    for (std::uint32_t i = begin; i < end; i += Width) body(i);
  }
  /// Makes the writes of the patch's threads visible to each of them.
  void sync() const {}
  /// Reductions over the threads of a patch.
  template <class Real>
  Real patch_max(Real value) const {
    return value;
  }
  template <class Real>
  void patch_argmin(Real&, std::uint32_t&) const {}
  template <class Real, std::size_t Count>
  void patch_sum(Real (&)[Count]) const {}
  /// The largest of some numbers and the sums of others, in one reduction.
  template <class Real, std::size_t Maxima, std::size_t Sums>
  void patch_reduce(Real (&)[Maxima], Real (&)[Sums]) const {}
  /// patch_reduce in two halves, at most once in a stage. The caller must synchronize between them. Only threads that
  /// need the results call the second.
  template <class Real, std::size_t Maxima, std::size_t Sums>
  void begin_reduce(const Real (&)[Maxima], const Real (&)[Sums]) const {}
  template <class Real, std::size_t Maxima, std::size_t Sums>
  void end_reduce(Real (&)[Maxima], Real (&)[Sums]) const {}

  /// Stores a value and returns the one before. Other patches may do so at the same place at the same time.
  static std::uint32_t replace(std::uint32_t* place, std::uint32_t value) {
    return std::atomic_ref(*place).exchange(value, std::memory_order_relaxed);
  }
  /// Makes everything that a patch wrote before visible to all patches.
  void meet() const { barrier_.arrive_and_wait(); }
  /// Replaces `sums` by their sums over all patches, and makes everything that a patch wrote before visible to all
  /// patches.
  /// scratch: [patch_count, 4]; must differ from that of the previous exchange.
  /// After a stop the last sum is not a number, in all patches alike, because one patch looks. A solve ends with it.
  template <class Real, std::size_t Count>
  void exchange(Real (&sums)[Count], Real* scratch) {
    static_assert(Count <= 4);
    if (leads() && stopped_ != nullptr && stopped_->load(std::memory_order_relaxed)) {
      sums[Count - 1] = std::numeric_limits<Real>::quiet_NaN();
    }
    if (patch_count_ == 1) return;
    for (std::size_t i = 0; i < Count; ++i) scratch[4 * patch_ + i] = sums[i];
    barrier_.arrive_and_wait();
    for (std::size_t i = 0; i < Count; ++i) {
      Real total = 0;
      for (std::uint32_t patch = 0; patch < patch_count_; ++patch) total += scratch[4 * patch + i];
      sums[i] = total;
    }
  }

 private:
  const std::uint32_t patch_, patch_count_;
  Barrier& barrier_;
  const std::atomic<bool>* const stopped_;
};

}  // namespace tensormass::backend::cpu
