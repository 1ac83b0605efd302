/* campaign_runs.h: reads and writes of a campaign's runner. Each write returns after its commit,
 * and adds its event. Committing a generation beyond all earlier ones resets the job's attempts.
 * Threads and errors as in store/campaigns.h. */
#ifndef MORPHO_STORE_CAMPAIGN_RUNS_H
#define MORPHO_STORE_CAMPAIGN_RUNS_H

#include "store/campaign_records.h"

/* Adds the event "campaign.lineage_unreadable": metadata of a controller in the campaign's lineage
 * cannot be read. field: the metadata field; detail: the reason. Both are short and need no escapes
 * in JSON. MO_ERR_CONFLICT as for training runs. */
int mo_store_campaign_lineage_fault(struct mo_store *store, int64_t id,
                                    const struct mo_sha256 *sha256, const char *field,
                                    const char *detail);

/* Adds the event "campaign.progress". data: its JSON. MO_ERR_CONFLICT as for training runs. */
int mo_store_campaign_progress(struct mo_store *store, int64_t id, const char *data);

/* The newest population in its order, for a campaign that resumes. Reading it returns
 * MO_ERR_NOT_FOUND if no generation is committed. */
struct mo_campaign_state {
  uint32_t generation, n;
  uint32_t *numbers;         /* (n) */
  uint32_t *born;            /* (n) generations */
  struct mo_bits *genotypes; /* (n) */
  double *scores;            /* (n) */
  uint64_t n_designs;
  double diversity_max;
  bool race_pays; /* as committed with the generation; initially false */
};
int mo_store_campaign_state(struct mo_store *store, int64_t id, struct mo_campaign_state **state);
void mo_campaign_state_free(void *state); /* NULL-safe */
/* Calls `take` with the genotype of every design ever born, in order, on the caller's thread. Stops
 * at the first non-zero result, and returns it. */
int mo_store_campaign_each(struct mo_store *store, int64_t id,
                           int (*take)(void *context, const struct mo_genotype *genotype),
                           void *context);

/* Losses of one candidate of the current generation. place: among the candidates to be scored
 * (zero-shot: children; else parents, then children). */
struct mo_campaign_loss {
  uint32_t place;
  double losses[MO_ENVIRONMENTS_MAX]; /* (n_environments); +infinity: diverged; NaN: not computed,
                                         because the child cannot survive */
  int32_t diverged_steps[MO_ENVIRONMENTS_MAX]; /* ≥ 0 */
  int64_t origins[MO_ENVIRONMENTS_MAX];        /* of each loss, as in mo_saved_block */
  /* Bit k is for environment k. by_workers: workers computed the loss, though the job runs on
   * devices; stored: it is already in `scores`. */
  uint64_t by_workers, stored;
  /* (n_environments) of a campaign that names measures: all measures of each rollout; NaN: no
   * value, or not computed. NULL: none. */
  double (*measures)[MO_MEASURES];
};
/* Saves losses of `generation`, which must follow the newest committed one. Returns after the
 * commit. Deletes rows of other generations; a place that is already saved keeps its losses.
 * event_data: JSON of "campaign.progress"; NULL: no event. MO_ERR_CONFLICT as for training runs. */
int mo_store_campaign_save_losses(struct mo_store *store, int64_t id, uint32_t generation,
                                  const struct mo_campaign_loss *losses, size_t n,
                                  const char *event_data);
/* Reads the saved losses of a generation, by place. One block of memory with their measures: free
 * frees all of it. */
int mo_store_campaign_losses(struct mo_store *store, int64_t id, uint32_t generation,
                             struct mo_campaign_loss **losses, size_t *n);
/* Finds genotypes with stored losses in environments of the campaign, under its controller and
 * physics (zero-shot). Uses losses computed by the code with this fingerprint or, where there are
 * none, by the code of `workers` (0: none). losses: room for n; place: index in `genotypes`; NaN:
 * not stored. Where `measures` of an element is not NULL, it is space for the measures, and a loss
 * without stored measures counts as not found. Returns the number found. */
int64_t mo_store_campaign_known(struct mo_store *store, int64_t id, int64_t fingerprint,
                                int64_t workers, const struct mo_bits *genotypes, uint32_t n,
                                struct mo_campaign_loss *losses);

/* Stores a checkpoint of the learning: the file campaigns/<job>/<generation>-<step>.checkpoint,
 * then its row. step: learning steps done in `generation`; the next generation starts from the last
 * one (simultaneous). A new checkpoint within a generation replaces the earlier one of that
 * generation. steps (nullable): rows of the learning curve since the last call, in the same
 * transaction; a rewritten row replaces the old one. MO_ERR_NO_SPACE. */
int mo_store_campaign_checkpoint(struct mo_store *store, int64_t id, uint32_t generation,
                                 uint32_t step, const uint8_t *bytes, size_t size,
                                 const struct mo_campaign_step *steps, size_t n_steps);
/* Reads the newest checkpoint of one generation. For the newest committed generation it is the
 * state that scored its population, even if learning has continued since. Earlier checkpoints are
 * not kept. */
int mo_store_campaign_checkpoint_of(struct mo_store *store, int64_t id, uint32_t generation,
                                    uint32_t *step, uint8_t **bytes, size_t *size);

/* A whole generation, committed in one transaction. */
struct mo_campaign_commit {
  struct mo_campaign_generation row; /* seconds as measured; the store fills in stored_us */
  /* (row.n_children); parents: places in the previous population; in a study, numbers of designs */
  const struct mo_birth *births;
  const struct mo_bits *forms, *genotypes; /* (row.n_children) of the children */
  const struct mo_design_size *sizes;      /* (row.n_children) */
  const double *child_scores;              /* (row.n_children) */
  const uint8_t *children_cut; /* (row.n_children) 1: the score is a lower bound; NULL: no score is
                                * a lower bound */
  /* (row.n_children, n_measures) the means of the measures that the campaign names, then the
   * measures of a study. parent_measures: (n_parents, n_measures) new means of parents that were
   * scored again, because the controller learns; else NULL. */
  const double *measures, *parent_measures;
  uint32_t n_measures;
  bool is_study;                  /* the job is requeued after the commit */
  const uint32_t *parent_numbers; /* (n_parents) the previous population, in its order */
  const double *parent_scores;    /* (n_parents) as used in the selection */
  uint32_t n_parents;
  const uint32_t *survivors; /* (n_survivors) places in parents, then children; in the order of the
                                new population */
  uint32_t n_survivors;
  bool race_pays;                         /* children race in the next generation */
  const struct mo_re_evaluated *held_out; /* (n_held_out) if the generation was re-evaluated */
  uint32_t n_held_out;
  /* (n_losses) zero-shot: losses of the children, stored in `scores` like the losses of
   * evaluations; else NULL. */
  const struct mo_campaign_loss *losses;
  uint32_t n_losses;
  int64_t fingerprint, workers_fingerprint; /* mo_store_fingerprint; workers_: for by_workers */
  const struct mo_campaign_step *steps;     /* (n_steps) rows of the learning curve that are not
                                               written yet */
  uint32_t n_steps;
  const uint8_t *checkpoint; /* simultaneous, few-shot: the learning state at the end, a file
                                written before the transaction; else NULL */
  size_t checkpoint_size;
  uint32_t checkpoint_step;
  const char *event_data;    /* JSON of "campaign.generation" */
  const char *collapse_data; /* nullable: JSON of "campaign.diversity_collapse" */
};
/* Commits a generation. Generation 0 has no parents: its whole population consists of children.
 * MO_ERR_NO_SPACE: nothing changed. MO_ERR_CONFLICT: as for training runs, or a different
 * generation is next. */
int mo_store_campaign_commit(struct mo_store *store, int64_t id,
                             const struct mo_campaign_commit *commit);
/* running → succeeded. controller (nullable): stored under its name, as by
 * mo_store_training_finish. MO_ERR_CONFLICT: as for training runs, or the campaign was extended in
 * the meantime (generations > expected), so continue. */
int mo_store_campaign_finish(struct mo_store *store, int64_t id, enum mo_campaign_end end,
                             uint32_t generations, const char *name, const uint8_t *bytes,
                             size_t size, const struct mo_controller *controller);

#endif
