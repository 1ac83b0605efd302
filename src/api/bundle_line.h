/* bundle_line.h: what the readers and writers of lines share. Only for bundle_lines.c,
 * bundle_heads.c and score_blocks.c. */
#ifndef MORPHO_API_BUNDLE_LINE_H
#define MORPHO_API_BUNDLE_LINE_H

#include "api/bundle.h"
#include "base/json.h"

struct mo_bundle_lines {
  const struct mo_lattice *lattice;
  bool is_checked; /* the lines were read before, and need not be compared */
  struct mo_faults faults;
  struct mo_text again; /* the line, written again */
  struct mo_json json;
};

/* ---- writing ---- */

void mo_line_whole(struct mo_text *text, const char *name, int64_t number);
void mo_line_counts(struct mo_text *text, const char *name, const uint32_t *numbers, uint32_t n);

/* ---- reading ---- */

struct mo_json *mo_line_begin(struct mo_bundle_lines *lines, const char *line, size_t size);
/* Tells the first fault of what was read. */
int mo_line_end(struct mo_bundle_lines *lines, struct mo_message *message);
/* Compares the line with what was written again. */
int mo_line_compare(struct mo_bundle_lines *lines, const char *line, size_t size,
                    struct mo_message *message);

/* Says what is wrong with the value that was read. */
void mo_line_refuse(struct mo_json *json, const char *words);
/* Read one value; those that are refused leave theirs as it is. */
void mo_line_u32(struct mo_json *json, int64_t max, uint32_t *value);
void mo_line_text(struct mo_json *json, char *text, size_t size);
void mo_line_word(struct mo_json *json, const char *const *words, int *word);
/* Reads up to `room` numbers, and counts all. */
void mo_line_u32s(struct mo_json *json, int64_t max, uint32_t *numbers, uint32_t room, uint32_t *n);
void mo_line_hash(struct mo_json *json, struct mo_sha256 *sha256);
/* Reads a genotype that is placed as bodies are scored. */
void mo_line_genotype(struct mo_json *json, struct mo_bits *genotype);
bool mo_line_is_printable(const char *text);

#endif
