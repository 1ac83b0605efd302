/* submit.c: accepts jobs: stores everything that a job needs later in one transaction. */
#include "store/runs.h"

#include <string.h>

#include "base/clock.h"
#include "store/contents.h"
#include "store/controller_rows.h"
#include "store/scores.h"

/* ---- idempotency keys ---- */

int mo_key_find(struct mo_connection *connection, const struct mo_request_key *key, int64_t *id)
{
  static const char sql[] = "SELECT job,body_sha256 FROM idempotency_keys WHERE key=?1";
  struct mo_sha256 known;
  sqlite3_stmt *row;
  int error = key->text != NULL ? mo_sql_row(connection, &row, sql, mo_string(key->text))
                                : MO_ERR_NOT_FOUND;
  if (error == MO_OK)
    error = mo_column_hash(row, 1, &known);
  if (error != MO_OK)
    return error;
  *id = sqlite3_column_int64(row, 0);
  return mo_sha256_equal(&known, &key->sha256) ? MO_OK : MO_ERR_CONFLICT;
}

int mo_key_insert(struct mo_connection *writer, const struct mo_request_key *key, int64_t id)
{
  static const char sql[] =
      "INSERT INTO idempotency_keys(key,body_sha256,job,created_us) VALUES(?1,?2,?3,?4)";
  return key->text == NULL ? MO_OK
                           : mo_sql_do(writer, sql, mo_string(key->text), mo_hash(&key->sha256),
                                       mo_int(id), mo_int(mo_clock_wall_us()));
}

int mo_store_replay(struct mo_store *store, const struct mo_request_key *key, int64_t *id)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return mo_key_find(reader, key, id);
}

/* ---- jobs of every kind ---- */

int mo_job_insert(struct mo_connection *writer, const struct mo_submission *request,
                  enum mo_job_kind kind, int64_t *id)
{
  static const char sql[] =
      "INSERT INTO jobs(kind,state,priority,version,epoch,attempts,label,created_us,started_us,"
      "finished_us,error,weight,back_end,submitted_by,experiment)"
      " VALUES(?1,0,?2,1,0,0,?3,?4,0,0,0,?5,?6,?7,?8)";
  return mo_sql_insert(
      writer, id, sql, mo_int(kind), mo_int(request->priority), mo_string(request->label),
      mo_int(mo_clock_wall_us()), mo_real(request->weight > 0 ? request->weight : 1),
      mo_int(request->back_end), mo_string(request->submitted_by), mo_string(request->experiment));
}

struct submit_arguments {
  const struct mo_request_key *key;
  int (*insert)(struct mo_store *store, const void *request, int64_t *id);
  const void *request;
  int64_t id;
  bool replayed;
};

static int submit(struct mo_store *store, void *arguments)
{
  struct submit_arguments *call = arguments;
  int error = mo_key_find(&store->writer, call->key, &call->id);
  call->replayed = error == MO_OK;
  if (error != MO_ERR_NOT_FOUND)
    return error;
  error = call->insert(store, call->request, &call->id);
  return error == MO_OK ? mo_key_insert(&store->writer, call->key, call->id) : error;
}

int mo_submit(struct mo_store *store, const struct mo_request_key *key,
              int (*insert)(struct mo_store *store, const void *request, int64_t *id),
              const void *request, int64_t *id, bool *replayed)
{
  struct submit_arguments call = {key, insert, request, 0, false};
  const int error = mo_write(store, submit, &call);
  if (error == MO_OK) {
    *id = call.id;
    *replayed = call.replayed;
  }
  return error;
}

static int give(struct mo_store *store, const void *request, int64_t *id)
{
  (void)store;
  *id = *(const int64_t *)request;
  return MO_OK;
}

int mo_store_keep_key(struct mo_store *store, const struct mo_request_key *key, int64_t id)
{
  int64_t known;
  bool replayed;
  return key->text != NULL ? mo_submit(store, key, give, &id, &known, &replayed) : MO_OK;
}

/* ---- designs that are stored after their evaluation ---- */

int mo_store_waiting(struct mo_store *store, int64_t *id)
{
  static const char sql[] =
      "SELECT e.job FROM evaluations e INDEXED BY evaluations_waiting JOIN jobs j ON j.id=e.job"
      " WHERE e.n_waiting>0 AND j.state=?1 ORDER BY e.n_waiting,e.job LIMIT 1";
  const int error = mo_read_integers(store, sql, MO_VALUES(mo_int(MO_JOB_QUEUED)), 1, id);
  if (error == MO_ERR_NOT_FOUND)
    *id = 0;
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

struct group {
  int64_t id;
  uint32_t first, n;
  const struct mo_bits *forms, *genotypes;
  struct mo_bits *ret; /* (n) */
};

static int read_group(sqlite3_stmt *row, void *any)
{
  const struct group *group = any;
  const int64_t key[2] = {group->id, group->first};
  const size_t size = group->n * sizeof(*group->ret);
  const void *bytes = sqlite3_column_blob(row, 0);
  if (bytes == NULL || (size_t)sqlite3_column_bytes(row, 0) != size ||
      mo_row_checksum(key, 2, bytes, size) != (uint64_t)sqlite3_column_int64(row, 1))
    return MO_ERR_CORRUPT;
  memcpy(group->ret, bytes, size);
  return MO_OK;
}

int mo_store_waiting_designs(struct mo_store *store, int64_t id, uint32_t first,
                             struct mo_bits *genotypes, uint32_t n)
{
  static const char sql[] = "SELECT bits,checksum FROM waiting_designs WHERE job=?1 AND first=?2";
  struct group group = {.id = id, .first = first, .n = n, .ret = genotypes};
  return mo_read_one(store, sql, MO_VALUES(mo_int(id), mo_int(first)), read_group, &group);
}

static int insert_waiting(struct mo_connection *writer, int64_t id,
                          const struct mo_evaluation_request *request)
{
  static const char sql[] =
      "INSERT INTO waiting_designs(job,first,bits,checksum) VALUES(?1,?2,?3,?4)";
  int error = MO_OK;
  for (uint32_t first = 0; first < request->n_designs && error == MO_OK; first += MO_DESIGN_GROUP) {
    const uint32_t left = request->n_designs - first;
    const size_t size =
        (left < MO_DESIGN_GROUP ? left : MO_DESIGN_GROUP) * sizeof(*request->genotypes);
    const int64_t key[2] = {id, first};
    const struct mo_bits *bits = &request->genotypes[first];
    error = mo_sql_do(writer, sql, mo_int(id), mo_int(first), mo_blob(bits, size),
                      mo_int((int64_t)mo_row_checksum(key, 2, bits, size)));
  }
  return error;
}

static int store_group(struct mo_store *store, void *arguments)
{
  static const char count_sql[] =
      "UPDATE evaluations SET n_waiting=n_waiting-?3 WHERE job=?1 AND n_designs-n_waiting=?2 AND"
      " n_waiting>=?3 AND EXISTS(SELECT 1 FROM jobs WHERE id=?1 AND state=0)";
  static const char version_sql[] = "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1";
  static const char waiting_sql[] = "DELETE FROM waiting_designs WHERE job=?1 AND first=?2";
  const struct group *group = arguments;
  struct mo_connection *writer = &store->writer;
  const int64_t now_us = mo_clock_wall_us();
  int error =
      mo_sql_change(writer, count_sql, mo_int(group->id), mo_int(group->first), mo_int(group->n));
  if (error == MO_OK)
    error = mo_sql_do(writer, version_sql, mo_int(group->id));
  if (error == MO_OK)
    error = mo_sql_do(writer, waiting_sql, mo_int(group->id), mo_int(group->first));
  for (uint32_t i = 0; i < group->n && error == MO_OK; i++) {
    int64_t row = 0;
    error = mo_genotype_row(writer, group->forms[i].words, group->genotypes[i].words, now_us, &row);
    if (error == MO_OK)
      error = mo_design_insert(writer, group->id, group->first + i, row);
  }
  return error;
}

int mo_store_group(struct mo_store *store, int64_t id, uint32_t first, const struct mo_bits *forms,
                   const struct mo_bits *genotypes, uint32_t n)
{
  struct group group = {.id = id, .first = first, .n = n, .forms = forms, .genotypes = genotypes};
  return mo_write(store, store_group, &group);
}

/* ---- evaluations ---- */

/* The set, or the sets of the suite, of a submission. */
struct sets {
  int64_t rows[MO_SUITE_TASKS], n_environments;
  uint32_t n; /* 0: environments are listed */
};

/* Finds the rows that a submission refers to. */
static int resolve(struct mo_connection *writer, const struct mo_evaluation_request *request,
                   int64_t *controller, int64_t *physics, struct sets *sets, bool *warns)
{
  enum mo_sensor sensor = MO_SENSOR_INVERSE_SQRT;
  struct mo_physics completed = request->physics;
  struct mo_warning warnings[MO_PHYSICS_WARNINGS_MAX];
  int error = mo_controller_find(writer, request->controller, controller, &sensor, &completed);
  *sets = (struct sets){.n_environments = request->n_environments};
  *warns = mo_warn_of_physics(&completed, warnings) > 0;
  if (error == MO_OK)
    error = mo_physics_row(writer, &completed, request->precision, sensor, physics);
  const struct mo_setting first = {completed, request->precision};
  const uint32_t n_runs = mo_ladder_runs(request->n_displaced, request->tolerance);
  for (uint32_t run = 1; run < n_runs && error == MO_OK; run++) {
    const struct mo_setting setting = mo_ladder_run(&first, request->n_displaced, run);
    int64_t row;
    error = mo_physics_row(writer, &setting.physics, setting.precision, sensor, &row);
  }
  return error == MO_OK && request->environment_set != NULL
             ? mo_suite_find(writer, request->environment_set, sets->rows, &sets->n,
                             &sets->n_environments)
             : error;
}

static int insert(struct mo_store *store, const void *any, int64_t *id)
{
  static const char sql[] =
      "INSERT INTO evaluations(job,controller,controller_name,physics,"
      "environment_set,n_designs,n_environments,verify,record,record_stride,"
      "done,cached,diverged,n_skipped,best,random_seed,random_first,n_waiting,n_displaced,"
      "measures,tolerance,suite)"
      " VALUES(?1,?2,?3,?4,nullif(?5,0),?6,?7,?8,?9,?10,0,0,0,?11,?12,"
      "CASE WHEN ?14>0 THEN ?13 END,?15,?16,?17,?18,?19,?20)";
  const struct mo_evaluation_request *request = any;
  const bool waits = request->forms == NULL;
  const char *name = strncmp(request->controller, "sha256:", 7) == 0 ? "" : request->controller;
  struct mo_connection *writer = &store->writer;
  int64_t controller, physics;
  struct sets sets;
  bool warns;
  int error = resolve(writer, request, &controller, &physics, &sets, &warns);
  const int64_t set = sets.n == 1 ? sets.rows[0] : 0;
  if (error == MO_OK)
    error = mo_job_insert(writer, &request->job, MO_JOB_EVALUATION, id);
  if (error == MO_OK)
    error = mo_sql_do(
        writer, sql, mo_int(*id), mo_int(controller), mo_string(name), mo_int(physics), mo_int(set),
        mo_int((int64_t)request->n_designs + request->n_skipped), mo_int(sets.n_environments),
        mo_int(request->verify), mo_int(request->record), mo_int(request->record_stride),
        mo_int(request->n_skipped), mo_int(request->best), mo_int((int64_t)request->random.seed),
        mo_int(request->random.count), mo_int(request->random.first),
        mo_int(waits ? request->n_designs : 0), mo_int(request->n_displaced),
        mo_int(request->measures), mo_real(request->tolerance),
        mo_string(sets.n > 1 ? request->environment_set : NULL));
  if (error == MO_OK)
    error = sets.n > 1 ? mo_suite_insert(writer, *id, sets.rows, sets.n)
                       : mo_environments_insert(writer, *id, set, request->environments,
                                                request->n_environments);
  if (error == MO_OK && waits && request->random.count == 0)
    error = insert_waiting(writer, *id, request);
  if (error == MO_OK && !waits)
    error = mo_designs_insert(writer, *id, request->forms, request->genotypes, request->n_designs,
                              request->notes, request->n_notes, mo_clock_wall_us());
  if (error == MO_OK)
    error = mo_notes_insert(writer, *id, request->notes, request->n_notes);
  if (error == MO_OK)
    error = mo_writer_event(store, *id, "job.created",
                            "{\"id\":\"%lld\",\"kind\":\"evaluation\",\"state\":\"queued\","
                            "\"rollouts_total\":%llu}",
                            (long long)*id,
                            (unsigned long long)request->n_designs * (uint64_t)sets.n_environments *
                                mo_ladder_runs(request->n_displaced, request->tolerance));
  /* Most submissions cannot cause a warning, so they are not read back. */
  return error == MO_OK && (sets.n == 0 || warns) ? mo_run_announce_warnings(store, *id, true)
                                                  : error;
}

int mo_store_submit(struct mo_store *store, const struct mo_evaluation_request *request,
                    int64_t *id, bool *replayed)
{
  return mo_submit(store, &request->job.key, insert, request, id, replayed);
}
