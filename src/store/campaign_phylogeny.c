/* campaign_phylogeny.c: reads all designs of a campaign, its populations and lines of descent.
 *
 * A page of designs is one range of campaign_designs. A population, and the births of a generation,
 * are one BLOB each. A campaign of a million designs has 9 MB of births. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"
#include "store/certificate_rows.h"

int mo_campaign_members_get(struct mo_connection *connection, int64_t id, int64_t generation,
                            struct mo_campaign_members *members)
{
  static const char sql[] =
      "SELECT population FROM campaign_populations WHERE job=?1 AND generation=?2";
  sqlite3_stmt *row;
  const int error = mo_sql_row(connection, &row, sql, mo_int(id), mo_int(generation));
  if (error != MO_OK)
    return error;
  members->population = sqlite3_column_blob(row, 0);
  size_t size = (size_t)sqlite3_column_bytes(row, 0);
  members->n = (uint32_t)(size / sizeof(*members->population));
  return size % sizeof(*members->population) == 0 && (members->population != NULL || size == 0)
             ? MO_OK
             : mo_column_missing(row);
}

/* ---- designs ---- */

/* With the newest result of a re-evaluation up to generation `until`, and with the newest
 * certificate under a controller of the campaign. */
#define DESIGN_COLUMNS(until)                                                                      \
  "SELECT d.number,d.operator,d.parent,d.other_parent,d.born,d.died,d.score,d.size,g.bits,x.form," \
  "CASE WHEN d.operator>=5 THEN (SELECT word FROM study_words w WHERE w.job=d.job AND w.kind=0"    \
  " AND w.place=d.operator-5) END,d.measures,d.is_cut,h.generation,h.worlds,h.diverged,h.mean,"    \
  "h.standard_error,v.job,v.verdict FROM campaign_designs d CROSS JOIN genotypes g ON "            \
  "g.id=d.genotype CROSS JOIN designs x ON x.id=g.design LEFT JOIN campaign_held_out h ON "        \
  "h.job=d.job AND h.number=d.number AND h.generation=(SELECT max(generation) FROM "               \
  "campaign_held_out WHERE job=d.job AND number=d.number AND generation<=" until ")"               \
  " LEFT JOIN certificate_verdicts v ON v.genotype=d.genotype AND v.job=(SELECT max(c.job) FROM "  \
  "certificate_verdicts c WHERE c.genotype=d.genotype AND c.controller IN (SELECT controller FROM" \
  " runs WHERE job=d.job UNION SELECT result FROM runs WHERE job=d.job))"
#define ANY_GENERATION "4294967295"

static uint32_t column_parent(sqlite3_stmt *row, int column)
{
  return sqlite3_column_type(row, column) == SQLITE_NULL ? MO_NO_PARENT
                                                         : mo_column_u32(row, column);
}

static int column_measures(sqlite3_stmt *row, int column, double measures[MO_DESIGN_MEASURES_MAX],
                           uint32_t *n)
{
  const void *bytes = sqlite3_column_blob(row, column);
  const size_t size = (size_t)sqlite3_column_bytes(row, column);
  *n = (uint32_t)(size / sizeof(*measures));
  if (size % sizeof(*measures) != 0 || *n > MO_DESIGN_MEASURES_MAX)
    return MO_ERR_CORRUPT;
  if (size > 0 && bytes == NULL)
    return mo_column_missing(row);
  if (size > 0)
    memcpy(measures, bytes, size);
  return MO_OK;
}

/* Reverses packed_size (campaign_commit.c). */
static struct mo_design_size unpacked_size(int64_t size)
{
  return (struct mo_design_size){.springs = (uint32_t)(size & 0xffff),
                                 .masses = (uint32_t)(size >> 16 & 1023),
                                 .voxels = (uint32_t)(size >> 26 & 1023),
                                 .footprint = (uint32_t)(size >> 36 & 1023)};
}

static int design_from_row(sqlite3_stmt *row, void *any)
{
  struct mo_campaign_design *design = any;
  uint64_t size = (uint64_t)sqlite3_column_int64(row, 7);
  design->number = (uint32_t)sqlite3_column_int64(row, 0);
  design->descent = (struct mo_descent){{column_parent(row, 2), column_parent(row, 3)},
                                        (uint8_t)sqlite3_column_int(row, 1)};
  design->born = (uint32_t)sqlite3_column_int64(row, 4);
  design->died = sqlite3_column_type(row, 5) == SQLITE_NULL ? -1 : sqlite3_column_int64(row, 5);
  design->size = unpacked_size(size);
  design->is_cut = sqlite3_column_int(row, 12) != 0;
  design->held_out = (struct mo_re_evaluated){.number = design->number,
                                              .generation = mo_column_u32(row, 13),
                                              .worlds = mo_column_u32(row, 14),
                                              .diverged = mo_column_u32(row, 15),
                                              .mean = mo_column_number(row, 16),
                                              .standard_error = mo_column_number(row, 17)};
  design->certified = mo_column_certified(row, 18);
  mo_column_text(row, 10, design->own_operator, sizeof(design->own_operator));
  int error = design->descent.op < MO_OPERATORS || design->own_operator[0] != '\0'
                  ? mo_column_double(row, 6, &design->score)
                  : MO_ERR_CORRUPT;
  if (error == MO_OK)
    error = column_measures(row, 11, design->measures, &design->n_measures);
  return error == MO_OK ? mo_column_design(row, 8, 9, &design->genotype, &design->form) : error;
}

int64_t mo_store_campaign_designs(struct mo_store *store, int64_t id, int64_t after,
                                  struct mo_campaign_design *rows, size_t limit)
{
  static const char sql[] =
      DESIGN_COLUMNS(ANY_GENERATION) " WHERE d.job=?1 AND d.number>?2 ORDER BY d.number LIMIT ?3";
  return mo_read_page(store, sql, MO_VALUES(mo_int(id), mo_int(after), mo_int((int64_t)limit)),
                      design_from_row, rows, sizeof(*rows));
}

/* until: the last generation whose re-evaluation may be the result. */
static int load_design(struct mo_connection *reader, int64_t id, uint32_t number, int64_t until,
                       struct mo_campaign_design *design)
{
  static const char sql[] = DESIGN_COLUMNS("?3") " WHERE d.job=?1 AND d.number=?2";
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_int(id), mo_int(number), mo_int(until));
  return error == MO_OK ? design_from_row(row, design) : error;
}

int mo_store_campaign_designs_of(struct mo_store *store, int64_t id, const uint32_t *numbers,
                                 size_t n, struct mo_campaign_design *rows)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  for (size_t i = 0; i < n && error == MO_OK; i++)
    error = load_design(reader, id, numbers[i], INT64_MAX, &rows[i]);
  return error;
}

/* ---- populations ---- */

int64_t mo_store_campaign_population(struct mo_store *store, int64_t id, int64_t generation,
                                     uint32_t offset, struct mo_campaign_design *rows, size_t limit,
                                     uint32_t *n)
{
  struct mo_campaign_members members;
  struct mo_campaign_head head = {0};
  int64_t filled = 0;
  if (limit > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int error = mo_campaign_head_get(reader, id, &head);
  if (generation < 0)
    generation = head.generation;
  if (error == MO_OK)
    error = mo_campaign_members_get(reader, id, generation, &members);
  if (error != MO_OK)
    return error;
  *n = members.n;
  for (uint32_t i = offset; i < members.n && (size_t)filled < limit; i++) {
    error = load_design(reader, id, members.population[i].number, generation, &rows[filled]);
    if (error != MO_OK)
      return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
    rows[filled++].score = members.population[i].score;
  }
  return filled;
}

/* ---- descents ---- */

int mo_store_campaign_descents(struct mo_store *store, int64_t id, struct mo_descent **ret,
                               uint32_t **ret_born, uint32_t *ret_n)
{
  static const char sql[] =
      "SELECT generation,births FROM campaign_populations WHERE job=?1 ORDER BY generation";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_head head = {0};
  int error = mo_campaign_head_get(reader, id, &head);
  struct mo_descent *descents = malloc((head.n_designs + 1) * sizeof(*descents));
  uint32_t *born = malloc((head.n_designs + 1) * sizeof(*born)), filled = 0;
  if (error == MO_OK && (descents == NULL || born == NULL))
    error = MO_ERR_NO_MEMORY;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id));
  while (descents != NULL && born != NULL && mo_sql_next(reader, row, &error)) {
    const struct mo_birth_row *births = sqlite3_column_blob(row, 1);
    const size_t n = (size_t)sqlite3_column_bytes(row, 1) / sizeof(*births);
    if (n > head.n_designs - filled)
      error = MO_ERR_CORRUPT;
    for (size_t i = 0; i < n && error == MO_OK; i++, filled++) {
      descents[filled] =
          (struct mo_descent){{births[i].parents[0], births[i].parents[1]}, births[i].op};
      born[filled] = mo_column_u32(row, 0);
    }
  }
  if (error == MO_OK && filled != head.n_designs)
    error = MO_ERR_CORRUPT;
  if (error == MO_OK) {
    *ret = descents;
    *ret_n = filled;
  } else {
    free(descents);
  }
  if (error == MO_OK && ret_born != NULL)
    *ret_born = born;
  else
    free(born);
  return error;
}

/* ---- the whole phylogeny as columns ---- */

/* Takes an array from the block. */
static void *take_array(char **block, size_t bytes)
{
  char *array = *block;
  *block += bytes;
  return array;
}

/* Allocates one block for n designs: the arrays of the widest numbers come first, so that all are
 aligned.
 */
static struct mo_campaign_columns *make_columns(size_t n, const struct mo_study_words *words)
{
  const size_t row = words->n_measures * sizeof(double) + 5 * sizeof(uint32_t) + 3;
  struct mo_campaign_columns *columns = malloc(sizeof(*columns) + n * row);
  if (columns == NULL)
    return NULL;
  char *block = (char *)(columns + 1);
  *columns = (struct mo_campaign_columns){.words = *words};
  for (uint32_t m = 0; m < words->n_measures; m++)
    columns->measures[m] = take_array(&block, n * sizeof(double));
  columns->parents[0] = take_array(&block, n * sizeof(uint32_t));
  columns->parents[1] = take_array(&block, n * sizeof(uint32_t));
  columns->born = take_array(&block, n * sizeof(uint32_t));
  columns->died = take_array(&block, n * sizeof(uint32_t));
  columns->scores = take_array(&block, n * sizeof(float));
  columns->operators = take_array(&block, n);
  columns->voxels = take_array(&block, n);
  columns->footprints = take_array(&block, n);
  return columns;
}

/* Reads the measures of the next design. A design lacks the measures that the study introduced
 * after it. */
static int read_measures(sqlite3_stmt *row, int column, struct mo_campaign_columns *columns)
{
  double measures[MO_DESIGN_MEASURES_MAX] = {0};
  uint32_t n = 0;
  const int error = column_measures(row, column, measures, &n);
  for (uint32_t m = 0; m < columns->words.n_measures; m++)
    columns->measures[m][columns->n] = m < n ? measures[m] : NAN;
  return error;
}

static int read_columns(struct mo_connection *reader, int64_t id, int64_t n,
                        struct mo_campaign_columns *columns)
{
  static const char sql[] =
      "SELECT number,operator,parent,other_parent,born,died,score,size,measures,is_cut"
      " FROM campaign_designs WHERE job=?1 ORDER BY number";
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id));
  while (mo_sql_next(reader, row, &error)) {
    const uint32_t i = columns->n;
    double score;
    if (i == n || sqlite3_column_int64(row, 0) != i)
      return MO_ERR_CORRUPT;
    columns->operators[i] = (uint8_t)sqlite3_column_int(row, 1);
    for (int p = 0; p < 2; p++)
      columns->parents[p][i] = column_parent(row, 2 + p);
    columns->born[i] = mo_column_u32(row, 4);
    columns->died[i] =
        sqlite3_column_type(row, 5) == SQLITE_NULL ? MO_ALIVE : mo_column_u32(row, 5);
    error = mo_column_double(row, 6, &score);
    columns->scores[i] = isfinite(score) ? (float)score : NAN;
    if (sqlite3_column_int(row, 9) != 0)
      columns->scores[i] = -columns->scores[i];
    const struct mo_design_size size = unpacked_size(sqlite3_column_int64(row, 7));
    columns->voxels[i] = (uint8_t)size.voxels;
    columns->footprints[i] = (uint8_t)size.footprint;
    if (error == MO_OK && columns->words.n_measures > 0)
      error = read_measures(row, 8, columns);
    columns->n++;
  }
  return error;
}

int mo_store_campaign_columns(struct mo_store *store, int64_t id, struct mo_campaign_columns **ret)
{
  static const char sql[] = "SELECT count(*) FROM campaign_designs WHERE job=?1";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_columns *columns = NULL;
  struct mo_study_words words;
  int64_t n = 0;
  int error = mo_sql_find(reader, &n, sql, mo_int(id));
  if (error == MO_OK)
    error = mo_campaign_words_get(reader, id, &words);
  if (error == MO_OK && n > MO_COLUMNS_MAX)
    error = MO_ERR_LIMIT;
  if (error == MO_OK && (columns = make_columns((size_t)n + 1, &words)) == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = read_columns(reader, id, n, columns);
  if (error != MO_OK) {
    free(columns);
    return error;
  }
  *ret = columns;
  return MO_OK;
}

/* ---- where a form was born ---- */

static int take_place(sqlite3_stmt *row, void *any)
{
  struct mo_campaign_place *place = any;
  *place = (struct mo_campaign_place){sqlite3_column_int64(row, 0), mo_column_u32(row, 1)};
  return MO_OK;
}

int64_t mo_store_campaigns_of_design(struct mo_store *store, const struct mo_genotype *form,
                                     int64_t after_campaign, struct mo_campaign_place *places,
                                     size_t limit)
{
  static const char sql[] =
      "SELECT d.job,d.number FROM designs x CROSS JOIN genotypes g ON g.design=x.id CROSS JOIN"
      " campaign_designs d ON d.genotype=g.id CROSS JOIN jobs j ON j.id=d.job AND j.state<6"
      " WHERE x.form=?1 AND d.job>?2 ORDER BY d.job LIMIT ?3";
  uint8_t bytes[MO_BITS_BYTES];
  mo_encode_genotype(form->words, bytes);
  return mo_read_page(
      store, sql,
      MO_VALUES(mo_blob(bytes, sizeof(bytes)), mo_int(after_campaign), mo_int((int64_t)limit)),
      take_place, places, sizeof(*places));
}
