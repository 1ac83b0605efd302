/* import_state.h: state shared by the parts of an import. Only for this room. */
#ifndef MORPHO_STORE_IMPORT_STATE_H
#define MORPHO_STORE_IMPORT_STATE_H

#include "store/imports.h"
#include "store/internal.h"

/* A job in state 6 with this epoch is hidden because it is being imported; mo_import_finish gives
 * it the state. Jobs that are being deleted have an epoch of 0 or above. */
#define MO_IMPORT_EPOCH(state) (-1 - (int64_t)(state))

/* If a piece runs again, everything here is restored to its value before the piece, except for the
 * memory to which the pointers refer. */
struct mo_import {
  struct mo_store *store;
  int64_t now_us;
  bool is_finished;
  /* The groups so far: id in the source, id here. */
  int64_t groups[MO_REPLICATES_MAX][2];
  uint32_t n_groups;
  /* The campaign that is being imported. */
  int64_t id, controller, physics, set;
  uint32_t n_environments;
  int64_t environments[MO_ENVIRONMENTS_MAX]; /* rows */
  struct mo_condition last; /* of the previous score; usually that of the next one, too */
  uint64_t n_losses;        /* new ones, of all campaigns */
  uint32_t conflict;
  /* The evaluation that is being imported. */
  int64_t evaluation;
  struct mo_saved_design classes; /* its controller, physics and classes; genotype: not set */
  uint32_t n_inserted;            /* of its designs */
  int32_t *diverged_steps;        /* (designs, recorded_environments) malloc */
  uint32_t recorded_environments;
  /* Rows that wait: (size) malloc; those before `at` are written. */
  uint8_t *rows;
  size_t size, room, at;
};

/* ---- imports.c, import_recordings.c: on the writer's thread ---- */

int mo_enter_campaign(struct mo_import *import, const struct mo_imported_campaign *campaign);
int mo_enter_design(struct mo_import *import, const struct mo_campaign_design *design);
int mo_enter_generation(struct mo_import *import, const struct mo_campaign_generation *row,
                        const struct mo_descent *births, const struct mo_campaign_member *members,
                        uint32_t n_members);
int mo_enter_step(struct mo_import *import, const struct mo_campaign_step *step);
int mo_enter_score(struct mo_import *import, const struct mo_campaign_score *score);
/* Inserts the evaluation without its designs. Returns 1, or 0 if it already exists. */
int mo_enter_evaluation(struct mo_import *import, const struct mo_imported_evaluation *evaluation);
/* Inserts the next designs, at least one, until the time is over. */
int mo_enter_evaluation_designs(struct mo_import *import,
                                const struct mo_imported_evaluation *evaluation, int64_t until_us);
int mo_enter_rollout(struct mo_import *import, const struct mo_saved_trajectory *rollout);

/* ---- import_hidden.c: jobs that readers do not see yet; on the writer's thread ---- */

/* Removes a job that has just been inserted from `usage`, which contains each job that readers
 * see. */
int mo_import_hide(struct mo_store *store, int64_t id);
/* Shows all jobs of the import: state, usage, events. */
int mo_import_show(struct mo_store *store, void *unused);
/* Marks the hidden jobs as deleted. */
int mo_import_forget(struct mo_store *store, void *unused);

/* ---- deletion.c ---- */

/* Deletes the jobs of an import that did not end, like other jobs. Waits only for the first
 * step. */
void mo_import_abandon(struct mo_store *store);

/* ---- shared queries ---- */

/* Finds the evaluation that was imported from this source, or that is the source itself: the same
 * id and times. A different evaluation may have had the id before a backup was restored. hidden:
 * also one that is being imported. MO_ERR_NOT_FOUND. */
int mo_source_evaluation(struct mo_connection *connection, uint64_t own, bool hidden,
                         const struct mo_imported_evaluation *evaluation, int64_t *id);
int mo_source_insert(struct mo_import *import, int64_t id, const struct mo_import_source *source);

#endif
