#pragma once

#include <stdlib.h>

#include <ctime>
#include <filesystem>
#include <fstream>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

#include <fmt/format.h>
#include <gtest/gtest.h>
#include <openssl/bio.h>
#include <openssl/evp.h>
#include <openssl/pem.h>
#include <openssl/x509.h>

#include "core/log.h"

namespace tensormass::tests {

/// A folder of keys, as `tensormass keys` makes it, whose daemon has signed for itself. The destructor removes it.
class KeyFolder {
 public:
  explicit KeyFolder(const std::string& clients) {
    std::string name = testing::TempDir() + "keys.XXXXXX";
    if (mkdtemp(name.data()) == nullptr) throw std::runtime_error("no temporary folder");
    path_ = name;
    make_certificate();
    write_daemon(kCurve, kCurve);
    write("clients.json", list_of(clients));
  }
  ~KeyFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }

  const std::filesystem::path& path() const { return path_; }
  void write_daemon(const std::string& curve_public, const std::string& curve_secret) const {
    using log::json_quoted;
    write("daemon.json",
          fmt::format(R"({{"tensormass": "daemon keys", "certificate": {}, "private_key": {}, "authority": {}, )"
                      R"("curve_public": {}, "curve_secret": {}}})",
                      json_quoted(certificate_), json_quoted(private_key_), json_quoted(certificate_),
                      json_quoted(curve_public), json_quoted(curve_secret)));
  }
  void write(const std::string& name, const std::string& text) const {
    std::ofstream(path_ / name) << text;
    std::filesystem::permissions(path_ / name, std::filesystem::perms::owner_read | std::filesystem::perms::owner_write);
  }
  /// In one step, without a descriptor.
  void rename(const std::string& from, const std::string& to) const {
    std::filesystem::rename(path_ / from, path_ / to);
  }

  static std::string list_of(const std::string& clients) {
    return R"({"tensormass": "client list", "clients": [)" + clients + "]}";
  }
  static std::string client(const std::string& id, const std::string& role = "viewer", std::time_t valid_for_s = 3600) {
    return fmt::format(R"({{"id": "{}", "role": "{}", "curve_public": "{}", "expires_s": {}}})", id, role, kCurve,
                       std::time(nullptr) + valid_for_s);
  }

  /// Any key of ZeroMQ, as Z85.
  static inline const std::string kCurve = "rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7";

 private:
  template <class T>
  static std::string pem_of(const T& write_to) {
    const std::unique_ptr<BIO, decltype(&BIO_free)> bio(BIO_new(BIO_s_mem()), &BIO_free);
    if (write_to(bio.get()) != 1) throw std::runtime_error("OpenSSL writes no PEM");
    char* text = nullptr;
    const long size = BIO_get_mem_data(bio.get(), &text);
    return {text, static_cast<std::size_t>(size)};
  }
  void make_certificate() {
    const std::unique_ptr<EVP_PKEY, decltype(&EVP_PKEY_free)> key(EVP_EC_gen("P-256"), &EVP_PKEY_free);
    const std::unique_ptr<X509, decltype(&X509_free)> made(X509_new(), &X509_free);
    X509_set_version(made.get(), X509_VERSION_3);
    ASN1_INTEGER_set(X509_get_serialNumber(made.get()), 1);
    X509_gmtime_adj(X509_getm_notBefore(made.get()), -3600);
    X509_gmtime_adj(X509_getm_notAfter(made.get()), 3600);
    X509_set_pubkey(made.get(), key.get());
    if (X509_sign(made.get(), key.get(), EVP_sha256()) == 0) throw std::runtime_error("OpenSSL signs nothing");
    certificate_ = pem_of([&](BIO* bio) { return PEM_write_bio_X509(bio, made.get()); });
    private_key_ = pem_of([&](BIO* bio) {
      return PEM_write_bio_PrivateKey(bio, key.get(), nullptr, nullptr, 0, nullptr, nullptr);
    });
  }

  std::filesystem::path path_;
  std::string certificate_, private_key_;
};

}  // namespace tensormass::tests
