// Compiled for any x86-64, and run before anything that is not: a daemon on too old a CPU says so instead of dying of
// an illegal instruction.
#ifdef TENSORMASS_CPU_LEVEL

#include <unistd.h>

#include <cstring>

namespace {

constexpr char kMessage[] =
    "tensormassd: this CPU lacks instructions that the program was compiled for (" TENSORMASS_CPU_LEVEL
    "). Build it with -DTENSORMASS_CPU_ARCHITECTURE=x86-64, or run it on a newer CPU.\n";

__attribute__((constructor(101))) void refuse_old_cpu() {
  __builtin_cpu_init();
  if (__builtin_cpu_supports(TENSORMASS_CPU_LEVEL)) return;
  [[maybe_unused]] const ssize_t written = write(STDERR_FILENO, kMessage, std::strlen(kMessage));
  _exit(1);
}

}  // namespace

#endif
