/* campaign_run.h: the state of one running campaign. Only for the files campaign_*.c of this room.
 *
 * The candidates of a generation lie in one row: the population (n_parents, best first), then its
 * children. Place i of each array belongs to candidate i. Each body is stored twice: in the
 * campaign's workspace for variation, selection and diversity, and in the default workspace for the
 * controllers and the store. */
#ifndef MORPHO_JOBS_CAMPAIGN_RUN_H
#define MORPHO_JOBS_CAMPAIGN_RUN_H

#include "jobs/campaigns.h"
#include "jobs/learner.h"
#include "jobs/scoring.h"
#include "store/studies.h"

/* The candidates of a generation: type, name and length of each column. n: the population; words:
 * of a genotype; e: environments. bits: in the default workspace; forms, births: of the children;
 * parent_losses: NaN: not known; cut: the score is a lower bound. */
/* clang-format off */
#define MO_CAMPAIGN_COLUMNS(X)                                                                     \
  X(uint64_t, genotypes, 2 * n * words) X(struct mo_bits, bits, 2 * n)                             \
  X(struct mo_design_size, sizes, 2 * n) X(double, scores, 2 * n) X(uint32_t, numbers, 2 * n)      \
  X(uint32_t, born, 2 * n) X(struct mo_bits, forms, n) X(struct mo_birth, births, n)               \
  X(uint32_t, survivors, n) X(double, parent_losses, n * e) X(uint8_t, cut, 2 * n)
/* clang-format on */
struct mo_campaign_rows {
#define MO_COLUMN(type, name, length) type *name;
  MO_CAMPAIGN_COLUMNS(MO_COLUMN)
#undef MO_COLUMN
};

struct mo_campaign_run {
  struct mo_runner *runner;
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_campaign_status status; /* from the start of the generation; may be extended since */
  const struct mo_campaign_settings *settings; /* of the status */
  struct mo_controller *controller;            /* as submitted; NULL: random weights */
  struct mo_environment *environments;
  uint32_t n_environments;
  struct mo_exclusion *exclusion;
  struct mo_seen *seen;
  struct mo_study_batch *told; /* of a study */
  size_t words;                /* of a genotype of the campaign's workspace */

  uint32_t generation; /* the current one */
  uint32_t n_parents, n_children;
  bool is_exhausted; /* no child was found */
  /* A commit may still read other_rows (mo_campaign_settle). */
  struct mo_campaign_rows *rows, *other_rows, all_rows[2];
  uint32_t n_survivors;
  uint64_t n_designs; /* born before this generation */
  struct mo_variation_counts variation;
  double diversity_max; /* so far */
  bool is_warned;       /* a collapse was reported since that maximum */
  int64_t begin_us;     /* start of the generation in this process */
  double prepared_s;    /* wall time before generation 0, which counts toward it; else 0 */
  int64_t progress_us;  /* time of the last progress event */
  double generation_s;  /* wall time of the newest generation, without prepared_s; 0: unknown */
  uint64_t generation_rollouts; /* of its scores */

  /* Learning (campaign_learn.c). */
  struct mo_learner learner;
  struct mo_campaign_step *steps; /* (parent + child steps) not written from steps_saved on */
  uint32_t step, steps_saved;     /* steps done in this generation; at the last checkpoint */
  int64_t checkpoint_us;
  double first_loss, last_loss;

  /* Scores of the candidates from `first_scored` on (campaign_score.c). */
  struct mo_scoring scoring;
  uint32_t first_scored, n_scored;
  struct mo_compute_controller *frozen; /* zero-shot: ready for the back end; NULL at first */
  struct mo_campaign_loss *losses;      /* (n_scored) */
  uint32_t *unsaved;                    /* (n_scored) places whose losses are not saved yet */
  uint32_t n_unsaved;
  uint32_t n_done;   /* of n_scored */
  uint64_t n_cached; /* losses that were found in the table `scores` */

  /* The race of the children (campaign_race.c). */
  bool races;            /* a race is possible: it is planned, and counted */
  bool race_pays;        /* in the generation before it saved time, or would have */
  uint32_t parents_left; /* parents whose scores the plan waits for */
  struct mo_race race;

  struct mo_campaign_writing *writing; /* the commit in progress (campaign_commit.c) */
};

/* ---- campaign_live.c ---- */
void mo_campaign_enter(struct mo_campaign_run *run, enum mo_phase phase, uint64_t total);
/* Sets the progress that the live figures show for the phase. rollouts_per_s 0: as before. */
void mo_campaign_advance(struct mo_campaign_run *run, uint64_t done, double rollouts_per_s);
/* Returns the JSON of "campaign.progress", or NULL less than a second after run->progress_us, which
 * the caller sets when it has written the event. */
const char *mo_campaign_progress(struct mo_campaign_run *run, const char *phase, uint64_t done,
                                 uint64_t total, char text[256]);

/* ---- campaign_submit.c ---- */
/* Estimates the memory of a campaign. controller: nullable. Errors as mo_lineage_read. */
int mo_campaign_need(struct mo_jobs *jobs, const struct mo_campaign_settings *settings,
                     const struct mo_sha256 *controller, enum mo_back_end back_end,
                     struct mo_need *need, struct mo_message *message);

/* ---- campaign_commit.c ---- */
/* Describes the selected generation and starts its commit, once the one before has ended. The
 * commit reads run->rows until it has ended, and takes the losses of a zero-shot campaign. The
 * survivors are in run->other_rows. */
int mo_campaign_commit(struct mo_campaign_run *run);
void mo_campaign_writing_free(struct mo_campaign_run *run);
/* Returns whether mo_campaign_settle would have to wait for the store. */
bool mo_campaign_is_writing(const struct mo_campaign_run *run);
/* Waits for the commit in progress; call it before any other write. MO_OK also if there is none;
 * errors as mo_runner_persist. MO_ERR_CANCELLED: a request arrived while the commit waited for
 * space; the call may be repeated. */
int mo_campaign_settle(struct mo_campaign_run *run);
/* Waits only until the thread has ended. */
void mo_campaign_writing_join(struct mo_campaign_run *run);

/* ---- campaign_learn.c ---- */
/* Runs the remaining learning steps of this generation. */
int mo_campaign_learn(struct mo_campaign_run *run);
/* Saves a checkpoint of the steps since the last one. */
int mo_campaign_save_learning(struct mo_campaign_run *run);
/* Loads the learning state at the end of the newest committed generation, for the result. */
int mo_campaign_load_learning(struct mo_campaign_run *run);
void mo_campaign_free_learning(struct mo_campaign_run *run);

/* ---- campaign_score.c ---- */
/* Scores the children; in a campaign that learns, the parents, too. */
int mo_campaign_score(struct mo_campaign_run *run);
/* Saves the losses that are not saved yet. run: struct mo_campaign_run. */
int mo_campaign_save_losses(void *run);
void mo_campaign_free_scores(struct mo_campaign_run *run);

/* ---- campaign_race.c ---- */
/* Closes the cells of the children until the race begins, if there is one. After the cells are
 * made; MO_ERR_NO_MEMORY. */
int mo_race_close(struct mo_campaign_run *run);
/* Begins the race, unless parents have no scores yet. After what is known is marked. */
void mo_race_begin(struct mo_campaign_run *run);
/* Goes on with a candidate whose losses have come. is_done: it has no cell left. Returns whether it
 * is done now: it may be cut short. */
bool mo_race_take(struct mo_campaign_run *run, uint32_t place, bool is_done);
/* Returns whether a race saved time in this generation, or would have; if that cannot be said, as
 * before it. */
bool mo_race_pays(const struct mo_campaign_run *run);
/* Keeps the losses of the survivors for the plan of the next generation, in `to`. */
void mo_race_keep(const struct mo_campaign_run *run, struct mo_campaign_rows *to);
/* Reads the losses of the population that a campaign goes on with. */
int mo_race_read(struct mo_campaign_run *run);

#endif
