/* jobs.c: see jobs.h. A job's row has the columns of every kind; columns of other kinds are
 * NULL. */
#include "store/jobs.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/words.h"
#include "store/atlases.h"
#include "store/campaigns.h"
#include "store/certificates.h"
#include "store/contents.h"
#include "store/fields.h"
#include "store/internal.h"
#include "store/trainings.h"
#include "store/warnings.h"

const char *const mo_job_state_words[] = {"queued", "running",   "paused", "succeeded",
                                          "failed", "cancelled", NULL};
const char *const mo_job_kind_words[] = {"evaluation", "training",    "campaign",
                                         "atlas",      "certificate", NULL};

const char *mo_job_state_name(enum mo_job_state state)
{
  return mo_word(mo_job_state_words, state);
}

const char *mo_job_kind_name(enum mo_job_kind kind)
{
  return mo_word(mo_job_kind_words, kind);
}

/* ---- one job ---- */

/* Reads the hash of a controller, if the row has one. */
static bool read_hash(sqlite3_stmt *row, int column, bool *is_there, struct mo_sha256 *sha256)
{
  *is_there = sqlite3_column_type(row, column) != SQLITE_NULL;
  return !*is_there || mo_column_hash(row, column, sha256) == MO_OK;
}

static void read_environments(sqlite3_stmt *row, struct mo_job *job)
{
  mo_column_text(row, MO_COLUMN_ENVIRONMENT_SET, job->environment_set,
                 sizeof(job->environment_set));
  job->n_environments = mo_column_u32(row, MO_COLUMN_N_ENVIRONMENTS);
}

static int read_evaluation(sqlite3_stmt *row, struct mo_job *job, void *record)
{
  (void)record;
  read_environments(row, job);
  job->n_designs = mo_column_u32(row, MO_COLUMN_N_DESIGNS);
  job->n_skipped = mo_column_u32(row, MO_COLUMN_N_SKIPPED);
  job->best = mo_column_u32(row, MO_COLUMN_BEST);
  job->is_random = sqlite3_column_type(row, MO_COLUMN_RANDOM_SEED) != SQLITE_NULL;
  job->random_seed = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_RANDOM_SEED);
  job->random_first = mo_column_u32(row, MO_COLUMN_RANDOM_FIRST);
  job->n_waiting = mo_column_u32(row, MO_COLUMN_N_WAITING);
  job->verify = sqlite3_column_int(row, MO_COLUMN_VERIFY) != 0;
  job->record = mo_column_u32(row, MO_COLUMN_RECORD) & ((1U << MO_CHANNELS) - 1);
  job->record_stride = mo_column_u32(row, MO_COLUMN_RECORD_STRIDE);
  job->recorded_bytes = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_RECORDED_BYTES);
  job->recordings_removed_us = sqlite3_column_int64(row, MO_COLUMN_RECORDINGS_REMOVED_US);
  job->n_displaced = mo_column_u32(row, MO_COLUMN_N_DISPLACED);
  job->measures = mo_column_u32(row, MO_COLUMN_MEASURES);
  job->tolerance = sqlite3_column_double(row, MO_COLUMN_TOLERANCE);
  if (job->n_displaced > MO_ERROR_DISPLACED ||
      !mo_tolerance_is_sound(job->tolerance, job->n_displaced) ||
      (job->measures & ~MO_MEASURES_ALL) != 0)
    return MO_ERR_CORRUPT;
  job->rollouts_total = (uint64_t)(job->n_designs - job->n_skipped) * job->n_environments *
                        mo_ladder_runs(job->n_displaced, job->tolerance);
  job->rollouts_done = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_DONE);
  job->rollouts_cached = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_CACHED);
  job->rollouts_diverged = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_DIVERGED);
  job->rollouts_cut = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_CUT);
  return mo_column_physics(row, MO_COLUMN_PHYSICS, &job->physics, &job->precision, &job->sensor);
}

int mo_column_settings(sqlite3_stmt *row, int column, enum mo_job_kind kind, void *record)
{
  const char *json = (const char *)sqlite3_column_text(row, column);
  return json != NULL ? mo_settings_read(kind, json, record) : mo_column_missing(row);
}

static int read_training(sqlite3_stmt *row, struct mo_job *job, void *any)
{
  struct mo_training_record *record = any;
  const int error = mo_column_settings(row, MO_COLUMN_SETTINGS, job->kind, record);
  if (error != MO_OK)
    return error;
  job->n_designs = mo_column_u32(row, MO_COLUMN_N_DESIGNS);
  job->physics = record->settings.physics;
  job->sensor = record->settings.sensor;
  job->steps_total = record->settings.n_steps * (record->each ? job->n_designs : 1);
  job->steps_done = mo_column_u32(row, MO_COLUMN_STEP);
  mo_column_text(row, MO_COLUMN_NAME, record->name, sizeof(record->name));
  memcpy(job->environment_set, record->environment_set, sizeof(job->environment_set));
  job->n_environments = record->n_environments;
  record->n_designs = job->n_designs;
  record->population = sqlite3_column_int64(row, MO_COLUMN_POPULATION);
  return MO_OK;
}

static int read_campaign(sqlite3_stmt *row, struct mo_job *job, void *any)
{
  struct mo_campaign_record *record = any;
  const int64_t generation = sqlite3_column_int64(row, MO_COLUMN_GENERATION);
  const int error = mo_column_settings(row, MO_COLUMN_SETTINGS, job->kind, record);
  if (error != MO_OK)
    return error;
  read_environments(row, job);
  record->settings.generations = mo_column_u32(row, MO_COLUMN_GENERATIONS);
  job->n_designs = record->settings.population;
  job->physics = record->settings.physics;
  job->sensor = record->settings.sensor;
  job->steps_total = record->settings.generations;
  job->steps_done = generation > 0 ? (uint32_t)generation : 0;
  mo_column_text(row, MO_COLUMN_NAME, record->name, sizeof(record->name));
  mo_column_text(row, MO_COLUMN_PRESET, record->preset, sizeof(record->preset));
  memcpy(record->environment_set, job->environment_set, sizeof(record->environment_set));
  record->n_environments = job->n_environments;
  record->n_listed = mo_column_u32(row, MO_COLUMN_N_LISTED);
  record->initial_campaign = sqlite3_column_int64(row, MO_COLUMN_INITIAL_CAMPAIGN);
  record->group = sqlite3_column_int64(row, MO_COLUMN_REPLICATES_OF);
  record->replicate = mo_column_u32(row, MO_COLUMN_REPLICATE);
  record->replicates = mo_column_u32(row, MO_COLUMN_REPLICATES);
  return MO_OK;
}

static int read_atlas(sqlite3_stmt *row, struct mo_job *job, void *any)
{
  struct mo_atlas_record *record = any;
  const int64_t orientations = sqlite3_column_int64(row, MO_COLUMN_ORIENTATIONS);
  const int64_t measures = sqlite3_column_int64(row, MO_COLUMN_MEASURES);
  read_environments(row, job);
  mo_column_text(row, MO_COLUMN_NAME, record->name, sizeof(record->name));
  record->voxels = mo_column_u32(row, MO_COLUMN_VOXELS);
  record->bodies_total = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_BODIES_TOTAL);
  record->bodies_done = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_BODIES_DONE);
  record->rollouts_done = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_ROLLOUTS_DONE);
  if (orientations < MO_ATLAS_CANONICAL || orientations > MO_ATLAS_IMAGES || record->voxels < 1 ||
      record->voxels > MO_ATLAS_VOXELS_MAX || measures < 0 || measures > MO_MEASURES_ALL ||
      !mo_atlas_name_is_valid(record->name))
    return MO_ERR_CORRUPT;
  record->measures = (uint32_t)measures;
  record->orientations = (enum mo_atlas_orientations)orientations;
  return mo_column_physics(row, MO_COLUMN_PHYSICS, &job->physics, &job->precision, &job->sensor);
}

static int read_certificate(sqlite3_stmt *row, struct mo_job *job, void *any)
{
  struct mo_certificate_record *record = any;
  const char *json = (const char *)sqlite3_column_text(row, MO_COLUMN_SETTINGS);
  struct mo_message message;
  if (json == NULL)
    return mo_column_missing(row);
  record->settings = mo_certificate_defaults();
  int error =
      mo_fields_parse(json, strlen(json), &mo_certificate_fields, &record->settings, &message);
  if (error == MO_OK)
    error = mo_certificate_check(&record->settings, &message);
  if (error != MO_OK)
    return error == MO_ERR_NO_MEMORY ? error : MO_ERR_CORRUPT;
  read_environments(row, job);
  job->n_designs = mo_column_u32(row, MO_COLUMN_N_DESIGNS);
  record->population = sqlite3_column_int64(row, MO_COLUMN_POPULATION);
  record->taken = mo_column_u32(row, MO_COLUMN_TAKEN);
  record->n_trials = mo_column_u32(row, MO_COLUMN_N_TRIALS);
  record->trials_done = mo_column_u32(row, MO_COLUMN_TRIALS_DONE);
  record->n_rollouts = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_N_ROLLOUTS);
  record->rollouts_done = (uint64_t)sqlite3_column_int64(row, MO_COLUMN_ROLLOUTS_DONE);
  if (job->n_designs < 1 || job->n_designs > MO_CERTIFICATE_DESIGNS_MAX ||
      record->trials_done > record->n_trials || record->rollouts_done > record->n_rollouts ||
      record->n_rollouts > MO_CERTIFICATE_ROLLOUTS_MAX)
    return MO_ERR_CORRUPT;
  return mo_column_physics(row, MO_COLUMN_PHYSICS, &job->physics, &job->precision, &job->sensor);
}

int mo_job_read(sqlite3_stmt *row, struct mo_job *job, void *record)
{
  static int (*const read[MO_JOB_KINDS])(sqlite3_stmt * row, struct mo_job * job, void *record) = {
      read_evaluation, read_training, read_campaign, read_atlas, read_certificate};
  union {
    struct mo_training_record training;
    struct mo_campaign_record campaign;
    struct mo_atlas_record atlas;
    struct mo_certificate_record certificate;
  } unused;
  const int64_t kind = sqlite3_column_int64(row, MO_COLUMN_KIND),
                state = sqlite3_column_int64(row, MO_COLUMN_STATE),
                priority = sqlite3_column_int64(row, MO_COLUMN_PRIORITY);
  memset(job, 0, sizeof(*job));
  job->id = sqlite3_column_int64(row, MO_COLUMN_ID);
  job->version = sqlite3_column_int64(row, MO_COLUMN_VERSION);
  if (kind < 0 || kind >= MO_JOB_KINDS || state < 0 || state >= MO_JOB_STATES ||
      priority < MO_BATCH || priority > MO_INTERACTIVE ||
      !read_hash(row, MO_COLUMN_CONTROLLER, &job->has_controller, &job->controller_sha256) ||
      !read_hash(row, MO_COLUMN_RESULT, &job->has_result, &job->result_sha256))
    return MO_ERR_CORRUPT;
  job->kind = (enum mo_job_kind)kind;
  job->state = (enum mo_job_state)state;
  job->priority = (enum mo_urgency)priority;
  job->weight = sqlite3_column_double(row, MO_COLUMN_WEIGHT);
  job->back_end = sqlite3_column_int(row, MO_COLUMN_BACK_END) != 0 ? MO_ON_DEVICE : MO_ON_CPU;
  job->has_label = sqlite3_column_type(row, MO_COLUMN_LABEL) != SQLITE_NULL;
  mo_column_text(row, MO_COLUMN_LABEL, job->label, sizeof(job->label));
  mo_column_text(row, MO_COLUMN_EXPERIMENT, job->experiment, sizeof(job->experiment));
  mo_column_text(row, MO_COLUMN_NOTE, job->note, sizeof(job->note));
  job->archived_us = sqlite3_column_int64(row, MO_COLUMN_ARCHIVED_US);
  job->worker_s = sqlite3_column_double(row, MO_COLUMN_WORKER_S);
  job->device_s = sqlite3_column_double(row, MO_COLUMN_DEVICE_S);
  mo_column_text(row, MO_COLUMN_SUBMITTED_BY, job->submitted_by, sizeof(job->submitted_by));
  job->created_us = sqlite3_column_int64(row, MO_COLUMN_CREATED_US);
  job->started_us = sqlite3_column_int64(row, MO_COLUMN_STARTED_US);
  job->finished_us = sqlite3_column_int64(row, MO_COLUMN_FINISHED_US);
  job->attempts = mo_column_u32(row, MO_COLUMN_ATTEMPTS);
  job->error = sqlite3_column_int(row, MO_COLUMN_ERROR);
  mo_column_text(row, MO_COLUMN_ERROR_TEXT, job->error_text, sizeof(job->error_text));
  mo_column_text(row, MO_COLUMN_CONTROLLER_NAME, job->controller_name,
                 sizeof(job->controller_name));
  return read[kind](row, job, record != NULL ? record : &unused);
}

int mo_job_row(struct mo_connection *connection, int64_t id, int kind, sqlite3_stmt **row)
{
#define COLUMN(name, sql) "," sql
  static const char sql[] =
      "SELECT 0" MO_JOB_COLUMNS(COLUMN) " FROM jobs j LEFT JOIN evaluations e ON e.job=j.id"
                                        " LEFT JOIN runs r ON r.job=j.id"
                                        " LEFT JOIN trainings t ON t.job=j.id"
                                        " LEFT JOIN campaigns m ON m.job=j.id"
                                        " LEFT JOIN atlases a ON a.job=j.id"
                                        " LEFT JOIN certificates k ON k.job=j.id"
                                        " LEFT JOIN controllers c ON c.id=coalesce("
                                        "e.controller,r.controller,a.controller,k.controller)"
                                        " LEFT JOIN controllers x ON x.id=r.result"
                                        " LEFT JOIN physics p ON p.id=coalesce("
                                        "e.physics,a.physics,k.physics)"
                                        " LEFT JOIN environment_sets s ON s.id=coalesce("
                                        "e.environment_set,m.environment_set,a.environment_set,"
                                        "k.environment_set)"
                                        " WHERE j.id=?1 AND j.state<>6 AND (?2<0 OR j.kind=?2)";
#undef COLUMN
  return mo_sql_row(connection, row, sql, mo_int(id), mo_int(kind));
}

static int load_job(struct mo_connection *connection, int64_t id, void *job)
{
  struct mo_job *read = job;
  sqlite3_stmt *row;
  int error = mo_job_row(connection, id, -1, &row);
  if (error == MO_OK)
    error = mo_job_read(row, read, NULL);
  return error == MO_OK && read->kind == MO_JOB_EVALUATION ? mo_job_warn(connection, read, NULL)
                                                           : error;
}

int mo_store_job(struct mo_store *store, int64_t id, struct mo_job *job)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return load_job(reader, id, job);
}

int mo_store_job_designs(struct mo_store *store, int64_t id, struct mo_bits **genotypes,
                         uint32_t *n)
{
  static const char sql[] = "SELECT coalesce(m.replicates_of,j.id) FROM jobs j"
                            " LEFT JOIN campaigns m ON m.job=j.id WHERE j.id=?1";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_designs designs = {.n = 0};
  int64_t owner;
  int error = mo_sql_find(reader, &owner, sql, mo_int(id));
  if (error == MO_OK)
    error = mo_designs_read(reader, owner, &designs);
  free(designs.rows);
  free(designs.positions);
  if (error != MO_OK) {
    free(designs.genotypes);
    return error;
  }
  *genotypes = designs.genotypes;
  *n = designs.n;
  return MO_OK;
}

int mo_store_design_notes(struct mo_store *store, int64_t id, struct mo_design_note **ret,
                          uint32_t *n)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  const int error = mo_notes_read(reader, id, ret, n);
  if (error != MO_OK) {
    free(*ret);
    *ret = NULL;
    *n = 0;
  }
  return error;
}

/* ---- pages ---- */

/* Queries for pages of jobs, newest first. `select` returns rows of jobs j with their id first;
 * `where` is a condition that an index answers, on ?4: kind, ?6: group, ?7 and ?10: the least and
 * the largest label, ?8: the submitter, ?11: experiment. ?1: ids are below this; ?2: state; ?3:
 * limit; ?5: ids of waiting jobs, which are shown as paused while they run; ?9: whether they are
 * archived; ?12: a pattern that labels match. Only a page by a label's prefix needs sorting:
 * otherwise each part is read in order from its index, and SQLite merges two of them. */
#define SHOWN                                                                                      \
  " AND +j.state<>6 AND (?9<0 OR (j.archived_us>0)=?9)"                                            \
  " AND (?12 IS NULL OR +j.label LIKE ?12 ESCAPE '\\')"
#define PAGE_OF_ALL(rows, where)                                                                   \
  rows " WHERE " where SHOWN " AND j.id<?1 ORDER BY j.id DESC LIMIT ?3"
#define PAGE_OF_STATE(select, where) PAGE_OF_ALL(select, where " AND j.state=?2")
#define PAGE_OF_SHOWN(select, where)                                                               \
  select                                                                                           \
      " WHERE " where SHOWN                                                                        \
      " AND j.state=?2 AND (?2<>1 OR j.id NOT IN (SELECT value FROM json_each(?5))) AND j.id<?1"   \
      " UNION ALL " select " WHERE " where SHOWN                                                   \
      " AND j.state=1 AND ?2=2 AND +j.id IN (SELECT value FROM json_each(?5))"                     \
      " AND j.id<?1 ORDER BY 1 DESC LIMIT ?3"
#define PAGES(select, where)                                                                       \
  {                                                                                                \
    PAGE_OF_ALL(select, where), PAGE_OF_STATE(select, where), PAGE_OF_SHOWN(select, where)         \
  }

/* Queries for any job, by label, by submitter, and by both. */
#define FILTERED(select, where)                                                                    \
  {                                                                                                \
    PAGES(select, where), PAGES(select, where " AND j.label=?7"),                                  \
        PAGES(select, where " AND j.submitted_by=?8"),                                             \
        PAGES(select, where " AND j.submitted_by=?8 AND j.label=?7")                               \
  }

/* Queries that find a few jobs by an index, and check the other conditions row by row. */
#define NARROWED(select, where)                                                                    \
  PAGES(select,                                                                                    \
        where " AND (?4<0 OR +j.kind=?4) AND (?7 IS NULL OR (+j.label>=?7 AND +j.label<=?10))"     \
              " AND (?8 IS NULL OR +j.submitted_by=?8) AND (?11 IS NULL OR +j.experiment=?11)")

/* Returns the index in PAGES of the query. */
static unsigned page_of(const struct mo_job_query *query)
{
  bool waits =
      query->n_waiting > 0 && (query->state == MO_JOB_RUNNING || query->state == MO_JOB_PAUSED);
  return query->state < 0 ? 0 : waits ? 2 : 1;
}

/* Writes the ids of the waiting jobs as JSON. */
static void write_waiting(const struct mo_job_query *query, char text[MO_WAITING_MAX * 24 + 8])
{
  size_t size = 1;
  text[0] = '[';
  for (size_t i = 0; i < query->n_waiting; i++)
    size += (size_t)sprintf(text + size, "%s%lld", i > 0 ? "," : "", (long long)query->waiting[i]);
  memcpy(text + size, "]", 2);
}

/* Writes the pattern of LIKE for texts that contain a text. */
static void write_pattern(const char *text, char pattern[2 * MO_LABEL_BYTES_MAX + 3])
{
  size_t size = 1;
  pattern[0] = '%';
  for (const char *c = text; *c != '\0' && size < 2 * MO_LABEL_BYTES_MAX; c++) {
    if (*c == '%' || *c == '_' || *c == '\\')
      pattern[size++] = '\\';
    pattern[size++] = *c;
  }
  memcpy(pattern + size, "%", 2);
}

int64_t mo_read_jobs(struct mo_store *store, const struct mo_job_query *query, size_t limit,
                     int (*load)(struct mo_connection *reader, int64_t id, void *status),
                     void *statuses, size_t status_size)
{
#define JOBS       "SELECT j.id FROM jobs j"
#define JOBS_BY(x) JOBS " INDEXED BY jobs_" x
  /* For any job; for jobs of a kind. */
  static const char *const sql[2][4][3] = {FILTERED(JOBS, "TRUE"), FILTERED(JOBS, "j.kind=?4")};
  enum { GROUP, EXPERIMENT, LABEL, ARCHIVED };
  static const char *const narrowed[][3] = {
      [GROUP] = NARROWED("SELECT j.id FROM campaigns m CROSS JOIN jobs j ON j.id=m.job",
                         "m.replicates_of=?6"),
      [EXPERIMENT] = NARROWED(JOBS_BY("by_experiment"), "j.experiment=?11"),
      [LABEL] = NARROWED(JOBS_BY("by_label"), "j.label>=?7 AND j.label<=?10"),
      [ARCHIVED] = NARROWED(JOBS_BY("archived"), "j.archived_us>0")};
#undef JOBS_BY
#undef JOBS
  const bool is_prefix = query->label != NULL && query->label_is_prefix;
  const int filter = (query->label != NULL) + 2 * (query->submitted_by != NULL);
  const char *const *pages = query->group != 0           ? narrowed[GROUP]
                             : query->experiment != NULL ? narrowed[EXPERIMENT]
                             : is_prefix                 ? narrowed[LABEL]
                             : query->archived > 0       ? narrowed[ARCHIVED]
                                                         : sql[query->kind >= 0][filter];
  char label[MO_LABEL_BYTES_MAX + 8];
  char waiting[MO_WAITING_MAX * 24 + 8], pattern[2 * MO_LABEL_BYTES_MAX + 3];
  int64_t ids[MO_PAGE_MAX] = {0}, n = 0;
  int error = MO_OK;
  if (limit > MO_PAGE_MAX || query->n_waiting > MO_WAITING_MAX)
    return MO_ERR_LIMIT;
  write_waiting(query, waiting);
  /* The largest character sorts after every label with this prefix. */
  snprintf(label, sizeof(label), "%s%s", query->label != NULL ? query->label : "",
           is_prefix ? "\xf4\x8f\xbf\xbf" : "");
  if (query->search != NULL)
    write_pattern(query->search, pattern);
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row = mo_sql_rows(
      reader, &error, pages[page_of(query)], mo_int(query->before > 0 ? query->before : INT64_MAX),
      mo_int(query->state), mo_int((int64_t)limit), mo_int(query->kind), mo_string(waiting),
      mo_int(query->group), mo_string(query->label), mo_string(query->submitted_by),
      mo_int(query->archived), mo_string(label), mo_string(query->experiment),
      mo_string(query->search != NULL ? pattern : NULL));
  while (mo_sql_next(reader, row, &error))
    ids[n++] = sqlite3_column_int64(row, 0);
  for (int64_t i = 0; i < n && error == MO_OK; i++)
    error = load(reader, ids[i], (char *)statuses + (size_t)i * status_size);
  return error != MO_OK ? error : n;
}

int64_t mo_store_jobs(struct mo_store *store, const struct mo_job_query *query, void *jobs,
                      size_t limit)
{
  return mo_read_jobs(store, query, limit, load_job, jobs, sizeof(struct mo_job));
}

int mo_store_job_counts(struct mo_store *store, uint64_t counts[MO_JOB_STATES])
{
  static const char sql[] =
      "SELECT state,count(*) FROM jobs WHERE state BETWEEN 0 AND 5 GROUP BY state";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql);
  memset(counts, 0, MO_JOB_STATES * sizeof(*counts));
  while (mo_sql_next(reader, row, &error))
    counts[sqlite3_column_int(row, 0)] = (uint64_t)sqlite3_column_int64(row, 1);
  return error;
}
