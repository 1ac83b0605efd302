/* recordings.c: stores recordings of evaluations, and removes them in three cases: on request;
 * while all recordings together exceed max_recordings, starting with the oldest evaluation; and if
 * the evaluation ended longer than keep_recordings ago, has no note and is not archived. Recordings
 * of unfinished evaluations are kept, because a restart continues from them.
 *
 * The row of each evaluation states the size of its recordings, and `meta` the sum. Every change to
 * recordings updates both in the same transaction. */
#include "store/recordings.h"

#include <math.h>
#include <stdlib.h>

#include "base/clock.h"
#include "store/credible.h"
#include "store/runs.h"

static uint64_t bytes_of(const struct mo_saved_trajectory *trajectory, unsigned channels)
{
  return trajectory->frames *
         mo_recording_frame_bytes(channels, trajectory->n_masses, trajectory->n_springs);
}

static struct mo_value channel_value(const struct mo_saved_trajectory *trajectory,
                                     enum mo_channel channel)
{
  return mo_blob(mo_recording_array(&trajectory->recording, channel), /* NULL: NULL */
                 bytes_of(trajectory, channel));
}

static int add_bytes(struct mo_connection *writer, int64_t job, int64_t bytes)
{
  static const char job_sql[] =
      "UPDATE evaluations SET recorded_bytes=recorded_bytes+?2 WHERE job=?1";
  static const char sum_sql[] = "UPDATE meta SET value=value+?1 WHERE key='recorded bytes'";
  const int error = mo_sql_do(writer, job_sql, mo_int(job), mo_int(bytes));
  return error == MO_OK ? mo_sql_do(writer, sum_sql, mo_int(bytes)) : error;
}

/* Computes the path length of the center of mass; NaN (stored as NULL): not known. */
static double path_of(const struct mo_saved_trajectory *trajectory)
{
  const double *com_m = trajectory->recording.com_m;
  double path_m = 0;
  for (uint32_t f = 1; com_m != NULL && f < trajectory->frames; f++) {
    const double *from = com_m + 3 * (size_t)(f - 1), *to = from + 3;
    const double x = to[0] - from[0], y = to[1] - from[1], z = to[2] - from[2];
    path_m += sqrt(x * x + y * y + z * z);
  }
  return com_m != NULL ? path_m : NAN;
}

/* Stores a trajectory and adds its bytes to *bytes. A trajectory that is already stored stays
 * unchanged. If its job was deleted in the meantime, the new trajectory is dropped; a job that is
 * being imported (epoch < 0) takes it. */
static int insert(struct mo_connection *writer, const struct mo_saved_trajectory *trajectory,
                  uint64_t *bytes)
{
  static const char sql[] = "INSERT OR IGNORE INTO trajectories(job,position,environment,stride,"
                            "frames,n_masses,diverged_step,com,masses,actuation,contacts,path_m)"
                            " SELECT ?1,?2,?3,?4,?5,?6,?7,?8,?9,?10,?11,?12"
                            " FROM jobs WHERE id=?1 AND (state<6 OR epoch<0)";
  unsigned channels = 0;
  const int error = mo_sql_do(
      writer, sql, mo_int(trajectory->job), mo_int(trajectory->design_position),
      mo_int(trajectory->environment_position), mo_int(trajectory->recording.stride),
      mo_int(trajectory->frames), mo_int(trajectory->n_masses), mo_int(trajectory->diverged_step),
      channel_value(trajectory, MO_RECORD_COM), channel_value(trajectory, MO_RECORD_MASSES),
      channel_value(trajectory, MO_RECORD_ACTUATION), channel_value(trajectory, MO_RECORD_CONTACTS),
      mo_real(path_of(trajectory)));
  for (unsigned channel = 1; channel < 1U << MO_CHANNELS; channel <<= 1)
    if (mo_recording_array(&trajectory->recording, (enum mo_channel)channel) != NULL)
      channels |= channel;
  if (error == MO_OK && sqlite3_changes(writer->db) > 0)
    *bytes += bytes_of(trajectory, channels);
  return error;
}

int mo_trajectories_insert(struct mo_connection *writer,
                           const struct mo_saved_trajectory *trajectories, size_t n)
{
  uint64_t bytes = 0;
  int error = MO_OK;
  for (size_t i = 0; i < n && error == MO_OK; i++) {
    error = insert(writer, &trajectories[i], &bytes);
    if (error == MO_OK && (i + 1 == n || trajectories[i + 1].job != trajectories[i].job)) {
      error = add_bytes(writer, trajectories[i].job, (int64_t)bytes);
      bytes = 0;
    }
  }
  return error;
}

int mo_recordings_drop(struct mo_connection *writer, int64_t job, int64_t *bytes)
{
  static const char bytes_sql[] = "SELECT recorded_bytes FROM evaluations WHERE job=?1";
  static const char sql[] = "DELETE FROM trajectories WHERE job=?1";
  int error = mo_sql_find(writer, bytes, bytes_sql, mo_int(job));
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, mo_int(job));
  return error == MO_OK && *bytes > 0 ? add_bytes(writer, job, -*bytes) : error;
}

/* ---- removal ---- */

bool mo_recordings_are_many(const struct mo_store *store)
{
  const uint64_t most = store->max_recordings_bytes;
  return most > 0 && atomic_load(&store->recorded_bytes) > most;
}

/* Removes the recordings of one evaluation. */
struct removal {
  struct mo_store *store;
  int64_t job;   /* 0: the oldest one that has ended, if recordings exceed the budget or it is too
                  * old */
  int64_t bytes; /* result */
};

static int remove_of(struct mo_store *store, int64_t job, const char *reason, int64_t *bytes)
{
  static const char removed_sql[] = "UPDATE evaluations SET recordings_removed_us=?2 WHERE job=?1";
  static const char version_sql[] = "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1";
  struct mo_connection *writer = &store->writer;
  int error = mo_recordings_drop(writer, job, bytes);
  if (error != MO_OK || *bytes == 0)
    return error;
  error = mo_sql_do(writer, removed_sql, mo_int(job), mo_int(mo_clock_wall_us()));
  if (error == MO_OK)
    error = mo_sql_do(writer, version_sql, mo_int(job));
  if (error != MO_OK)
    return error;
  return mo_writer_event(store, job, "evaluation.recordings_removed",
                         "{\"id\":\"%lld\",\"bytes\":%lld,\"reason\":\"%s\"}", (long long)job,
                         (long long)*bytes, reason);
}

static int remove_oldest(struct mo_store *store, void *arguments)
{
  static const char sum_sql[] = "SELECT value FROM meta WHERE key='recorded bytes'";
  static const char oldest_sql[] =
      "SELECT e.job FROM evaluations e JOIN jobs j ON j.id=e.job"
      " WHERE e.recorded_bytes>0 AND j.state BETWEEN 3 AND 5 ORDER BY e.job LIMIT 1";
  static const char aged_sql[] =
      "SELECT e.job FROM evaluations e JOIN jobs j ON j.id=e.job WHERE e.recorded_bytes>0"
      " AND j.state BETWEEN 3 AND 5 AND j.finished_us<?1 AND j.archived_us=0 AND j.note IS NULL"
      " AND NOT EXISTS(SELECT 1 FROM imports WHERE job=e.job AND imported_us>=?1)"
      " ORDER BY e.job LIMIT 1";
  struct removal *removal = arguments;
  int64_t sum = 0;
  int error = mo_sql_find(&store->writer, &sum, sum_sql);
  removal->bytes = 0;
  if (error != MO_OK)
    return error;
  atomic_store(&store->recorded_bytes, (uint64_t)sum);
  const bool are_many = mo_recordings_are_many(store);
  if (!are_many &&
      (store->keep_recordings_us == 0 || store->aged_left == 0 || !mo_clock_is_credible(store)))
    return MO_OK;
  error = are_many ? mo_sql_find(&store->writer, &removal->job, oldest_sql)
                   : mo_sql_find(&store->writer, &removal->job, aged_sql,
                                 mo_int(mo_clock_wall_us() - store->keep_recordings_us));
  if (error == MO_OK && !are_many)
    store->aged_left--;
  if (error == MO_OK)
    error = remove_of(store, removal->job, are_many ? "budget" : "age", &removal->bytes);
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

static int remove_on_request(struct mo_store *store, void *arguments)
{
  struct removal *removal = arguments;
  enum mo_job_state state;
  enum mo_job_kind kind;
  int error = mo_job_state_get(&store->writer, removal->job, &state, &kind);
  removal->bytes = 0;
  if (error == MO_OK && kind != MO_JOB_EVALUATION)
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK && !mo_job_state_is_final(state))
    error = MO_ERR_CONFLICT;
  return error == MO_OK ? remove_of(store, removal->job, "request", &removal->bytes) : error;
}

/* Counts a removal after its commit, and continues if something was removed. */
static void removed(struct mo_store *store, int64_t bytes)
{
  if (bytes == 0)
    return;
  atomic_fetch_add(&store->recordings_removed, 1);
  atomic_fetch_add(&store->recordings_removed_bytes, (uint64_t)bytes);
  mo_recordings_check(store);
}

static void checked(void *arguments, int status)
{
  struct removal *removal = arguments;
  if (status == MO_OK)
    removed(removal->store, removal->bytes);
  free(removal);
}

void mo_recordings_check(struct mo_store *store)
{
  struct removal *removal = calloc(1, sizeof(*removal));
  if (removal == NULL)
    return; /* the next check removes it */
  removal->store = store;
  if (mo_write_later(store, remove_oldest, removal, checked) != MO_OK)
    free(removal);
}

int mo_store_trajectories_remove(struct mo_store *store, int64_t id, uint64_t *bytes)
{
  struct removal removal = {store, id, 0};
  const int error = mo_write_urgent(store, remove_on_request, &removal);
  if (error == MO_OK) {
    removed(store, removal.bytes);
    *bytes = (uint64_t)removal.bytes;
  }
  return error;
}
