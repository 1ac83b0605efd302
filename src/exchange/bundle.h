/* bundle.h: bundles: campaigns that travel between services, in the form of docs/bundles.md. */
#ifndef MORPHO_EXCHANGE_BUNDLE_H
#define MORPHO_EXCHANGE_BUNDLE_H

#include "base/fields.h"
#include "exchange/archive.h"
#include "store/imports.h"

#define MO_BUNDLE_VERSION   2
#define MO_BUNDLE_CAMPAIGNS MO_REPLICATES_MAX /* of one bundle */
#define MO_BUNDLE_ROLLOUTS  40000             /* recorded; each has up to MO_CHANNELS members */
/* What fills a part: designs, also those whose scores it has, and steps; bytes of generations,
 * after which it has no further line. */
#define MO_BUNDLE_PART_ROWS  1000
#define MO_BUNDLE_PART_BYTES 1000000

/* ---- lines (bundle_lines.c, bundle_heads.c) ---- */

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
void mo_bundle_write_generation(struct mo_text *text, const struct mo_campaign_generation *row,
                                const struct mo_campaign_member *members, uint32_t n);
void mo_bundle_write_score(struct mo_text *text, const struct mo_campaign_score *score);
void mo_bundle_write_step(struct mo_text *text, const struct mo_campaign_step *step);

struct mo_bundle_lines; /* reads them */
/* is_checked: the same lines were read before. */
struct mo_bundle_lines *mo_bundle_lines_create(const struct mo_lattice *lattice, bool is_checked);
void mo_bundle_lines_free(struct mo_bundle_lines *lines); /* NULL-safe */
/* Read one line, which a NUL ends. Each line must be the one that the function above writes of what
 * was read, or the table. MO_ERR_FORMAT: it is not; MO_ERR_NO_MEMORY. */
int mo_bundle_read_head(struct mo_bundle_lines *lines, const char *line, size_t size,
                        struct mo_bundle_head *head, struct mo_message *message);
int mo_bundle_read_campaign(struct mo_bundle_lines *lines, const char *line, size_t size,
                            struct mo_imported_campaign *campaign, struct mo_message *message);
int mo_bundle_read_environment(struct mo_bundle_lines *lines, const char *line, size_t size,
                               struct mo_environment *environment, struct mo_message *message);
int mo_bundle_read_design(struct mo_bundle_lines *lines, const char *line, size_t size,
                          struct mo_campaign_design *design, struct mo_message *message);
/* members: room for `room`; *n: how many there are. */
int mo_bundle_read_generation(struct mo_bundle_lines *lines, const char *line, size_t size,
                              struct mo_campaign_generation *row,
                              struct mo_campaign_member *members, uint32_t room, uint32_t *n,
                              struct mo_message *message);
int mo_bundle_read_step(struct mo_bundle_lines *lines, const char *line, size_t size,
                        struct mo_campaign_step *step, struct mo_message *message);
int mo_bundle_read_score(struct mo_bundle_lines *lines, const char *line, size_t size,
                         struct mo_campaign_score *score, struct mo_message *message);
int mo_bundle_read_evaluation(struct mo_bundle_lines *lines, const char *line, size_t size,
                              struct mo_imported_evaluation *evaluation,
                              struct mo_message *message);
/* Adds to the digest of a campaign what tells it from others that have no generation either. */
void mo_bundle_digest_source(struct mo_text *digest, const struct mo_import_source *source,
                             int64_t created_us);
/* A controller's file as a member: its content (MO_ERR_FORMAT), and its name. */
int mo_bundle_read_weights(const struct mo_archive_member *member,
                           struct mo_controller **controller, struct mo_message *message);
void mo_bundle_weights_name(const struct mo_sha256 *sha256, char name[MO_ARCHIVE_NAME_BYTES]);

/* ---- recordings (bundle_recordings.c): an evaluation, then an array for each of its designs,
 * environments and channels, in this order ---- */

struct mo_bundle_recordings {
  struct mo_imported_evaluation evaluation;
  uint32_t n;      /* evaluations so far, with this one */
  uint32_t frames; /* of each rollout */
  /* The array that comes next. channel 0: the evaluation is whole, or there is none. */
  uint32_t place, environment;
  unsigned channel;
  uint32_t n_masses, n_springs;  /* of its design */
  struct mo_recording recording; /* the arrays of its rollout so far */
};
/* The name of the member that comes next, behind the folder of the campaign. */
void mo_bundle_recordings_name(const struct mo_bundle_recordings *recordings,
                               char name[MO_ARCHIVE_NAME_BYTES]);
/* Begins an evaluation. */
void mo_bundle_recordings_begin(struct mo_bundle_recordings *recordings,
                                const struct mo_physics *physics);
/* Goes on behind the array. Returns 1 where it was the last of its rollout. */
int mo_bundle_recordings_next(struct mo_bundle_recordings *recordings);
/* Writes the array, or reads it into the recording. MO_ERR_FORMAT: it is none, or another one. */
int mo_bundle_write_array(struct mo_text *text, const struct mo_bundle_recordings *recordings,
                          const struct mo_recording *recording);
int mo_bundle_read_array(struct mo_bundle_recordings *recordings, const char *bytes, size_t size);

/* ---- whole bundles (bundle_read.c) ---- */

/* What takes the content, in its order. Any function may be NULL. An error ends the reading. */
struct mo_bundle_sink {
  void *context;
  int (*controller)(void *context, const struct mo_controller *controller,
                    const struct mo_sha256 *sha256, const char *bytes, size_t size);
  /* Returns 1 to take what follows of the campaign, 0 to skip it. */
  int (*campaign)(void *context, const struct mo_imported_campaign *campaign);
  int (*design)(void *context, const struct mo_campaign_design *design);
  int (*generation)(void *context, const struct mo_campaign_generation *row,
                    const struct mo_descent *births, const struct mo_campaign_member *members,
                    uint32_t n);
  int (*step)(void *context, const struct mo_campaign_step *step);
  int (*score)(void *context, const struct mo_campaign_score *score);
  /* Returns 1 to take the rollouts, 0 to skip them. */
  int (*evaluation)(void *context, const struct mo_imported_evaluation *evaluation);
  int (*rollout)(void *context, const struct mo_saved_trajectory *rollout);
  bool (*is_over)(void *context); /* whether to end early, with MO_ERR_CANCELLED */
};
struct mo_bundle_campaign {
  struct mo_import_source source;
  uint64_t n_designs, n_scores;
  uint32_t n_recordings; /* evaluations that recorded */
  int64_t generation;
  bool has_result;
  struct mo_sha256 result_sha256;
};
struct mo_bundle_summary {
  uint32_t n, n_controllers;
  struct mo_bundle_campaign campaigns[MO_BUNDLE_CAMPAIGNS];
};
/* Reads a bundle in memory and checks all of it: every hash, every line, and that the lines of a
 * campaign agree with each other. known: the summary of an earlier reading, from which the digests
 * of the sources come; what it checked of single lines is not checked again. NULL: they are zero.
 * MO_ERR_FORMAT: the message says what is wrong. */
int mo_bundle_read(const void *bytes, size_t size, const struct mo_lattice *lattice,
                   const struct mo_bundle_sink *sink, const struct mo_bundle_summary *known,
                   struct mo_bundle_summary *summary, struct mo_message *message);

/* ---- making one (bundle_export.c) ---- */

struct mo_bundle_export;
/* ids: (n) ascending, taken over. NULL: no memory. */
struct mo_bundle_export *mo_bundle_export_create(struct mo_store *store, const char *program,
                                                 int64_t *ids, uint32_t n, bool with_recordings);
int mo_bundle_export_more(void *context, struct mo_text *text); /* a mo_download_more */
void mo_bundle_export_free(void *context);
/* Describes a stored campaign as its bundle would. MO_ERR_CONFLICT: it has not ended. */
int mo_bundle_describe(struct mo_store *store, int64_t id, struct mo_campaign_status *status,
                       struct mo_imported_campaign *campaign);
/* Computes the digest that a bundle of the campaign would have. is_over (nullable): as above. */
int mo_bundle_digest(struct mo_store *store, int64_t id, bool (*is_over)(void *context),
                     void *context, struct mo_sha256 *digest);

#endif
