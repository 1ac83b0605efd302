/* campaign_run.h: the state of one running campaign, and the phases of a generation. Only for the
 * files campaign*.c of this room.
 *
 * The candidates of a generation lie in one row: the population (n_parents, best first), then its
 * children. Place i of each array belongs to candidate i. Each body is stored twice: in the
 * campaign's workspace for variation, selection and diversity, and in the service's workspace for
 * the controllers and the store. */
#ifndef MORPHO_JOBS_CAMPAIGN_RUN_H
#define MORPHO_JOBS_CAMPAIGN_RUN_H

#include "jobs/campaign_learn.h"
#include "jobs/campaign_score.h"
#include "jobs/campaigns.h"
#include "store/studies.h"

/* The candidates of a generation: type, name and length of each column. n: the population; words:
 * of a genotype; e: environments. bits: in the service's workspace; forms, births: of the children;
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

/* Each part belongs to the file in parentheses. The other files only read it. */
struct mo_campaign_run {
  /* What is run, and with which settings (campaign_resume.c). */
  struct mo_runner *runner;
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_campaign_status status; /* as of the start of the generation; the campaign may have been
                                     * extended since */
  const struct mo_campaign_settings *settings; /* in the status */
  const struct mo_mode *mode;                  /* the mode in the settings */
  struct mo_controller *controller;            /* as submitted; NULL: random weights */
  struct mo_environment *environments;
  uint32_t n_environments;
  size_t words; /* words of a genotype in the campaign's workspace */

  /* The progress (campaign.c). */
  uint32_t generation; /* the current one */
  uint64_t n_designs;  /* number born before this generation */
  bool is_exhausted;   /* no child was found */
  bool has_ended;      /* the end is written */

  /* The candidates (campaign_vary.c, campaign_select.c). */
  struct mo_exclusion *exclusion;
  struct mo_seen *seen;
  struct mo_study_batch *batch; /* of a study */
  uint32_t n_parents, n_children, n_survivors;
  /* A commit may still be reading other_rows (mo_campaign_wait_for_commit). */
  struct mo_campaign_rows *rows, *other_rows, all_rows[2];
  struct mo_variation_counts variation;

  struct mo_re_evaluated held_out[MO_ELITE_MAX]; /* (n_held_out) campaign_re_evaluate.c */
  uint32_t n_held_out;

  struct mo_campaign_learning learning; /* campaign_learn.c */
  struct mo_campaign_scores scores;     /* campaign_score.c */
  struct mo_campaign_race race;         /* campaign_race.c */

  /* The commit in progress, and the data that it needs from earlier ones (campaign_commit.c). */
  struct mo_campaign_writing *writing;
  struct {
    double max;     /* so far */
    bool is_warned; /* a collapse was reported since that maximum */
  } diversity;

  /* Times, for the live figures (campaign_live.c). */
  struct {
    int64_t begin_us;    /* when this process started the generation */
    int64_t progress_us; /* of the last progress event */
    double prepared_s;   /* wall time before generation 0, counted as part of it; else 0 */
    double generation_s; /* wall time of the newest generation, without prepared_s; 0: unknown */
    uint64_t generation_rollouts; /* of its scores */
  } times;
};

/* ---- campaign_live.c ---- */
void mo_campaign_enter(struct mo_campaign_run *run, enum mo_phase phase, uint64_t total);
/* Sets the progress in the live figures of the phase. rollouts_per_s 0: unchanged. */
void mo_campaign_advance(struct mo_campaign_run *run, uint64_t done, double rollouts_per_s);
/* Returns the live figures as JSON for "campaign.progress", or NULL if less than a second has
 * passed since run->times.progress_us, which is set when the event is written. */
const char *mo_campaign_progress(const struct mo_campaign_run *run, char text[256]);

/* Returns how many measures the campaign names. */
static inline uint32_t mo_campaign_n_means(const struct mo_campaign_run *run)
{
  return (uint32_t)__builtin_popcount(run->status.record.measures);
}

/* ---- campaign_submit.c ---- */
/* Estimates the memory of a campaign. record: with the number of its environments. controller:
 * nullable. Returns the errors of mo_lineage_read. */
int mo_campaign_need(struct mo_jobs *jobs, const struct mo_campaign_record *record,
                     const struct mo_sha256 *controller, enum mo_back_end back_end,
                     struct mo_need *need, struct mo_message *message);

/* ---- campaign_resume.c ---- */
/* Reads the campaign, its controller, its environments and its newest population. */
int mo_campaign_resume(struct mo_campaign_run *run);
void mo_campaign_free_rows(struct mo_campaign_run *run);

/* ---- campaign_vary.c ---- */
/* Collects, once, the designs that must not be born again. Does nothing for a study. */
int mo_campaign_read_seen(struct mo_campaign_run *run);
/* Makes the children, or reads the children of a study's batch. MO_ERR_EXHAUSTED: no child was
 * found. */
int mo_campaign_vary(struct mo_campaign_run *run);

/* ---- campaign_select.c ---- */
int mo_campaign_select(struct mo_campaign_run *run);
/* Copies the survivors, in order, to run->other_rows. No commit may be reading these rows. */
int mo_campaign_succeed(struct mo_campaign_run *run);

/* ---- campaign_re_evaluate.c ---- */
/* Scores the best survivors in fresh worlds, if this is due. Call it after mo_campaign_succeed. */
int mo_campaign_re_evaluate(struct mo_campaign_run *run);

/* ---- campaign_commit.c ---- */
/* Describes the selected generation and starts its commit, once the previous commit has ended. The
 * commit reads run->rows until it has ended, and takes ownership of the losses of a campaign that
 * does not learn. The survivors are in run->other_rows. */
int mo_campaign_commit(struct mo_campaign_run *run);
void mo_campaign_writing_free(struct mo_campaign_run *run);
/* Returns whether mo_campaign_wait_for_commit would have to wait for the store. */
bool mo_campaign_is_writing(const struct mo_campaign_run *run);
/* Waits for the commit in progress. Returns MO_OK even if there is none, and otherwise the errors
 * of mo_runner_persist. MO_ERR_CANCELLED: a request arrived while the commit waited for space; the
 * call may be repeated. */
int mo_campaign_wait_for_commit(struct mo_campaign_run *run);
/* Writes as mo_runner_persist does, but after the commit in progress. Once a campaign has committed
 * a generation, all its other writes use this function. */
int mo_campaign_persist(struct mo_campaign_run *run, int (*write)(void *context), void *context,
                        const char *what);
/* Adds an event about the progress, at most once per second, unless a commit is being written. A
 * lost event is not an error, but a failed commit is. */
int mo_campaign_report(struct mo_campaign_run *run);
/* Waits only until the thread has ended. */
void mo_campaign_writing_join(struct mo_campaign_run *run);

#endif
