/* fleet.h: the server for workers of other machines (setting fleet_listen). */
#ifndef MORPHOD_FLEET_H
#define MORPHOD_FLEET_H

#include "api/api.h"
#include "daemon/settings.h"
#include "daemon/sockets.h"

/* Who computes the scores of batch jobs: the setting compute. */
enum fleet_compute { COMPUTE_BOTH, COMPUTE_LOCAL, COMPUTE_FLEET };

/* The texts of fleet_certificate and fleet_key. */
struct fleet_certificate {
  char *certificate, *key;
};
/* Reads both and checks that they fit; leaves NULL where they are not set. MO_ERR_INVALID: the
 * message names the setting; MO_ERR_NO_MEMORY. On failure there is nothing to free. */
int fleet_certificate_read(const struct settings *settings, struct fleet_certificate *pair,
                           struct mo_message *message);
/* Wipes and frees the texts. */
void fleet_certificate_free(struct fleet_certificate *pair);

/* Starts the server of workers, if fleet_listen names an address. log: as in mo_http_config. The
 * sockets are handed over. MO_ERR_INVALID, and errors of mo_http_start. */
int fleet_start(const struct settings *settings, struct sockets *sockets, struct mo_api *api,
                void (*log)(void *context, const struct mo_http_log_entry *entry),
                struct mo_message *message);

/* Descriptors that the server of workers may need; 0: there is none. */
uint32_t fleet_max_connections(const struct settings *settings);

#endif
