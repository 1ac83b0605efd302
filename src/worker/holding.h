/* holding.h: the leases that a worker holds, their blocks in its back end, and their results.
 *
 * Only one thread may call these functions. Blocks are submitted in the order of the leases, a few
 * more than the number of workers, by the threads that finish other blocks. Therefore, the first
 * lease finishes first, while the next one keeps all workers busy. A separate thread computes each
 * gradient shard and waits for the workers. */
#ifndef MORPHO_WORKER_HOLDING_H
#define MORPHO_WORKER_HOLDING_H

#include "fleet/wire.h"

struct mo_holding_config {
  struct mo_compute *compute;
  void (*ended)(void *context); /* a lease has ended; called on any thread */
  void *context;
};

struct mo_holding;
int mo_holding_create(const struct mo_holding_config *config, struct mo_holding **holding);
/* Cancels all leases and waits until they have ended. NULL-safe; call it before mo_compute_free. */
void mo_holding_free(struct mo_holding *holding);
/* Sets the workspace of later leases, and drops leases of other workspaces. MO_ERR_NO_MEMORY,
 * MO_ERR_LIMIT.
 */
int mo_holding_set_workspace(struct mo_holding *holding, struct mo_workspace workspace);

/* Takes ownership of a lease and its arrays. MO_ERR_LIMIT: MO_HELD_LEASES_MAX are already held;
 * MO_ERR_NO_MEMORY: the lease still belongs to the caller. */
#define MO_HELD_LEASES_MAX 8
int mo_holding_add(struct mo_holding *holding, struct mo_wire_lease *lease);
/* Starts the leases that have their weights in memory. Returns whether a lease lacks its weights;
 * *hash: the hash of these weights. */
bool mo_holding_start(struct mo_holding *holding, struct mo_sha256 *hash);
/* Adds weights. Errors as in mo_kept_weights_add. */
int mo_holding_add_weights(struct mo_holding *holding, const struct mo_sha256 *hash,
                           const uint8_t *bytes, size_t size, struct mo_message *message);
/* Returns the leases that wait for these weights to the daemon. */
void mo_holding_miss_weights(struct mo_holding *holding, const struct mo_sha256 *hash);

/* Ends a lease without a result; id NULL: all. */
void mo_holding_drop(struct mo_holding *holding, const struct mo_lease_id *id);
/* Returns the leases that have not started any block to the daemon. all: also returns leases that
 * are running. */
void mo_holding_give_back(struct mo_holding *holding, bool all);

/* Moves finished leases into a message, each lease once. A gradient gets its own message. Frees
 * dropped leases. */
void mo_holding_take_results(struct mo_holding *holding, struct mo_wire_results *results);

struct mo_holding_status {
  uint32_t n_leases[2]; /* by enum mo_back_end: computing or waiting */
  uint32_t n_results;   /* finished leases, not taken yet */
  uint64_t rows_done, leases_done;
};
void mo_holding_get_status(struct mo_holding *holding,
                           struct mo_holding_status *status); /* any thread */

#endif
