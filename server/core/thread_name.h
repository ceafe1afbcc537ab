#pragma once

#include <pthread.h>

#include <cstddef>
#include <string>
#include <string_view>

namespace tensormass {

/// Names the calling thread, for debuggers, `top -H` and /proc/PID/task/*/comm. Linux keeps the first 15 bytes.
inline void name_thread(std::string_view name) {
  constexpr std::size_t kMax = 15;
  pthread_setname_np(pthread_self(), std::string(name.substr(0, kMax)).c_str());
}

}  // namespace tensormass
