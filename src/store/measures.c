/* measures.c: stored measures of rollouts.
 *
 * A row of `measures` holds all measures of one genotype in the environments of one condition. It
 * is computed and written together with losses, or later, for losses that are already stored. Like
 * losses, measures are looked up by environment, no matter which condition they are in.
 *
 * The packed data begins with the number of measures, because later versions append more: a row
 * that lacks a requested measure counts as unknown. Values are whole multiples of a step, so four
 * bytes hold nearly all of them; the top bit of the header is set if one did not fit, and then all
 * are doubles. */
#include "store/measures.h"

#include <math.h>
#include <string.h>

#include "store/runner.h"
#include "store/scores.h"

#define KEY_WORDS (6 + MO_BLOCK_LANES)
#define HEAD      4
#define CHECKSUM  8
#define DOUBLES   (UINT32_C(1) << 31)
#define NO_VALUE  INT32_MIN

/* ---- packed measures ---- */

/* Returns a value as a number of steps. *is_exact: four bytes hold it with all its bits. */
static int32_t steps_of(double value, double steps_in_one, bool *is_exact)
{
  const double whole = rint(value * steps_in_one);
  const bool fits = whole > INT32_MIN && whole <= INT32_MAX; /* not NaN */
  const int32_t steps = fits ? (int32_t)whole : NO_VALUE;
  *is_exact = isnan(value) || (fits && mo_same_bits(steps / steps_in_one, value)); /* not -0 */
  return steps;
}

/* Writes values as numbers of steps. Returns false if one does not fit. */
static bool put_steps(const double (*values)[MO_MEASURES], uint32_t n, uint8_t *bytes)
{
  for (uint32_t i = 0; i < n; i++)
    for (unsigned m = 0; m < MO_MEASURES; m++) {
      bool is_exact;
      const int32_t steps = steps_of(values[i][m], mo_measure_info[m].steps_in_one, &is_exact);
      if (!is_exact)
        return false;
      memcpy(bytes, &steps, sizeof(steps));
      bytes += sizeof(steps);
    }
  return true;
}

size_t mo_pack_measures(const int64_t *key, size_t n_key, const double (*values)[MO_MEASURES],
                        uint32_t n, uint8_t *bytes)
{
  const size_t count = (size_t)n * MO_MEASURES;
  const bool fit = put_steps(values, n, bytes + HEAD);
  const uint32_t head = MO_MEASURES | (fit ? 0 : DOUBLES);
  const size_t size = HEAD + count * (fit ? sizeof(int32_t) : sizeof(double));
  memcpy(bytes, &head, HEAD);
  if (!fit)
    memcpy(bytes + HEAD, values, count * sizeof(double));
  const uint64_t sum = mo_row_checksum(key, n_key, bytes, size);
  memcpy(bytes + size, &sum, CHECKSUM);
  return size + CHECKSUM;
}

static double value_at(const uint8_t *bytes, bool is_double, unsigned m)
{
  double value;
  int32_t steps;
  if (is_double) {
    memcpy(&value, bytes, sizeof(value));
    return value;
  }
  memcpy(&steps, bytes, sizeof(steps));
  return steps == NO_VALUE ? (double)NAN : steps / mo_measure_info[m].steps_in_one;
}

int mo_unpack_measures(const int64_t *key, size_t n_key, const uint8_t *bytes, size_t size,
                       uint32_t n, double (*values)[MO_MEASURES], uint32_t *n_measures)
{
  uint32_t head;
  uint64_t sum;
  if (bytes == NULL || size < HEAD + CHECKSUM)
    return MO_ERR_CORRUPT;
  memcpy(&head, bytes, HEAD);
  memcpy(&sum, bytes + size - CHECKSUM, CHECKSUM);
  const bool is_double = (head & DOUBLES) != 0;
  const size_t n_packed = head & ~DOUBLES, each = is_double ? sizeof(double) : sizeof(int32_t);
  if (size != HEAD + each * n_packed * n + CHECKSUM ||
      sum != mo_row_checksum(key, n_key, bytes, size - CHECKSUM))
    return MO_ERR_CORRUPT;
  for (uint32_t i = 0; i < n; i++)
    for (unsigned m = 0; m < MO_MEASURES; m++)
      values[i][m] = m < n_packed ? value_at(bytes + HEAD + each * (i * n_packed + m), is_double, m)
                                  : (double)NAN;
  *n_measures = n_packed < MO_MEASURES ? (uint32_t)n_packed : MO_MEASURES;
  return MO_OK;
}

/* ---- rows ---- */

/* origin: 0: unknown, of a row from before version 22. */
static size_t key_of(const struct mo_condition *condition, int64_t genotype, int64_t origin,
                     int64_t computed_us, int64_t key[KEY_WORDS])
{
  size_t n = 5 + condition->n;
  key[0] = genotype;
  key[1] = condition->controller;
  key[2] = condition->physics;
  key[3] = condition->fingerprint;
  key[4] = computed_us;
  memcpy(key + 5, condition->environments, condition->n * sizeof(*key));
  if (origin != 0)
    key[n++] = origin;
  return n;
}

int mo_measures_insert_row(struct mo_store *store, const struct mo_condition *condition,
                           int64_t genotype, int64_t origin, const double (*values)[MO_MEASURES],
                           int64_t computed_us)
{
  /* A row of an earlier version may lack measures, and a repair replaces wrong ones. */
  static const char sql[] =
      "INSERT OR REPLACE INTO measures(genotype,condition,computed_us,packed,origin)"
      " VALUES(?1,?2,?3,?4,?5)";
  const int64_t from = origin != 0 ? origin : store->origin;
  uint8_t bytes[MO_PACKED_MEASURES_BYTES(MO_BLOCK_LANES)];
  int64_t key[KEY_WORDS];
  const size_t size = mo_pack_measures(key, key_of(condition, genotype, from, computed_us, key),
                                       values, condition->n, bytes);
  return mo_sql_do(&store->writer, sql, mo_int(genotype), mo_int(condition->id),
                   mo_int(computed_us), mo_blob(bytes, size), mo_int(from));
}

int mo_measures_insert(struct mo_store *store, const struct mo_saved_block *blocks, size_t n,
                       int64_t now_us)
{
  struct mo_condition last = {.n = 0};
  int error = MO_OK;
  for (size_t i = 0; i < n && error == MO_OK; i++) {
    struct mo_condition condition = blocks[i].condition;
    if (blocks[i].measures == NULL)
      continue;
    error = mo_condition_row_after(&store->writer, &condition, &last);
    if (error == MO_OK)
      error = mo_measures_insert_row(store, &condition, blocks[i].genotype, blocks[i].origin,
                                     (const double(*)[MO_MEASURES])blocks[i].measures, now_us);
  }
  return error;
}

int mo_measures_from_row(sqlite3_stmt *statement, int first, struct mo_condition *condition,
                         double (*values)[MO_MEASURES], uint32_t *n_measures)
{
  int64_t key[KEY_WORDS];
  if (mo_condition_from_row(statement, first + 1, condition) != MO_OK)
    return MO_ERR_CORRUPT;
  const size_t n_key = key_of(condition, sqlite3_column_int64(statement, first),
                              sqlite3_column_int64(statement, first + 7), /* 0 for NULL */
                              sqlite3_column_int64(statement, first + 5), key);
  return mo_unpack_measures(key, n_key, sqlite3_column_blob(statement, first + 6),
                            (size_t)sqlite3_column_bytes(statement, first + 6), condition->n,
                            values, n_measures);
}

int mo_measures_read(struct mo_connection *connection, const struct mo_saved_design *design,
                     const int64_t *environments, uint32_t n, uint32_t set,
                     double (*values)[MO_MEASURES], uint64_t *known)
{
  static const char sql[] =
      "SELECT " MO_MEASURE_COLUMNS " FROM measures x CROSS JOIN conditions c ON c.id=x.condition"
      " WHERE x.genotype=?1 AND c.controller=?2 AND c.physics=?3 AND c.fingerprint=?4";
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(connection, &error, sql, mo_int(design->genotype), mo_int(design->controller),
                  mo_int(design->physics), mo_int(design->fingerprint));
  *known = 0;
  while (mo_sql_next(connection, row, &error)) {
    struct mo_condition condition = {.n = 0};
    double found[MO_BLOCK_LANES][MO_MEASURES];
    uint32_t n_measures = 0;
    error = mo_measures_from_row(row, 0, &condition, found, &n_measures);
    if (error != MO_OK || (set & ~((UINT32_C(1) << n_measures) - 1)) != 0)
      continue;
    for (uint32_t i = 0; i < condition.n; i++)
      for (uint32_t k = 0; k < n; k++)
        if (environments[k] == condition.environments[i]) {
          *known |= UINT64_C(1) << k;
          if (values != NULL)
            memcpy(values[k], found[i], sizeof(found[i]));
        }
  }
  return error;
}

int mo_measures_compare(struct mo_connection *connection, const struct mo_saved_design *design,
                        const int64_t *environments, uint32_t n,
                        const double (*values)[MO_MEASURES], uint64_t *known)
{
  double stored[MO_BLOCK_LANES][MO_MEASURES];
  const int error =
      mo_measures_read(connection, design, environments, n, MO_MEASURES_ALL, stored, known);
  for (uint32_t k = 0; error == MO_OK && k < n; k++)
    for (unsigned m = 0; m < MO_MEASURES && (*known >> k & 1) != 0; m++)
      if (isnan(stored[k][m]) ? !isnan(values[k][m]) : !mo_same_bits(stored[k][m], values[k][m]))
        return MO_ERR_CONFLICT;
  return error;
}

int mo_store_measured(struct mo_store *store, const struct mo_saved_design *design,
                      const int64_t *environment_rows, uint32_t n, uint32_t set, uint64_t *known)
{
  MO_SCOPED struct mo_connection *reader = mo_runner_acquire(store);
  return mo_measures_read(reader, design, environment_rows, n, set, NULL, known);
}
