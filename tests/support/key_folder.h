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
#include <openssl/ssl.h>
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
  const std::string& certificate() const { return certificate_; }
  const std::string& private_key() const { return private_key_; }
  void write_daemon(const std::string& curve_public, const std::string& curve_secret) const {
    using log::json_quoted;
    write("daemon.json",
          fmt::format(R"({{"tensormass": "daemon keys", "certificate": {}, "private_key": {}, "authority": {}, )"
                      R"("curve_public": {}, "curve_secret": {}}})",
                      json_quoted(certificate_), json_quoted(private_key_), json_quoted(certificate_),
                      json_quoted(curve_public), json_quoted(curve_secret)));
  }
  /// Makes a client of TLS use the daemon's own certificate, which is an authority of itself.
  void use_in(SSL_CTX* context) const {
    const std::unique_ptr<BIO, decltype(&BIO_free)> pem(BIO_new_mem_buf(certificate_.data(), -1), &BIO_free);
    const std::unique_ptr<X509, decltype(&X509_free)> certificate(
        PEM_read_bio_X509(pem.get(), nullptr, nullptr, nullptr), &X509_free);
    SSL_CTX_use_certificate(context, certificate.get());
    SSL_CTX_use_PrivateKey(context, key_.get());
  }
  void write(const std::string& name, const std::string& text) const {
    std::ofstream(path_ / name) << text;
    std::filesystem::permissions(path_ / name,
                                 std::filesystem::perms::owner_read | std::filesystem::perms::owner_write);
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

  /// The name in the certificate.
  static constexpr const char* kName = "tensormassd";
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
    const std::unique_ptr<X509, decltype(&X509_free)> made(X509_new(), &X509_free);
    X509_set_version(made.get(), X509_VERSION_3);
    ASN1_INTEGER_set(X509_get_serialNumber(made.get()), 1);
    X509_gmtime_adj(X509_getm_notBefore(made.get()), -3600);
    X509_gmtime_adj(X509_getm_notAfter(made.get()), 3600);
    X509_NAME* const name = X509_get_subject_name(made.get());
    X509_NAME_add_entry_by_txt(name, "CN", MBSTRING_ASC, reinterpret_cast<const unsigned char*>(kName), -1, -1, 0);
    X509_set_issuer_name(made.get(), name);
    X509_set_pubkey(made.get(), key_.get());
    if (X509_sign(made.get(), key_.get(), EVP_sha256()) == 0) throw std::runtime_error("OpenSSL signs nothing");
    certificate_ = pem_of([&](BIO* bio) { return PEM_write_bio_X509(bio, made.get()); });
    private_key_ = pem_of(
        [&](BIO* bio) { return PEM_write_bio_PrivateKey(bio, key_.get(), nullptr, nullptr, 0, nullptr, nullptr); });
  }

  std::filesystem::path path_;
  const std::unique_ptr<EVP_PKEY, decltype(&EVP_PKEY_free)> key_{EVP_EC_gen("P-256"), &EVP_PKEY_free};
  std::string certificate_, private_key_;
};

}  // namespace tensormass::tests
