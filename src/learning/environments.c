/* environments.c: the environments that a training was given, in place of those that it would draw:
 * kept in the training, and as bytes for its checkpoints and its controller's lineage. */
#include "learning/internal.h"

#include <stdlib.h>
#include <string.h>

#include "world/environment.h"

int mo_training_allocate_environments(struct mo_training *training, uint32_t n)
{
  struct mo_environment *environments = calloc(n, sizeof(*environments));
  if (environments == NULL)
    return MO_ERR_NO_MEMORY;
  free(training->environments);
  training->environments = environments;
  training->n_environments = n;
  return MO_OK;
}

int mo_training_set_environments(struct mo_training *training,
                                 const struct mo_environment *environments, uint32_t n)
{
  if (n < 1 || n > MO_TRAINING_ENVIRONMENTS_MAX)
    return MO_ERR_RANGE;
  if (training->step > 0 || training->lattice != NULL) /* the first draw makes the lattice */
    return MO_ERR_CONFLICT;
  const int r = mo_training_allocate_environments(training, n);
  if (r == MO_OK)
    memcpy(training->environments, environments, n * sizeof(*environments));
  return r;
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
  return training->n_environments * mo_fields_packed_bytes(&mo_environment_fields, version);
}

void mo_training_environments_pack(const struct mo_training *training, unsigned version,
                                   uint8_t *bytes)
{
  const size_t size = mo_fields_packed_bytes(&mo_environment_fields, version);
  for (uint32_t k = 0; k < training->n_environments; k++)
    mo_fields_pack(&mo_environment_fields, version, &training->environments[k], bytes + k * size);
}

int mo_training_environments_unpack(struct mo_training *training, unsigned version,
                                    const uint8_t *bytes)
{
  const size_t size = mo_fields_packed_bytes(&mo_environment_fields, version);
  for (uint32_t k = 0; k < training->n_environments; k++) {
    struct mo_environment *environment = &training->environments[k];
    *environment = mo_environment_defaults;
    if (!mo_fields_unpack(&mo_environment_fields, version, bytes + k * size, environment) ||
        mo_environment_check(environment, NULL) != MO_OK)
      return MO_ERR_FORMAT;
  }
  return mo_training_environments_version(training) == version ? MO_OK : MO_ERR_FORMAT;
}
