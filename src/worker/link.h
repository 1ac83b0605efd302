/* link.h: the worker's concurrent requests to the daemon over HTTP/1.1.
 *
 * One thread uses a link; only mo_link_wake may be called from others. Each kind of request has its
 * own place, so at most one of each kind is in flight. */
#ifndef MORPHO_WORKER_LINK_H
#define MORPHO_WORKER_LINK_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>

enum mo_call {
  MO_CALL_SESSION, /* joins or leaves */
  MO_CALL_ORDERS,  /* always open: the heartbeat */
  MO_CALL_RESULTS, /* sends results, takes leases that are available now */
  MO_CALL_LEASES,  /* waits for leases */
  MO_CALL_WEIGHTS,
  MO_CALLS
};

/* Texts that outlive the link. */
struct mo_link_config {
  const char *server;           /* "https://host:port" */
  const char *token;            /* nullable */
  const char *pin, *ca, *proxy; /* nullable; as CURLOPT_PINNEDPUBLICKEY, …_CAINFO, …_PROXY */
  const char *user_agent;
};

struct mo_link;
/* MO_ERR_INVALID: the server, the pin or the file of certificates; or a token would be sent in
 * clear text to a host that is not on loopback. MO_ERR_NO_MEMORY. */
int mo_link_create(const struct mo_link_config *config, struct mo_link **link,
                   struct mo_message *message);
void mo_link_free(struct mo_link *link); /* NULL-safe */

struct mo_link_request {
  const char *method, *path;
  const char *type; /* of the body */
  const void *body; /* copied; NULL: none */
  size_t size;
  uint32_t wait_s;     /* > 0: Prefer: wait */
  uint32_t timeout_ms; /* of the whole request */
  size_t limit;        /* largest reply */
  bool has_digest;     /* a successful reply must have a Content-Digest */
};
/* Starts a request in its place, which must be free. MO_ERR_NO_MEMORY. */
int mo_link_start(struct mo_link *link, enum mo_call call, const struct mo_link_request *request);
bool mo_link_is_busy(const struct mo_link *link, enum mo_call call);
/* Ends a request without its reply; its connection is closed. */
void mo_link_abort(struct mo_link *link, enum mo_call call);

struct mo_link_reply {
  /* MO_OK: a reply has arrived; MO_ERR_IO: no connection, or it was closed; MO_ERR_INVALID: the
   * daemon's certificate is not the expected one; MO_ERR_CORRUPT: too long, or its digest does not
   * match. */
  int error;
  int status;
  uint32_t retry_after_s;
  uint8_t *body; /* malloc, followed by a NUL; owned by the caller */
  size_t size;
  char why[256]; /* reason for an error */
};
/* Waits until a request ends, and returns its place. Returns −1 after the timeout, or if
 * mo_link_wake was called. */
int mo_link_next(struct mo_link *link, uint32_t timeout_ms, struct mo_link_reply *reply);
void mo_link_wake(struct mo_link *link);

#endif
