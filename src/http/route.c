/* route.c: see route.h. */
#include "http/route.h"

#include <stdio.h>
#include <string.h>

#include "http/field.h"

const struct mo_route_info mo_routes[MO_ROUTES] = {
    [MO_ROUTE_NONE] = {"other", 0, false, true},
    [MO_ROUTE_EVALUATIONS] = {"/v1/evaluations", MO_POST, false, false},
    [MO_ROUTE_EVALUATION] = {"/v1/evaluations/{id}", MO_GET, false, false},
    [MO_ROUTE_TRAJECTORY] = {"/v1/evaluations/{id}/trajectories/{n}", MO_GET, false, false},
    [MO_ROUTE_TRAININGS] = {"/v1/trainings", MO_GET | MO_POST, false, false, true},
    [MO_ROUTE_TRAINING] = {"/v1/trainings/{id}", MO_GET, false, false},
    [MO_ROUTE_TRAINING_STEPS] = {"/v1/trainings/{id}/steps", MO_GET, false, false, true},
    [MO_ROUTE_TRAINING_VALIDATIONS] = {"/v1/trainings/{id}/validations", MO_GET, false, false,
                                       true},
    [MO_ROUTE_TRAINING_CHECKPOINTS] = {"/v1/trainings/{id}/checkpoints", MO_GET | MO_DELETE, false,
                                       false, true},
    [MO_ROUTE_TRAINING_CHECKPOINT] = {"/v1/trainings/{id}/checkpoints/{step}", MO_DELETE, false,
                                      false},
    [MO_ROUTE_TRAINING_CONTROLLER] = {"/v1/trainings/{id}/controller", MO_GET, false, false},
    [MO_ROUTE_TRAINING_HELD_OUT] = {"/v1/trainings/{id}/held-out", MO_GET, false, false, true},
    [MO_ROUTE_HELD_OUT] = {"/v1/held-out", MO_GET, false, false, true},
    [MO_ROUTE_CAMPAIGNS] = {"/v1/campaigns", MO_GET | MO_POST, false, false, true},
    [MO_ROUTE_CAMPAIGN] = {"/v1/campaigns/{id}", MO_GET, false, false},
    [MO_ROUTE_CAMPAIGN_PAUSE] = {"/v1/campaigns/{id}/pause", MO_POST, false, false},
    [MO_ROUTE_CAMPAIGN_RESUME] = {"/v1/campaigns/{id}/resume", MO_POST, false, false},
    [MO_ROUTE_CAMPAIGN_CANCEL] = {"/v1/campaigns/{id}/cancel", MO_POST, false, false},
    [MO_ROUTE_CAMPAIGN_EXTEND] = {"/v1/campaigns/{id}/extend", MO_POST, false, false},
    [MO_ROUTE_CAMPAIGN_GENERATIONS] = {"/v1/campaigns/{id}/generations", MO_GET, false, false,
                                       true},
    [MO_ROUTE_CAMPAIGN_LEARNING] = {"/v1/campaigns/{id}/learning", MO_GET, false, false, true},
    [MO_ROUTE_CAMPAIGN_REPLICATES] = {"/v1/campaigns/{id}/replicates", MO_GET, false, false, true},
    [MO_ROUTE_CAMPAIGN_POPULATION] = {"/v1/campaigns/{id}/population", MO_GET, false, false, true},
    [MO_ROUTE_CAMPAIGN_DESIGN] = {"/v1/campaigns/{id}/designs/{number}", MO_GET, false, false},
    [MO_ROUTE_CAMPAIGN_ANCESTORS] = {"/v1/campaigns/{id}/designs/{number}/ancestors", MO_GET, false,
                                     false, true},
    [MO_ROUTE_CAMPAIGN_DESCENDANTS] = {"/v1/campaigns/{id}/designs/{number}/descendants", MO_GET,
                                       false, false, true},
    [MO_ROUTE_CAMPAIGN_PHYLOGENY] = {"/v1/campaigns/{id}/phylogeny", MO_GET, false, false, true},
    [MO_ROUTE_CAMPAIGN_CHAMPIONS] = {"/v1/campaigns/{id}/champions", MO_GET | MO_POST, false, false,
                                     true},
    [MO_ROUTE_CAMPAIGN_CHECKPOINTS] = {"/v1/campaigns/{id}/checkpoints", MO_GET | MO_DELETE, false,
                                       false, true},
    [MO_ROUTE_JOBS] = {"/v1/jobs", MO_GET, false, false, true},
    [MO_ROUTE_JOB] = {"/v1/jobs/{id}", MO_GET | MO_DELETE, false, false},
    [MO_ROUTE_JOB_PAUSE] = {"/v1/jobs/{id}/pause", MO_POST, false, false},
    [MO_ROUTE_JOB_RESUME] = {"/v1/jobs/{id}/resume", MO_POST, false, false},
    [MO_ROUTE_JOB_WEIGHT] = {"/v1/jobs/{id}/weight", MO_POST, false, false},
    [MO_ROUTE_DESIGNS] = {"/v1/designs", MO_GET, false, false, true},
    [MO_ROUTE_DESIGN] = {"/v1/designs/{id}", MO_GET, false, false},
    [MO_ROUTE_CONTROLLERS] = {"/v1/controllers", MO_GET, false, false, true},
    [MO_ROUTE_CONTROLLER] = {"/v1/controllers/{name}", MO_GET | MO_PUT | MO_DELETE, false, false},
    [MO_ROUTE_EVENTS] = {"/v1/events", MO_GET, false, false, true},
    [MO_ROUTE_WORKERS] = {"/v1/workers", MO_GET, false, true},
    [MO_ROUTE_DEVICES] = {"/v1/devices", MO_GET, false, true},
    [MO_ROUTE_HEALTH] = {"/healthz", MO_GET, true, true},
    [MO_ROUTE_READY] = {"/readyz", MO_GET, true, true},
    [MO_ROUTE_METRICS] = {"/metrics", MO_GET, false, true},
    [MO_ROUTE_OPENAPI] = {"/openapi.json", MO_GET, true, true},
    [MO_ROUTE_INDEX] = {"/", MO_GET, true, true},
};

static const struct {
  const char *name;
  enum mo_method method;
} methods[] = {{"GET", MO_GET}, {"HEAD", MO_HEAD},     {"POST", MO_POST},
               {"PUT", MO_PUT}, {"DELETE", MO_DELETE}, {"OPTIONS", MO_OPTIONS}};

enum mo_method mo_method_of(const char *name)
{
  for (size_t i = 0; i < sizeof(methods) / sizeof(methods[0]); i++)
    if (strcmp(name, methods[i].name) == 0)
      return methods[i].method;
  return MO_OTHER_METHOD;
}

static bool matches(const char *pattern, const char *path, size_t size,
                    char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES])
{
  size_t at = 0, parameter = 0;
  while (*pattern != '\0') {
    /* Both must be at a slash. */
    if (at >= size || path[at] != '/')
      return false;
    pattern++, at++;
    size_t wanted = strcspn(pattern, "/");
    size_t given = 0;
    while (at + given < size && path[at + given] != '/')
      given++;
    if (*pattern == '{') {
      if (given == 0 || !mo_percent_decode(path + at, given, false, parameters[parameter],
                                           MO_PATH_PARAMETER_BYTES))
        return false;
      parameter++;
    } else if (wanted != given || memcmp(pattern, path + at, given) != 0) {
      return false;
    }
    pattern += wanted;
    at += given;
  }
  return at == size;
}

enum mo_route mo_route_find(const char *path, size_t size,
                            char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES])
{
  for (enum mo_route route = MO_ROUTE_NONE + 1; route < MO_ROUTES; route++)
    if (matches(mo_routes[route].path, path, size, parameters))
      return route;
  return MO_ROUTE_NONE;
}

void mo_route_allow(enum mo_route route, char allow[64])
{
  size_t at = 0;
  unsigned allowed = mo_routes[route].methods | MO_OPTIONS;
  if (allowed & MO_GET)
    allowed |= MO_HEAD;
  for (size_t i = 0; i < sizeof(methods) / sizeof(methods[0]); i++)
    if (allowed & (unsigned)methods[i].method)
      at += (size_t)snprintf(allow + at, 64 - at, "%s%s", at > 0 ? ", " : "", methods[i].name);
}
