/* bundle_lines.h: the lines of bundles, written and read (bundle_lines.c, bundle_heads.c;
 * docs/bundles.md). */
#ifndef MORPHO_EXCHANGE_BUNDLE_LINES_H
#define MORPHO_EXCHANGE_BUNDLE_LINES_H

#include "base/fields.h"
#include "exchange/archive.h"
#include "store/imports.h"

#define MO_BUNDLE_CAMPAIGNS MO_REPLICATES_MAX /* of one bundle */

/* The first member, with its version. */
struct mo_bundle_head {
  char format[16], program[64];
  uint32_t version, n;
  int64_t campaigns[MO_BUNDLE_CAMPAIGNS]; /* (n) ids, ascending */
};
/* Lines of struct mo_bundle_head, mo_imported_campaign and mo_imported_evaluation. */
extern const struct mo_fields mo_bundle_head_fields, mo_bundle_campaign_fields,
    mo_bundle_evaluation_fields;
void mo_bundle_write_design(struct mo_text *text, const struct mo_campaign_design *design);
/* held_out: (n_held_out) results of the re-evaluated generation, by number; they determine
 * row->held_out. */
void mo_bundle_write_generation(struct mo_text *text, const struct mo_campaign_generation *row,
                                const struct mo_campaign_member *members, uint32_t n,
                                const struct mo_re_evaluated *held_out, uint32_t n_held_out);
void mo_bundle_write_score(struct mo_text *text, const struct mo_campaign_score *score);
void mo_bundle_write_step(struct mo_text *text, const struct mo_campaign_step *step);

struct mo_bundle_lines; /* the reader of lines */
/* is_checked: the same lines were read and checked before. */
struct mo_bundle_lines *mo_bundle_lines_create(const struct mo_lattice *lattice, bool is_checked);
void mo_bundle_lines_free(struct mo_bundle_lines *lines); /* NULL-safe */
/* Read one line, which ends with a NUL. The line must equal the line that the function above, or
 * the table, writes for the same values. MO_ERR_FORMAT: it does not; MO_ERR_NO_MEMORY. */
int mo_bundle_read_head(struct mo_bundle_lines *lines, const char *line, size_t size,
                        struct mo_bundle_head *head, struct mo_message *message);
int mo_bundle_read_campaign(struct mo_bundle_lines *lines, const char *line, size_t size,
                            struct mo_imported_campaign *campaign, struct mo_message *message);
int mo_bundle_read_environment(struct mo_bundle_lines *lines, const char *line, size_t size,
                               struct mo_environment *environment, struct mo_message *message);
int mo_bundle_read_design(struct mo_bundle_lines *lines, const char *line, size_t size,
                          struct mo_campaign_design *design, struct mo_message *message);
/* members: (room); *n: the number of members read. held_out: (MO_ELITE_MAX); *n_held_out: likewise.
 * Does not fill in row->held_out. */
int mo_bundle_read_generation(struct mo_bundle_lines *lines, const char *line, size_t size,
                              struct mo_campaign_generation *row,
                              struct mo_campaign_member *members, uint32_t room, uint32_t *n,
                              struct mo_re_evaluated *held_out, uint32_t *n_held_out,
                              struct mo_message *message);
int mo_bundle_read_step(struct mo_bundle_lines *lines, const char *line, size_t size,
                        struct mo_campaign_step *step, struct mo_message *message);
int mo_bundle_read_score(struct mo_bundle_lines *lines, const char *line, size_t size,
                         struct mo_campaign_score *score, struct mo_message *message);
int mo_bundle_read_evaluation(struct mo_bundle_lines *lines, const char *line, size_t size,
                              struct mo_imported_evaluation *evaluation,
                              struct mo_message *message);
/* Adds to the digest of a campaign without generations the values that distinguish it from other
 * such campaigns. */
void mo_bundle_digest_source(struct mo_text *digest, const struct mo_import_source *source,
                             int64_t created_us);
/* A controller's file as a member: read its content (MO_ERR_FORMAT), and make its name. */
int mo_bundle_read_weights(const struct mo_archive_member *member,
                           struct mo_controller **controller, struct mo_message *message);
void mo_bundle_weights_name(const struct mo_sha256 *sha256, char name[MO_ARCHIVE_NAME_BYTES]);

#endif
