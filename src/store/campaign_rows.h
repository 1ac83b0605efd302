/* campaign_rows.h: what the source files of campaigns share. Only for this room. */
#ifndef MORPHO_STORE_CAMPAIGN_ROWS_H
#define MORPHO_STORE_CAMPAIGN_ROWS_H

#include "store/campaigns.h"
#include "store/internal.h"

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

/* Reads the row ids of a campaign's environments, in order; n ≤ MO_ENVIRONMENTS_MAX. */
int mo_campaign_environment_rows(struct mo_connection *connection, int64_t group, int64_t *rows,
                                 uint32_t n);
/* The BLOBs of a generation; valid until the statement is reset. MO_ERR_NOT_FOUND; MO_ERR_CORRUPT:
 * a wrong size. */
struct mo_campaign_blobs {
  const uint8_t *births, *population; /* (n_births, MO_BIRTH_BYTES), (n, MO_MEMBER_BYTES) */
  uint32_t n_births, n;
  sqlite3_stmt *statement;
};
int mo_campaign_blobs_get(struct mo_connection *connection, int64_t id, int64_t generation,
                          struct mo_campaign_blobs *blobs);

int mo_campaign_generation_write(struct mo_connection *writer, int64_t id,
                                 const struct mo_campaign_generation *row);
int mo_campaign_step_write(struct mo_connection *writer, int64_t id,
                           const struct mo_campaign_step *row);
int mo_campaign_losses_drop(struct mo_connection *writer, int64_t id);

/* A checkpoint that is being written, under checkpoints_mutex. Begin (on any thread) writes the
 * file; row (in an operation) writes the row and deletes the rows of replaced checkpoints; end
 * (always) deletes the files of these. `committed`: the state after the generation. */
struct mo_campaign_checkpoint {
  int64_t id;
  uint32_t generation, step;
  bool committed;
  uint64_t size;
  struct mo_sha256 sha256;
  char *path;
  bool was_there;
  uint32_t dropped[MO_CAMPAIGN_CHECKPOINTS_MAX][2];
  size_t n_dropped;
};
int mo_campaign_checkpoint_begin(struct mo_store *store, const uint8_t *bytes,
                                 struct mo_campaign_checkpoint *checkpoint);
int mo_campaign_checkpoint_row(struct mo_store *store, struct mo_campaign_checkpoint *checkpoint);
/* Deletes the rows of checkpoints of generations before `generation`, and writes none. */
int mo_campaign_checkpoint_drop(struct mo_store *store, struct mo_campaign_checkpoint *checkpoint);
void mo_campaign_checkpoint_end(struct mo_store *store, struct mo_campaign_checkpoint *checkpoint,
                                int error);

#endif
