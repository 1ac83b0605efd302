/* http.h: an HTTP server that is independent of jobs: it serves the routes of a table (route.h).
 *
 * Threads: one acceptor per server takes connections from every listening socket and hands them to
 * libmicrohttpd's pool of I/O threads. I/O threads read requests and write replies, and never wait
 * for anything else. Requests that read the store or parse large bodies go to a pool of API
 * threads. One clock thread enforces deadlines, heartbeats and `Prefer: wait`. Health, readiness
 * and metrics read only atomics and wait for no thread.
 *
 * This room does not write logs: the `log` callback receives each finished request. */
#ifndef MORPHO_HTTP_HTTP_H
#define MORPHO_HTTP_HTTP_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>

#include <morpho/error.h>

#include "http/route.h"

struct mo_http;
struct mo_request;

/* One finished request, for a log line. Texts are valid during the call only. They are safe to
 * print: control bytes are replaced. */
struct mo_http_log_entry {
  char request_id[17];
  const char *client; /* "127.0.0.1:51234 uid 1000", "192.0.2.7:51234", "unix uid 1000" */
  const char *user;   /* the name of the token that was sent; "": none */
  const char *method;
  const char *path;
  const char *reason; /* why the service failed (status 500 and above), or what data it could not
                         read; NULL: neither */
  unsigned status;    /* 0: the connection ended before a reply was made */
  uint64_t body_in;   /* bytes of the request's body */
  uint64_t body_out;  /* bytes of the reply's body; for a stream, the bytes written */
  double duration_s;  /* from the end of the header to the end of the reply */
};

/* The server copies the tokens. The other names and groups must outlive it.
 *
 * The kind of a listening socket is read from the socket itself: TCP on a loopback address, TCP
 * elsewhere, or unix. */
struct mo_http_config {
  const int *listeners; /* listening sockets; mo_http_start takes ownership: the server closes them,
                           even if the start fails */
  size_t n_listeners;
  const char *const
      *allowed_hosts; /* additional names (with or without port) for Host and Origin; loopback names
                         and the listeners' addresses are always allowed. "*": any Host */
  size_t n_allowed_hosts;
  const struct mo_token *tokens; /* at most MO_TOKENS_MAX; see mo_http_set_tokens */
  size_t n_tokens;
  bool token_on_loopback;   /* also require a token on loopback */
  bool token_if_any;        /* require a token on loopback if any is set; a token allows any Host */
  const char *certificate;  /* NULL: plain HTTP. Else TLS 1.3: the chain, as text in PEM */
  const char *key;          /* its private key, as text in PEM; both are read only at the start */
  const gid_t *unix_groups; /* groups whose members may use the unix socket, in addition to root and
                               the service's own user */
  size_t n_unix_groups;
  uint32_t n_io_threads;      /* libmicrohttpd's pool; 0: one per CPU, at most 4 */
  uint32_t max_connections;   /* beyond this, idle connections are closed, or new ones get 503 with
                               * Retry-After. Lower if the limit on open files requires it: see
                               * mo_http_get_stats */
  uint32_t other_files;       /* descriptors that other servers in this process may need */
  uint32_t max_streams;       /* event streams */
  uint32_t max_in_flight;     /* requests of one client at a time, except requests that wait for a
                               * job; beyond this: 429 */
  uint32_t max_queued;        /* requests that wait for an API thread; beyond this: 503; 0: 256 */
  uint32_t client_rate_per_s; /* submissions and uploads per second and client; 0: no limit; beyond
                                 this: 429 */
  uint64_t max_body_bytes;    /* JSON body that submits work */
  uint64_t max_file_bytes;    /* a file in a body */
  uint64_t max_bundle_bytes;  /* several files in one body */
  uint64_t max_body_memory; /* for bodies being received or handled, and large replies not yet read.
                               One client may use at most half; beyond this: 429 */
  uint32_t header_timeout_ms; /* from the start of a request to the end of its header */
  uint32_t body_timeout_ms;   /* from the end of the header to the end of the body */
  uint32_t idle_timeout_ms;   /* between requests of one connection */
  uint32_t heartbeat_ms;      /* of event streams; 0: 15 s */
  void (*log)(void *context,
              const struct mo_http_log_entry *entry); /* nullable; called by several threads */
  void *log_context;
};

/* The service behind a server. All of it must outlive the server. */
struct mo_http_service {
  struct mo_routes routes; /* at most MO_ROUTES_MAX */
  void *context;           /* for the handlers */
  /* Each nullable. start: before the first connection is accepted; an error aborts the start. tick:
   * every tick_ms, on the clock thread. stop: after the last reply. */
  int (*start)(void *context, struct mo_http *http);
  void (*tick)(void *context);
  void (*stop)(void *context);
  uint32_t tick_ms; /* 0: 1000 ms */
};

struct mo_http_stats {
  uint32_t connections, in_flight;
  uint32_t max_connections; /* as reduced by the limit on open files */
  uint64_t requests;
  int64_t heartbeat_us; /* monotonic: the older of the last heartbeats of the acceptor and the
                           clock. API threads do not count, because they may wait for the store's
                           writer, which has its own heartbeat */
};

/* Opens a listening socket: "127.0.0.1:8765", "[::1]:0", "name:8765" (first address of the name),
 * "unix:/run/morphod.sock". A unix socket replaces a stale one that no server uses; its mode is
 * 0666, because peers are checked by their credentials. `address` (≥ 128 bytes) receives
 * the address with the real port: "http://127.0.0.1:41234" or "unix:/run/…". MO_ERR_INVALID,
 * MO_ERR_NOT_FOUND (unknown name), MO_ERR_CONFLICT (address in use), MO_ERR_IO. */
int mo_http_listen(const char *where, int *fd, char *address, struct mo_message *message);
/* Describes, in the same form, a listening socket that was opened elsewhere. MO_ERR_INVALID: not a
 * listening TCP or unix socket. */
int mo_http_describe(int fd, char *address, bool *beyond_loopback, struct mo_message *message);

/* Starts the server. A process may have several. GET /readyz is 503 until mo_http_set_ready.
 * MO_ERR_INVALID: no tokens although a listener is not on loopback, a malformed token, a
 * certificate and a key that do not match, no listener; MO_ERR_NO_MEMORY; MO_ERR_IO. */
int mo_http_start(const struct mo_http_config *config, const struct mo_http_service *service,
                  struct mo_http **http, struct mo_message *message);

/* Checks a certificate and its key. MO_ERR_INVALID, MO_ERR_NO_MEMORY. */
int mo_http_check_certificate(const char *certificate, const char *key, struct mo_message *message);
/* Closes the listening sockets, for a caller that fails before mo_http_start. */
void mo_http_refuse_listeners(const struct mo_http_config *config);

/* Sets readiness. While it is false (draining), /readyz returns 503 and new work is rejected with
 * 503, but requests in flight are still answered. */
void mo_http_set_ready(struct mo_http *http, bool ready);
bool mo_http_is_ready(const struct mo_http *http);

void *mo_http_context(const struct mo_request *request); /* of the request's service */

/* Replaces the tokens. Open requests continue, but event streams with a removed token are closed.
 * MO_ERR_INVALID (missing but required, or malformed), MO_ERR_NO_MEMORY: the old tokens stay. */
int mo_http_set_tokens(struct mo_http *http, const struct mo_token *tokens, size_t n,
                       struct mo_message *message);

/* Stops the server gracefully: accepts no new connections, closes event streams, answers waiting
 * requests, waits up to `grace_ms` for replies in flight, then closes and frees everything.
 * NULL-safe. The service must still exist. */
void mo_http_stop(struct mo_http *http, uint32_t grace_ms);

/* Runs the service's next tick at once. Takes no lock. */
void mo_http_tick_soon(struct mo_http *http);
void mo_http_get_stats(struct mo_http *http, struct mo_http_stats *stats);

#endif
