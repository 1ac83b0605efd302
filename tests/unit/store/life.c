/* life.c: the history of a state folder: contents drawn from seeds, a disk with a promised store
 * next to it, comparisons of the two, and a report of faults. */
#include <ftw.h>
#include <math.h>
#include <sqlite3.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "fixture.h"
#include "life.h"
#include "store/check.h"
#include "store/internal.h"

uint64_t life_hash(uint64_t seed, uint64_t place)
{
  uint64_t z = seed * UINT64_C(0x9E3779B97F4A7C15) + place + 1; /* SplitMix64's mixing */
  z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
  z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
  return z ^ (z >> 31);
}

static void *memory_of(size_t size)
{
  void *memory = NULL;
  if (posix_memalign(&memory, 16, size) != 0)
    abort();
  return memory;
}

static size_t fill(uint64_t seed, size_t size, uint8_t **bytes)
{
  *bytes = memory_of(size);
  for (size_t i = 0; i < size; i++)
    (*bytes)[i] = (uint8_t)life_hash(seed, i);
  return size;
}

size_t life_checkpoint(uint64_t seed, uint32_t step, uint8_t **bytes)
{
  const uint64_t own = life_hash(seed, step);
  return fill(own, 1 + own % 30000, bytes);
}

double life_loss(uint64_t seed, uint32_t design, uint32_t environment, int32_t *diverged_step)
{
  const uint64_t own = life_hash(seed, 100 + (uint64_t)design * MO_ENVIRONMENTS_MAX + environment);
  *diverged_step = own % 16 == 0 ? 1 + (int32_t)((own >> 32) % 100) : 0;
  return *diverged_step != 0 ? (double)INFINITY : (double)(own >> 11) * 0x1p-53 - 0.5;
}

void life_name(int index, char name[16])
{
  snprintf(name, 16, index == 0 ? "default" : "walker-%d", index);
}

void life_key(char kind, int index, char key[32])
{
  snprintf(key, 32, "%c%d", kind, index);
}

int life_start(struct life *life, uint64_t seed, unsigned lies, struct mo_bits *forms,
               struct mo_bits *genotypes)
{
  struct mo_message message;
  *life = (struct life){.disk = disk_new(seed, lies), .forms = forms, .genotypes = genotypes};
  snprintf(life->promised_folder, sizeof(life->promised_folder), "%s/morpho-promised-XXXXXX",
           access("/dev/shm", W_OK) == 0 ? "/dev/shm" : "/tmp");
  if (life->disk == NULL || mkdtemp(life->promised_folder) == NULL)
    return -1;
  const struct mo_store_config config = {.path = life->promised_folder, .n_readers = 1};
  return mo_store_open(&config, &life->promised, &message) == MO_OK ? 0 : -1;
}

void life_end(struct life *life)
{
  mo_store_close(life->store);
  mo_store_close(life->promised);
  fixture_remove(life->promised_folder);
  disk_free(life->disk);
}

int life_open(struct life *life, uint32_t checkpoint_frames, struct mo_message *message)
{
  const struct mo_store_config config = {.path = disk_folder(life->disk),
                                         .vfs = disk_vfs(life->disk),
                                         .files = disk_files(life->disk),
                                         .n_readers = 1,
                                         .checkpoint_frames = checkpoint_frames};
  life->store = NULL;
  return mo_store_open(&config, &life->store, message);
}

void life_found(struct life *life, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  if (life->findings++ == 0)
    vsnprintf(life->first, sizeof(life->first), format, arguments);
  va_end(arguments);
}

/* A quarter of all contents have large metadata, so that the log grows long and is sometimes copied
 * into the database. */
void put_start(struct put *put, uint64_t seed)
{
  const size_t length = seed % 4 == 0 ? 100000 : 20;
  *put = (struct put){.key = "note", .note = memory_of(length + 1)};
  memset(put->note, 'x', length);
  put->note[length] = '\0';
  put->entry = (struct mo_metadata_entry){.key = put->key, .value = put->note};
  put->controller = (struct mo_controller){.workspace = MO_DEFAULT_WORKSPACE,
                                           .n_parameters = 1,
                                           .metadata = &put->entry,
                                           .n_metadata = 1};
  put->size = fill(seed, 1 + life_hash(seed, 1) % 20000, &put->bytes);
}

void put_end(struct put *put)
{
  free(put->note);
  free(put->bytes);
}

/* ---- contents of a folder ---- */

static bool is_left_out(const char *column)
{
  const size_t n = strlen(column);
  return strcmp(column, "epoch") == 0 || (n > 3 && strcmp(column + n - 3, "_us") == 0);
}

/* Packed losses and measures end with an 8-byte checksum, which also covers the row's time. */
static size_t checksum_of(const char *column)
{
  return strcmp(column, "losses") == 0 || strcmp(column, "packed") == 0 ? 8 : 0;
}

/* Returns the rows of a query. */
static uint64_t rows_of(sqlite3 *db, const char *sql)
{
  uint64_t sum = FNV_START;
  sqlite3_stmt *rows = NULL;
  CHECK_OK(sqlite3_prepare_v2(db, sql, -1, &rows, NULL));
  while (sqlite3_step(rows) == SQLITE_ROW)
    for (int i = 0; i < sqlite3_column_count(rows); i++) {
      const char *column = sqlite3_column_name(rows, i);
      const size_t n = (size_t)sqlite3_column_bytes(rows, i);
      if (!is_left_out(column)) {
        hash(&sum, &n, sizeof(n));
        hash(&sum, sqlite3_column_blob(rows, i), n - checksum_of(column));
      }
    }
  sqlite3_finalize(rows);
  return sum;
}

static struct {
  size_t folder_length;
  uint64_t sum; /* by name, in any order */
} files;

static int add_file(const char *path, const struct stat *status, int kind, struct FTW *place)
{
  uint64_t sum = FNV_START;
  (void)status;
  (void)place;
  if (kind == FTW_F)
    hash(&sum, path + files.folder_length, strlen(path + files.folder_length));
  files.sum += kind == FTW_F ? sum : 0;
  return 0;
}

static void add(struct contents *contents, const char *name, uint64_t sum)
{
  if (contents->n == COUNT(contents->tables))
    abort();
  snprintf(contents->tables[contents->n].name, sizeof(contents->tables[0].name), "%.39s", name);
  contents->tables[contents->n++].sum = sum;
  hash(&contents->sum, &sum, sizeof(sum));
}

void life_contents(const char *folder, struct contents *contents)
{
  static const char tables[] =
      "SELECT name, 'SELECT * FROM ' || name FROM sqlite_schema WHERE type='table' AND name NOT IN"
      " ('meta', 'fingerprints') AND name NOT LIKE 'sqlite%'";
  static const char *const folders[] = {"trainings", "campaigns"};
  char path[512];
  sqlite3 *db = NULL;
  sqlite3_stmt *rows = NULL;
  *contents = (struct contents){.sum = FNV_START};
  snprintf(path, sizeof(path), "%s/morphod.db", folder);
  CHECK_OK(sqlite3_open_v2(path, &db, SQLITE_OPEN_READONLY, NULL));
  CHECK_OK(sqlite3_prepare_v2(db, tables, -1, &rows, NULL));
  while (sqlite3_step(rows) == SQLITE_ROW)
    add(contents, (const char *)sqlite3_column_text(rows, 0),
        rows_of(db, (const char *)sqlite3_column_text(rows, 1)));
  sqlite3_finalize(rows);
  sqlite3_close(db);
  for (size_t i = 0; i < COUNT(folders); i++) {
    snprintf(path, sizeof(path), "%s/%s", folder, folders[i]);
    files.sum = 0;
    files.folder_length = strlen(folder);
    (void)nftw(path, add_file, 16, FTW_PHYS);
    add(contents, folders[i], files.sum);
  }
}

static const char number_sql[] =
    "SELECT coalesce(max(seq),0) FROM sqlite_sequence WHERE name='events'";

static int set_number(struct mo_store *of, void *number)
{
  return mo_sql_do(&of->writer, "UPDATE sqlite_sequence SET seq=?1 WHERE name='events'",
                   mo_int(*(int64_t *)number));
}

void life_follow(struct life *life)
{
  const int64_t history = (int64_t)mo_store_history(life->store);
  const bool is_other = history != life->history;
  int64_t promised = 0, is = 0;
  CHECK_OK(mo_read_integers(life->promised, number_sql, MO_VALUES(), 1, &promised));
  if (mo_read_integers(life->store, number_sql, MO_VALUES(), 1, &is) != MO_OK || is < promised ||
      (promised > 0 && is_other != (is > promised)))
    life_found(life, "events continue at %lld after %lld", (long long)is, (long long)promised);
  if (life->was_stopped && !is_other)
    life_found(life, "a history continues after a stop");
  life->history = history;
  life->was_stopped = false;
  CHECK_OK(mo_write(life->promised, set_number, &is));
}

static void tell(void *text, const char *finding)
{
  snprintf(text, MATCH_TEXT, "%s", finding);
}

bool life_matches(const struct life *life, char text[MATCH_TEXT])
{
  static struct contents is, promised;
  struct mo_check_counts counts;
  life_contents(disk_folder(life->disk), &is);
  life_contents(life->promised_folder, &promised);
  snprintf(text, MATCH_TEXT, is.n != promised.n ? "there are other tables" : "");
  for (int i = promised.n - 1; i >= 0 && is.n == promised.n; i--)
    if (is.tables[i].sum != promised.tables[i].sum)
      snprintf(text, MATCH_TEXT, "%s are not as promised", promised.tables[i].name);
  return is.sum == promised.sum &&
         mo_store_check_contents(life->store, tell, text, &counts) == MO_OK && counts.findings == 0;
}
