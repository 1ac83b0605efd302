/* campaigns.h: the store's part in campaigns: what was asked for, every generation, every design
 * ever born.
 *
 * A campaign is a job of kind MO_JOB_CAMPAIGN. Its settings never change, but for the number of
 * generations (extend). A generation commits in one transaction: its designs, births, deaths,
 * scores, population, statistics, learning curve, and the row of the checkpoint that the next one
 * starts from. Losses inside a generation, and checkpoints inside its learning, are saved as they
 * come; they go when the generation commits.
 *
 * Designs of a campaign are numbered 0, 1, … in order of birth (initial population, then each
 * generation's children in the order of variation). Births of a generation, and its population, are
 * one BLOB each, so that a whole phylogeny of a million designs is read in milliseconds.
 *
 * Threads and errors as in store.h. Genotypes here are of the default workspace, placed. */
#ifndef MORPHO_STORE_CAMPAIGNS_H
#define MORPHO_STORE_CAMPAIGNS_H

#include <morpho/evolution.h>

#include "store/store.h"

#define MO_REPLICATES_MAX 100

/* What a campaign is. */
struct mo_campaign_record {
  struct mo_campaign_settings settings; /* generations: as extended */
  char name[MO_NAME_BYTES_MAX +
            1];    /* of the resulting controller of a campaign that learns; "": "campaign-<id>" */
  char preset[16]; /* as asked for; "": none */
  bool has_controller;
  char controller_name[MO_NAME_BYTES_MAX + 8]; /* as asked for; "": by hash, or none */
  struct mo_sha256 controller_sha256;          /* what the name meant at submission */
  enum mo_sensor sensor;                       /* of the controller, or of the settings */
  char environment_set[MO_NAME_BYTES_MAX + 1]; /* "" : the request's own */
  uint32_t n_environments;                     /* filled in by the store with a set */
  uint32_t n_listed;                           /* initial designs that were listed */
  int64_t
      initial_campaign; /* whose newest population, at submission, is the initial one; 0: none */
  int64_t group;        /* id of the first replicate; its own for that one */
  uint32_t replicate, replicates; /* place in the group, from 0; their number */
  uint32_t checkpoint_every_s;    /* inside the learning of a generation; 0: at its end only */
};

/* One generation as it is listed. Everything in it is a function of settings and seed, but for
 * `seconds`, `stored_us` and `rollouts_cached`, which depends on what the store held. */
struct mo_campaign_generation {
  uint32_t generation;
  uint64_t born_before; /* number of its first child: designs born in earlier generations */
  uint32_t n_children;
  struct mo_population_stats stats; /* of the population that lives after selection */
  double mean_parents,
      mean_children; /* mean scores before selection, of those that did not diverge; NaN: none */
  struct mo_variation_counts variation;
  uint32_t survived_mutants,
      survived_recombinants; /* children that live on; fallbacks are mutants */
  double turnover;           /* share of the population that was born in this generation */
  uint64_t rollouts, rollouts_cached,
      rollouts_diverged;        /* for scores; cached: found in the store (of it: `rollouts`) */
  uint32_t learning_steps;      /* in this generation */
  double first_loss, last_loss; /* mean training loss of its first and last step; NaN: none */
  bool collapse;                /* this generation brought the diversity warning */
  double seconds;               /* wall time since the one before, pauses excluded */
  int64_t stored_us;
  struct mo_row_damage damage;
};

struct mo_campaign_step {    /* a learning step */
  uint32_t generation, step; /* step from 1 within the generation */
  bool on_children;
  struct mo_training_report report;
  double seconds;
  struct mo_row_damage damage;
};

enum mo_campaign_end { MO_CAMPAIGN_OPEN = 0, MO_CAMPAIGN_COMPLETED = 1, MO_CAMPAIGN_EXHAUSTED = 2 };

/* A campaign as it stands: read in one transaction. */
struct mo_campaign_status {
  struct mo_job job; /* kind, state, version, weight, times, attempts, error; steps_total:
                      * generations, steps_done: of them committed;
                      * -- generation 0 is not counted -- */
  struct mo_campaign_record record;
  int64_t generation;                 /* newest committed; −1: none */
  struct mo_campaign_generation last; /* generation ≥ 0 */
  uint64_t n_designs;                 /* ever born */
  double best_score;                  /* of the newest population; NaN: none */
  double diversity_max;               /* so far */
  enum mo_campaign_end end;           /* once succeeded */
  uint32_t scored; /* designs of the generation under way whose losses are saved */
  bool has_result;
  struct mo_sha256 result_sha256; /* succeeded, of a campaign that learns: the controller */
};

/* ---- submission (by jobs) ---- */

struct mo_campaign_submission {
  struct mo_campaign_record record; /* of the first replicate; the store fills in controller,
                                       n_environments, group, replicate */
  const char *controller; /* name or "sha256:<hex>"; NULL: random weights (simultaneous) */
  const struct mo_environment *environments; /* (record.n_environments) without a set */
  const struct mo_bits *forms, *genotypes;   /* (record.n_listed) */
  /* initial_campaign: its population is copied as the listed designs are: the store reads it in the
   * same transaction. */
  enum mo_urgency priority;
  enum mo_back_end back_end;
  double weight;
  const char *label;           /* nullable */
  const char *idempotency_key; /* nullable */
  struct mo_sha256 body_sha256;
};
/* All replicates (seed, seed + 1, …) in one transaction; *id: the first; the others follow it
 * without a gap. Errors as mo_store_submit; MO_ERR_NOT_FOUND also: no such initial campaign;
 * MO_ERR_CONFLICT also: it has no population yet; MO_ERR_RANGE: replicates, more listed designs
 * than the population, no or too many environments. */
int mo_store_submit_campaign(struct mo_store *store,
                             const struct mo_campaign_submission *submission, int64_t *id,
                             bool *replayed);
/* Adds generations: to a queued, running, paused or succeeded campaign (which is queued again,
 * unless it is exhausted). *before: its state before. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: failed,
 * cancelled or exhausted; MO_ERR_RANGE: beyond MO_GENERATIONS_MAX or MO_CAMPAIGN_DESIGNS_MAX;
 * MO_ERR_UNSUPPORTED: its learning rate depends on the number of generations (simultaneous by one
 * cosine); MO_ERR_EMPTY: simultaneous, and what it has learned was removed; MO_ERR_DUPLICATE: the
 * key is known with another request. Event "campaign.extended". key (nullable): an extension whose
 * key is known is done, and *before is MO_JOB_QUEUED. */
int mo_store_extend_campaign(struct mo_store *store, int64_t id, uint32_t generations,
                             const struct mo_request_key *key, enum mo_job_state *before);

/* ---- reading: lists of a campaign that is not there are empty, everything else gives
 * MO_ERR_NOT_FOUND ---- */

/* MO_ERR_NOT_FOUND. MO_ERR_CORRUPT: status->job.damage tells, as in mo_store_job; the rest of
 * *status is as it was. */
int mo_store_campaign(struct mo_store *store, int64_t id, struct mo_campaign_status *status);
struct mo_campaign_query {
  int64_t before; /* only ids below this; 0: from the newest */
  int state;      /* enum mo_job_state or −1 */
  int64_t group;  /* 0: any */
  /* (n_waiting ≤ MO_WAITING_MAX) campaigns that, while they run, are shown and so found as paused;
   * nullable. */
  const int64_t *waiting;
  size_t n_waiting;
};
int64_t mo_store_campaigns(struct mo_store *store, const struct mo_campaign_query *query,
                           struct mo_campaign_status *statuses, size_t limit);
int mo_store_campaign_environments(struct mo_store *store, int64_t id,
                                   struct mo_environment **environments, uint32_t *n);
/* The initial designs (malloc): record.n_listed listed ones, then those of initial_campaign's
 * newest population, best first, as many as the population has room for; what is listed already, or
 * does not fit the campaign's workspace, was left out. */
int mo_store_campaign_initial(struct mo_store *store, int64_t id, struct mo_bits **genotypes,
                              uint32_t *n);

/* Generations > after (−1: from the first), ascending. One with a number that cannot be told is
 * there with its damage, and its generation; steps likewise. */
int64_t mo_store_campaign_generations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_campaign_generation *rows, size_t limit);
int64_t mo_store_campaign_steps(struct mo_store *store, int64_t id, int64_t after_generation,
                                uint32_t after_step, struct mo_campaign_step *rows, size_t limit);

/* A design of a campaign. */
struct mo_campaign_design {
  uint32_t number;
  struct mo_bits form, genotype;
  struct mo_descent descent; /* parents as numbers */
  uint32_t born;
  int64_t died; /* first generation whose population is without it (its own: it was never selected);
                   −1: it lives */
  double score; /* the last that it had; +infinity: a rollout diverged */
  struct mo_design_size size;
};
/* Numbers > after (−1: from the first), ascending, at most `limit` ≤ MO_PAGE_MAX; ≤ 50 ms in a
 * campaign of a million designs, as all reads here. */
int64_t mo_store_campaign_designs(struct mo_store *store, int64_t id, int64_t after,
                                  struct mo_campaign_design *rows, size_t limit);
/* These numbers, in this order. MO_ERR_NOT_FOUND: one is not there. */
int mo_store_campaign_designs_of(struct mo_store *store, int64_t id, const uint32_t *numbers,
                                 size_t n, struct mo_campaign_design *rows);
/* The population that a generation left, best first: `offset` … . generation −1: the newest. score:
 * as it was then. *n: its size. Returns the number of rows or an error; MO_ERR_NOT_FOUND: no such
 * generation. */
int64_t mo_store_campaign_population(struct mo_store *store, int64_t id, int64_t generation,
                                     uint32_t offset, struct mo_campaign_design *rows, size_t limit,
                                     uint32_t *n);
/* All descents so far (malloc), and the generation of each birth (malloc, nullable). *n: designs.
 */
int mo_store_campaign_descents(struct mo_store *store, int64_t id, struct mo_descent **descents,
                               uint32_t **born, uint32_t *n);
/* Where a form was born: (campaign, number), by campaign. */
struct mo_campaign_place {
  int64_t campaign;
  uint32_t number;
};
int64_t mo_store_campaigns_of_design(struct mo_store *store, const struct mo_bits *form,
                                     int64_t after_campaign, struct mo_campaign_place *places,
                                     size_t limit);

/* ---- the runner ---- */

int64_t mo_store_queued_campaigns(struct mo_store *store, int64_t *ids,
                                  size_t limit); /* by priority, then ascending */
/* As mo_store_training_start, _park: events job.started, job.requeued, job.finished. A committed
 * generation beyond all before forgives the job's attempts. */
int mo_store_campaign_start(struct mo_store *store, int64_t id);
int mo_store_campaign_park(struct mo_store *store, int64_t id, int error, const char *error_text,
                           uint32_t max_attempts, enum mo_job_state *after);

/* Event "campaign.lineage_unreadable": a controller of the campaign's lineage says something of
 * itself that cannot be read. field: of its metadata; detail: both short texts that JSON holds as
 * they are. MO_ERR_CONFLICT as for trainings. */
int mo_store_campaign_lineage_fault(struct mo_store *store, int64_t id,
                                    const struct mo_sha256 *sha256, const char *field,
                                    const char *detail);

/* What a resumed campaign needs: the newest population in its order (numbers, genotypes, scores,
 * births) and the forms of every design ever born. MO_ERR_NOT_FOUND: no generation is committed. */
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
/* Calls `take` with the genotype of every design ever born, in order, on the caller's thread;
 * non-zero ends it and is returned. */
int mo_store_campaign_each(struct mo_store *store, int64_t id,
                           int (*take)(void *context, const struct mo_bits *genotype),
                           void *context);

/* Losses of the generation under way. place: among its candidates to be scored (zero-shot:
 * children; else parents, then children). */
struct mo_campaign_loss {
  uint32_t place;
  double losses[MO_ENVIRONMENTS_MAX];          /* (n_environments); +infinity: diverged */
  int32_t diverged_steps[MO_ENVIRONMENTS_MAX]; /* ≥ 0 */
  uint64_t by_workers; /* bit k: devices compute the campaign, but not its environment k */
};
/* Returns after the commit. `generation` must be the one after the newest committed; older rows of
 * another generation go; what is saved of a place stays as it was saved first. event_data: JSON of
 * "campaign.progress"; nullable: quiet. MO_ERR_CONFLICT as for trainings; MO_ERR_RANGE: a place ≥ 2
 * populations. */
int mo_store_campaign_save_losses(struct mo_store *store, int64_t id, uint32_t generation,
                                  const struct mo_campaign_loss *losses, size_t n,
                                  const char *event_data);
/* Those that are saved, by place (malloc). */
int mo_store_campaign_losses(struct mo_store *store, int64_t id, uint32_t generation,
                             struct mo_campaign_loss **losses, size_t *n);
/* What `scores` holds of each genotype under the campaign's controller, physics and environments
 * (zero-shot), computed by code of this fingerprint: rows in which every environment is known;
 * place: in `genotypes`. losses: room for n. Returns their number. */
int64_t mo_store_campaign_known(struct mo_store *store, int64_t id, int64_t fingerprint,
                                const struct mo_bits *genotypes, uint32_t n,
                                struct mo_campaign_loss *losses);

/* Checkpoints of the learning: files campaigns/<job>/<generation>-<step>.checkpoint, written before
 * their row. step: learning steps done of `generation`; the last one of a generation is the state
 * that the next starts from (simultaneous). A new one inside a generation replaces the one before
 * of the same generation. MO_ERR_NO_SPACE. Steps (nullable): rows of the learning curve since the
 * last call, in the same transaction; rows again replace. */
int mo_store_campaign_checkpoint(struct mo_store *store, int64_t id, uint32_t generation,
                                 uint32_t step, const uint8_t *bytes, size_t size,
                                 const struct mo_campaign_step *steps, size_t n_steps);
/* The newest of a generation ≥ the newest committed one (malloc). MO_ERR_NOT_FOUND; MO_ERR_CORRUPT.
 */
int mo_store_campaign_checkpoint_bytes(struct mo_store *store, int64_t id, uint32_t *generation,
                                       uint32_t *step, uint8_t **bytes, size_t *size);
/* The newest of this generation: of the newest committed one, what scored its population, whatever
 * the generation under way has learned since. Others are not kept. */
int mo_store_campaign_checkpoint_of(struct mo_store *store, int64_t id, uint32_t generation,
                                    uint32_t *step, uint8_t **bytes, size_t *size);

/* Those that are kept: one after the newest committed generation, perhaps one inside the generation
 * under way. */
#define MO_CAMPAIGN_CHECKPOINTS_MAX 64
struct mo_campaign_checkpoint_row {
  uint32_t generation, step;
  struct mo_sha256 sha256;
  uint64_t size;
  int64_t stored_us;
};
int64_t mo_store_campaign_checkpoints(struct mo_store *store, int64_t id,
                                      struct mo_campaign_checkpoint_row *rows,
                                      size_t limit); /* newest first */
/* Removes those that are not needed: of a campaign that has ended every one, of another none. On a
 * full disk with the reserve. MO_ERR_NOT_FOUND: no such campaign. */
struct mo_campaign_checkpoints_removed {
  uint32_t places[MO_CAMPAIGN_CHECKPOINTS_MAX][2]; /* (n) generation, step; newest first */
  size_t n;
  uint64_t bytes;
};
int mo_store_campaign_checkpoints_remove(struct mo_store *store, int64_t id,
                                         struct mo_campaign_checkpoints_removed *removed);

/* A whole generation, one transaction. */
struct mo_campaign_commit {
  struct mo_campaign_generation row; /* seconds as measured; stored_us by the store */
  const struct mo_birth *births; /* (row.n_children); parents: places in the population before */
  const struct mo_bits *forms, *genotypes; /* (row.n_children) of the children */
  const struct mo_design_size *sizes;      /* (row.n_children) */
  const double *child_scores;              /* (row.n_children) */
  const uint32_t *parent_numbers;          /* (n_parents) the population before, in its order */
  const double *parent_scores;             /* (n_parents) as used by the selection */
  uint32_t n_parents;
  const uint32_t *survivors; /* (n_survivors) places: parents, then children; in the order of the
                                new population */
  uint32_t n_survivors;
  const struct mo_campaign_loss *losses; /* (n_losses) zero-shot: of the children, which go into
                                            `scores` as evaluations' do; else NULL */
  uint32_t n_losses;
  int64_t fingerprint,
      workers_fingerprint; /* mo_store_fingerprint; of the losses that by_workers names */
  const struct mo_campaign_step
      *steps; /* (n_steps) rows of the learning curve that are not written yet */
  uint32_t n_steps;
  const uint8_t *checkpoint; /* simultaneous, few-shot: the learning state at the end; else NULL.
                                File first, then the transaction */
  size_t checkpoint_size;
  uint32_t checkpoint_step;
  const char *event_data;    /* JSON of "campaign.generation" */
  const char *collapse_data; /* nullable: JSON of "campaign.diversity_collapse" */
};
/* MO_ERR_NO_SPACE: nothing changed. MO_ERR_CONFLICT as for trainings, or it is not the turn of this
 * generation. MO_ERR_INVALID, MO_ERR_RANGE: a mistake of the caller: parents are not the stored
 * population in its order, a survivor named twice, a score that is NaN, row.born_before is not the
 * number of designs so far. Generation 0 has no parents: all of it are children. */
int mo_store_campaign_commit(struct mo_store *store, int64_t id,
                             const struct mo_campaign_commit *commit);
/* running → succeeded. controller: nullable; under its name, as mo_store_training_finish.
 * MO_ERR_CONFLICT also: it was extended meanwhile (generations > expected): go on. MO_ERR_INVALID:
 * end is open. */
int mo_store_campaign_finish(struct mo_store *store, int64_t id, enum mo_campaign_end end,
                             uint32_t generations, const char *name, const uint8_t *bytes,
                             size_t size, const struct mo_controller *controller);

#endif
