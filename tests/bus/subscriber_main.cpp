// Subscribes to a key over both transports. Writes one byte to stdout when a message has arrived over each, then keeps
// reading until it is killed.
// Usage: bus_subscriber ZEROMQ_ENDPOINT ZENOH_LOCATOR KEY
#include <unistd.h>

#include <future>
#include <string>

#include <zmq.hpp>

#include "bus/zenoh/session.h"

int main(int argc, char** argv) {
  if (argc != 4) return 2;
  const std::string key = argv[3];
  zmq::context_t context(1);
  zmq::socket_t socket(context, zmq::socket_type::sub);
  socket.set(zmq::sockopt::subscribe, key + '\0');
  socket.connect(argv[1]);

  auto session = tensormass::zenoh::Session::open({.connect = argv[2]});
  if (!session) return 1;
  std::promise<void> over_zenoh;
  bool first = true;
  auto subscriber = session->subscribe(key, [&](std::string_view, std::string_view) {
    if (std::exchange(first, false)) over_zenoh.set_value();
  });
  if (!subscriber) return 1;

  zmq::message_t message;
  if (!socket.recv(message)) return 1;
  over_zenoh.get_future().wait();
  if (write(STDOUT_FILENO, "r", 1) != 1) return 1;
  while (socket.recv(message)) continue;
  return 1;
}
