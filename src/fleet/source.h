/* source.h: the interface that the fleet gets work from and delivers results to. */
#ifndef MORPHO_FLEET_SOURCE_H
#define MORPHO_FLEET_SOURCE_H

#include <morpho/compute.h>

#include "fleet/wire.h"

/* In the service, these are mo_compute's functions for remote takers. Tests use their own functions
 * and `compute`. They are called without locks of the fleet, except is_cancelled, which must only
 * read. */
struct mo_fleet_source {
  struct mo_compute *compute;
  struct mo_taken *(*take)(struct mo_compute *compute, enum mo_back_end back_end,
                           uint64_t max_steps);
  void (*put_back)(struct mo_compute *compute, struct mo_taken *taken);
  void (*keep)(struct mo_compute *compute, struct mo_taken *taken);
  struct mo_taken *(*split)(struct mo_compute *compute, struct mo_taken *taken);
  bool (*is_cancelled)(const struct mo_taken *taken);
  void (*deliver)(struct mo_compute *compute, struct mo_taken *taken,
                  const struct mo_remote_result *result);
  void (*want)(struct mo_compute *compute, enum mo_back_end back_end, uint32_t blocks);
  uint64_t (*waiting)(struct mo_compute *compute, enum mo_back_end back_end);
  /* Computes a lease of one block in this process, to decide which of two sessions returned wrong
   * bits. weights: the file of its controller; NULL: passive bodies. Writes rows as in a result,
   * and measures if the lease has them. Setting *cancel ends it early. NULL: disputes are not
   * decided. Returns MO_OK or an error. */
  int (*recompute)(struct mo_compute *compute, struct mo_workspace workspace,
                   const struct mo_wire_lease *lease, const uint8_t *weights, size_t weights_bytes,
                   const volatile int *cancel, double *losses, uint32_t *diverged_steps,
                   double (*measures)[MO_MEASURES]);
};
struct mo_fleet_source mo_fleet_source_of(struct mo_compute *compute);

#endif
