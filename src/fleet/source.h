/* source.h: where the fleet's work comes from and its results go. */
#ifndef MORPHO_FLEET_SOURCE_H
#define MORPHO_FLEET_SOURCE_H

#include <morpho/compute.h>

#include "fleet/wire.h"

/* mo_compute's functions for remote takers in the service, others in tests. Called without locks of
 * the fleet, except is_cancelled, which must only read. */
struct mo_fleet_source {
  void *context;
  struct mo_taken *(*take)(void *context, enum mo_back_end back_end, uint64_t max_steps);
  void (*put_back)(void *context, struct mo_taken *taken);
  void (*keep)(void *context, struct mo_taken *taken); /* puts back, and never gives again */
  struct mo_taken *(*split)(void *context, struct mo_taken *taken);
  bool (*is_cancelled)(void *context, const struct mo_taken *taken);
  void (*deliver)(void *context, struct mo_taken *taken, const struct mo_remote_result *result);
  void (*want)(void *context, enum mo_back_end back_end, uint32_t blocks);
  /* Returns the rollout steps of blocks that wait and suit. NULL: leases do not become smaller near
   * the end of a queue. */
  uint64_t (*waiting)(void *context, enum mo_back_end back_end);
  /* Computes a lease of one block in this process, to decide which of two sessions gave wrong bits.
   * weights: the file of its controller; NULL: passive bodies. Rows as in a result. *cancel ends it
   * early. NULL: a third session decides. Returns MO_OK or an error. */
  int (*recompute)(void *context, const struct mo_wire_lease *lease, struct mo_workspace workspace,
                   const uint8_t *weights, size_t weights_bytes, const volatile int *cancel,
                   double *losses, uint32_t *diverged_steps);
};
struct mo_fleet_source mo_fleet_source_of(struct mo_compute *compute);

#endif
