/* api.c: see api.h. */
#include "api/api.h"

#include <stdio.h>
#include <stdlib.h>

#include "api/atlas_json.h"
#include "api/openapi.h"
#include "base/clock.h"
#include "fleet/fleet.h"

#define FLEET_TICK_MS 20

/* ---- routes ---- */

static const struct mo_route table[] = {
#define ROUTE(PATH, METHOD, HANDLER, RIGHT, FLAGS, BODY, QUERY)                                    \
  {PATH, MO_##METHOD, mo_api_##HANDLER, MO_RIGHT_##RIGHT, FLAGS, MO_BODY_##BODY, QUERY},
#define TABLE(PATH, HANDLER, QUERY, COLUMNS)                                                       \
  {PATH,          MO_GET, mo_api_get_table, MO_RIGHT_READ, MO_ROUTE_LIST | MO_ROUTE_VARY,          \
   MO_BODY_SMALL, QUERY},
#define HEAVY_TABLE(PATH, HANDLER, QUERY, COLUMNS)                                                 \
  {PATH,          MO_GET, mo_api_get_table, MO_RIGHT_READ, MO_ROUTE_HEAVY | MO_ROUTE_VARY,         \
   MO_BODY_SMALL, QUERY},
#include "api/routes.inc"
};
_Static_assert(sizeof(table) / sizeof(table[0]) <= MO_ROUTES_MAX, "metrics count by route");

static const struct mo_route fleet_table[] = {
#define ROUTE(PATH, METHOD, HANDLER, RIGHT, FLAGS, BODY, QUERY)                                    \
  {PATH, MO_##METHOD, mo_api_##HANDLER, MO_RIGHT_##RIGHT, FLAGS, MO_BODY_##BODY, QUERY},
#include "api/fleet_routes.inc"
};

static const struct mo_routes routes = {table, sizeof(table) / sizeof(table[0])};

/* ---- start and stop ---- */

static void count_jobs(struct mo_api *api)
{
  uint64_t counts[MO_JOB_STATES];
  if (atomic_exchange(&api->jobs_changed, false) &&
      mo_store_job_counts(api->store, counts) == MO_OK)
    for (int state = 0; state < MO_JOB_STATES; state++)
      atomic_store(&api->jobs_by_state[state], counts[state]);
}

static int start(void *context, struct mo_http *http)
{
  struct mo_api *api = context;
  api->http = http;
  return mo_events_follow(api);
}

static void tick(void *context)
{
  count_jobs(context);
  mo_load_sample(context);
}

static void stop(void *context)
{
  mo_events_leave(context);
}

static void destroy(struct mo_api *api)
{
  mo_body_stream_free(api->random_stream.stream);
  mo_atlas_library_free(&api->atlases);
  free(api);
}

int mo_api_start(const struct mo_http_config *config, const struct mo_api_services *services,
                 struct mo_api **ret, struct mo_message *message)
{
  struct mo_api *api = calloc(1, sizeof(*api));
  const struct mo_http_service service = {
      .routes = routes, .context = api, .start = start, .tick = tick, .stop = stop};
  struct mo_sha256 contract;
  if (api == NULL) {
    mo_http_refuse_listeners(config);
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory for the server");
  }
  *api = (struct mo_api){.store = services->store,
                         .jobs = services->jobs,
                         .compute = services->compute,
                         .lattice = mo_jobs_lattice(services->jobs),
                         .log_dropped = services->log_dropped,
                         .dashboard = services->dashboard,
                         .listener = -1,
                         .load.mutex = PTHREAD_MUTEX_INITIALIZER,
                         .random_stream.mutex = PTHREAD_MUTEX_INITIALIZER,
                         .jobs_changed = true};
  mo_atlas_library_init(&api->atlases, services->store, mo_atlas_write_description);
  snprintf(api->version, sizeof(api->version), "%s",
           services->version != NULL ? services->version : "");
  mo_sha256_of(mo_openapi_json, mo_openapi_json_size, &contract);
  mo_sha256_to_hex(&contract, api->contract_tag);
  count_jobs(api);
  int error = mo_http_start(config, &service, &api->http, message);
  if (error != MO_OK)
    destroy(api);
  else
    *ret = api;
  return error;
}

static int start_fleet(void *context, struct mo_http *http)
{
  atomic_store(&((struct mo_api *)context)->fleet_http, http);
  return MO_OK;
}

static void tick_fleet(void *context)
{
  struct mo_api *api = context;
  mo_fleet_tick(atomic_load(&api->fleet), mo_clock_ns());
}

int mo_api_start_fleet(struct mo_api *api, const struct mo_http_config *config,
                       const struct mo_api_fleet *fleet, struct mo_message *message)
{
  const struct mo_http_service service = {
      .routes = {fleet_table, sizeof(fleet_table) / sizeof(fleet_table[0])},
      .context = api,
      .start = start_fleet,
      .tick = tick_fleet,
      .tick_ms = FLEET_TICK_MS};
  struct mo_http *http = NULL;
  api->fleet_epoch = fleet->epoch;
  api->fleet_compute = fleet->compute;
  atomic_store(&api->fleet, fleet->fleet);
  const int error = mo_http_start(config, &service, &http, message);
  if (error != MO_OK) /* the failed start has freed it */
    atomic_store(&api->fleet_http, NULL);
  return error;
}

struct mo_http *mo_api_fleet_http(struct mo_api *api)
{
  return atomic_load(&api->fleet_http);
}

struct mo_http *mo_api_http(struct mo_api *api)
{
  return api->http;
}

void mo_api_stop(struct mo_api *api, uint32_t grace_ms)
{
  if (api == NULL)
    return;
  mo_http_stop(atomic_load(&api->fleet_http), grace_ms);
  mo_http_stop(api->http, grace_ms);
  destroy(api);
}
