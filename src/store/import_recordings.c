/* import_recordings.c: evaluations that recorded designs of a campaign: their export, and their
 * import after the campaign's scores. See imports.h. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/campaign_rows.h"
#include "store/contents.h"
#include "store/import_state.h"
#include "store/recordings.h"
#include "store/runs.h"
#include "store/scores.h"
#include "store/store.h"

/* ---- export ---- */

int mo_store_campaign_recordings(struct mo_store *store, int64_t id, int64_t **evaluations,
                                 uint32_t *n, uint64_t *rollouts)
{
  static const char sql[] =
      "SELECT e.job,e.n_designs*e.n_environments FROM evaluations e JOIN jobs j ON j.id=e.job"
      " WHERE e.recorded_bytes>0 AND j.state=3 AND e.verify=0 AND e.controller=?2 AND e.physics=?3"
      " AND e.fingerprint IS NOT NULL"
      " AND NOT EXISTS(SELECT 1 FROM design_notes x WHERE x.job=e.job)"
      " AND NOT EXISTS(SELECT 1 FROM job_designs x WHERE x.job=e.job AND NOT EXISTS(SELECT 1"
      " FROM campaign_designs d WHERE d.genotype=x.genotype AND d.job=?1))"
      " AND NOT EXISTS(SELECT 1 FROM job_environments x WHERE x.job=e.job AND x.environment NOT IN"
      " (SELECT environment FROM job_environments WHERE job=?4))"
      " AND e.n_designs*e.n_environments="
      "(SELECT count(*) FROM trajectories t WHERE t.job=e.job) ORDER BY e.job";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_head head = {0};
  size_t room = 0;
  *evaluations = NULL;
  *n = 0;
  *rollouts = 0;
  int error = mo_campaign_head_get(reader, id, &head);
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id), mo_int(head.controller),
                                  mo_int(head.physics), mo_int(head.group));
  while (mo_sql_next(reader, row, &error)) {
    if (*n == room) {
      int64_t *grown = realloc(*evaluations, (room = 2 * room + 16) * sizeof(*grown));
      if (grown == NULL) {
        error = MO_ERR_NO_MEMORY;
        break;
      }
      *evaluations = grown;
    }
    (*evaluations)[(*n)++] = sqlite3_column_int64(row, 0);
    *rollouts += (uint64_t)sqlite3_column_int64(row, 1);
  }
  return error;
}

/* Reads a column of numbers, at most `most`. */
static int read_list(struct mo_connection *reader, const char *sql, int64_t id, int64_t other,
                     uint32_t *list, uint32_t most, uint32_t *n)
{
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id), mo_int(other));
  while (*n < most && mo_sql_next(reader, row, &error))
    list[(*n)++] = mo_column_u32(row, 0);
  return error;
}

/* Reads classes and source. */
static int read_origin(struct mo_connection *reader, uint64_t own, int64_t id,
                       struct mo_imported_evaluation *evaluation)
{
  static const char sql[] =
      "SELECT f.text,coalesce(w.text,''),i.store,i.source FROM evaluations e"
      " JOIN fingerprints f ON f.id=e.fingerprint LEFT JOIN fingerprints w ON w.id=e.workers"
      " LEFT JOIN imports i ON i.job=e.job WHERE e.job=?1";
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_int(id));
  if (error != MO_OK)
    return error;
  mo_column_text(row, 0, evaluation->fingerprint, sizeof(evaluation->fingerprint));
  mo_column_text(row, 1, evaluation->workers, sizeof(evaluation->workers));
  const bool is_imported = sqlite3_column_type(row, 2) != SQLITE_NULL;
  evaluation->source.store = is_imported ? (uint64_t)sqlite3_column_int64(row, 2) : own;
  evaluation->source.job = is_imported ? sqlite3_column_int64(row, 3) : id;
  return MO_OK;
}

int mo_store_recorded_evaluation(struct mo_store *store, int64_t campaign, int64_t id,
                                 struct mo_imported_evaluation *evaluation)
{
  static const char places_sql[] =
      "SELECT min(y.position) FROM job_environments x JOIN job_environments y"
      " ON y.environment=x.environment AND y.job=?2 WHERE x.job=?1"
      " GROUP BY x.position ORDER BY x.position";
  static const char numbers_sql[] =
      "SELECT min(d.number) FROM job_designs x CROSS JOIN campaign_designs d"
      " ON d.genotype=x.genotype AND d.job=?2 WHERE x.job=?1"
      " GROUP BY x.position ORDER BY x.position";
  struct mo_job job;
  struct mo_campaign_head head;
  int error = mo_store_job(store, id, &job);
  if (error != MO_OK)
    return error;
  *evaluation = (struct mo_imported_evaluation){.has_label = job.has_label,
                                                .back_end = job.back_end,
                                                .created_us = job.created_us,
                                                .started_us = job.started_us,
                                                .finished_us = job.finished_us,
                                                .record = job.record,
                                                .stride = job.record_stride};
  memcpy(evaluation->label, job.label, sizeof(job.label));
  memcpy(evaluation->experiment, job.experiment, sizeof(job.experiment));
  memcpy(evaluation->note, job.note, sizeof(job.note));
  memcpy(evaluation->controller_name, job.controller_name, sizeof(job.controller_name));
  memcpy(evaluation->environment_set, job.environment_set, sizeof(job.environment_set));
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  error = mo_campaign_head_get(reader, campaign, &head);
  if (error == MO_OK)
    error = read_origin(reader, mo_store_id(store), id, evaluation);
  if (error == MO_OK)
    error = read_list(reader, places_sql, id, head.group, evaluation->environments,
                      MO_ENVIRONMENTS_MAX, &evaluation->n_environments);
  if (error == MO_OK)
    error = read_list(reader, numbers_sql, id, campaign, evaluation->numbers, MO_DESIGNS_MAX,
                      &evaluation->n_designs);
  return error == MO_OK && (evaluation->n_designs != job.n_designs ||
                            evaluation->n_environments != job.n_environments)
             ? MO_ERR_NOT_FOUND /* one of them was deleted in the meantime */
             : error;
}

/* ---- import ---- */

int mo_source_evaluation(struct mo_connection *connection, uint64_t own, bool hidden,
                         const struct mo_imported_evaluation *evaluation, int64_t *id)
{
#define OF_TIMES "j.kind=?2 AND j.created_us=?3 AND j.started_us=?4 AND j.finished_us=?5"
  static const char own_sql[] = "SELECT j.id FROM jobs j WHERE j.id=?1 AND j.state<6 AND " OF_TIMES
                                " AND NOT EXISTS(SELECT 1 FROM imports WHERE job=?1)";
  static const char sql[] = "SELECT i.job FROM imports i JOIN jobs j ON j.id=i.job"
                            " WHERE i.digest IN (?1,?6) AND (j.state<6 OR ?7) AND " OF_TIMES;
#undef OF_TIMES
  const struct mo_import_source *source = &evaluation->source;
  const struct mo_value kind = mo_int(MO_JOB_EVALUATION), created = mo_int(evaluation->created_us),
                        started = mo_int(evaluation->started_us),
                        finished = mo_int(evaluation->finished_us);
  struct mo_sha256 older; /* as stored by earlier versions */
  char text[64];
  int error = source->store == own ? mo_sql_find(connection, id, own_sql, mo_int(source->job), kind,
                                                 created, started, finished)
                                   : MO_ERR_NOT_FOUND;
  if (error != MO_ERR_NOT_FOUND)
    return error;
  snprintf(text, sizeof(text), "evaluation %016llx %lld", (unsigned long long)source->store,
           (long long)source->job);
  mo_sha256_of(text, strlen(text), &older);
  return mo_sql_find(connection, id, sql, mo_hash(&source->digest), kind, created, started,
                     finished, mo_hash(&older), mo_int(hidden));
}

static int insert_job(struct mo_import *import, const struct mo_imported_evaluation *evaluation)
{
  static const char sql[] =
      "INSERT INTO jobs(kind,state,priority,version,epoch,attempts,label,created_us,started_us,"
      "finished_us,error,weight,back_end,experiment,note)"
      " VALUES(?1,6,1,1,?2,0,?3,?4,?5,?6,0,1,?7,nullif(?8,''),nullif(?9,''))";
  const int error =
      mo_sql_insert(&import->store->writer, &import->evaluation, sql, mo_int(MO_JOB_EVALUATION),
                    mo_int(MO_IMPORT_EPOCH(MO_JOB_SUCCEEDED)),
                    evaluation->has_label ? mo_string(evaluation->label) : mo_null(),
                    mo_int(evaluation->created_us), mo_int(evaluation->started_us),
                    mo_int(evaluation->finished_us), mo_int(evaluation->back_end),
                    mo_string(evaluation->experiment), mo_string(evaluation->note));
  return error == MO_OK ? mo_import_hide(import->store, import->evaluation) : error;
}

/* Returns whether the environments are the same as in the campaign's named set. */
static bool has_set(const struct mo_import *import, const struct mo_imported_evaluation *evaluation)
{
  bool same = import->set != 0 && evaluation->environment_set[0] != '\0' &&
              evaluation->n_environments == import->n_environments;
  for (uint32_t k = 0; k < evaluation->n_environments && same; k++)
    same = evaluation->environments[k] == k;
  return same;
}

static int insert_evaluation(struct mo_import *import,
                             const struct mo_imported_evaluation *evaluation,
                             const struct mo_saved_design *classes)
{
  static const char sql[] =
      "INSERT INTO evaluations(job,controller,controller_name,physics,environment_set,n_designs,"
      "n_environments,verify,record,record_stride,done,cached,diverged,n_skipped,fingerprint,"
      "workers) VALUES(?1,?2,?3,?4,nullif(?5,0),?6,?7,0,?8,?9,?6*?7,0,0,0,?10,nullif(?11,0))";
  return mo_sql_do(&import->store->writer, sql, mo_int(import->evaluation),
                   mo_int(import->controller), mo_string(evaluation->controller_name),
                   mo_int(import->physics), mo_int(has_set(import, evaluation) ? import->set : 0),
                   mo_int(evaluation->n_designs), mo_int(evaluation->n_environments),
                   mo_int(evaluation->record), mo_int(evaluation->stride),
                   mo_int(classes->fingerprint), mo_int(classes->workers));
}

static int insert_environments(struct mo_import *import,
                               const struct mo_imported_evaluation *evaluation)
{
  static const char sql[] =
      "INSERT INTO job_environments(job,position,environment) VALUES(?1,?2,?3)";
  int error = MO_OK;
  for (uint32_t k = 0; k < evaluation->n_environments && error == MO_OK; k++)
    error = mo_sql_do(&import->store->writer, sql, mo_int(import->evaluation), mo_int(k),
                      mo_int(import->environments[evaluation->environments[k]]));
  return error;
}

int mo_enter_evaluation(struct mo_import *import, const struct mo_imported_evaluation *evaluation)
{
  struct mo_connection *writer = &import->store->writer;
  struct mo_saved_design *classes = &import->classes;
  int error = mo_source_evaluation(writer, mo_store_id(import->store), true, evaluation,
                                   &import->evaluation);
  if (error != MO_ERR_NOT_FOUND)
    return error;
  *classes = (struct mo_saved_design){.controller = import->controller, .physics = import->physics};
  import->n_inserted = 0;
  error = mo_text_row(writer, MO_FINGERPRINTS, evaluation->fingerprint, &classes->fingerprint);
  if (error == MO_OK && evaluation->workers[0] != '\0')
    error = mo_text_row(writer, MO_FINGERPRINTS, evaluation->workers, &classes->workers);
  if (error == MO_OK)
    error = insert_job(import, evaluation);
  if (error == MO_OK)
    error = insert_evaluation(import, evaluation, classes);
  if (error == MO_OK)
    error = insert_environments(import, evaluation);
  if (error == MO_OK)
    error = mo_source_insert(import, import->evaluation, &evaluation->source);
  return error == MO_OK ? 1 : error;
}

int mo_enter_evaluation_designs(struct mo_import *import,
                                const struct mo_imported_evaluation *evaluation, int64_t until_us)
{
  static const char sql[] = "SELECT genotype FROM campaign_designs WHERE job=?1 AND number=?2";
  static const char diverged_sql[] = "UPDATE evaluations SET diverged=diverged+?2 WHERE job=?1";
  struct mo_connection *writer = &import->store->writer;
  struct mo_saved_design design = import->classes;
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  int64_t environments[MO_ENVIRONMENTS_MAX], n_diverged = 0;
  const uint32_t n = evaluation->n_environments;
  int error = MO_OK;
  for (uint32_t k = 0; k < n; k++)
    environments[k] = import->environments[evaluation->environments[k]];
  do {
    const uint32_t i = import->n_inserted;
    error = mo_sql_find(writer, &design.genotype, sql, mo_int(import->id),
                        mo_int(evaluation->numbers[i]));
    if (error == MO_OK)
      error = mo_design_insert(writer, import->evaluation, i, design.genotype);
    if (error == MO_OK)
      error = mo_losses_read(writer, &design, environments, n, scores);
    for (uint32_t k = 0; k < n && error == MO_OK; k++) {
      import->diverged_steps[(size_t)i * n + k] = scores[k].diverged_step;
      n_diverged += scores[k].diverged_step != 0;
      error = scores[k].known ? MO_OK : MO_ERR_NOT_FOUND; /* all their losses must be stored */
    }
  } while (error == MO_OK && ++import->n_inserted < evaluation->n_designs &&
           mo_clock_us() < until_us);
  return error == MO_OK
             ? mo_sql_do(writer, diverged_sql, mo_int(import->evaluation), mo_int(n_diverged))
             : error;
}

int mo_enter_rollout(struct mo_import *import, const struct mo_saved_trajectory *rollout)
{
  struct mo_saved_trajectory own = *rollout;
  own.job = import->evaluation;
  own.diverged_step =
      import->diverged_steps[(size_t)own.design_position * import->recorded_environments +
                             own.environment_position];
  return mo_trajectories_insert(&import->store->writer, &own, 1);
}
