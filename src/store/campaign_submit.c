/* campaign_submit.c: accepts a campaign with its replicates, and extends a campaign. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"

#include "base/clock.h"

struct submit_arguments {
  const struct mo_campaign_submission *submission;
  int64_t id;
  bool replayed;
};

struct setting {
  int64_t controller, physics, set; /* 0: none */
  uint32_t n_environments;
  struct mo_campaign_settings settings; /* with the controller's sensor */
};

static int resolve(struct mo_connection *writer, const struct mo_campaign_submission *submission,
                   struct setting *setting)
{
  const struct mo_campaign_record *record = &submission->record;
  int64_t n = record->n_environments;
  int error = MO_OK;
  *setting = (struct setting){.settings = record->settings};
  if (submission->controller != NULL) {
    error = mo_controller_find(writer, submission->controller, &setting->controller);
    if (error == MO_OK)
      error = mo_controller_sensor(writer, setting->controller, &setting->settings.sensor);
  }
  if (error == MO_OK)
    error = mo_physics_row(writer, &setting->settings.physics, MO_FLOAT32, setting->settings.sensor,
                           &setting->physics);
  if (error == MO_OK && record->environment_set[0] != '\0') {
    error = mo_environment_set_find(writer, record->environment_set, &setting->set, &n);
    if (error == MO_OK && setting->set == 0) /* 0 means that there is no set */
      error = MO_ERR_CORRUPT;
  }
  if (error == MO_OK && (n < 1 || n > MO_ENVIRONMENTS_MAX))
    error = setting->set != 0 ? MO_ERR_CORRUPT : MO_ERR_RANGE;
  setting->n_environments = (uint32_t)n;
  return error;
}

static int insert_campaign(struct mo_connection *writer,
                           const struct mo_campaign_submission *submission,
                           const struct setting *setting, int64_t id, int64_t group)
{
  static const char sql[] = "INSERT INTO "
                            "campaigns(job,settings,generations,name,preset,controller,controller_"
                            "name,physics,environment_set,"
                            "n_environments,n_listed,initial_campaign,replicates_of,replicate,"
                            "replicates,checkpoint_every_s,generation,"
                            "n_designs,diversity_max,ended,scored_generation,scored) "
                            "VALUES(?1,?2,?3,?4,?5,nullif(?6,0),?7,?8,nullif(?9,0),"
                            "?10,?11,?12,?13,?14,?15,?16,-1,0,0,0,-1,0)";
  const struct mo_campaign_record *record = &submission->record;
  bool named = submission->controller != NULL && strncmp(submission->controller, "sha256:", 7) != 0;
  struct mo_campaign_settings settings = setting->settings;
  uint8_t bytes[MO_CAMPAIGN_BYTES];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  settings.seed += (uint64_t)(id - group);
  mo_encode_campaign(&settings, bytes);
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_blob(statement, 2, bytes, sizeof(bytes), SQLITE_STATIC);
  sqlite3_bind_int64(statement, 3, settings.generations);
  sqlite3_bind_text(statement, 4, record->name, -1, SQLITE_STATIC);
  sqlite3_bind_text(statement, 5, record->preset, -1, SQLITE_STATIC);
  sqlite3_bind_int64(statement, 6, setting->controller);
  sqlite3_bind_text(statement, 7, named ? submission->controller : "", -1, SQLITE_STATIC);
  sqlite3_bind_int64(statement, 8, setting->physics);
  sqlite3_bind_int64(statement, 9, setting->set);
  sqlite3_bind_int64(statement, 10, setting->n_environments);
  sqlite3_bind_int64(statement, 11, record->n_listed);
  sqlite3_bind_int64(statement, 12, record->initial_campaign);
  sqlite3_bind_int64(statement, 13, group);
  sqlite3_bind_int64(statement, 14, id - group);
  sqlite3_bind_int64(statement, 15, record->replicates);
  sqlite3_bind_int64(statement, 16, record->checkpoint_every_s);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error;
}

static int insert_environments(struct mo_connection *writer,
                               const struct mo_campaign_submission *submission,
                               const struct setting *setting, int64_t group)
{
  static const char copy_sql[] =
      "INSERT INTO campaign_environments(job,position,environment)"
      " SELECT ?1,position,environment FROM environment_set_members WHERE environment_set=?2";
  static const char sql[] =
      "INSERT INTO campaign_environments(job,position,environment) VALUES(?1,?2,?3)";
  return mo_environments_insert(writer, copy_sql, sql, group, setting->set,
                                submission->environments, setting->n_environments);
}

/* ---- the population of another campaign ---- */

static int compare_rows(const void *a, const void *b)
{
  int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
  return (x > y) - (x < y);
}

/* Reads the row ids of the designs that the group lists, ascending. */
static int load_listed(struct mo_connection *writer, int64_t group, int64_t *designs, uint32_t n)
{
  static const char sql[] =
      "SELECT g.design FROM campaign_initial x JOIN genotypes g ON g.id=x.genotype"
      " WHERE x.job=?1 LIMIT ?2";
  uint32_t found = 0;
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, group);
  sqlite3_bind_int64(statement, 2, n);
  while ((step = mo_sql_step(writer, statement)) > 0)
    designs[found++] = sqlite3_column_int64(statement, 0);
  qsort(designs, found, sizeof(*designs), compare_rows);
  return step < 0 ? step : found == n ? MO_OK : MO_ERR_CORRUPT;
}

static int fits(const struct mo_bits *bits, struct mo_workspace workspace)
{
  struct mo_bits moved;
  int error = mo_workspace_words(workspace) > MO_DEFAULT_WORDS
                  ? MO_OK /* the workspace is larger than the default one, so all designs fit */
                  : mo_genotype_move(MO_DEFAULT_WORKSPACE, bits->words, workspace, moved.words);
  return error == MO_OK ? 1 : error == MO_ERR_RANGE ? 0 : error;
}

/* Finds the genotype of a member. Returns 1: the campaign takes it; 0: its form is listed already,
 * or it does not fit. */
static int find_member(struct mo_connection *writer, const struct mo_campaign_record *record,
                       uint32_t number, const int64_t *listed, int64_t *genotype)
{
  static const char sql[] =
      "SELECT d.genotype,g.design,g.bits FROM campaign_designs d JOIN genotypes g"
      " ON g.id=d.genotype WHERE d.job=?1 AND d.number=?2";
  struct mo_bits bits;
  int64_t design;
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, record->initial_campaign);
  sqlite3_bind_int64(statement, 2, number);
  step = mo_sql_step(writer, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_CORRUPT;
  *genotype = sqlite3_column_int64(statement, 0);
  design = sqlite3_column_int64(statement, 1);
  error = mo_column_bits(statement, 2, &bits);
  (void)sqlite3_reset(statement);
  if (error != MO_OK)
    return error;
  if (record->n_listed > 0 &&
      bsearch(&design, listed, record->n_listed, sizeof(*listed), compare_rows) != NULL)
    return 0;
  return fits(&bits, record->settings.workspace);
}

static int insert_inherited(struct mo_connection *writer, const struct mo_campaign_record *record,
                            int64_t group)
{
  static const char sql[] = "INSERT INTO campaign_initial(job,position,genotype) VALUES(?1,?2,?3)";
  int64_t *listed = calloc(record->n_listed + 1, sizeof(*listed));
  struct mo_campaign_blobs blobs = {.n = 0};
  struct mo_campaign_head head = {0};
  uint32_t n = record->n_listed;
  int error = listed == NULL ? MO_ERR_NO_MEMORY
                             : mo_campaign_head_get(writer, record->initial_campaign, &head);
  if (error == MO_OK && head.generation < 0)
    error = MO_ERR_CONFLICT;
  if (error == MO_OK)
    error = load_listed(writer, group, listed, n);
  if (error == MO_OK)
    error = mo_campaign_blobs_get(writer, record->initial_campaign, head.generation, &blobs);
  for (uint32_t i = 0; i < blobs.n && n < record->settings.population && error == MO_OK; i++) {
    uint32_t number = mo_decode_u32(blobs.population + (size_t)i * MO_MEMBER_BYTES);
    int64_t genotype = 0;
    int welcome = find_member(writer, record, number, listed, &genotype);
    sqlite3_stmt *statement;
    if (welcome < 0)
      error = welcome;
    else if (welcome > 0 && (statement = mo_sql(writer, sql, &error)) != NULL) {
      sqlite3_bind_int64(statement, 1, group);
      sqlite3_bind_int64(statement, 2, n++);
      sqlite3_bind_int64(statement, 3, genotype);
      error = mo_sql_run(writer, statement);
    }
  }
  if (blobs.statement != NULL)
    (void)sqlite3_reset(blobs.statement);
  free(listed);
  return error;
}

/* ---- submission ---- */

static int submit_replicate(struct mo_store *store, const struct mo_campaign_submission *submission,
                            const struct setting *setting, uint32_t replicate, int64_t now_us,
                            int64_t *group)
{
  char data[192];
  int64_t id = 0;
  int error =
      mo_job_insert(&store->writer, MO_JOB_CAMPAIGN, submission->priority, submission->back_end,
                    submission->weight, submission->label, now_us, &id);
  if (replicate == 0)
    *group = id;
  else if (error == MO_OK && id != *group + replicate)
    error = MO_ERR_CORRUPT; /* ids of jobs grow by one */
  if (error == MO_OK)
    error = insert_campaign(&store->writer, submission, setting, id, *group);
  if (error != MO_OK)
    return error;
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"kind\":\"campaign\",\"state\":\"queued\",\"generations\":%u,"
           "\"replicates_of\":\"%lld\"}",
           (long long)id, (unsigned)setting->settings.generations, (long long)*group);
  return mo_writer_event(store, id, "job.created", data);
}

static int submit(struct mo_store *store, void *arguments)
{
  static const char initial_sql[] =
      "INSERT INTO campaign_initial(job,position,genotype) VALUES(?1,?2,?3)";
  struct submit_arguments *call = arguments;
  const struct mo_campaign_submission *submission = call->submission;
  const struct mo_campaign_record *record = &submission->record;
  struct mo_connection *writer = &store->writer;
  struct setting setting;
  int64_t now_us = mo_clock_wall_us();
  int error;
  call->replayed = false;
  if (submission->idempotency_key != NULL) {
    error = mo_key_find(writer, submission->idempotency_key, &submission->body_sha256, &call->id);
    call->replayed = error == MO_OK;
    if (error != MO_ERR_NOT_FOUND)
      return error;
  }
  error = resolve(writer, submission, &setting);
  for (uint32_t r = 0; r < record->replicates && error == MO_OK; r++)
    error = submit_replicate(store, submission, &setting, r, now_us, &call->id);
  if (error == MO_OK)
    error = insert_environments(writer, submission, &setting, call->id);
  if (error == MO_OK)
    error = mo_designs_insert(writer, initial_sql, call->id, submission->forms,
                              submission->genotypes, record->n_listed, now_us);
  if (error == MO_OK && record->initial_campaign != 0)
    error = insert_inherited(writer, record, call->id);
  if (error == MO_OK && submission->idempotency_key != NULL)
    error = mo_key_insert(writer, submission->idempotency_key, &submission->body_sha256, now_us,
                          call->id);
  return error;
}

int mo_store_submit_campaign(struct mo_store *store,
                             const struct mo_campaign_submission *submission, int64_t *id,
                             bool *replayed)
{
  struct submit_arguments call = {.submission = submission};
  const struct mo_campaign_record *record = &submission->record;
  int error;
  if (record->replicates < 1 || record->replicates > MO_REPLICATES_MAX ||
      record->settings.population > MO_POPULATION_MAX ||
      record->n_listed > record->settings.population)
    return MO_ERR_RANGE;
  error = mo_write(store, submit, &call);
  if (error == MO_OK) {
    *id = call.id;
    *replayed = call.replayed;
  }
  return error;
}

/* ---- extension ---- */

struct extend_arguments {
  int64_t id;
  uint32_t generations;
  const struct mo_request_key *key;
  enum mo_job_state before;
};

/* Checks whether a campaign may have so many generations. */
static int check_extension(const struct mo_campaign_settings *settings, uint64_t generations)
{
  uint64_t steps = settings->child_steps +
                   ((uint64_t)settings->parent_steps + settings->child_steps) * generations;
  if (generations > MO_GENERATIONS_MAX ||
      settings->population * (generations + 1) > MO_CAMPAIGN_DESIGNS_MAX)
    return MO_ERR_RANGE;
  if (settings->mode != MO_SIMULTANEOUS)
    return MO_OK;
  if (settings->learning.schedule.kind == MO_SCHEDULE_COSINE)
    return MO_ERR_UNSUPPORTED;
  return steps > MO_TRAINING_STEPS_MAX ? MO_ERR_RANGE : MO_OK;
}

/* Checks that the learning state after the newest generation exists, if the next generation starts
 * from it (simultaneous). MO_ERR_EMPTY: it does not. */
static int check_learning(struct mo_connection *writer, int64_t id, enum mo_campaign_mode mode)
{
  static const char sql[] =
      "SELECT count(*) FROM campaigns m WHERE m.job=?1 AND (m.generation<0 OR EXISTS("
      "SELECT 1 FROM campaign_checkpoints c WHERE c.job=?1 AND c.generation=m.generation))";
  int error = MO_OK;
  int64_t n = 0;
  sqlite3_stmt *statement = mode == MO_SIMULTANEOUS ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  error = mo_sql_integer(writer, statement, &n);
  return error == MO_OK && n == 0 ? MO_ERR_EMPTY : error;
}

static int extend(struct mo_store *store, void *arguments)
{
  static const char find_sql[] =
      "SELECT m.settings,m.generations,m.ended FROM campaigns m WHERE m.job=?1";
  static const char job_sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION ",state=CASE state WHEN 3 THEN 0 ELSE state END,"
      "finished_us=CASE state WHEN 3 THEN 0 ELSE finished_us END WHERE id=?1";
  static const char sql[] = "UPDATE campaigns SET generations=?2,ended=0,result=NULL WHERE job=?1";
  struct extend_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  struct mo_campaign_settings settings;
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  enum mo_job_state state = MO_JOB_QUEUED;
  uint64_t generations;
  int ended, step;
  char more[96];
  sqlite3_stmt *statement;
  int64_t known;
  int error = call->key != NULL ? mo_key_find(writer, call->key->text, &call->key->sha256, &known)
                                : MO_ERR_NOT_FOUND;
  call->before = MO_JOB_QUEUED;
  if (error != MO_ERR_NOT_FOUND)
    return error == MO_ERR_CONFLICT ? MO_ERR_DUPLICATE : error;
  error = mo_job_state_get(writer, call->id, &state, &kind);
  if (error == MO_OK && kind != MO_JOB_CAMPAIGN)
    error = MO_ERR_NOT_FOUND;
  statement = error == MO_OK ? mo_sql(writer, find_sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  step = mo_sql_step(writer, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_CORRUPT;
  error = mo_decode_campaign(sqlite3_column_blob(statement, 0),
                             (size_t)sqlite3_column_bytes(statement, 0), &settings);
  generations = (uint64_t)sqlite3_column_int64(statement, 1) + call->generations;
  ended = sqlite3_column_int(statement, 2);
  (void)sqlite3_reset(statement);
  if (error == MO_OK && (state > MO_JOB_SUCCEEDED || ended == MO_CAMPAIGN_EXHAUSTED))
    error = MO_ERR_CONFLICT;
  if (error == MO_OK)
    error = check_extension(&settings, generations);
  if (error == MO_OK)
    error = check_learning(writer, call->id, settings.mode);
  statement = error == MO_OK ? mo_sql(writer, job_sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  error = mo_sql_run(writer, statement);
  statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, (sqlite3_int64)generations);
  error = mo_sql_run(writer, statement);
  if (error == MO_OK && call->key != NULL)
    error =
        mo_key_insert(writer, call->key->text, &call->key->sha256, mo_clock_wall_us(), call->id);
  if (error != MO_OK)
    return error;
  call->before = state;
  snprintf(more, sizeof(more), ",\"generations\":%llu,\"added\":%u",
           (unsigned long long)generations, (unsigned)call->generations);
  return mo_run_announce(store, call->id, MO_JOB_CAMPAIGN, "campaign.extended",
                         state == MO_JOB_SUCCEEDED ? MO_JOB_QUEUED : state, more);
}

int mo_store_extend_campaign(struct mo_store *store, int64_t id, uint32_t generations,
                             const struct mo_request_key *key, enum mo_job_state *before)
{
  struct extend_arguments call = {.id = id, .generations = generations, .key = key};
  int error = generations == 0 ? MO_ERR_RANGE : mo_write(store, extend, &call);
  if (error == MO_OK && before != NULL)
    *before = call.before;
  return error;
}
