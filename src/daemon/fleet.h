/* fleet.h: the server for workers on other machines (setting fleet_listen). */
#ifndef MORPHOD_FLEET_H
#define MORPHOD_FLEET_H

#include "api/api.h"
#include "daemon/settings.h"
#include "daemon/sockets.h"

/* What computes the scores and gradients of batch jobs: the setting `compute`. */
enum fleet_compute { COMPUTE_BOTH, COMPUTE_LOCAL, COMPUTE_FLEET };

/* The texts of fleet_certificate and fleet_key. */
struct fleet_certificate {
  char *certificate, *key;
};
/* Reads both and checks that they match. Leaves NULL if they are not set. MO_ERR_INVALID: the
 * message names the setting; MO_ERR_NO_MEMORY. On failure there is nothing to free. */
int fleet_certificate_read(const struct settings *settings, struct fleet_certificate *pair,
                           struct mo_message *message);
/* Wipes and frees the texts. */
void fleet_certificate_free(struct fleet_certificate *pair);

/* Returns whether workers on other machines are served: fleet_listen has an address, and compute is
 * not local. */
bool fleet_is_on(const struct settings *settings);
/* Returns the number of descriptors that the server for workers may need; 0 if there is no such
 * server. */
uint32_t fleet_max_connections(const struct settings *settings);

struct fleet;
/* Computes the canaries of this machine's classes, which takes a few tenths of a second, and
 * creates the table of sessions and leases. Call it before the first block is submitted. *fleet is
 * NULL if the fleet is off. MO_ERR_NO_MEMORY, MO_ERR_DEVICE. */
int fleet_create(const struct settings *settings, struct mo_store *store,
                 struct mo_compute *compute, struct fleet **fleet, struct mo_message *message);
/* Starts the server for workers, which takes over the sockets. log: as in mo_http_config, with a
 * context that is not NULL. MO_ERR_INVALID, and errors of mo_http_start. */
int fleet_serve(struct fleet *fleet, const struct settings *settings, struct sockets *sockets,
                struct mo_jobs *jobs, struct mo_api *api,
                void (*log)(void *context, const struct mo_http_log_entry *entry),
                struct mo_message *message);
/* Ends the sessions of users who no longer have a token. */
void fleet_end_others(struct fleet *fleet, const struct mo_token *tokens, size_t n);
/* Call it before the server stops. NULL-safe. */
void fleet_retire(struct fleet *fleet);
/* Takes back all leases. Call it after the server has stopped and before the jobs are freed.
 * NULL-safe. */
void fleet_free(struct fleet *fleet);

#endif
