/* sql.h: a connection with its prepared statements, and short forms for the usual queries. Only for
 * this room. */
#ifndef MORPHO_STORE_SQL_H
#define MORPHO_STORE_SQL_H

#include <sqlite3.h>

#include "store/encode.h"

/* More than the number of statements in this room, because a connection keeps every statement that
 * it has used; tests/lint/rooms.py counts them. */
#define MO_STATEMENTS_MAX 512

struct mo_store;

/* A database handle with its prepared statements, used by one thread at a time. */
struct mo_connection {
  sqlite3 *db;
  struct {
    const char *sql;
    sqlite3_stmt *statement;
  } cache[MO_STATEMENTS_MAX];
  unsigned n_cached;
  bool busy;
  struct mo_store *store; /* of a reader */
  int error;              /* error of the start of its transaction; all statements return it */
};

/* Call mo_mapping_init before the first connection. mo_mapping_error translates the error of this
 * thread's last mapping (mapping.c). */
void mo_mapping_init(void);
int mo_mapping_error(void);
int mo_connection_open(const struct mo_store *store, bool writable,
                       struct mo_connection *connection);
void mo_connection_close(struct mo_connection *connection);

/* ---- statements with their values ---- */

/* The value of a parameter. Text and bytes must outlive the query. */
struct mo_value {
  int type; /* SQLITE_INTEGER … SQLITE_NULL */
  int64_t integer;
  double real;
  const void *bytes;
  size_t size;
};
struct mo_value mo_null(void);
struct mo_value mo_int(int64_t value);
struct mo_value mo_real(double value);
struct mo_value mo_string(const char *text);             /* NULL: NULL */
struct mo_value mo_blob(const void *bytes, size_t size); /* NULL: NULL */
struct mo_value mo_hash(const struct mo_sha256 *hash);
struct mo_values {
  const struct mo_value *at;
  int n;
};
#define MO_VALUES(...)                                                                             \
  ((struct mo_values){(const struct mo_value[]){__VA_ARGS__},                                      \
                      sizeof((const struct mo_value[]){__VA_ARGS__}) / sizeof(struct mo_value)})

/* Each of these prepares a string literal (once: it is looked up by its address), binds the values
 * to ?1, ?2 … and runs it. A row can be read until its statement runs again, or until
 * mo_sql_reset. */
#define mo_sql_do(connection, sql, ...) mo_sql_do_with(connection, sql, MO_VALUES(__VA_ARGS__))
int mo_sql_do_with(struct mo_connection *connection, const char *sql, struct mo_values values);
/* MO_ERR_CONFLICT: it changed nothing. */
#define mo_sql_change(connection, sql, ...)                                                        \
  mo_sql_change_with(connection, sql, MO_VALUES(__VA_ARGS__))
int mo_sql_change_with(struct mo_connection *connection, const char *sql, struct mo_values values);
/* Inserts a row and returns its id in *row. */
#define mo_sql_insert(connection, row, sql, ...)                                                   \
  mo_sql_insert_with(connection, row, sql, MO_VALUES(__VA_ARGS__))
int mo_sql_insert_with(struct mo_connection *connection, int64_t *row, const char *sql,
                       struct mo_values values);
/* Steps to the first row. MO_ERR_NOT_FOUND: no rows. */
#define mo_sql_row(connection, row, sql, ...)                                                      \
  mo_sql_row_with(connection, row, sql, MO_VALUES(__VA_ARGS__))
int mo_sql_row_with(struct mo_connection *connection, sqlite3_stmt **row, const char *sql,
                    struct mo_values values);
/* Reads the integer in the first row. MO_ERR_NOT_FOUND: no rows. */
#define mo_sql_find(connection, value, sql, ...)                                                   \
  mo_sql_find_with(connection, value, sql, MO_VALUES(__VA_ARGS__))
int mo_sql_find_with(struct mo_connection *connection, int64_t *value, const char *sql,
                     struct mo_values values);
/* Returns a statement for mo_sql_next to read rows one by one, until no row is left or *error is
 * not MO_OK. Neither does anything if *error is already set. */
#define mo_sql_rows(connection, error, sql, ...)                                                   \
  mo_sql_rows_with(connection, error, sql, MO_VALUES(__VA_ARGS__))
sqlite3_stmt *mo_sql_rows_with(struct mo_connection *connection, int *error, const char *sql,
                               struct mo_values values);
bool mo_sql_next(struct mo_connection *connection, sqlite3_stmt *row, int *error);
/* Ends all row reading. */
void mo_sql_reset(struct mo_connection *connection);
int mo_sql_exec(struct mo_connection *connection, const char *sql);
/* Translates SQLite's result code into an MO_ERR_ code. */
int mo_sql_error(sqlite3 *db, int code);

/* ---- columns ---- */

/* Returns why a required value of a column is missing: MO_ERR_CORRUPT or MO_ERR_NO_MEMORY. */
int mo_column_missing(sqlite3_stmt *statement);
/* Each reads a column and checks it: MO_ERR_CORRUPT. */
int mo_column_hash(sqlite3_stmt *statement, int column, struct mo_sha256 *hash);
int mo_column_genotype(sqlite3_stmt *statement, int column, struct mo_genotype *genotype);
/* Reads a genotype and its design's form, and checks that one is an orientation of the other, so
 * that a damaged body is never mistaken for the scored one. */
int mo_column_design(sqlite3_stmt *statement, int genotype_column, int form_column,
                     struct mo_genotype *genotype, struct mo_genotype *form);
/* Reads the same for a list of designs. form: nullable. */
int mo_column_listed(sqlite3_stmt *statement, int genotype_column, int form_column,
                     struct mo_bits *genotype, struct mo_bits *form);
/* Reads an environment and checks its hash. */
int mo_column_environment(sqlite3_stmt *statement, int data, int sha256,
                          struct mo_environment *environment);
/* Reads the environment of a row, and its hash (nullable). */
int mo_environment_get(struct mo_connection *connection, int64_t id,
                       struct mo_environment *environment, struct mo_sha256 *sha256);
int mo_column_physics(sqlite3_stmt *statement, int column, struct mo_physics *physics,
                      enum mo_precision *precision, enum mo_sensor *sensor);
int mo_column_double(sqlite3_stmt *statement, int column, double *value); /* 8-byte BLOB */
double mo_column_number(sqlite3_stmt *statement, int column);             /* NaN: NULL */
uint32_t mo_column_u32(sqlite3_stmt *statement, int column);
void mo_column_text(sqlite3_stmt *statement, int column, char *text, size_t size);

#endif
