/* campaign_rows.h: definitions shared by the source files of campaigns. Only for this room. */
#ifndef MORPHO_STORE_CAMPAIGN_ROWS_H
#define MORPHO_STORE_CAMPAIGN_ROWS_H

#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"
#include "store/checkpoint_files.h"
#include "store/runs.h"

/* Same layout as in campaign_populations. */
struct mo_birth_row {
  uint8_t op;
  uint32_t parents[2]; /* numbers */
} __attribute__((packed));
struct mo_member_row {
  uint32_t number;
  double score;
} __attribute__((packed));

/* The part of a campaign's row that operations need. */
struct mo_campaign_head {
  enum mo_campaign_mode mode;
  uint32_t population, generations, n_environments;
  uint32_t measures; /* as bits */
  int64_t group, physics;
  int64_t controller, environment_set; /* 0: none */
  int64_t generation;                  /* −1: none */
  uint64_t n_designs;
  int64_t scored_generation, scored;
  double diversity_max;
  bool race_pays;
};
int mo_campaign_head_get(struct mo_connection *connection, int64_t id,
                         struct mo_campaign_head *head);

/* The population of a generation, valid until the next call. MO_ERR_NOT_FOUND; MO_ERR_CORRUPT:
 * wrong size. */
struct mo_campaign_members {
  const struct mo_member_row *population; /* (n) best first */
  uint32_t n;
};
int mo_campaign_members_get(struct mo_connection *connection, int64_t id, int64_t generation,
                            struct mo_campaign_members *members);

/* Like mo_store_study_find, inside an operation. */
int mo_study_find(struct mo_connection *connection, const char *label, int64_t *id);
/* Reads the words of the designs: the names of the service's measures, then the words that a study
 * defines. */
int mo_campaign_words_get(struct mo_connection *connection, int64_t id,
                          struct mo_study_words *words);
/* Reads only the words that a study defines. */
int mo_study_words_get(struct mo_connection *connection, int64_t id, struct mo_study_words *words);
/* Inserts a design; its genotype already has a row. measures: (n), of a study. */
int mo_campaign_design_row(struct mo_connection *writer, int64_t id, int64_t genotype,
                           const struct mo_campaign_design *design, const double *measures,
                           uint32_t n);

/* Inserts the result of a re-evaluated design. */
int mo_campaign_held_out_row(struct mo_connection *writer, int64_t id,
                             const struct mo_re_evaluated *result);

int mo_campaign_losses_drop(struct mo_connection *writer, int64_t id);

/* Writes the row of a checkpoint and deletes the rows that it replaces. is_committed: it is the
 * state at the end of its generation. */
int mo_campaign_checkpoint_row(struct mo_store *store, struct mo_checkpoint *checkpoint,
                               bool is_committed);

#endif
