/* campaigns.c: reads campaigns: settings, progress, data shared by replicates. */
#include "store/campaigns.h"

#include <stdio.h>
#include <string.h>

#include "store/campaign_rows.h"
#include "store/jobs.h"
#include "store/rows.h"
#include "store/studies.h"
#include "store/warnings.h"

/* ---- studies only ---- */

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

/* Puts the names of the service's measures in front of a study's own. */
static void prepend_measures(uint32_t set, struct mo_study_words *words)
{
  const uint32_t n = (uint32_t)__builtin_popcount(set);
  uint32_t place = 0;
  memmove(words->measures[n], words->measures[0], words->n_measures * sizeof(words->measures[0]));
  for (unsigned m = 0; m < MO_MEASURES; m++)
    if (set >> m & 1)
      snprintf(words->measures[place++], sizeof(words->measures[0]), "%s", mo_measure_info[m].name);
  words->n_measures += n;
}

int mo_campaign_words_get(struct mo_connection *connection, int64_t id,
                          struct mo_study_words *words)
{
  struct mo_campaign_head head;
  int error = mo_campaign_head_get(connection, id, &head);
  if (error == MO_OK)
    error = mo_study_words_get(connection, id, words);
  if (error == MO_OK)
    prepend_measures(head.measures, words);
  return error;
}

int mo_store_study_words(struct mo_store *store, int64_t id, struct mo_study_words *words)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return mo_campaign_words_get(reader, id, words);
}

/* Reads the parts that only a study has: its newest batch, its words, and its sampler state. */
static int get_study(struct mo_connection *connection, int64_t id,
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

/* ---- one campaign ---- */

int mo_campaign_head_get(struct mo_connection *connection, int64_t id,
                         struct mo_campaign_head *head)
{
  static const char sql[] =
      "SELECT r.settings,m.generations,m.n_environments,m.replicates_of,m.physics,"
      "coalesce(r.controller,0),coalesce(m.environment_set,0),m.generation,m.n_designs,"
      "m.scored_generation,m.scored,m.diversity_max,m.race_pays FROM campaigns m JOIN runs r ON "
      "r.job=m.job"
      " JOIN jobs j ON j.id=m.job AND j.state<>6 WHERE m.job=?1";
  struct mo_campaign_record record;
  sqlite3_stmt *row;
  int error = mo_sql_row(connection, &row, sql, mo_int(id));
  if (error == MO_OK)
    error = mo_column_settings(row, 0, MO_JOB_CAMPAIGN, &record);
  if (error != MO_OK)
    return error;
  *head = (struct mo_campaign_head){.mode = record.settings.mode,
                                    .population = record.settings.population,
                                    .generations = mo_column_u32(row, 1),
                                    .n_environments = mo_column_u32(row, 2),
                                    .measures = record.measures,
                                    .group = sqlite3_column_int64(row, 3),
                                    .physics = sqlite3_column_int64(row, 4),
                                    .controller = sqlite3_column_int64(row, 5),
                                    .environment_set = sqlite3_column_int64(row, 6),
                                    .generation = sqlite3_column_int64(row, 7),
                                    .n_designs = (uint64_t)sqlite3_column_int64(row, 8),
                                    .scored_generation = sqlite3_column_int64(row, 9),
                                    .scored = sqlite3_column_int64(row, 10),
                                    .diversity_max = sqlite3_column_double(row, 11),
                                    .race_pays = sqlite3_column_int(row, 12) != 0};
  return head->n_environments < 1 || head->n_environments > MO_ENVIRONMENTS_MAX ? MO_ERR_CORRUPT
                                                                                : MO_OK;
}

static int load_source(struct mo_connection *reader, int64_t id, struct mo_campaign_status *status)
{
  static const char sql[] = "SELECT store,source,imported_us FROM imports WHERE job=?1";
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_int(id));
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_OK : error;
  status->source_store = (uint64_t)sqlite3_column_int64(row, 0);
  status->source_campaign = sqlite3_column_int64(row, 1);
  status->imported_us = sqlite3_column_int64(row, 2);
  return MO_OK;
}

static int load_status(struct mo_connection *reader, int64_t id, void *any)
{
  struct mo_campaign_status *status = any;
  sqlite3_stmt *row;
  bool found = true;
  int error = mo_job_row(reader, id, MO_JOB_CAMPAIGN, &row);
  memset(status, 0, sizeof(*status));
  if (error != MO_OK)
    return error;
  error = mo_job_read(row, &status->job, &status->record);
  status->generation = sqlite3_column_int64(row, MO_COLUMN_GENERATION);
  status->n_designs = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_N_BORN);
  status->best_score = mo_column_number(row, MO_COLUMN_BEST_SCORE);
  status->diversity_max = sqlite3_column_double(row, MO_COLUMN_DIVERSITY_MAX);
  status->end = (enum mo_campaign_end)sqlite3_column_int(row, MO_COLUMN_ENDED);
  status->scored = mo_column_u32(row, MO_COLUMN_SCORED);
  if (error == MO_OK)
    error = mo_job_warn(reader, &status->job, &status->record);
  if (error == MO_OK && !mo_modes[status->record.settings.mode].makes_children)
    error = get_study(reader, id, status);
  if (error == MO_OK)
    prepend_measures(status->record.measures, &status->words);
  if (error == MO_OK)
    error = load_source(reader, id, status);
  if (error == MO_OK && status->generation >= 0)
    error = mo_row_newest(reader, MO_CAMPAIGN_GENERATIONS, id, &status->last, &found);
  return error == MO_OK && !found ? MO_ERR_CORRUPT : error;
}

int mo_store_campaign(struct mo_store *store, int64_t id, struct mo_campaign_status *status)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return load_status(reader, id, status);
}

int64_t mo_store_campaigns(struct mo_store *store, const struct mo_job_query *query, void *statuses,
                           size_t limit)
{
  struct mo_job_query campaigns = *query;
  campaigns.kind = MO_JOB_CAMPAIGN;
  return mo_read_jobs(store, &campaigns, limit, load_status, statuses,
                      sizeof(struct mo_campaign_status));
}
