/* table.h: tables, numbers, times and progress for people. */
#ifndef MORPHOCTL_TABLE_H
#define MORPHOCTL_TABLE_H

#include <jansson.h>

#include "ctl.h"

#define COLUMNS_MAX 16

struct table {
  const char *heads[COLUMNS_MAX];
  bool right[COLUMNS_MAX]; /* for numbers */
  size_t n_columns;
  char **cells; /* (n_rows, n_columns) */
  size_t n_rows, capacity;
  bool failed; /* memory ran out */
};

/* Starts a table. heads: "#|design|>score": columns are separated by |, and a leading > aligns to
 * the right. heads must outlive the table. */
void table_open(struct table *table, const char *heads);
/* Adds a row of n_columns texts (NULL: "–"), made plain. */
void table_add(struct table *table, const char *const *cells);
/* Removes a column. */
void table_drop(struct table *table, size_t column);
/* Prints and frees the table. Cells are never cut: people copy ids. */
void table_print(struct table *table, FILE *file, const struct ctl *ctl);

/* Returns the columns that a text takes on a terminal (UTF-8; one per code point). */
size_t text_width(const char *text);

/* Writes a score with four digits, "–" for null. */
const char *score_text(const json_t *score, char text[32]);
/* Writes a time in RFC 3339 as local time, "2026-11-21 13:15:02"; an invalid time is returned as it
 * is; "–" for null. */
const char *time_text(const json_t *time, char text[32]);
/* Writes a count as "1,234,567". */
const char *count_text(int64_t n, char text[32]);

/* Shows progress in place on standard error: "  1,234 of 10,000 rollouts [#####     ]  12 %  456/s
 * 0:21 left". */
struct progress {
  bool shown;
  double begin_s, last_s;
  int64_t first_done;
};
void progress_show(struct progress *progress, const struct ctl *ctl, const char *state,
                   int64_t done, int64_t total);
void progress_end(struct progress *progress);
double monotonic_s(void);

#endif
