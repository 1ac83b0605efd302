/* rows.c: see rows.h. REAL keeps the bits of every number except NaN, which is stored as NULL. */
#include "store/rows.h"

#include "base/text.h"
#include "store/campaigns.h"
#include "store/columns.h"
#include "store/internal.h"
#include "store/trainings.h"

#define COLUMNS_MAX 80
#define SQL_MAX     3072

enum { CREATE, WRITE, NEWEST, AFTER, STRIDE, STATEMENTS };

/* A table of rows of jobs. Its first n_keys columns identify a row of a job. */
static const struct table {
  const char *name;
  const struct mo_columns *columns;
  size_t size; /* of a row in memory */
  size_t n_keys;
} tables[MO_ROW_TABLES] = {
    [MO_TRAINING_STEPS] = {"training_steps", &mo_step_columns, sizeof(struct mo_training_step_row),
                           1},
    [MO_TRAINING_VALIDATIONS] = {"training_validations", &mo_validation_columns,
                                 sizeof(struct mo_training_validation_row), 1},
    [MO_CAMPAIGN_GENERATIONS] = {"campaign_generations", &mo_generation_columns,
                                 sizeof(struct mo_campaign_generation), 1},
    [MO_CAMPAIGN_STEPS] = {"campaign_steps", &mo_campaign_step_columns,
                           sizeof(struct mo_campaign_step), 2}};
static char statements[MO_ROW_TABLES][STATEMENTS][SQL_MAX]; /* made once */

/* ---- statements ---- */

/* Adds the names of the first n columns, with commas between them. */
static void add_names(struct mo_text *sql, const struct table *table, size_t n)
{
  for (size_t i = 0; i < n; i++)
    mo_text_format(sql, "%s\"%s\"", i > 0 ? "," : "", mo_column_name(&table->columns->items[i]));
}

static void make_statement(const struct table *table, int which, struct mo_text *sql)
{
  const size_t n = table->columns->n + table->columns->n_stored;
  if (which == CREATE) {
    mo_text_format(sql, "CREATE TABLE %s(job INTEGER NOT NULL REFERENCES runs(job)", table->name);
    for (size_t i = 0; i < n; i++)
      mo_text_format(sql, ",\"%s\" %s", mo_column_name(&table->columns->items[i]),
                     table->columns->items[i].type == MO_COLUMN_NUMBER ? "REAL"
                                                                       : "INTEGER NOT NULL");
    mo_text_format(sql, ",PRIMARY KEY(job,");
    add_names(sql, table, table->n_keys);
    mo_text_format(sql, ")) STRICT, WITHOUT ROWID");
    return;
  }
  if (which == WRITE) {
    mo_text_format(sql, "INSERT OR REPLACE INTO %s(job,", table->name);
    add_names(sql, table, n);
    mo_text_format(sql, ") VALUES(?");
    for (size_t i = 0; i < n; i++)
      mo_text_format(sql, ",?");
    mo_text_format(sql, ")");
    return;
  }
  mo_text_format(sql, "SELECT ");
  add_names(sql, table, n);
  mo_text_format(sql, " FROM %s WHERE job=?1", table->name);
  if (which == NEWEST) {
    mo_text_format(sql, " ORDER BY 1 DESC LIMIT 1");
  } else if (which == STRIDE) {
    /* Looks up each multiple separately: reading all rows in between would take a third of a second
     * for a million rows. */
    mo_text_format(
        sql,
        " AND %1$s IN (WITH RECURSIVE wanted(at) AS (SELECT (?2/?3+1)*?3 UNION ALL"
        " SELECT at+?3 FROM wanted WHERE at+?3<=(SELECT max(%1$s) FROM %2$s WHERE job=?1)"
        " LIMIT ?4) SELECT at FROM wanted) ORDER BY %1$s",
        mo_column_name(&table->columns->items[0]), table->name);
  } else {
    mo_text_format(sql, " AND (");
    add_names(sql, table, table->n_keys);
    mo_text_format(sql, table->n_keys == 1 ? ")>(?2) ORDER BY 1 LIMIT ?3"
                                           : ")>(?2,?3) ORDER BY 1,2 LIMIT ?4");
  }
}

static void make_statements(void)
{
  for (int t = 0; t < MO_ROW_TABLES; t++)
    for (int i = 0; i < STATEMENTS; i++)
      make_statement(
          &tables[t], i,
          &(struct mo_text){.data = statements[t][i], .capacity = SQL_MAX, .is_fixed = true});
}

static const char *statement_of(enum mo_row_table which, int statement)
{
  static pthread_once_t once = PTHREAD_ONCE_INIT;
  pthread_once(&once, make_statements);
  return statements[which][statement];
}

int mo_rows_create(struct mo_connection *writer)
{
  int error = MO_OK;
  for (enum mo_row_table which = 0; which < MO_ROW_TABLES && error == MO_OK; which++)
    error = mo_sql_exec(writer, statement_of(which, CREATE));
  return error;
}

/* Adds a column, unless the table has it. Existing rows get 0, or no number. */
static int extend(struct mo_connection *writer, const struct table *table,
                  const struct mo_column *column)
{
  static const char has_sql[] = "SELECT count(*) FROM pragma_table_info(?1) WHERE name=?2";
  const char *name = mo_column_name(column);
  char sql[160];
  int64_t has = 0;
  const int error = mo_sql_find(writer, &has, has_sql, mo_string(table->name), mo_string(name));
  if (error != MO_OK || has > 0)
    return error;
  snprintf(sql, sizeof(sql), "ALTER TABLE %s ADD COLUMN \"%s\" %s", table->name, name,
           column->type == MO_COLUMN_NUMBER ? "REAL" : "INTEGER NOT NULL DEFAULT 0");
  return mo_sql_exec(writer, sql);
}

int mo_rows_extend(struct mo_connection *writer)
{
  int error = MO_OK;
  for (const struct table *table = tables; table < tables + MO_ROW_TABLES; table++)
    for (size_t i = 0; i < table->columns->n + table->columns->n_stored && error == MO_OK; i++)
      error = extend(writer, table, &table->columns->items[i]);
  return error;
}

/* ---- rows ---- */

static struct mo_value value_of(const struct mo_column *column, const void *row)
{
  const void *at = (const char *)row + column->offset;
  switch (column->type) {
  case MO_COLUMN_COUNT: return mo_int(*(const uint32_t *)at);
  case MO_COLUMN_LONG: return mo_int((int64_t) * (const uint64_t *)at);
  case MO_COLUMN_TIME: return mo_int(*(const int64_t *)at);
  case MO_COLUMN_NUMBER: return mo_real(*(const double *)at);
  default: return mo_int(*(const bool *)at);
  }
}

static void read_row(sqlite3_stmt *statement, const struct table *table, void *row)
{
  for (size_t i = 0; i < table->columns->n + table->columns->n_stored; i++) {
    const int64_t integer = sqlite3_column_int64(statement, (int)i);
    void *at = (char *)row + table->columns->items[i].offset;
    switch (table->columns->items[i].type) {
    case MO_COLUMN_COUNT: *(uint32_t *)at = (uint32_t)integer; break;
    case MO_COLUMN_LONG: *(uint64_t *)at = (uint64_t)integer; break;
    case MO_COLUMN_TIME: *(int64_t *)at = integer; break;
    case MO_COLUMN_NUMBER: *(double *)at = mo_column_number(statement, (int)i); break;
    default: *(bool *)at = integer != 0; break;
    }
  }
}

int mo_row_write(struct mo_connection *writer, enum mo_row_table which, int64_t id, const void *row)
{
  const struct mo_columns *columns = tables[which].columns;
  const size_t n = columns->n + columns->n_stored;
  struct mo_value values[COLUMNS_MAX] = {mo_int(id)};
  for (size_t i = 0; i < n; i++)
    values[i + 1] = value_of(&columns->items[i], row);
  return mo_sql_do_with(writer, statement_of(which, WRITE), (struct mo_values){values, (int)n + 1});
}

int mo_row_newest(struct mo_connection *reader, enum mo_row_table which, int64_t id, void *row,
                  bool *found)
{
  sqlite3_stmt *statement;
  const int error = mo_sql_row(reader, &statement, statement_of(which, NEWEST), mo_int(id));
  *found = error == MO_OK;
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_OK : error;
  read_row(statement, &tables[which], row);
  return MO_OK;
}

/* ---- pages ---- */

static int64_t read_page(struct mo_store *store, enum mo_row_table which, int statement,
                         struct mo_values values, void *rows)
{
  const struct table *table = &tables[which];
  char *at = rows;
  int64_t n = 0;
  int error = MO_OK;
  if (values.at[values.n - 1].integer > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row = mo_sql_rows_with(reader, &error, statement_of(which, statement), values);
  for (; mo_sql_next(reader, row, &error); n++, at += table->size)
    read_row(row, table, at);
  return error != MO_OK ? error : n;
}

/* Reads the rows after `after`, or only multiples of `stride`. */
static int64_t read_curve(struct mo_store *store, enum mo_row_table which, int64_t id,
                          int64_t after, uint32_t stride, void *rows, size_t limit)
{
  const struct mo_value last = mo_int((int64_t)limit);
  const int64_t before_first = after < 0 ? -(int64_t)stride : after; /* 0 is also a multiple */
  return stride > 1
             ? read_page(store, which, STRIDE,
                         MO_VALUES(mo_int(id), mo_int(before_first), mo_int(stride), last), rows)
             : read_page(store, which, AFTER, MO_VALUES(mo_int(id), mo_int(after), last), rows);
}

int64_t mo_store_training_steps(struct mo_store *store, int64_t id, uint32_t after, uint32_t stride,
                                struct mo_training_step_row *rows, size_t limit)
{
  return read_curve(store, MO_TRAINING_STEPS, id, after, stride, rows, limit);
}

int64_t mo_store_training_validations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_training_validation_row *rows, size_t limit)
{
  return read_curve(store, MO_TRAINING_VALIDATIONS, id, after, 1, rows, limit);
}

int64_t mo_store_campaign_generations(struct mo_store *store, int64_t id, int64_t after,
                                      uint32_t stride, struct mo_campaign_generation *rows,
                                      size_t limit)
{
  return read_curve(store, MO_CAMPAIGN_GENERATIONS, id, after, stride, rows, limit);
}

int64_t mo_store_campaign_steps(struct mo_store *store, int64_t id, int64_t after_generation,
                                uint32_t after_step, struct mo_campaign_step *rows, size_t limit)
{
  return read_page(
      store, MO_CAMPAIGN_STEPS, AFTER,
      MO_VALUES(mo_int(id), mo_int(after_generation), mo_int(after_step), mo_int((int64_t)limit)),
      rows);
}
