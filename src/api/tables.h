/* tables.h: lists and curves in formats for table software: CSV, lines of JSON, and columns (arrays
 * after a header, as in a scene). */
#ifndef MORPHO_API_TABLES_H
#define MORPHO_API_TABLES_H

#include <stdbool.h>

#include "store/columns.h"

struct mo_request;

enum mo_form { MO_FORM_JSON, MO_FORM_CSV, MO_FORM_NDJSON, MO_FORM_COLUMNS };

/* Reads the format of a reply from `format` and Accept. Returns false if it has replied. */
bool mo_table_form(struct mo_request *request, int *form);

/* Replies with a list in a format other than JSON: everything after `cursor`, or `limit` rows.
 * Calls `page`, which replies with a page of the list as JSON, as often as needed. columns: the
 * columns of CSV and of `columns`, separated by blanks. Each is the path of a value in an item,
 * such as "error.code" or "light_xy_m.0". A colon and the type may follow: ":n" is a number; ":d"
 * and ":g" are an id and a genotype, which are preceded by this letter in CSV so that no program
 * mistakes their digits for a number; ":u" and ":l" are whole numbers of 32 and 64 bits. rows
 * (nullable): further columns, of rows of numbers. */
void mo_table_reply(struct mo_request *request, enum mo_form form,
                    void (*page)(struct mo_request *request), const char *columns,
                    const struct mo_columns *rows);

#endif
