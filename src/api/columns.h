/* columns.h: rows of numbers as tables. Each column is one line: its place in the JSON object, its
 * name in CSV, its type, and its offset in the row's struct. JSON and CSV are written from the same
 * list. */
#ifndef MORPHO_API_COLUMNS_H
#define MORPHO_API_COLUMNS_H

#include <stddef.h>

#include <morpho/evolution.h>

#include "base/text.h"

enum mo_column_type {
  MO_COLUMN_COUNT,  /* uint32_t */
  MO_COLUMN_LONG,   /* uint64_t */
  MO_COLUMN_NUMBER, /* double; not finite: null, or an empty cell */
  MO_COLUMN_FLAG,   /* bool; 0 or 1 in CSV */
  MO_COLUMN_WORD    /* bool: one of two words */
};

struct mo_column {
  const char *path; /* "score.mean": member mean of the object score. Columns of one object stand
                       together */
  enum mo_column_type type;
  size_t offset;
  const char *csv;      /* NULL: as the path */
  const char *words[2]; /* of a word: false, true */
};

struct mo_columns {
  const struct mo_column *items;
  size_t n;
};

/* Writes the row as an object; NULL: null. */
void mo_columns_json(struct mo_text *text, const struct mo_columns *columns, const void *row);
/* Write a line of CSV, and the heading. */
void mo_columns_csv(struct mo_text *text, const struct mo_columns *columns, const void *row);
void mo_columns_heading(struct mo_text *text, const struct mo_columns *columns);

/* The rows of the curves. */
extern const struct mo_columns mo_step_columns;          /* struct mo_training_step_row */
extern const struct mo_columns mo_validation_columns;    /* struct mo_training_validation_row */
extern const struct mo_columns mo_generation_columns;    /* struct mo_campaign_generation */
extern const struct mo_columns mo_campaign_step_columns; /* struct mo_campaign_step */
extern const struct mo_columns mo_replicate_columns;     /* struct mo_replicate_row */

/* One generation over several campaigns: the least, mean and most of each number over the campaigns
 * in which it is finite. Begin with zeros, add the campaigns, and finish. */
#define MO_REPLICATE_NUMBERS 3 /* mean score, best score, diversity */
struct mo_campaign_generation;
struct mo_replicate_row {
  uint32_t generation, campaigns;
  struct mo_spread spread[MO_REPLICATE_NUMBERS]; /* mean: the sum, until the row is finished */
  uint32_t n[MO_REPLICATE_NUMBERS];
};
void mo_replicate_add(struct mo_replicate_row *row, const struct mo_campaign_generation *of_one);
void mo_replicate_finish(struct mo_replicate_row *row);

#endif
