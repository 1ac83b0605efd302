/* job_row.c: decodes the rows of a job. */
#include <string.h>

#include "store/internal.h"

static int environments_from_row(sqlite3_stmt *row, int column, struct mo_job *job)
{
  const int64_t n = sqlite3_column_int64(row, column);
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    return MO_ERR_CORRUPT;
  job->n_environments = (uint32_t)n;
  return MO_OK;
}

/* `required`: there must be one. */
static int controller_from_row(sqlite3_stmt *row, bool required, struct mo_job *job)
{
  if (!required && sqlite3_column_type(row, 13) == SQLITE_NULL)
    return MO_OK;
  return mo_column_hash(row, 13, &job->controller_sha256);
}

static int evaluation_from_row(sqlite3_stmt *row, struct mo_job *job)
{
  int64_t n_designs = sqlite3_column_int64(row, 16);
  const void *encoding = sqlite3_column_blob(row, 17);
  int record = sqlite3_column_int(row, 19);
  int error = environments_from_row(row, 15, job);
  if (error == MO_OK && (n_designs < 1 || n_designs > MO_DESIGNS_MAX))
    error = MO_ERR_CORRUPT;
  if (error == MO_OK)
    error = controller_from_row(row, true, job);
  if (error == MO_OK && (encoding == NULL ||
                         mo_decode_physics(encoding, (size_t)sqlite3_column_bytes(row, 17),
                                           &job->physics, &job->precision, &job->sensor) != MO_OK))
    error = MO_ERR_CORRUPT;
  if (error != MO_OK)
    return error;
  mo_column_text(row, 12, job->controller_name, sizeof(job->controller_name));
  mo_column_text(row, 14, job->environment_set, sizeof(job->environment_set));
  job->n_designs = (uint32_t)n_designs;
  job->verify = sqlite3_column_int(row, 18) != 0;
  job->record_com = (record & 1) != 0;
  job->record_masses = (record & 2) != 0;
  job->record_stride = (uint32_t)sqlite3_column_int64(row, 20);
  job->rollouts_total = (uint64_t)n_designs * job->n_environments;
  job->rollouts_done = (uint64_t)sqlite3_column_int64(row, 21);
  job->rollouts_cached = (uint64_t)sqlite3_column_int64(row, 22);
  job->rollouts_diverged = (uint64_t)sqlite3_column_int64(row, 23);
  return MO_OK;
}

static int training_from_row(sqlite3_stmt *row, struct mo_job *job)
{
  struct mo_training_settings settings;
  const void *encoding = sqlite3_column_blob(row, 26);
  if (encoding == NULL ||
      mo_decode_training(encoding, (size_t)sqlite3_column_bytes(row, 26), &settings) != MO_OK)
    return MO_ERR_CORRUPT;
  if (controller_from_row(row, false, job) != MO_OK)
    return MO_ERR_CORRUPT;
  mo_column_text(row, 24, job->controller_name, sizeof(job->controller_name));
  job->n_designs = (uint32_t)sqlite3_column_int64(row, 25);
  job->physics = settings.physics;
  job->sensor = settings.sensor;
  job->precision = MO_FLOAT32;
  job->steps_total = settings.n_steps;
  job->steps_done = (uint32_t)sqlite3_column_int64(row, 27);
  return MO_OK;
}

static int campaign_from_row(sqlite3_stmt *row, struct mo_job *job)
{
  struct mo_campaign_settings settings;
  const void *encoding = sqlite3_column_blob(row, 30);
  int64_t generation = sqlite3_column_int64(row, 32);
  if (mo_decode_campaign(encoding, (size_t)sqlite3_column_bytes(row, 30), &settings) != MO_OK)
    return MO_ERR_CORRUPT;
  if (environments_from_row(row, 33, job) != MO_OK || controller_from_row(row, false, job) != MO_OK)
    return MO_ERR_CORRUPT;
  mo_column_text(row, 29, job->controller_name, sizeof(job->controller_name));
  mo_column_text(row, 14, job->environment_set, sizeof(job->environment_set));
  job->n_designs = settings.population;
  job->physics = settings.physics;
  job->sensor = settings.sensor;
  job->precision = MO_FLOAT32;
  job->steps_total = (uint32_t)sqlite3_column_int64(row, 31);
  job->steps_done = generation > 0 ? (uint32_t)generation : 0;
  return MO_OK;
}

int mo_job_from_row(sqlite3_stmt *row, struct mo_job *job)
{
  const int64_t kind = sqlite3_column_int64(row, 2), state = sqlite3_column_int64(row, 3),
                priority = sqlite3_column_int64(row, 4);
  memset(job, 0, sizeof(*job));
  job->id = sqlite3_column_int64(row, 0);
  job->version = sqlite3_column_int64(row, 1);
  if (kind < 0 || kind >= MO_JOB_KINDS || state < 0 || state >= MO_JOB_STATES ||
      priority < MO_BATCH || priority > MO_INTERACTIVE)
    return MO_ERR_CORRUPT;
  job->kind = (enum mo_job_kind)kind;
  job->state = (enum mo_job_state)state;
  job->weight = sqlite3_column_double(row, 28);
  job->priority = (enum mo_urgency)priority;
  job->back_end = sqlite3_column_int(row, 34) != 0 ? MO_ON_DEVICE : MO_ON_CPU;
  job->has_label = sqlite3_column_type(row, 5) != SQLITE_NULL;
  mo_column_text(row, 5, job->label, sizeof(job->label));
  job->created_us = sqlite3_column_int64(row, 6);
  job->started_us = sqlite3_column_int64(row, 7);
  job->finished_us = sqlite3_column_int64(row, 8);
  job->attempts = (uint32_t)sqlite3_column_int64(row, 9);
  job->error = sqlite3_column_int(row, 10);
  mo_column_text(row, 11, job->error_text, sizeof(job->error_text));
  return job->kind == MO_JOB_EVALUATION ? evaluation_from_row(row, job)
         : job->kind == MO_JOB_TRAINING ? training_from_row(row, job)
                                        : campaign_from_row(row, job);
}
