#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <string>
#include <string_view>

#include "core/metrics_limits.h"
#include "core/result.h"

namespace tensormass::metrics {

/// Answers Prometheus over HTTP: GET /metrics, one request a connection, on a thread of its own.
///
///     scraper ── connect ──> at most kMaxMetricsConnections ── headers, kMaxMetricsHeaderBytes in kMaxMetricsTime
///             <── 200 and the text, 403, 404 or 405 in kMaxMetricsTime, then closed ───────────┘
///
/// Nobody is asked who it is, so the address must be of this machine alone.
class MetricsServer {
 public:
  /// Listens on `address`, HOST:PORT with a literal address or localhost; port 0 takes a free one.
  /// Fails with kUnavailable if it cannot be listened on.
  ///
  ///   text()         returns what is answered; called on the server's thread for each scrape
  ///   is_own(host)   whether a Host header names this machine. A page in a browser may let its name lead here (DNS
  ///                  rebinding), and would read what is answered
  ///   time           as limits::kMaxMetricsTime
  static Result<std::unique_ptr<MetricsServer>> start(const std::string& address, std::function<std::string()> text,
                                                      std::function<bool(std::string_view host)> is_own,
                                                      std::chrono::milliseconds time = limits::kMaxMetricsTime);
  /// Closes all connections and joins the thread.
  ~MetricsServer();

  /// HOST:PORT to scrape, with the port that was chosen.
  const std::string& endpoint() const;

 private:
  struct Parts;  // Boost's classes, whose headers take seconds to compile
  explicit MetricsServer(std::unique_ptr<Parts> parts);

  std::unique_ptr<Parts> parts_;
};

}  // namespace tensormass::metrics
