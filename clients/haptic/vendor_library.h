#pragma once

// A shared library of a device's maker, loaded at run time. Its kit is then not needed to build this client.

#include <string>

#include "core/result.h"

namespace tensormass::haptic {

/// An open library. It stays loaded until the program ends, because makers' libraries start threads of their own.
class VendorLibrary {
 public:
  /// Opens `path`: a file's path, or a name that the system's loader searches for.
  /// kit: name of the maker's kit, which starts each message. remedy: what the user installs, which ends it.
  static Result<VendorLibrary> open(const std::string& path, const std::string& kit, const std::string& remedy);

  /// Sets `function` to the function of this name. Fails if the library lacks it.
  template <class Function>
  Result<void> find(const char* name, Function*& function) const {
    TM_ASSIGN_OR_RETURN(symbol, find_symbol(name));
    function = reinterpret_cast<Function*>(symbol);
    return {};
  }

  /// Sets `function` to the function of this name, or to null if the library lacks it.
  template <class Function>
  void find_optional(const char* name, Function*& function) const {
    function = reinterpret_cast<Function*>(find_symbol(name).value_or(nullptr));
  }

 private:
  Result<void*> find_symbol(const char* name) const;

  void* handle_ = nullptr;
  std::string path_, kit_, remedy_;
};

}  // namespace tensormass::haptic
