/* server.h: the complete state of a server. See http.h for the threads.
 *
 * Order in which locks may be taken: streams → pool → bodies → clients → connections →
 * libmicrohttpd's own. */
#ifndef MORPHO_HTTP_SERVER_H
#define MORPHO_HTTP_SERVER_H

#include "http/client.h"
#include "http/connection.h"
#include "http/guard.h"
#include "http/http.h"
#include "http/metrics.h"
#include "http/pool.h"
#include "http/reply.h"
#include "http/stream.h"

struct mo_http {
  struct mo_http_config config; /* defaults filled in */
  struct mo_http_service service;
  struct mo_names names;
  struct mo_tokens tokens;
  bool beyond_loopback, is_tls;
  struct mo_listener {
    int fd;
    enum mo_transport transport;
  } * listeners;
  size_t n_listeners;
  struct MHD_Daemon *daemon;
  /* accept.c, connection.c */
  pthread_t acceptor, clock;
  bool acceptor_started, clock_started;
  int stop_fd;  /* eventfd: stops the acceptor */
  int watch_fd; /* epoll: clients that leave, and tick_fd */
  int tick_fd;  /* eventfd: a tick is requested */
  atomic_bool tick_wanted;
  int peers_fd; /* netlink socket for the users of loopback peers; −1: not available */
  uint32_t peers_sequence;
  pthread_mutex_t connections_lock;
  struct mo_connection **connections;       /* by descriptor */
  size_t connections_size, connections_top; /* all descriptors are below connections_top */
  atomic_uint n_connections, n_leaving;     /* n_leaving: shut down, but not yet closed by their I/O
                                             * threads */
  _Atomic int64_t acceptor_us, clock_us;
  atomic_bool clock_stop, ready, stopping;
  struct mo_lingering lingering;
  struct mo_clients clients;
  struct mo_pool pool;
  struct mo_streams streams;
  struct mo_metrics metrics;
  atomic_uint n_in_flight;
  pthread_mutex_t bodies_lock;
  LIST_HEAD(, mo_request) bodies; /* requests whose bodies are being received */
  _Atomic uint64_t body_memory;
  _Atomic uint64_t next_id;
  uint64_t id_key;
};

/* Writes the last bytes of a connection, and closes TLS (tls.c), on the I/O thread. Returns whether
 * any were written. */
bool mo_connection_write_last(struct mo_request *request, const char *bytes, size_t n);

/* Starts libmicrohttpd with its callbacks (dispatch.c). */
int mo_daemon_start(struct mo_http *http, struct mo_message *message);

/* Parses an address to listen on: "127.0.0.1:8765", "[::1]:8765", "localhost:0" or
 * "unix:/run/x". MO_ERR_INVALID with a message. */
struct mo_listen_address {
  bool is_unix, is_loopback;
  char host[256]; /* or the path */
  uint16_t port;
};
int mo_http_parse_address(const char *text, struct mo_listen_address *address,
                          struct mo_message *message);

#endif
