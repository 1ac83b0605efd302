/* deletion.c: see deletion.h.
 *
 * The first transaction sets the job's state to 6, which no reader finds, and deletes what takes
 * the most room: recordings, then checkpoints with their files. Then rows of its tables go, at most
 * ROWS_MAX in a transaction, so that a campaign of a million designs delays other writes by
 * milliseconds. Each such step finds its work in the database, so a restart continues it. On a full
 * disk the first transaction may use the reserve; the steps wait until there is space. */
#include "store/deletion.h"

#include <stdio.h>
#include <stdlib.h>

#include "base/clock.h"
#include "store/checkpoints.h"
#include "store/recordings.h"
#include "store/runs.h"
#include "store/upkeep.h"

#define ROWS_MAX     1000                /* in one transaction, about */
#define EXPIRE_MAX   100                 /* jobs in one transaction */
#define EXPIRE_BYTES (INT64_C(64) << 20) /* of recordings; at least one job's */
#define UPKEEP_US    INT64_C(60000000)

/* ---- the first transaction ---- */

/* Describes a job that needs this one. MO_ERR_NOT_FOUND: none does. */
static int find_dependent(struct mo_connection *writer, int64_t id, struct mo_message *message)
{
  static const char sql[] =
      "SELECT words FROM ("
      "SELECT job,'training '||job||' learns on its designs' words FROM trainings"
      " WHERE population=?1 AND population<>0 UNION ALL"
      " SELECT job,'campaign '||job||' was bred from its population' FROM campaigns"
      " WHERE initial_campaign=?1 AND initial_campaign<>0 UNION ALL"
      " SELECT job,'campaign '||job||', a replicate, shares its environments' FROM campaigns"
      " WHERE replicates_of=?1 AND job<>?1 UNION ALL"
      " SELECT r.job,'job '||r.job||' began with its controller' FROM runs o JOIN runs r"
      " ON r.controller=o.result AND r.controller IS NOT NULL AND r.job<>o.job WHERE o.job=?1)"
      " JOIN jobs j ON j.id=job AND j.state<>6 ORDER BY job DESC LIMIT 1";
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
  enum mo_job_kind kind;
  int64_t recorded_bytes;
  struct mo_message *message; /* nullable */
};

static int mark(struct mo_store *store, void *arguments)
{
  static const char usage_sql[] =
      "INSERT INTO past_usage(kind,label,experiment,submitted_by,jobs,worker_s,device_s)"
      " SELECT kind,coalesce(label,''),coalesce(experiment,''),coalesce(submitted_by,''),1,"
      "worker_s,device_s FROM jobs WHERE id=?1 ON CONFLICT DO UPDATE SET jobs=jobs+1,"
      "worker_s=worker_s+excluded.worker_s,device_s=device_s+excluded.device_s";
  static const char sql[] = "UPDATE jobs SET state=6," MO_NEXT_VERSION " WHERE id=?1";
  static const char import_sql[] = "DELETE FROM imports WHERE job=?1";
  struct mark *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_state state;
  char data[128];
  int error = mo_job_state_get(writer, call->id, &state, &call->kind);
  call->recorded_bytes = 0;
  if (error == MO_OK && (int)state == MO_JOB_STATES)
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK && !mo_job_state_is_final(state))
    error = MO_ERR_CONFLICT;
  if (error != MO_OK)
    return error;
  error = find_dependent(writer, call->id, call->message);
  if (error != MO_ERR_NOT_FOUND)
    return error == MO_OK ? MO_ERR_CONFLICT : error;
  error = call->kind == MO_JOB_EVALUATION
              ? mo_recordings_drop(writer, call->id, &call->recorded_bytes)
              : MO_OK;
  if (error == MO_OK)
    error = mo_sql_do(writer, usage_sql, mo_int(call->id));
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, mo_int(call->id));
  if (error == MO_OK) /* its bundle may enter again at once */
    error = mo_sql_do(writer, import_sql, mo_int(call->id));
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"kind\":\"%s\",\"reason\":\"%s\"}",
           (long long)call->id, mo_job_kind_name(call->kind), call->reason);
  return error == MO_OK ? mo_writer_event(store, call->id, "job.deleted", data) : error;
}

/* ---- the steps ---- */

/* Deletes the rows of ?1 with the next keys. Each table is found by job and key. */
#define PART(table, key, keys)                                                                     \
  "DELETE FROM " table " WHERE job=?1 AND " key "<" keys "+(SELECT min(" key ") FROM " table       \
  " WHERE job=?1)"
static const char *const parts[] = {PART("recomputed", "position", "16"),
                                    PART("job_designs", "position", "1000"),
                                    PART("job_environments", "position", "1000"),
                                    PART("design_notes", "position", "1000"),
                                    PART("training_steps", "step", "1000"),
                                    PART("training_validations", "step", "1000"),
                                    PART("training_code", "from_step", "1000"),
                                    PART("campaign_losses", "place", "1000"),
                                    PART("campaign_steps", "generation", "16"),
                                    PART("campaign_generations", "generation", "1000"),
                                    PART("campaign_populations", "generation", "64"),
                                    PART("campaign_designs", "number", "1000"),
                                    "DELETE FROM idempotency_keys WHERE job=?1",
                                    "DELETE FROM evaluations WHERE job=?1",
                                    "DELETE FROM trainings WHERE job=?1",
                                    "DELETE FROM study_words WHERE job=?1",
                                    "DELETE FROM studies WHERE job=?1",
                                    "DELETE FROM campaigns WHERE job=?1",
                                    "DELETE FROM runs WHERE job=?1",
                                    "DELETE FROM jobs WHERE id=?1"};
#undef PART

struct round {
  struct mo_store *store;
  uint64_t n; /* rows deleted, or jobs marked */
};

static int delete_some(struct mo_store *store, void *arguments)
{
  /* The files of checkpoints go before their rows, on another thread. */
  static const char next_sql[] = "SELECT id FROM jobs WHERE state=6 AND NOT EXISTS("
                                 "SELECT 1 FROM checkpoints WHERE job=id) ORDER BY id LIMIT 1";
  struct mo_connection *writer = &store->writer;
  struct round *round = arguments;
  int64_t id;
  int error = MO_OK;
  round->n = 0;
  while (error == MO_OK && round->n < ROWS_MAX &&
         (error = mo_sql_find(writer, &id, next_sql)) == MO_OK) {
    size_t part = 0;
    while (part < sizeof(parts) / sizeof(parts[0]) && error == MO_OK && round->n < ROWS_MAX) {
      error = mo_sql_do(writer, parts[part], mo_int(id));
      const int n = error == MO_OK ? sqlite3_changes(writer->db) : 0;
      round->n += (uint64_t)n;
      part += n == 0;
    }
  }
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

/* Marks evaluations that ended long ago. One that a client has noted or archived stays, and one
 * that a training learns on. */
static int expire(struct mo_store *store, void *arguments)
{
  static const char sql[] =
      "SELECT id FROM jobs INDEXED BY jobs_by_end WHERE kind=0 AND state>=3 AND state<6"
      " AND archived_us=0 AND note IS NULL AND finished_us<?1"
      " AND NOT EXISTS(SELECT 1 FROM trainings WHERE population=id AND population<>0)"
      " ORDER BY finished_us LIMIT ?2";
  struct round *round = arguments;
  int64_t ids[EXPIRE_MAX];
  size_t n = 0;
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(&store->writer, &error, sql,
                  mo_int(mo_clock_wall_us() - store->keep_evaluations_us), mo_int(EXPIRE_MAX));
  while (mo_sql_next(&store->writer, row, &error))
    ids[n++] = sqlite3_column_int64(row, 0);
  int64_t bytes = 0;
  round->n = 0;
  for (size_t i = 0; i < n && error == MO_OK && bytes < EXPIRE_BYTES; i++) {
    struct mark one = {.id = ids[i], .reason = "age"};
    error = mark(store, &one);
    bytes += one.recorded_bytes;
    round->n++;
  }
  return error;
}

static void run(struct mo_store *store, int (*step)(struct mo_store *store, void *arguments),
                void (*done)(void *arguments, int status));

static void deleted_some(void *arguments, int status)
{
  struct round *round = arguments;
  if (status == MO_OK && round->n > 0)
    run(round->store, delete_some, deleted_some);
  free(round);
}

static void expired(void *arguments, int status)
{
  struct round *round = arguments;
  if (status == MO_OK && round->n > 0) {
    run(round->store, expire, expired);
    run(round->store, delete_some, deleted_some);
  }
  free(round);
}

/* Queues a step; each is behind the writes that came before it. Without memory the next upkeep
 * does it. */
static void run(struct mo_store *store, int (*step)(struct mo_store *store, void *arguments),
                void (*done)(void *arguments, int status))
{
  struct round *round = calloc(1, sizeof(*round));
  if (round == NULL)
    return;
  round->store = store;
  if (mo_write_later(store, step, round, done) != MO_OK)
    free(round);
}

/* ---- for the service ---- */

/* Deletes the checkpoints of a marked job. */
static int delete_checkpoints(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                              struct mo_deleted *deleted)
{
  struct mo_checkpoints_removed removed = {.n = 0};
  int error = MO_OK;
  if (kind == MO_JOB_EVALUATION)
    return MO_OK;
  do {
    error = mo_store_checkpoints_remove(store, id, kind, 0, &removed);
    deleted->n_checkpoints += removed.n;
    deleted->checkpoint_bytes += removed.bytes;
  } while (error == MO_OK && removed.n > 0);
  return error;
}

int mo_store_delete_job(struct mo_store *store, int64_t id, struct mo_deleted *deleted,
                        struct mo_message *message)
{
  struct mark call = {.id = id, .reason = "request", .message = message};
  int error;
  message->text[0] = '\0';
  error = mo_write_urgent(store, mark, &call);
  if (error != MO_OK)
    return error;
  *deleted = (struct mo_deleted){.recorded_bytes = (uint64_t)call.recorded_bytes};
  if (call.recorded_bytes > 0)
    mo_recordings_check(store);
  /* The job is gone whatever becomes of its files: the next start deletes what this leaves. */
  (void)delete_checkpoints(store, id, call.kind, deleted);
  run(store, delete_some, deleted_some);
  return MO_OK;
}

void mo_upkeep(struct mo_store *store)
{
  const int64_t now = mo_clock_us();
  if (now - store->last_upkeep_us < UPKEEP_US)
    return;
  store->last_upkeep_us = now;
  run(store, delete_some, deleted_some);
  if (store->keep_evaluations_us > 0)
    run(store, expire, expired);
  if (store->keep_recordings_us > 0)
    mo_recordings_check(store);
}

void mo_upkeep_begin(struct mo_store *store)
{
  static const char sql[] = "SELECT DISTINCT j.id,j.kind FROM jobs j JOIN checkpoints c"
                            " ON c.job=j.id WHERE j.state=6 LIMIT 100";
  int64_t ids[100];
  enum mo_job_kind kinds[100];
  struct mo_deleted deleted = {.n_checkpoints = 0};
  size_t n = 0;
  int error = MO_OK;
  struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql);
  while (mo_sql_next(reader, row, &error)) {
    ids[n] = sqlite3_column_int64(row, 0);
    kinds[n++] = (enum mo_job_kind)sqlite3_column_int(row, 1);
  }
  mo_reader_release(store, reader);
  for (size_t i = 0; i < n; i++)
    (void)delete_checkpoints(store, ids[i], kinds[i], &deleted);
  run(store, delete_some, deleted_some);
  if (store->keep_evaluations_us > 0)
    run(store, expire, expired);
  mo_recordings_check(store);
}
