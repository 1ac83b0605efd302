/* verification.h: recomputes, on this host, the losses and measures that a worker on another
 * machine returned. */
#ifndef MORPHO_JOBS_VERIFICATION_H
#define MORPHO_JOBS_VERIFICATION_H

#include "jobs/jobs.h"
#include "store/origins.h"

#define MO_VERIFIED_MAX 64 /* rows in one call */

struct mo_verification {
  const char *origin;
  struct mo_origin_place place; /* moves past the last row */
  size_t limit;                 /* 1 … MO_VERIFIED_MAX; fewer if rows are long */
  bool repair;
  /* Results. */
  struct mo_origin_row *rows; /* (n) malloc; the rows that differ, with the recomputed ones */
  size_t n;
  uint64_t checked, skipped; /* rollouts; skipped: of a class that this host does not have */
  bool is_last;
};
/* Recomputes the losses and measures of the next rows of an origin, ahead of all batch work and
 * never on workers on other machines, and waits for them. With `repair`, replaces those that
 * differ, in one transaction. The caller frees `rows`, even after an error.
 * - MO_ERR_NOT_FOUND: nothing has this origin
 * - MO_ERR_DEVICE: devices computed these rows, and no device works
 * - MO_ERR_CANCELLED: the service is stopping */
int mo_jobs_verify(struct mo_jobs *jobs, struct mo_verification *verification);

#endif
