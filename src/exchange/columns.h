/* columns.h: rows of numbers as JSON, written according to their list of columns
 * (store/columns.h). */
#ifndef MORPHO_EXCHANGE_COLUMNS_H
#define MORPHO_EXCHANGE_COLUMNS_H

#include "base/text.h"
#include "store/columns.h"

/* Writes the row as an object, or null if `row` is NULL. */
void mo_columns_json(struct mo_text *text, const struct mo_columns *columns, const void *row);
/* Writes only the members of this object. */
void mo_columns_members(struct mo_text *text, const struct mo_columns *columns, const void *row);

#endif
