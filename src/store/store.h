/* store.h: the durable state: one SQLite database and the files next to it, in one folder.
 *
 *   <path>/morphod.db (+ -wal, -shm)             all tables (schema/schema.sql)
 *   <path>/controllers/<sha256>.safetensors      weights, identified by content
 *   <path>/trainings/<job>/<step>.checkpoint     states of training runs (store/trainings.h)
 *   <path>/campaigns/<job>/<generation>-<step>.checkpoint   of campaigns (store/campaigns.h)
 *   <path>/atlases/<name>.atlas                  atlases (store/atlas_names.h)
 *   <path>/reserve                               4 MiB set aside for a full disk
 *   <path>/lock                                  locked, like the folder, by the process using it
 *
 * When the disk is full, pausing, cancelling, deleting and opening may use the reserve. Until it is
 * restored, all other writes return MO_ERR_NO_SPACE, even after a restart.
 *
 * One connection, on its own thread, writes. Callers submit operations to it. Each operation runs
 * in a savepoint; all waiting operations are committed together with one fsync; then their callers
 * return. Reads use a pool of read-only connections and never wait for the writer. All functions
 * may be called from any thread.
 *
 * Any function may return MO_ERR_NO_MEMORY, MO_ERR_CORRUPT (the database contradicts itself) or
 * MO_ERR_IO. Functions that write may also return MO_ERR_NO_SPACE (nothing was changed; retry when
 * there is space) or MO_ERR_CANCELLED (the store is closing). A failed fsync, or a write error
 * other than a full disk, is fatal: the store calls `fatal` once, every later write returns
 * MO_ERR_IO, and the process must exit. The next start recovers the database. */
#ifndef MORPHO_STORE_STORE_H
#define MORPHO_STORE_STORE_H

#include "base/files.h"
#include "store/controllers.h"
#include "store/designs.h"
#include "store/evaluations.h"
#include "store/events.h"
#include "store/labels.h"

struct mo_store_config {
  const char *path; /* the state folder; must exist and be writable */
  const char
      *vfs; /* NULL: SQLite's default; must outlive the store; tests set one that fails on demand */
  const struct mo_file_operations *files; /* NULL: the system's; must outlive the store; tests pass
                                             a table that fails on demand */
  uint32_t n_readers;                     /* read connections; 0: 4 */
  uint64_t events_kept;                   /* older ones are pruned; 0: 100000 */
  int64_t idempotency_keep_s;             /* 0: 24 h */
  uint32_t checkpoint_frames;    /* number of pages at which the log is copied into the database; 0:
                                    2000 */
  uint64_t max_recordings_bytes; /* beyond this, recordings of evaluations that have ended are
                                    removed, oldest first; 0: no limit */
  uint64_t max_excluded_bytes;   /* for all files of excluded bodies (excluded.h); 0: keeps none */
  int64_t keep_jobs_s[MO_JOB_KINDS]; /* after their end; 0: no limit */
  int64_t keep_recordings_s;         /* after the end of their evaluation; 0: no limit */
  bool must_exist;                   /* MO_ERR_NOT_FOUND if no database exists yet */
  void (*fatal)(void *context, const char *what); /* once, on any thread; nullable */
  void *fatal_context;
};

/* Opens the state folder and returns its descriptor (≥ 0). The folder and its contents must belong
 * to this process's user, and no other user may be able to write to it. *real (nullable, malloc):
 * its path without links. MO_ERR_INVALID: an owner or a permission is wrong, or the path goes
 * through a link of another user; MO_ERR_NOT_FOUND: no such folder; MO_ERR_IO. */
int mo_state_folder_open(const char *path, char **real, struct mo_message *message);

/* Opens or creates a store. MO_ERR_INVALID: as in mo_state_folder_open; MO_ERR_BUSY: another
 * process uses the folder; MO_ERR_UNSUPPORTED: a newer version or 0.1 wrote it, or the file system
 * has no shared memory; MO_ERR_FORMAT: not a database of morphod; MO_ERR_NOT_FOUND: no such folder;
 * MO_ERR_CONFLICT: the folder has files but no database, so the database is missing; MO_ERR_IO: not
 * writable; MO_ERR_NO_SPACE: even the reserve does not suffice. After an unclean stop it runs
 * SQLite's quick_check (MO_ERR_CORRUPT). Stores the paper's test set if it is missing. */
int mo_store_open(const struct mo_store_config *config, struct mo_store **store,
                  struct mo_message *message);
/* Runs all queued operations, checkpoints and closes. NULL-safe. No other call may be running. */
void mo_store_close(struct mo_store *store);
/* Limits the caches of all stores to about `bytes` together. Call it before opening the first. */
void mo_store_limit_memory(uint64_t bytes);

/* Files below controllers/, trainings/ and campaigns/ that no row refers to. Opening the store does
 * not remove them. */
struct mo_orphans {
  uint64_t n, bytes;
  char first[320]; /* names of up to three */
};
const struct mo_orphans *mo_store_orphans(const struct mo_store *store);
/* Calls `report` for each orphan, and for each file of a controller that nothing refers to. With
 * report NULL, removes all of them. No other call may use the store at the same time. */
int mo_store_clean(struct mo_store *store,
                   void (*report)(void *context, const char *name, uint64_t bytes), void *context);
/* Confirms that the wall clock is right, even if the service was off for a long time. */
int mo_store_accept_clock(struct mo_store *store);
/* Returns a random number chosen when the database was created: unique to this store. */
uint64_t mo_store_id(const struct mo_store *store);
/* Returns the random number of this history: a restore, a copy or a crash starts a new one. */
uint64_t mo_store_history(const struct mo_store *store);
/* Returns the number of times the store was opened: unique to this opening. */
uint64_t mo_store_epoch(const struct mo_store *store);

struct mo_store_stats {
  uint64_t commits, operations, operations_failed; /* operations / commits: mean size of a batch */
  uint64_t queued;                                 /* operations waiting for the writer */
  double commit_s;                                 /* sum of the time spent in COMMIT */
  int64_t database_bytes, wal_bytes;
  uint64_t recorded_bytes;                                             /* of all recordings */
  uint64_t recordings_removed, recordings_removed_bytes, jobs_expired; /* since the opening */
  int64_t clock_ahead_us; /* > 0: too far ahead to be credible, so nothing is deleted by age */
  int64_t heartbeat_us;   /* monotonic clock: the writer's last round (at least one per second) */
  bool no_space;          /* the last write failed for lack of space */
  bool fatal;
};
void mo_store_get_stats(struct mo_store *store, struct mo_store_stats *stats); /* lock-free */

/* Runs SQLite's own checks. MO_ERR_CORRUPT: `message` holds the first finding. */
int mo_store_check(struct mo_store *store, struct mo_message *message);

/* ---- jobs ---- */

/* MO_ERR_NOT_FOUND. MO_ERR_CORRUPT: a row cannot be decoded. */
int mo_store_job(struct mo_store *store, int64_t id, struct mo_job *job);

struct mo_job_query {
  int64_t before;           /* only ids below this; 0: from the newest */
  int state, kind;          /* enum mo_job_state, enum mo_job_kind, or −1 */
  const char *label;        /* only jobs with this label; nullable */
  bool label_is_prefix;     /* also labels that begin with it */
  const char *search;       /* only labels with this text, in either case; nullable */
  const char *experiment;   /* only jobs of this experiment; nullable */
  int archived;             /* 0: only unarchived jobs; 1: only archived jobs; −1: both */
  const char *submitted_by; /* only jobs submitted with the token of this name; nullable */
  /* (n_waiting ≤ MO_WAITING_MAX) running jobs that are listed and matched as paused; nullable. */
  const int64_t *waiting;
  size_t n_waiting;
  int64_t group; /* only campaigns of this group of replicates; 0: any job */
};
#define MO_WAITING_MAX 82 /* largest number of jobs other than evaluations that can run at once */
/* Reads a page, newest first; returns its size (limit ≤ MO_PAGE_MAX). Next: before = last id. */
int64_t mo_store_jobs(struct mo_store *store, const struct mo_job_query *query,
                      void *jobs /* struct mo_job */, size_t limit);
/* Counts the jobs in each state. */
int mo_store_job_counts(struct mo_store *store, uint64_t counts[MO_JOB_STATES]);

/* ---- the attempts of training runs and campaigns ---- */

/* Reads the ids of queued training runs or campaigns, by priority, then ascending. */
int64_t mo_store_queued_runs(struct mo_store *store, enum mo_job_kind kind, int64_t *ids,
                             size_t limit);
/* queued → running. MO_ERR_CONFLICT. */
int mo_store_run_start(struct mo_store *store, int64_t id);
/* Ends an attempt. error MO_OK (a stop): running → queued, and the attempts do not change.
 * MO_ERR_DEVICE: running → paused. Otherwise: → queued, attempts + 1, or at max_attempts → failed.
 * A job that is not running stays unchanged. *after (nullable): the resulting state. */
int mo_store_run_park(struct mo_store *store, int64_t id, int error, const char *error_text,
                      uint32_t max_attempts, enum mo_job_state *after);

#endif
