/* weights.h: the controllers that leases refer to by hash; the last few stay in memory. For one
 * thread. */
#ifndef MORPHO_WORKER_WEIGHTS_H
#define MORPHO_WORKER_WEIGHTS_H

#include <morpho/compute.h>

#include "base/sha256.h"

#define MO_WEIGHTS_KEPT 8

struct mo_kept_weights {
  struct mo_compute *compute;
  uint64_t takes;
  struct mo_kept {
    struct mo_sha256 hash;
    struct mo_controller *controller;       /* NULL: passive bodies */
    struct mo_compute_controller *prepared; /* NULL: free */
    uint32_t users;
    uint64_t used;          /* when it was last taken, counted in takes */
  } items[MO_WEIGHTS_KEPT]; /* the first: passive bodies */
};
int mo_kept_weights_init(struct mo_kept_weights *weights, struct mo_compute *compute);
void mo_kept_weights_clear(struct mo_kept_weights *weights); /* call it once no block uses a
                                                                controller any longer */

/* Adds the bytes of a controller's file. MO_ERR_CORRUPT: they do not have this hash; MO_ERR_FORMAT,
 * MO_ERR_LIMIT: they are not a controller for this workspace; MO_ERR_EXHAUSTED: all kept
 * controllers are in use; MO_ERR_NO_MEMORY. */
int mo_kept_weights_add(struct mo_kept_weights *weights, const struct mo_sha256 *hash,
                        struct mo_workspace workspace, const uint8_t *bytes, size_t size,
                        struct mo_message *message);
/* Returns a controller, to be released after its last block, or NULL if it must be added first. A
 * hash of zeros, for passive bodies, is always available. */
struct mo_compute_controller *mo_kept_weights_take(struct mo_kept_weights *weights,
                                                   const struct mo_sha256 *hash);
void mo_kept_weights_release(struct mo_kept_weights *weights,
                             const struct mo_compute_controller *controller);

#endif
