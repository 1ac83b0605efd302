/* scores.h: stored losses, packed (scores.c). Only for this room. */
#ifndef MORPHO_STORE_SCORES_H
#define MORPHO_STORE_SCORES_H

#include <string.h>

#include <morpho/compute.h>

#include "store/internal.h"

/* ---- packed losses: doubles; the 32-bit steps if any rollout diverged; a 64-bit checksum ---- */

#define MO_PACKED_BYTES(n) (12 * (size_t)(n) + 8) /* at most */
/* Returns the checksum of `key` and of bytes. A change to any one word changes it. */
uint64_t mo_row_checksum(const int64_t *key, size_t n_key, const void *bytes, size_t size);
/* Returns the number of bytes. `key` identifies the losses, for the checksum. */
size_t mo_pack_losses(const int64_t *key, size_t n_key, const double *losses,
                      const uint32_t *diverged_steps, uint32_t n, uint8_t *bytes);
/* MO_ERR_CORRUPT: wrong number of losses or wrong checksum. */
int mo_unpack_losses(const int64_t *key, size_t n_key, const uint8_t *bytes, size_t size,
                     uint32_t n, double *losses, uint32_t *diverged_steps);

/* ---- rows ---- */

/* Returns a genotype with everything that its losses under a condition depend on. */
static inline struct mo_saved_design mo_design_under(const struct mo_condition *condition,
                                                     int64_t genotype, int64_t environment_set)
{
  return (struct mo_saved_design){.genotype = genotype,
                                  .controller = condition->controller,
                                  .physics = condition->physics,
                                  .environment_set = environment_set,
                                  .fingerprint = condition->fingerprint};
}
/* Finds or inserts a condition, and sets its id. */
int mo_condition_row(struct mo_connection *writer, struct mo_condition *condition);
/* Same. *last: the condition of the previous call ({0}: none), which is usually the same one. */
int mo_condition_row_after(struct mo_connection *writer, struct mo_condition *condition,
                           struct mo_condition *last);
/* Inserts the losses of a genotype under a condition with an id, unless they are stored. origin: 0:
 * this host. */
int mo_losses_insert(struct mo_store *store, const struct mo_condition *condition, int64_t genotype,
                     int64_t origin, const double *losses, const uint32_t *diverged_steps,
                     int64_t computed_us, bool *is_new);
/* Replaces the losses of a stored row; this host is their origin. */
int mo_losses_replace(struct mo_store *store, const struct mo_condition *condition,
                      int64_t genotype, const double *losses, const uint32_t *diverged_steps,
                      int64_t computed_us);
/* Reads controller, physics, fingerprint and environments of a condition from four columns,
 * starting at `first`. MO_ERR_CORRUPT. */
int mo_condition_from_row(sqlite3_stmt *statement, int first, struct mo_condition *condition);
/* Decodes a row of MO_SCORE_COLUMNS, starting at column `first`; losses and steps
 * (MO_BLOCK_LANES). */
#define MO_SCORE_COLUMNS                                                                           \
  "x.genotype,c.controller,c.physics,c.fingerprint,c.environments,x.origin,x.computed_us,x.losses"
int mo_score_from_row(sqlite3_stmt *statement, int first, struct mo_condition *condition,
                      double *losses, uint32_t *diverged_steps);
/* Reads the losses of a genotype in n ≤ MO_ENVIRONMENTS_MAX environments: losses of the class
 * `fingerprint` or, where there are none, of the class `workers` (0: none). */
int mo_losses_read(struct mo_connection *connection, const struct mo_saved_design *design,
                   const int64_t *environments, uint32_t n, struct mo_score *scores);
/* Determines whether the losses in all environments of a condition are stored, in any blocks. */
int mo_losses_are_known(struct mo_connection *connection, const struct mo_condition *condition,
                        int64_t genotype, bool *are_known);
/* Compares a row with the stored losses of its rollouts, no matter which blocks they are in.
 * MO_ERR_CONFLICT: a stored loss has different bits. */
int mo_losses_compare(struct mo_connection *connection, const struct mo_condition *condition,
                      int64_t genotype, const double *losses, const uint32_t *diverged_steps,
                      struct mo_score stored[MO_BLOCK_LANES]);
/* Inserts the losses of blocks as saved for a job. */
int mo_blocks_insert(struct mo_store *store, const struct mo_saved_block *blocks, size_t n,
                     int64_t now_us);

/* Returns whether two numbers have the same bits. */
static inline bool mo_same_bits(double a, double b)
{
  uint64_t words[2];
  memcpy(&words[0], &a, sizeof(a));
  memcpy(&words[1], &b, sizeof(b));
  return words[0] == words[1];
}

/* ---- means over named sets ---- */

/* Inserts a genotype's mean, if the set is complete and the mean is not stored yet. */
int mo_set_score_insert(struct mo_connection *writer, const struct mo_saved_design *design);
/* Recomputes a stored mean, unless losses are missing. */
int mo_set_score_replace(struct mo_connection *writer, const struct mo_saved_design *design,
                         int64_t ranking);
/* Like mo_set_score_insert, for a caller that has the mean. */
int mo_set_score_insert_mean(struct mo_connection *writer, const struct mo_saved_design *design,
                             double mean);
/* Reads a row's mean in column `first` and checks it against the checksum in the next column. */
int mo_set_score_from_row(sqlite3_stmt *statement, int first, int64_t ranking, int64_t genotype,
                          double *mean);

#endif
