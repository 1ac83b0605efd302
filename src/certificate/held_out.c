/* held_out.c: the fresh worlds of the axis `held_out`.
 *
 * They must be of the base's kind, or the axis would compare two tasks. A set of the suite has a
 * held-out set. The only other worlds that can be drawn are training worlds, so a list has fresh
 * worlds only if each of its own worlds could be a training world. A list with level ground,
 * profiles or lights at other distances has none, because it is unknown which other worlds its
 * author would have chosen. */
#include "certificate/held_out.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include <morpho/learning.h>

#include "base/words.h"

/* Same as in training worlds (world/environments.c). */
#define LIGHT_NEAR_M 0.4
#define LIGHT_FAR_M  2.0
#define ROUGHEST_M   0.13 /* standard deviation of 64 heights; their σ is below 0.1 m */
#define ROUNDED_M    1e-6 /* numbers of a list may have been rounded */

static const char held_out_suffix[] = "-held-out";

/* Returns the number of the held-out set of the base's set; −1: none. */
static int fresh_set(const char *set)
{
  const size_t size = strlen(set);
  for (int i = 0; mo_set_words[i] != NULL; i++)
    if (strncmp(mo_set_words[i], set, size) == 0 &&
        strcmp(mo_set_words[i] + size, held_out_suffix) == 0)
      return i;
  return -1;
}

static bool is_paper_test(const char *set)
{
  return strcmp(set, mo_set_words[0]) == 0;
}

/* Returns whether heights could be drawn for training. */
static bool is_rough(const double heights_m[MO_TERRAIN_HEIGHTS])
{
  double lowest_m = heights_m[0], sum = 0, squares = 0;
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++) {
    lowest_m = fmin(lowest_m, heights_m[k]);
    sum += heights_m[k];
  }
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++) {
    const double off_m = heights_m[k] - sum / MO_TERRAIN_HEIGHTS;
    squares += off_m * off_m;
  }
  const double sigma_m = sqrt(squares / (MO_TERRAIN_HEIGHTS - 1));
  return fabs(lowest_m - MO_TERRAIN_FLOOR_M) <= ROUNDED_M && sigma_m > ROUNDED_M &&
         sigma_m <= ROUGHEST_M;
}

static bool is_in_ring(const double light_xy_m[2])
{
  const double x = light_xy_m[0] - MO_WORLD_CENTER_M, y = light_xy_m[1] - MO_WORLD_CENTER_M;
  const double square = x * x + y * y, near_m = LIGHT_NEAR_M - ROUNDED_M,
               far_m = LIGHT_FAR_M + ROUNDED_M;
  return square >= near_m * near_m && square <= far_m * far_m;
}

static const char *list_refuses(const struct mo_environment *environment)
{
  if (environment->n_profile > 0 || environment->grid != NULL)
    return "fresh terrains can be drawn only for lists with 8 x 8 heights; use a "
           "named set, or list other worlds yourself";
  if (!is_rough(environment->terrain_heights_m))
    return "the terrains of this list are not of the kind that training draws, so no "
           "fresh ones can be drawn; use a named set, or list other worlds yourself";
  if (environment->task.guide.kind == MO_GUIDE_FIXED && !is_in_ring(environment->light_xy_m))
    return "the lights of this list are not 0.4 to 2 m from the center, where training places "
           "them; use a named set, or list other worlds yourself";
  return NULL;
}

const char *mo_fresh_refuses(const struct mo_certificate_base *base)
{
  if (base->set != NULL)
    return is_paper_test(base->set) || fresh_set(base->set) >= 0
               ? NULL
               : "the worlds are already a held-out set, and its suite has no others";
  for (uint32_t k = 0; k < base->n_environments; k++) {
    const char *reason = list_refuses(&base->environments[k]);
    if (reason != NULL)
      return reason;
  }
  return NULL;
}

uint32_t mo_fresh_count(const struct mo_certificate_base *base, uint32_t wanted)
{
  const bool is_set = base->set != NULL && !is_paper_test(base->set);
  return is_set && wanted > MO_SET_ENVIRONMENTS_MAX ? MO_SET_ENVIRONMENTS_MAX : wanted;
}

const char *mo_fresh_kind(const struct mo_certificate_base *base)
{
  if (base->set == NULL)
    return "the fresh worlds are drawn as training draws them, with the tasks, damage, "
           "factors and drops of the list in turn";
  if (is_paper_test(base->set))
    return "the fresh worlds are drawn as training draws them: lights 0.4 to 2 m away, not 1.5 or "
           "2 m";
  return NULL;
}

int mo_fresh_worlds(const struct mo_certificate_base *base, uint64_t seed, uint32_t n,
                    struct mo_environment *environments)
{
  const struct mo_environment *tasks = base->environments;
  if (mo_fresh_refuses(base) != NULL || mo_fresh_count(base, n) < n)
    return MO_ERR_RANGE; /* possible with the settings of an imported campaign */
  if (base->set == NULL) {
    mo_held_out_tasks(seed, n, tasks, base->n_environments, environments);
    for (uint32_t k = 0; k < n; k++) {
      environments[k].damage = tasks[k % base->n_environments].damage;
      environments[k].factors = tasks[k % base->n_environments].factors;
      environments[k].drop_m = tasks[k % base->n_environments].drop_m;
    }
    return MO_OK;
  }
  if (is_paper_test(base->set)) {
    mo_held_out_environments(seed, n, environments);
    return MO_OK;
  }
  struct mo_environment *all = calloc(MO_SET_ENVIRONMENTS_MAX, sizeof(*all));
  if (all == NULL)
    return MO_ERR_NO_MEMORY;
  mo_environment_set(fresh_set(base->set), all);
  memcpy(environments, all, n * sizeof(*all));
  free(all);
  return MO_OK;
}
