#include "control/tls.h"

#include <algorithm>
#include <array>
#include <cerrno>
#include <climits>
#include <utility>

#include <fmt/format.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/ssl.h>
#include <openssl/x509.h>

#include "access/openssl_pointers.h"

namespace tensormass::control {
namespace {

using access::Certificate;
using access::read_text;

/// HTTP/2, the only protocol that gRPC speaks, as ALPN writes it.
constexpr std::array<unsigned char, 3> kHttp2{2, 'h', '2'};

int select_http2(SSL*, const unsigned char** out, unsigned char* size, const unsigned char* offered,
                 unsigned int offered_size, void*) {
  unsigned char* selected = nullptr;
  const int found = SSL_select_next_proto(&selected, size, kHttp2.data(), kHttp2.size(), offered, offered_size);
  *out = selected;
  return found == OPENSSL_NPN_NEGOTIATED ? SSL_TLSEXT_ERR_OK : SSL_TLSEXT_ERR_ALERT_FATAL;
}

std::string last_error() {
  const unsigned long code = ERR_peek_last_error();
  const char* reason = ERR_reason_error_string(code);
  ERR_clear_error();
  return reason != nullptr ? reason : "the connection ended";
}

tl::unexpected<Error> refused(const char* what) {
  return invalid(
      fmt::format("--keys: OpenSSL does not take {} of daemon.json: {}; make it anew with `tensormass keys "
                  "renew`",
                  what, last_error()));
}

}  // namespace

void TlsContext::Free::operator()(ssl_ctx_st* context) const { SSL_CTX_free(context); }
void TlsStream::Free::operator()(ssl_st* stream) const { SSL_free(stream); }

Result<std::unique_ptr<TlsContext>> TlsContext::make(const std::string& certificate, const std::string& private_key,
                                                     const std::string& authority) {
  std::unique_ptr<SSL_CTX, Free> context(SSL_CTX_new(TLS_server_method()));
  if (!context) return refused("the keys");
  SSL_CTX_set_min_proto_version(context.get(), TLS1_3_VERSION);
  const Certificate own(PEM_read_bio_X509(read_text(certificate).get(), nullptr, nullptr, nullptr));
  const access::PrivateKey key(PEM_read_bio_PrivateKey(read_text(private_key).get(), nullptr, nullptr, nullptr));
  const Certificate signer(PEM_read_bio_X509(read_text(authority).get(), nullptr, nullptr, nullptr));
  if (!own || SSL_CTX_use_certificate(context.get(), own.get()) != 1) return refused("the certificate");
  if (!key || SSL_CTX_use_PrivateKey(context.get(), key.get()) != 1) return refused("the private key");
  if (!signer || X509_STORE_add_cert(SSL_CTX_get_cert_store(context.get()), signer.get()) != 1) {
    return refused("the authority");
  }
  SSL_CTX_set_verify(context.get(), SSL_VERIFY_PEER | SSL_VERIFY_FAIL_IF_NO_PEER_CERT, nullptr);
  SSL_CTX_set_alpn_select_cb(context.get(), select_http2, nullptr);
  SSL_CTX_set_mode(context.get(), SSL_MODE_ENABLE_PARTIAL_WRITE | SSL_MODE_ACCEPT_MOVING_WRITE_BUFFER);
  // Each connection shows its certificate. A ticket would let a client in whose key was removed since.
  SSL_CTX_set_session_cache_mode(context.get(), SSL_SESS_CACHE_OFF);
  SSL_CTX_set_num_tickets(context.get(), 0);
  SSL_CTX_set_options(context.get(), SSL_OP_NO_TICKET);
  return std::unique_ptr<TlsContext>(new TlsContext(std::move(context)));
}

TlsStream::TlsStream(const TlsContext& context, int socket) : stream_(SSL_new(context.get())) {
  if (!stream_ || SSL_set_fd(stream_.get(), socket) != 1) throw std::bad_alloc();
  SSL_set_accept_state(stream_.get());
}

TlsStream::Handshake TlsStream::shake_hands() {
  ERR_clear_error();
  const int code = SSL_do_handshake(stream_.get());
  if (code == 1) return Handshake::kDone;
  const int error = SSL_get_error(stream_.get(), code);
  waits_to_write_ = error == SSL_ERROR_WANT_WRITE;
  if (error == SSL_ERROR_WANT_READ || error == SSL_ERROR_WANT_WRITE) return Handshake::kGoesOn;
  const long verified = SSL_get_verify_result(stream_.get());
  failure_ = verified != X509_V_OK ? X509_verify_cert_error_string(verified) : last_error();
  ERR_clear_error();
  return Handshake::kFailed;
}

std::string TlsStream::peer_name() const {
  const Certificate peer(SSL_get1_peer_certificate(stream_.get()));
  if (!peer) return {};
  std::array<char, 128> name{};
  const int size = X509_NAME_get_text_by_NID(X509_get_subject_name(peer.get()), NID_commonName, name.data(),
                                             static_cast<int>(name.size()));
  return size > 0 ? std::string(name.data(), static_cast<std::size_t>(size)) : std::string();
}

ssize_t TlsStream::result(int code) {
  waits_to_write_ = false;
  if (code > 0) return code;
  switch (SSL_get_error(stream_.get(), code)) {
    case SSL_ERROR_WANT_WRITE:
      waits_to_write_ = true;
      [[fallthrough]];
    case SSL_ERROR_WANT_READ:
      errno = EAGAIN;
      return -1;
    case SSL_ERROR_ZERO_RETURN:
      return 0;
    default:
      ERR_clear_error();
      errno = ECONNRESET;
      return -1;
  }
}

ssize_t TlsStream::read(char* bytes, std::size_t size) {
  ERR_clear_error();
  return result(SSL_read(stream_.get(), bytes, static_cast<int>(std::min<std::size_t>(size, INT_MAX))));
}

ssize_t TlsStream::write(const char* bytes, std::size_t size) {
  ERR_clear_error();
  return result(SSL_write(stream_.get(), bytes, static_cast<int>(std::min<std::size_t>(size, INT_MAX))));
}

void TlsStream::end() {
  ERR_clear_error();
  SSL_shutdown(stream_.get());
  ERR_clear_error();
}

}  // namespace tensormass::control
