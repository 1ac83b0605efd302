/* service.h: the parts of the service, put together and taken apart in the right order. */
#ifndef MORPHO_DAEMON_SERVICE_H
#define MORPHO_DAEMON_SERVICE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>

#include "daemon/settings.h"

/* Exit statuses (morphod(8)): the numbers of sysexits.h that fit. */
enum exit_status {
  EXIT_OK = 0,
  EXIT_USAGE = 64,
  EXIT_UNAVAILABLE = 69,
  EXIT_INTERNAL = 70,
  EXIT_SYSTEM = 71,
  EXIT_STATE = 74,
  EXIT_IN_USE = 75,
  EXIT_CONFIG = 78
};

struct service;

/* Opens state, starts computing, serves. `fatal` is called from some thread when the process must
 * end (a failed write). On failure: what was opened is closed, the exit status is returned and
 * `message` says what is wrong. */
int service_start(const struct settings *settings, void (*fatal)(const char *what),
                  struct service **service, struct mo_message *message);

/* "http://127.0.0.1:8765" or "unix:/path", as many as there are listeners. */
size_t service_addresses(const struct service *service, const char *const **addresses);

/* Reads the token file again. */
int service_reload_tokens(struct service *service, const struct settings *settings,
                          struct mo_message *message);

/* Takes no new work from now on. */
void service_drain(struct service *service);
/* Whether no evaluation is being computed: what a stop waits for. Trainings and campaigns would
 * take hours: they are parked at once. */
bool service_is_idle(struct service *service);
bool service_is_learning(struct service *service);

/* Whether scheduler, writer and HTTP came round within `limit_us`; else *who is the one that did
 * not. */
bool service_is_alive(struct service *service, int64_t limit_us, const char **who);

/* Parks what runs, answers what waits, closes everything. */
void service_stop(struct service *service);

/* A short account of what goes on, for STATUS= and the log. */
void service_describe(struct service *service, char *text, size_t capacity);

#endif
