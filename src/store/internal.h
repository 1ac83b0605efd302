/* internal.h: connections, the writer's queue, the store itself, shared queries. Only for this
 * room. */
#ifndef MORPHO_STORE_INTERNAL_H
#define MORPHO_STORE_INTERNAL_H

#include <pthread.h>
#include <stdatomic.h>

#include "store/readers.h"
#include "store/runner.h"
#include "store/store.h"

#define MO_APPLICATION_ID    0x6D727068 /* "mrph" */
#define MO_CHECKPOINT_FRAMES 2000
#define MO_WAL_LONG          4 /* times the configured number of frames */
#define MO_BUSY_MS           5000
#define MO_LISTENERS_MAX     64

/* ---- writing ---- */

struct mo_operation {
  /* Runs inside a savepoint, possibly several times: each run must ignore leftovers of an earlier
   * run in `arguments`. */
  int (*run)(struct mo_store *store, void *arguments);
  void *arguments;
  void (*done)(void *arguments, int status); /* NULL: the caller waits */
  bool is_urgent;                            /* may use the reserve */
  int status;
  bool finished;
  pthread_cond_t released;
  struct mo_operation *next;
};

struct mo_store {
  char *path, *database_path, *reserve_path;
  char *controllers_path, *trainings_path, *campaigns_path, *excluded_path, *atlases_path;
  const char *vfs;
  const struct mo_file_operations *files;
  bool must_exist;
  int folder_fd, lock_fd;             /* both are locked */
  int64_t epoch, id, history, origin; /* origin: the row of this host in `origins` */
  uint64_t events_kept;
  int64_t idempotency_keep_us;
  void (*fatal)(void *context, const char *what);
  void *fatal_context;
  struct mo_orphans orphans;

  /* Readers. */
  pthread_mutex_t readers_mutex;
  pthread_cond_t reader_free, import_closed;
  struct mo_connection *readers; /* (n_readers + 1) the last is the scheduler's */
  uint32_t n_readers;

  /* The writer. `mutex` guards the list of operations and `closing`; only the writer's thread
   * touches the rest. */
  struct mo_connection writer;
  pthread_t thread;
  bool thread_started;
  pthread_mutex_t mutex;
  pthread_cond_t work;
  struct mo_operation *first, *last;
  bool closing;
  struct mo_event *events; /* events of this batch */
  size_t n_events, events_capacity;
  uint64_t events_since_prune;
  int64_t last_prune_us, last_probe_us, last_restart_us, next_reserve_us;
  int wal_frames, checkpoint_frames;
  uint64_t max_recordings_bytes, max_excluded_bytes;      /* 0: no limit; 0: keep none */
  int64_t keep_jobs_us[MO_JOB_KINDS], keep_recordings_us; /* after their end; 0: no limit */
  int64_t last_upkeep_us, credible_us, credible_at_us;    /* as stored, and mo_clock_us() then */
  unsigned aged_left; /* deletions by age that are still allowed before the next upkeep */
  void (*upkeep)(struct mo_store *store); /* between batches; nullable */
  bool reserve_whole, is_importing;
  pthread_mutex_t excluded_mutex;    /* held while a file of excluded bodies is written */
  pthread_mutex_t checkpoints_mutex; /* guards checkpoint files and their rows; locked before
                                        anything is written */
  /* Read lock: from the write of a file of weights to the commit of its row. Write lock: from the
   * deletion of a row to the deletion of its file. */
  pthread_rwlock_t controllers_lock;
  pthread_mutex_t imports_mutex, listeners_mutex; /* imports_mutex guards is_importing */
  struct {
    int handle;
    mo_store_listener call;
    void *context;
  } listeners[MO_LISTENERS_MAX];
  unsigned n_listeners;
  int next_handle;
  bool (*used)(void *context, int64_t job, double *worker_s, double *device_s); /* nullable */
  void *used_context;

  atomic_uint_fast64_t commits, operations, operations_failed, queued, commit_ns;
  atomic_int_fast64_t database_bytes, wal_bytes, heartbeat_us, clock_ahead_us;
  atomic_uint_fast64_t recorded_bytes, recordings_removed, recordings_removed_bytes, jobs_expired;
  atomic_bool no_space, is_fatal;
  atomic_bool is_short; /* part of the reserve is in use: only urgent operations may write */
  atomic_uint file_counter;
};

/* Runs `run` on the writer's thread and waits for its commit. */
int mo_write(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
             void *arguments);
/* Like mo_write, but may use the reserve: for requests that clients need on a full disk, and for
 * the writes of every start. Only for small writes that no job makes or repeats. */
int mo_write_urgent(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                    void *arguments);
/* Like mo_write, but does not wait. `done` frees the arguments. */
int mo_write_later(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                   void *arguments, void (*done)(void *arguments, int status));
/* Declares the store fatal: acknowledged writes may not be on the disk. May be called from any
 * thread. */
void mo_store_declare_fatal(struct mo_store *store, const char *what);
int mo_writer_start(struct mo_store *store);
void mo_writer_stop(struct mo_store *store);
/* Adds an event; only inside an operation. The format produces a JSON object. */
int mo_writer_event(struct mo_store *store, int64_t job, const char *type, const char *format, ...)
    __attribute__((format(printf, 4, 5)));

/* ---- reading ---- */

/* Calls `take` for each row of a page and its place in `rows`, on a pooled connection. The last
 * value is the limit. Returns the number of rows or an error. MO_ERR_LIMIT: limit > MO_PAGE_MAX. */
int64_t mo_read_page(struct mo_store *store, const char *sql, struct mo_values values,
                     int (*take)(sqlite3_stmt *statement, void *row), void *rows, size_t row_size);
/* Calls `take` for the first row. MO_ERR_NOT_FOUND: no row. */
int mo_read_one(struct mo_store *store, const char *sql, struct mo_values values,
                int (*take)(sqlite3_stmt *statement, void *row), void *ret);
/* Reads the first n columns of the first row. MO_ERR_NOT_FOUND: no row. */
int mo_read_integers(struct mo_store *store, const char *sql, struct mo_values values, int n,
                     int64_t *integers);
/* Calls `load` with a new object of `size` zero bytes. Returns NULL on failure, with *error. */
void *mo_read_whole(struct mo_store *store, size_t size,
                    int (*load)(struct mo_connection *reader, const void *key, void *ret),
                    const void *key, void (*release)(void *ret), int *error);

/* ---- automatic work of the store ---- */

/* mo_reserve_make restores the reserve; without disk space for it, the store is short of space.
 * mo_reserve_free frees it, and returns true if the store is short of space but may get some now.
 * Called only by the writer's thread, and while opening, before that thread starts. */
void mo_reserve_make(struct mo_store *store);
bool mo_reserve_free(struct mo_store *store);
/* Queues due deletions, including unfinished ones of the last process. Call it after the writer has
 * started. */
void mo_upkeep_begin(struct mo_store *store);
/* Does this once a minute, with recordings only by age. The writer calls it between batches. */
void mo_upkeep(struct mo_store *store);
/* Creates the paper's test set if it is missing. Call it after the writer has started. */
int mo_make_sets(struct mo_store *store);

#endif
