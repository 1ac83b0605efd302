/* shards.h: the shards of a gradient while it is computed, by the workers or by remote takers.
 *
 * The calling thread claims the first unassigned shard and gives its blocks to the workers; remote
 * takers take shards in the same order. Both therefore get work at the rates at which they compute.
 * A taker that finds nothing else takes a shard that the workers are already computing: the first
 * result counts, and the bits are the same. Shards that takers return repeatedly are left to the
 * workers.
 *
 * Shards for absent devices (absent.c) are for takers only.
 *
 * The mutex of the back end's queue guards everything, unless a comment says otherwise. */
#ifndef MORPHO_COMPUTE_SHARDS_H
#define MORPHO_COMPUTE_SHARDS_H

#include "compute/fair.h"

struct mo_shard_result {
  struct mo_gradient_counts counts;
  struct mo_outcome outcomes[MO_GRADIENT_SHARD];
  double d_parameters[]; /* (n_parameters) */
};
/* d_parameters are zeros. Returns NULL if out of memory. */
struct mo_shard_result *mo_shard_result_create(size_t n_parameters);

struct mo_shard {
  struct mo_gradient_batch part; /* constant: its robots, in order */
  bool is_here, is_taken;        /* the workers are computing it; a taker has it */
  uint32_t n_returned;           /* number of times that takers returned it */
  bool is_refused;               /* takers cannot compute it */
  atomic_bool stop;              /* it is done or no longer needed; read anywhere */
  struct mo_shard_result *result;
};

/* The shards of one call. Takers see them while the offer is listed. */
struct mo_offer {
  struct mo_compute *compute;
  enum mo_back_end back_end;
  struct mo_fair *fair;
  struct mo_compute_share *share; /* in this queue; NULL: none */
  const struct mo_gradient_batch *batch;
  struct mo_robot *robots; /* (batch->n) in the order of the shards */
  uint32_t n, n_taken;
  struct mo_shard *items; /* (n) */
  pthread_cond_t changed;
  bool is_listed;
  struct mo_offer *next;
};

/* ---- for the calling thread; these take the mutex ---- */

/* order: (batch->n), as arranged. MO_ERR_NO_MEMORY; MO_ERR_DEVICE: only takers could compute the
 * batch, but it cannot be offered to them. */
int mo_offer_open(struct mo_offer *offer, struct mo_compute *compute, enum mo_back_end back_end,
                  const struct mo_gradient_batch *batch, const uint32_t *order, double weight);
/* Returns the number of the next shard for the workers. MO_ERR_EXHAUSTED: there is none. */
int mo_offer_claim(struct mo_offer *offer);
/* Delivers the workers' result of a shard. If a taker was faster, *result remains the caller's. */
void mo_offer_finish(struct mo_offer *offer, uint32_t number, struct mo_shard_result **result);
/* Takes the result of a shard, which the caller frees. Returns NULL if it is not done yet. */
struct mo_shard_result *mo_offer_collect(struct mo_offer *offer, uint32_t number);
/* Waits for the result of a shard or for any other change, at most 50 ms, because cancellation and
 * the arrival and departure of takers do not wake it. */
void mo_offer_wait(struct mo_offer *offer, uint32_t number);
/* Returns the error of shards that only takers compute. MO_ERR_UNSUPPORTED: takers cannot compute a
 * shard; MO_ERR_DEVICE: takers return a shard repeatedly. */
int mo_offer_error(struct mo_offer *offer);
void mo_offer_stop(struct mo_offer *offer); /* no shard is needed any longer; call it before
                                               close */
/* Waits until takers have returned all shards, and frees the members of the offer. */
void mo_offer_close(struct mo_offer *offer);

/* ---- for takers; under the mutex ---- */

/* Returns the offer with a shard for a taker and with the share that is next, or NULL if there is
 * none. here: looks for a shard that the workers are computing. */
struct mo_offer *mo_offer_next(const struct mo_compute_core *core, enum mo_back_end back_end,
                               bool here);
struct mo_shard *mo_offer_take(struct mo_offer *offer, bool here);
/* Returns a shard from a taker. result: NULL, or consumed. has_failed: takers cannot compute it. */
void mo_offer_return(struct mo_offer *offer, struct mo_shard *shard, bool has_failed,
                     struct mo_shard_result *result);
/* Returns the rollout steps of waiting shards. */
double mo_offers_units(const struct mo_compute_core *core, enum mo_back_end back_end);

static inline bool mo_shard_is_cancelled(const struct mo_shard *shard)
{
  return atomic_load_explicit(&shard->stop, memory_order_relaxed) ||
         mo_is_cancelled(shard->part.cancel);
}

#endif
