/* transport.h: sends requests to the server over HTTP, with libcurl.
 *
 * Requests are repeated: after a broken connection with growing pauses, after 429 and 503 when
 * Retry-After says. All of them are safe to repeat: a POST has an Idempotency-Key, or does nothing
 * the second time. */
#ifndef MORPHOCTL_TRANSPORT_H
#define MORPHOCTL_TRANSPORT_H

#include <jansson.h>

#include "ctl.h"

struct request {
  const char *method; /* "GET", … */
  const char *path;   /* begins with "/"; with the query; escaped */
  const char *accept; /* NULL: application/json */
  const char *content_type;
  const void *body;
  size_t body_bytes;
  const char *key;        /* Idempotency-Key; NULL: none */
  const char *last_event; /* Last-Event-ID; NULL: none */
  unsigned wait_s;        /* seconds for Prefer: wait (0: none) */
  bool once;              /* never repeat this request */
};

struct reply {
  long status;
  char *body; /* a NUL follows the last byte; nullable */
  size_t body_bytes;
  FILE *file;                /* that writes the body; private */
  bool is_file, is_too_long; /* private */
  char content_type[96], shape[64], step[24], request_id[32];
  long retry_after_s; /* −1: none */
};

struct transport;

void transport_open(struct ctl *ctl);

/* Makes a path, which stays until the fourth call after this one. */
const char *path_to(const char *format, ...) __attribute__((format(printf, 1, 2)));
/* Sends a request without complaining about the reply's status (connection errors are still
 * reported). Free *reply in any case. */
int transport_try(struct ctl *ctl, const struct request *request, struct reply *reply);
/* Sends a request. *reply has a status below 400: any other error is printed, for problem details
 * with all faults, and ends the program. */
void transport_send(struct ctl *ctl, const struct request *request, struct reply *reply);
/* Gets what a path has in one form, in the same way. */
void transport_get(struct ctl *ctl, const char *path, const char *accept, struct reply *reply);
void reply_free(struct reply *reply);

/* Complains that no server answers: names the address, where it was configured, and what to do.
 * Returns STATUS_CONNECTION. */
int complain_about_server(const struct ctl *ctl, const char *words);
/* Prints what a reply of status ≥ 400 says, and returns the exit status for it. */
int complain_about_reply(const struct ctl *ctl, const struct reply *reply);

/* Sends a request and parses the reply. Returns an exit status; an error was printed, and *json is
 * NULL. code: nullable; the reply's status. */
int try_json(struct ctl *ctl, const struct request *request, long *code, json_t **json);
/* The same, but an error ends the program. Returns a new reference. */
json_t *send_json(struct ctl *ctl, const struct request *request, long *code);
/* Gets the JSON of a path, which printf makes. It is kept. */
json_t *get_json(struct ctl *ctl, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* Reads a stream. Calls `data` with each piece; `data` may send other requests. A non-zero result
 * ends the stream. False: the stream broke. last_event: nullable. */
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
