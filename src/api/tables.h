/* tables.h: lists and curves in the forms that programs for tables read: CSV, lines of JSON, and
 * columns (arrays behind a header, as in a scene). */
#ifndef MORPHO_API_TABLES_H
#define MORPHO_API_TABLES_H

#include <stdbool.h>

#include "store/columns.h"

struct mo_request;

enum mo_form { MO_FORM_JSON, MO_FORM_CSV, MO_FORM_NDJSON, MO_FORM_COLUMNS };

/* Reads the form of a reply from `format` and Accept. False: the reply is made. */
bool mo_table_form(struct mo_request *request, int *form);

/* Replies with a list in another form than JSON: all of it from `cursor` on, or `limit` rows. Calls
 * `page`, which replies with a page of the list as JSON, as often as it takes. columns: the columns
 * of CSV and of `columns`, separated by blanks: each the path of a value in an item, "error.code"
 * or "light_xy_m.0", and perhaps a colon with what it is: ":n" a number, ":d" or ":g" an id or a
 * genotype, which get this letter in CSV, so that nothing takes their digits for a number; ":u" and
 * ":l" are whole numbers of 32 and 64 bits. rows (nullable): further columns, of rows of numbers.
 */
void mo_table_reply(struct mo_request *request, enum mo_form form,
                    void (*page)(struct mo_request *request), const char *columns,
                    const struct mo_columns *rows);

#endif
