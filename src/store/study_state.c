/* study_state.c: what a study has besides what every campaign has: its newest batch, its own words,
 * the state of its sampler. */
#include "store/campaign_rows.h"
#include "store/studies.h"

int mo_study_words_get(struct mo_connection *connection, int64_t id, struct mo_study_words *words)
{
  static const char sql[] =
      "SELECT kind,place,word FROM study_words WHERE job=?1 ORDER BY kind,place";
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(connection, &error, sql, mo_int(id));
  *words = (struct mo_study_words){.n_operators = 0};
  while (mo_sql_next(connection, row, &error)) {
    const bool is_operator = sqlite3_column_int(row, 0) == 0;
    uint32_t *n = is_operator ? &words->n_operators : &words->n_measures;
    if (*n == (is_operator ? MO_STUDY_OPERATORS_MAX : MO_STUDY_MEASURES_MAX) ||
        mo_column_u32(row, 1) != *n)
      return MO_ERR_CORRUPT;
    mo_column_text(row, 2, is_operator ? words->operators[*n] : words->measures[*n],
                   MO_STUDY_WORD_MAX + 1);
    (*n)++;
  }
  return error;
}

int mo_store_study_words(struct mo_store *store, int64_t id, struct mo_study_words *words)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return mo_study_words_get(reader, id, words);
}

int mo_study_status_get(struct mo_connection *connection, int64_t id,
                        struct mo_campaign_status *status)
{
  static const char sql[] = "SELECT batch FROM studies WHERE job=?1";
  static const char sampler_sql[] =
      "SELECT size,sha256 FROM checkpoints WHERE job=?1 AND generation=?2";
  sqlite3_stmt *row;
  int error = mo_sql_find(connection, &status->told, sql, mo_int(id));
  if (error == MO_OK)
    error = mo_study_words_get(connection, id, &status->words);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  error = mo_sql_row(connection, &row, sampler_sql, mo_int(id), mo_int(status->generation));
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_OK : error;
  status->sampler_bytes = (uint64_t)sqlite3_column_int64(row, 0);
  return mo_column_hash(row, 1, &status->sampler_sha256);
}
