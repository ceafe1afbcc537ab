#pragma once

#include <chrono>
#include <memory>
#include <string>

#include <grpcpp/grpcpp.h>

namespace tensormass::tests {

/// Returns a channel to a server of this machine, connected within a minute, without bound of what it receives.
///
/// gRPC 1.51 may take a connection that is under way for one that failed (an errno of malloc), and a call then fails.
/// Waiting tries again.
inline std::shared_ptr<grpc::Channel> connected_channel(const std::string& endpoint) {
  grpc::ChannelArguments arguments;
  arguments.SetMaxReceiveMessageSize(-1);
  arguments.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, 0);
  const auto channel = grpc::CreateCustomChannel(endpoint, grpc::InsecureChannelCredentials(), arguments);
  channel->WaitForConnected(std::chrono::system_clock::now() + std::chrono::seconds(60));
  return channel;
}

}  // namespace tensormass::tests
