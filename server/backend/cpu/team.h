#pragma once

#include <atomic>
#include <cstdint>

#include "core/pack.h"

namespace tensormass::backend::cpu {

/// Waits until all of a fixed number of threads have arrived. Spins shortly, since stages are short, then sleeps.
class Barrier {
 public:
  explicit Barrier(std::uint32_t count) : count_(count) {}

  void arrive_and_wait() {
    if (count_ == 1) return;
    const std::uint32_t phase = phase_.load(std::memory_order_acquire);
    if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == count_) {
      arrived_.store(0, std::memory_order_relaxed);
      phase_.store(phase + 1, std::memory_order_release);
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

/// One thread that runs one patch. The interface that the stages are written against; backend/cuda/team.cuh is the
/// other.
class Team {
 public:
  template <class Real>
  using Lanes = NativeLanes<Real>;

  /// What no other thread writes, it may write in any order: a matrix may store edges (matrix/edges.h).
  static constexpr bool kOneThread = true;

  Team(std::uint32_t patch, std::uint32_t patch_count, Barrier& barrier)
      : patch_(patch), patch_count_(patch_count), barrier_(barrier) {}

  std::uint32_t patch() const { return patch_; }
  bool leads() const { return patch_ == 0; }
  bool leads_patch() const { return true; }
  std::uint32_t part() const { return 0; }
  std::uint32_t parts() const { return 1; }

  template <class Body>
  void for_each(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    for (std::uint32_t i = begin; i < end; ++i) body(i);
  }
  /// use(i, read(i)) for all; up to AtOnce may be read before the first is used.
  template <int AtOnce, class Read, class Use>
  void for_each(std::uint32_t begin, std::uint32_t end, const Read& read, const Use& use) const {
    for (std::uint32_t i = begin; i < end; ++i) use(i, read(i));
  }
  template <std::uint32_t Width, int AtOnce = 1, class Body>
  void for_lanes(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    for (std::uint32_t i = begin; i < end; i += Width) body(i);
  }
  /// What the patch's threads wrote is visible to them.
  void sync() const {}
  template <class Real>
  Real patch_max(Real value) const {
    return value;
  }
  template <class Real>
  void patch_argmin(Real&, std::uint32_t&) const {}
  template <class Real, std::size_t Count>
  void patch_sum(Real (&)[Count]) const {}
  /// The largest of some numbers and the sums of others, at once.
  template <class Real, std::size_t Maxima, std::size_t Sums>
  void patch_reduce(Real (&)[Maxima], Real (&)[Sums]) const {}
  /// In two halves, once in a stage, with a sync between; the second is for whoever asks.
  template <class Real, std::size_t Maxima, std::size_t Sums>
  void begin_reduce(const Real (&)[Maxima], const Real (&)[Sums]) const {}
  template <class Real, std::size_t Maxima, std::size_t Sums>
  void end_reduce(Real (&)[Maxima], Real (&)[Sums]) const {}

  /// Sums over all patches in their order, and makes what each patch wrote before visible to all.
  /// scratch: [patch_count, 4], not the one of the exchange before.
  template <class Real, std::size_t Count>
  void exchange(Real (&sums)[Count], Real* scratch) {
    static_assert(Count <= 4);
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
};

}  // namespace tensormass::backend::cpu
