/* trainings.c: submits and reads training runs, and reads the designs of populations. */
#include "store/trainings.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/campaign_runs.h"
#include "store/contents.h"
#include "store/controller_rows.h"
#include "store/jobs.h"
#include "store/rows.h"
#include "store/runs.h"
#include "store/warnings.h"

/* ---- submission ---- */

static int insert(struct mo_store *store, const void *any, int64_t *id)
{
  static const char sql[] =
      "INSERT INTO trainings(job,n_designs,population,step) VALUES(?1,?2,?3,0)";
  const struct mo_training_request *request = any;
  struct mo_training_record record = request->record;
  struct mo_connection *writer = &store->writer;
  int64_t parent = 0, set = 0, n_environments = record.n_environments;
  int error = MO_OK;
  if (request->parent != NULL)
    error = mo_controller_find(writer, request->parent, &parent, &record.settings.sensor,
                               &record.settings.physics);
  if (error == MO_OK && record.environment_set[0] != '\0')
    error = mo_environment_set_find(writer, record.environment_set, &set, &n_environments);
  record.n_environments = (uint32_t)n_environments;
  if (record.n_environments > 0 && !record.draws_worlds)
    record.settings.held_out_environments = record.n_environments;
  if (error == MO_OK)
    error = mo_training_settings_check(&record.settings, NULL);
  if (error == MO_OK)
    error = mo_job_insert(writer, &request->job, MO_JOB_TRAINING, id);
  if (error == MO_OK)
    error =
        mo_run_insert(writer, *id, MO_JOB_TRAINING, &record, record.name, parent, request->parent);
  if (error == MO_OK)
    error =
        mo_sql_do(writer, sql, mo_int(*id), mo_int(record.n_designs), mo_int(record.population));
  if (error == MO_OK)
    error = mo_environments_insert(writer, *id, set, request->environments, record.n_environments);
  if (error == MO_OK)
    error = mo_notes_insert(writer, *id, request->notes, request->n_notes);
  if (error == MO_OK)
    error = mo_designs_insert(writer, *id, request->forms, request->genotypes, record.n_designs,
                              NULL, 0, mo_clock_wall_us());
  if (error == MO_OK)
    error =
        mo_writer_event(store, *id, "job.created",
                        "{\"id\":\"%lld\",\"kind\":\"training\",\"state\":\"queued\",\"steps\":%u}",
                        (long long)*id, (unsigned)record.settings.n_steps);
  return error == MO_OK ? mo_run_announce_warnings(store, *id, true) : error;
}

int mo_store_submit_training(struct mo_store *store, const struct mo_training_request *request,
                             int64_t *id, bool *replayed)
{
  return mo_submit(store, &request->job.key, insert, request, id, replayed);
}

/* ---- one training run ---- */

static int load_status(struct mo_connection *reader, int64_t id, void *any)
{
  static const char checkpoint_sql[] = "SELECT coalesce(max(step),0) FROM checkpoints WHERE job=?1";
  static const char bodies_sql[] = "SELECT count(*) FROM training_bodies WHERE job=?1";
  struct mo_training_status *status = any;
  sqlite3_stmt *row;
  bool has_step;
  int64_t step = 0, bodies = 0;
  int error = mo_job_row(reader, id, MO_JOB_TRAINING, &row);
  memset(status, 0, sizeof(*status));
  if (error == MO_OK)
    error = mo_job_read(row, &status->job, &status->record);
  if (error == MO_OK)
    error = mo_job_warn(reader, &status->job, &status->record);
  if (error == MO_OK)
    error = mo_row_newest(reader, MO_TRAINING_STEPS, id, &status->last, &has_step);
  if (error == MO_OK)
    error = mo_row_newest(reader, MO_TRAINING_VALIDATIONS, id, &status->validation,
                          &status->has_validation);
  if (error == MO_OK)
    error = mo_sql_find(reader, &step, checkpoint_sql, mo_int(id));
  if (error == MO_OK && status->record.each)
    error = mo_sql_find(reader, &bodies, bodies_sql, mo_int(id));
  status->step = status->job.steps_done;
  status->checkpoint_step = (uint32_t)step;
  status->bodies_done = (uint32_t)bodies;
  return error == MO_OK ? mo_training_code_load(reader, id, &status->code) : error;
}

int mo_store_training(struct mo_store *store, int64_t id, struct mo_training_status *status)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return load_status(reader, id, status);
}

int64_t mo_store_trainings(struct mo_store *store, const struct mo_job_query *query, void *statuses,
                           size_t limit)
{
  struct mo_job_query trainings = *query;
  trainings.kind = MO_JOB_TRAINING;
  return mo_read_jobs(store, &trainings, limit, load_status, statuses,
                      sizeof(struct mo_training_status));
}

/* ---- populations ---- */

struct ranked {
  double score;
  struct mo_bits genotype;
};

/* Compares by score, then by bits, so that equal genotypes, which have equal scores, become
 * neighbors. */
static int compare_ranked(const void *a, const void *b)
{
  const struct ranked *first = a, *second = b;
  if (first->score != second->score)
    return first->score < second->score ? -1 : 1;
  for (int w = 0; w < MO_DEFAULT_WORDS; w++)
    if (first->genotype.words[w] != second->genotype.words[w])
      return first->genotype.words[w] < second->genotype.words[w] ? -1 : 1;
  return 0;
}

/* Reads the newest population of a campaign, which is sorted and has no duplicate forms. */
static int population_of_campaign(struct mo_store *store, int64_t id, uint32_t best,
                                  struct mo_bits **ret, uint32_t *ret_n)
{
  struct mo_campaign_state *state = NULL;
  uint32_t n = 0;
  int error = mo_store_campaign_state(store, id, &state);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CONFLICT : error;
  for (uint32_t i = 0; i < state->n && (best == 0 || n < best); i++)
    if (isfinite(state->scores[i]))
      state->genotypes[n++] = state->genotypes[i];
  *ret = state->genotypes;
  *ret_n = n;
  state->genotypes = NULL;
  mo_campaign_state_free(state);
  return MO_OK;
}

int mo_store_population(struct mo_store *store, int64_t id, uint32_t best, struct mo_bits **ret,
                        uint32_t *ret_n)
{
  struct mo_evaluation_results *results = NULL;
  struct mo_bits *genotypes = NULL;
  struct ranked *ranked = NULL;
  struct mo_job job;
  uint32_t n_ranked = 0, n = 0;
  int error = mo_store_job(store, id, &job);
  if (error == MO_OK && job.kind == MO_JOB_CAMPAIGN)
    return population_of_campaign(store, id, best, ret, ret_n);
  if (error == MO_OK && job.kind != MO_JOB_EVALUATION)
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK && job.state != MO_JOB_SUCCEEDED)
    error = MO_ERR_CONFLICT;
  if (error == MO_OK)
    error = mo_store_results_unmeasured(store, id, &results);
  if (error != MO_OK)
    return error;
  ranked = calloc(results->n_designs, sizeof(*ranked));
  genotypes = calloc(results->n_designs, sizeof(*genotypes));
  if (ranked == NULL || genotypes == NULL)
    error = MO_ERR_NO_MEMORY;
  /* Only complete scores are ranked. A design that was cut short has only a lower bound, unless
   * another entry with its genotype has a score. */
  for (uint32_t i = 0; i < results->n_designs && error == MO_OK; i++)
    if (isfinite(results->scores[i]) && !results->is_bound[i])
      ranked[n_ranked++] = (struct ranked){results->scores[i], results->genotypes[i]};
  if (n_ranked > 0)
    qsort(ranked, n_ranked, sizeof(*ranked), compare_ranked);
  for (uint32_t i = 0; i < n_ranked && (best == 0 || n < best); i++)
    if (i == 0 || compare_ranked(&ranked[i - 1], &ranked[i]) != 0)
      genotypes[n++] = ranked[i].genotype;
  free(ranked);
  mo_evaluation_results_free(results);
  if (error != MO_OK) {
    free(genotypes);
    return error;
  }
  *ret = genotypes;
  *ret_n = n;
  return MO_OK;
}
