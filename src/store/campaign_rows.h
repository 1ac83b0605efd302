/* campaign_rows.h: what the source files of campaigns share. Only for this room. */
#ifndef MORPHO_STORE_CAMPAIGN_ROWS_H
#define MORPHO_STORE_CAMPAIGN_ROWS_H

#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"
#include "store/checkpoint_files.h"
#include "store/runs.h"

#define MO_BIRTH_BYTES  9  /* operator, two parents */
#define MO_MEMBER_BYTES 12 /* number, score */

/* The part of a campaign's row that operations need. */
struct mo_campaign_head {
  enum mo_campaign_mode mode;
  uint32_t population, generations, n_environments;
  int64_t group, physics;
  int64_t controller, environment_set; /* 0: none */
  int64_t generation;                  /* −1: none */
  uint64_t n_designs;
  int64_t scored_generation, scored;
  double diversity_max;
};
int mo_campaign_head_get(struct mo_connection *connection, int64_t id,
                         struct mo_campaign_head *head);

/* The BLOBs of a generation, which can be read until the next call. MO_ERR_NOT_FOUND;
 * MO_ERR_CORRUPT: a wrong size. */
struct mo_campaign_blobs {
  const uint8_t *births, *population; /* (n_births, MO_BIRTH_BYTES), (n, MO_MEMBER_BYTES) */
  uint32_t n_births, n;
};
int mo_campaign_blobs_get(struct mo_connection *connection, int64_t id, int64_t generation,
                          struct mo_campaign_blobs *blobs);

int mo_campaign_losses_drop(struct mo_connection *writer, int64_t id);

/* Writes the row of a checkpoint and deletes the rows that it replaces. is_committed: it is the
 * state after its generation. */
int mo_campaign_checkpoint_row(struct mo_store *store, struct mo_checkpoint *checkpoint,
                               bool is_committed);

#endif
