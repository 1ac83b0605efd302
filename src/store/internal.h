/* internal.h: connections, the writer's queue, the store itself, shared queries. Only for this
 * room. */
#ifndef MORPHO_STORE_INTERNAL_H
#define MORPHO_STORE_INTERNAL_H

#include <pthread.h>
#include <sqlite3.h>
#include <stdatomic.h>

#include "store/encode.h"
#include "store/runner.h"
#include "store/store.h"
#include "store/trainings.h"

#define MO_APPLICATION_ID    0x6D727068 /* "mrph" */
#define MO_STATEMENTS_MAX    192
#define MO_CHECKPOINT_FRAMES 2000
#define MO_WAL_LONG          4 /* times the configured number of frames */
#define MO_BUSY_MS           5000
#define MO_LISTENERS_MAX     64

/* ---- a connection: a database handle with its prepared statements, used by one thread at a time
 * ---- */

struct mo_connection {
  sqlite3 *db;
  struct {
    const char *sql;
    sqlite3_stmt *statement;
  } cache[MO_STATEMENTS_MAX];
  unsigned n_cached;
  bool busy;
};

/* Call mo_mapping_init before the first connection. mo_mapping_error translates the error of this
 * thread's last mapping (mapping.c). */
void mo_mapping_init(void);
int mo_mapping_error(void);
int mo_connection_open(const struct mo_store *store, bool writable,
                       struct mo_connection *connection);
void mo_connection_close(struct mo_connection *connection);

/* Returns the cached statement of a string literal (found by its address), reset and without
 * bindings. NULL: it cannot be prepared; *error says why. */
sqlite3_stmt *mo_sql(struct mo_connection *connection, const char *sql, int *error);
/* 1: a row; 0: done (and reset); negative: an error (and reset). */
int mo_sql_step(struct mo_connection *connection, sqlite3_stmt *statement);
/* Runs a statement that returns no rows. */
int mo_sql_run(struct mo_connection *connection, sqlite3_stmt *statement);
int mo_sql_exec(struct mo_connection *connection, const char *sql);
/* Reads the integer in the first row. MO_ERR_NOT_FOUND: no rows. */
int mo_sql_integer(struct mo_connection *connection, sqlite3_stmt *statement, int64_t *value);
/* Reads a page of rows on a pooled connection: binds `values` to ?1 …, then the limit; `take`
 * copies each row into its place. Returns the number of rows or an error. MO_ERR_LIMIT: limit >
 * MO_PAGE_MAX. */
int64_t mo_read_rows(struct mo_store *store, const char *sql, const int64_t *values, int n_values,
                     size_t limit, int (*take)(sqlite3_stmt *statement, void *row), void *rows,
                     size_t row_size);
/* Translates SQLite's result code into an MO_ERR_ code. */
int mo_sql_error(sqlite3 *db, int code);

/* Binds data that must outlive the step. Binding fails only by a mistake in this room. */
void mo_bind_hash(sqlite3_stmt *statement, int index, const struct mo_sha256 *hash);
/* Read a column and check it: MO_ERR_CORRUPT. */
int mo_column_hash(sqlite3_stmt *statement, int column, struct mo_sha256 *hash);
int mo_column_bits(sqlite3_stmt *statement, int column, struct mo_bits *bits);
/* Reads an environment and checks its hash. */
int mo_column_environment(sqlite3_stmt *statement, int data, int sha256,
                          struct mo_environment *environment);
int mo_column_double(sqlite3_stmt *statement, int column, double *value); /* 8-byte BLOB */
void mo_column_text(sqlite3_stmt *statement, int column, char *text, size_t size);

/* ---- writing ---- */

struct mo_operation {
  /* Runs inside a savepoint, perhaps several times: each run must ignore what an earlier one left
   * in `arguments`. */
  int (*run)(struct mo_store *store, void *arguments);
  void *arguments;
  void (*done)(void *arguments, int status); /* NULL: the caller waits */
  bool is_urgent;                            /* may use the reserve */
  int status;
  bool finished;
  size_t first_event; /* index of the operation's first event in the batch */
  pthread_cond_t released;
  struct mo_operation *next;
};

struct mo_store {
  char *path, *database_path, *controllers_path, *trainings_path, *campaigns_path, *reserve_path,
      *vfs;
  const struct mo_file_operations *files;
  bool must_exist;
  int folder_fd, lock_fd; /* both locked */
  int64_t epoch, id;
  uint64_t events_kept;
  int64_t idempotency_keep_us;
  void (*fatal)(void *context, const char *what);
  void *fatal_context;
  struct mo_orphans orphans;

  /* Readers. */
  pthread_mutex_t readers_mutex;
  pthread_cond_t reader_free;
  struct mo_connection *readers;
  uint32_t n_readers;
  pthread_mutex_t runner_mutex;
  struct mo_connection runner; /* the scheduler's */

  /* The writer. `mutex` guards the list of operations and `closing`; only the writer's thread
   * touches the rest. */
  struct mo_connection writer;
  pthread_t thread;
  bool thread_started;
  pthread_mutex_t mutex;
  pthread_cond_t work;
  struct mo_operation *first, *last;
  bool closing;
  struct mo_event *events; /* of this batch */
  size_t n_events, events_capacity;
  uint64_t events_since_prune;
  int64_t last_prune_us, last_probe_us, last_restart_us, next_reserve_us;
  int wal_frames, checkpoint_frames;
  bool reserve_whole;

  pthread_mutex_t checkpoints_mutex; /* guards checkpoint files and their rows; locked before
                                        anything is written */
  /* Read lock: from the write of a file of weights to the commit of its row. Write lock: from the
   * deletion of a row to that of its file. */
  pthread_rwlock_t controllers_lock;
  pthread_mutex_t listeners_mutex;
  struct {
    int handle;
    mo_store_listener call;
    void *context;
  } listeners[MO_LISTENERS_MAX];
  unsigned n_listeners;
  int next_handle;

  atomic_uint_fast64_t commits, operations, operations_failed, queued, commit_ns;
  atomic_int_fast64_t database_bytes, wal_bytes, heartbeat_us;
  atomic_bool no_space, is_fatal;
  atomic_bool is_short; /* part of the reserve is in use: only urgent operations may write */
  atomic_uint file_counter;
};

/* Runs `run` on the writer's thread and waits for its commit. */
int mo_write(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
             void *arguments);
/* Like mo_write, but may use the reserve: for requests that clients need on a full disk, and for
 * what every start writes. Only for small writes that no job makes or repeats by itself. */
int mo_write_urgent(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                    void *arguments);
/* Like mo_write, but does not wait. `done` frees what is to be freed. */
int mo_write_later(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                   void *arguments, void (*done)(void *arguments, int status));
/* Declares the store fatal: acknowledged writes may not be on the disk. May be called from any
 * thread. */
void mo_store_declare_fatal(struct mo_store *store, const char *what);
int mo_writer_start(struct mo_store *store);
void mo_writer_stop(struct mo_store *store);
/* Adds an event; only inside an operation. `data`: a JSON object. */
int mo_writer_event(struct mo_store *store, int64_t job, const char *type, const char *data);

/* ---- the folder (folder.c) ---- */

/* Locks the state folder. The caller closes *file_fd in any case, unless it is −1. MO_ERR_BUSY:
 * another process holds the lock. */
int mo_state_folder_lock(int fd, const char *path, int *file_fd, struct mo_message *message);

/* ---- reading ---- */

struct mo_connection *mo_reader_acquire(struct mo_store *store); /* waits for a free reader */
void mo_reader_release(struct mo_store *store, struct mo_connection *connection);

/* ---- the reserve (reserve.c) ---- */

/* Only the writer's thread calls these, and opening before that thread starts. */
/* Makes the reserve whole again. If there is no space for it, the store is short of space. */
void mo_reserve_make(struct mo_store *store);
/* Frees the reserve. true: the store is short of space, and there may be some space now. */
bool mo_reserve_free(struct mo_store *store);

/* ---- shared queries ---- */

/* What each change of a job counts. */
#define MO_NEXT_VERSION "version=version+1"
#define MO_NEXT_ATTEMPT "(attempts+1)"

#define MO_JOB_COLUMNS                                                                             \
  "j.id,j.version,j.kind,j.state,j.priority,j.label,j.created_us,j.started_us,j.finished_us,j."    \
  "attempts,j.error,"                                                                              \
  "j.error_text,e.controller_name,c.sha256,s.name,e.n_environments,e.n_designs,p.encoding,e."      \
  "verify,e.record,"                                                                               \
  "e.record_stride,e.done,e.cached,e.diverged,t.parent_name,t.n_designs,t.settings,t.step,j."      \
  "weight,"                                                                                        \
  "m.controller_name,m.settings,m.generations,m.generation,m.n_environments,j.back_end"
#define MO_JOB_TABLES                                                                              \
  " FROM jobs j LEFT JOIN evaluations e ON e.job=j.id LEFT JOIN trainings t ON t.job=j.id"         \
  " LEFT JOIN campaigns m ON m.job=j.id LEFT JOIN controllers c ON "                               \
  "c.id=coalesce(e.controller,t.parent,m.controller)"                                              \
  " LEFT JOIN physics p ON p.id=e.physics LEFT JOIN environment_sets s"                            \
  " ON s.id=coalesce(e.environment_set,m.environment_set) "
#define MO_JOB_N_COLUMNS 35
/* MO_ERR_CORRUPT: the row cannot be decoded. */
int mo_job_from_row(sqlite3_stmt *statement, struct mo_job *job);
int mo_job_state_get(struct mo_connection *connection, int64_t id, enum mo_job_state *state,
                     enum mo_job_kind *kind); /* MO_ERR_NOT_FOUND */

/* Finds or inserts a design and one of its orientations, by content. */
int mo_genotype_row(struct mo_connection *writer, const struct mo_bits *form,
                    const struct mo_bits *genotype, int64_t now_us, int64_t *row);
/* Inserts the designs of a job, in order. sql: ?1 job, ?2 position, ?3 genotype's row. */
int mo_designs_insert(struct mo_connection *writer, const char *sql, int64_t id,
                      const struct mo_bits *forms, const struct mo_bits *genotypes, uint32_t n,
                      int64_t now_us);
int mo_job_insert(struct mo_connection *writer, enum mo_job_kind kind, enum mo_urgency priority,
                  enum mo_back_end back_end, double weight, const char *label, int64_t now_us,
                  int64_t *id);
/* Inserts the environments of a job: those of `set` (copy_sql: ?1 job, ?2 set), or if set is 0 the
 * given ones (sql: ?1 job, ?2 position, ?3 environment). */
int mo_environments_insert(struct mo_connection *writer, const char *copy_sql, const char *sql,
                           int64_t id, int64_t set, const struct mo_environment *environments,
                           uint32_t n);
int mo_environment_row(struct mo_connection *writer, const struct mo_environment *environment,
                       int64_t *row);
int mo_physics_row(struct mo_connection *writer, const struct mo_physics *physics,
                   enum mo_precision precision, enum mo_sensor sensor, int64_t *row);
/* Finds a named set and its size. MO_ERR_NOT_FOUND. */
int mo_environment_set_find(struct mo_connection *connection, const char *name, int64_t *row,
                            int64_t *n);
/* Insert scores of rollouts that have none yet (*n_new: how many), and a genotype's mean over a
 * named set, if the set is complete and the mean is not stored yet. */
int mo_scores_insert(struct mo_connection *writer, const struct mo_saved_score *scores, size_t n,
                     int64_t now_us, uint32_t *n_new);
int mo_set_score_insert(struct mo_connection *writer, const struct mo_saved_design *design);
/* Like mo_set_score_insert when all losses of the set were new, so that the caller knows the mean.
 */
int mo_set_score_insert_mean(struct mo_connection *writer, const struct mo_saved_design *design,
                             double mean);
/* Finds the job of an idempotency key. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: the key has another body.
 */
int mo_key_find(struct mo_connection *connection, const char *key, const struct mo_sha256 *body,
                int64_t *id);
int mo_key_insert(struct mo_connection *writer, const char *key, const struct mo_sha256 *body,
                  int64_t now_us, int64_t id);
/* Queries for pages of jobs, newest first. `select` returns rows of jobs j with their id first;
 * `where` is a condition that an index answers. ?1: ids are below this; ?2: state; ?3: limit; ?4
 * and ?6 (a label): free for `where`; ?5: ids of waiting jobs, which are shown as paused while they
 * run. No page needs sorting: each part comes in order from its index, and SQLite merges two of
 * them. */
#define MO_PAGE_OF_ALL(select, where)                                                              \
  select " WHERE " where " AND j.id<?1 ORDER BY j.id DESC LIMIT ?3"
#define MO_PAGE_OF_STATE(select, where) MO_PAGE_OF_ALL(select, where " AND j.state=?2")
#define MO_PAGE_OF_SHOWN(select, where)                                                            \
  select                                                                                           \
      " WHERE " where                                                                              \
      " AND j.state=?2 AND (?2<>1 OR j.id NOT IN (SELECT value FROM json_each(?5))) AND j.id<?1"   \
      " UNION ALL " select " WHERE " where                                                         \
      " AND j.state=1 AND ?2=2 AND +j.id IN (SELECT value FROM json_each(?5))"                     \
      " AND j.id<?1 ORDER BY 1 DESC LIMIT ?3"
#define MO_PAGES(select, where)                                                                    \
  {                                                                                                \
    MO_PAGE_OF_ALL(select, where), MO_PAGE_OF_STATE(select, where),                                \
        MO_PAGE_OF_SHOWN(select, where)                                                            \
  }
/* Returns the index in MO_PAGES of the query. */
unsigned mo_job_page(const struct mo_job_query *query);
/* Binds ?1 to ?5. MO_ERR_LIMIT. */
int mo_bind_page(sqlite3_stmt *statement, const struct mo_job_query *query, int64_t fourth,
                 size_t limit);
/* Reads a page of jobs of one kind in one transaction: `sql` returns their ids as above; `load`
 * reads each into its place, which begins with a struct mo_job. */
int64_t mo_read_jobs(struct mo_store *store, const char *sql, const struct mo_job_query *query,
                     int64_t group, size_t limit,
                     int (*load)(struct mo_connection *reader, int64_t id, void *status),
                     void *statuses, size_t status_size);
/* Finds or inserts a fingerprint. */
int mo_fingerprint_row(struct mo_connection *writer, const char *text, int64_t *id);
int mo_training_code_load(struct mo_connection *connection, int64_t id,
                          struct mo_training_lineage *lineage);
/* runs.c: jobs that run on a thread of their own. These are called inside an operation: */
/* Increases the version of a job that still takes writes. MO_ERR_CONFLICT: the job is final, or was
 * not started under this opening. */
int mo_run_touch(struct mo_store *store, int64_t id, enum mo_job_kind kind);
/* Adds an event with a job's state. more: further members of the JSON object, each with a leading
 * comma. */
int mo_run_announce(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *type,
                    enum mo_job_state state, const char *more);
/* Runs a statement. MO_ERR_CONFLICT: it changed nothing. */
int mo_run_changed(struct mo_connection *writer, sqlite3_stmt *statement);
/* These are operations of their own: mo_store_queued_trainings, mo_store_training_start and _park
 * for both kinds. MO_ERR_DEVICE pauses the job and counts no attempt. */
int64_t mo_run_queued(struct mo_store *store, enum mo_job_kind kind, int64_t *ids, size_t limit);
int mo_run_start(struct mo_store *store, int64_t id, enum mo_job_kind kind);
int mo_run_park(struct mo_store *store, int64_t id, enum mo_job_kind kind, int error,
                const char *error_text, uint32_t max_attempts, enum mo_job_state *after);
/* Reads a controller's sensor. MO_ERR_UNSUPPORTED: its workspace is not the default one. */
int mo_controller_sensor(struct mo_connection *connection, int64_t row, enum mo_sensor *sensor);

/* Stores a file of weights, then its row and name. Begin: on any thread; row: in an operation; end:
 * always. */
struct mo_controller_put {
  const char *name;
  const struct mo_controller *controller;
  char *metadata;
  struct mo_sha256 sha256;
  size_t size;
  struct mo_controller_record record;
  bool created, is_locked;
  int64_t row; /* result */
};
int mo_controller_put_begin(struct mo_store *store, const char *name, const uint8_t *bytes,
                            size_t size, const struct mo_controller *controller,
                            struct mo_controller_put *call);
char *mo_controller_path(const struct mo_store *store, const struct mo_sha256 *sha256); /* malloc */
int mo_controller_put_row(struct mo_store *store, struct mo_controller_put *call);
void mo_controller_put_end(struct mo_store *store, struct mo_controller_put *call);

/* ---- files ---- */

/* Reads a file of `size` bytes (malloc). MO_ERR_NOT_FOUND; MO_ERR_CORRUPT: another size; MO_ERR_IO;
 * MO_ERR_NO_MEMORY: of memory or descriptors. */
int mo_file_read(const char *path, size_t size, uint8_t **bytes);
/* Like mo_file_read for a file that a row refers to. MO_ERR_CORRUPT also: it is missing, or has
 * another hash. */
int mo_file_read_checked(const char *path, size_t size, const struct mo_sha256 *sha256,
                         uint8_t **bytes);
/* Writes a file, atomic and durable. `path` is in `folder`. MO_ERR_NO_SPACE: nothing was changed.
 */
int mo_file_write(struct mo_store *store, const char *folder, const char *path,
                  const uint8_t *bytes, size_t size);
/* MO_ERR_NO_MEMORY: the folder cannot be opened now; MO_ERR_IO is fatal to the store. */
int mo_folder_sync(struct mo_store *store, const char *path);
/* Makes a folder if it is missing and makes its name durable in any case. */
int mo_folder_make(struct mo_store *store, const char *parent, const char *path);
/* Counts files without rows in store->orphans, and removes those that this program left behind.
 * connection NULL: recognizes only unfinished files as such. Called before the writer starts. */
int mo_files_sort_out(struct mo_store *store, struct mo_connection *connection, bool removes);
/* Reports the files of controllers that nothing refers to, or (tell NULL) removes them. */
int mo_controllers_clean(struct mo_store *store,
                         void (*tell)(void *context, const char *name, uint64_t bytes),
                         void *context);

/* Finds a controller's row by name or "sha256:…". MO_ERR_NOT_FOUND. */
int mo_controller_find(struct mo_connection *connection, const char *name, int64_t *row);
/* Makes the paper's test set if it is missing. When the writer has started. */
int mo_make_paper_test(struct mo_store *store);

#endif
