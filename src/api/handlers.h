/* handlers.h: shared by the files of this room: the interface's state, and the handlers, which run
 * on API threads, or on I/O threads if their route is direct. */
#ifndef MORPHO_API_HANDLERS_H
#define MORPHO_API_HANDLERS_H

#include "api/api.h"
#include "api/atlas_library.h"
#include "base/text.h"
#include "http/field.h"
#include "http/query.h"
#include "http/reply.h"
#include "jobs/jobs.h"

#define MO_LOAD_SAMPLES 360
struct mo_load_sample {
  int64_t at_us;
  double busy_share, device_share, rollouts_per_s; /* device_share NaN: no devices */
};
struct mo_load {
  pthread_mutex_t mutex; /* of samples and n */
  struct mo_load_sample samples[MO_LOAD_SAMPLES];
  uint64_t n; /* ever added; the newest is samples[(n − 1) % MO_LOAD_SAMPLES] */
  int64_t sampled_us;
  double busy_s; /* at the newest sample */
  uint64_t rollouts;
};

/* The stream of random bodies that the latest request read. It is kept so that a request for the
 * bodies that follow does not draw all earlier ones again. */
struct mo_random_stream {
  pthread_mutex_t mutex;
  struct mo_body_stream *stream; /* NULL: no stream, or a request is using it */
  uint64_t seed;
  uint32_t next; /* the number of its next body */
};

struct mo_api {
  struct mo_store *store;
  struct mo_jobs *jobs;
  struct mo_compute *compute;
  struct mo_http *http;                 /* for clients */
  _Atomic(struct mo_http *) fleet_http; /* for workers; NULL: none */
  _Atomic(struct mo_fleet *) fleet;     /* NULL: none */
  uint64_t fleet_epoch;
  const char *fleet_compute;
  const struct mo_lattice *lattice; /* of `jobs` */
  char version[32];
  char contract_tag[MO_SHA256_DIGITS + 1]; /* of openapi.json */
  uint64_t (*log_dropped)(void);
  enum mo_dashboard dashboard;
  int listener; /* the subscription to the store's events; −1: none */
  _Atomic uint64_t jobs_by_state[MO_JOB_STATES];
  atomic_bool jobs_changed;
  struct mo_load load;
  struct mo_random_stream random_stream;
  struct mo_atlas_library atlases;
};

/* Returns the interface that a request is for. */
static inline struct mo_api *mo_api_of(const struct mo_request *request)
{
  return mo_http_context(request);
}

#define ROUTE(PATH, METHOD, HANDLER, RIGHT, FLAGS, BODY, QUERY)                                    \
  void mo_api_##HANDLER(struct mo_request *request);
#include "api/routes.inc"
#define ROUTE(PATH, METHOD, HANDLER, RIGHT, FLAGS, BODY, QUERY)                                    \
  void mo_api_##HANDLER(struct mo_request *request);
#include "api/fleet_routes.inc"
void mo_api_get_table(struct mo_request *request); /* for all lists: calls the handler that makes
                                                      the pages */

/* Reads the parameter `class` (designs.c); NULL: not given. Returns false if it has replied. */
bool mo_query_class(struct mo_request *request, const char **class);

/* The topic of a request that waits for the pending batch of a study, not for the end of the job.
 */
#define MO_WAIT_BATCH(id) ((id) + (INT64_C(1) << 62))

/* Follow the store's events (events.c): streams, waiting requests, counts of jobs. */
int mo_events_follow(struct mo_api *api);
void mo_events_leave(struct mo_api *api);

void mo_load_sample(struct mo_api *api);
void mo_api_metrics_write(struct mo_api *api, struct mo_text *text);

#endif
