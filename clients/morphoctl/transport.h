/* transport.h: sends requests to the server over HTTP, with libcurl.
 *
 * Requests are retried: after a lost connection with growing pauses, and after 429 and 503 at the
 * time in Retry-After. All of them are safe to repeat: a POST has an Idempotency-Key, or has no
 * effect the second time. */
#ifndef MORPHOCTL_TRANSPORT_H
#define MORPHOCTL_TRANSPORT_H

#include <jansson.h>

#include "ctl.h"

struct request {
  const char *method; /* "GET", … */
  const char *path;   /* begins with "/"; includes the query; escaped */
  const char *accept; /* NULL = application/json */
  const char *content_type;
  const void *body;
  size_t body_bytes;
  const char *key;        /* Idempotency-Key; NULL if none */
  const char *last_event; /* Last-Event-ID; NULL if none */
  unsigned wait_s;        /* seconds for Prefer: wait (0 = none) */
  bool once;              /* never repeat this request */
};

struct reply {
  long status;
  char *body; /* a NUL follows the last byte; nullable */
  size_t body_bytes;
  FILE *file;                /* that writes the body; private */
  bool is_file, is_too_long; /* private */
  char content_type[96], shape[64], step[24], request_id[32];
  long retry_after_s; /* −1 if none */
};

struct transport;

void transport_open(struct ctl *ctl);

/* Makes a path, which remains valid until the fourth call after this one. */
const char *path_to(const char *format, ...) __attribute__((format(printf, 1, 2)));
/* Sends a request without reporting the reply's status (connection errors are still reported). Free
 * *reply in any case. */
int transport_try(struct ctl *ctl, const struct request *request, struct reply *reply);
/* Sends a request. *reply has a status below 400: any other error is printed, including all faults
 * in problem details, and ends the program. */
void transport_send(struct ctl *ctl, const struct request *request, struct reply *reply);
/* Gets a path in one format, in the same way. */
void transport_get(struct ctl *ctl, const char *path, const char *accept, struct reply *reply);
void reply_free(struct reply *reply);

/* Reports that no server replies, with the address, where it was configured, and what to do.
 * Returns STATUS_CONNECTION. */
int complain_about_server(const struct ctl *ctl, const char *words);
/* Prints the problem in a reply with status ≥ 400, and returns the exit status for it. */
int complain_about_reply(const struct ctl *ctl, const struct reply *reply);

/* Sends a request and parses the reply. Returns an exit status; an error was printed, and *json is
 * NULL. code: nullable; the reply's status. */
int try_json(struct ctl *ctl, const struct request *request, long *code, json_t **json);
/* The same, but an error ends the program. Returns a new reference. */
json_t *send_json(struct ctl *ctl, const struct request *request, long *code);
/* Gets the JSON of a path made with a printf format. It is kept. */
json_t *get_json(struct ctl *ctl, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* Reads a stream. Calls `data` with each piece; `data` may send other requests. A non-zero result
 * stops the stream. Returns false if the stream broke. last_event: nullable. */
bool transport_stream(struct ctl *ctl, const char *path, const char *last_event,
                      int (*data)(void *context, const char *bytes, size_t n), void *context);

/* Reads a long reply in the same way, to its end. */
void transport_download(struct ctl *ctl, const char *path, const char *accept,
                        int (*data)(void *context, const char *bytes, size_t n), void *context);

/* Sleeps, but wakes on an interrupt. */
void pause_s(double seconds);
/* Writes a random Idempotency-Key: 32 hexadecimal digits and a NUL. */
void random_key(char key[33]);
/* Escapes one component of a path or query (kept). */
char *escape(const char *text);

#endif
