#include "world/loop_status.h"

#include <utility>

#include <fmt/format.h>

#include "world/messages.h"

namespace tensormass::world {

namespace {

void fill(const DurationCounts& counts, v1::DurationHistogram& out) {
  for (std::size_t bucket = 0; bucket < DurationBuckets::kCount; ++bucket) {
    const std::uint64_t count = counts.count(bucket);
    if (count == 0) continue;
    out.add_buckets(static_cast<std::uint32_t>(bucket));
    out.add_counts(count);
  }
  out.set_max_s(1e-9 * static_cast<double>(counts.max_ns()));
}

}  // namespace

LoopStatus::LoopStatus(const std::shared_ptr<const model::Model>& model, SceneDevice device,
                       const IterationBudget& budget, const Present<Generation>& generation, const PoseCounts& poses,
                       const LoopOutputs& outputs, std::shared_ptr<SceneCounts> counts)
    : settings_(*model),
      device_(std::move(device)),
      generation_(generation),
      poses_(poses),
      outputs_(outputs),
      state_(model->lockstep ? v1::SceneStatus::STATE_LOCKSTEP : v1::SceneStatus::STATE_RUNNING),
      statistics_(std::make_shared<StepStatistics>()),
      counts_(std::move(counts)),
      findings_(model, budget) {}

void LoopStatus::go_on_with(const std::shared_ptr<const model::Model>& model) noexcept {
  findings_.go_on_with(model);
  if (state_ != v1::SceneStatus::STATE_FAULTED) return;
  {
    const std::lock_guard lock(fault_mutex_);
    fault_.clear();
  }
  set_state(settings_.lockstep ? v1::SceneStatus::STATE_LOCKSTEP : v1::SceneStatus::STATE_RUNNING);
}

void LoopStatus::set_state(State next) {
  state_ = next;
  statistics_->interrupt();
  due_.store(true, std::memory_order_relaxed);
}

void LoopStatus::set_fault(std::string reason) {
  {
    const std::lock_guard lock(fault_mutex_);
    fault_ = std::move(reason);
  }
  set_state(v1::SceneStatus::STATE_FAULTED);
}

void LoopStatus::clear() {
  {
    const std::lock_guard lock(fault_mutex_);
    fault_.clear();
  }
  findings_.clear();
}

void LoopStatus::take_stamp(const StepStamp& stamp) {
  step_count_.store(stamp.step, std::memory_order_relaxed);
  simulated_time_s_.store(stamp.simulated_time_s, std::memory_order_relaxed);
  changes_.fetch_add(1, std::memory_order_relaxed);
}

void LoopStatus::take_edits(const World& world) {
  findings_.take_edits(world);
  fracture_energy_j_.store(world.sweeps().fracture_j(), std::memory_order_relaxed);
  if (world.editor() == nullptr) return;
  removed_mass_kg_.store(world.editor()->removed_mass_kg(), std::memory_order_relaxed);
  removed_volume_m3_.store(world.editor()->removed_volume_m3(), std::memory_order_relaxed);
  changes_.fetch_add(1, std::memory_order_relaxed);
}

Result<void> LoopStatus::require_not_faulted() const {
  if (state_ != v1::SceneStatus::STATE_FAULTED) return {};
  const std::lock_guard lock(fault_mutex_);
  return fail(ErrorCode::kFailedPrecondition, fmt::format("scene '{}' is stopped: {}", settings_.name, fault_));
}

v1::SceneStatus LoopStatus::make() const {
  v1::SceneStatus status;
  status.set_scene(settings_.name);
  status.set_state(state_);
  status.set_step(step_count_.load(std::memory_order_relaxed));
  status.set_simulated_time_s(simulated_time_s_.load(std::memory_order_relaxed));
  status.set_server_time_ns(unix_time_ns());
  status.set_target_rate_hz(settings_.lockstep ? 0 : settings_.rate_hz);
  status.set_reached_rate_hz(statistics_->reached_rate_hz());
  status.set_missed_deadlines(statistics_->missed_deadlines());
  const StepStatistics::Percentiles times = statistics_->percentiles();
  status.set_step_time_p50_s(times.p50_s);
  status.set_step_time_p99_s(times.p99_s);
  status.set_step_time_max_s(times.max_s);
  fill(statistics_->times(), *status.mutable_step_times());
  std::uint64_t received = poses_.received.load(std::memory_order_relaxed),
                rejected =
                    poses_.malformed.load(std::memory_order_relaxed) + poses_.rejected.load(std::memory_order_relaxed),
                superseded = poses_.superseded.load(std::memory_order_relaxed);
  for (const std::shared_ptr<PoseInbox>& inbox : generation_.get()->inboxes) {
    received += inbox->received();
    rejected += inbox->rejected();
    superseded += inbox->superseded();
  }
  status.set_poses_received(received);
  status.set_poses_rejected(rejected);
  status.set_poses_superseded(superseded);
  status.set_backend(device_.backend);
  status.set_device(device_.number);
  if (state_ == v1::SceneStatus::STATE_RUNNING) {
    status.set_hand_period_s(hand_period_s_.load(std::memory_order_relaxed));
    status.set_step_lead_s(step_lead_s_.load(std::memory_order_relaxed));
  }
  status.set_removed_mass_kg(removed_mass_kg_.load(std::memory_order_relaxed));
  status.set_removed_volume_m3(removed_volume_m3_.load(std::memory_order_relaxed));
  status.set_cut_area_m2(cut_area_m2_.load(std::memory_order_relaxed));
  status.set_fracture_energy_j(fracture_energy_j_.load(std::memory_order_relaxed));
  findings_.add_to(status);
  {
    const std::lock_guard lock(fault_mutex_);
    status.set_fault(fault_);
  }
  outputs_.add_to(status);
  return status;
}

bool LoopStatus::take(v1::SceneStatus& status) {
  const Clock::time_point now = Clock::now();
  const bool changed = due_.exchange(false, std::memory_order_relaxed);
  const double rate_hz = settings_.status_rate_hz;
  if (!changed && (rate_hz == 0 || now < next_)) return false;
  if (rate_hz > 0) {
    next_ = now + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1 / rate_hz));
  }
  status = make();
  return true;
}

}  // namespace tensormass::world
