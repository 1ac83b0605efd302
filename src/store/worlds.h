/* worlds.h: the environments and physics that scores refer to by hash. Threads and errors as in
 * store.h. */
#ifndef MORPHO_STORE_WORLDS_H
#define MORPHO_STORE_WORLDS_H

#include "store/records.h"

struct mo_store;

/* The caller drops the environment's grid (mo_environments_drop). MO_ERR_NOT_FOUND: nothing with
 * this hash is stored. */
int mo_store_environment(struct mo_store *store, const struct mo_sha256 *sha256,
                         struct mo_environment *environment);
int mo_store_physics(struct mo_store *store, const struct mo_sha256 *sha256,
                     struct mo_physics *physics, enum mo_precision *precision,
                     enum mo_sensor *sensor);
/* Reads the environments of a named set, or of a job, in order. *environments: (n), which the
 * caller frees with mo_environments_free. MO_ERR_NOT_FOUND: also for a training run that draws its
 * environments.
 */
int mo_store_environment_set(struct mo_store *store, const char *name,
                             struct mo_environment **environments, uint32_t *n);
int mo_store_job_environments(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                              struct mo_environment **environments, uint32_t *n);

#endif
