/* environments.c: the environments given to a training run in place of those that it would draw: in
 * its state, and as bytes in its checkpoints and in its controller's lineage. */
#include "learning/internal.h"

#include <stdlib.h>
#include <string.h>

#include "world/environment.h"

int mo_training_allocate_environments(struct mo_training *training, uint32_t n)
{
  struct mo_environment *environments = calloc(n, sizeof(*environments));
  if (environments == NULL)
    return MO_ERR_NO_MEMORY;
  mo_environments_free(training->environments, training->n_environments);
  training->environments = environments;
  training->n_environments = n;
  return MO_OK;
}

static int set(struct mo_training *training, const struct mo_environment *environments, uint32_t n,
               bool draws_worlds)
{
  if (n < 1 || n > MO_TRAINING_ENVIRONMENTS_MAX)
    return MO_ERR_RANGE;
  if (training->step > 0 || training->lattice != NULL) /* the first draw makes the lattice */
    return MO_ERR_CONFLICT;
  const int r = mo_training_allocate_environments(training, n);
  if (r == MO_OK) {
    memcpy(training->environments, environments, n * sizeof(*environments));
    mo_environments_hold(training->environments, n);
    training->draws_worlds = draws_worlds;
  }
  return r;
}

int mo_training_set_environments(struct mo_training *training,
                                 const struct mo_environment *environments, uint32_t n)
{
  return set(training, environments, n, false);
}

int mo_training_set_tasks(struct mo_training *training, const struct mo_environment *tasks,
                          uint32_t n)
{
  return set(training, tasks, n, true);
}

void mo_training_give_task(const struct mo_environment *tasked, struct mo_environment *environment)
{
  environment->task = tasked->task;
  if (tasked->task.guide.kind != MO_GUIDE_FIXED)
    memcpy(environment->light_xy_m, tasked->light_xy_m, sizeof(environment->light_xy_m));
}

void mo_held_out_tasks(uint64_t seed, uint32_t n, const struct mo_environment *tasks,
                       uint32_t n_tasks, struct mo_environment *environments)
{
  mo_held_out_environments(seed, n, environments);
  for (uint32_t i = 0; i < n && n_tasks > 0; i++)
    mo_training_give_task(&tasks[i % n_tasks], &environments[i]);
}

const struct mo_environment *mo_training_environments(const struct mo_training *training,
                                                      uint32_t *n)
{
  *n = training->n_environments;
  return training->environments;
}

/* ---- as bytes ---- */

unsigned mo_training_environments_version(const struct mo_training *training)
{
  unsigned version = 1;
  for (uint32_t k = 0; k < training->n_environments; k++) {
    const unsigned own = mo_environment_version(&training->environments[k]);
    version = own > version ? own : version;
  }
  return version;
}

size_t mo_training_environments_bytes(const struct mo_training *training, unsigned version)
{
  size_t size = 0;
  for (uint32_t k = 0; k < training->n_environments; k++)
    size += mo_environment_packed_bytes(&training->environments[k], version);
  return size;
}

void mo_training_environments_pack(const struct mo_training *training, unsigned version,
                                   uint8_t *bytes)
{
  for (uint32_t k = 0; k < training->n_environments; k++) {
    mo_environment_pack(&training->environments[k], version, bytes);
    bytes += mo_environment_packed_bytes(&training->environments[k], version);
  }
}

int mo_training_environments_unpack(struct mo_training *training, unsigned version,
                                    const uint8_t *bytes, size_t size, size_t *used)
{
  *used = 0;
  for (uint32_t k = 0; k < training->n_environments; k++) {
    struct mo_environment *environment = &training->environments[k];
    size_t own = 0;
    const int r = mo_environment_unpack(version, bytes + *used, size - *used, environment, &own);
    if (r != MO_OK)
      return r;
    if (mo_environment_check(environment, NULL) != MO_OK)
      return MO_ERR_FORMAT;
    *used += own;
  }
  return mo_training_environments_version(training) == version ? MO_OK : MO_ERR_FORMAT;
}
