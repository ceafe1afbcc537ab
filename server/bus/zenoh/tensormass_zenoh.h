#pragma once

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* The C interface of the Rust crate in rust/src/lib.rs. C++ uses it through zenoh/session.h, which draws the threads.
 *
 * Text is UTF-8. Keys are zenoh's key expressions; they carry their length and need no terminating zero. Every function
 * may be called from any thread. Bytes that the caller passes are copied before the function returns. */

#ifdef __cplusplus
extern "C" {
#endif

typedef struct tensormass_zenoh_session tensormass_zenoh_session;
typedef struct tensormass_zenoh_subscriber tensormass_zenoh_subscriber;

/* Receives one message. Key and payload are valid during the call only. */
typedef void (*tensormass_zenoh_message_fn)(void* context, const char* key, size_t key_size, const uint8_t* payload,
                                            size_t size);
/* Receives one log line. The texts are valid during the call only and have no terminating zero. who: the peer that was
 * disconnected for the reason in `message`, the name of its certificate or its address; "": a line of zenoh's own. */
typedef void (*tensormass_zenoh_log_fn)(void* context, bool is_error, const char* who, size_t who_size,
                                        const char* message, size_t size);

/* Text may be null, which reads as "". */
typedef struct {
  /* The address to listen on, "tcp/127.0.0.1:7447"; port 0 takes a free one. "": the session does not listen and is a
   * client of `connect`. */
  const char* listen;
  /* The address of the peer to connect to. "": no connection is made. */
  const char* connect;
  /* The key expression whose gets are answered with retained messages. "": no get is answered. */
  const char* serve;
  /* The key expression under which peers may put. Peers may then put nothing else, answer nobody, and get only what
   * this session puts and retains under `serve`. "": no rule holds, and peers speak to each other through this session.
   */
  const char* accept;
  /* zenoh's access control as JSON, in place of the rules of `accept`; "": those rules. */
  const char* access_control;
  /* PEM texts for mutual TLS: who signs the peers' certificates, and the own certificate and key. Addresses are then
   * written tls/HOST:PORT. "": no TLS. */
  const char* authority;
  const char* certificate;
  const char* private_key;
  /* Peers connected at once, and the bytes of a message of a peer; what is beyond is refused before it is held. A
   * message that zenoh sends in one piece, below 64 KiB, passes whatever the limit. 0: zenoh's own limits, 1000 and
   * 1 GiB. */
  uint32_t max_sessions;
  uint32_t max_message_bytes;
  /* Subscriptions and interests of a peer, and of all peers together; beyond it a peer's connection is closed. 0: no
   * limit, and none of the next four. Counted only after tensormass_zenoh_set_log. */
  uint32_t max_declarations;
  uint32_t max_declarations_of_all;
  /* Keys that zenoh keeps for what a peer declares, and the bytes of one. All peers together have as many as
   * subscriptions. */
  uint32_t max_keys;
  uint32_t max_key_bytes;
  /* Messages of a peer other than puts, with keys of all connections of one: so many at once, and so many a second
   * [1/s] after that. */
  double max_requests;
  double max_requests_per_s;
  bool shared_memory;
} tensormass_zenoh_options;

/* Opens a session, without scouting for peers. Close it with tensormass_zenoh_close. Returns null on failure and
 * writes the cause, cut to `error_capacity` bytes, to `error`. */
tensormass_zenoh_session* tensormass_zenoh_open(const tensormass_zenoh_options* options, char* error,
                                                size_t error_capacity);
/* Closes the session and frees it. Returns when no callback is running. Unsubscribe every subscriber before. */
void tensormass_zenoh_close(tensormass_zenoh_session* session);
/* Writes the address that the session listens on, with the port that was chosen; "" if it does not listen. */
void tensormass_zenoh_locator(const tensormass_zenoh_session* session, char* locator, size_t capacity);

/* Sends a message. `full_queues`, unless it is null, gets the number of readers whose queue became full by it. Waits at
 * most a few milliseconds, fixed by zenoh, for a reader whose queue is full; that reader then
 * loses the message. Urgent messages overtake the others. Returns false if the key is invalid or the session closed. */
bool tensormass_zenoh_put(const tensormass_zenoh_session* session, const char* key, size_t key_size,
                          const uint8_t* payload, size_t size, bool urgent, uint32_t* full_queues);
/* Keeps a message as the answer to a get of this key; needs `serve`. Returns false if the key is invalid. */
bool tensormass_zenoh_retain(const tensormass_zenoh_session* session, const char* key, size_t key_size,
                             const uint8_t* payload, size_t size);
/* Drops the retained message of this key, if there is one. */
void tensormass_zenoh_forget(const tensormass_zenoh_session* session, const char* key, size_t key_size);

/* Calls `function` on zenoh's threads for each message under the key. Returns null if the key is invalid or the session
 * is closed. */
tensormass_zenoh_subscriber* tensormass_zenoh_subscribe(const tensormass_zenoh_session* session, const char* key,
                                                        size_t key_size, tensormass_zenoh_message_fn function,
                                                        void* context);
/* Number of the peer whose message the calling function of a subscriber has: the same for all connections whose
 * certificates have the same name, and without certificates one a connection. 0: not known, because the session has no
 * max_declarations or nobody receives the log. */
uint64_t tensormass_zenoh_sender(void);
/* Writes who that is, for the log: the name of its certificate or its address, cut to `capacity` bytes; "": not known.
 */
void tensormass_zenoh_sender_name(char* name, size_t capacity);
/* Closes the connection that the message came over. Does nothing if it is not known. */
void tensormass_zenoh_end_sender(void);
/* Ends the subscription and returns when its function is not running. Must not be called from that function, and must
 * be called before the session is closed. */
void tensormass_zenoh_unsubscribe(tensormass_zenoh_subscriber* subscriber);

/* Asks all peers for the messages they retain under the key and calls `function` on this thread for each. Waits at most
 * timeout_ms. Returns the number of messages. */
size_t tensormass_zenoh_get(const tensormass_zenoh_session* session, const char* key, size_t key_size,
                            uint32_t timeout_ms, tensormass_zenoh_message_fn function, void* context);

/* Sends zenoh's warnings and errors to `function`, for the whole process. Works once: returns false if the log already
 * has a receiver. Source paths are removed from the text. */
bool tensormass_zenoh_set_log(tensormass_zenoh_log_fn function, void* context);
/* Connections to this process that failed zenoh's handshake. zenoh reports them only in its log, so the count starts
 * when tensormass_zenoh_set_log is called. */
uint64_t tensormass_zenoh_failed_handshakes(void);

/* What sessions of this process did not take from peers, counted as the failed handshakes are. */
typedef struct {
  uint64_t not_allowed;           /* messages that access control dropped */
  uint64_t too_large;             /* messages above max_message_bytes */
  uint64_t too_many_declarations; /* peers that were disconnected for what they declare or ask */
} tensormass_zenoh_refusals;
tensormass_zenoh_refusals tensormass_zenoh_refused(void);

#ifdef __cplusplus
}
#endif
