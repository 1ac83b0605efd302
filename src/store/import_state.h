/* import_state.h: state shared by the parts of an import. Only for this room. */
#ifndef MORPHO_STORE_IMPORT_STATE_H
#define MORPHO_STORE_IMPORT_STATE_H

#include "store/imports.h"
#include "store/internal.h"

struct mo_import {
  struct mo_store *store;
  int64_t now_us;
  /* The groups so far: id in the source, id here. */
  int64_t groups[MO_REPLICATES_MAX][2];
  uint32_t n_groups;
  /* The campaign that is being imported. */
  int64_t id, controller, physics, set;
  uint32_t n_environments;
  int64_t environments[MO_ENVIRONMENTS_MAX]; /* rows */
  struct mo_condition last; /* of the previous score; usually the same for the next one */
  /* The evaluation that is being imported. */
  int64_t evaluation;
  int32_t *diverged_steps; /* (designs, recorded_environments) malloc */
  uint32_t recorded_environments;
};

/* Finds the evaluation that was imported from this source, or that is the source itself: the same
 * id and times. A different evaluation may have had the id before a backup was restored.
 * MO_ERR_NOT_FOUND. */
int mo_source_evaluation(struct mo_connection *connection, uint64_t own,
                         const struct mo_imported_evaluation *evaluation, int64_t *id);
int mo_source_insert(struct mo_import *import, int64_t id, const struct mo_import_source *source);

#endif
