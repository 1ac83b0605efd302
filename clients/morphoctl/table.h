/* table.h: tables for people, and progress on standard error. */
#ifndef MORPHOCTL_TABLE_H
#define MORPHOCTL_TABLE_H

#include <jansson.h>

#include "ctl.h"

/* Prints a table with a row for each item of an array. columns: "head=template|>head=template|…",
 * see template.h; a leading > aligns to the right. Cells are never cut: people copy ids. */
void print_table(FILE *file, const struct ctl *ctl, const json_t *items, const char *columns);

/* Returns the columns that a text takes on a terminal (UTF-8; one per code point). */
size_t text_width(const char *text);

/* Shows progress in place on standard error: "  1,234 of 10,000 rollouts [#####     ]  12 %  456/s
 * 0:21 left". */
void progress_show(const struct ctl *ctl, const char *state, int64_t done, int64_t total);
void progress_end(void);
double monotonic_s(void);

#endif
