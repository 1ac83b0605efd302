/* tables.h: lists and curves in the forms that programs for tables read: CSV, lines of JSON, and
 * columns (arrays behind a header, as in a scene). */
#ifndef MORPHO_API_TABLES_H
#define MORPHO_API_TABLES_H

#include "api/columns.h"

struct mo_request;

enum mo_form { MO_FORM_JSON, MO_FORM_CSV, MO_FORM_NDJSON, MO_FORM_COLUMNS };

/* Reads the form of a reply from `format` and Accept. False: the reply is made. */
bool mo_table_form(struct mo_request *request, int *form);
/* Returns the media type of a form. */
const char *mo_table_type(enum mo_form form);

/* Replies with a list in another form than JSON: all of it from `cursor` on, or `limit` rows. Calls
 * `page`, which replies with a page of the list as JSON, as often as it takes. columns: the columns
 * of CSV and of `columns`, separated by blanks: each the path of a value in an item, "error.code"
 * or "light_xy_m.0", and perhaps a colon with what it is: ":n" a number, ":d" or ":g" an id or a
 * genotype, which get this letter in CSV, so that nothing takes their digits for a number. */
void mo_table_reply(struct mo_request *request, enum mo_form form,
                    void (*page)(struct mo_request *request), const char *columns);

/* ---- columns that are gathered row by row ---- */

#define MO_GATHER_COLUMNS 64
#define MO_GATHER_BYTES   ((size_t)64 << 20) /* of all columns of a reply */
#define MO_GATHER_WORDS   "the columns of this reply would take more than 64 MiB; use csv or ndjson"

struct mo_gathered {
  char name[48];
  const char *type; /* of the numbers: "float64", "uint64", "uint32", "uint8"; NULL: any JSON */
  struct mo_text values;
};
struct mo_gather {
  unsigned n;
  uint32_t n_rows;
  struct mo_gathered columns[MO_GATHER_COLUMNS];
};

/* Adds a column: the path with _ for each dot. */
struct mo_gathered *mo_gather_column(struct mo_gather *gather, const char *path, size_t size,
                                     const char *type);
/* Append a value to a column; every row must append to all of them. */
void mo_gather_number(struct mo_gathered *column, double value);
void mo_gather_json(struct mo_gathered *column, const char *json, size_t size);
/* Adds the columns of a list, and appends a row to them; they are those from `first` on. */
void mo_gather_columns(struct mo_gather *gather, const struct mo_columns *columns);
void mo_gather_row(struct mo_gather *gather, unsigned first, const struct mo_columns *columns,
                   const void *row);
/* Says whether the columns fit in a reply. MO_ERR_LIMIT, MO_ERR_NO_MEMORY. */
int mo_gather_check(const struct mo_gather *gather);
/* Replies with what was gathered, or with the problem of an error, and empties `gather`. */
void mo_gather_reply(struct mo_request *request, int error, struct mo_gather *gather);

#endif
