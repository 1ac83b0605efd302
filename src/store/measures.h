/* measures.h: stored measures of rollouts, packed (measures.c). Only for this room. */
#ifndef MORPHO_STORE_MEASURES_H
#define MORPHO_STORE_MEASURES_H

#include <morpho/measure.h>

#include "store/internal.h"

#define MO_PACKED_MEASURES_BYTES(n) (12 + 8 * MO_MEASURES * (size_t)(n)) /* at most */
/* Packs the measures of n rollouts. Returns the number of bytes. `key` identifies the rollouts, for
 * the checksum. */
size_t mo_pack_measures(const int64_t *key, size_t n_key, const double (*values)[MO_MEASURES],
                        uint32_t n, uint8_t *bytes);
/* *n_measures: the number of measures that were packed; these are the first ones, and the others
 * are NaN. MO_ERR_CORRUPT: wrong size or wrong checksum. */
int mo_unpack_measures(const int64_t *key, size_t n_key, const uint8_t *bytes, size_t size,
                       uint32_t n, double (*values)[MO_MEASURES], uint32_t *n_measures);

/* Inserts the measures of those blocks that have them. */
int mo_measures_insert(struct mo_store *store, const struct mo_saved_block *blocks, size_t n,
                       int64_t now_us);
/* Inserts the measures of one genotype under a condition, whose id is known, as one row, or
 * replaces this row. origin: 0: this host. */
int mo_measures_insert_row(struct mo_store *store, const struct mo_condition *condition,
                           int64_t genotype, int64_t origin, const double (*values)[MO_MEASURES],
                           int64_t computed_us);
/* Decodes a row of MO_MEASURE_COLUMNS, starting at column `first`; values (MO_BLOCK_LANES). */
#define MO_MEASURE_COLUMNS                                                                         \
  "x.genotype,c.controller,c.physics,c.fingerprint,c.environments,x.computed_us,x.packed,x.origin"
int mo_measures_from_row(sqlite3_stmt *statement, int first, struct mo_condition *condition,
                         double (*values)[MO_MEASURES], uint32_t *n_measures);
/* Compares measures with those that are stored. MO_ERR_CONFLICT: a value differs. *known: where all
 * of them are stored, as bits. */
int mo_measures_compare(struct mo_connection *connection, const struct mo_saved_design *design,
                        const int64_t *environments, uint32_t n,
                        const double (*values)[MO_MEASURES], uint64_t *known);
/* Reads the measures of a genotype in n ≤ MO_ENVIRONMENTS_MAX environments, of the class
 * `fingerprint`. *known: the environments in which all measures of the set are stored, as bits; the
 * others have no values. values (n): nullable. */
int mo_measures_read(struct mo_connection *connection, const struct mo_saved_design *design,
                     const int64_t *environments, uint32_t n, uint32_t set,
                     double (*values)[MO_MEASURES], uint64_t *known);

#endif
