/* request.h: one request and its reply.
 *
 * Lifecycle of a request:
 * - libmicrohttpd's URI callback creates the request when its target is known.
 * - The header is checked and the body is received.
 * - Direct routes and refusals are answered at once. For other routes the connection is suspended
 *   and the request is queued for the API pool.
 * - An API thread handles the request. The request may be parked until something ends (pool.h).
 * - The connection is resumed, and its I/O thread sends the reply, logs the request and frees it.
 *
 * The connection owns the request: a request that the library never completes is freed with its
 * connection. Only one thread uses a request at a time; requests are handed over under the pool's
 * lock, or by libmicrohttpd's suspend and resume. */
#ifndef MORPHO_HTTP_REQUEST_H
#define MORPHO_HTTP_REQUEST_H

#include <stdatomic.h>
#include <sys/queue.h>

#include <microhttpd.h>

#include "http/guard.h"
#include "http/route.h"

struct mo_client;
struct mo_connection;
struct mo_http;

struct mo_reply {
  unsigned status; /* 0: no reply yet */
  const char *type;
  char *body;        /* malloc; NULL: see fixed */
  const char *fixed; /* static, or borrowed from the owner until it is released */
  size_t size;
  void (*release)(void *owner); /* NULL: nothing to release */
  void *owner;
  const char *policy; /* static: Content-Security-Policy; NULL: frame-ancestors 'none' */
  bool close;
  bool keep;  /* the reply to this path never changes: clients may cache it for a year */
  bool packs; /* worth compressing, although the type does not suggest it */
  unsigned retry_after_s;
  char etag[112], location[192], allow[64], applied[24];
  unsigned n_extra;
  struct {
    const char *name;
    char value[96];
  } extra[6];
};

/* The query parameters of a request, decoded. */
#define MO_QUERY_MAX 16
struct mo_query {
  char *text; /* malloc: the names and values */
  unsigned n;
  struct {
    const char *name, *value;
  } items[MO_QUERY_MAX];
};

#define MO_REASON_BYTES 896 /* size of a note for the log */

enum mo_stage { MO_STAGE_TARGET, MO_STAGE_BODY, MO_STAGE_HANDLING, MO_STAGE_REPLY };

struct mo_request {
  struct mo_http *http;
  struct MHD_Connection *mhd;
  struct mo_connection *connection;
  enum mo_stage stage;
  char id[17];
  char *raw_target; /* as received */
  struct mo_target target;
  char path[256]; /* for logs: truncated, control bytes replaced */
  char method_text[16];
  enum mo_method method;
  const struct mo_route *route; /* the line of path and method; if the path lacks the method, the
                                   path's first line; NULL: no such path */
  char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES];
  struct mo_framing framing;
  struct mo_caller caller;
  struct mo_query query;
  /* Body. */
  uint64_t body_limit, body_seen, body_reserved;
  struct mo_client *body_client; /* the client to which `body_reserved` (of the body or the reply)
                                    is charged; NULL: no client */
  char *body;
  size_t body_size, body_capacity;
  bool body_coming, body_gave_way; /* body.c */
  LIST_ENTRY(mo_request) other_bodies;
  struct mo_reply reply;
  char reason[MO_REASON_BYTES]; /* for the log: why the service failed, or what data it could not
                                   read; "": neither */
  unsigned char client_key[16]; /* the connection's client and the token: many people may share a
                                   proxy */
  struct mo_client *client;
  int64_t started_us;
  uint64_t sent;
  bool answered; /* answered: by mo_reply_last */
  /* Waiting (pool.c). */
  int64_t wait_for, wait_deadline_us;
  int wait_s; /* requested seconds (Prefer: wait); −1: none */
  bool wait_fired, wait_parked, wait_over;
  int64_t kept; /* for the handler, which may run again after a wait; initially 0 */
  LIST_ENTRY(mo_request) others_waiting;
  /* Waiting for a thread (queue.c). */
  TAILQ_ENTRY(mo_request) other_clients;
  STAILQ_HEAD(, mo_request) behind;
  STAILQ_ENTRY(mo_request) next_behind;
  bool is_crowded; /* its client has other requests in the same queue */
  /* A reply that is produced piece by piece, or an event stream. refill: makes the next piece on an
   * API thread and resumes the connection. reader: passes libmicrohttpd the next bytes; NULL: the
   * reply is complete. */
  void (*refill)(struct mo_request *request);
  MHD_ContentReaderCallback reader;
  struct mo_stream *stream;
  struct mo_download *download;
};

/* Creates the request of a connection that has none. Returns NULL if memory runs out. */
struct mo_request *mo_request_begin(struct mo_connection *connection, struct MHD_Connection *mhd,
                                    const char *target);
/* Logs and frees the connection's request, if it has one. complete: the reply was sent in full. */
void mo_request_end(struct mo_connection *connection, bool complete);

/* Returns whether the reply is no longer needed: the client has left, or the service is stopping. A
 * handler that works for seconds checks this periodically, and stops with MO_ERR_CANCELLED. */
bool mo_request_is_over(const struct mo_request *request);

/* ---- the memory of bodies and of large replies (body.c) ---- */

#define MO_BODY_GAVE_WAY                                                                           \
  "The body stopped arriving, and other requests needed its memory; try again later."
/* Returns how much of the memory the bodies and replies of one client may use: half. Workers may
 * share one address, and may use all of the memory of their server. */
uint64_t mo_body_memory_of_client(const struct mo_request *request);
/* Reserves `more` bytes for a request that already holds `held` bytes. Returns false if too little
 * memory is left. A request always gets its bytes if no other request holds any. */
bool mo_body_memory_take(struct mo_http *http, uint64_t held, uint64_t more, bool small);
/* Appends a piece to the body. MO_ERR_LIMIT: the client has used its share; MO_ERR_NO_MEMORY;
 * MO_ERR_CANCELLED: the body was dropped. */
int mo_body_add(struct mo_request *request, const char *bytes, size_t n);
/* Ends the receiving of the body, which can then no longer be dropped. Returns false if it was
 * already dropped. */
bool mo_body_end(struct mo_request *request);
/* Frees the body's memory once it has been read or is not needed. */
void mo_request_drop_body(struct mo_request *request);

#endif
