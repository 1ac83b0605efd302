/* imports.h: campaigns of other stores, imported completely or not at all. The caller has checked
 * the data. Threads and errors as in store.h.
 *
 * An import writes short transactions, so that other writes can run between them. The last
 * transaction makes all of its jobs visible to readers. If the import ends without that one, the
 * rows of its jobs are deleted (deletion.h); controllers, environments, designs and scores stay. */
#ifndef MORPHO_STORE_IMPORTS_H
#define MORPHO_STORE_IMPORTS_H

#include "store/campaign_designs.h"
#include "store/save.h"

struct mo_store;

/* The source of a campaign, or of an evaluation with recordings. */
struct mo_import_source {
  uint64_t store;          /* the id of its store */
  int64_t job;             /* its id there */
  struct mo_sha256 digest; /* digest of a campaign's history, or of an evaluation's source and
                            * times */
};

/* A campaign that has ended. */
struct mo_imported_campaign {
  struct mo_campaign_record record; /* group: its id in the source */
  enum mo_job_state state;          /* succeeded or cancelled */
  bool has_label;
  char label[MO_LABEL_BYTES_MAX + 1];
  char experiment[MO_EXPERIMENT_BYTES_MAX + 1], note[MO_NOTE_BYTES_MAX + 1]; /* "": none */
  double weight;
  enum mo_back_end back_end;
  int64_t created_us, started_us, finished_us;
  int64_t generation; /* the newest; −1: none */
  uint64_t n_designs;
  double diversity_max;
  enum mo_campaign_end end;
  bool has_controller;
  char controller_name[MO_NAME_BYTES_MAX + 8]; /* as requested; "": by hash */
  struct mo_sha256 controller_sha256;
  bool has_result;
  struct mo_sha256 result_sha256;
  struct mo_environment environments[MO_ENVIRONMENTS_MAX]; /* (record.n_environments) */
  struct mo_import_source source;
};

/* The losses of a design in a block of the campaign's environments. */
struct mo_campaign_score {
  uint32_t number;
  char fingerprint[MO_FINGERPRINT_BYTES], origin[MO_ORIGIN_BYTES];
  int64_t computed_us;
  uint32_t n;                            /* ≤ MO_BLOCK_LANES */
  uint32_t environments[MO_BLOCK_LANES]; /* places */
  double losses[MO_BLOCK_LANES];         /* +infinity: diverged */
  uint32_t diverged_steps[MO_BLOCK_LANES];
  /* (n) of a campaign that names measures: all measures; NaN: no value. NULL: none. The reader of
   * the score owns them. */
  double (*measures)[MO_MEASURES];
};

/* An evaluation that recorded designs of a campaign, with its controller, in its environments. */
struct mo_imported_evaluation {
  struct mo_import_source source;
  bool has_label;
  char label[MO_LABEL_BYTES_MAX + 1];
  char experiment[MO_EXPERIMENT_BYTES_MAX + 1], note[MO_NOTE_BYTES_MAX + 1]; /* "": none */
  enum mo_back_end back_end;
  int64_t created_us, started_us, finished_us;
  char controller_name[MO_NAME_BYTES_MAX + 8]; /* as requested; "": by hash */
  char environment_set[MO_NAME_BYTES_MAX + 1]; /* "": listed in the request */
  char fingerprint[MO_FINGERPRINT_BYTES];      /* its class */
  char workers[MO_FINGERPRINT_BYTES]; /* class of bodies that devices left to workers; "": none */
  uint32_t record, stride;            /* channels; steps between two frames */
  uint32_t n_environments, n_designs;
  uint32_t environments[MO_ENVIRONMENTS_MAX]; /* places */
  uint32_t numbers[MO_DESIGNS_MAX];
};

struct mo_campaign_member { /* of a population */
  uint32_t number;
  double score;
};

/* ---- export from a store ---- */

/* Reads the population after a generation, best first: (n) malloc. MO_ERR_NOT_FOUND. */
int mo_store_campaign_members(struct mo_store *store, int64_t id, int64_t generation,
                              struct mo_campaign_member **members, uint32_t *n);
/* Calls `take` for the stored losses of designs from `first` up to `last` under the campaign's
 * controller and physics, in its environments, ordered by design. Stops at an error of `take`. */
int mo_store_campaign_scores(struct mo_store *store, int64_t id, uint32_t first, uint32_t last,
                             int (*take)(void *context, const struct mo_campaign_score *score),
                             void *context);
/* Lists the evaluations that recorded only designs of this campaign, with all of their recordings
 * still stored: (n) malloc, ascending. *rollouts: number of recorded rollouts. */
int mo_store_campaign_recordings(struct mo_store *store, int64_t id, int64_t **evaluations,
                                 uint32_t *n, uint64_t *rollouts);
int mo_store_recorded_evaluation(struct mo_store *store, int64_t campaign, int64_t id,
                                 struct mo_imported_evaluation *evaluation);
/* Finds the campaign that ran here under the id from the source. It may be a different campaign,
 * because ids are reused after a backup is restored. MO_ERR_NOT_FOUND. */
int mo_store_import_own(struct mo_store *store, const struct mo_import_source *source, int64_t *id);
/* Finds the campaign that was imported from a bundle with this digest. MO_ERR_NOT_FOUND. */
int mo_store_import_find(struct mo_store *store, const struct mo_import_source *source,
                         int64_t *id);

/* ---- import into a store ---- */

/* Files of weights are written before their rows; between these calls they are kept. */
void mo_store_import_begin(struct mo_store *store);
void mo_store_import_end(struct mo_store *store);
int mo_store_import_file(struct mo_store *store, const struct mo_sha256 *sha256,
                         const uint8_t *bytes, size_t size);

struct mo_import;
/* Begins an import, for one thread. Waits for another one, at most until is_over(context). */
int mo_import_open(struct mo_store *store, bool (*is_over)(void *context), void *context,
                   struct mo_import **import);
/* Writes what is left, and then shows all jobs of the import in one transaction. */
int mo_import_finish(struct mo_import *import);
/* Frees the import. Without a successful mo_import_finish, its jobs are deleted. */
void mo_import_close(struct mo_import *import);

/* Finds job `own` (0: none) if it exists, else as mo_store_import_find, also among its own jobs. */
int mo_import_find(struct mo_import *import, const struct mo_import_source *source, int64_t own,
                   int64_t *id);
int mo_import_controller(struct mo_import *import, const struct mo_controller *controller,
                         const struct mo_sha256 *sha256, size_t size);
/* Begins a campaign. The calls below belong to it. */
int mo_import_campaign(struct mo_import *import, const struct mo_imported_campaign *campaign,
                       int64_t *id);
/* A row is copied, and may be written by a later call, which then returns the error. births:
 * (row->n_children) operator and parents. MO_ERR_CONFLICT: a different loss is stored for a rollout
 * of design mo_import_conflict(import). A rollout's job and step must be the evaluation's. */
int mo_import_design(struct mo_import *import, const struct mo_campaign_design *design);
int mo_import_generation(struct mo_import *import, const struct mo_campaign_generation *row,
                         const struct mo_descent *births, const struct mo_campaign_member *members,
                         uint32_t n_members);
int mo_import_held_out(struct mo_import *import, const struct mo_re_evaluated *result);
int mo_import_step(struct mo_import *import, const struct mo_campaign_step *step);
int mo_import_score(struct mo_import *import, const struct mo_campaign_score *score);
int mo_import_rollout(struct mo_import *import, const struct mo_saved_trajectory *rollout);
/* Writes the rows that have been copied so far. */
int mo_import_flush(struct mo_import *import);
/* Begins an evaluation, after mo_import_flush; rollouts that follow belong to it. Returns 1, or 0
 * if it already exists. MO_ERR_NOT_FOUND: it lacks a loss. */
int mo_import_evaluation(struct mo_import *import, const struct mo_imported_evaluation *evaluation);
uint32_t mo_import_conflict(const struct mo_import *import);
uint64_t mo_import_losses(const struct mo_import *import); /* so far, not stored before */

#endif
