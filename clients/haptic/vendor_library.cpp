#include "haptic/vendor_library.h"

#include <dlfcn.h>

#include <spdlog/fmt/fmt.h>

namespace tensormass::haptic {

Result<VendorLibrary> VendorLibrary::open(const std::string& path, const std::string& kit, const std::string& remedy) {
  VendorLibrary library;
  // All symbols at once: a library that misses one of its own must fail here, not in the loop.
  library.handle_ = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
  if (library.handle_ == nullptr) {
    const char* reason = dlerror();
    return fail(ErrorCode::kUnavailable, fmt::format("{}: cannot load {} ({}); {}", kit, path,
                                                     reason == nullptr ? "no reason given" : reason, remedy));
  }
  library.path_ = path;
  library.kit_ = kit;
  library.remedy_ = remedy;
  return library;
}

Result<void*> VendorLibrary::find_symbol(const char* name) const {
  void* const symbol = dlsym(handle_, name);
  if (symbol != nullptr) return symbol;
  return fail(ErrorCode::kUnavailable,
              fmt::format("{}: {} has no function {}, so it is another library or another version; {}", kit_, path_,
                          name, remedy_));
}

}  // namespace tensormass::haptic
