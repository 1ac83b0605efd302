/* open.c: opens and closes a state folder, and brings its schema up to date.
 *
 * Opening proceeds in this order: folder and its lock (folder.c), database, application id and
 * version, quick_check after an unclean stop, schema, epoch, readers, reserve, writer. Only SQLite
 * opens the database file: closing it elsewhere would drop SQLite's locks. On a full disk, opening
 * uses the reserve. */
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/utsname.h>
#include <unistd.h>

#include "base/clock.h"
#include "schema.h"
#include "store/atlas_rows.h"
#include "store/contents.h"
#include "store/folder.h"
#include "store/rows.h"

/* The version of schema.sql, and the newest version. Versions up to LAST_OF_0_1 belong to morphod
 * 0.1, and the versions in between to unreleased programs. */
#define LAST_OF_0_1   8
#define FIRST_SCHEMA  14
#define NEWEST_SCHEMA (FIRST_SCHEMA + schema_count - 1)

static char *join(const char *folder, const char *name)
{
  char *path;
  return asprintf(&path, "%s/%s", folder, name) >= 0 ? path : NULL;
}

static int prepare_folders(struct mo_store *store, struct mo_message *message)
{
  const char *const paths[] = {store->controllers_path, store->trainings_path,
                               store->campaigns_path, store->atlases_path};
  for (size_t i = 0; i < sizeof(paths) / sizeof(paths[0]); i++) {
    const int error = mo_folder_make(store, store->path, paths[i]);
    if (error != MO_OK)
      return mo_fail(message, error, "cannot create %s: %s", paths[i], strerrordesc_np(errno));
  }
  return MO_OK;
}

static off_t size_of(const struct mo_store *store, const char *ending)
{
  char path[PATH_MAX];
  struct stat status;
  snprintf(path, sizeof(path), "%s%s", store->database_path, ending);
  return lstat(path, &status) == 0 ? status.st_size : 0;
}

static int refuse_without_database(const struct mo_store *store, struct mo_message *message)
{
  const bool has_files = store->orphans.n > 0;
  return mo_fail(
      message, MO_ERR_CONFLICT,
      "the state folder has lost its database: morphod.db is missing or empty, although there are "
      "data files such as %.48s; mount or restore it, or move them away to start with an empty "
      "one: %s",
      has_files ? store->orphans.first : "morphod.db-wal", store->path);
}

/* Before anything is created or removed, checks that the database is not missing. A first start
 * that was killed leaves no other files, because the database is created first. SQLite writes the
 * log after the database's first page, and deletes a log without a database. */
static int check_for_database(struct mo_store *store, struct mo_message *message)
{
  const bool is_there = size_of(store, "") > 1;
  int error = mo_files_sort_out(store, NULL, is_there);
  if (error != MO_OK)
    return mo_fail(message, error, "cannot list %s: %s", store->path, mo_error_text(error));
  if (!is_there && (store->orphans.n > 0 || size_of(store, "-wal") > 0))
    return refuse_without_database(store, message);
  if (!is_there && store->must_exist)
    return mo_fail(message, MO_ERR_NOT_FOUND, "the state folder %s has no database", store->path);
  return MO_OK;
}

/* If a check cannot load a page, because memory is short or a read failed, it reports this in the
 * same way as damage: in a row that ends with SQLite's error code. */
static int finding_error(struct mo_connection *connection, const char *text)
{
  static const char mark[] = "error code=";
  const char *found = strstr(text, mark);
  long code = found != NULL ? strtol(found + sizeof(mark) - 1, NULL, 10) : SQLITE_CORRUPT;
  return mo_sql_error(connection->db, code > 0 && code < INT_MAX ? (int)code : SQLITE_CORRUPT);
}

/* Reads the text in the first row; leaves it unchanged if there are no rows. */
static int read_text(struct mo_connection *connection, const char *sql, char *text, size_t size)
{
  sqlite3_stmt *row;
  const int error = mo_sql_row(connection, &row, sql);
  if (error == MO_OK)
    mo_column_text(row, 0, text, size);
  mo_sql_reset(connection);
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

/* Runs a check that answers "ok" in one row. */
static int run_check(struct mo_connection *connection, const char *sql, struct mo_message *message)
{
  char text[160] = "ok";
  int error = read_text(connection, sql, text, sizeof(text));
  if (error == MO_OK && strcmp(text, "ok") != 0)
    error = finding_error(connection, text);
  if (error == MO_OK)
    return MO_OK;
  return error == MO_ERR_CORRUPT && strcmp(text, "ok") != 0
             ? mo_fail(message, error, "the database is damaged: %s", text)
             : mo_fail(message, error, "the database cannot be read: %s", mo_error_text(error));
}

/* Commits, or rolls back after an error. */
static int end_transaction(struct mo_connection *writer, int error)
{
  if (error == MO_OK)
    error = mo_sql_exec(writer, "COMMIT");
  if (error != MO_OK && !sqlite3_get_autocommit(writer->db))
    (void)mo_sql_exec(writer, "ROLLBACK");
  return error;
}

/* Creates a new database (from = 0), or upgrades one with an older schema. */
static int migrate(struct mo_connection *writer, int64_t from, struct mo_message *message)
{
  char sql[96];
  /* version-17.sql changes the text of a check. */
  (void)sqlite3_db_config(writer->db, SQLITE_DBCONFIG_DEFENSIVE, 0, NULL);
  int error = mo_sql_exec(writer, "BEGIN EXCLUSIVE");
  for (int64_t i = from == 0 ? 0 : from - FIRST_SCHEMA + 1; i < schema_count && error == MO_OK;
       i++) {
    error = mo_sql_exec(writer, (const char *)schema_files[i].bytes);
    if (error != MO_OK)
      mo_fail(message, error, "%s failed: %s", schema_files[i].name, sqlite3_errmsg(writer->db));
  }
  /* In the same transaction, so that the database can be opened after a kill between this commit
   * and the commit of the first opening. */
  if (error == MO_OK)
    error = from == 0 ? mo_rows_create(writer) : mo_rows_extend(writer);
  if (error == MO_OK && from == 0)
    error = mo_sql_exec(writer, "INSERT INTO meta(key,value) VALUES('epoch',0),('clean',1)");
  if (error == MO_OK) {
    snprintf(sql, sizeof(sql), "PRAGMA user_version=%d; PRAGMA application_id=%d", NEWEST_SCHEMA,
             MO_APPLICATION_ID);
    error = mo_sql_exec(writer, sql);
  }
  error = end_transaction(writer, error);
  (void)sqlite3_db_config(writer->db, SQLITE_DBCONFIG_DEFENSIVE, 1, NULL);
  return error;
}

/* Turns the write-ahead log on. If SQLite cannot use it (for example, without shared memory), it
 * returns the mode that it keeps. */
static int use_log(const struct mo_store *store, struct mo_connection *writer,
                   struct mo_message *message)
{
  char mode[16] = "";
  const int error = read_text(writer, "PRAGMA journal_mode=WAL", mode, sizeof(mode));
  if (error != MO_OK)
    return error;
  if (strcmp(mode, "wal") == 0)
    return MO_OK;
  return mo_fail(
      message, MO_ERR_UNSUPPORTED,
      "the database cannot be on the file system of %s, because SQLite's write-ahead log "
      "needs shared memory, which network file systems lack; use a local disk",
      store->path);
}

struct header {
  int64_t application, version, tables;
};

/* Opens the writer and reads the database's header. This is the first read, which rebuilds the
 * log's index. */
static int read_header(struct mo_store *store, struct header *header)
{
  struct mo_connection *writer = &store->writer;
  int error = mo_connection_open(store, true, writer);
  if (error == MO_OK)
    error = mo_sql_find(writer, &header->application, "PRAGMA application_id");
  if (error == MO_OK)
    error = mo_sql_find(writer, &header->version, "PRAGMA user_version");
  if (error == MO_OK)
    error = mo_sql_find(writer, &header->tables, "SELECT count(*) FROM sqlite_schema");
  if (error == MO_ERR_NO_SPACE)
    mo_connection_close(writer);
  return error;
}

/* Begins a new history, unless this database was closed by the last process that used this folder:
 * then the database and the file `lock`, which every opening changes, agree on the time of its last
 * change. Numbers may be assigned a second time in a new history, so identifiers for clients
 * include the history. The numbers of events skip ahead, so that numbers of lost events are not
 * reused. */
static int follow_history(struct mo_store *store, struct mo_connection *writer)
{
  static const char same_sql[] =
      "SELECT count(*)=3 FROM meta WHERE (key='clean' AND value=1) OR (key='lock_inode' AND"
      " value=?1) OR (key='lock_ns' AND value=?2)";
  static const char jump_sql[] =
      "UPDATE sqlite_sequence SET seq=seq+?1+abs(random()%?1) WHERE name='events'";
  static const char place_sql[] = "INSERT OR REPLACE INTO meta(key,value)"
                                  " VALUES('lock_inode',?1),('lock_ns',?2)";
  struct stat lock;
  int64_t is_same = 0;
#define PLACE                                                                                      \
  mo_int((int64_t)lock.st_ino),                                                                    \
      mo_int((int64_t)lock.st_ctim.tv_sec * 1000000000 + lock.st_ctim.tv_nsec)
  if (fstat(store->lock_fd, &lock) != 0)
    return MO_ERR_IO;
  int error = mo_sql_find(writer, &is_same, same_sql, PLACE);
  if (error == MO_OK && !is_same)
    error = mo_sql_do(writer, jump_sql, mo_int((int64_t)(store->events_kept / 8 + 1)));
  if (error == MO_OK && !is_same)
    error =
        mo_sql_exec(writer, "INSERT OR REPLACE INTO meta(key,value) VALUES('history',random())");
  if (error == MO_OK && (futimens(store->lock_fd, NULL) != 0 || fstat(store->lock_fd, &lock) != 0))
    error = MO_ERR_IO;
  return error == MO_OK ? mo_sql_do(writer, place_sql, PLACE) : error;
#undef PLACE
}

/* Counts the opening, and finds or inserts this host in `origins`. */
static int count_opening(struct mo_store *store, struct mo_connection *writer)
{
  struct utsname host;
  int error = mo_sql_exec(writer, "BEGIN IMMEDIATE");
  if (error == MO_OK)
    error = follow_history(store, writer);
  if (error == MO_OK)
    error = mo_sql_exec(
        writer, "INSERT INTO meta(key,value) VALUES('epoch',1)"
                " ON CONFLICT(key) DO UPDATE SET value=value+1;"
                "INSERT INTO meta(key,value) VALUES('clean',0)"
                " ON CONFLICT(key) DO UPDATE SET value=0;"
                "INSERT INTO meta(key,value) VALUES('id',random()) ON CONFLICT(key) DO NOTHING;");
  if (error == MO_OK)
    error = uname(&host) == 0 ? mo_text_row(writer, MO_ORIGINS, host.nodename, &store->origin)
                              : MO_ERR_IO;
  return end_transaction(writer, error);
}

/* Rejects a database file that ends within a page, which SQLite would fill with zeros. After a
 * kill, the log may have the complete page. */
static int check_length(const struct mo_store *store, struct mo_connection *writer,
                        struct mo_message *message)
{
  struct stat file;
  int64_t page_bytes = 0;
  int error = mo_sql_find(writer, &page_bytes, "PRAGMA page_size");
  if (error != MO_OK || stat(store->database_path, &file) != 0 || page_bytes == 0 ||
      file.st_size % page_bytes == 0)
    return error;
  (void)sqlite3_wal_checkpoint_v2(writer->db, NULL, SQLITE_CHECKPOINT_TRUNCATE, NULL, NULL);
  if (stat(store->database_path, &file) == 0 && file.st_size % page_bytes != 0)
    error = mo_fail(message, MO_ERR_CORRUPT,
                    "%s is truncated: its last page is incomplete; restore a backup",
                    store->database_path);
  return error;
}

static int prepare_database(struct mo_store *store, struct mo_message *message)
{
  struct mo_connection *writer = &store->writer;
  struct header header = {.version = 0};
  int64_t clean = 1;
  int error = read_header(store, &header);
  if (error == MO_ERR_NO_SPACE && mo_reserve_free(store))
    error = read_header(store, &header);
  if (error == MO_ERR_CORRUPT)
    return mo_fail(message, MO_ERR_FORMAT, "%s is not a morphod database, or it is damaged",
                   store->database_path);
  if (error != MO_OK)
    return mo_fail(message, error, "cannot open %s: %s", store->database_path,
                   mo_error_text(error));
  if (header.application != MO_APPLICATION_ID && (header.application != 0 || header.tables != 0))
    return mo_fail(message, MO_ERR_FORMAT, "%s is not a morphod database", store->database_path);
  if (header.version == 0 && header.tables == 0 && store->orphans.n > 0)
    return refuse_without_database(store, message);
  if (header.version == 0 && header.tables > 0)
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "%s has tables but no schema number, so another program must have changed it; "
                   "restore a backup",
                   store->database_path);
  if (header.version > NEWEST_SCHEMA || header.version < 0)
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "%s has schema %lld, but this program supports schemas up to %d; use the newer "
                   "program that wrote it",
                   store->database_path, (long long)header.version, NEWEST_SCHEMA);
  if (header.version > LAST_OF_0_1 && header.version < FIRST_SCHEMA)
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "the state folder %s has schema %lld of an unreleased program; this version "
                   "reads %d to %d; start it once with a program of schema %d, or start with an "
                   "empty folder, and store the files of %s there again",
                   store->path, (long long)header.version, FIRST_SCHEMA, NEWEST_SCHEMA,
                   FIRST_SCHEMA, store->controllers_path);
  if (header.version > 0 && header.version <= LAST_OF_0_1)
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "the state folder %s was written by morphod 0.1, which this version cannot "
                   "read; start with an empty folder, and store the files in %s there again",
                   store->path, store->controllers_path);
  error = use_log(store, writer, message);
  if (error == MO_OK && header.version > 0) {
    error = check_length(store, writer, message);
    if (error != MO_OK)
      return error;
  }
  if (error == MO_OK && header.version > 0) {
    error = mo_sql_find(writer, &clean, "SELECT value FROM meta WHERE key='clean'");
    if (error == MO_OK && !clean)
      error = run_check(writer, "PRAGMA quick_check(1)", message);
    if (error == MO_ERR_NOT_FOUND)
      error = mo_fail(message, MO_ERR_CORRUPT, "%s lacks its metadata", store->database_path);
    if (error == MO_ERR_CORRUPT)
      return error;
  }
  if (error == MO_OK && header.version < NEWEST_SCHEMA)
    error = migrate(writer, header.version, message);
  if (error == MO_OK) {
    error = count_opening(store, writer);
    if (error == MO_ERR_NO_SPACE && mo_reserve_free(store))
      error = count_opening(store, writer);
  }
  if (error == MO_OK)
    error = mo_sql_find(writer, &store->epoch, "SELECT value FROM meta WHERE key='epoch'");
  if (error == MO_OK)
    error = mo_sql_find(writer, &store->id, "SELECT value FROM meta WHERE key='id'");
  if (error == MO_OK)
    error = mo_sql_find(writer, &store->history, "SELECT value FROM meta WHERE key='history'");
  if (error != MO_OK && message != NULL && message->text[0] == '\0')
    mo_fail(message, error, "cannot prepare %s: %s", store->database_path, mo_error_text(error));
  return error;
}

static void free_store(struct mo_store *store)
{
  for (uint32_t i = 0; store->readers != NULL && i <= store->n_readers; i++)
    mo_connection_close(&store->readers[i]);
  mo_connection_close(&store->writer);
  if (store->lock_fd >= 0)
    close(store->lock_fd);
  if (store->folder_fd >= 0)
    close(store->folder_fd);
  free(store->events);
  free(store->readers);
  free(store->path);
  free(store->database_path);
  free(store->controllers_path);
  free(store->excluded_path);
  free(store->atlases_path);
  free(store->trainings_path);
  free(store->campaigns_path);
  free(store->reserve_path);
  free(store);
}

/* `path`: without links; the store takes ownership. */
static struct mo_store *create_store(const struct mo_store_config *config, char *path)
{
  struct mo_store *store = malloc(sizeof(*store));
  if (store == NULL)
    return NULL;
  mo_mapping_init();
  *store = (struct mo_store){
      .path = path,
      .database_path = join(path, "morphod.db"),
      .controllers_path = join(path, "controllers"),
      .trainings_path = join(path, "trainings"),
      .campaigns_path = join(path, "campaigns"),
      .excluded_path = join(path, "excluded"),
      .atlases_path = join(path, "atlases"),
      .reserve_path = join(path, "reserve"),
      .vfs = config->vfs,
      .files = config->files != NULL ? config->files : &mo_system_files,
      .max_recordings_bytes = config->max_recordings_bytes,
      .keep_recordings_us = config->keep_recordings_s * 1000000,
      .upkeep = mo_upkeep,
      .last_upkeep_us = mo_clock_us(),
      .must_exist = config->must_exist,
      .folder_fd = -1,
      .lock_fd = -1,
      .events_kept = config->events_kept > 0 ? config->events_kept : 100000,
      .idempotency_keep_us =
          (config->idempotency_keep_s > 0 ? config->idempotency_keep_s : 86400) * 1000000,
      .fatal = config->fatal,
      .fatal_context = config->fatal_context,
      .readers_mutex = PTHREAD_MUTEX_INITIALIZER,
      .reader_free = PTHREAD_COND_INITIALIZER,
      .n_readers = config->n_readers > 0 ? config->n_readers : 4,
      .mutex = PTHREAD_MUTEX_INITIALIZER,
      .work = PTHREAD_COND_INITIALIZER,
      .checkpoint_frames =
          config->checkpoint_frames > 0 ? (int)config->checkpoint_frames : MO_CHECKPOINT_FRAMES,
      .max_excluded_bytes = config->max_excluded_bytes,
      .excluded_mutex = PTHREAD_MUTEX_INITIALIZER,
      .checkpoints_mutex = PTHREAD_MUTEX_INITIALIZER,
      .controllers_lock = PTHREAD_RWLOCK_INITIALIZER,
      .imports_mutex = PTHREAD_MUTEX_INITIALIZER,
      .import_closed = PTHREAD_COND_INITIALIZER,
      .listeners_mutex = PTHREAD_MUTEX_INITIALIZER};
  store->readers = calloc(store->n_readers + 1, sizeof(*store->readers));
  if (store->database_path == NULL || store->controllers_path == NULL ||
      store->trainings_path == NULL || store->campaigns_path == NULL ||
      store->excluded_path == NULL || store->atlases_path == NULL || store->reserve_path == NULL ||
      store->readers == NULL) {
    free_store(store);
    return NULL;
  }
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    store->keep_jobs_us[kind] = config->keep_jobs_s[kind] * 1000000;
  return store;
}

int mo_store_open(const struct mo_store_config *config, struct mo_store **ret,
                  struct mo_message *message)
{
  char *path = NULL;
  if (config->path == NULL || config->path[0] == '\0')
    return mo_fail(message, MO_ERR_INVALID, "a state folder is required");
  if (message != NULL)
    message->text[0] = '\0';
  int fd = mo_state_folder_open(config->path, &path, message);
  if (fd < 0)
    return fd;
  struct mo_store *store = create_store(config, path);
  if (store == NULL) {
    close(fd);
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  }
  store->folder_fd = fd;
  int error = mo_state_folder_lock(fd, config->path, &store->lock_fd, message);
  if (error == MO_OK)
    error = check_for_database(store, message);
  if (error == MO_OK)
    error = prepare_folders(store, message);
  if (error == MO_OK)
    error = prepare_database(store, message);
  if (error == MO_OK)
    error = mo_files_sort_out(store, &store->writer, true);
  if (error == MO_OK)
    error = mo_atlases_sort_out(store);
  if (error == MO_OK)
    error = mo_readers_open(store);
  if (error == MO_OK) {
    mo_reserve_make(store);
    error = mo_writer_start(store);
  }
  if (error == MO_OK)
    error = mo_make_sets(store);
  if (error != MO_OK) {
    mo_writer_stop(store);
    if (message != NULL && message->text[0] == '\0')
      mo_fail(message, error, "cannot open the state folder %s: %s", store->path,
              mo_error_text(error));
    free_store(store);
    return error;
  }
  mo_upkeep_begin(store);
  *ret = store;
  return MO_OK;
}

void mo_store_close(struct mo_store *store)
{
  if (store == NULL)
    return;
  mo_writer_stop(store);
  if (atomic_load(&store->is_fatal)) {
    /* Leave recovery to the next opening, which reads what is actually on the disk, rather than
     * this process's view of it. */
    (void)sqlite3_db_config(store->writer.db, SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1, NULL);
  } else {
    /* Close readers first, so that the last checkpoint can empty the log. */
    for (uint32_t i = 0; i <= store->n_readers; i++)
      mo_connection_close(&store->readers[i]);
    if (mo_sql_exec(&store->writer, "UPDATE meta SET value=1 WHERE key='clean'") == MO_OK)
      (void)sqlite3_wal_checkpoint_v2(store->writer.db, NULL, SQLITE_CHECKPOINT_TRUNCATE, NULL,
                                      NULL);
  }
  free_store(store);
}

uint64_t mo_store_id(const struct mo_store *store)
{
  return (uint64_t)store->id;
}

uint64_t mo_store_history(const struct mo_store *store)
{
  return (uint64_t)store->history;
}

uint64_t mo_store_epoch(const struct mo_store *store)
{
  return (uint64_t)store->epoch;
}

int mo_store_check(struct mo_store *store, struct mo_message *message)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row;
  char table[64];
  int error = run_check(reader, "PRAGMA integrity_check(1)", message);
  if (error == MO_OK)
    error = mo_sql_row(reader, &row, "PRAGMA foreign_key_check");
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_OK : error;
  mo_column_text(row, 0, table, sizeof(table));
  return mo_fail(message, MO_ERR_CORRUPT,
                 "the database is damaged: a row of %s refers to a missing row", table);
}
