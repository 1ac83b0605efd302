/* import_state.h: what the parts of an import share. Only for this room. */
#ifndef MORPHO_STORE_IMPORT_STATE_H
#define MORPHO_STORE_IMPORT_STATE_H

#include "store/imports.h"
#include "store/internal.h"

struct mo_import {
  struct mo_store *store;
  int64_t now_us;
  /* The groups so far: of the source, and here. */
  int64_t groups[MO_REPLICATES_MAX][2];
  uint32_t n_groups;
  /* The campaign that is entered. */
  int64_t id, controller, physics, set;
  uint32_t n_environments;
  int64_t environments[MO_ENVIRONMENTS_MAX]; /* rows */
  struct mo_condition last; /* of the score before, which the next one mostly shares */
  /* The evaluation that is entered. */
  int64_t evaluation;
  int32_t *diverged_steps; /* (designs, recorded_environments) malloc */
  uint32_t recorded_environments;
};

/* Finds the evaluation that came from this source, or is it: one of the same id and times there.
 * Another one may have had the id before a backup was restored. MO_ERR_NOT_FOUND. */
int mo_source_evaluation(struct mo_connection *connection, uint64_t own,
                         const struct mo_imported_evaluation *evaluation, int64_t *id);
int mo_source_insert(struct mo_import *import, int64_t id, const struct mo_import_source *source);

#endif
