#include "core/secret_file.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstring>

#include <fmt/format.h>

namespace tensormass {

Result<std::string> read_file_of_owner(const std::string& path, mode_t forbidden, std::string_view place,
                                       std::string_view remedy) {
  const auto refuse = [&](std::string_view what) { return invalid(fmt::format("{}{}{}", place, path, what)); };
  struct Open {
    int descriptor;
    ~Open() {
      if (descriptor >= 0) close(descriptor);
    }
  };
  // O_NONBLOCK: a pipe in place of the file is refused below, and must not make anybody wait before.
  const Open file{open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK)};
  struct stat found {};
  // The mode of what is read counts, whatever has its name by now.
  if (file.descriptor < 0 || fstat(file.descriptor, &found) != 0) {
    return refuse(fmt::format(": cannot be read: {}; {}", std::strerror(errno), remedy));
  }
  if (!S_ISREG(found.st_mode)) return refuse(fmt::format(": not a file; {}", remedy));
  if ((found.st_mode & forbidden) != 0) {
    return refuse(
        fmt::format(": every user of this machine can use it; renew the keys if a stranger may have read it, else: "
                    "chmod o-rwx {}",
                    path));
  }
  // Whoever owns a file can read and replace it, whatever its mode. Root can anyway; Kubernetes' Secrets are root's.
  if (found.st_uid != geteuid() && found.st_uid != 0) {
    return refuse(fmt::format(
        ": user {} owns it, who is neither the user of this program, {}, nor root; run it as user {}, or: chown {} {}",
        found.st_uid, geteuid(), found.st_uid, geteuid(), path));
  }
  std::string text;
  std::array<char, 4096> part;
  while (true) {
    const ssize_t size = read(file.descriptor, part.data(), part.size());
    if (size < 0) return refuse(fmt::format(": cannot be read: {}; {}", std::strerror(errno), remedy));
    if (size == 0) return text;
    text.append(part.data(), static_cast<std::size_t>(size));
  }
}

}  // namespace tensormass
