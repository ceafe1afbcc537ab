#pragma once

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* The C interface of the Rust crate beside this file (rust/src/lib.rs). C++ uses it through zenoh/session.h.
 * Text is UTF-8. Keys are key expressions of zenoh, given with their length. Everything may be called from any thread.
 */

#ifdef __cplusplus
extern "C" {
#endif

typedef struct tensormass_zenoh_session tensormass_zenoh_session;
typedef struct tensormass_zenoh_subscriber tensormass_zenoh_subscriber;

/* Key and payload are valid during the call. */
typedef void (*tensormass_zenoh_message_fn)(void* context, const char* key, size_t key_size, const uint8_t* payload,
                                            size_t size);
typedef void (*tensormass_zenoh_log_fn)(void* context, bool is_error, const char* message, size_t size);

/* listen: "tcp/127.0.0.1:7447", port 0 for a free one; null: none, and the session is a client of `connect`.
 * connect: "tcp/127.0.0.1:7447"; null: none.
 * serve: key expression under which retained messages are answered; null: none are.
 * Nothing is scouted. On failure null, with the reason in `error`. */
tensormass_zenoh_session* tensormass_zenoh_open(const char* listen, const char* connect, const char* serve,
                                                bool shared_memory, char* error, size_t error_capacity);
/* Undeclares everything, returns when no callback runs any more. */
void tensormass_zenoh_close(tensormass_zenoh_session* session);
/* What the session listens on, with its port; empty if it does not listen. */
void tensormass_zenoh_locator(const tensormass_zenoh_session* session, char* locator, size_t capacity);

/* Never waits for a stopped reader longer than zenoh's own milliseconds: who cannot take it loses it. */
bool tensormass_zenoh_put(const tensormass_zenoh_session* session, const char* key, size_t key_size,
                          const uint8_t* payload, size_t size, bool urgent);
/* Kept as the answer to a get of this key; needs `serve`. */
bool tensormass_zenoh_retain(const tensormass_zenoh_session* session, const char* key, size_t key_size,
                             const uint8_t* payload, size_t size);
void tensormass_zenoh_forget(const tensormass_zenoh_session* session, const char* key, size_t key_size);

/* The function runs on threads of zenoh. Null if the key is no key expression or the session is closed. */
tensormass_zenoh_subscriber* tensormass_zenoh_subscribe(const tensormass_zenoh_session* session, const char* key,
                                                        size_t key_size, tensormass_zenoh_message_fn function,
                                                        void* context);
/* Returns when the function does not run any more; not to be called from it. Before the session is closed. */
void tensormass_zenoh_unsubscribe(tensormass_zenoh_subscriber* subscriber);

/* Calls the function, on this thread, for each message that is retained under the key somewhere; returns how many. */
size_t tensormass_zenoh_get(const tensormass_zenoh_session* session, const char* key, size_t key_size,
                            uint32_t timeout_ms, tensormass_zenoh_message_fn function, void* context);

/* For the whole process, once; false if something else has taken the log. Warnings and errors of zenoh. */
bool tensormass_zenoh_set_log(tensormass_zenoh_log_fn function, void* context);
/* Connections of the whole process that did not get through zenoh's handshake; counted once the log is set. */
uint64_t tensormass_zenoh_failed_handshakes(void);

#ifdef __cplusplus
}
#endif
