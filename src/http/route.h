/* route.h: maps paths and methods to routes. The table is the only list of routes: metrics, Allow
 * and the contract test (tests/api) use it. */
#ifndef MORPHO_HTTP_ROUTE_H
#define MORPHO_HTTP_ROUTE_H

#include <stdbool.h>
#include <stddef.h>

enum mo_method {
  MO_GET = 1 << 0,
  MO_HEAD = 1 << 1,
  MO_POST = 1 << 2,
  MO_PUT = 1 << 3,
  MO_DELETE = 1 << 4,
  MO_OPTIONS = 1 << 5,
  MO_OTHER_METHOD = 0
};

enum mo_route {
  MO_ROUTE_NONE = 0, /* no such path */
  MO_ROUTE_EVALUATIONS,
  MO_ROUTE_EVALUATION,
  MO_ROUTE_TRAJECTORY,
  MO_ROUTE_TRAININGS,
  MO_ROUTE_TRAINING,
  MO_ROUTE_TRAINING_STEPS,
  MO_ROUTE_TRAINING_VALIDATIONS,
  MO_ROUTE_TRAINING_CHECKPOINTS,
  MO_ROUTE_TRAINING_CHECKPOINT,
  MO_ROUTE_TRAINING_CONTROLLER,
  MO_ROUTE_TRAINING_HELD_OUT,
  MO_ROUTE_HELD_OUT,
  MO_ROUTE_CAMPAIGNS,
  MO_ROUTE_CAMPAIGN,
  MO_ROUTE_CAMPAIGN_PAUSE,
  MO_ROUTE_CAMPAIGN_RESUME,
  MO_ROUTE_CAMPAIGN_CANCEL,
  MO_ROUTE_CAMPAIGN_EXTEND,
  MO_ROUTE_CAMPAIGN_GENERATIONS,
  MO_ROUTE_CAMPAIGN_LEARNING,
  MO_ROUTE_CAMPAIGN_REPLICATES,
  MO_ROUTE_CAMPAIGN_POPULATION,
  MO_ROUTE_CAMPAIGN_DESIGN,
  MO_ROUTE_CAMPAIGN_ANCESTORS,
  MO_ROUTE_CAMPAIGN_DESCENDANTS,
  MO_ROUTE_CAMPAIGN_PHYLOGENY,
  MO_ROUTE_CAMPAIGN_CHAMPIONS,
  MO_ROUTE_CAMPAIGN_CHECKPOINTS,
  MO_ROUTE_JOBS,
  MO_ROUTE_JOB,
  MO_ROUTE_JOB_PAUSE,
  MO_ROUTE_JOB_RESUME,
  MO_ROUTE_JOB_WEIGHT,
  MO_ROUTE_DESIGNS,
  MO_ROUTE_DESIGN,
  MO_ROUTE_CONTROLLERS,
  MO_ROUTE_CONTROLLER,
  MO_ROUTE_EVENTS,
  MO_ROUTE_WORKERS,
  MO_ROUTE_DEVICES,
  MO_ROUTE_HEALTH,
  MO_ROUTE_READY,
  MO_ROUTE_METRICS,
  MO_ROUTE_OPENAPI,
  MO_ROUTE_INDEX,
  MO_ROUTES
};

#define MO_PATH_PARAMETERS      2
#define MO_PATH_PARAMETER_BYTES 128

struct mo_route_info {
  const char *path; /* "/v1/jobs/{id}" */
  unsigned methods; /* without HEAD (allowed with GET) and OPTIONS (always allowed) */
  bool open;        /* needs no token */
  bool direct;      /* answered without an API thread */
  bool list; /* GET returns many items: a page, a curve, a population. pool.c limits how many run at
                a time */
};
extern const struct mo_route_info mo_routes[MO_ROUTES];

enum mo_method mo_method_of(const char *name);

/* Finds the route of a path as received; percent escapes are decoded per segment. parameters: the
 * values of {…} in order, NUL-terminated. */
enum mo_route mo_route_find(const char *path, size_t size,
                            char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES]);

/* Writes the methods of a route: "GET, HEAD, OPTIONS". */
void mo_route_allow(enum mo_route route, char allow[64]);

#endif
