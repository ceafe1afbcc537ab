#include "access/key_ring.h"

#include <sys/stat.h>

#include <algorithm>
#include <chrono>
#include <ctime>
#include <exception>
#include <new>
#include <utility>

#include <fmt/format.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/x509.h>
#include <nlohmann/json.hpp>

#include "access/openssl_pointers.h"
#include "core/log.h"
#include "core/secret_file.h"
#include "core/thread_name.h"

namespace tensormass::access {
namespace {

/// Time between two looks at the list of clients. A removed client must be cut within 5 s.
constexpr std::chrono::milliseconds kPeriod{500};

std::int64_t now_s() { return static_cast<std::int64_t>(std::time(nullptr)); }

/// Returns a hash of a file's inode, size and times. A write, a replacement, another mode or owner changes it. 0: the
/// file does not exist.
std::uint64_t signature_of(const std::string& path) {
  struct stat found {};
  if (stat(path.c_str(), &found) != 0) return 0;
  std::uint64_t hash = 1469598103934665603u;
  for (const auto part :
       {static_cast<std::uint64_t>(found.st_ino), static_cast<std::uint64_t>(found.st_size),
        static_cast<std::uint64_t>(found.st_mtim.tv_sec), static_cast<std::uint64_t>(found.st_mtim.tv_nsec),
        static_cast<std::uint64_t>(found.st_ctim.tv_sec), static_cast<std::uint64_t>(found.st_ctim.tv_nsec)}) {
    hash = (hash ^ part) * 1099511628211u;
  }
  return hash | 1;
}

/// Refuses a certificate that cannot be read or does not hold now.
Result<void> check_certificate(const std::string& pem, const std::string& path, std::string_view renew) {
  const Certificate certificate(PEM_read_bio_X509(read_text(pem).get(), nullptr, nullptr, nullptr));
  if (!certificate) return invalid(fmt::format("--keys: {}: the certificate is damaged; {}", path, renew));
  if (X509_cmp_current_time(X509_get0_notAfter(certificate.get())) < 0) {
    return invalid(fmt::format("--keys: {}: the daemon's certificate has expired; {}", path, renew));
  }
  if (X509_cmp_current_time(X509_get0_notBefore(certificate.get())) > 0) {
    return invalid(
        fmt::format("--keys: {}: the daemon's certificate is not valid yet; set this machine's clock", path));
  }
  return {};
}

/// Refuses a private key that cannot be read or is of another certificate.
Result<void> check_private_key(const DaemonKeys& daemon, const std::string& path, std::string_view renew) {
  const Certificate own(PEM_read_bio_X509(read_text(daemon.certificate_pem).get(), nullptr, nullptr, nullptr));
  const PrivateKey key(PEM_read_bio_PrivateKey(read_text(daemon.private_key_pem).get(), nullptr, nullptr, nullptr));
  const bool fits = own && key && X509_check_private_key(own.get(), key.get()) == 1;
  ERR_clear_error();
  if (fits) return {};
  return invalid(fmt::format("--keys: {}: the private key is damaged or of another certificate; {}", path, renew));
}

}  // namespace

Result<std::unique_ptr<KeyRing>> KeyRing::open(const std::string& folder) {
  const std::string init = fmt::format("make keys with: tensormass keys init {}", folder);
  const std::string renew = fmt::format("renew it with: tensormass keys renew {}", folder);
  const std::string own = folder + "/daemon.json", others = folder + "/clients.json";
  TM_ASSIGN_OR_RETURN(text, read_file_of_owner(own, S_IRWXO, "--keys: ", init));
  const nlohmann::json file = nlohmann::json::parse(text, nullptr, false);
  if (!file.is_object() || !file.contains("tensormass") || file["tensormass"] != "daemon keys") {
    return invalid(fmt::format("--keys: {} does not hold a daemon's keys; {}", own, init));
  }
  DaemonKeys daemon;
  for (auto [field, value] :
       std::vector<std::pair<const char*, std::string*>>{{"certificate", &daemon.certificate_pem},
                                                         {"private_key", &daemon.private_key_pem},
                                                         {"authority", &daemon.authority_pem},
                                                         {"curve_public", &daemon.curve_public},
                                                         {"curve_secret", &daemon.curve_secret}}) {
    if (!file.contains(field) || !file[field].is_string()) {
      return invalid(fmt::format("--keys: {} lacks {}; {}", own, field, init));
    }
    *value = file[field].get<std::string>();
  }
  for (const char* field : {"curve_public", "curve_secret"}) {
    if (!is_curve_key(file[field].get<std::string>())) {
      return invalid(fmt::format("--keys: {}: {} is not a key of ZeroMQ, {} characters of Z85; {}", own, field,
                                 kCurveCharacters, init));
    }
  }
  TM_RETURN_IF_ERROR(check_certificate(daemon.certificate_pem, own, renew));
  TM_RETURN_IF_ERROR(check_certificate(daemon.authority_pem, own, init));
  TM_RETURN_IF_ERROR(check_private_key(daemon, own, renew));
  const std::uint64_t seen = signature_of(others);
  TM_ASSIGN_OR_RETURN(list, read_file_of_owner(others, S_IWOTH, "--keys: ", init));
  TM_ASSIGN_OR_RETURN(clients, read_client_list(list, others));
  return std::unique_ptr<KeyRing>(new KeyRing(folder, std::move(daemon), std::move(clients), seen));
}

KeyRing::KeyRing(std::string folder, DaemonKeys daemon, ClientList clients, std::uint64_t seen)
    : folder_(std::move(folder)), daemon_(std::move(daemon)), clients_(std::move(clients)), seen_(seen) {}

KeyRing::~KeyRing() { stop(); }

void KeyRing::stop() {
  if (!thread_.joinable()) return;
  {
    const std::lock_guard lock(mutex_);
    stopping_ = true;
  }
  wake_.notify_one();
  thread_.join();
}

ClientPtr KeyRing::find(std::string_view id) const {
  const std::lock_guard lock(mutex_);
  const auto found = clients_.find(id);
  return found != clients_.end() && now_s() < found->second->expires_s ? found->second : nullptr;
}

ClientPtr KeyRing::find_curve(std::string_view curve_public) const {
  const std::lock_guard lock(mutex_);
  for (const auto& [id, client] : clients_) {
    if (client->curve_public == curve_public) return now_s() < client->expires_s ? client : nullptr;
  }
  return nullptr;
}

std::vector<ClientPtr> KeyRing::list() const {
  const std::lock_guard lock(mutex_);
  std::vector<ClientPtr> out;
  for (const auto& [id, client] : clients_) {
    if (now_s() < client->expires_s) out.push_back(client);
  }
  return out;
}

void KeyRing::follow(std::function<bool()> on_change) {
  thread_ = std::thread([this, changed = std::move(on_change)] { run(changed); });
}

void KeyRing::run(const std::function<bool()>& on_change) {
  name_thread("key ring");
  const auto same = [](const std::vector<ClientPtr>& a, const std::vector<ClientPtr>& b) {
    return std::equal(a.begin(), a.end(), b.begin(), b.end(),
                      [](const ClientPtr& one, const ClientPtr& other) { return *one == *other; });
  };
  std::vector<ClientPtr> before = list();
  bool done = true;  // on_change has taken what counts
  while (true) {
    {
      std::unique_lock lock(mutex_);
      if (wake_.wait_for(lock, kPeriod, [this] { return stopping_; })) return;
    }
    try {
      read_again();
      std::vector<ClientPtr> now = list();
      if (!same(before, now)) {
        log::info("other keys count", {{"before", before.size()}, {"now", now.size()}});
        before = std::move(now);
        done = false;
      }
      if (!done) done = on_change();
    } catch (const std::bad_alloc&) {
      // Tried again in the next period, and not logged: a line needs memory, too.
    } catch (const std::exception& error) {
      log::error("the change of keys is tried again", {{"reason", error.what()}});
    }
  }
}

void KeyRing::read_again() {
  const std::string path = folder_ + "/clients.json";
  // Before the read: what is written during the read is seen the next time.
  const std::uint64_t signature = signature_of(path);
  if (signature == seen_) return told_.reset();
  const auto say = [&](const Error& error) {
    if (std::exchange(told_, signature) == signature) return;
    log::error("the list of clients cannot be read", {{"reason", error.message}});
  };
  const auto text = read_file_of_owner(path, S_IWOTH, "--keys: ", "the list before counts on");
  if (!text) return say(text.error());  // it is read again in each period
  seen_ = signature;
  log::debug("the list of clients was read");
  auto clients = read_client_list(*text, path);
  if (!clients) return say(clients.error());
  told_.reset();
  const std::lock_guard lock(mutex_);
  clients_ = std::move(*clients);
}

}  // namespace tensormass::access
