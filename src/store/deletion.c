/* deletion.c: see deletion.h.
 *
 * The first transaction sets the job's state to 6, which hides it from readers, and deletes its
 * recordings. Then checkpoint files and rows are deleted, at most ROWS_MAX per transaction, so that
 * a campaign of a million designs delays other writes only by milliseconds. Each step finds its
 * work in the database, so a restart continues it. On a full disk the first transaction may use the
 * reserve, and files are deleted; the other steps wait until there is space.
 *
 * The jobs of an import that did not end are in state 6, too (import_state.h), and are deleted in
 * the same way. */
#include "store/deletion.h"

#include <stdlib.h>

#include "base/clock.h"
#include "store/atlases.h"
#include "store/checkpoint_files.h"
#include "store/credible.h"
#include "store/import_state.h"
#include "store/recordings.h"
#include "store/runs.h"

#define ROWS_MAX     1000                 /* roughly, in one transaction */
#define EXPIRE_MAX   100                  /* jobs and recordings per check; one check a minute */
#define EXPIRE_BYTES (UINT64_C(64) << 20) /* of recordings per check; at least one job's */
#define UPKEEP_US    INT64_C(60000000)

/* ---- the first transaction ---- */

/* Selects the jobs that need this one, as texts. */
#define NEEDING(id)                                                                                \
  "SELECT words FROM ("                                                                            \
  "SELECT job,'training '||job||' learns on its designs' words FROM trainings"                     \
  " WHERE population=" id " AND population<>0 UNION ALL"                                           \
  " SELECT job,'certificate '||job||' is about its designs' FROM certificates"                     \
  " WHERE population=" id " AND population<>0 UNION ALL"                                           \
  " SELECT job,'campaign '||job||' was bred from its population' FROM campaigns"                   \
  " WHERE initial_campaign=" id " AND initial_campaign<>0 UNION ALL"                               \
  " SELECT job,'campaign '||job||', a replicate, shares its environments' FROM campaigns"          \
  " WHERE replicates_of=" id " AND job<>" id " UNION ALL"                                          \
  " SELECT r.job,'job '||r.job||' began with its controller' FROM runs o JOIN runs r"              \
  " ON r.controller=o.result AND r.controller IS NOT NULL AND r.job<>o.job WHERE o.job=" id ")"    \
  " JOIN jobs j ON j.id=job AND j.state<>6"

/* Describes a job that needs this one. MO_ERR_NOT_FOUND: no such job. */
static int find_dependent(struct mo_connection *writer, int64_t id, struct mo_message *message)
{
  static const char sql[] = NEEDING("?1") " ORDER BY job DESC LIMIT 1";
  char words[128];
  sqlite3_stmt *row;
  const int error = mo_sql_row(writer, &row, sql, mo_int(id));
  if (error != MO_OK)
    return error;
  mo_column_text(row, 0, words, sizeof(words));
  return mo_fail(message, MO_OK, "%s", words);
}

struct mark {
  int64_t id;
  const char *reason;
  struct mo_deleted deleted;
  struct mo_message *message; /* nullable */
};

static int mark(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE jobs SET state=6," MO_NEXT_VERSION " WHERE id=?1";
  static const char import_sql[] = "DELETE FROM imports WHERE job=?1";
  static const char verdicts_sql[] = "DELETE FROM certificate_verdicts WHERE job=?1";
  static const char checkpoints_sql[] =
      "SELECT count(*),coalesce(sum(size),0) FROM checkpoints WHERE job=?1";
  struct mark *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_state state;
  enum mo_job_kind kind;
  int64_t recorded_bytes = 0;
  sqlite3_stmt *row;
  int error = mo_job_state_get(writer, call->id, &state, &kind);
  if (error == MO_OK && (int)state == MO_JOB_STATES)
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK && !mo_job_state_is_final(state))
    error = MO_ERR_CONFLICT;
  if (error != MO_OK)
    return error;
  error = find_dependent(writer, call->id, call->message);
  if (error != MO_ERR_NOT_FOUND)
    return error == MO_OK ? MO_ERR_CONFLICT : error;
  error = kind == MO_JOB_EVALUATION ? mo_recordings_drop(writer, call->id, &recorded_bytes) : MO_OK;
  if (error == MO_OK)
    error = mo_sql_row(writer, &row, checkpoints_sql, mo_int(call->id));
  if (error == MO_OK)
    call->deleted = (struct mo_deleted){.recorded_bytes = (uint64_t)recorded_bytes,
                                        .n_checkpoints = (uint64_t)sqlite3_column_int64(row, 0),
                                        .checkpoint_bytes = (uint64_t)sqlite3_column_int64(row, 1)};
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, mo_int(call->id));
  if (error == MO_OK) /* its bundle may be imported again at once */
    error = mo_sql_do(writer, import_sql, mo_int(call->id));
  if (error == MO_OK) /* lists no longer mention it */
    error = mo_sql_do(writer, verdicts_sql, mo_int(call->id));
  if (error != MO_OK)
    return error;
  return mo_writer_event(store, call->id, "job.deleted",
                         "{\"id\":\"%lld\",\"kind\":\"%s\",\"reason\":\"%s\"}", (long long)call->id,
                         mo_job_kind_name(kind), call->reason);
}

/* ---- the steps ---- */

/* Deletes the rows of ?1 with the next keys. Each table is found by job and key. */
#define PART(table, key, keys)                                                                     \
  "DELETE FROM " table " WHERE job=?1 AND " key "<" keys "+(SELECT min(" key ") FROM " table       \
  " WHERE job=?1)"
static const char *const parts[] = {PART("recomputed", "position", "16"),
                                    PART("job_designs", "position", "1000"),
                                    PART("waiting_designs", "first", "100000"),
                                    PART("job_environments", "position", "1000"),
                                    PART("design_notes", "position", "1000"),
                                    PART("training_steps", "step", "1000"),
                                    PART("training_validations", "step", "1000"),
                                    PART("training_code", "from_step", "1000"),
                                    PART("training_bodies", "position", "1000"),
                                    PART("campaign_losses", "place", "1000"),
                                    PART("certificate_losses", "trial", "1"),
                                    PART("campaign_steps", "generation", "16"),
                                    PART("campaign_held_out", "generation", "10"),
                                    PART("campaign_generations", "generation", "1000"),
                                    PART("campaign_populations", "generation", "64"),
                                    PART("campaign_designs", "number", "1000"),
                                    "DELETE FROM idempotency_keys WHERE job=?1",
                                    "DELETE FROM evaluations WHERE job=?1",
                                    "DELETE FROM trainings WHERE job=?1",
                                    "DELETE FROM atlases WHERE job=?1",
                                    "DELETE FROM certificates WHERE job=?1",
                                    "DELETE FROM study_words WHERE job=?1",
                                    "DELETE FROM studies WHERE job=?1",
                                    "DELETE FROM campaigns WHERE job=?1",
                                    "DELETE FROM runs WHERE job=?1",
                                    "DELETE FROM jobs WHERE id=?1"};
#undef PART

struct round {
  struct mo_store *store;
  int (*step)(struct mo_store *store, void *arguments);
  uint64_t n; /* rows deleted, or jobs marked */
};

/* Only an evaluation of an import still has recordings here. */
static int drop_recordings(struct mo_connection *writer, int64_t id)
{
  int64_t bytes = 0;
  const int error = mo_recordings_drop(writer, id, &bytes);
  return error == MO_ERR_NOT_FOUND ? MO_OK : error; /* not an evaluation */
}

static int delete_some(struct mo_store *store, void *arguments)
{
  static const char next_sql[] = "SELECT id FROM jobs WHERE state=6 AND epoch>=0 AND NOT EXISTS("
                                 "SELECT 1 FROM checkpoints WHERE job=id) ORDER BY id LIMIT 1";
  struct mo_connection *writer = &store->writer;
  struct round *round = arguments;
  int64_t id;
  int error = mo_checkpoints_forget(store, &round->n);
  while (error == MO_OK && round->n < ROWS_MAX &&
         (error = mo_sql_find(writer, &id, next_sql)) == MO_OK) {
    size_t part = 0;
    error = drop_recordings(writer, id);
    while (part < sizeof(parts) / sizeof(parts[0]) && error == MO_OK && round->n < ROWS_MAX) {
      error = mo_sql_do(writer, parts[part], mo_int(id));
      const int n = error == MO_OK ? sqlite3_changes(writer->db) : 0;
      round->n += (uint64_t)n;
      part += n == 0;
    }
  }
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

/* Marks jobs of a kind that ended, or were imported, long ago. Jobs with a note, archived jobs, and
 * jobs that another job needs are kept. */
static int expire_kind(struct mo_store *store, int kind, uint64_t *n_marked)
{
  static const char sql[] =
      "SELECT d.id FROM jobs d INDEXED BY jobs_by_end WHERE d.kind=?1 AND d.state>=3 AND d.state<6"
      " AND d.archived_us=0 AND d.note IS NULL AND d.finished_us<?2"
      " AND NOT EXISTS(SELECT 1 FROM imports WHERE job=d.id AND imported_us>=?2)"
      " AND NOT EXISTS(" NEEDING("d.id") ") ORDER BY d.finished_us LIMIT ?3";
  int64_t ids[EXPIRE_MAX];
  size_t n = 0;
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(&store->writer, &error, sql, mo_int(kind),
                  mo_int(mo_clock_wall_us() - store->keep_jobs_us[kind]), mo_int(store->aged_left));
  while (mo_sql_next(&store->writer, row, &error))
    ids[n++] = sqlite3_column_int64(row, 0);
  uint64_t bytes = 0;
  for (size_t i = 0; i < n && error == MO_OK && bytes < EXPIRE_BYTES; i++) {
    struct mark one = {.id = ids[i], .reason = "age"};
    error = mark(store, &one);
    bytes += one.deleted.recorded_bytes;
    store->aged_left--;
    ++*n_marked;
  }
  return error;
}

static int expire(struct mo_store *store, void *arguments)
{
  struct round *round = arguments;
  int error = mo_clock_check(store);
  round->n = 0;
  for (int kind = 0; kind < MO_JOB_KINDS && error == MO_OK; kind++)
    if (store->keep_jobs_us[kind] > 0 && mo_clock_is_credible(store))
      error = expire_kind(store, kind, &round->n);
  return error;
}

static void run(struct mo_store *store, int (*step)(struct mo_store *store, void *arguments));

/* Queues the next step if this one found something to delete. */
static void done(void *arguments, int status)
{
  struct round *round = arguments;
  if (status == MO_OK && round->n > 0) {
    run(round->store, round->step);
    if (round->step == expire) {
      atomic_fetch_add(&round->store->jobs_expired, round->n);
      run(round->store, delete_some);
    }
  }
  free(round);
}

/* Queues a step after all earlier writes. If memory runs out, the next upkeep queues it. */
static void run(struct mo_store *store, int (*step)(struct mo_store *store, void *arguments))
{
  struct round *round = malloc(sizeof(*round));
  if (round == NULL)
    return;
  *round = (struct round){store, step, 0};
  if (mo_write_later(store, step, round, done) != MO_OK)
    free(round);
}

/* ---- for the service ---- */

int mo_store_delete_job(struct mo_store *store, int64_t id, struct mo_deleted *deleted,
                        struct mo_message *message)
{
  struct mark call = {.id = id, .reason = "request", .message = message};
  struct round round = {.store = store};
  message->text[0] = '\0';
  int error = mo_write_urgent(store, mark, &call);
  if (error != MO_OK)
    return error;
  *deleted = call.deleted;
  mo_store_atlas_drop(store, id);
  if (deleted->recorded_bytes > 0)
    mo_recordings_check(store);
  /* The job is deleted even if this fails: the next upkeep or start continues. */
  if (mo_write(store, delete_some, &round) == MO_OK && round.n > 0)
    run(store, delete_some);
  return MO_OK;
}

/* Runs one round; nothing is left afterward. */
static int forget(struct mo_store *store, void *arguments)
{
  (void)arguments;
  return mo_import_forget(store, NULL);
}

void mo_import_abandon(struct mo_store *store)
{
  if (mo_write_urgent(store, mo_import_forget, NULL) == MO_OK)
    run(store, delete_some);
}

void mo_upkeep_begin(struct mo_store *store)
{
  store->aged_left = EXPIRE_MAX;
  run(store, forget);
  run(store, delete_some);
  run(store, expire);
  mo_recordings_check(store);
}

void mo_upkeep(struct mo_store *store)
{
  const int64_t now = mo_clock_us();
  if (now - store->last_upkeep_us < UPKEEP_US)
    return;
  store->last_upkeep_us = now;
  store->aged_left = EXPIRE_MAX;
  run(store, delete_some);
  run(store, expire);
  /* Without a retention time, only new recordings cause the removal of old ones. */
  if (store->keep_recordings_us > 0)
    mo_recordings_check(store);
}
