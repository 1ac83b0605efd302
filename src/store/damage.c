/* damage.c: which row it is that keeps something from being read.
 *
 * Whoever reads finds no more than that a row is not what it must be. The statements of
 * schema/damage/ say which. They are asked after a reading has failed, and never before. */
#include <stdlib.h>
#include <string.h>

#include "damage.h"
#include "store/campaign_rows.h"

/* What the statements have as numbers. */
_Static_assert(MO_BITS_BYTES == 18 && MO_PHYSICS_BYTES == 93 && MO_ENVIRONMENT_BYTES == 528 &&
                   MO_BIRTH_BYTES == 9 && MO_MEMBER_BYTES == 12 && MO_STEPS_MAX == 1000000 &&
                   MO_DEFAULT_MASSES == 245 && MO_ENVIRONMENTS_MAX == 64 &&
                   MO_TIME_US_MAX == 253402300799999999,
               "schema/damage has other limits");

enum { OF_DESIGN = 0, OF_JOB = 1 }; /* of the embedded files */

/* sha256(x): the hash of a BLOB, as a BLOB. */
static void hash_of(sqlite3_context *context, int n, sqlite3_value **values)
{
  struct mo_sha256 hash;
  const void *bytes = sqlite3_value_blob(values[0]);
  (void)n;
  if (bytes == NULL) {
    sqlite3_result_null(context);
    return;
  }
  mo_sha256_of(bytes, (size_t)sqlite3_value_bytes(values[0]), &hash);
  sqlite3_result_blob(context, hash.bytes, sizeof(hash.bytes), SQLITE_TRANSIENT);
}

/* The first words that a file's statements give for the value that `bind` binds as their parameter.
 */
static int find(struct mo_connection *reader, size_t file,
                void (*bind)(sqlite3_stmt *statement, const void *value), const void *value,
                char words[MO_DAMAGE_BYTES])
{
  const char *sql = (const char *)damage_files[file].bytes;
  int error = mo_sql_error(
      reader->db, sqlite3_create_function(reader->db, "sha256", 1,
                                          SQLITE_UTF8 | SQLITE_DETERMINISTIC | SQLITE_DIRECTONLY,
                                          NULL, hash_of, NULL, NULL));
  words[0] = '\0';
  while (error == MO_OK && words[0] == '\0' && *sql != '\0') {
    sqlite3_stmt *statement = NULL; /* asked so seldom that a connection need not keep it */
    error = mo_sql_error(reader->db, sqlite3_prepare_v2(reader->db, sql, -1, &statement, &sql));
    if (statement == NULL) /* nor is there one behind the last */
      continue;
    bind(statement, value);
    error = mo_sql_step(reader, statement);
    if (error > 0) {
      mo_column_text(statement, 0, words, MO_DAMAGE_BYTES);
      error = MO_OK;
    }
    sqlite3_finalize(statement);
  }
  return error != MO_OK ? error : words[0] != '\0' ? MO_OK : MO_ERR_NOT_FOUND;
}

/* ---- jobs ---- */

static void bind_id(sqlite3_stmt *statement, const void *id)
{
  sqlite3_bind_int64(statement, 1, *(const int64_t *)id);
}

/* Of its own rows, those that every reading of it needs: with words in job->damage and
 * MO_ERR_CORRUPT. */
static int read_status(struct mo_store *store, int64_t id, struct mo_job *job)
{
  int error = mo_store_job(store, id, job);
  struct mo_training_status *training =
      error == MO_OK && job->kind == MO_JOB_TRAINING ? malloc(sizeof(*training)) : NULL;
  struct mo_campaign_status *campaign =
      error == MO_OK && job->kind == MO_JOB_CAMPAIGN ? malloc(sizeof(*campaign)) : NULL;
  if (training != NULL && (error = mo_store_training(store, id, training)) == MO_ERR_CORRUPT)
    memcpy(job->damage, training->job.damage, sizeof(job->damage));
  if (campaign != NULL && (error = mo_store_campaign(store, id, campaign)) == MO_ERR_CORRUPT)
    memcpy(job->damage, campaign->job.damage, sizeof(job->damage));
  free(training);
  free(campaign);
  return error;
}

int mo_store_job_damage(struct mo_store *store, int64_t id, struct mo_job *job)
{
  struct mo_connection *reader;
  int error;
  memset(job, 0, sizeof(*job));
  error = read_status(store, id, job);
  if (error == MO_ERR_CORRUPT && job->damage[0] != '\0')
    return MO_OK;
  if (error != MO_OK)
    return error;
  reader = mo_reader_acquire(store);
  error = find(reader, OF_JOB, bind_id, &id, job->damage);
  mo_reader_release(store, reader);
  return error;
}

/* ---- designs ---- */

static void bind_form(sqlite3_stmt *statement, const void *bytes)
{
  sqlite3_bind_blob(statement, 1, bytes, MO_BITS_BYTES, SQLITE_STATIC);
}

int mo_store_design_damage(struct mo_store *store, const struct mo_bits *form, int64_t *row,
                           char words[MO_DAMAGE_BYTES])
{
  static const char sql[] = "SELECT id FROM designs WHERE form=?1";
  struct mo_connection *reader = mo_reader_acquire(store);
  uint8_t bytes[MO_BITS_BYTES];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  mo_encode_bits(form, bytes);
  if (statement != NULL) {
    bind_form(statement, bytes);
    error = mo_sql_integer(reader, statement, row);
    (void)sqlite3_clear_bindings(statement);
  }
  if (error == MO_OK)
    error = find(reader, OF_DESIGN, bind_form, bytes, words);
  mo_reader_release(store, reader);
  return error;
}
