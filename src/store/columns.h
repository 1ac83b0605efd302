/* columns.h: rows of numbers as tables. Each line defines one column: its place in the JSON object,
 * its name in CSV and in the database, its type, and its offset in the row's struct. JSON, CSV and
 * the tables of the database are all made from the same list. */
#ifndef MORPHO_STORE_COLUMNS_H
#define MORPHO_STORE_COLUMNS_H

#include <stddef.h>

enum mo_column_type {
  MO_COLUMN_COUNT,  /* uint32_t */
  MO_COLUMN_LONG,   /* uint64_t */
  MO_COLUMN_NUMBER, /* double; not finite: null, or an empty cell */
  MO_COLUMN_FLAG,   /* bool; 0 or 1 in CSV */
  MO_COLUMN_WORD,   /* bool: one of two words */
  MO_COLUMN_TIME    /* int64_t, only stored */
};

struct mo_column {
  const char *path; /* "score.mean": member mean of the object score. Columns of one object are
                       adjacent */
  enum mo_column_type type;
  size_t offset;
  const char *csv;      /* its name in CSV and in the database; NULL: same as the path */
  const char *words[2]; /* of MO_COLUMN_WORD: the words for false and true */
};

struct mo_columns {
  const struct mo_column *items;
  size_t n, n_stored; /* number of columns, and of the later columns that only the database has */
};
#define MO_COLUMNS(list, stored)                                                                   \
  {                                                                                                \
    list, sizeof(list) / sizeof((list)[0]) - (stored), stored                                      \
  }

/* The minimum, mean and maximum of a number; `at` is the offset of its struct mo_spread. */
#define MO_SPREAD_COLUMNS(name, at)                                                                \
  {name ".least", MO_COLUMN_NUMBER, (at) + offsetof(struct mo_spread, least), name "_least"},      \
      {name ".mean", MO_COLUMN_NUMBER, (at) + offsetof(struct mo_spread, mean), name "_mean"},     \
  {                                                                                                \
    name ".most", MO_COLUMN_NUMBER, (at) + offsetof(struct mo_spread, most), name "_most"          \
  }

static inline const char *mo_column_name(const struct mo_column *column)
{
  return column->csv != NULL ? column->csv : column->path;
}

extern const struct mo_columns mo_step_columns;              /* struct mo_training_step_row */
extern const struct mo_columns mo_validation_columns;        /* struct mo_training_validation_row */
extern const struct mo_columns mo_generation_columns;        /* struct mo_campaign_generation */
extern const struct mo_columns mo_bundle_generation_columns; /* the same, without the columns that
                                                              * bundles lack */
extern const struct mo_columns mo_campaign_step_columns;     /* struct mo_campaign_step */

#endif
