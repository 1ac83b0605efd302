/* score_blocks.h: scores identified by content, in blocks of bounded size, for transfer between
 * stores, where database rows have different numbers. Threads and errors as in store.h. */
#ifndef MORPHO_STORE_SCORE_BLOCKS_H
#define MORPHO_STORE_SCORE_BLOCKS_H

#include "store/imports.h"
#include "store/origins.h"

#define MO_SCORED_ROWS         4096 /* of a block */
#define MO_SCORED_CONDITIONS   64
#define MO_SCORED_ENVIRONMENTS 1024

/* The conditions of scores, except for body, environments and class. */
struct mo_scored_condition {
  struct mo_sha256 controller;
  struct mo_physics physics;
  enum mo_precision precision;
  enum mo_sensor sensor; /* of the controller */
};
struct mo_scored_design {
  struct mo_genotype genotype, form;
};
/* A file of scores has one or more blocks. Each can be read without the others, except for the
 * weights of a controller, which are in the first block with its scores. */
struct mo_score_block {
  uint64_t store;             /* the id of the source store, */
  char host[MO_ORIGIN_BYTES]; /* and the host */
  uint32_t number;            /* of the block in the file, from 0 */
  bool is_last;
  uint32_t n_conditions, n_environments, n_designs, n_scores;
  struct mo_scored_condition conditions[MO_SCORED_CONDITIONS];
  struct mo_environment environments[MO_SCORED_ENVIRONMENTS];
  struct mo_scored_design designs[MO_SCORED_ROWS];
  /* number: place of the design; environments: places. */
  struct mo_campaign_score scores[MO_SCORED_ROWS];
  uint32_t condition_of[MO_SCORED_ROWS]; /* place of each score's condition */
  uint8_t *weights;                      /* (weights_size) a controller's file; NULL: none */
  size_t weights_size;
  struct mo_sha256 weights_sha256;
  struct mo_controller *controller; /* decoded weights of a block that was read */
};
/* Returns NULL if out of memory. */
struct mo_score_block *mo_score_block_create(void);
void mo_score_block_clear(struct mo_score_block *block);
void mo_score_block_free(struct mo_score_block *block); /* NULL-safe */

/* ---- export from a store ---- */

struct mo_score_query {
  const char *controller;  /* only its scores: a name or "sha256:…"; nullable */
  const char *fingerprint; /* only this class; nullable */
  int64_t since_us;        /* only scores computed then or later; 0: all */
};
struct mo_score_walk;
/* MO_ERR_NOT_FOUND: no such controller. */
int mo_score_walk_create(struct mo_store *store, const struct mo_score_query *query,
                         struct mo_score_walk **walk);
void mo_score_walk_free(struct mo_score_walk *walk); /* NULL-safe */
/* Reads the next block. Scores stored in the meantime may be missing. */
int mo_score_walk_next(struct mo_score_walk *walk, struct mo_score_block *block);

/* ---- import into a store ---- */

#define MO_DIFFERENCES_MAX 16
/* Counts of rollouts. If a row contradicts a stored loss in any rollout, the whole row is left
 * out. */
struct mo_scores_imported {
  uint64_t n_new, n_known, n_different;
  uint32_t n; /* the first rows that differ: the stored and the imported values */
  struct mo_origin_row differences[MO_DIFFERENCES_MAX];
};
/* Imports a checked block in one transaction. Adds to *entered. MO_ERR_INVALID: a controller is
 * missing here, or does not fit these scores, or a score lists an environment twice; the message
 * has the details. */
int mo_store_scores_import(struct mo_store *store, const struct mo_score_block *block,
                           struct mo_scores_imported *entered, struct mo_message *message);

#endif
