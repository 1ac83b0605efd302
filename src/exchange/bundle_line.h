/* bundle_line.h: shared by the readers and writers of lines. Only for bundle_lines.c,
 * bundle_heads.c and score_blocks.c. */
#ifndef MORPHO_EXCHANGE_BUNDLE_LINE_H
#define MORPHO_EXCHANGE_BUNDLE_LINE_H

#include "base/json.h"
#include "exchange/bundle.h"

struct mo_bundle_lines {
  const struct mo_lattice *lattice;
  bool is_checked; /* the lines were checked before, and need not be compared */
  struct mo_faults faults;
  struct mo_text again; /* the line, rewritten */
  struct mo_json json;
  double measures[MO_BLOCK_LANES][MO_MEASURES]; /* of the newest line with a score */
};

/* ---- members ---- */

/* Skips a member that follows from others. It is compared when the line is rewritten. */
void mo_line_skip(struct mo_json *json, void *value);
extern const struct mo_field_own mo_line_store, /* uint64_t: the id of a store */
    mo_line_genotype;                           /* struct mo_genotype, placed as for scoring */

/* Reads a text. If it is rejected, `text` stays unchanged. */
void mo_line_text(struct mo_json *json, char *text, size_t size);

/* ---- lines ---- */

struct mo_json *mo_line_begin(struct mo_bundle_lines *lines, const char *line, size_t size);
/* Reports the first fault in the line. */
int mo_line_end(struct mo_bundle_lines *lines, struct mo_message *message);
/* Compares the line with its rewritten form. */
int mo_line_compare(struct mo_bundle_lines *lines, const char *line, size_t size,
                    struct mo_message *message);
/* Reads a line into `value`, which holds the defaults, using a table. Then calls `check` (nullable)
 * and compares the line with the line that the table writes. */
int mo_line_read(struct mo_bundle_lines *lines, const char *line, size_t size,
                 const struct mo_fields *fields, void *value,
                 int (*check)(const void *value, struct mo_message *message),
                 struct mo_message *message);

#endif
