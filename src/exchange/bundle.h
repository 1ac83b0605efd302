/* bundle.h: bundles, files that carry campaigns between services (docs/bundles.md). */
#ifndef MORPHO_EXCHANGE_BUNDLE_H
#define MORPHO_EXCHANGE_BUNDLE_H

#include "exchange/archive.h"
#include "exchange/bundle_lines.h"
#include "store/imports.h"

#define MO_BUNDLE_VERSION  2
#define MO_BUNDLE_ROLLOUTS 40000 /* recorded; up to MO_CHANNELS members each */
/* Sizes of parts: the number of designs, of designs with scores, or of steps; and the size in bytes
 * at which a part of generations gets no more lines. */
#define MO_BUNDLE_PART_ROWS  1000
#define MO_BUNDLE_PART_BYTES 1000000

/* ---- recordings (bundle_recordings.c): an evaluation, then an array for each of its designs,
 * environments and channels, in this order ---- */

struct mo_bundle_recordings {
  struct mo_imported_evaluation evaluation;
  uint32_t n;      /* evaluations so far, including this one */
  uint32_t frames; /* of each rollout */
  /* The next array. channel 0: the evaluation is complete, or none has begun. */
  uint32_t place, environment;
  unsigned channel;
  uint32_t n_masses, n_springs;  /* of its design */
  struct mo_recording recording; /* the arrays of its rollout so far */
};
/* Writes the name of the next member, without the folder of the campaign. */
void mo_bundle_recordings_name(const struct mo_bundle_recordings *recordings,
                               char name[MO_ARCHIVE_NAME_BYTES]);
/* Begins an evaluation. */
void mo_bundle_recordings_begin(struct mo_bundle_recordings *recordings,
                                const struct mo_physics *physics);
/* Moves past the array. Returns 1 if it was the last one of its rollout. */
int mo_bundle_recordings_next(struct mo_bundle_recordings *recordings);
/* Write the array, or read it into the recording. MO_ERR_FORMAT: not the expected array. */
int mo_bundle_write_array(struct mo_text *text, const struct mo_bundle_recordings *recordings,
                          const struct mo_recording *recording);
int mo_bundle_read_array(struct mo_bundle_recordings *recordings, const char *bytes, size_t size);

/* ---- whole bundles (bundle_read.c) ---- */

/* Receives the content in order. Any function may be NULL. An error stops the reading. */
struct mo_bundle_sink {
  void *context;
  int (*controller)(void *context, const struct mo_controller *controller,
                    const struct mo_sha256 *sha256, const char *bytes, size_t size);
  /* Returns 1 to receive the rest of the campaign, 0 to skip it. */
  int (*campaign)(void *context, const struct mo_imported_campaign *campaign);
  int (*design)(void *context, const struct mo_campaign_design *design);
  int (*generation)(void *context, const struct mo_campaign_generation *row,
                    const struct mo_descent *births, const struct mo_campaign_member *members,
                    uint32_t n);
  /* After its generation. */
  int (*held_out)(void *context, const struct mo_re_evaluated *result);
  int (*step)(void *context, const struct mo_campaign_step *step);
  int (*score)(void *context, const struct mo_campaign_score *score);
  /* Returns 1 to receive the rollouts, 0 to skip them. */
  int (*evaluation)(void *context, const struct mo_imported_evaluation *evaluation);
  int (*rollout)(void *context, const struct mo_saved_trajectory *rollout);
  bool (*is_over)(void *context); /* whether to stop early, with MO_ERR_CANCELLED */
};
struct mo_bundle_campaign {
  struct mo_import_source source;
  uint64_t n_designs, n_scores;
  uint32_t n_recordings; /* evaluations with recordings */
  int64_t generation;
  bool has_result;
  struct mo_sha256 result_sha256;
};
struct mo_bundle_summary {
  uint32_t n, n_controllers;
  struct mo_bundle_campaign campaigns[MO_BUNDLE_CAMPAIGNS];
};
/* Reads a bundle in memory and checks all of it: every hash, every line, and that the lines of a
 * campaign agree with each other. known: the summary of an earlier read, which has the digests of
 * the sources; single lines are then not checked again. If it is NULL, the digests are zero.
 * MO_ERR_FORMAT: the message says what is wrong. */
int mo_bundle_read(const void *bytes, size_t size, const struct mo_lattice *lattice,
                   const struct mo_bundle_sink *sink, const struct mo_bundle_summary *known,
                   struct mo_bundle_summary *summary, struct mo_message *message);

/* ---- export (bundle_export.c) ---- */

struct mo_bundle_export;
/* ids: (n) ascending; takes ownership. Returns NULL if memory runs out. */
struct mo_bundle_export *mo_bundle_export_create(struct mo_store *store, const char *program,
                                                 int64_t *ids, uint32_t n, bool with_recordings);
int mo_bundle_export_more(void *context, struct mo_text *text); /* of type mo_download_more */
void mo_bundle_export_free(void *context);
/* Describes a stored campaign in the same way as its bundle. MO_ERR_CONFLICT: it has not ended. */
int mo_bundle_describe(struct mo_store *store, int64_t id, struct mo_campaign_status *status,
                       struct mo_imported_campaign *campaign);
/* Computes the digest that a bundle of the campaign would have. is_over (nullable): as above. */
int mo_bundle_digest(struct mo_store *store, int64_t id, bool (*is_over)(void *context),
                     void *context, struct mo_sha256 *digest);

#endif
