/* table.h: makes text from JSON with templates, and tables for people; shows progress on standard
 * error.
 *
 * "{place}" stands for the value at a place in the JSON, such as {progress.step}, and
 * "{place:form}" for the value in a format:
 *   (none)        a text or a whole number as it is
 *   ,             a count: 1,234
 *   .4f .4g g     a number, as printf writes it
 *   .1%           a share in percent: 12.5 %
 *   .12           the first 12 bytes of a text
 *   #             how many items an array has
 *   s             an s, unless an array has one item
 *   time          a time of RFC 3339 as local time: 2026-11-21 13:15:02
 *   duration      seconds: 0:12:34, or 3 d 04:05
 *   GiB, MB       bytes
 *   -             nothing: only a condition
 * "{part/whole:%}" is the share of two counts in whole percent, rounded down: 99 %.
 *
 * "[a|b|…]" is the first part whose values all exist, or nothing. A value exists if it is a number,
 * a boolean or a text that is not empty. {place>0} exists only above 0, {place!=word} only if it is
 * another word or number. {place=word}, and {!place} for a missing value, are only conditions.
 * Outside brackets a missing value is "", 0 for a count, and a dash for other numbers and times. */
#ifndef MORPHOCTL_TABLE_H
#define MORPHOCTL_TABLE_H

#include <jansson.h>

#include "ctl.h"

/* Writes a template up to its end or to a "|" outside brackets, and returns that position. Texts
 * are made plain (plain.c). */
const char *fill_template(FILE *file, const json_t *json, const char *template);
/* Returns the filled template (malloc). */
char *text_from(const json_t *json, const char *template);
/* Prints the filled template as a line. */
void print_from(FILE *file, const json_t *json, const char *template);

const json_t *value_at(const json_t *json, const char *place); /* NULL if none */
/* Writes a count as "1,234,567". */
const char *count_text(int64_t n, char text[32]);

/* Prints a table with a row for each item of an array. columns: "head=template|>head=template|…"; a
 * leading > aligns to the right. Cells are never cut, because people copy ids. */
void print_table(FILE *file, const struct ctl *ctl, const json_t *items, const char *columns);

/* Returns the columns that a text occupies on a terminal (UTF-8; one per code point). */
size_t text_width(const char *text);

/* Shows progress in place on standard error: "  1,234 of 10,000 rollouts [#####     ]  12 %  456/s
 * 0:21 left". what: "rollouts". */
void progress_show(const struct ctl *ctl, const char *state, int64_t done, int64_t total,
                   const char *what);
double monotonic_s(void);

#endif
