/* api.h: the HTTP interface of the service (schema/openapi.yaml is its contract): jobs, designs,
 * controllers, events, and the state of the service, on top of the HTTP room. */
#ifndef MORPHO_API_API_H
#define MORPHO_API_API_H

#include "http/http.h"

struct mo_store;
struct mo_jobs;
struct mo_compute;
struct mo_fleet;
struct mo_api;

/* Whether the dashboard is served, and whether it offers actions that change something. */
enum mo_dashboard { MO_DASHBOARD_ON, MO_DASHBOARD_READ_ONLY, MO_DASHBOARD_OFF };
extern const char *const mo_dashboard_words[]; /* "on", "read-only", "off", NULL */

/* What the routes use. All of it must outlive the interface. */
struct mo_api_services {
  struct mo_store *store;
  struct mo_jobs *jobs;
  struct mo_compute *compute;
  const char *version;           /* "0.1.0" */
  uint64_t (*log_dropped)(void); /* nullable: number of log lines that were dropped, for /metrics */
  enum mo_dashboard dashboard;
};

/* Starts the server. Returns the errors of mo_http_start. */
int mo_api_start(const struct mo_http_config *config, const struct mo_api_services *services,
                 struct mo_api **api, struct mo_message *message);
struct mo_http *mo_api_http(struct mo_api *api);
/* Starts the server for workers, which has its own sockets, tokens and limits. Returns the errors
 * of mo_http_start. */
struct mo_api_fleet {
  struct mo_fleet *fleet; /* must outlive the interface */
  uint64_t epoch;         /* as in its configuration */
  const char *compute;    /* the setting `compute`: "both", "local" or "fleet" */
};
int mo_api_start_fleet(struct mo_api *api, const struct mo_http_config *config,
                       const struct mo_api_fleet *fleet, struct mo_message *message);
struct mo_http *mo_api_fleet_http(struct mo_api *api); /* NULL: no server for workers */
/* Wakes the waiting requests of a session. It is a callback in the configuration of the fleet. */
void mo_api_wake_session(struct mo_api *api, uint64_t session);
/* Stops both servers, as mo_http_stop does. */
void mo_api_stop(struct mo_api *api, uint32_t grace_ms);

#endif
