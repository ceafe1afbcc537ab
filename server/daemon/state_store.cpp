#include "daemon/state_store.h"

#include <dirent.h>
#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cerrno>
#include <charconv>
#include <cstring>
#include <optional>
#include <utility>

#include <fmt/format.h>
#include <openssl/evp.h>

#include "access/openssl_pointers.h"
#include "core/limits.h"
#include "core/names.h"
#include "core/state_limits.h"

namespace tensormass::daemon {
namespace {

/// The first byte is not text, and a transfer that changes ends of lines damages the last one.
constexpr std::array<char, 8> kStateMagic{'\x89', 'T', 'M', 'S', 'T', 'A', 'T', '\n'};
constexpr std::uint32_t kStateFormat = 1;
enum StateKind : std::uint32_t { kSceneFile = 1, kSnapshotFile = 2 };
using StateSum = std::array<unsigned char, 32>;

struct FileHeader {
  std::array<char, 8> magic = kStateMagic;
  std::uint32_t format = kStateFormat;
  std::uint32_t kind = 0;
  std::array<char, 32> version{};  // the daemon's; ends with a zero
  std::uint32_t paused = 0;
  std::uint32_t first_size = 0;   // snapshot: bytes of SceneAdjustments, which come first; scene: 0
  std::uint64_t second_size = 0;  // bytes of the scene or the snapshot
  StateSum sum{};                 // SHA-256 of this header with zeros here, and of the content
};
static_assert(sizeof(FileHeader) == 96, "state_store.h states the size");
static_assert(std::endian::native == std::endian::little);

constexpr std::string_view kSceneEnd = ".scene", kSnapshotEnd = ".snapshot", kUnfinishedEnd = ".unfinished";
constexpr const char* kAside = "aside";

StateSum sum_of(FileHeader header, std::string_view first, std::string_view second) {
  header.sum = {};
  StateSum sum{};
  const access::Digest digest(EVP_MD_CTX_new());
  EVP_MD_CTX* const context = digest.get();
  const bool done = context != nullptr && EVP_DigestInit_ex(context, EVP_sha256(), nullptr) == 1 &&
                    EVP_DigestUpdate(context, &header, sizeof(header)) == 1 &&
                    EVP_DigestUpdate(context, first.data(), first.size()) == 1 &&
                    EVP_DigestUpdate(context, second.data(), second.size()) == 1 &&
                    EVP_DigestFinal_ex(context, sum.data(), nullptr) == 1;
  if (!done) throw std::bad_alloc();  // nothing else can fail here
  return sum;
}

bool write_all(int descriptor, std::string_view bytes) {
  while (!bytes.empty()) {
    const ssize_t count = ::write(descriptor, bytes.data(), bytes.size());
    if (count < 0 && errno == EINTR) continue;
    if (count < 0) return false;
    bytes.remove_prefix(static_cast<std::size_t>(count));
  }
  return true;
}

/// Reads what is there, at most bytes.size(). Returns the number of bytes, or -1.
ssize_t read_all(int descriptor, std::string& bytes) {
  std::size_t at = 0;
  while (at < bytes.size()) {
    const ssize_t count = ::read(descriptor, bytes.data() + at, bytes.size() - at);
    if (count < 0 && errno == EINTR) continue;
    if (count < 0) return -1;
    if (count == 0) break;
    at += static_cast<std::size_t>(count);
  }
  return static_cast<ssize_t>(at);
}

std::string scene_file(const std::string& name) { return name + std::string(kSceneEnd); }

std::string snapshot_file(const std::string& name, std::uint64_t generation) {
  return fmt::format("{}.{}{}", name, generation, kSnapshotEnd);
}

/// A file that passed its sum.
struct StateFile {
  FileHeader header;
  std::string bytes;
  std::string_view first() const { return std::string_view(bytes).substr(sizeof(FileHeader), header.first_size); }
  std::string_view second() const { return std::string_view(bytes).substr(sizeof(FileHeader) + header.first_size); }
};

/// Reads and checks a file. path: for errors
Result<StateFile> read_state_file(int directory, const std::string& file, const std::string& path, StateKind kind) {
  const auto damaged = [&](std::string_view why) { return invalid(fmt::format("{}: {}", path, why)); };
  // Neither a pipe nor a link to a device may hold the daemon up.
  const int descriptor = openat(directory, file.c_str(), O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
  if (descriptor < 0) return damaged(std::strerror(errno));
  struct stat found {};
  StateFile out;
  std::string why;
  constexpr std::size_t kLargest =
      sizeof(FileHeader) + limits::kMaxStateAdjustmentBytes + limits::kMaxControlMessageBytes;
  if (fstat(descriptor, &found) != 0 || !S_ISREG(found.st_mode)) {
    why = "is not a regular file";
  } else if (found.st_size < static_cast<off_t>(sizeof(FileHeader))) {
    why = fmt::format("{} bytes are too few; it is cut off", found.st_size);
  } else if (found.st_size > static_cast<off_t>(kLargest)) {
    why = fmt::format("{} bytes are more than {}", found.st_size, kLargest);
  } else {
    out.bytes.resize(static_cast<std::size_t>(found.st_size));
    if (read_all(descriptor, out.bytes) != found.st_size) why = "cannot be read";
  }
  close(descriptor);
  if (!why.empty()) return damaged(why);
  std::memcpy(&out.header, out.bytes.data(), sizeof(FileHeader));
  const FileHeader& header = out.header;
  if (header.magic != kStateMagic) return damaged("is not a file of --state, or is damaged");
  if (header.format != kStateFormat) {
    return damaged(fmt::format("has format {}, but this daemon reads format {}", header.format, kStateFormat));
  }
  const std::uint64_t content = out.bytes.size() - sizeof(FileHeader);
  if (header.kind != kind || header.first_size > limits::kMaxStateAdjustmentBytes ||
      header.second_size > limits::kMaxControlMessageBytes || header.first_size + header.second_size != content ||
      header.version.back() != '\0') {
    return damaged("its header is wrong; it is cut off or damaged");
  }
  if (sum_of(header, out.first(), out.second()) != header.sum) return damaged("its checksum is wrong; it is damaged");
  return out;
}

/// What the name of a file says.
struct NamedFile {
  std::string scene;
  std::optional<std::uint64_t> generation;  // no value: the scene itself
};

std::optional<NamedFile> read_file_name(std::string_view file) {
  if (file.ends_with(kSceneEnd)) {
    file.remove_suffix(kSceneEnd.size());
    return is_valid_name(file) ? std::optional(NamedFile{std::string(file), std::nullopt}) : std::nullopt;
  }
  if (!file.ends_with(kSnapshotEnd)) return std::nullopt;
  file.remove_suffix(kSnapshotEnd.size());
  const std::size_t dot = file.rfind('.');
  if (dot == std::string_view::npos || !is_valid_name(file.substr(0, dot))) return std::nullopt;
  const std::string_view digits = file.substr(dot + 1);
  std::uint64_t generation = 0;
  const auto [end, failure] = std::from_chars(digits.data(), digits.data() + digits.size(), generation);
  // The name must be the one that this number is written as.
  if (failure != std::errc{} || end != digits.data() + digits.size() || fmt::format("{}", generation) != digits ||
      generation >= std::uint64_t{1} << 63) {
    return std::nullopt;
  }
  return NamedFile{std::string(file.substr(0, dot)), generation};
}

/// Calls visit(name, bytes) for each regular file of a folder.
template <class Visit>
bool visit_files(int directory, const Visit& visit) {
  const int again = openat(directory, ".", O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  DIR* const entries = again < 0 ? nullptr : fdopendir(again);
  if (entries == nullptr) {
    if (again >= 0) close(again);
    return false;
  }
  while (const dirent* entry = readdir(entries)) {
    struct stat found {};
    if (fstatat(directory, entry->d_name, &found, AT_SYMLINK_NOFOLLOW) != 0 || !S_ISREG(found.st_mode)) continue;
    visit(std::string(entry->d_name), static_cast<std::uint64_t>(found.st_size));
  }
  closedir(entries);
  return true;
}

}  // namespace

StateStore::StateStore(std::string folder, std::string version, std::uint64_t max_bytes)
    : folder_(std::move(folder)), version_(std::move(version)), max_bytes_(max_bytes) {}

StateStore::~StateStore() {
  if (aside_ >= 0) close(aside_);
  if (directory_ >= 0) close(directory_);  // ends the lock
}

Result<std::unique_ptr<StateStore>> StateStore::open(const std::string& folder, std::string version,
                                                     std::uint64_t max_bytes) {
  TM_ASSERT(version.size() < FileHeader{}.version.size(), "a version fits its field");
  std::unique_ptr<StateStore> store(new StateStore(folder, std::move(version), max_bytes));
  if (mkdir(folder.c_str(), 0700) != 0 && errno != EEXIST) {
    return invalid(
        fmt::format("--state: cannot make the folder '{}': {}; make it, for this user alone: "
                    "install -d -m 700 '{}'",
                    folder, std::strerror(errno), folder));
  }
  store->directory_ = ::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  struct stat found {};
  if (store->directory_ < 0 || fstat(store->directory_, &found) != 0) {
    return invalid(fmt::format("--state: cannot open the folder '{}': {}; name a folder of the daemon's user", folder,
                               std::strerror(errno)));
  }
  if (found.st_uid != geteuid()) {
    return invalid(
        fmt::format("--state: the folder '{}' is of user {}, but the daemon runs as user {}; name a folder "
                    "of the daemon's user, or: chown {} '{}'",
                    folder, found.st_uid, geteuid(), geteuid(), folder));
  }
  if ((found.st_mode & 0022) != 0) {
    return invalid(
        fmt::format("--state: others can write the folder '{}' (mode {:o}); scenes are loaded from it, so: "
                    "chmod 700 '{}'",
                    folder, found.st_mode & 07777, folder));
  }
  if (flock(store->directory_, LOCK_EX | LOCK_NB) != 0) {
    return fail(ErrorCode::kUnavailable,
                fmt::format("--state: another daemon uses the folder '{}'; end it, or name another folder", folder));
  }
  TM_RETURN_IF_ERROR(store->scan());
  return store;
}

Result<void> StateStore::scan() {
  std::map<std::string, std::map<std::uint64_t, std::uint64_t>> snapshots;
  const bool read = visit_files(directory_, [&](const std::string& file, std::uint64_t bytes) {
    if (file.starts_with('.') && file.ends_with(kUnfinishedEnd)) {
      unlinkat(directory_, file.c_str(), 0);
    } else if (const auto named = read_file_name(file)) {
      if (named->generation) {
        snapshots[named->scene][*named->generation] = bytes;
      } else {
        scenes_[named->scene].bytes = bytes;
      }
    }
  });
  if (!read) return fail(ErrorCode::kUnavailable, fmt::format("--state: the folder '{}' cannot be read", folder_));
  for (const auto& [name, generations] : snapshots) {
    const auto scene = scenes_.find(name);
    for (const auto& [generation, bytes] : generations) {
      if (scene == scenes_.end()) {  // its scene was removed, and the process ended midway
        unlinkat(directory_, snapshot_file(name, generation).c_str(), 0);
      } else {
        bytes_ += bytes;
      }
    }
    if (scene == scenes_.end()) continue;
    scene->second.generations = generations;
    scene->second.next_generation = generations.rbegin()->first + 1;
  }
  for (auto& [name, scene] : scenes_) {
    scene.ticket = next_ticket_++;
    bytes_ += scene.bytes;
  }
  aside_ = openat(directory_, kAside, O_RDONLY | O_DIRECTORY | O_CLOEXEC | O_NOFOLLOW);
  if (aside_ >= 0) {
    visit_files(aside_, [&](const std::string& file, std::uint64_t bytes) {
      aside_bytes_[file] = bytes;
      bytes_ += bytes;
    });
  }
  return {};
}

std::vector<std::string> StateStore::scenes() const {
  const std::lock_guard lock(mutex_);
  std::vector<std::string> names;
  for (const auto& [name, scene] : scenes_) names.push_back(name);
  return names;
}

Result<v1::Scene> StateStore::read_scene(const std::string& name) const {
  const std::string path = path_of(scene_file(name));
  TM_ASSIGN_OR_RETURN(file, read_state_file(directory_, scene_file(name), path, kSceneFile));
  v1::Scene scene;
  if (!scene.ParseFromArray(file.second().data(), static_cast<int>(file.second().size())) || scene.name() != name) {
    return invalid(fmt::format("{}: is not a scene named '{}'", path, name));
  }
  return scene;
}

std::vector<std::uint64_t> StateStore::generations(const std::string& name) const {
  const std::lock_guard lock(mutex_);
  std::vector<std::uint64_t> numbers;
  const auto scene = scenes_.find(name);
  if (scene == scenes_.end()) return numbers;
  for (const auto& [number, bytes] : scene->second.generations) numbers.push_back(number);
  std::reverse(numbers.begin(), numbers.end());
  return numbers;
}

Result<StateStore::Snapshot> StateStore::read_snapshot(const std::string& name, std::uint64_t generation) const {
  const std::string path = path_of(snapshot_file(name, generation));
  TM_ASSIGN_OR_RETURN(file, read_state_file(directory_, snapshot_file(name, generation), path, kSnapshotFile));
  Snapshot out;
  out.version = file.header.version.data();
  out.paused = file.header.paused != 0;
  if (!out.adjustments.ParseFromArray(file.first().data(), static_cast<int>(file.first().size()))) {
    return invalid(fmt::format("{}: its adjusted values cannot be read", path));
  }
  out.snapshot = file.second();
  return out;
}

Result<void> StateStore::reserve(std::uint64_t bytes) {
  const std::lock_guard lock(mutex_);
  if (bytes_ + bytes > max_bytes_) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("{}: {} bytes more than its {} would pass --max-state-mib {}; unload scenes, empty '{}/{}' "
                            "or raise the limit",
                            folder_, bytes, bytes_, max_bytes_ >> 20, folder_, kAside));
  }
  bytes_ += bytes;
  return {};
}

void StateStore::release(std::uint64_t bytes) {
  const std::lock_guard lock(mutex_);
  bytes_ -= bytes;
}

Result<std::string> StateStore::write_unfinished(std::uint32_t kind, bool paused, std::string_view first,
                                                 std::string_view second) {
  FileHeader header;
  header.kind = kind;
  std::copy(version_.begin(), version_.end(), header.version.begin());
  header.paused = paused ? 1 : 0;
  header.first_size = static_cast<std::uint32_t>(first.size());
  header.second_size = second.size();
  header.sum = sum_of(header, first, second);
  std::string file;
  {
    const std::lock_guard lock(mutex_);
    file = fmt::format(".{}{}", next_unfinished_++, kUnfinishedEnd);
  }
  const int descriptor = openat(directory_, file.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, 0600);
  int failure = descriptor < 0 ? errno : 0;
  if (descriptor >= 0) {
    const std::string_view head(reinterpret_cast<const char*>(&header), sizeof(header));
    const bool written = write_all(descriptor, head) && write_all(descriptor, first) && write_all(descriptor, second) &&
                         fsync(descriptor) == 0;
    if (!written) failure = errno;
    if (close(descriptor) != 0 && failure == 0) failure = errno;
    if (failure != 0) unlinkat(directory_, file.c_str(), 0);
  }
  if (failure == 0) return file;
  return fail(ErrorCode::kUnavailable, fmt::format("cannot write to '{}': {}; make room there, or name another folder "
                                                   "with --state",
                                                   folder_, std::strerror(failure)));
}

Result<StateStore::Ticket> StateStore::add(const v1::Scene& scene) {
  TM_ASSERT(is_valid_name(scene.name()), "a loaded scene has a valid name");
  const std::string& name = scene.name();
  remove(name);
  std::string content;
  if (!scene.SerializeToString(&content) || content.size() > limits::kMaxControlMessageBytes) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("scene '{}' is larger than limits::kMaxControlMessageBytes", name));
  }
  const std::uint64_t bytes = sizeof(FileHeader) + content.size();
  TM_RETURN_IF_ERROR(reserve(bytes));
  const auto unfinished = write_unfinished(kSceneFile, false, {}, content);
  if (!unfinished) {
    release(bytes);
    return tl::make_unexpected(unfinished.error());
  }
  const std::lock_guard lock(mutex_);
  if (renameat(directory_, unfinished->c_str(), directory_, scene_file(name).c_str()) != 0) {
    bytes_ -= bytes;
    unlinkat(directory_, unfinished->c_str(), 0);
    return fail(ErrorCode::kUnavailable, fmt::format("cannot write to '{}'", folder_));
  }
  fsync(directory_);
  Scene& added = scenes_[name];
  added.bytes = bytes;
  added.ticket = next_ticket_++;
  return added.ticket;
}

StateStore::Ticket StateStore::ticket(const std::string& name) const {
  const std::lock_guard lock(mutex_);
  const auto scene = scenes_.find(name);
  return scene == scenes_.end() ? 0 : scene->second.ticket;
}

Result<void> StateStore::write(const std::string& name, Ticket ticket, const Snapshot& snapshot) {
  std::string adjustments;
  if (!snapshot.adjustments.SerializeToString(&adjustments) || adjustments.size() > limits::kMaxStateAdjustmentBytes ||
      snapshot.snapshot.size() > limits::kMaxControlMessageBytes) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("the snapshot of scene '{}' has {} bytes, more than limits::kMaxControlMessageBytes", name,
                            snapshot.snapshot.size()));
  }
  const std::uint64_t bytes = sizeof(FileHeader) + adjustments.size() + snapshot.snapshot.size();
  TM_RETURN_IF_ERROR(reserve(bytes));
  const auto unfinished = write_unfinished(kSnapshotFile, snapshot.paused, adjustments, snapshot.snapshot);
  if (!unfinished) {
    release(bytes);
    return tl::make_unexpected(unfinished.error());
  }
  const std::lock_guard lock(mutex_);
  const auto found = scenes_.find(name);
  const bool wanted = found != scenes_.end() && found->second.ticket == ticket;
  const std::uint64_t generation = wanted ? found->second.next_generation : 0;
  if (!wanted || renameat(directory_, unfinished->c_str(), directory_, snapshot_file(name, generation).c_str()) != 0) {
    bytes_ -= bytes;
    unlinkat(directory_, unfinished->c_str(), 0);
    return wanted ? fail(ErrorCode::kUnavailable, fmt::format("cannot write to '{}'", folder_)) : Result<void>{};
  }
  fsync(directory_);
  Scene& scene = found->second;
  ++scene.next_generation;
  scene.generations[generation] = bytes;
  while (scene.generations.size() > limits::kStateGenerations) {
    remove_generation(name, scene, scene.generations.begin()->first);
  }
  return {};
}

void StateStore::remove(const std::string& name) {
  const std::lock_guard lock(mutex_);
  remove_locked(name);
}

/// Removes the scene before its snapshots: without it they are orphans, which `scan` removes.
void StateStore::remove_locked(const std::string& name) {
  const auto scene = scenes_.find(name);
  if (scene == scenes_.end()) return;
  unlinkat(directory_, scene_file(name).c_str(), 0);
  bytes_ -= scene->second.bytes;
  while (!scene->second.generations.empty()) {
    remove_generation(name, scene->second, scene->second.generations.begin()->first);
  }
  scenes_.erase(scene);
  fsync(directory_);
}

void StateStore::remove_generation(const std::string& name, Scene& scene, std::uint64_t generation) {
  unlinkat(directory_, snapshot_file(name, generation).c_str(), 0);
  bytes_ -= scene.generations.at(generation);
  scene.generations.erase(generation);
}

/// Keeps a file in `aside`. Without a place there the caller removes it.
void StateStore::move_aside(const std::string& file, const std::string& to, std::uint64_t bytes) {
  if (aside_ < 0) {
    mkdirat(directory_, kAside, 0700);
    aside_ = openat(directory_, kAside, O_RDONLY | O_DIRECTORY | O_CLOEXEC | O_NOFOLLOW);
  }
  if (aside_ < 0 || renameat(directory_, file.c_str(), aside_, to.c_str()) != 0) return;
  bytes_ += bytes;
  bytes_ -= std::exchange(aside_bytes_[to], bytes);
}

void StateStore::move_to_aside(const std::string& name, std::uint64_t generation) {
  const std::lock_guard lock(mutex_);
  const auto scene = scenes_.find(name);
  if (scene == scenes_.end() || !scene->second.generations.contains(generation)) return;
  move_aside(snapshot_file(name, generation), name + std::string(kSnapshotEnd),
             scene->second.generations.at(generation));
  remove_generation(name, scene->second, generation);
}

void StateStore::move_to_aside(const std::string& name) {
  const std::lock_guard lock(mutex_);
  const auto scene = scenes_.find(name);
  if (scene == scenes_.end()) return;
  if (const auto& generations = scene->second.generations; !generations.empty()) {
    move_aside(snapshot_file(name, generations.rbegin()->first), name + std::string(kSnapshotEnd),
               generations.rbegin()->second);
  }
  move_aside(scene_file(name), scene_file(name), scene->second.bytes);
  remove_locked(name);
}

}  // namespace tensormass::daemon
