/* campaigns.c: reads campaigns: settings, progress, what replicates share. */
#include "store/campaigns.h"

#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"
#include "store/contents.h"
#include "store/fields.h"
#include "store/jobs.h"
#include "store/rows.h"

/* ---- one campaign ---- */

int mo_campaign_head_get(struct mo_connection *connection, int64_t id,
                         struct mo_campaign_head *head)
{
  static const char sql[] =
      "SELECT r.settings,m.generations,m.n_environments,m.replicates_of,m.physics,"
      "coalesce(r.controller,0),coalesce(m.environment_set,0),m.generation,m.n_designs,"
      "m.scored_generation,m.scored,m.diversity_max FROM campaigns m JOIN runs r ON r.job=m.job"
      " WHERE m.job=?1";
  struct mo_campaign_record record;
  sqlite3_stmt *row;
  int error = mo_sql_row(connection, &row, sql, mo_int(id));
  if (error != MO_OK)
    return error;
  error = mo_settings_read(MO_JOB_CAMPAIGN, (const char *)sqlite3_column_text(row, 0), &record);
  *head = (struct mo_campaign_head){.mode = record.settings.mode,
                                    .population = record.settings.population,
                                    .generations = mo_column_u32(row, 1),
                                    .n_environments = mo_column_u32(row, 2),
                                    .group = sqlite3_column_int64(row, 3),
                                    .physics = sqlite3_column_int64(row, 4),
                                    .controller = sqlite3_column_int64(row, 5),
                                    .environment_set = sqlite3_column_int64(row, 6),
                                    .generation = sqlite3_column_int64(row, 7),
                                    .n_designs = (uint64_t)sqlite3_column_int64(row, 8),
                                    .scored_generation = sqlite3_column_int64(row, 9),
                                    .scored = sqlite3_column_int64(row, 10),
                                    .diversity_max = sqlite3_column_double(row, 11)};
  (void)sqlite3_reset(row);
  if (error == MO_OK && (head->n_environments < 1 || head->n_environments > MO_ENVIRONMENTS_MAX))
    error = MO_ERR_CORRUPT;
  return error;
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
  if (error == MO_OK)
    error = mo_run_result_read(row, &status->has_result, &status->result_sha256);
  status->generation = sqlite3_column_int64(row, MO_COLUMN_GENERATION);
  status->n_designs = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_N_BORN);
  status->best_score = mo_column_number(row, MO_COLUMN_BEST_SCORE);
  status->diversity_max = sqlite3_column_double(row, MO_COLUMN_DIVERSITY_MAX);
  status->end = (enum mo_campaign_end)sqlite3_column_int(row, MO_COLUMN_ENDED);
  status->scored = mo_column_u32(row, MO_COLUMN_SCORED);
  (void)sqlite3_reset(row);
  if (error == MO_OK && status->generation >= 0)
    error = mo_row_newest(reader, MO_CAMPAIGN_GENERATIONS, id, &status->last, &found);
  return error == MO_OK && !found ? MO_ERR_CORRUPT : error;
}

int mo_store_campaign(struct mo_store *store, int64_t id, struct mo_campaign_status *status)
{
  struct mo_campaign_status found;
  const int error = mo_read_job(store, id, load_status, &found);
  if (error == MO_OK)
    *status = found;
  return error;
}

int64_t mo_store_campaigns(struct mo_store *store, const struct mo_job_query *query,
                           struct mo_campaign_status *statuses, size_t limit)
{
  struct mo_job_query campaigns = *query;
  campaigns.kind = MO_JOB_CAMPAIGN;
  return mo_read_jobs(store, &campaigns, limit, load_status, statuses, sizeof(*statuses));
}

/* ---- environments and initial designs, which the group shares ---- */

struct environment_rows {
  int64_t *rows;
  uint32_t n;
};

static int take_row(sqlite3_stmt *statement, void *any)
{
  struct environment_rows *list = any;
  list->rows[list->n++] = sqlite3_column_int64(statement, 0);
  return MO_OK;
}

int mo_campaign_environment_rows(struct mo_connection *connection, int64_t group, int64_t *rows,
                                 uint32_t n)
{
  static const char sql[] =
      "SELECT environment FROM campaign_environments WHERE job=?1 ORDER BY position LIMIT ?2";
  struct environment_rows list = {rows, 0};
  const int64_t found = mo_sql_each(connection, take_row, &list, sql, mo_int(group), mo_int(n));
  return found < 0 ? (int)found : found == n ? MO_OK : MO_ERR_CORRUPT;
}

struct environments {
  struct mo_environment *all; /* malloc */
  uint32_t n;
};

static int load_environments(struct mo_connection *reader, int64_t id, void *any)
{
  static const char sql[] = "SELECT e.id,e.data,e.sha256 FROM campaign_environments x"
                            " JOIN environments e ON e.id=x.environment"
                            " WHERE x.job=?1 ORDER BY x.position";
  struct environments *environments = any;
  struct mo_campaign_head head;
  const int error = mo_campaign_head_get(reader, id, &head);
  if (error != MO_OK)
    return error;
  environments->n = head.n_environments;
  environments->all = calloc(head.n_environments, sizeof(*environments->all));
  return environments->all == NULL
             ? MO_ERR_NO_MEMORY
             : mo_environments_read(reader, sql, head.group, head.n_environments, environments->all,
                                    NULL);
}

int mo_store_campaign_environments(struct mo_store *store, int64_t id, struct mo_environment **ret,
                                   uint32_t *ret_n)
{
  struct environments environments = {NULL, 0};
  const int error = mo_read_job(store, id, load_environments, &environments);
  if (error != MO_OK) {
    free(environments.all);
    return error;
  }
  *ret = environments.all;
  *ret_n = environments.n;
  return MO_OK;
}

static int load_initial(struct mo_connection *reader, int64_t id, void *designs)
{
  static const char sql[] =
      "SELECT g.id,g.bits,d.form FROM campaign_initial x JOIN genotypes g ON g.id=x.genotype"
      " JOIN designs d ON d.id=g.design WHERE x.job=?1 ORDER BY x.position";
  struct mo_campaign_head head;
  const int error = mo_campaign_head_get(reader, id, &head);
  return error == MO_OK ? mo_designs_read(reader, sql, head.group, head.population, designs)
                        : error;
}

int mo_store_campaign_initial(struct mo_store *store, int64_t id, struct mo_bits **genotypes,
                              uint32_t *n)
{
  return mo_job_designs(store, id, load_initial, genotypes, n);
}
