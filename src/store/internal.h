/* internal.h: connections, the writer's queue, and the store itself. For this room alone. */
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
#define MO_WAL_LONG          4 /* times that */
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

int mo_connection_open(const struct mo_store *store, bool writable,
                       struct mo_connection *connection);
void mo_connection_close(struct mo_connection *connection);

/* The statement of a literal (found again by its address), reset and unbound. NULL when it cannot
 * be prepared. */
sqlite3_stmt *mo_sql(struct mo_connection *connection, const char *sql, int *error);
/* 1: a row; 0: done (and reset); negative: an error (and reset). */
int mo_sql_step(struct mo_connection *connection, sqlite3_stmt *statement);
/* Runs a statement that gives no rows. */
int mo_sql_run(struct mo_connection *connection, sqlite3_stmt *statement);
int mo_sql_exec(struct mo_connection *connection, const char *sql);
/* The one integer of the first row; MO_ERR_NOT_FOUND without rows. */
int mo_sql_integer(struct mo_connection *connection, sqlite3_stmt *statement, int64_t *value);
/* A page: what a statement gives for these integers (?1 …) and, behind them, the limit, each row by
 * `take` into its place. Returns their number or an error; MO_ERR_LIMIT: more than MO_PAGE_MAX are
 * wanted. */
int64_t mo_read_rows(struct mo_store *store, const char *sql, const int64_t *values, int n_values,
                     size_t limit, int (*take)(sqlite3_stmt *statement, void *row), void *rows,
                     size_t row_size);
/* What a SQLite code means to callers. */
int mo_sql_error(sqlite3 *db, int code);

/* Bindings of static data, which cannot fail but by a mistake in this room. */
void mo_bind_hash(sqlite3_stmt *statement, int index, const struct mo_sha256 *hash);
/* Columns with their checks: MO_ERR_CORRUPT. */
int mo_column_hash(sqlite3_stmt *statement, int column, struct mo_sha256 *hash);
int mo_column_bits(sqlite3_stmt *statement, int column, struct mo_bits *bits);
/* An environment, checked against its hash. */
int mo_column_environment(sqlite3_stmt *statement, int data, int sha256,
                          struct mo_environment *environment);
int mo_column_double(sqlite3_stmt *statement, int column, double *value); /* 8-byte BLOB */
void mo_column_text(sqlite3_stmt *statement, int column, char *text, size_t size);

/* ---- writing ---- */

struct mo_operation {
  /* Runs inside a savepoint, perhaps more than once: a later run must forget what an earlier one
   * left in `arguments`. */
  int (*run)(struct mo_store *store, void *arguments);
  void *arguments;
  void (*done)(void *arguments, int status); /* NULL: somebody waits */
  bool is_urgent;                            /* may use the room that is set aside ... */
  bool is_opening;                           /* ... in small pieces, as many as one opening may */
  int status;
  bool finished;
  size_t first_event; /* of this operation in the batch's events */
  pthread_cond_t released;
  struct mo_operation *next;
};

struct mo_store {
  char *path, *database_path, *controllers_path, *trainings_path, *campaigns_path, *reserve_path,
      *vfs;
  const struct mo_file_operations *files;
  int lock_fd;
  int64_t epoch;
  uint64_t events_kept;
  int64_t idempotency_keep_us;
  void (*fatal)(void *context, const char *what);
  void *fatal_context;
  char repairs[256]; /* what the opening has put right */

  /* Readers. */
  pthread_mutex_t readers_mutex;
  pthread_cond_t reader_free;
  struct mo_connection *readers;
  uint32_t n_readers;
  pthread_mutex_t runner_mutex;
  struct mo_connection runner; /* the scheduler's */

  /* The writer. Below the mutex: touched by the writer's thread alone. */
  struct mo_connection writer;
  pthread_t thread;
  bool thread_started;
  pthread_mutex_t mutex;
  pthread_cond_t work;
  struct mo_operation *first, *last;
  bool closing;
  struct mo_event *events; /* made in this batch */
  size_t n_events, events_capacity;
  uint64_t events_since_prune;
  int64_t last_prune_us, last_probe_us, last_restart_us, reserve_us;
  int wal_frames, checkpoint_frames, pieces_cut;
  bool reserve_whole;

  pthread_mutex_t checkpoints_mutex; /* files of trainings and campaigns with their rows; taken
                                        before anything is written */
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
  atomic_bool is_short; /* some of the room that was set aside is in use: what is not urgent changes
                           nothing */
  atomic_uint file_counter;
};

/* Runs `run` on the writer's thread and waits for its commit. */
int mo_write(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
             void *arguments);
/* The same for what people need on a full disk: it may use the room that is set aside. Small, and
 * nothing that jobs do or try again by themselves. */
int mo_write_urgent(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                    void *arguments);
/* The same for what every start writes. */
int mo_write_opening(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                     void *arguments);
/* Like mo_write without waiting; `done` frees what is to be freed. */
int mo_write_later(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                   void *arguments, void (*done)(void *arguments, int status));
/* From any thread: what was acknowledged may not be on the disk. */
void mo_store_declare_fatal(struct mo_store *store, const char *what);
int mo_writer_start(struct mo_store *store);
void mo_writer_stop(struct mo_store *store);
/* Inside an operation: adds an event. `data`: a JSON object. */
int mo_writer_event(struct mo_store *store, int64_t job, const char *type, const char *data);

/* ---- reading ---- */

struct mo_connection *mo_reader_acquire(struct mo_store *store); /* waits for a free one */
void mo_reader_release(struct mo_store *store, struct mo_connection *connection);

/* ---- room set aside ---- */

/* Of the writer's thread alone, and of the opening before that starts. */
/* If it is not whole, every few seconds at most. No room for that: the store is short of it. */
void mo_reserve_make(struct mo_store *store);
/* true: there is some room now, and the store is short of it. */
bool mo_reserve_cut(struct mo_store *store);
/* The same for what an opening writes; false, too, when it has had its part, or no more is left
 * than is kept for people. */
bool mo_reserve_cut_piece(struct mo_store *store);

/* ---- shared queries ---- */

/* What replies can say: times before the year 10000, ids of 18 digits. */
#define MO_TIME_US_MAX INT64_C(253402300799999999)
#define MO_ID_MAX      INT64_C(999999999999999999)

/* Of a job's row, what each change counts: a damaged number, which one more might not fit, begins
 * anew, so that nothing keeps the job from being run, ended or cancelled. */
#define MO_NEXT_VERSION "version=iif(version BETWEEN 1 AND 999999999999999998,version+1,1)"
#define MO_NEXT_ATTEMPT "(min(max(attempts,0),4294967294)+1)"

/* A column with the text of a JSON object, which goes into replies as it is: if it is none, one
 * that says so in its place. */
#define MO_JSON_COLUMN(table, column)                                                              \
  "CASE WHEN json_valid(" column ") IS NOT 1 THEN json_object('unreadable','" table "." column     \
  " is not JSON')"                                                                                 \
  " WHEN json_type(" column ")<>'object' THEN json_object('unreadable','" table "." column         \
  " is no object')"                                                                                \
  " ELSE " column " END"

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
/* MO_ERR_CORRUPT: job->damage tells. */
int mo_job_from_row(sqlite3_stmt *statement, struct mo_job *job);
/* Notes what of a job's rows cannot be read; returns MO_ERR_CORRUPT. */
int mo_job_damaged(struct mo_job *job, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
/* The same of a BLOB that cannot be decoded. */
int mo_job_undecodable(struct mo_job *job, const char *column_name, sqlite3_stmt *row, int column);
/* What replies can say of a column: numbers from least to most, and names, or none. Else
 * MO_ERR_CORRUPT, noted. */
struct mo_column_range {
  int column;
  const char *name;
  int64_t least, most;
};
int mo_job_ranges(struct mo_job *job, sqlite3_stmt *row, const struct mo_column_range *ranges,
                  size_t n);
int mo_job_name(struct mo_job *job, sqlite3_stmt *row, int column, const char *name);
/* Whether a list may go on behind this error: it is of this job alone. */
bool mo_job_passed_over(int error, const struct mo_job *job);
/* MO_ERR_CORRUPT: the state cannot be read. A kind that cannot be read is MO_JOB_KINDS. */
int mo_job_state_get(struct mo_connection *connection, int64_t id, enum mo_job_state *state,
                     enum mo_job_kind *kind); /* MO_ERR_NOT_FOUND */

/* A design and one of its orientations, by content: found, or made. */
int mo_genotype_row(struct mo_connection *writer, const struct mo_bits *form,
                    const struct mo_bits *genotype, int64_t now_us, int64_t *row);
/* The designs of a job, in order. sql: inserts (?1 job, ?2 position, ?3 genotype's row). */
int mo_designs_insert(struct mo_connection *writer, const char *sql, int64_t id,
                      const struct mo_bits *forms, const struct mo_bits *genotypes, uint32_t n,
                      int64_t now_us);
/* What submissions name or give: found, or made. */
int mo_job_insert(struct mo_connection *writer, enum mo_job_kind kind, enum mo_urgency priority,
                  enum mo_back_end back_end, double weight, const char *label, int64_t now_us,
                  int64_t *id);
/* Environments of a job: those of a set (copy_sql: ?1 job, ?2 set), or without one (0) these (sql:
 * ?1 job, ?2 position, ?3 environment). */
int mo_environments_insert(struct mo_connection *writer, const char *copy_sql, const char *sql,
                           int64_t id, int64_t set, const struct mo_environment *environments,
                           uint32_t n);
int mo_environment_row(struct mo_connection *writer, const struct mo_environment *environment,
                       int64_t *row);
int mo_physics_row(struct mo_connection *writer, const struct mo_physics *physics,
                   enum mo_precision precision, enum mo_sensor sensor, int64_t *row);
/* A named set and its size. MO_ERR_NOT_FOUND. */
int mo_environment_set_find(struct mo_connection *connection, const char *name, int64_t *row,
                            int64_t *n);
/* Rollouts' rows, unless they are there, and how many were not; and the mean over a named set,
 * unless it is incomplete or there. */
int mo_scores_insert(struct mo_connection *writer, const struct mo_saved_score *scores, size_t n,
                     int64_t now_us, uint32_t *n_new);
int mo_set_score_insert(struct mo_connection *writer, const struct mo_saved_design *design);
/* The same when all losses of the set were new, so that their mean is known. */
int mo_set_score_insert_mean(struct mo_connection *writer, const struct mo_saved_design *design,
                             double mean);
/* The job of a key. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: of another body. */
int mo_key_find(struct mo_connection *connection, const char *key, const struct mo_sha256 *body,
                int64_t *id);
int mo_key_insert(struct mo_connection *writer, const char *key, const struct mo_sha256 *body,
                  int64_t now_us, int64_t id);
/* With ?state and ?waiting (mo_bind_waiting): the jobs j that are shown in this state. */
#define MO_JOB_SHOWN_IN(state, waiting)                                                            \
  "((j.state=" state " AND (" state "<>1 OR j.id NOT IN (SELECT value FROM json_each(" waiting     \
  "))))"                                                                                           \
  " OR (" state "=2 AND j.state=1 AND j.id IN (SELECT value FROM json_each(" waiting "))))"
/* Whether the query needs that: the plain state needs no sorting. */
bool mo_job_query_waits(const struct mo_job_query *query);
int mo_bind_waiting(sqlite3_stmt *statement, int index,
                    const struct mo_job_query *query); /* MO_ERR_LIMIT */
/* A page of jobs of one kind, read in one transaction: `sql` gives their ids for ?1 the id that
 * they are below, ?2 the state, ?3 the limit, ?4 the group and, where mo_job_query_waits, ?5 those
 * that wait; `load` reads each into its place, which begins with a struct mo_job. One that cannot
 * be read does not end the page (mo_job_passed_over). */
int64_t mo_read_jobs(struct mo_store *store, const char *sql, const struct mo_job_query *query,
                     int64_t group, size_t limit,
                     int (*load)(struct mo_connection *reader, int64_t id, void *status),
                     void *statuses, size_t status_size);
/* The row of a fingerprint: found, or made. */
int mo_fingerprint_row(struct mo_connection *writer, const char *text, int64_t *id);
int mo_training_code_load(struct mo_connection *connection, int64_t id,
                          struct mo_training_lineage *lineage);
/* runs.c: of jobs that a thread of their own runs. Inside an operation: */
/* A new version of one that takes writes still. MO_ERR_CONFLICT: it is over, or somebody else's. */
int mo_run_touch(struct mo_store *store, int64_t id, enum mo_job_kind kind);
/* An event of a job's state; more: further members of the object, each with its comma. */
int mo_run_announce(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *type,
                    enum mo_job_state state, const char *more);
/* MO_ERR_CONFLICT when the statement changed nothing. */
int mo_run_changed(struct mo_connection *writer, sqlite3_stmt *statement);
/* Of their own: what mo_store_queued_trainings, mo_store_training_start and _park are, for any such
 * kind. Parked with MO_ERR_DEVICE it is paused, which is no attempt. */
int64_t mo_run_queued(struct mo_store *store, enum mo_job_kind kind, int64_t *ids, size_t limit);
int mo_run_start(struct mo_store *store, int64_t id, enum mo_job_kind kind);
int mo_run_park(struct mo_store *store, int64_t id, enum mo_job_kind kind, int error,
                const char *error_text, uint32_t max_attempts, enum mo_job_state *after);
/* The sensor of a controller. MO_ERR_UNSUPPORTED: it is not of the default workspace. */
int mo_controller_sensor(struct mo_connection *connection, int64_t row, enum mo_sensor *sensor);

/* A file of weights, then its row and name: begin, on any thread; row, in an operation; end always.
 */
struct mo_controller_put {
  const char *name;
  const struct mo_controller *controller;
  char *metadata;
  struct mo_sha256 sha256;
  size_t size;
  struct mo_controller_record record;
  bool created;
  int64_t row; /* result */
};
int mo_controller_put_begin(struct mo_store *store, const char *name, const uint8_t *bytes,
                            size_t size, const struct mo_controller *controller,
                            struct mo_controller_put *call);
int mo_controller_put_row(struct mo_store *store, struct mo_controller_put *call);
void mo_controller_put_end(struct mo_controller_put *call);

/* ---- files ---- */

/* The bytes of a file (malloc). MO_ERR_NOT_FOUND; MO_ERR_CORRUPT: of another size; MO_ERR_IO;
 * MO_ERR_NO_MEMORY: or no file can be opened now. */
int mo_file_read(const char *path, size_t size, uint8_t **bytes);
/* The same of a file that a row speaks of: MO_ERR_CORRUPT also when it is not there, or its bytes
 * have another hash. */
int mo_file_read_checked(const char *path, size_t size, const struct mo_sha256 *sha256,
                         uint8_t **bytes);
/* Atomic and durable: `path` is in `folder`. MO_ERR_NO_SPACE: nothing was changed. */
int mo_file_write(struct mo_store *store, const char *folder, const char *path,
                  const uint8_t *bytes, size_t size);
int mo_folder_sync(struct mo_store *store, const char *path); /* MO_ERR_IO is fatal to the store */
/* The folder is there and its name is durable, whoever made it. */
int mo_folder_make(struct mo_store *store, const char *parent, const char *path);
/* Removes what interrupted writes left, and the files that are not to be kept (keep NULL: all are).
 */
int mo_folder_clean(const struct mo_store *store, const char *path,
                    bool (*keep)(void *context, const char *name), void *context);
/* A file or folder. MO_ERR_NO_MEMORY: it cannot be opened now; MO_ERR_IO. */
int mo_path_sync(const struct mo_store *store, const char *path, bool is_folder);
/* Removes files of trainings and campaigns of which no row speaks. Before the writer starts. */
int mo_trainings_clean(struct mo_store *store);
int mo_campaigns_clean(struct mo_store *store);
/* Cleans the folders <path>/<job>, and removes those that are empty then. has_row gets the
 * cleaning; it may set its error. */
struct mo_cleaning {
  struct mo_connection *connection;
  int64_t job;
  int error;
};
int mo_job_folders_clean(const struct mo_store *store, const char *path,
                         bool (*has_row)(void *cleaning, const char *name),
                         struct mo_cleaning *cleaning);

/* Row of a controller by name or "sha256:…". MO_ERR_NOT_FOUND. */
int mo_controller_find(struct mo_connection *connection, const char *name, int64_t *row);
/* Makes the paper's test set, or puts it right, and notes in store->repairs what was damaged. When
 * the writer has started. */
int mo_put_paper_test_right(struct mo_store *store);
int64_t mo_monotonic_us(void);

#endif
