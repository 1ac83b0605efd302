/* job_row.c: what the rows of a job say, each value checked: what replies cannot say is damage, and
 * told by table and column. */
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "base/number.h"
#include "store/internal.h"

int mo_job_damaged(struct mo_job *job, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(job->damage, sizeof(job->damage), format, arguments);
  va_end(arguments);
  return MO_ERR_CORRUPT;
}

int mo_job_undecodable(struct mo_job *job, const char *column_name, sqlite3_stmt *row, int column)
{
  const unsigned char *bytes = sqlite3_column_blob(row, column);
  const int size = sqlite3_column_bytes(row, column);
  if (bytes == NULL || size < 1)
    return mo_job_damaged(job, "%s is missing or empty", column_name);
  return mo_job_damaged(job, "%s cannot be decoded: version %d, length %d", column_name, bytes[0],
                        size);
}

int mo_job_ranges(struct mo_job *job, sqlite3_stmt *row, const struct mo_column_range *ranges,
                  size_t n)
{
  for (size_t i = 0; i < n; i++) {
    const int64_t value = sqlite3_column_int64(row, ranges[i].column);
    if (value < ranges[i].least || value > ranges[i].most)
      return mo_job_damaged(job, "%s is %lld", ranges[i].name, (long long)value);
  }
  return MO_OK;
}

int mo_job_name(struct mo_job *job, sqlite3_stmt *row, int column, const char *name)
{
  const char *text = (const char *)sqlite3_column_text(row, column);
  return text == NULL || text[0] == '\0' || mo_controller_name_check(text) == MO_OK
             ? MO_OK
             : mo_job_damaged(job, "%s is no name", name);
}

/* Characters of UTF-8. */
static size_t count_characters(const unsigned char *text)
{
  size_t n = 0;
  for (; text != NULL && *text != '\0'; text++)
    n += (*text & 0xC0) != 0x80;
  return n;
}

bool mo_job_passed_over(int error, const struct mo_job *job)
{
  return error == MO_ERR_CORRUPT && job->damage[0] != '\0';
}

static int environments_from_row(sqlite3_stmt *row, int column, const char *column_name,
                                 struct mo_job *job)
{
  const int64_t n = sqlite3_column_int64(row, column);
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    return mo_job_damaged(job, "%s is %lld", column_name, (long long)n);
  job->n_environments = (uint32_t)n;
  return MO_OK;
}

/* `required`: there must be one. */
static int controller_from_row(sqlite3_stmt *row, bool required, struct mo_job *job)
{
  if (!required && sqlite3_column_type(row, 13) == SQLITE_NULL)
    return MO_OK;
  return mo_column_hash(row, 13, &job->controller_sha256) == MO_OK
             ? MO_OK
             : mo_job_damaged(job, "controllers.sha256 of its controller is missing or is no hash");
}

static int evaluation_from_row(sqlite3_stmt *row, struct mo_job *job)
{
  int64_t n_designs = sqlite3_column_int64(row, 16);
  const void *encoding = sqlite3_column_blob(row, 17);
  static const struct mo_column_range ranges[] = {{21, "evaluations.done", 0, INT64_MAX},
                                                  {22, "evaluations.cached", 0, INT64_MAX},
                                                  {23, "evaluations.diverged", 0, INT64_MAX}};
  int record = sqlite3_column_int(row, 19);
  int error = environments_from_row(row, 15, "evaluations.n_environments", job);
  if (error == MO_OK && (n_designs < 1 || n_designs > MO_DESIGNS_MAX))
    error = mo_job_damaged(job, "evaluations.n_designs is %lld", (long long)n_designs);
  if (error == MO_OK)
    error = controller_from_row(row, true, job);
  if (error == MO_OK && (encoding == NULL ||
                         mo_decode_physics(encoding, (size_t)sqlite3_column_bytes(row, 17),
                                           &job->physics, &job->precision, &job->sensor) != MO_OK))
    error = mo_job_undecodable(job, "physics.encoding", row, 17);
  if (error == MO_OK)
    error = mo_job_ranges(job, row, ranges, sizeof(ranges) / sizeof(ranges[0]));
  if (error == MO_OK)
    error = mo_job_name(job, row, 12, "evaluations.controller_name");
  if (error == MO_OK)
    error = mo_job_name(job, row, 14, "environment_sets.name");
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
    return mo_job_undecodable(job, "trainings.settings", row, 26);
  const struct mo_column_range ranges[] = {
      {25, "trainings.n_designs", settings.kind == MO_TRAINING_FINETUNE, MO_TRAINING_DESIGNS_MAX},
      {27, "trainings.step", 0, settings.n_steps}};
  if (controller_from_row(row, false, job) != MO_OK ||
      mo_job_ranges(job, row, ranges, sizeof(ranges) / sizeof(ranges[0])) != MO_OK ||
      mo_job_name(job, row, 24, "trainings.parent_name") != MO_OK)
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
    return mo_job_undecodable(job, "campaigns.settings", row, 30);
  static const struct mo_column_range ranges[] = {
      {31, "campaigns.generations", 0, MO_GENERATIONS_MAX},
      {32, "campaigns.generation", -1, MO_GENERATIONS_MAX}};
  if (environments_from_row(row, 33, "campaigns.n_environments", job) != MO_OK ||
      controller_from_row(row, false, job) != MO_OK ||
      mo_job_ranges(job, row, ranges, sizeof(ranges) / sizeof(ranges[0])) != MO_OK ||
      mo_job_name(job, row, 29, "campaigns.controller_name") != MO_OK ||
      mo_job_name(job, row, 14, "environment_sets.name") != MO_OK)
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
  static const struct mo_column_range ranges[] = {{6, "jobs.created_us", 1, MO_TIME_US_MAX},
                                                  {7, "jobs.started_us", 0, MO_TIME_US_MAX},
                                                  {8, "jobs.finished_us", 0, MO_TIME_US_MAX},
                                                  {9, "jobs.attempts", 0, UINT32_MAX}};
  const int64_t kind = sqlite3_column_int64(row, 2), state = sqlite3_column_int64(row, 3),
                priority = sqlite3_column_int64(row, 4);
  memset(job, 0, sizeof(*job));
  job->id = sqlite3_column_int64(row, 0);
  job->version = sqlite3_column_int64(row, 1);
  job->kind =
      kind >= 0 && kind < MO_JOB_KINDS ? (enum mo_job_kind)kind : (enum mo_job_kind)MO_JOB_KINDS;
  job->weight = sqlite3_column_double(row, 28);
  if (state >= 0 && state < MO_JOB_STATES)
    job->state = (enum mo_job_state)state;
  if (kind < 0 || kind >= MO_JOB_KINDS)
    return mo_job_damaged(job, "jobs.kind is %lld", (long long)kind);
  if (state < 0 || state >= MO_JOB_STATES)
    return mo_job_damaged(job, "jobs.state is %lld", (long long)state);
  if (priority < MO_BATCH || priority > MO_INTERACTIVE)
    return mo_job_damaged(job, "jobs.priority is %lld", (long long)priority);
  if (!(job->weight >= MO_WEIGHT_MIN && job->weight <= MO_WEIGHT_MAX))
    return mo_job_damaged(job, "jobs.weight is %s", MO_NUMBER(job->weight));
  if (mo_job_ranges(job, row, ranges, sizeof(ranges) / sizeof(ranges[0])) != MO_OK)
    return MO_ERR_CORRUPT;
  if (count_characters(sqlite3_column_text(row, 5)) > MO_LABEL_BYTES_MAX / 4)
    return mo_job_damaged(job, "jobs.label is too long");
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
