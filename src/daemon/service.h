/* service.h: starts and stops the parts of the service in the right order. */
#ifndef MORPHO_DAEMON_SERVICE_H
#define MORPHO_DAEMON_SERVICE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>

#include "daemon/settings.h"

/* The installed controllers: the default one, the one for the paper's physics, and the one that was
 * trained with all guides. */
#define SHIPPED_CONTROLLER    MORPHOD_DATADIR "/controllers/phototaxis-16ms.safetensors"
#define PAPER_CONTROLLER      MORPHOD_DATADIR "/controllers/phototaxis.safetensors"
#define GENERALIST_CONTROLLER MORPHOD_DATADIR "/controllers/generalist-16ms.safetensors"
#define ROBUST_CONTROLLER     MORPHOD_DATADIR "/controllers/robust-16ms.safetensors"

/* Exit statuses (see morphod(8)), numbered as in sysexits.h. */
enum exit_status {
  EXIT_OK = 0,
  EXIT_USAGE = 64,
  EXIT_UNAVAILABLE = 69,
  EXIT_INTERNAL = 70,
  EXIT_SYSTEM = 71,
  EXIT_STATE = 74,
  EXIT_IN_USE = 75, /* also: a worker cannot reach its daemon */
  EXIT_PROTOCOL = 76,
  EXIT_DENIED = 77,
  EXIT_CONFIG = 78
};

/* Maps an error of mo_store_open() to an exit status: EXIT_CONFIG if retrying cannot help. */
int service_store_status(int error);

struct service;

/* Opens the state, starts computing, and serves. `fatal`, as in struct mo_store_config, is called
 * from any thread when the process must end (a failed write). On failure, closes what was opened,
 * fills `message` and returns the exit status. */
int service_start(const struct settings *settings, void (*fatal)(void *context, const char *what),
                  struct service **service, struct mo_message *message);

/* Returns the number of listeners and their addresses: "http://127.0.0.1:8765" or "unix:/path".
 * of_fleet: counts the listeners of the server for workers; 0 if there is no such server. */
size_t service_addresses(const struct service *service, bool of_fleet,
                         const char *const **addresses);

/* Rereads the token file. */
int service_reload_tokens(struct service *service, const struct settings *settings,
                          struct mo_message *message);

/* Accepts no new jobs from now on. */
void service_drain(struct service *service);
/* Returns whether no evaluation is being computed. A stop waits for evaluations. Training runs and
 * campaigns would take hours, so a stop parks them at once. */
bool service_is_idle(struct service *service);
bool service_is_learning(struct service *service);

/* Returns whether scheduler, writer and HTTP each completed a round within `limit_us`. *who is the
 * name of one of them that did not. */
bool service_is_alive(struct service *service, int64_t limit_us, const char **who);

/* Parks running jobs, answers waiting requests, and closes everything. */
void service_stop(struct service *service);

/* Logs how many jobs were deleted by age since the last call, and warns if the clock is not
 credible.
 */
void service_report_expiry(struct service *service);
/* Writes a short summary of the activity, for STATUS= and the log. */
void service_describe(struct service *service, char *text, size_t capacity);

#endif
