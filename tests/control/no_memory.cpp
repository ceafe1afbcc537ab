#include <dlfcn.h>
#include <fcntl.h>
#include <link.h>
#include <sys/mman.h>
#include <unistd.h>
#include <unwind.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstdint>
#include <cstdlib>
#include <string_view>

#include "support/operator_new.h"

/// Preloaded into a daemon (LD_PRELOAD), lets one allocation of the daemon's own code or of protobuf fail. A test says
/// which in the file that TENSORMASS_NO_MEMORY names, which both map: a number of 64 bits, the allocations until one
/// fails; 0 or less: none does.
///
/// Allocations of gRPC are not counted: without memory gRPC ends the process by itself.
namespace {

std::atomic<std::int64_t>* countdown = nullptr;

struct Code {
  std::uintptr_t begin = 0, end = 0;
  bool has(std::uintptr_t place) const { return begin <= place && place < end; }
};
Code program, protobuf;
std::array<Code, 2> passed_through;  // the standard library, whose callers count, and this library

/// Names a library's place in memory by its file's name.
int note(dl_phdr_info* info, std::size_t, void*) {
  Code code{~std::uintptr_t{0}, 0};
  for (int i = 0; i < info->dlpi_phnum; ++i) {
    const auto& segment = info->dlpi_phdr[i];
    if (segment.p_type != PT_LOAD || (segment.p_flags & PF_X) == 0) continue;
    const std::uintptr_t begin = info->dlpi_addr + segment.p_vaddr;
    code.begin = std::min(code.begin, begin);
    code.end = std::max(code.end, begin + segment.p_memsz);
  }
  const std::string_view name = info->dlpi_name;
  if (name.empty() && program.end == 0) program = code;
  if (name.find("libprotobuf.so") != name.npos) protobuf = code;
  if (name.find("libstdc++.so") != name.npos) passed_through[0] = code;
  if (code.has(reinterpret_cast<std::uintptr_t>(&note))) passed_through[1] = code;
  return 0;
}

/// Whether the place is in a function of the standard library that the program exports, so that other libraries call
/// it.
bool is_exported_standard(std::uintptr_t place) {
  Dl_info info{};
  if (!program.has(place) || dladdr(reinterpret_cast<void*>(place), &info) == 0 || info.dli_sname == nullptr)
    return false;
  const std::string_view name = info.dli_sname;
  return name.starts_with("_ZNSt") || name.starts_with("_ZNKSt") || name.starts_with("_ZSt");
}

_Unwind_Reason_Code look(_Unwind_Context* context, void* out) {
  const std::uintptr_t place = _Unwind_GetIP(context);
  if (passed_through[0].has(place) || passed_through[1].has(place) || is_exported_standard(place))
    return _URC_NO_REASON;
  *static_cast<bool*>(out) = program.has(place) || protobuf.has(place);
  return _URC_END_OF_STACK;
}
bool is_for_program_or_protobuf() {
  bool is = false;
  _Unwind_Backtrace(look, &is);
  return is;
}

[[gnu::constructor]] void begin() {
  const char* file = std::getenv("TENSORMASS_NO_MEMORY");
  const int descriptor = file == nullptr ? -1 : open(file, O_RDWR | O_CLOEXEC);
  if (descriptor < 0) return;
  void* const memory = mmap(nullptr, sizeof(*countdown), PROT_READ | PROT_WRITE, MAP_SHARED, descriptor, 0);
  close(descriptor);
  if (memory == MAP_FAILED) return;
  dl_iterate_phdr(note, nullptr);
  countdown = static_cast<std::atomic<std::int64_t>*>(memory);
}

}  // namespace

bool tensormass::tests::may_allocate(std::size_t) noexcept {
  if (countdown == nullptr || countdown->load(std::memory_order_relaxed) <= 0) return true;
  return !is_for_program_or_protobuf() || countdown->fetch_sub(1, std::memory_order_relaxed) != 1;
}
