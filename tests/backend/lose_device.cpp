#include <fcntl.h>
#include <pthread.h>
#include <unistd.h>

#include <csignal>
#include <cstdlib>
#include <thread>

#include "backend/device_faults.h"

/// Preloaded into a daemon (LD_PRELOAD), takes its GPU from it: a test writes the number of a DeviceFault, a digit,
/// into the FIFO that TENSORMASS_LOSE_DEVICE names, and a kernel with that fault runs in the daemon's process. So the
/// daemon itself has no code that makes faults.
namespace {

void wait_and_commit(const char* fifo) {
  const int from = open(fifo, O_RDONLY | O_CLOEXEC);  // waits for a writer
  char digit = 0;
  if (from < 0 || read(from, &digit, 1) != 1 || digit < '0' || digit > '3') return;
  tensormass::tests::answers_to(static_cast<tensormass::tests::DeviceFault>(digit - '0'));
}

/// The daemon takes signals on its main thread alone, so this thread blocks them all.
[[gnu::constructor]] void begin() {
  const char* fifo = std::getenv("TENSORMASS_LOSE_DEVICE");
  if (fifo == nullptr) return;
  sigset_t all, before;
  sigfillset(&all);
  pthread_sigmask(SIG_BLOCK, &all, &before);
  std::thread(wait_and_commit, fifo).detach();
  pthread_sigmask(SIG_SETMASK, &before, nullptr);
}

}  // namespace
