// Checks at start that the CPU has the instructions that the rest of the program was compiled for. Without this check a
// daemon on an older CPU dies of an illegal instruction, without a message.
//
// CMake compiles this file alone for plain x86-64. The constructor's priority, 101, runs it before the program's other
// code; it calls only libc, which is not compiled for newer instructions.
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
