#pragma once

#include <chrono>
#include <ctime>
#include <memory>

#include <cuda_runtime.h>
#include <sys/prctl.h>

#include "backend/cuda/memory.cuh"
#include "model/model.h"

/// Streams and graphs that end with their owner, and how to wait for them.
///
///   stages of a step ── record_graph, once ──> Graph ── launch, each step ──> Stream ── wait ──> results
///
/// 1. A step launches one recorded graph instead of each kernel: the host does less for each step.
/// 2. A thread that waits for its stream may sleep (wait_and_look), because many scenes share few processors.
namespace tensormass::backend::cuda {

/// Ends a stream after its work has finished.
struct EndStream {
  void operator()(cudaStream_t stream) const {
    cudaStreamSynchronize(stream);
    cudaStreamDestroy(stream);
  }
};
using Stream = std::unique_ptr<CUstream_st, EndStream>;

inline Stream make_stream() {
  cudaStream_t stream = nullptr;
  check(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking), "stream");
  return Stream(stream);
}

struct DestroyGraph {
  void operator()(cudaGraphExec_t graph) const { cudaGraphExecDestroy(graph); }
};
using Graph = std::unique_ptr<CUgraphExec_st, DestroyGraph>;

/// Waits until the work of a stream has finished. After `awake` it does not occupy a processor: many scenes have more
/// threads than a machine has processors. A blocking event would wake up late, and all scenes would meet at a lock of
/// the driver.
///
///   look()   called again and again meanwhile
template <class Look>
cudaError_t wait_and_look(cudaStream_t stream, std::chrono::microseconds awake, const Look& look) {
  using Clock = std::chrono::steady_clock;
  constexpr long kSleepNs = 20'000;
  thread_local const bool precise = prctl(PR_SET_TIMERSLACK, 1UL, 0UL, 0UL, 0UL) == 0;
  static_cast<void>(precise);
  const Clock::time_point sleepy = Clock::now() + awake;
  for (;;) {
    if (const cudaError_t status = cudaStreamQuery(stream); status != cudaErrorNotReady) return status;
    look();
    if (awake.count() > 0 && Clock::now() < sleepy) continue;
    const timespec sleep{0, kSleepNs};
    nanosleep(&sleep, nullptr);
  }
}

/// Whether a solve may take so long, on a slow device, that a caller of `stop` would have to wait for it.
template <class Real>
bool may_take_long(const model::Model& model) {
  constexpr double kLongS = 0.25, kLatencyS = 3e-5, kBytesPerS = 2e11;
  const double blocks = double{view::kSliceRows} * model.layout.slice_begin.back();
  const double iteration_s = kLatencyS + 9 * sizeof(Real) * blocks / kBytesPerS;
  return model.cg_max_iterations * iteration_s > kLongS;
}

/// Records the work that enqueue() puts into the stream as a graph, without running it.
///
///   enqueue()   called once; may throw
template <class Enqueue>
Graph record_graph(cudaStream_t stream, const Enqueue& enqueue) {
  cudaGraph_t graph = nullptr;
  cudaGraphExec_t executable = nullptr;
  // Capture is local to the thread: other scenes allocate and launch at the same time.
  check(cudaStreamBeginCapture(stream, cudaStreamCaptureModeThreadLocal), "start of the step's graph");
  try {
    enqueue();
  } catch (...) {
    // While a thread is recording, it cannot load another scene. So recording must end here too.
    cudaStreamEndCapture(stream, &graph);
    if (graph) cudaGraphDestroy(graph);
    throw;
  }
  check(cudaStreamEndCapture(stream, &graph), "end of the step's graph");
  const cudaError_t status = cudaGraphInstantiate(&executable, graph, 0);
  cudaGraphDestroy(graph);
  check(status, "the step's graph");
  Graph made(executable);
  // Takes its device memory now, so that a lack of it refuses the scene and does not stop its first step.
  check(cudaGraphUpload(made.get(), stream), "the step's graph");
  return made;
}

}  // namespace tensormass::backend::cuda
