/* orphans.c: files that no row refers to.
 *
 * Opening removes only files that this program itself leaves behind: unfinished files, which have
 * unique names; checkpoints without rows, if the database has their job; and excluded bodies of
 * deleted controllers. Any other file may be the last copy of its data, for example if the database
 * was replaced. It is kept until mo_store_clean removes it. */
#include <errno.h>
#include <fts.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

#include "store/controller_rows.h"
#include "store/folder.h"

struct round {
  struct mo_connection *connection; /* NULL: recognizes only unfinished files */
  bool removes_left_over, removes_unknown;
  void (*report)(void *context, const char *name, uint64_t bytes); /* for unknown files; nullable */
  void *context;
};

enum whose { UNKNOWN = 0, LEFT_OVER = 1, NAMED = 2 };

/* Returns whether `format` prints `name` from n numbers, and sets the numbers. */
static bool is_of_form(const char *name, const char *format, int n, long long numbers[3])
{
  char again[128];
  numbers[0] = numbers[1] = numbers[2] = 0;
  if (sscanf(name, format, &numbers[0], &numbers[1], &numbers[2]) !=
      n) /* NOLINT(cert-err34-c): compared below */
    return false;
  snprintf(again, sizeof(again), format, numbers[0], numbers[1], numbers[2]);
  return strcmp(name, again) == 0 && numbers[0] >= 0 && numbers[1] >= 0 && numbers[2] >= 0;
}

/* Determines which job or controller a file belongs to. connection NULL: recognizes only unfinished
 * files. */
static int judge(struct mo_connection *connection, const char *name, int64_t *whose)
{
  static const char weights_sql[] = "SELECT 2*EXISTS(SELECT 1 FROM controllers WHERE sha256=?1)";
  static const char excluded_sql[] = "SELECT 1+EXISTS(SELECT 1 FROM controllers WHERE sha256=?1)";
  static const char training_sql[] =
      "SELECT max(2*EXISTS(SELECT 1 FROM checkpoints WHERE job=?1 AND step=?2),"
      "EXISTS(SELECT 1 FROM trainings WHERE job=?1))";
  static const char campaign_sql[] =
      "SELECT max(2*EXISTS(SELECT 1 FROM checkpoints WHERE job=?1 AND generation=?2 AND step=?3),"
      "EXISTS(SELECT 1 FROM campaigns WHERE job=?1))";
  const char *file = strrchr(name, '/') + 1;
  const size_t digits = strspn(file, "0123456789abcdef");
  struct mo_sha256 sha256;
  uint64_t key;
  long long numbers[3];
  *whose = is_of_form(file, ".tmp-%lld", 1, numbers) ? LEFT_OVER : UNKNOWN;
  if (*whose == UNKNOWN && strncmp(name, "excluded/", 9) == 0 &&
      mo_excluded_name_read(file, &sha256, &key)) {
    *whose = NAMED; /* it can be recreated, so it does not indicate a missing database */
    return connection == NULL ? MO_OK
                              : mo_sql_find(connection, whose, excluded_sql, mo_hash(&sha256));
  }
  if (*whose == LEFT_OVER || connection == NULL)
    return MO_OK;
  if (is_of_form(name, "trainings/%lld/%lld.checkpoint", 2, numbers))
    return mo_sql_find(connection, whose, training_sql, mo_int(numbers[0]), mo_int(numbers[1]));
  if (is_of_form(name, "campaigns/%lld/%lld-%lld.checkpoint", 3, numbers))
    return mo_sql_find(connection, whose, campaign_sql, mo_int(numbers[0]), mo_int(numbers[1]),
                       mo_int(numbers[2]));
  if (strncmp(name, "controllers/", 12) == 0 && file == name + 12 &&
      strcmp(file + digits, ".safetensors") == 0 &&
      mo_sha256_from_hex(file, digits, &sha256) == MO_OK)
    return mo_sql_find(connection, whose, weights_sql, mo_hash(&sha256));
  return MO_OK;
}

static int visit(struct mo_store *store, const struct round *round, const FTSENT *entry)
{
  const char *name = entry->fts_path + strlen(store->path) + 1;
  int64_t whose = UNKNOWN;
  int error = entry->fts_info == FTS_F ? judge(round->connection, name, &whose) : MO_OK;
  if (error == MO_OK && whose == UNKNOWN && round->report != NULL)
    round->report(round->context, name, (uint64_t)entry->fts_statp->st_size);
  if (error == MO_OK &&
      (whose == UNKNOWN ? round->removes_unknown : whose == LEFT_OVER && round->removes_left_over))
    (void)store->files->unlink(entry->fts_path);
  return error;
}

static int walk(struct mo_store *store, const struct round *round)
{
  char *const folders[] = {store->controllers_path, store->trainings_path, store->campaigns_path,
                           store->excluded_path, NULL};
  FTS *tree = fts_open(folders, FTS_PHYSICAL | FTS_NOCHDIR, NULL);
  int error = tree != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  const FTSENT *entry;
  while (error == MO_OK && (errno = 0, entry = fts_read(tree)) != NULL) {
    const bool is_missing =
        entry->fts_info == FTS_NS && entry->fts_level == 0 && entry->fts_errno == ENOENT;
    if (entry->fts_info == FTS_DNR || entry->fts_info == FTS_ERR ||
        (entry->fts_info == FTS_NS && !is_missing))
      error = MO_ERR_IO;
    else if (entry->fts_info == FTS_DP && entry->fts_level > 0 && round->removes_unknown)
      (void)store->files->rmdir(entry->fts_path); /* if it is empty */
    else if (entry->fts_info != FTS_D && entry->fts_info != FTS_DP && !is_missing)
      error = visit(store, round, entry);
  }
  if (error == MO_OK && errno != 0)
    error = MO_ERR_IO;
  if (tree != NULL)
    (void)fts_close(tree);
  return error;
}

static void note(void *context, const char *name, uint64_t bytes)
{
  struct mo_orphans *orphans = context;
  const size_t length = strlen(orphans->first);
  orphans->bytes += bytes;
  if (orphans->n++ < 3)
    snprintf(orphans->first + length, sizeof(orphans->first) - length, "%s%s",
             length > 0 ? ", " : "", name);
}

int mo_files_sort_out(struct mo_store *store, struct mo_connection *connection, bool removes)
{
  store->orphans = (struct mo_orphans){.n = 0};
  return walk(store, &(struct round){.connection = connection,
                                     .removes_left_over = removes,
                                     .report = note,
                                     .context = &store->orphans});
}

const struct mo_orphans *mo_store_orphans(const struct mo_store *store)
{
  return &store->orphans;
}

int mo_store_clean(struct mo_store *store,
                   void (*report)(void *context, const char *name, uint64_t bytes), void *context)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = walk(store, &(struct round){.connection = reader,
                                          .removes_unknown = report == NULL,
                                          .report = report,
                                          .context = context});
  mo_reader_release(store, reader);
  return error != MO_OK ? error : mo_controllers_clean(store, report, context);
}
