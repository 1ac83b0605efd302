/* kinds.h: settings that have a kind, such as the selection: a word, or an object with `kind` and
 * the settings of this kind. */
#ifndef MORPHO_EVOLUTION_KINDS_H
#define MORPHO_EVOLUTION_KINDS_H

#include "base/fields.h"

#define MO_KIND_ROWS_MAX 8

/* Rows that belong to one kind, or to several kinds. */
struct mo_kind_rows {
  size_t from, n;
};
struct mo_kinds {
  const char *const *words;       /* names of the kinds; NULL after the last */
  const char *noun;               /* in messages, before the name of a kind: "selection by" */
  struct mo_fields fields;        /* the first row is `kind`; at most MO_KIND_ROWS_MAX */
  const struct mo_kind_rows *own; /* by kind: its rows in addition to `kind` */
};

/* Reads a value of any JSON type into `value`, the struct of the fields. Returns false after a
 * fault, or if the reading ended; `value` may then have some of the members. */
bool mo_kinds_read(struct mo_json *json, const struct mo_kinds *kinds, void *value);
/* Writes an object with `kind` and the settings of this kind. */
void mo_kinds_write(struct mo_text *text, const struct mo_kinds *kinds, const void *value);

#endif
