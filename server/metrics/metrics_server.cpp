#include "metrics/metrics_server.h"

#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <exception>
#include <thread>
#include <utility>

#include <fmt/format.h>
#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/address.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/steady_timer.hpp>
#include <boost/beast/core/flat_buffer.hpp>
#include <boost/beast/core/tcp_stream.hpp>
#include <boost/beast/http.hpp>
#include <boost/beast/version.hpp>

#include "core/metrics_limits.h"
#include "core/thread_name.h"

namespace tensormass::metrics {
namespace {

namespace asio = boost::asio;
namespace beast = boost::beast;
namespace http = beast::http;
using Failure = boost::system::error_code;

/// Time without accepting after accept failed, as it does without descriptors.
constexpr std::chrono::milliseconds kAcceptPause{100};

struct Answers {
  std::function<std::string()> text;
  std::function<bool(std::string_view)> is_own;
  std::chrono::milliseconds time;
};

http::response<http::string_body> answer(const http::request<http::empty_body>& request, const Answers& answers) {
  http::response<http::string_body> response(http::status::ok, request.version());
  response.keep_alive(false);
  response.set(http::field::content_type, "text/plain; charset=utf-8");
  const auto refuse = [&](http::status status, const char* why) {
    response.result(status);
    response.body() = why;
  };
  const auto host = request[http::field::host];
  const auto target = request.target();
  if (!answers.is_own({host.data(), host.size()})) {
    refuse(http::status::forbidden, "the Host header does not name this machine; ask for 127.0.0.1\n");
  } else if (std::string_view(target.data(), target.size()) != "/metrics") {
    refuse(http::status::not_found, "there is /metrics alone\n");
  } else if (request.method() != http::verb::get) {
    refuse(http::status::method_not_allowed, "there is GET alone\n");
    response.set(http::field::allow, "GET");
  } else {
    response.set(http::field::content_type, "text/plain; version=0.0.4; charset=utf-8");
    response.body() = answers.text();
  }
  response.prepare_payload();
  return response;
}

/// One connection. Its handlers share it, so it ends when none of them waits.
class Session : public std::enable_shared_from_this<Session> {
 public:
  Session(asio::ip::tcp::socket socket, const Answers& answers)
      : stream_(std::move(socket)), buffer_(limits::kMaxMetricsHeaderBytes), answers_(answers) {
    parser_.header_limit(limits::kMaxMetricsHeaderBytes);
  }

  void start() {
    stream_.expires_after(answers_.time);
    http::async_read_header(stream_, buffer_, parser_, [self = shared_from_this()](Failure failure, std::size_t) {
      if (!failure) self->send();
    });
  }
  void close() { stream_.close(); }

 private:
  void send() {
    response_ = answer(parser_.get(), answers_);
    stream_.expires_after(answers_.time);
    http::async_write(stream_, response_, [self = shared_from_this()](Failure, std::size_t) {
      Failure ignored;
      self->stream_.socket().shutdown(asio::ip::tcp::socket::shutdown_send, ignored);
    });
  }

  beast::tcp_stream stream_;
  beast::flat_buffer buffer_;
  http::request_parser<http::empty_body> parser_;
  http::response<http::string_body> response_;
  const Answers& answers_;
};

}  // namespace

struct MetricsServer::Parts {
  Answers answers;
  asio::io_context context{1};
  asio::ip::tcp::acceptor acceptor{context};
  asio::steady_timer pause{context};
  std::deque<std::weak_ptr<Session>> sessions{};  // oldest first; the thread's
  std::string endpoint{};
  std::thread thread{};

  void accept() {
    acceptor.async_accept([this](Failure failure, asio::ip::tcp::socket socket) {
      if (failure) {
        pause.expires_after(kAcceptPause);
        pause.async_wait([this](Failure) { accept(); });
        return;
      }
      accept();  // first, so that a failure below ends one connection alone
      take(std::move(socket));
    });
  }

  void take(asio::ip::tcp::socket socket) {
    std::erase_if(sessions, [](const std::weak_ptr<Session>& session) { return session.expired(); });
    if (sessions.size() >= limits::kMaxMetricsConnections) {
      if (const auto oldest = sessions.front().lock()) oldest->close();
      sessions.pop_front();
    }
    const auto session = std::make_shared<Session>(std::move(socket), answers);
    sessions.push_back(session);
    session->start();
  }

  void run() {
    name_thread("metrics");
    while (!context.stopped()) {
      try {
        context.run();
      } catch (const std::exception&) {
        // There is no memory for an answer. Its connection was closed; the others go on.
      }
    }
  }
};

Result<std::unique_ptr<MetricsServer>> MetricsServer::start(const std::string& address,
                                                            std::function<std::string()> text,
                                                            std::function<bool(std::string_view)> is_own,
                                                            std::chrono::milliseconds time) {
  const auto cannot_listen = [&](const std::string& why) {
    return fail(ErrorCode::kUnavailable,
                fmt::format("cannot listen on '{}' for --metrics: {}; give another HOST:PORT, or port 0 for a free one",
                            address, why));
  };
  const std::size_t colon = address.rfind(':');
  if (colon == std::string::npos) return cannot_listen("no port in it");
  std::string host = address.substr(0, colon);
  if (host == "localhost") host = "127.0.0.1";
  if (host.starts_with('[') && host.ends_with(']')) host = host.substr(1, host.size() - 2);
  Failure failure;
  const auto ip = asio::ip::make_address(host, failure);
  if (failure) return cannot_listen(failure.message());
  const auto port = static_cast<std::uint16_t>(std::strtoul(address.c_str() + colon + 1, nullptr, 10));
  std::unique_ptr<Parts> parts(new Parts{.answers = {std::move(text), std::move(is_own), time}});
  asio::ip::tcp::acceptor& acceptor = parts->acceptor;
  const asio::ip::tcp::endpoint wanted(ip, port);
  acceptor.open(wanted.protocol(), failure);
  if (!failure) acceptor.set_option(asio::socket_base::reuse_address(true), failure);
  if (!failure) acceptor.bind(wanted, failure);
  if (!failure) acceptor.listen(asio::socket_base::max_listen_connections, failure);
  if (failure) return cannot_listen(failure.message());
  parts->endpoint = fmt::format("{}:{}", address.substr(0, colon), acceptor.local_endpoint().port());
  parts->accept();
  parts->thread = std::thread([raw = parts.get()] { raw->run(); });
  return std::unique_ptr<MetricsServer>(new MetricsServer(std::move(parts)));
}

MetricsServer::MetricsServer(std::unique_ptr<Parts> parts) : parts_(std::move(parts)) {}

MetricsServer::~MetricsServer() {
  parts_->context.stop();
  parts_->thread.join();
}

const std::string& MetricsServer::endpoint() const { return parts_->endpoint; }

}  // namespace tensormass::metrics
