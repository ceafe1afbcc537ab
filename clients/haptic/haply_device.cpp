#include "haptic/haply_device.h"

#include <pthread.h>
#include <signal.h>

#include <chrono>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <optional>
#include <thread>
#include <utility>  // Boost 1.74 uses std::exchange without it

#include <spdlog/fmt/fmt.h>
#include <boost/asio/awaitable.hpp>
#include <boost/asio/buffer.hpp>
#include <boost/asio/co_spawn.hpp>
#include <boost/asio/executor_work_guard.hpp>
#include <boost/asio/io_context.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/asio/post.hpp>
#include <boost/asio/redirect_error.hpp>
#include <boost/asio/steady_timer.hpp>
#include <boost/asio/use_awaitable.hpp>
#include <boost/beast/core/flat_buffer.hpp>
#include <boost/beast/core/tcp_stream.hpp>
#include <boost/beast/websocket.hpp>

#include "haptic/checks.h"
#include "haptic/power_switch.h"
#include "haptic/realtime.h"

namespace tensormass::haptic {
namespace {

namespace asio = boost::asio;
namespace beast = boost::beast;
namespace websocket = boost::beast::websocket;
using asio::ip::tcp;
using std::chrono::steady_clock;

constexpr auto kExchangePeriod = std::chrono::microseconds(500);
constexpr auto kPoll = std::chrono::milliseconds(1);
constexpr const char* kScheme = "ws://";
constexpr const char* kDefaultPort = "10001";

steady_clock::duration seconds(double s) {
  return std::chrono::duration_cast<steady_clock::duration>(std::chrono::duration<double>(s));
}

std::string_view text_of(const beast::flat_buffer& buffer) {
  return {static_cast<const char*>(buffer.data().data()), buffer.size()};
}

}  // namespace

Result<HaplyAddress> parse_haply_url(const std::string& url) {
  const auto wrong = [&] {
    return invalid(fmt::format("{} is not of the form ws://host:port, such as ws://127.0.0.1:10001", url));
  };
  if (!url.starts_with(kScheme)) return wrong();
  const std::string rest = url.substr(std::string_view(kScheme).size());
  const std::string authority = rest.substr(0, rest.find('/'));
  HaplyAddress address{authority, kDefaultPort, authority.size() < rest.size() ? rest.substr(authority.size()) : "/"};
  // The colons of an IPv6 address stand in brackets.
  const std::size_t bracket = authority.rfind(']');
  const std::size_t colon = authority.rfind(':');
  if (colon != std::string::npos && (bracket == std::string::npos || colon > bracket)) {
    address.host = authority.substr(0, colon);
    address.port = authority.substr(colon + 1);
  }
  if (address.host.starts_with('[') && address.host.ends_with(']')) {
    address.host = address.host.substr(1, address.host.size() - 2);
  }
  const bool is_number = !address.port.empty() && address.port.size() <= 5 &&
                         address.port.find_first_not_of("0123456789") == std::string::npos;
  if (address.host.empty() || !is_number || std::stoi(address.port) > 65535) return wrong();
  if (url.find_first_of(" \t\r\n") != std::string::npos) return wrong();
  return address;
}

/// One connection and its thread. All of Beast runs on that thread; the mutex guards what the loop shares with it.
class HaplyDevice::Session {
 public:
  Session(const std::string& url, const HaplyAddress& address, const HaplyChoice& choice)
      : url_(url), address_(address), choice_(choice) {
    asio::co_spawn(io_, run(), [this](std::exception_ptr thrown) {
      if (thrown) publish({ErrorCode::kUnavailable, "Haply Inverse service at " + url_ + ": out of memory"});
    });
    thread_ = std::thread([this] {
      // Signals belong to the program's own threads.
      sigset_t signals;
      sigfillset(&signals);
      pthread_sigmask(SIG_BLOCK, &signals, nullptr);
      static_cast<void>(request_realtime(kLinkPriority));
      io_.run();
    });
  }

  /// Sends a zero force if the connection still stands, then ends the thread.
  ~Session() {
    asio::post(io_, [this] {
      closing_ = true;
      pace_.cancel();
      deadline_.expires_after(seconds(kHaplyCloseTimeoutS));
      deadline_.async_wait([this](boost::system::error_code) { io_.stop(); });
      asio::co_spawn(io_, say_goodbye(), [this](std::exception_ptr) { io_.stop(); });
    });
    thread_.join();
  }
  Session(const Session&) = delete;
  Session& operator=(const Session&) = delete;

  /// Waits for the first state. Returns the chosen devices.
  Result<HaplyDevices> wait_until_ready() {
    std::unique_lock lock(mutex_);
    changed_.wait_for(lock, seconds(kHaplyOpenTimeoutS), [this] { return error_ || pose_; });
    if (error_) return tl::make_unexpected(*error_);
    if (pose_) return *devices_;
    return fail(ErrorCode::kUnavailable,
                fmt::format("Haply Inverse service at {}: did not {} within {:g} s; restart the service, or correct "
                            "--device-url",
                            url_, awaited_, kHaplyOpenTimeoutS));
  }

  /// The newest pose, in the device's frame.
  Result<DevicePose> newest() const {
    const std::scoped_lock lock(mutex_);
    if (error_) return tl::make_unexpected(*error_);
    if (steady_clock::now() - arrival_ <= seconds(kMaxHaplySilenceS)) return *pose_;
    return fail(ErrorCode::kUnavailable,
                fmt::format("Haply Inverse3 {} at {}: the Inverse service has sent no state for {:g} s; restart the "
                            "service and check that the machine is not overloaded",
                            shown_haply_id(devices_->inverse_id), url_, kMaxHaplySilenceS));
  }

  /// Sets the force of the next message, in the device's frame.
  Result<void> set_force(const Eigen::Vector3d& force_n) {
    const std::scoped_lock lock(mutex_);
    force_n_ = force_n;
    if (error_) return tl::make_unexpected(*error_);
    return {};
  }

 private:
  /// The whole session. After an error the force is taken off at once, because the loop may be the one that stalls.
  asio::awaitable<void> run() {
    const Result<void> done = co_await converse();
    if (!done) publish(done.error());
    co_await say_goodbye();
  }

  /// Opens the connection, then exchanges forces and states until an error or the end. No pose may be a local variable
  /// here: GCC 12 aligns a coroutine's frame to 16 bytes, and Eigen reads a quaternion with instructions that need 32.
  asio::awaitable<Result<void>> converse() {
    boost::system::error_code error;
    auto token = asio::redirect_error(asio::use_awaitable, error);
    tcp::resolver resolver(io_);
    const auto endpoints = co_await resolver.async_resolve(address_.host, address_.port, token);
    if (!error) co_await beast::get_lowest_layer(socket_).async_connect(endpoints, token);
    if (error) {
      co_return fail(ErrorCode::kUnavailable,
                     fmt::format("no Haply Inverse service at {}: {}; start it (Haply Hub, or systemctl start "
                                 "haply-inverse-service), or correct --device-url",
                                 url_, error.message()));
    }
    beast::get_lowest_layer(socket_).socket().set_option(tcp::no_delay(true), error);
    await("answer the WebSocket handshake");
    socket_.read_message_max(kMaxHaplyMessageBytes);
    const bool is_ipv6 = address_.host.find(':') != std::string::npos;
    const std::string host = is_ipv6 ? "[" + address_.host + "]" : address_.host;
    co_await socket_.async_handshake(host + ":" + address_.port, address_.path, token);
    if (error) {
      co_return fail(ErrorCode::kUnavailable, fmt::format("no Haply Inverse service at {}: it does not speak WebSocket "
                                                          "({}); correct --device-url",
                                                          url_, error.message()));
    }
    await("send the list of its devices");
    beast::flat_buffer buffer;
    co_await socket_.async_read(buffer, token);
    if (error) co_return lost(error);
    if (const Result<void> taken = take_snapshot(text_of(buffer)); !taken) co_return taken;

    while (!closing_) {
      const auto start = steady_clock::now();
      const std::string command = force_command();
      writing_ = true;
      co_await socket_.async_write(asio::buffer(command), token);
      writing_ = false;
      if (error) co_return lost(error);
      buffer.clear();
      co_await socket_.async_read(buffer, token);
      if (closing_) break;
      if (error) co_return lost(error);
      if (const Result<void> taken = take_state(text_of(buffer)); !taken) co_return taken;
      pace_.expires_at(start + kExchangePeriod);
      co_await pace_.async_wait(token);
    }
    co_return Result<void>();
  }

  /// Sends zero force and closes, also if the service owes a state: Beast allows a write and a close beside a pending
  /// read. A second call waits for the first.
  asio::awaitable<void> say_goodbye() {
    boost::system::error_code error;
    auto token = asio::redirect_error(asio::use_awaitable, error);
    asio::steady_timer poll(io_);
    const bool is_first = !std::exchange(leaving_, true);
    while (is_first ? writing_ : !left_) {
      poll.expires_after(kPoll);
      co_await poll.async_wait(token);
    }
    if (is_first && socket_.is_open()) {
      if (devices_) {
        const std::string command = haply_force_command(*devices_, Eigen::Vector3d::Zero());
        co_await socket_.async_write(asio::buffer(command), token);
      }
      co_await socket_.async_close(websocket::close_code::normal, token);
    }
    left_ = true;
  }

  tl::unexpected<Error> lost(const boost::system::error_code& error) {
    if (error == websocket::error::message_too_big) {
      return fail(ErrorCode::kUnavailable,
                  fmt::format("Haply Inverse service at {}: a message is larger than {} bytes; check that --device-url "
                              "leads to the Inverse service",
                              url_, kMaxHaplyMessageBytes));
    }
    const std::string who = devices_
                                ? fmt::format("Haply Inverse3 {} at {}", shown_haply_id(devices_->inverse_id), url_)
                                : fmt::format("Haply Inverse service at {}", url_);
    return fail(ErrorCode::kUnavailable, fmt::format("{}: the service has closed the connection ({}); restart it and "
                                                     "see its log",
                                                     who, error.message()));
  }

  /// Says what the service has to do next, for the message of wait_until_ready().
  void await(const char* what) {
    const std::scoped_lock lock(mutex_);
    awaited_ = what;
  }
  Result<void> take_snapshot(std::string_view message) {
    TM_ASSIGN_OR_RETURN(devices, parse_haply_snapshot(message, choice_));
    const std::scoped_lock lock(mutex_);
    devices_ = devices;
    awaited_ = "answer the first force";
    return {};
  }
  Result<void> take_state(std::string_view message) {
    TM_ASSIGN_OR_RETURN(pose, parse_haply_state(message, *devices_));
    {
      const std::scoped_lock lock(mutex_);
      pose_ = pose;
      arrival_ = steady_clock::now();
    }
    changed_.notify_all();
    return {};
  }
  void publish(const Error& error) {
    {
      const std::scoped_lock lock(mutex_);
      error_ = error;
    }
    changed_.notify_all();
  }
  std::string force_command() const {
    const std::scoped_lock lock(mutex_);
    return haply_force_command(*devices_, force_n_);
  }

  const std::string url_;
  const HaplyAddress address_;
  const HaplyChoice choice_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  /// Written once by the I/O thread, before the first pose.
  std::optional<HaplyDevices> devices_;
  std::optional<DevicePose> pose_;
  steady_clock::time_point arrival_;
  std::optional<Error> error_;
  Eigen::Vector3d force_n_ = Eigen::Vector3d::Zero();
  const char* awaited_ = "accept a connection";

  // Used by the I/O thread only.
  asio::io_context io_{1};
  asio::executor_work_guard<asio::io_context::executor_type> work_{io_.get_executor()};
  websocket::stream<beast::tcp_stream> socket_{io_};
  asio::steady_timer pace_{io_};
  asio::steady_timer deadline_{io_};
  bool writing_ = false;
  bool closing_ = false;
  bool leaving_ = false;
  bool left_ = false;
  std::thread thread_;
};

HaplyDevice::HaplyDevice(HaplyOptions options) : options_(std::move(options)), info_(kInverse3Limits) {}

HaplyDevice::~HaplyDevice() { close(); }

Result<void> HaplyDevice::open() {
  close();
  TM_ASSIGN_OR_RETURN(address, parse_haply_url(options_.url));
  TM_RETURN_IF_ERROR(check(options_.workspace, "Haply Inverse3"));
  TM_RETURN_IF_ERROR(check_power_button(options_.choice.power_button, kHaplyButtons, "Haply Inverse3"));
  session_ = std::make_unique<Session>(options_.url, address, options_.choice);
  const Result<HaplyDevices> devices = session_->wait_until_ready();
  const Result<DevicePose> first = devices ? session_->newest() : tl::make_unexpected(devices.error());
  if (!first) {
    close();
    return tl::make_unexpected(first.error());
  }
  map_ = map_from(first->position_m, options_.workspace);
  info_ = map_.to_scene(kInverse3Limits);
  info_.name += " " + shown_haply_id(devices->inverse_id);
  return {};
}

Result<DevicePose> HaplyDevice::read() {
  if (session_ == nullptr) return fail(ErrorCode::kFailedPrecondition, "Haply Inverse3: read before open");
  TM_ASSIGN_OR_RETURN(pose, session_->newest());
  return map_.to_scene(pose);
}

Result<void> HaplyDevice::write_force(const Eigen::Vector3d& force_n) {
  if (session_ == nullptr) return fail(ErrorCode::kFailedPrecondition, "Haply Inverse3: write before open");
  if (!force_n.allFinite()) return invalid("Haply Inverse3: the force is not finite");
  return session_->set_force(map_.force_to_device(force_n));
}

void HaplyDevice::close() noexcept { session_.reset(); }

}  // namespace tensormass::haptic
