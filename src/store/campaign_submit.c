/* campaign_submit.c: accepts a campaign with its replicates, and extends a campaign. */
#include <stdio.h>

#include "store/campaign_rows.h"

#include "base/clock.h"
#include "store/contents.h"
#include "store/controller_rows.h"
#include "store/designs.h"
#include "store/jobs.h"

struct setting {
  int64_t controller, physics, set; /* 0: none */
  int64_t n_environments;
  struct mo_campaign_record record; /* with the controller's sensor */
};

static int resolve(struct mo_connection *writer, const struct mo_campaign_request *request,
                   struct setting *setting)
{
  struct mo_campaign_settings *settings = &setting->record.settings;
  int error = MO_OK;
  *setting =
      (struct setting){.record = request->record, .n_environments = request->record.n_environments};
  if (request->controller != NULL)
    error = mo_controller_find(writer, request->controller, &setting->controller, &settings->sensor,
                               &settings->physics);
  if (error == MO_OK)
    error = mo_campaign_settings_check(settings, NULL);
  if (error == MO_OK)
    error =
        mo_physics_row(writer, &settings->physics, MO_FLOAT32, settings->sensor, &setting->physics);
  if (error == MO_OK && setting->record.environment_set[0] != '\0')
    error = mo_environment_set_find(writer, setting->record.environment_set, &setting->set,
                                    &setting->n_environments);
  return error;
}

/* ---- the population of another campaign ---- */

/* Finds the genotype of a member. Returns 1 if it fits the campaign's workspace as it is, otherwise
 * 0. */
static int find_member(struct mo_connection *writer, const struct mo_campaign_record *record,
                       uint32_t number, int64_t *genotype)
{
  static const char sql[] = "SELECT d.genotype,g.bits FROM campaign_designs d"
                            " JOIN genotypes g ON g.id=d.genotype WHERE d.job=?1 AND d.number=?2";
  struct mo_genotype bits;
  sqlite3_stmt *row;
  int error = mo_sql_row(writer, &row, sql, mo_int(record->initial_campaign), mo_int(number));
  if (error == MO_OK)
    error = mo_column_genotype(row, 1, &bits);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  *genotype = sqlite3_column_int64(row, 0);
  return mo_fits_as_it_is(record->settings.workspace, &bits);
}

/* Adds a note that a member of the initial campaign was left out. place: its rank, from 0. */
static int note_misfit(struct mo_connection *writer, const struct mo_campaign_record *record,
                       uint32_t place, uint32_t number, int64_t group)
{
  const struct mo_workspace w = record->settings.workspace;
  struct mo_design_note note = {.place = place, .fault.where = "/initial/campaign"};
  snprintf(note.fault.detail, sizeof(note.fault.detail),
           "design %u of campaign %lld does not fit the workspace of %u × %u × %u voxels",
           (unsigned)number, (long long)record->initial_campaign, w.nx, w.ny, w.nz);
  return mo_notes_insert(writer, group, &note, 1);
}

static int insert_inherited(struct mo_connection *writer, const struct mo_campaign_record *record,
                            int64_t group)
{
  struct mo_campaign_members members = {.n = 0};
  struct mo_campaign_head head = {0};
  uint32_t n = 0; /* with an initial campaign, no designs are listed */
  int error = mo_campaign_head_get(writer, record->initial_campaign, &head);
  if (error == MO_OK && head.generation < 0)
    error = MO_ERR_CONFLICT;
  if (error == MO_OK)
    error = mo_campaign_members_get(writer, record->initial_campaign, head.generation, &members);
  for (uint32_t i = 0; i < members.n && n < record->settings.population && error == MO_OK; i++) {
    int64_t genotype = 0;
    const uint32_t number = members.population[i].number;
    const int fitting = find_member(writer, record, number, &genotype);
    if (fitting < 0)
      error = fitting;
    else if (fitting > 0)
      error = mo_design_insert(writer, group, n++, genotype);
    else
      error = note_misfit(writer, record, i, number, group);
  }
  return error == MO_OK && n == 0 ? MO_ERR_EMPTY : error;
}

/* ---- submission ---- */

/* Inserts one replicate. Its seed is the seed of the first plus its number. */
static int insert_replicate(struct mo_store *store, const struct mo_campaign_request *request,
                            const struct setting *setting, uint32_t replicate, int64_t *group)
{
  static const char sql[] =
      "INSERT INTO campaigns(job,generations,preset,physics,environment_set,n_environments,"
      "n_listed,initial_campaign,replicates_of,replicate,replicates,generation,n_designs,"
      "diversity_max,ended,scored_generation,scored)"
      " VALUES(?1,?2,?3,?4,nullif(?5,0),?6,?7,?8,?9,?10,?11,-1,0,0,0,-1,0)";
  static const char study_sql[] =
      "INSERT INTO studies(job,batch,sha256,children) VALUES(?1,-1,zeroblob(32),x'')";
  struct mo_connection *writer = &store->writer;
  struct mo_campaign_record record = setting->record;
  const struct mo_value generations = mo_int(record.settings.generations);
  int64_t id = 0;
  int error = mo_job_insert(writer, &request->job, MO_JOB_CAMPAIGN, &id);
  if (replicate == 0)
    *group = id;
  else if (error == MO_OK && id != *group + replicate)
    error = MO_ERR_CORRUPT; /* jobs get consecutive ids */
  record.settings.seed += replicate;
  if (error == MO_OK)
    error = mo_run_insert(writer, id, MO_JOB_CAMPAIGN, &record, record.name, setting->controller,
                          request->controller);
  if (error == MO_OK)
    error =
        mo_sql_do(writer, sql, mo_int(id), generations, mo_string(record.preset),
                  mo_int(setting->physics), mo_int(setting->set), mo_int(setting->n_environments),
                  mo_int(record.n_listed), mo_int(record.initial_campaign), mo_int(*group),
                  mo_int(replicate), mo_int(record.replicates));
  if (error == MO_OK && !mo_modes[record.settings.mode].makes_children)
    error = mo_sql_do(writer, study_sql, mo_int(id));
  if (error != MO_OK)
    return error;
  return mo_writer_event(
      store, id, "job.created",
      "{\"id\":\"%lld\",\"kind\":\"campaign\",\"state\":\"queued\",\"generations\":%u,"
      "\"replicates_of\":\"%lld\"}",
      (long long)id, (unsigned)record.settings.generations, (long long)*group);
}

static int insert(struct mo_store *store, const void *any, int64_t *id)
{
  const struct mo_campaign_request *request = any;
  const struct mo_campaign_record *record = &request->record;
  struct mo_connection *writer = &store->writer;
  struct setting setting;
  int error = resolve(writer, request, &setting);
  for (uint32_t r = 0; r < record->replicates && error == MO_OK; r++)
    error = insert_replicate(store, request, &setting, r, id);
  if (error == MO_OK)
    error = mo_environments_insert(writer, *id, setting.set, request->environments,
                                   (uint32_t)setting.n_environments);
  if (error == MO_OK)
    error = mo_designs_insert(writer, *id, request->forms, request->genotypes, record->n_listed,
                              NULL, 0, mo_clock_wall_us());
  if (error == MO_OK)
    error = mo_notes_insert(writer, *id, request->notes, request->n_notes);
  if (error == MO_OK && record->initial_campaign != 0)
    error = insert_inherited(writer, record, *id);
  for (uint32_t r = 0; r < record->replicates && error == MO_OK; r++)
    error = mo_run_announce_warnings(store, *id + r, true);
  return error;
}

struct campaign_submission {
  const struct mo_campaign_request *request;
  int64_t *found; /* the existing study with the request's label */
};

static int find_or_insert(struct mo_store *store, const void *any, int64_t *id)
{
  const struct campaign_submission *call = any;
  const struct mo_campaign_request *request = call->request;
  const int error = request->reuses ? mo_study_find(&store->writer, request->job.label, call->found)
                                    : MO_ERR_NOT_FOUND;
  return error == MO_ERR_NOT_FOUND ? insert(store, request, id)
         : error == MO_OK          ? MO_ERR_DUPLICATE
                                   : error;
}

int mo_store_submit_campaign(struct mo_store *store, const struct mo_campaign_request *request,
                             int64_t *id, bool *replayed)
{
  const struct campaign_submission call = {request, id};
  return mo_submit(store, &request->job.key, find_or_insert, &call, id, replayed);
}

/* ---- extension ---- */

struct extend_arguments {
  int64_t id;
  uint32_t generations;
  const struct mo_request_key *key;
  enum mo_job_state before;
};

/* Checks whether a campaign may have this many generations. */
static int check_extension(const struct mo_campaign_settings *settings, uint64_t generations)
{
  uint64_t steps = settings->child_steps +
                   ((uint64_t)settings->parent_steps + settings->child_steps) * generations;
  if (generations > MO_GENERATIONS_MAX ||
      settings->population * (generations + 1) > MO_CAMPAIGN_DESIGNS_MAX)
    return MO_ERR_RANGE;
  if (!mo_modes[settings->mode].inherits_learning)
    return MO_OK;
  if (settings->learning.schedule.kind == MO_SCHEDULE_COSINE)
    return MO_ERR_UNSUPPORTED;
  return steps > MO_TRAINING_STEPS_MAX ? MO_ERR_RANGE : MO_OK;
}

/* Checks that the learning state after the newest generation exists, if the next generation starts
 * from it (simultaneous). MO_ERR_EMPTY: the state does not exist. */
static int check_learning(struct mo_connection *writer, int64_t id, enum mo_campaign_mode mode)
{
  static const char sql[] =
      "SELECT count(*) FROM campaigns m WHERE m.job=?1 AND (m.generation<0 OR EXISTS("
      "SELECT 1 FROM checkpoints c WHERE c.job=?1 AND c.generation=m.generation))";
  int64_t n = 0;
  if (!mo_modes[mode].inherits_learning)
    return MO_OK;
  const int error = mo_sql_find(writer, &n, sql, mo_int(id));
  return error == MO_OK && n == 0 ? MO_ERR_EMPTY : error;
}

static int extend(struct mo_store *store, void *arguments)
{
  static const char find_sql[] = "SELECT r.settings,m.generations,m.ended FROM campaigns m"
                                 " JOIN runs r ON r.job=m.job WHERE m.job=?1";
  static const char job_sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION ",state=CASE state WHEN 3 THEN 0 ELSE state END,"
      "finished_us=CASE state WHEN 3 THEN 0 ELSE finished_us END WHERE id=?1";
  static const char run_sql[] = "UPDATE runs SET result=NULL WHERE job=?1";
  static const char sql[] = "UPDATE campaigns SET generations=?2,ended=0 WHERE job=?1";
  struct extend_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  const struct mo_value id = mo_int(call->id);
  struct mo_campaign_record record;
  enum mo_job_kind kind;
  enum mo_job_state state = MO_JOB_QUEUED;
  uint64_t generations;
  int64_t known;
  char more[96];
  sqlite3_stmt *row;
  int error = call->key != NULL ? mo_key_find(writer, call->key, &known) : MO_ERR_NOT_FOUND;
  call->before = MO_JOB_QUEUED;
  if (error != MO_ERR_NOT_FOUND)
    return error == MO_ERR_CONFLICT ? MO_ERR_DUPLICATE : error;
  error = mo_job_state_get(writer, call->id, &state, &kind);
  if (error == MO_OK)
    error = mo_sql_row(writer, &row, find_sql, id); /* not found: a job of a different kind */
  if (error == MO_OK)
    error = mo_column_settings(row, 0, MO_JOB_CAMPAIGN, &record);
  if (error != MO_OK)
    return error;
  generations = (uint64_t)sqlite3_column_int64(row, 1) + call->generations;
  int ended = sqlite3_column_int(row, 2);
  error = state > MO_JOB_SUCCEEDED || ended == MO_CAMPAIGN_EXHAUSTED
              ? MO_ERR_CONFLICT
              : check_extension(&record.settings, generations);
  if (error == MO_OK)
    error = check_learning(writer, call->id, record.settings.mode);
  if (error == MO_OK)
    error = mo_sql_do(writer, job_sql, id);
  if (error == MO_OK)
    error = mo_sql_do(writer, run_sql, id);
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, id, mo_int((int64_t)generations));
  if (error == MO_OK && call->key != NULL)
    error = mo_key_insert(writer, call->key, call->id);
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
  const int error = mo_write(store, extend, &call);
  *before = call.before;
  return error;
}
