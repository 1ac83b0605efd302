/* store.h: the durable state: one SQLite database and the files beside it, in one folder.
 *
 *   <path>/morphod.db (+ -wal, -shm)            every table (schema/migrations)
 *   <path>/controllers/<sha256>.safetensors     weights, by content
 *   <path>/trainings/<job>/<step>.checkpoint    states of trainings (store/trainings.h)
 *   <path>/campaigns/<job>/<generation>-<step>.checkpoint    states of the learning of campaigns
 * (store/campaigns.h) <path>/reserve                              4 MiB that pausing, cancelling
 * and deleting may use when the disk is full, and of which an opening may use a little; until they
 * are there again, after another opening, too, all other writes give MO_ERR_NO_SPACE <path>/lock
 * held while a process uses the folder
 *
 * One connection, on a thread of its own, writes: callers hand it operations, each runs in a
 * savepoint, all that are waiting commit together with one fsync, then the callers are released.
 * Reads use a pool of read-only connections and never wait for the writer. All functions may be
 * called from any thread.
 *
 * Errors of every function: MO_ERR_NO_MEMORY; MO_ERR_CORRUPT (the database contradicts itself);
 * MO_ERR_IO; of those that write: MO_ERR_NO_SPACE (nothing was changed; try again when there is
 * room), MO_ERR_CANCELLED (the store is closing). A failed fsync or write error is fatal: the
 * `fatal` callback is told once, every later write gives MO_ERR_IO, and the process must end; at
 * the next start the database recovers by itself. */
#ifndef MORPHO_STORE_STORE_H
#define MORPHO_STORE_STORE_H

#include "store/files.h"
#include "store/records.h"

struct mo_store;

/* How a request that may be sent twice is known again, for as long as idempotency_keep_s: the
 * client's key, and what it asks for. */
struct mo_request_key {
  const char *text;
  struct mo_sha256 sha256;
};

struct mo_store_config {
  const char *path; /* the state folder: must exist and be writable */
  const char *vfs;  /* NULL: SQLite's default; tests name one that fails on demand */
  const struct mo_file_operations
      *files;                 /* NULL: the system's; likewise; as long as the store is open */
  uint32_t n_readers;         /* read connections; 0: 4 */
  uint64_t events_kept;       /* older ones are pruned; 0: 100000 */
  int64_t idempotency_keep_s; /* 0: 24 h */
  uint32_t
      checkpoint_frames; /* pages in the log after which it is copied into the database; 0: 2000 */
  void (*fatal)(void *context, const char *what); /* once, on any thread; nullable */
  void *fatal_context;
};

/* Opens or creates. MO_ERR_BUSY: another process uses the folder; MO_ERR_UNSUPPORTED: written by a
 * newer version, or on a file system without shared memory; MO_ERR_FORMAT: not our database;
 * MO_ERR_NOT_FOUND: no such folder; MO_ERR_IO: not writable; MO_ERR_NO_SPACE: nor is there enough
 * in the reserve. After an unclean stop it runs SQLite's quick_check (MO_ERR_CORRUPT), but for the
 * tables' CHECKs: readings name such rows. Stores the paper's test set, or puts its rows right. */
int mo_store_open(const struct mo_store_config *config, struct mo_store **store,
                  struct mo_message *message);
/* Finishes what is queued, checkpoints, closes. NULL-safe. No other call may be under way. */
void mo_store_close(struct mo_store *store);

/* Which damaged rows the opening has written again, by table, column and row; "": none. */
const char *mo_store_repairs(const struct mo_store *store);
int64_t mo_store_epoch(const struct mo_store *store); /* counts openings: 1 for the first */
int64_t mo_store_now_us(void);                        /* wall clock */

struct mo_store_stats {
  uint64_t commits, operations,
      operations_failed; /* operations / commits: how well commits are shared */
  uint64_t queued;       /* operations waiting for the writer */
  double commit_s;       /* sum of the time spent in COMMIT */
  int64_t database_bytes, wal_bytes;
  int64_t heartbeat_us; /* monotonic clock: when the writer last came round (at least once per s) */
  bool no_space;        /* the last write failed for want of space */
  bool fatal;
};
void mo_store_get_stats(struct mo_store *store, struct mo_store_stats *stats); /* lock-free */

/* A consistent copy of the database at `path` (must not exist): VACUUM INTO beside it,
 * integrity_check, fsync, rename. The folder controllers/ is to be copied after this; its files
 * never change. Files of trainings/ come and go: copied before this, they may lack the newest
 * checkpoints, and a training goes on from an older one, or from its start; those of campaigns/
 * have to be of the same generation as the database. Runs on the caller's thread. MO_ERR_CONFLICT:
 * path exists. */
int mo_store_backup(struct mo_store *store, const char *path, struct mo_message *message);
/* SQLite's integrity_check and foreign_key_check. MO_ERR_CORRUPT with the first finding. */
int mo_store_check(struct mo_store *store, struct mo_message *message);

/* ---- events ---- */

/* Called on the writer's thread after each commit that made events, in order; must be short and
 * must not call the store's writing functions. 0 or MO_ERR_NO_MEMORY, MO_ERR_LIMIT. */
typedef void (*mo_store_listener)(void *context, const struct mo_event *events, size_t n);
int mo_store_subscribe(struct mo_store *store, mo_store_listener listener, void *context,
                       int *ret_handle);
void mo_store_unsubscribe(struct mo_store *store,
                          int handle); /* after it returns, the listener is not called again */

/* Events with sequence > after, ascending, at most `limit`; job 0: all. Returns the number written
 * to `events` or an error. One that cannot be read is there with its damage. *oldest, *newest
 * (nullable): the range that is kept (0, 0: none yet), up to 18 digits. after < *oldest − 1: some
 * were pruned: `reset`. */
int64_t mo_store_events(struct mo_store *store, int64_t after, int64_t job, struct mo_event *events,
                        size_t limit, int64_t *oldest, int64_t *newest);

/* ---- jobs and evaluations ---- */

/* MO_ERR_NOT_FOUND. MO_ERR_CORRUPT: with job->damage, which is "" when the database itself is
 * damaged. */
int mo_store_job(struct mo_store *store, int64_t id, struct mo_job *job);

/* After a reading of a job, or of what belongs to it, has given MO_ERR_CORRUPT: which row that is,
 * in job->damage; the job's id and kind are there, too. MO_ERR_NOT_FOUND: there is no such job, or
 * no row is found. A campaign of a million designs takes half a second. */
int mo_store_job_damage(struct mo_store *store, int64_t id, struct mo_job *job);

struct mo_job_query {
  int64_t before; /* only ids below this; 0: from the newest */
  int state;      /* enum mo_job_state or −1 */
  int kind;       /* enum mo_job_kind or −1 */
  /* (n_waiting ≤ MO_WAITING_MAX) jobs that, while they run, are shown and so found as paused;
   * nullable. */
  const int64_t *waiting;
  size_t n_waiting;
};
#define MO_WAITING_MAX 80 /* all trainings and campaigns that can run */
/* Newest first, at most `limit` ≤ MO_PAGE_MAX, also those that cannot be read (damage). Returns the
 * number or an error. Next page: before = last id. */
int64_t mo_store_jobs(struct mo_store *store, const struct mo_job_query *query, struct mo_job *jobs,
                      size_t limit);
/* Jobs per state. */
int mo_store_job_counts(struct mo_store *store, uint64_t counts[MO_JOB_STATES]);

/* MO_ERR_NOT_FOUND. Of a job that has not succeeded, what is there so far. */
int mo_store_results(struct mo_store *store, int64_t id, struct mo_evaluation_results **results);

/* Design n, environment k (both from 0) of an evaluation that recorded. MO_ERR_NOT_FOUND: no such
 * evaluation, design or environment, or nothing recorded (yet). */
int mo_store_trajectory(struct mo_store *store, int64_t id, uint32_t n, uint32_t k,
                        struct mo_trajectory **trajectory);

/* ---- designs ---- */

int mo_store_design(struct mo_store *store, const struct mo_bits *form,
                    struct mo_design **design); /* MO_ERR_NOT_FOUND */

/* After that has given MO_ERR_CORRUPT: which row it is, and that of the design. MO_ERR_NOT_FOUND as
 * of jobs. */
int mo_store_design_damage(struct mo_store *store, const struct mo_bits *form, int64_t *row,
                           char words[MO_DAMAGE_BYTES]);

enum mo_design_sort {
  MO_DESIGNS_BY_ID = 0 /* order of first sight */,
  MO_DESIGNS_BY_SCORE = 1 /* best first */
};
struct mo_design_query {
  enum mo_design_sort sort;
  int64_t
      after_row; /* by id: rows after this; by score: genotype_row of the last; 0: from the first */
  double after_score; /* by score, with after_row: score of the last */
  /* by score: of which setting (rows without such a score are left out) */
  struct mo_sha256 controller_sha256;
  char environment_set[MO_NAME_BYTES_MAX + 1];
  struct mo_physics physics;
  enum mo_precision precision;
};
int64_t mo_store_designs(struct mo_store *store, const struct mo_design_query *query,
                         struct mo_design_row *rows, size_t limit);
int mo_store_design_count(struct mo_store *store, uint64_t *n);

/* ---- controllers ---- */

int64_t mo_store_controllers(struct mo_store *store, const char *after_name,
                             struct mo_controller_record *records,
                             size_t limit); /* by name; after_name NULL: from the first */
/* Those whose names are damaged, which the other list leaves out, in an order that stays, after the
 * first passed_over: with damage, and the beginning of what they are called. */
int64_t mo_store_controllers_misnamed(struct mo_store *store, int64_t passed_over,
                                      struct mo_controller_record *records, size_t limit);
/* `name`: a name, or "sha256:<64 hex>". MO_ERR_NOT_FOUND. */
int mo_store_controller(struct mo_store *store, const char *name,
                        struct mo_controller_record *record);
/* The file's bytes (malloc). Checked against the hash: MO_ERR_CORRUPT. */
int mo_store_controller_bytes(struct mo_store *store, const struct mo_sha256 *sha256,
                              uint8_t **bytes, size_t *size);
/* Its metadata, a JSON object (malloc). */
int mo_store_controller_metadata(struct mo_store *store, const struct mo_sha256 *sha256,
                                 char **json);

/* Stores bytes (already checked by mo_controller_decode: the caller passes what it read) under a
 * name, or re-points the name. *created: the name is new. MO_ERR_FORMAT: not a name
 * ([a-z0-9][a-z0-9._-]{0,63}). */
int mo_store_controller_put(struct mo_store *store, const char *name, const uint8_t *bytes,
                            size_t size, const struct mo_controller *controller,
                            struct mo_controller_record *record, bool *created);
/* Removes the name; content that scores or jobs refer to stays. MO_ERR_NOT_FOUND. */
int mo_store_controller_remove(struct mo_store *store, const char *name);
int mo_controller_name_check(const char *name); /* MO_OK or MO_ERR_FORMAT */

#endif
