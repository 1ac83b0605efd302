/* campaign_run.h: one campaign while it runs. For the files campaign_*.c of this room alone.
 *
 * Candidates of a generation lie in one row: the population (n_parents, best first), then its
 * children. Everything about candidate i is at place i of each array. Bodies are kept twice: in the
 * campaign's workspace, where variation, selection and diversity work, and in the default
 * workspace, for which controllers are and which the store holds. */
#ifndef MORPHO_JOBS_CAMPAIGN_RUN_H
#define MORPHO_JOBS_CAMPAIGN_RUN_H

#include "jobs/internal.h"

struct mo_campaign_run {
  struct mo_attempt attempt; /* first */
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_campaign_status
      status; /* as it was when the generation began: generations may have been added */
  struct mo_compute_share *share;
  struct mo_controller *controller; /* as submitted; NULL: random weights */
  struct mo_environment *environments;
  uint32_t n_environments;
  struct mo_exclusion *exclusion;
  struct mo_seen *seen;
  size_t words; /* of a genotype of the campaign's workspace */

  uint32_t generation; /* under way */
  uint32_t n_parents, n_children;
  uint64_t *genotypes;          /* (2 · population, words) */
  struct mo_bits *bits;         /* (2 · population) in the default workspace */
  struct mo_bits *forms;        /* (population) of the children */
  struct mo_design_size *sizes; /* (2 · population) */
  double *scores;               /* (2 · population) */
  uint32_t *numbers, *born;     /* (2 · population) */
  struct mo_birth *births;      /* (population) of the children */
  uint32_t *survivors;          /* (population) */
  uint32_t n_survivors;
  uint64_t n_designs; /* ever born, before this generation */
  struct mo_variation_counts variation;
  double diversity_max; /* so far */
  bool is_warned;       /* of a collapse, since that maximum */
  int64_t begin_us;     /* of the generation in this process */
  double
      prepared_s; /* wall time of what came before generation 0, which counts to it; 0 for others */
  int64_t progress_us; /* when progress was told last */
  double generation_s; /* wall time of the newest generation, without what came before generation 0;
                          0: not known */

  /* Learning (campaign_learn.c). */
  struct mo_learner learner;
  struct mo_campaign_step
      *steps; /* (parent + child steps): rows from steps_saved on are not written yet */
  uint32_t step, steps_saved; /* steps done in this generation, as of the last checkpoint */
  uint32_t steps_base;        /* steps of the training before this generation */
  bool is_learned;            /* the learning state is of this generation, or later */
  int64_t checkpoint_us;
  double first_loss, last_loss;

  /* Scores (campaign_score.c): of the candidates from `first_scored` on. */
  uint32_t first_scored, n_scored;
  struct mo_compute_controller
      *frozen; /* zero-shot: the weights, ready for the back end; NULL before the first scores */
  struct mo_campaign_loss *losses; /* (n_scored) */
  uint8_t *left;                   /* (n_scored) blocks of the candidate that are not done */
  uint32_t *unsaved;               /* (n_scored) places whose losses are to be saved */
  uint32_t n_unsaved;
  uint32_t n_done;   /* of n_scored */
  uint32_t n_cached; /* of these, found in `scores` */

  struct mo_campaign_writing *writing; /* the commit that is under way (campaign_commit.c) */
};

/* ---- campaign_run.c ---- */
int mo_campaign_enter(struct mo_campaign_run *run, enum mo_campaign_phase phase, uint64_t total);
void mo_campaign_advance(struct mo_campaign_run *run, uint64_t done); /* live figure of the phase */
/* Bodies of pretrainings that are drawn again. */
struct mo_campaign_drawing {
  uint64_t done, total;
  double seconds_left; /* < 0: not known yet */
  int64_t drawer;      /* the campaign that draws them */
};
void mo_campaign_show_drawing(struct mo_campaign_run *run,
                              const struct mo_campaign_drawing *drawing); /* NULL: it is over */
void mo_campaign_show_rate(struct mo_campaign_run *run, double rollouts_per_s);
/* JSON of "campaign.progress" once a second; else NULL. */
const char *mo_campaign_progress(struct mo_campaign_run *run, const char *phase, uint64_t done,
                                 uint64_t total, char text[256]);
void mo_campaign_told(struct mo_campaign_run *run); /* it was written */

/* ---- campaign_commit.c ---- */
/* The thread that writes, and room for what it writes; freed with NULL, too. */
int mo_campaign_writing_create(struct mo_campaign_run *run); /* MO_ERR_NO_MEMORY */
void mo_campaign_writing_free(struct mo_campaign_run *run);
/* Describes the generation that was selected and begins its commit; the run goes on with copies of
 * its own, but for the losses. */
int mo_campaign_commit(struct mo_campaign_run *run);
/* Whether settling would wait for the store. */
bool mo_campaign_is_writing(const struct mo_campaign_run *run);
/* Waits until what was begun is committed; to be called before anything else is written. MO_OK also
 * if nothing was begun; errors as mo_attempt_persist. MO_ERR_CANCELLED: a wish came while it waited
 * for room; it can be called again. */
int mo_campaign_settle(struct mo_campaign_run *run);
void mo_campaign_writing_join(struct mo_campaign_run *run); /* only until the thread has ended */

/* ---- campaign_learn.c ---- */
/* Learns what this generation is to learn, from where it stands, to its end. */
int mo_campaign_learn(struct mo_campaign_run *run);
int mo_campaign_save_learning(
    struct mo_campaign_run *run); /* a checkpoint of what was learned since the last one */
/* The state that the newest committed generation ended with, for the result. */
int mo_campaign_load_learning(struct mo_campaign_run *run);
void mo_campaign_free_learning(struct mo_campaign_run *run);

/* ---- campaign_score.c ---- */
/* Scores the children; of a campaign that learns the parents, too. */
int mo_campaign_score(struct mo_campaign_run *run);
int mo_campaign_save_losses(struct mo_campaign_run *run); /* those that are not saved yet */
void mo_campaign_free_scores(struct mo_campaign_run *run);

/* ---- campaign_lineage.c ---- */
/* The pretrainings behind the campaign's controller, its own first. */
#define MO_LINEAGE_PARTS_MAX 16
struct mo_lineage_part {
  uint64_t seed, n_bodies; /* ≥ 1 */
};
struct mo_lineage {
  struct mo_lineage_part parts[MO_LINEAGE_PARTS_MAX];
  uint32_t n_parts;
};
/* Tells of every field that cannot be read, and leaves out what would follow from it. MO_ERR_LIMIT:
 * more bodies than can be drawn again. MO_ERR_CANCELLED: a wish came while it waited for room to
 * tell. */
int mo_lineage_read(struct mo_campaign_run *run, struct mo_lineage *lineage);

/* ---- campaign_excluded.c ---- */
/* The forms of the bodies that the campaign's controller and its ancestors were pretrained on:
 * drawn again, or shared with another campaign that has them or draws them. *exclusion NULL: there
 * are none. MO_ERR_CANCELLED: a wish came. */
int mo_exclusion_acquire(struct mo_campaign_run *run, struct mo_exclusion **exclusion);
void mo_exclusion_release(struct mo_campaign_run *run,
                          struct mo_exclusion *exclusion); /* NULL-safe */
const struct mo_form_set *mo_exclusion_forms(const struct mo_exclusion *exclusion);

#endif
