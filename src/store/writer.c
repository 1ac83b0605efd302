/* writer.c: the one thread that changes the database.
 *
 * Operations wait in a list. The writer takes a batch, runs each operation in a savepoint of one
 * transaction, commits once, and then releases the callers, so that under load one fsync serves
 * many operations. If an operation fails, only its own changes are rolled back. When SQLite rolls
 * back the whole transaction (disk full, out of memory), or the commit fails for lack of space,
 * each operation runs again in its own transaction, so that an operation that is too large does not
 * make the others fail. An urgent operation may use the reserve (reserve.c).
 *
 * Any other I/O error is fatal at once. After a failed fsync the content of the disk is unknown,
 * and a second fsync may succeed without having written. Therefore, nothing is retried: the process
 * must exit, and the next one recovers from the log. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/internal.h"

#include "base/clock.h"
#include "base/thread.h"

#define BATCH_MAX       256
#define PRUNE_EVERY     1000 /* events */
#define PRUNE_EVERY_US  INT64_C(60000000)
#define PRUNE_ROWS      "5000"
#define SPACE_PROBE_US  INT64_C(1000000)
#define RESTART_US      INT64_C(5000000)
#define RESTART_WAIT_MS 250

/* Writes the usage of a running job together with each of its events. */
static int meter(struct mo_store *store, int64_t job)
{
  static const char sql[] = "UPDATE jobs SET worker_s=?2,device_s=?3 WHERE id=?1";
  double worker_s, device_s;
  pthread_mutex_lock(&store->listeners_mutex);
  const bool runs =
      store->used != NULL && store->used(store->used_context, job, &worker_s, &device_s);
  pthread_mutex_unlock(&store->listeners_mutex);
  return runs ? mo_sql_do(&store->writer, sql, mo_int(job), mo_real(worker_s), mo_real(device_s))
              : MO_OK;
}

int mo_writer_event(struct mo_store *store, int64_t job, const char *type, const char *format, ...)
{
  static const char sql[] = "INSERT INTO events(time_us,job,type,data) VALUES(?1,?2,?3,?4)";
  struct mo_connection *writer = &store->writer;
  if (store->n_events == store->events_capacity) {
    size_t capacity = store->events_capacity > 0 ? store->events_capacity * 2 : 64;
    struct mo_event *events = realloc(store->events, capacity * sizeof(*events));
    if (events == NULL)
      return MO_ERR_NO_MEMORY;
    store->events = events;
    store->events_capacity = capacity;
  }
  struct mo_event *event = &store->events[store->n_events];
  memset(event, 0, sizeof(*event));
  va_list arguments;
  va_start(arguments, format);
  const int size = vsnprintf(event->data, sizeof(event->data), format, arguments);
  va_end(arguments);
  if (strlen(type) >= sizeof(event->type) || (size_t)size >= sizeof(event->data))
    return MO_ERR_LIMIT;
  memcpy(event->type, type, strlen(type) + 1);
  event->time_us = mo_clock_wall_us();
  event->job = job;
  int error = mo_sql_insert(writer, &event->sequence, sql, mo_int(event->time_us), mo_int(job),
                            mo_string(event->type), mo_string(event->data));
  store->n_events += error == MO_OK;
  return error == MO_OK && job > 0 ? meter(store, job) : error;
}

void mo_store_declare_fatal(struct mo_store *store, const char *what)
{
  if (!atomic_exchange(&store->is_fatal, true) && store->fatal != NULL)
    store->fatal(store->fatal_context, what);
}

/* Prepared when the writer starts, because ending a transaction must not depend on free memory. */
static const char begin_sql[] = "BEGIN IMMEDIATE";
static const char commit_sql[] = "COMMIT";
static const char rollback_sql[] = "ROLLBACK";
static const char savepoint_sql[] = "SAVEPOINT operation";
static const char rollback_to_sql[] = "ROLLBACK TO operation";
static const char release_sql[] = "RELEASE operation";

static int prepare_transactions(struct mo_store *store)
{
  static const char *const sql[] = {begin_sql,     commit_sql,      rollback_sql,
                                    savepoint_sql, rollback_to_sql, release_sql};
  int error = MO_OK;
  for (size_t i = 0; i < sizeof(sql) / sizeof(sql[0]); i++)
    (void)mo_sql_rows(&store->writer, &error, sql[i]);
  return error;
}

/* Runs an operation in the open transaction. While the store is short of space, an operation that
 * is not urgent succeeds only if it changes nothing. On an error the caller rolls back. */
static int run_operation(struct mo_store *store, struct mo_operation *operation)
{
  const sqlite3_int64 before = sqlite3_total_changes64(store->writer.db);
  const int error = operation->run(store, operation->arguments);
  const bool is_refused = !operation->is_urgent && atomic_load(&store->is_short);
  mo_sql_reset(&store->writer);
  return error == MO_OK && is_refused && sqlite3_total_changes64(store->writer.db) != before
             ? MO_ERR_NO_SPACE
             : error;
}

/* Runs one operation in the open transaction. After an error the transaction no longer exists or
 * must be rolled back. */
static int run_in_savepoint(struct mo_store *store, struct mo_operation *operation)
{
  struct mo_connection *writer = &store->writer;
  const size_t first_event = store->n_events;
  int error = mo_sql_do(&store->writer, savepoint_sql);
  if (error != MO_OK)
    return error; /* no savepoint to roll back to */
  operation->status = run_operation(store, operation);
  if (sqlite3_get_autocommit(writer->db) || operation->status == MO_ERR_IO)
    return operation->status != MO_OK ? operation->status : MO_ERR_IO;
  if (operation->status != MO_OK) {
    store->n_events = first_event;
    error = mo_sql_do(&store->writer, rollback_to_sql);
  }
  return error == MO_OK ? mo_sql_do(&store->writer, release_sql) : error;
}

static int commit(struct mo_store *store)
{
  int64_t start = mo_clock_us();
  int error = mo_sql_do(&store->writer, commit_sql);
  if (error == MO_OK) {
    atomic_fetch_add(&store->commits, 1);
    atomic_fetch_add(&store->commit_ns, (uint64_t)(mo_clock_us() - start) * 1000);
  }
  return error;
}

/* Rolls back after an error, and declares the store fatal after a fatal error. */
static void abandon(struct mo_store *store, int error)
{
  if (error == MO_OK)
    return;
  if (error == MO_ERR_IO)
    mo_store_declare_fatal(store, sqlite3_errmsg(store->writer.db));
  if (!sqlite3_get_autocommit(store->writer.db))
    (void)mo_sql_do(&store->writer, rollback_sql);
  store->n_events = 0;
}

static int run_alone(struct mo_store *store, struct mo_operation *operation)
{
  if (atomic_load(&store->is_fatal))
    return MO_ERR_IO;
  int error = mo_sql_do(&store->writer, begin_sql);
  if (error == MO_OK)
    error = run_operation(store, operation);
  if (error == MO_OK)
    error = sqlite3_get_autocommit(store->writer.db) ? MO_ERR_IO : commit(store);
  return error;
}

static void notify_listeners(struct mo_store *store)
{
  if (store->n_events == 0)
    return;
  pthread_mutex_lock(&store->listeners_mutex);
  for (unsigned i = 0; i < store->n_listeners; i++)
    store->listeners[i].call(store->listeners[i].context, store->events, store->n_events);
  pthread_mutex_unlock(&store->listeners_mutex);
  store->events_since_prune += store->n_events;
  store->n_events = 0;
}

static void release(struct mo_store *store, struct mo_operation *operation)
{
  atomic_fetch_add(&store->operations, 1);
  atomic_fetch_sub(&store->queued, 1);
  if (operation->status == MO_ERR_NO_SPACE)
    atomic_store(&store->no_space, true);
  else if (operation->status == MO_OK && !atomic_load(&store->is_short))
    atomic_store(&store->no_space, false);
  if (operation->status != MO_OK)
    atomic_fetch_add(&store->operations_failed, 1);
  if (operation->done != NULL) {
    operation->done(operation->arguments, operation->status);
    free(operation);
    return;
  }
  MO_GUARD(&store->mutex);
  operation->finished = true;
  pthread_cond_signal(&operation->released);
}

/* Runs all operations in one transaction. */
static int run_together(struct mo_store *store, struct mo_operation *first)
{
  int error = atomic_load(&store->is_fatal) ? MO_ERR_IO : mo_sql_do(&store->writer, begin_sql);
  for (struct mo_operation *operation = first; operation != NULL && error == MO_OK;
       operation = operation->next)
    error = run_in_savepoint(store, operation);
  return error == MO_OK ? commit(store) : error;
}

/* Runs one operation in its own transaction. */
static void finish_alone(struct mo_store *store, struct mo_operation *operation)
{
  operation->status = run_alone(store, operation);
  abandon(store, operation->status);
  notify_listeners(store);
}

/* Runs a batch. A single operation needs no savepoint, which would copy every page that a large one
 * changes. While the store is short of space, each operation runs in its own transaction, because a
 * commit also writes pages that a rolled-back operation has changed. */
static void run_batch(struct mo_store *store, struct mo_operation *first)
{
  struct mo_operation *operation, *next;
  int error = MO_OK;
  store->n_events = 0;
  if (atomic_load(&store->is_short))
    mo_reserve_make(store);
  bool each_alone = first->next == NULL || atomic_load(&store->is_short);
  if (!each_alone)
    error = run_together(store, first);
  abandon(store, error); /* if it is fatal, run_alone() rejects everything from now on */
  if (each_alone || error != MO_OK)
    for (operation = first; operation != NULL; operation = operation->next)
      finish_alone(store, operation);
  notify_listeners(store);
  for (operation = first; operation != NULL; operation = next) {
    next = operation->next;
    if (operation->is_urgent && operation->status == MO_ERR_NO_SPACE && mo_reserve_free(store))
      finish_alone(store, operation);
    release(store, operation);
  }
}

/* Deletes old events and idempotency keys, a bounded number of rows at once. Events are counted:
 * their numbers jump after a crash. After a failure, the next round retries. */
static void prune(struct mo_store *store)
{
  static const char events_sql[] =
      "DELETE FROM events WHERE sequence IN (SELECT sequence FROM events ORDER BY sequence"
      " LIMIT max(0,min(" PRUNE_ROWS ",(SELECT count(*) FROM events)-?1)))";
  static const char keys_sql[] =
      "DELETE FROM idempotency_keys WHERE key IN (SELECT key FROM idempotency_keys WHERE "
      "created_us < ?1 ORDER BY created_us LIMIT " PRUNE_ROWS ")";
  struct mo_connection *writer = &store->writer;
  int error = mo_sql_do(writer, begin_sql);
  store->last_prune_us = mo_clock_us();
  store->events_since_prune = 0;
  if (error == MO_OK)
    error = mo_sql_do(writer, events_sql, mo_int((int64_t)store->events_kept));
  if (error == MO_OK && sqlite3_changes(writer->db) > 0)
    store->events_since_prune = PRUNE_EVERY; /* there may be more old rows: prune again soon */
  if (error == MO_OK)
    error = mo_sql_do(writer, keys_sql, mo_int(mo_clock_wall_us() - store->idempotency_keep_us));
  if (error == MO_OK)
    error = commit(store);
  if (error != MO_OK)
    store->events_since_prune = 0;
  abandon(store, error);
}

/* Probes for free space periodically, so that /readyz recovers without a client's write. */
static void probe_space(struct mo_store *store)
{
  int64_t now = mo_clock_us();
  if (!atomic_load(&store->no_space) || atomic_load(&store->is_short) ||
      now - store->last_probe_us < SPACE_PROBE_US)
    return;
  store->last_probe_us = now;
  int error = mo_sql_exec(&store->writer, "INSERT INTO meta(key,value) VALUES('space probes',1)"
                                          " ON CONFLICT(key) DO UPDATE SET value=value+1");
  if (error == MO_OK)
    atomic_store(&store->no_space, false);
  abandon(store, error);
}

/* Copies the log into the database. The log restarts only when no connection reads it, and
 * overlapping readers can prevent that indefinitely. So if the log is long, this waits briefly for
 * the current readers; new readers use the database. */
static void checkpoint(struct mo_store *store)
{
  sqlite3 *db = store->writer.db;
  int64_t now = mo_clock_us();
  int mode = SQLITE_CHECKPOINT_PASSIVE;
  if (store->wal_frames >= MO_WAL_LONG * store->checkpoint_frames &&
      now - store->last_restart_us >= RESTART_US) {
    store->last_restart_us = now;
    mode = SQLITE_CHECKPOINT_RESTART;
    sqlite3_busy_timeout(db, RESTART_WAIT_MS);
  }
  int result = sqlite3_wal_checkpoint_v2(db, NULL, mode, NULL, NULL);
  abandon(store, mo_sql_error(db, result));
  sqlite3_busy_timeout(db, MO_BUSY_MS);
  store->wal_frames = 0; /* the hook counts again at the next commit */
}

static void maintain(struct mo_store *store)
{
  static const char pages_sql[] = "PRAGMA page_count";
  int64_t pages;
  if (atomic_load(&store->is_fatal))
    return;
  if (atomic_load(&store->is_short) || !atomic_load(&store->no_space))
    mo_reserve_make(store);
  probe_space(store);
  if (!atomic_load(&store->is_short)) {
    if (store->events_since_prune >= PRUNE_EVERY ||
        mo_clock_us() - store->last_prune_us >= PRUNE_EVERY_US)
      prune(store);
    if (store->wal_frames >= store->checkpoint_frames)
      checkpoint(store);
    if (store->upkeep != NULL)
      store->upkeep(store);
  }
  if (mo_sql_find(&store->writer, &pages, pages_sql) == MO_OK)
    atomic_store(&store->database_bytes, pages * 4096);
}

static int count_frames(void *context, sqlite3 *db, const char *name, int frames)
{
  struct mo_store *store = context;
  (void)db;
  (void)name;
  store->wal_frames = frames;
  atomic_store(&store->wal_bytes, (int64_t)frames * (4096 + 24));
  return SQLITE_OK;
}

/* Waits for operations, at most a second, and takes up to BATCH_MAX of them. Returns NULL with
 * *closing set when the store closes. */
static struct mo_operation *take(struct mo_store *store, bool *closing)
{
  struct mo_operation *first, *last;
  const int64_t until_us = mo_clock_us() + 1000000;
  MO_GUARD(&store->mutex);
  while (store->first == NULL && !store->closing &&
         mo_wait_until(&store->work, &store->mutex, until_us))
    ;
  first = last = store->first;
  if (first != NULL) {
    for (unsigned n = 1; n < BATCH_MAX && last->next != NULL; n++)
      last = last->next;
    store->first = last->next;
    if (store->first == NULL)
      store->last = NULL;
    last->next = NULL;
  }
  *closing = store->closing && first == NULL;
  return first;
}

static void *write_loop(void *context)
{
  struct mo_store *store = context;
  bool closing = false;
  for (;;) {
    struct mo_operation *first = take(store, &closing);
    if (closing)
      break;
    if (first != NULL)
      run_batch(store, first);
    maintain(store);
    atomic_store(&store->heartbeat_us, mo_clock_us());
  }
  return NULL;
}

int mo_writer_start(struct mo_store *store)
{
  int error = prepare_transactions(store);
  if (error != MO_OK)
    return error;
  sqlite3_wal_hook(store->writer.db, count_frames, store);
  store->last_prune_us = mo_clock_us();
  store->last_restart_us = store->last_prune_us - RESTART_US;
  atomic_store(&store->heartbeat_us, mo_clock_us());
  if (pthread_create(&store->thread, NULL, write_loop, store) != 0)
    return MO_ERR_NO_MEMORY;
  store->thread_started = true;
  return MO_OK;
}

void mo_writer_stop(struct mo_store *store)
{
  if (!store->thread_started)
    return;
  pthread_mutex_lock(&store->mutex);
  store->closing = true;
  pthread_cond_signal(&store->work);
  pthread_mutex_unlock(&store->mutex);
  pthread_join(store->thread, NULL);
  store->thread_started = false;
}

static int enqueue(struct mo_store *store, struct mo_operation *operation)
{
  if (atomic_load(&store->is_fatal))
    return MO_ERR_IO;
  MO_GUARD(&store->mutex);
  if (store->closing)
    return MO_ERR_CANCELLED;
  operation->next = NULL;
  if (store->last != NULL)
    store->last->next = operation;
  else
    store->first = operation;
  store->last = operation;
  atomic_fetch_add(&store->queued, 1);
  pthread_cond_signal(&store->work);
  if (operation->done == NULL)
    while (!operation->finished)
      pthread_cond_wait(&operation->released, &store->mutex);
  return MO_OK;
}

static int write_and_wait(struct mo_store *store,
                          int (*run)(struct mo_store *store, void *arguments), void *arguments,
                          bool is_urgent)
{
  struct mo_operation operation = {.run = run,
                                   .arguments = arguments,
                                   .is_urgent = is_urgent,
                                   .released = PTHREAD_COND_INITIALIZER};
  const int error = enqueue(store, &operation);
  return error != MO_OK ? error : operation.status;
}

int mo_write(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
             void *arguments)
{
  return write_and_wait(store, run, arguments, false);
}

int mo_write_urgent(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                    void *arguments)
{
  return write_and_wait(store, run, arguments, true);
}

int mo_write_later(struct mo_store *store, int (*run)(struct mo_store *store, void *arguments),
                   void *arguments, void (*done)(void *arguments, int status))
{
  struct mo_operation *operation = malloc(sizeof(*operation));
  if (operation == NULL)
    return MO_ERR_NO_MEMORY;
  *operation = (struct mo_operation){.run = run, .arguments = arguments, .done = done};
  int error = enqueue(store, operation);
  if (error != MO_OK)
    free(operation);
  return error;
}

int mo_store_subscribe(struct mo_store *store, mo_store_listener listener, void *context,
                       int *ret_handle)
{
  MO_GUARD(&store->listeners_mutex);
  if (store->n_listeners == MO_LISTENERS_MAX)
    return MO_ERR_LIMIT;
  store->listeners[store->n_listeners].handle = ++store->next_handle;
  store->listeners[store->n_listeners].call = listener;
  store->listeners[store->n_listeners].context = context;
  store->n_listeners++;
  *ret_handle = store->next_handle;
  return MO_OK;
}

void mo_store_unsubscribe(struct mo_store *store, int handle)
{
  MO_GUARD(&store->listeners_mutex);
  for (unsigned i = 0; i < store->n_listeners; i++)
    if (store->listeners[i].handle == handle) {
      for (unsigned k = i + 1; k < store->n_listeners; k++)
        store->listeners[k - 1] = store->listeners[k];
      store->n_listeners--;
      break;
    }
}

void mo_store_get_stats(struct mo_store *store, struct mo_store_stats *stats)
{
  *stats = (struct mo_store_stats){
      .commits = atomic_load(&store->commits),
      .operations = atomic_load(&store->operations),
      .operations_failed = atomic_load(&store->operations_failed),
      .queued = atomic_load(&store->queued),
      .commit_s = (double)atomic_load(&store->commit_ns) * 1e-9,
      .database_bytes = atomic_load(&store->database_bytes),
      .wal_bytes = atomic_load(&store->wal_bytes),
      .recorded_bytes = atomic_load(&store->recorded_bytes),
      .recordings_removed = atomic_load(&store->recordings_removed),
      .recordings_removed_bytes = atomic_load(&store->recordings_removed_bytes),
      .jobs_expired = atomic_load(&store->jobs_expired),
      .clock_ahead_us = atomic_load(&store->clock_ahead_us),
      .heartbeat_us = atomic_load(&store->heartbeat_us),
      .no_space = atomic_load(&store->no_space),
      .fatal = atomic_load(&store->is_fatal),
  };
}
