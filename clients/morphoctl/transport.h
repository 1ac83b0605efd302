/* transport.h: requests to the server over HTTP, by libcurl.
 *
 * A request that may be repeated safely is: after a broken connection with growing pauses, after
 * 429 and 503 when Retry-After says. What may be repeated: GET, PUT, DELETE, and a POST that
 * carries an Idempotency-Key. */
#ifndef MORPHOCTL_TRANSPORT_H
#define MORPHOCTL_TRANSPORT_H

#include <jansson.h>

#include "ctl.h"

#define HEADERS_MAX 8

struct request {
  const char *method; /* "GET", … */
  const char *path;   /* from "/" on, query included, escaped */
  const char *accept; /* NULL: application/json */
  const char *content_type;
  const void *body;
  size_t body_bytes;
  const char *headers[HEADERS_MAX]; /* further ones, "Name: value" */
  unsigned wait_s; /* what Prefer: wait asks for (0: none); the header is made from it */
  bool once;       /* not to be repeated */
};

struct reply {
  long status;
  char *body; /* NUL-terminated besides */
  size_t body_bytes, body_capacity;
  char content_type[96], location[512], shape[64], step[24], request_id[32];
  long retry_after_s; /* −1: none */
};

struct transport;

/* STATUS_OK, or STATUS_USAGE for a server address that makes no sense. */
int transport_open(struct ctl *ctl);
void transport_close(struct ctl *ctl);

/* STATUS_OK: there is a reply with a status below 400 in *reply. Else what is wrong has been
 * printed, problem details with all their faults. *reply is to be freed in both cases. */
int transport_send(struct ctl *ctl, const struct request *request, struct reply *reply);
/* The same without complaints about the reply's status (connection errors are still reported). */
int transport_try(struct ctl *ctl, const struct request *request, struct reply *reply);
void reply_free(struct reply *reply);

/* Prints what a reply of status ≥ 400 says and returns the exit status for it. */
int complain_about_reply(const struct ctl *ctl, const struct reply *reply);

/* GET and parse. *json is NULL on failure. */
int transport_get_json(struct ctl *ctl, const char *path, unsigned wait_s, json_t **json);
json_t *reply_json(const struct reply *reply); /* NULL and a complaint: not JSON */

/* A stream: `data` is called with each piece; a non-zero return ends it (STATUS_OK). It may send
 * other requests meanwhile. STATUS_CONNECTION: it broke. */
int transport_stream(struct ctl *ctl, const char *path, const char *header,
                     int (*data)(void *context, const char *bytes, size_t n), void *context);

/* Sleeps, but wakes on an interrupt. */
void pause_s(double seconds);
/* A random key for Idempotency-Key: 32 hexadecimal digits and a NUL. */
int random_key(char key[33]);
/* Escapes one path or query component (malloc). */
char *escape(const char *text);

#endif
