/* served.h: a morphod of its own for a benchmark, and a client that costs little. Every failure
 * ends the program. */
#ifndef MORPHO_BENCH_SERVED_H
#define MORPHO_BENCH_SERVED_H

#include <stdint.h>
#include <sys/types.h>

#include "bench.h"

struct bench_daemon {
  pid_t pid;
  uint16_t port;
  char folder[64];
};

/* On a free port, with an empty state in a folder of its own; flags: further ones, NULL at the end,
 * or NULL. */
void bench_daemon_start(struct bench_daemon *daemon, const struct bench_options *options,
                        const char *const *flags);
void bench_daemon_stop(const struct bench_daemon *daemon);

int bench_dial(const struct bench_daemon *daemon); /* a connection */
void bench_send(int fd, const char *bytes, size_t n);
/* Bytes of the whole reply at the beginning of `text` once its header is there, else 0. */
size_t bench_reply_size(const char *text, size_t n);
/* One request on a connection of its own; returns the status. *ret (nullable): the body (malloc,
 * terminated). */
int bench_ask(const struct bench_daemon *daemon, const char *method, const char *path,
              const char *headers, const char *body, size_t size, char **ret);

/* The body of an evaluation of n distinct random designs, with `more` members, each after a comma
 * (malloc). */
char *bench_request_of(struct mo_body_stream *stream, int n, const char *more, size_t *size);

_Noreturn void bench_die(const char *what); /* with errno, if it is set */

#endif
