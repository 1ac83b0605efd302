/* campaign_phylogeny.c: reads every design of a campaign, its populations, its descents.
 *
 * A page of designs is one range of campaign_designs. A population, and the births of a generation,
 * are one BLOB each. A campaign of a million designs has 9 MB of births. */
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"

int mo_campaign_members_get(struct mo_connection *connection, int64_t id, int64_t generation,
                            struct mo_campaign_members *members)
{
  static const char sql[] =
      "SELECT population FROM campaign_populations WHERE job=?1 AND generation=?2";
  sqlite3_stmt *row;
  const int error = mo_sql_row(connection, &row, sql, mo_int(id), mo_int(generation));
  size_t size;
  if (error != MO_OK)
    return error;
  members->population = sqlite3_column_blob(row, 0);
  size = (size_t)sqlite3_column_bytes(row, 0);
  members->n = (uint32_t)(size / sizeof(*members->population));
  return size % sizeof(*members->population) == 0 && (members->population != NULL || size == 0)
             ? MO_OK
             : mo_column_missing(row);
}

/* ---- designs ---- */

#define DESIGN_COLUMNS                                                                             \
  "SELECT d.number,d.operator,d.parent,d.other_parent,d.born,d.died,d.score,d.size,g.bits,x.form " \
  "FROM"                                                                                           \
  " campaign_designs d CROSS JOIN genotypes g ON g.id=d.genotype CROSS JOIN designs x ON "         \
  "x.id=g.design"

static uint32_t column_parent(sqlite3_stmt *row, int column)
{
  return sqlite3_column_type(row, column) == SQLITE_NULL
             ? MO_NO_PARENT
             : (uint32_t)sqlite3_column_int64(row, column);
}

static int design_from_row(sqlite3_stmt *row, void *any)
{
  struct mo_campaign_design *design = any;
  uint64_t size = (uint64_t)sqlite3_column_int64(row, 7);
  int error;
  design->number = (uint32_t)sqlite3_column_int64(row, 0);
  design->descent = (struct mo_descent){{column_parent(row, 2), column_parent(row, 3)},
                                        (uint8_t)sqlite3_column_int(row, 1)};
  design->born = (uint32_t)sqlite3_column_int64(row, 4);
  design->died = sqlite3_column_type(row, 5) == SQLITE_NULL ? -1 : sqlite3_column_int64(row, 5);
  design->size = (struct mo_design_size){.springs = (uint32_t)(size & 0xffff),
                                         .masses = (uint32_t)(size >> 16 & 1023),
                                         .voxels = (uint32_t)(size >> 26 & 1023),
                                         .footprint = (uint32_t)(size >> 36 & 1023)};
  error = mo_column_double(row, 6, &design->score);
  return error == MO_OK ? mo_column_genotype(row, 8, 9, &design->genotype, &design->form) : error;
}

int64_t mo_store_campaign_designs(struct mo_store *store, int64_t id, int64_t after,
                                  struct mo_campaign_design *rows, size_t limit)
{
  static const char sql[] =
      DESIGN_COLUMNS " WHERE d.job=?1 AND d.number>?2 ORDER BY d.number LIMIT ?3";
  return mo_read_page(store, sql, MO_VALUES(mo_int(id), mo_int(after), mo_int((int64_t)limit)),
                      design_from_row, rows, sizeof(*rows));
}

static int load_design(struct mo_connection *reader, int64_t id, uint32_t number,
                       struct mo_campaign_design *design)
{
  static const char sql[] = DESIGN_COLUMNS " WHERE d.job=?1 AND d.number=?2";
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_int(id), mo_int(number));
  return error == MO_OK ? design_from_row(row, design) : error;
}

int mo_store_campaign_designs_of(struct mo_store *store, int64_t id, const uint32_t *numbers,
                                 size_t n, struct mo_campaign_design *rows)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  for (size_t i = 0; i < n && error == MO_OK; i++)
    error = load_design(reader, id, numbers[i], &rows[i]);
  mo_reader_release(store, reader);
  return error;
}

/* ---- populations ---- */

static int64_t load_population(struct mo_connection *reader, int64_t id, int64_t generation,
                               uint32_t offset, struct mo_campaign_design *rows, size_t limit,
                               uint32_t *n)
{
  struct mo_campaign_members members;
  struct mo_campaign_head head = {0};
  int64_t filled = 0;
  int error = mo_campaign_head_get(reader, id, &head);
  if (error == MO_OK)
    error = mo_campaign_members_get(reader, id, generation < 0 ? head.generation : generation,
                                    &members);
  if (error != MO_OK)
    return error;
  *n = members.n;
  for (uint32_t i = offset; i < members.n && (size_t)filled < limit; i++) {
    error = load_design(reader, id, members.population[i].number, &rows[filled]);
    if (error != MO_OK)
      return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
    rows[filled++].score = members.population[i].score;
  }
  return filled;
}

int64_t mo_store_campaign_population(struct mo_store *store, int64_t id, int64_t generation,
                                     uint32_t offset, struct mo_campaign_design *rows, size_t limit,
                                     uint32_t *n)
{
  struct mo_connection *reader;
  int64_t filled;
  if (limit > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  reader = mo_reader_acquire(store);
  filled = load_population(reader, id, generation, offset, rows, limit, n);
  mo_reader_release(store, reader);
  return filled;
}

/* ---- descents ---- */

int mo_store_campaign_descents(struct mo_store *store, int64_t id, struct mo_descent **ret,
                               uint32_t **ret_born, uint32_t *ret_n)
{
  static const char sql[] =
      "SELECT generation,births FROM campaign_populations WHERE job=?1 ORDER BY generation";
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_head head = {0};
  int error = mo_campaign_head_get(reader, id, &head);
  struct mo_descent *descents = malloc((head.n_designs + 1) * sizeof(*descents));
  uint32_t *born = malloc((head.n_designs + 1) * sizeof(*born)), filled = 0;
  sqlite3_stmt *row;
  if (error == MO_OK && (descents == NULL || born == NULL))
    error = MO_ERR_NO_MEMORY;
  row = mo_sql_rows(reader, &error, sql, mo_int(id));
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
  mo_reader_release(store, reader);
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

/* ---- where a form was born ---- */

static int take_place(sqlite3_stmt *row, void *any)
{
  struct mo_campaign_place *place = any;
  *place = (struct mo_campaign_place){sqlite3_column_int64(row, 0), mo_column_u32(row, 1)};
  return MO_OK;
}

int64_t mo_store_campaigns_of_design(struct mo_store *store, const struct mo_bits *form,
                                     int64_t after_campaign, struct mo_campaign_place *places,
                                     size_t limit)
{
  static const char sql[] =
      "SELECT d.job,d.number FROM designs x CROSS JOIN genotypes g ON g.design=x.id CROSS JOIN"
      " campaign_designs d ON d.genotype=g.id WHERE x.form=?1 AND d.job>?2"
      " ORDER BY d.job LIMIT ?3";
  uint8_t bytes[MO_BITS_BYTES];
  mo_encode_bits(form, bytes);
  return mo_read_page(
      store, sql,
      MO_VALUES(mo_blob(bytes, sizeof(bytes)), mo_int(after_campaign), mo_int((int64_t)limit)),
      take_place, places, sizeof(*places));
}
