/* handlers.h: what the files of this room share: the interface's state, and the handlers, which run
 * on API threads, or on I/O threads where their route is direct. */
#ifndef MORPHO_API_HANDLERS_H
#define MORPHO_API_HANDLERS_H

#include "api/api.h"
#include "base/text.h"
#include "http/field.h"
#include "http/query.h"
#include "http/reply.h"
#include "jobs/jobs.h"

struct mo_api {
  struct mo_store *store;
  struct mo_jobs *jobs;
  struct mo_compute *compute;
  struct mo_http *http;
  struct mo_lattice *lattice;
  char version[32];
  char contract_tag[MO_SHA256_DIGITS + 1]; /* of openapi.json */
  uint64_t (*log_dropped)(void);
  int listener; /* the subscription to the store's events; −1: none */
  _Atomic uint64_t jobs_by_state[MO_JOB_STATES];
  atomic_bool jobs_changed;
};

/* Returns the interface that a request is for. */
static inline struct mo_api *mo_api_of(const struct mo_request *request)
{
  return mo_http_context(request);
}

#define ROUTE(PATH, METHOD, HANDLER, FLAGS, BODY, QUERY)                                           \
  void mo_api_##HANDLER(struct mo_request *request);
#include "api/routes.inc"

/* Follow the store's events (events.c): streams, waiting requests, counts of jobs. */
int mo_events_follow(struct mo_api *api);
void mo_events_leave(struct mo_api *api);

void mo_api_metrics_write(struct mo_api *api, struct mo_text *text);

#endif
