/* connection.h: open connections and their clients. */
#ifndef MORPHO_HTTP_CONNECTION_H
#define MORPHO_HTTP_CONNECTION_H

#include <netinet/in.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <sys/socket.h>

#include <morpho/error.h>

#define MO_NEVER INT64_MAX

struct mo_http;
struct mo_request;

enum mo_transport { MO_TRANSPORT_LOOPBACK, MO_TRANSPORT_TCP, MO_TRANSPORT_UNIX };

/* A few connections are reserved: some for the unix socket, some for health requests. */
enum mo_place { MO_PLACE_ORDINARY, MO_PLACE_UNIX, MO_PLACE_HEALTH, MO_PLACES };

#define MO_GAVE_WAY INT64_MIN
#define MO_STALL_US 1000000 /* a request without progress for this long may be dropped */

struct mo_connection {
  struct mo_http *http;
  struct mo_request *request; /* the request in flight; used by the I/O thread only */
  int fd;
  enum mo_place place;
  enum mo_transport transport;
  unsigned char client_key[16]; /* identifies the client for limits: the peer's user if it is on
                                   this machine, otherwise its address */
  char client[64];              /* for logs */
  _Atomic int64_t deadline_us;  /* when the clock thread closes the connection */
  bool lingers; /* the client still sends, so closing at once could lose the last reply */
  /* These decide whether this connection may be closed if a new one needs its place. spare_us: the
   * time since which the connection has been idle, or its request (receiving: one has begun) has
   * made no progress. MO_NEVER: a complete request has arrived. */
  atomic_bool receiving;
  _Atomic int64_t spare_us; /* MO_GAVE_WAY: already closed */
  atomic_bool left;         /* the client has closed its end */
};

/* The table of connections by descriptor (in struct mo_http). */
int mo_connections_init(struct mo_http *http, struct mo_message *message);
void mo_connection_add(struct mo_http *http, struct mo_connection *connection);
struct mo_connection *mo_connection_find(struct mo_http *http, int fd);
void mo_connection_forget(struct mo_http *http, struct mo_connection *connection);
/* Closes all connections whose deadline has passed. */
void mo_connections_expire(struct mo_http *http, int64_t now_us);

/* Sets spare_us. Returns false if the connection was already closed; its request must then not be
 * handled. */
bool mo_connection_spare(struct mo_connection *connection, int64_t since_us);
/* Closes the connection by shutdown, so that the I/O thread sees the end of file. detail
 * (nullable): the detail of a 503 that is sent first if the connection has a request without a
 * reply. */
void mo_connection_cut(struct mo_http *http, const struct mo_connection *connection, const char *id,
                       const char *detail);
/* Waits for clients to leave, at most timeout_ms: libmicrohttpd does not watch suspended
 * connections. Returns whether a client has left. */
bool mo_connections_watch(struct mo_http *http, int timeout_ms);
/* Returns whether the client of a connection has left. */
bool mo_connection_has_left(const struct mo_connection *connection);
/* Writes a refusal to a socket as a complete reply. With TLS it does nothing, because only the
 * thread of a connection can encrypt. */
void mo_write_refusal(const struct mo_http *http, int fd, unsigned status, const char *id,
                      const char *detail);

/* Reads and discards, for a short time, the data that clients still send after their last reply:
 * closing at once would reset the connection and lose the reply. */
#define MO_LINGER_MAX 128
struct mo_lingering {
  pthread_mutex_t lock;
  int fd[MO_LINGER_MAX];
  int64_t until_us[MO_LINGER_MAX];
  size_t n;
};
/* Takes over the descriptor, already shut down for writing. */
void mo_linger_add(struct mo_lingering *lingering, int fd);
void mo_linger_on(struct mo_lingering *lingering, int64_t now_us);
void mo_linger_end(struct mo_lingering *lingering);

int mo_acceptor_start(struct mo_http *http, struct mo_message *message); /* accept.c */
void mo_acceptor_stop(struct mo_http *http);

bool mo_address_is_loopback(const struct sockaddr_storage *address); /* in listen.c */

#endif
