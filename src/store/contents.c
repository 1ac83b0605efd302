/* contents.c: see contents.h. */
#include "store/contents.h"

#include <stdlib.h>

#include "base/words.h"
#include "store/internal.h"

/* ---- rows by content: found or inserted ---- */

/* Finds or inserts a row in a table where the hash of the bytes identifies a row. */
static int content_row(struct mo_connection *writer, const char *find_sql, const char *insert_sql,
                       const uint8_t *bytes, size_t size, int64_t *row)
{
  struct mo_sha256 hash;
  mo_sha256_of(bytes, size, &hash);
  int error = mo_sql_find(writer, row, find_sql, mo_hash(&hash));
  return error != MO_ERR_NOT_FOUND
             ? error
             : mo_sql_insert(writer, row, insert_sql, mo_hash(&hash), mo_blob(bytes, size));
}

int mo_environment_row(struct mo_connection *writer, const struct mo_environment *environment,
                       int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM environments WHERE sha256=?1";
  static const char insert_sql[] = "INSERT INTO environments(sha256,data) VALUES(?1,?2)";
  uint8_t *bytes = malloc(mo_encoded_environment_bytes(environment));
  if (bytes == NULL)
    return MO_ERR_NO_MEMORY;
  const size_t size = mo_encode_environment(environment, bytes);
  const int error = content_row(writer, find_sql, insert_sql, bytes, size, row);
  free(bytes);
  return error;
}

int mo_physics_row(struct mo_connection *writer, const struct mo_physics *physics,
                   enum mo_precision precision, enum mo_sensor sensor, int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM physics WHERE sha256=?1";
  static const char insert_sql[] = "INSERT INTO physics(sha256,encoding) VALUES(?1,?2)";
  uint8_t bytes[MO_PHYSICS_BYTES_MAX];
  const size_t size = mo_encode_physics(physics, precision, sensor, bytes);
  return content_row(writer, find_sql, insert_sql, bytes, size, row);
}

int mo_physics_runs(struct mo_connection *connection, const struct mo_setting *first,
                    enum mo_sensor sensor, uint32_t n_displaced, double tolerance, int64_t *rows)
{
  static const char sql[] = "SELECT id FROM physics WHERE sha256=?1";
  int error = MO_OK;
  for (uint32_t run = 1; run < mo_ladder_runs(n_displaced, tolerance) && error == MO_OK; run++) {
    const struct mo_setting setting = mo_ladder_run(first, n_displaced, run);
    struct mo_sha256 hash;
    mo_physics_hash(&setting.physics, setting.precision, sensor, &hash);
    error = mo_sql_find(connection, &rows[run], sql, mo_hash(&hash));
  }
  return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
}

int mo_genotype_row(struct mo_connection *writer, const uint64_t *form, const uint64_t *genotype,
                    int64_t now_us, int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM genotypes WHERE bits=?1";
  static const char find_design_sql[] = "SELECT id FROM designs WHERE form=?1";
  static const char insert_design_sql[] = "INSERT INTO designs(form,first_seen_us) VALUES(?1,?2)";
  static const char insert_sql[] = "INSERT INTO genotypes(bits,design) VALUES(?1,?2)";
  uint8_t bits[MO_BITS_BYTES], canonical[MO_BITS_BYTES];
  int64_t design = 0;
  mo_encode_genotype(genotype, bits);
  int error = mo_sql_find(writer, row, find_sql, mo_blob(bits, sizeof(bits)));
  if (error != MO_ERR_NOT_FOUND)
    return error;
  mo_encode_genotype(form, canonical);
  error = mo_sql_find(writer, &design, find_design_sql, mo_blob(canonical, sizeof(canonical)));
  if (error == MO_ERR_NOT_FOUND)
    error = mo_sql_insert(writer, &design, insert_design_sql, mo_blob(canonical, sizeof(canonical)),
                          mo_int(now_us));
  return error == MO_OK
             ? mo_sql_insert(writer, row, insert_sql, mo_blob(bits, sizeof(bits)), mo_int(design))
             : error;
}

int mo_text_row(struct mo_connection *writer, enum mo_texts table, const char *text, int64_t *id)
{
  static const char *const insert_sql[] = {[MO_FINGERPRINTS] =
                                               "INSERT INTO fingerprints(text) VALUES(?1)",
                                           [MO_ORIGINS] = "INSERT INTO origins(text) VALUES(?1)"};
  static const char *const find_sql[] = {[MO_FINGERPRINTS] =
                                             "SELECT id FROM fingerprints WHERE text=?1",
                                         [MO_ORIGINS] = "SELECT id FROM origins WHERE text=?1"};
  const int error = mo_sql_find(writer, id, find_sql[table], mo_string(text));
  return error == MO_ERR_NOT_FOUND ? mo_sql_insert(writer, id, insert_sql[table], mo_string(text))
                                   : error;
}

/* ---- named sets ---- */

#define FIND_SET "SELECT id,n FROM environment_sets WHERE name=?1"

int mo_environment_set_find(struct mo_connection *connection, const char *name, int64_t *row,
                            int64_t *n)
{
  sqlite3_stmt *statement;
  const int error = mo_sql_row(connection, &statement, FIND_SET, mo_string(name));
  if (error != MO_OK)
    return error;
  *row = sqlite3_column_int64(statement, 0);
  *n = sqlite3_column_int64(statement, 1);
  return MO_OK;
}

int mo_suite_find(struct mo_connection *connection, const char *name, int64_t *rows,
                  uint32_t *n_sets, int64_t *n)
{
  const int suite = mo_word_index(mo_suite_words, name);
  int error = MO_OK;
  *n_sets = suite < 0 ? 1 : MO_SUITE_TASKS;
  *n = 0;
  for (uint32_t i = 0; i < *n_sets && error == MO_OK; i++) {
    int64_t of_set = 0;
    error = mo_environment_set_find(connection, suite < 0 ? name : mo_suite_set(suite, i), &rows[i],
                                    &of_set);
    *n += of_set;
  }
  return error;
}

int mo_store_environment_set_size(struct mo_store *store, const char *name, uint32_t *n)
{
  int64_t found[2] = {0, 0};
  const int error = mo_read_integers(store, FIND_SET, MO_VALUES(mo_string(name)), 2, found);
  *n = (uint32_t)found[1];
  return error;
}

/* Named sets are constants of the code with their own rows, so that scores can refer to them. Once
 * a folder has stored a set with a name, the set never changes there. */
static int make_set(struct mo_connection *writer, int i, struct mo_environment *environments)
{
  static const char set_sql[] = "INSERT INTO environment_sets(name,n) VALUES(?1,?2)";
  static const char member_sql[] =
      "INSERT INTO environment_set_members(environment_set,position,environment) VALUES(?1,?2,?3)";
  int64_t set = 0, size = 0, row = 0;
  int error = mo_environment_set_find(writer, mo_set_words[i], &set, &size);
  if (error != MO_ERR_NOT_FOUND)
    return error;
  const uint32_t n = mo_environment_set(i, environments);
  error = mo_sql_insert(writer, &set, set_sql, mo_string(mo_set_words[i]), mo_int(n));
  for (uint32_t k = 0; k < n && error == MO_OK; k++) {
    error = mo_environment_row(writer, &environments[k], &row);
    if (error == MO_OK)
      error = mo_sql_do(writer, member_sql, mo_int(set), mo_int(k), mo_int(row));
  }
  return error;
}

static int make_sets(struct mo_store *store, void *arguments)
{
  int error = MO_OK;
  for (int i = 0; mo_set_words[i] != NULL && error == MO_OK; i++)
    error = make_set(&store->writer, i, arguments);
  return error;
}

int mo_make_sets(struct mo_store *store)
{
  struct mo_environment *environments = calloc(MO_SET_ENVIRONMENTS_MAX, sizeof(*environments));
  const int error =
      environments != NULL ? mo_write(store, make_sets, environments) : MO_ERR_NO_MEMORY;
  free(environments);
  return error;
}

/* ---- the environments and designs of a job ---- */

int mo_suite_insert(struct mo_connection *writer, int64_t id, const int64_t *sets, uint32_t n_sets)
{
  static const char count_sql[] = "SELECT count(*) FROM job_environments WHERE job=?1";
  static const char sql[] = "INSERT INTO job_environments(job,position,environment)"
                            " SELECT ?1,position+?3,environment FROM environment_set_members"
                            " WHERE environment_set=?2";
  int64_t first = 0;
  int error = MO_OK;
  for (uint32_t i = 0; i < n_sets && error == MO_OK; i++) {
    error = mo_sql_find(writer, &first, count_sql, mo_int(id));
    if (error == MO_OK)
      error = mo_sql_do(writer, sql, mo_int(id), mo_int(sets[i]), mo_int(first));
  }
  return error;
}

int mo_environments_insert(struct mo_connection *writer, int64_t id, int64_t set,
                           const struct mo_environment *environments, uint32_t n)
{
  static const char copy_sql[] =
      "INSERT INTO job_environments(job,position,environment)"
      " SELECT ?1,position,environment FROM environment_set_members WHERE environment_set=?2";
  static const char sql[] =
      "INSERT INTO job_environments(job,position,environment) VALUES(?1,?2,?3)";
  int64_t row = 0;
  int error = MO_OK;
  if (set != 0)
    return mo_sql_do(writer, copy_sql, mo_int(id), mo_int(set));
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    error = mo_environment_row(writer, &environments[i], &row);
    if (error == MO_OK)
      error = mo_sql_do(writer, sql, mo_int(id), mo_int(i), mo_int(row));
  }
  return error;
}

int mo_design_insert(struct mo_connection *writer, int64_t id, uint32_t position, int64_t genotype)
{
  static const char sql[] = "INSERT INTO job_designs(job,position,genotype) VALUES(?1,?2,?3)";
  return mo_sql_do(writer, sql, mo_int(id), mo_int(position), mo_int(genotype));
}

int mo_designs_insert(struct mo_connection *writer, int64_t id, const struct mo_bits *forms,
                      const struct mo_bits *genotypes, uint32_t n,
                      const struct mo_design_note *notes, uint32_t n_notes, int64_t now_us)
{
  int64_t row = 0;
  int error = MO_OK;
  for (uint32_t i = 0, place = 0, k = 0; i < n && error == MO_OK; i++, place++) {
    for (; k < n_notes && notes[k].place <= place; k++)
      place += mo_is_skipped(&notes[k]);
    error = mo_genotype_row(writer, forms[i].words, genotypes[i].words, now_us, &row);
    if (error == MO_OK)
      error = mo_design_insert(writer, id, place, row);
  }
  return error;
}

int mo_notes_insert(struct mo_connection *writer, int64_t id, const struct mo_design_note *notes,
                    uint32_t n)
{
  static const char sql[] = "INSERT INTO design_notes(job,position,dropped,pointer,detail,"
                            "robot,orientation) VALUES(?1,?2,?3,?4,?5,?6,?7)";
  int error = MO_OK;
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    const bool skipped = mo_is_skipped(&notes[i]);
    error = mo_sql_do(writer, sql, mo_int(id), mo_int(notes[i].place), mo_int(notes[i].dropped),
                      mo_string(skipped ? notes[i].fault.where : NULL),
                      mo_string(skipped ? notes[i].fault.detail : NULL),
                      mo_string(notes[i].robot[0] != '\0' ? notes[i].robot : NULL),
                      mo_int(notes[i].orientation));
  }
  return error;
}

int mo_notes_read(struct mo_connection *reader, int64_t id, struct mo_design_note **notes,
                  uint32_t *n)
{
  static const char n_sql[] = "SELECT count(*) FROM design_notes WHERE job=?1";
  static const char sql[] =
      "SELECT position,dropped,coalesce(pointer,''),coalesce(detail,''),"
      "coalesce(robot,''),orientation FROM design_notes WHERE job=?1 ORDER BY position";
  int64_t count = 0;
  int error = mo_sql_find(reader, &count, n_sql, mo_int(id));
  *n = 0;
  *notes = NULL;
  if (error != MO_OK || count == 0)
    return error;
  *notes = calloc((size_t)count, sizeof(**notes));
  if (*notes == NULL)
    return MO_ERR_NO_MEMORY;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id));
  while (*n < count && mo_sql_next(reader, row, &error)) {
    struct mo_design_note *note = &(*notes)[(*n)++];
    note->place = mo_column_u32(row, 0);
    note->dropped = mo_column_u32(row, 1);
    mo_column_text(row, 2, note->fault.where, sizeof(note->fault.where));
    mo_column_text(row, 3, note->fault.detail, sizeof(note->fault.detail));
    mo_column_text(row, 4, note->robot, sizeof(note->robot));
    note->orientation = (enum mo_orientation)sqlite3_column_int(row, 5);
    if (note->orientation < MO_ORIENTATION_GIVEN || note->orientation > MO_ORIENTATION_BEST)
      return MO_ERR_CORRUPT;
  }
  return error == MO_OK && *n != count ? MO_ERR_CORRUPT : error;
}

int mo_environments_read(struct mo_connection *connection, int64_t id, uint32_t n,
                         struct mo_environment *environments, int64_t *rows)
{
  static const char sql[] =
      "SELECT e.id,e.data,e.sha256 FROM job_environments x JOIN environments e"
      " ON e.id=x.environment WHERE x.job=?1 ORDER BY x.position";
  uint32_t k = 0;
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(connection, &error, sql, mo_int(id));
  for (; mo_sql_next(connection, row, &error); k++) {
    if (k == n)
      return MO_ERR_CORRUPT;
    if (rows != NULL)
      rows[k] = sqlite3_column_int64(row, 0);
    if (environments != NULL)
      error = mo_column_environment(row, 1, 2, &environments[k]);
  }
  return error == MO_OK && k < n ? MO_ERR_CORRUPT : error;
}

int mo_designs_read(struct mo_connection *connection, int64_t id, struct mo_designs *designs)
{
  static const char n_sql[] = "SELECT count(*) FROM job_designs WHERE job=?1";
  static const char sql[] =
      "SELECT g.id,g.bits,d.form,x.position FROM job_designs x JOIN genotypes g ON g.id=x.genotype"
      " JOIN designs d ON d.id=g.design WHERE x.job=?1 ORDER BY x.position";
  int64_t n = 0;
  int error = mo_sql_find(connection, &n, n_sql, mo_int(id));
  *designs = (struct mo_designs){.n = 0};
  if (error != MO_OK)
    return error;
  designs->genotypes = calloc((size_t)n + 1, sizeof(*designs->genotypes));
  designs->rows = calloc((size_t)n + 1, sizeof(*designs->rows));
  designs->positions = calloc((size_t)n + 1, sizeof(*designs->positions));
  if (designs->genotypes == NULL || designs->rows == NULL || designs->positions == NULL)
    return MO_ERR_NO_MEMORY;
  sqlite3_stmt *row = mo_sql_rows(connection, &error, sql, mo_int(id));
  while (designs->n < n && mo_sql_next(connection, row, &error)) {
    designs->rows[designs->n] = sqlite3_column_int64(row, 0);
    designs->positions[designs->n] = mo_column_u32(row, 3);
    error = mo_column_listed(row, 1, 2, &designs->genotypes[designs->n++], NULL);
  }
  return error == MO_OK && designs->n != n ? MO_ERR_CORRUPT : error;
}
