/* campaigns.h: campaigns in the store: settings, generations, every design ever born.
 *
 * A campaign is a job of kind MO_JOB_CAMPAIGN. Its settings never change, but for the number of
 * generations (extend). A generation commits in one transaction: designs, births, deaths, scores,
 * population, statistics, learning curve, and the row of the checkpoint that the next generation
 * starts from. Losses of the current generation and checkpoints inside its learning are saved
 * earlier; the commit deletes them.
 *
 * A campaign numbers its designs 0, 1, … in order of birth: initial population, then each
 * generation's children in the order of variation. The births of a generation are one BLOB and so
 * is its population, so that the phylogeny of a million designs is read in milliseconds.
 *
 * Threads and errors as in store.h. Genotypes here are placed in the default workspace. */
#ifndef MORPHO_STORE_CAMPAIGNS_H
#define MORPHO_STORE_CAMPAIGNS_H

#include <morpho/evolution.h>

#include "store/checkpoints.h"

#define MO_REPLICATES_MAX 100

/* The settings of a campaign. */
struct mo_campaign_record {
  struct mo_campaign_settings settings; /* generations: including extensions */
  /* Of the resulting controller, of a campaign that learns; "": "campaign-<id>". */
  char name[MO_NAME_BYTES_MAX + 1];
  char preset[16]; /* as requested; "": none */
  bool has_controller;
  char controller_name[MO_NAME_BYTES_MAX + 8]; /* as requested; "": by hash, or none */
  struct mo_sha256 controller_sha256;          /* the content of the name at submission */
  enum mo_sensor sensor; /* of the controller, or of the settings without one */
  char environment_set[MO_NAME_BYTES_MAX + 1]; /* "": listed in the request */
  uint32_t n_environments;                     /* with a set, the store fills it in */
  uint32_t n_listed;                           /* initial designs listed in the request */
  int64_t initial_campaign; /* its newest population at submission is the initial one; 0: none */
  int64_t group;            /* id of the first replicate; its own for that one */
  uint32_t replicate, replicates; /* number in the group, from 0; size of the group */
  uint32_t checkpoint_every_s;    /* inside the learning of a generation; 0: only at its end */
};

/* A generation as lists show it. All of it is a function of settings and seed, except `seconds`,
 * `stored_us`, and `rollouts_cached`, which depends on what the store held. */
struct mo_campaign_generation {
  uint32_t generation;
  uint64_t born_before; /* number of its first child: the designs born in earlier generations */
  uint32_t n_children;
  struct mo_population_stats stats; /* of the population after selection */
  double mean_parents,
      mean_children; /* mean scores before selection, without designs that diverged; NaN: none */
  struct mo_variation_counts variation;
  uint32_t survived_mutants,
      survived_recombinants; /* children that selection kept; fallbacks count as mutants */
  double turnover;           /* share of the population born in this generation */
  uint64_t rollouts, rollouts_cached,
      rollouts_diverged;        /* for scores; cached: found in the store, included in `rollouts` */
  uint32_t learning_steps;      /* in this generation */
  double first_loss, last_loss; /* mean training loss of its first and last step; NaN: none */
  bool collapse;                /* this generation raised the diversity warning */
  double seconds;               /* wall time since the generation before, without pauses */
  int64_t stored_us;
};

struct mo_campaign_step {
  uint32_t generation, step; /* step from 1 within the generation */
  bool on_children;
  struct mo_training_report report;
  double seconds;
};

enum mo_campaign_end { MO_CAMPAIGN_OPEN = 0, MO_CAMPAIGN_COMPLETED = 1, MO_CAMPAIGN_EXHAUSTED = 2 };

/* The current status of a campaign, read in one transaction. */
struct mo_campaign_status {
  /* Kind, state, version, weight, times, attempts, error; steps_total: generations; steps_done:
   * committed ones; both without generation 0. */
  struct mo_job job;
  struct mo_campaign_record record;
  int64_t generation;                 /* newest committed; −1: none */
  struct mo_campaign_generation last; /* generation ≥ 0 */
  uint64_t n_designs;                 /* ever born */
  double best_score;                  /* of the newest population; NaN: none */
  double diversity_max;               /* so far */
  enum mo_campaign_end end;           /* of a succeeded campaign */
  uint32_t scored;                    /* designs of the current generation whose losses are saved */
  bool has_result;
  struct mo_sha256 result_sha256; /* the controller of a succeeded campaign that learns */
};

/* ---- submission (by jobs) ---- */

struct mo_campaign_submission {
  struct mo_campaign_record record; /* of the first replicate; the store fills in controller,
                                       n_environments, group, replicate */
  const char *controller; /* name or "sha256:<hex>"; NULL: random weights (simultaneous) */
  const struct mo_environment *environments; /* (record.n_environments) if there is no set */
  const struct mo_bits *forms, *genotypes;   /* (record.n_listed) */
  /* The population of initial_campaign is copied in the same transaction, like listed designs. */
  enum mo_urgency priority;
  enum mo_back_end back_end;
  double weight;
  const char *label;           /* nullable */
  const char *idempotency_key; /* nullable */
  struct mo_sha256 body_sha256;
};
/* Stores all replicates (seed, seed + 1, …) in one transaction. *id: the first; the others have the
 * ids after it, without a gap. Errors as mo_store_submit; also MO_ERR_NOT_FOUND: no such initial
 * campaign; MO_ERR_CONFLICT: that has no population yet; MO_ERR_RANGE: replicates, more listed
 * designs than the population, no environments or too many. */
int mo_store_submit_campaign(struct mo_store *store,
                             const struct mo_campaign_submission *submission, int64_t *id,
                             bool *replayed);
/* Adds generations to a queued, running, paused or succeeded campaign; a succeeded one is queued
 * again. *before: its state before. key (nullable): an extension whose key is known was done
 * already; *before is then MO_JOB_QUEUED. Event "campaign.extended". MO_ERR_NOT_FOUND;
 * MO_ERR_CONFLICT: failed, cancelled or exhausted; MO_ERR_RANGE: beyond MO_GENERATIONS_MAX or
 * MO_CAMPAIGN_DESIGNS_MAX; MO_ERR_UNSUPPORTED: the learning rate depends on the number of
 * generations (simultaneous, one cosine); MO_ERR_EMPTY: simultaneous, and the learning state was
 * removed; MO_ERR_DUPLICATE: the key is known with another request. */
int mo_store_extend_campaign(struct mo_store *store, int64_t id, uint32_t generations,
                             const struct mo_request_key *key, enum mo_job_state *before);

/* ---- reading: lists of an unknown campaign are empty; all else returns MO_ERR_NOT_FOUND ---- */

/* MO_ERR_NOT_FOUND. After an error *status is as it was. */
int mo_store_campaign(struct mo_store *store, int64_t id, struct mo_campaign_status *status);
struct mo_campaign_query {
  int64_t before;    /* only ids below this; 0: from the newest */
  int state;         /* enum mo_job_state or −1 */
  int64_t group;     /* 0: any */
  const char *label; /* nullable; as in mo_job_query */
  /* (n_waiting ≤ MO_WAITING_MAX) running campaigns that are shown, and so found, as paused;
   * nullable. */
  const int64_t *waiting;
  size_t n_waiting;
};
int64_t mo_store_campaigns(struct mo_store *store, const struct mo_campaign_query *query,
                           struct mo_campaign_status *statuses, size_t limit);
int mo_store_campaign_environments(struct mo_store *store, int64_t id,
                                   struct mo_environment **environments, uint32_t *n);
/* Reads the initial designs (malloc): record.n_listed listed ones, then those of initial_campaign's
 * newest population, best first, while the population has room. Designs that are listed already or
 * do not fit the campaign's workspace were left out. */
int mo_store_campaign_initial(struct mo_store *store, int64_t id, struct mo_bits **genotypes,
                              uint32_t *n);

/* Reads generations > after (−1: from the first), ascending. */
int64_t mo_store_campaign_generations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_campaign_generation *rows, size_t limit);
int64_t mo_store_campaign_steps(struct mo_store *store, int64_t id, int64_t after_generation,
                                uint32_t after_step, struct mo_campaign_step *rows, size_t limit);

struct mo_campaign_design {
  uint32_t number;
  struct mo_bits form, genotype;
  struct mo_descent descent; /* parents as numbers */
  uint32_t born;
  int64_t died; /* first generation whose population lacks it (`born`: never selected); −1: none */
  double score; /* its last score; +infinity: a rollout diverged */
  struct mo_design_size size;
};
/* Reads designs with numbers > after (−1: from the first), ascending, at most `limit` ≤
 * MO_PAGE_MAX. Takes, like all reads here, ≤ 50 ms in a campaign of a million designs. */
int64_t mo_store_campaign_designs(struct mo_store *store, int64_t id, int64_t after,
                                  struct mo_campaign_design *rows, size_t limit);
/* Reads the designs with these numbers, in this order. MO_ERR_NOT_FOUND: one does not exist. */
int mo_store_campaign_designs_of(struct mo_store *store, int64_t id, const uint32_t *numbers,
                                 size_t n, struct mo_campaign_design *rows);
/* Reads the population after a generation (−1: the newest), best first, from place `offset` on,
 * with the scores of that time. *n: its size. Returns the number of rows or an error;
 * MO_ERR_NOT_FOUND: no such generation. */
int64_t mo_store_campaign_population(struct mo_store *store, int64_t id, int64_t generation,
                                     uint32_t offset, struct mo_campaign_design *rows, size_t limit,
                                     uint32_t *n);
/* Reads all descents so far (malloc), and the generation of each birth (malloc, nullable). *n:
 * designs. */
int mo_store_campaign_descents(struct mo_store *store, int64_t id, struct mo_descent **descents,
                               uint32_t **born, uint32_t *n);
/* One birth of a form. */
struct mo_campaign_place {
  int64_t campaign;
  uint32_t number;
};
/* Finds births of a form, by campaign, in campaigns > after_campaign. */
int64_t mo_store_campaigns_of_design(struct mo_store *store, const struct mo_bits *form,
                                     int64_t after_campaign, struct mo_campaign_place *places,
                                     size_t limit);

/* ---- the runner ---- */

int64_t mo_store_queued_campaigns(struct mo_store *store, int64_t *ids,
                                  size_t limit); /* by priority, then ascending */
/* Start and end an attempt, as mo_store_training_start and _park, with the events job.started,
 * job.requeued, job.finished. Committing a generation beyond all earlier ones resets the job's
 * attempts. */
int mo_store_campaign_start(struct mo_store *store, int64_t id);
int mo_store_campaign_park(struct mo_store *store, int64_t id, int error, const char *error_text,
                           uint32_t max_attempts, enum mo_job_state *after);

/* Adds the event "campaign.lineage_unreadable": metadata of a controller in the campaign's lineage
 * cannot be read. field: of the metadata; detail: why. Both are short and need no escapes in JSON.
 * MO_ERR_CONFLICT as for trainings. */
int mo_store_campaign_lineage_fault(struct mo_store *store, int64_t id,
                                    const struct mo_sha256 *sha256, const char *field,
                                    const char *detail);

/* The newest population in its order, for a campaign that resumes. Reading it returns
 * MO_ERR_NOT_FOUND when no generation is committed. */
struct mo_campaign_state {
  uint32_t generation, n;
  uint32_t *numbers;         /* (n) */
  uint32_t *born;            /* (n) generations */
  struct mo_bits *genotypes; /* (n) */
  double *scores;            /* (n) */
  uint64_t n_designs;
  double diversity_max;
};
int mo_store_campaign_state(struct mo_store *store, int64_t id, struct mo_campaign_state **state);
void mo_campaign_state_free(struct mo_campaign_state *state); /* NULL-safe */
/* Calls `take` with the genotype of every design ever born, in order, on the caller's thread. Stops
 * at a non-zero result and returns it. */
int mo_store_campaign_each(struct mo_store *store, int64_t id,
                           int (*take)(void *context, const struct mo_bits *genotype),
                           void *context);

/* Losses of one candidate of the current generation. place: among the candidates to be scored
 * (zero-shot: children; else parents, then children). */
struct mo_campaign_loss {
  uint32_t place;
  double losses[MO_ENVIRONMENTS_MAX];          /* (n_environments); +infinity: diverged */
  int32_t diverged_steps[MO_ENVIRONMENTS_MAX]; /* ≥ 0 */
  uint64_t by_workers; /* bit k: workers, not devices as for the rest, computed environment k */
};
/* Saves losses of `generation`, which must follow the newest committed one. Returns after the
 * commit. Deletes rows of other generations; a place that is saved already keeps its losses.
 * event_data: JSON of "campaign.progress"; NULL: no event. MO_ERR_CONFLICT as for trainings;
 * MO_ERR_RANGE: a place ≥ 2 populations. */
int mo_store_campaign_save_losses(struct mo_store *store, int64_t id, uint32_t generation,
                                  const struct mo_campaign_loss *losses, size_t n,
                                  const char *event_data);
/* Reads the saved losses of a generation, by place (malloc). */
int mo_store_campaign_losses(struct mo_store *store, int64_t id, uint32_t generation,
                             struct mo_campaign_loss **losses, size_t *n);
/* Finds genotypes whose losses in all environments of the campaign are stored, under its controller
 * and physics (zero-shot), by code of this fingerprint. losses: room for n; place: index in
 * `genotypes`. Returns their number. */
int64_t mo_store_campaign_known(struct mo_store *store, int64_t id, int64_t fingerprint,
                                const struct mo_bits *genotypes, uint32_t n,
                                struct mo_campaign_loss *losses);

/* Stores a checkpoint of the learning: the file campaigns/<job>/<generation>-<step>.checkpoint,
 * then its row. step: learning steps done in `generation`; the next generation starts from the last
 * one (simultaneous). A new checkpoint inside a generation replaces the earlier one of that
 * generation. steps (nullable): rows of the learning curve since the last call, in the same
 * transaction; a row written again replaces the old one. MO_ERR_NO_SPACE. */
int mo_store_campaign_checkpoint(struct mo_store *store, int64_t id, uint32_t generation,
                                 uint32_t step, const uint8_t *bytes, size_t size,
                                 const struct mo_campaign_step *steps, size_t n_steps);
/* Reads the newest checkpoint of one generation. For the newest committed generation it is the
 * state that scored its population, whatever was learned since. Earlier ones are not kept. */
int mo_store_campaign_checkpoint_of(struct mo_store *store, int64_t id, uint32_t generation,
                                    uint32_t *step, uint8_t **bytes, size_t *size);

/* A whole generation, committed in one transaction. */
struct mo_campaign_commit {
  struct mo_campaign_generation row; /* seconds as measured; the store fills in stored_us */
  const struct mo_birth *births; /* (row.n_children); parents: places in the population before */
  const struct mo_bits *forms, *genotypes; /* (row.n_children) of the children */
  const struct mo_design_size *sizes;      /* (row.n_children) */
  const double *child_scores;              /* (row.n_children) */
  const uint32_t *parent_numbers;          /* (n_parents) the population before, in its order */
  const double *parent_scores;             /* (n_parents) as used by the selection */
  uint32_t n_parents;
  const uint32_t *survivors; /* (n_survivors) places in parents, then children; in the order of the
                                new population */
  uint32_t n_survivors;
  /* (n_losses) zero-shot: losses of the children, stored in `scores` like those of evaluations;
   * else NULL. */
  const struct mo_campaign_loss *losses;
  uint32_t n_losses;
  int64_t fingerprint, workers_fingerprint; /* mo_store_fingerprint; workers_: for by_workers */
  const struct mo_campaign_step *steps;     /* (n_steps) of the learning curve, not written yet */
  uint32_t n_steps;
  const uint8_t *checkpoint; /* simultaneous, few-shot: the learning state at the end, a file
                                written before the transaction; else NULL */
  size_t checkpoint_size;
  uint32_t checkpoint_step;
  const char *event_data;    /* JSON of "campaign.generation" */
  const char *collapse_data; /* nullable: JSON of "campaign.diversity_collapse" */
};
/* Commits a generation. Generation 0 has no parents: its whole population are children.
 * MO_ERR_NO_SPACE: nothing changed. MO_ERR_CONFLICT: as for trainings, or another generation is
 * next. MO_ERR_INVALID, MO_ERR_RANGE: a mistake of the caller: parents are not the stored
 * population in its order, a survivor is named twice, a score is NaN, or row.born_before is not the
 * number of designs so far. */
int mo_store_campaign_commit(struct mo_store *store, int64_t id,
                             const struct mo_campaign_commit *commit);
/* running → succeeded. controller (nullable): stored under its name, as by
 * mo_store_training_finish. MO_ERR_CONFLICT: as for trainings, or the campaign was extended
 * meanwhile (generations > expected): continue. MO_ERR_INVALID: end is open. */
int mo_store_campaign_finish(struct mo_store *store, int64_t id, enum mo_campaign_end end,
                             uint32_t generations, const char *name, const uint8_t *bytes,
                             size_t size, const struct mo_controller *controller);

#endif
