/* origins.h: the losses and measures that one origin computed, and their replacement. Threads and
 * errors as in store.h. */
#ifndef MORPHO_STORE_ORIGINS_H
#define MORPHO_STORE_ORIGINS_H

#include <morpho/compute.h>
#include <morpho/measure.h>

#include "store/records.h"

struct mo_store;

struct mo_loss_row {
  double losses[MO_BLOCK_LANES]; /* (n) */
  uint32_t diverged_steps[MO_BLOCK_LANES];
};
/* Returns whether n losses have the same bits. */
bool mo_loss_rows_equal(const struct mo_loss_row *a, const struct mo_loss_row *b, uint32_t n);

struct mo_measures_row {
  double values[MO_BLOCK_LANES][MO_MEASURES]; /* (n) NaN: without a value */
};
/* Returns whether a measure has the same bits twice, or twice no value. */
bool mo_measure_equal(double a, double b);

/* A row of `scores`, of `measures`, or one of each for the same rollouts, and everything needed to
 * recompute it. */
struct mo_origin_row {
  int64_t genotype_row, condition;
  struct mo_genotype form, genotype; /* canonical; as scored */
  struct mo_sha256 controller_sha256, physics_sha256;
  struct mo_physics physics;
  enum mo_precision precision;
  char fingerprint[MO_FINGERPRINT_BYTES];
  int64_t computed_us;
  uint32_t n;
  struct mo_environment environments[MO_BLOCK_LANES]; /* the reader of the row drops their grids */
  struct mo_sha256 environment_sha256[MO_BLOCK_LANES];
  bool has_losses, has_measures; /* which of them the origin computed; the others are not set */
  uint32_t n_measures;           /* how many measures of each rollout are stored: the first ones */
  struct mo_loss_row stored;
  struct mo_measures_row stored_measures;
  /* Set by the caller: the recomputed rows, with all measures, and whether they differ. */
  struct mo_loss_row again;
  struct mo_measures_row again_measures;
  bool differs, measures_differ;
};

/* A place in the order of rows: {0, 0} is before all of them. */
struct mo_origin_place {
  int64_t genotype, condition;
};
/* Reads the rows of an origin after *place, in order, and advances *place. Measures of unknown
 * origin, which an earlier version stored, count as everyone's. Looks at a limited number of rows
 * of other origins, so it may return fewer than `limit` rows, or none, although more follow.
 * *is_last: no more rows follow. Returns their number or an error. MO_ERR_NOT_FOUND: no such
 * origin. */
int64_t mo_store_origin_rows(struct mo_store *store, const char *origin,
                             struct mo_origin_place *place, struct mo_origin_row *rows,
                             size_t limit, bool *is_last);

/* Replaces the losses and measures of rows that differ with the recomputed ones, sets their origin
 * to this host, and updates the means of the sets that contain these losses: for all rows or, on an
 * error, for none. Losses or measures that have changed since they were read stay unchanged. */
int mo_store_origin_replace(struct mo_store *store, const struct mo_origin_row *rows, size_t n);

#endif
