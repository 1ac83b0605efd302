/* evaluations.h: evaluations: submission and results. Threads and errors as in store.h. */
#ifndef MORPHO_STORE_EVALUATIONS_H
#define MORPHO_STORE_EVALUATIONS_H

#include "store/records.h"

struct mo_store;

/* Writes warnings about a time step beyond the linear stability bound, and about a controller that
 * acts in every short step. Returns their number. */
#define MO_PHYSICS_WARNINGS_MAX 2
uint32_t mo_warn_of_physics(const struct mo_physics *physics,
                            struct mo_warning warnings[MO_PHYSICS_WARNINGS_MAX]);

/* Writes the same warning for a time step that is stable except with the factors of an environment.
 * Returns 0 or 1. */
uint32_t mo_warn_of_world(const struct mo_physics *physics,
                          const struct mo_environment *environment, uint32_t position,
                          struct mo_warning *warning);

/* ---- submission (by jobs) ---- */

/* Bodies `first` to `first + count − 1` of a seed's stream (mo_body_stream). count 0: none. */
struct mo_random_bodies {
  uint32_t first, count; /* first + count ≤ MO_RANDOM_BODIES_MAX */
  uint64_t seed;
};

/* An evaluation as requested (genotypes are valid) and as stored (genotypes are placed, and have
 * their forms). More than MO_DESIGNS_MAX designs have no notes. */
struct mo_evaluation_request {
  struct mo_submission job;
  const struct mo_bits *genotypes; /* (n_designs); NULL: random bodies */
  const struct mo_bits *forms; /* (n_designs) canonical; as stored. NULL: more than MO_DESIGNS_MAX
                                  designs are listed, and are placed and stored after the
                                  submission */
  uint32_t n_designs;          /* with n_skipped 1 … MO_LARGE_MAX */
  struct mo_random_bodies random; /* without genotypes: their count is n_designs */
  struct mo_design_note *notes;   /* (n_notes) ascending; the submission completes the notes on
                                     ids */
  uint32_t n_notes, n_skipped;    /* n_skipped: notes of skipped designs */
  const char *environment_set;    /* of mo_set_words or mo_suite_words; NULL: `environments` */
  const struct mo_environment *environments; /* (n_environments) checked */
  uint32_t n_environments;                   /* 1 … MO_ENVIRONMENTS_MAX; ignored with a set */
  const char *controller;                    /* name or "sha256:<64 hex>" */
  struct mo_physics physics;                 /* checked */
  enum mo_precision precision;
  uint32_t best;        /* number of best designs that get complete scores; 0: all */
  uint32_t n_displaced; /* displaced starts that estimate the errors of the scores; 0: no estimate.
                           The settings of all runs (score_error.h) are checked */
  uint32_t measures;    /* of the rollouts, as bits (morpho/measure.h) */
  double tolerance; /* of the estimated errors, with n_displaced > 0; 0: none. The settings of all
                       rungs (score_ladder.h) are checked */
  bool verify;
  unsigned record;        /* channels */
  uint32_t record_stride; /* 1 … n_steps; ignored if nothing is recorded */
};
/* Stores an evaluation in one transaction: designs, genotypes, environments, settings, job, key and
 * event. Errors as in mo_jobs_submit_evaluation. */
int mo_store_submit(struct mo_store *store, const struct mo_evaluation_request *request,
                    int64_t *id, bool *replayed);

/* ---- results ---- */

/* The climb of a design (score_ladder.h), and the results of its rungs. */
struct mo_climbed {
  struct mo_climb climb;
  uint32_t n; /* rungs with complete losses; 0: none yet, or a skipped design */
  struct mo_score_error errors[MO_LADDER_RUNGS];
  double scores[MO_LADDER_RUNGS]; /* +infinity: a rollout diverged */
};
/* The results of an evaluation. Rows are designs, columns are environments, both in the order of
 * the request. A design that was skipped is empty; its losses and score are NaN. */
struct mo_evaluation_results {
  uint32_t n_designs, n_environments;
  struct mo_bits *forms;     /* (n_designs) canonical */
  struct mo_bits *genotypes; /* (n_designs) placed, as evaluated */
  double *scores;            /* (n_designs) mean loss; +infinity: a rollout diverged */
  uint8_t *is_bound; /* (n_designs) 1: the score is a lower bound, in which losses count as 0 that
                        were not computed because the design cannot be among the best */
  double *losses;    /* (n_designs, n_environments); +infinity: diverged; NaN: not computed yet, or
                        never */
  int32_t *diverged_steps; /* (n_designs, n_environments); 0: did not diverge */
  /* Verify jobs only, else NULL: `losses` were recomputed by this job; these were stored before. */
  double *stored_losses; /* (n_designs, n_environments); NaN: not stored */
  uint8_t *agrees; /* (n_designs): 1: every stored loss equals the recomputed one, bit for bit */
  struct mo_score_error *errors; /* (n_designs) NULL: no estimates */
  /* Requested measures, else measure_set is 0 and these are NULL. */
  uint32_t measure_set, n_measures;
  double *measures; /* (n_designs, n_environments, n_measures) those of the set, in its order; NaN:
                       without a value, diverged, or not computed */
  uint8_t *flags;   /* (n_designs, n_environments) bits of enum mo_measure_flag */
  /* With a tolerance, else NULL: the scores and losses above are those of the chosen rungs. */
  struct mo_climbed *climbed; /* (n_designs) */
  double tolerance;
  struct mo_setting rungs[MO_LADDER_RUNGS];
  double *paths_m; /* (n_designs) mean path length of the center of mass over the environments; NaN:
                      not recorded in all of them */
  struct mo_design_note *notes; /* (n_notes) on all designs of the request, ascending */
  uint32_t n_notes;
};
void mo_evaluation_results_free(void *results); /* NULL-safe */

struct mo_trajectory {
  uint32_t n_frames, n_masses, n_springs; /* n_springs: 0 without actuation */
  double dt_s;
  struct mo_recording recording;
};
void mo_trajectory_free(void *trajectory); /* NULL-safe */

/* Reads the results of an evaluation. If it is unfinished, reads the results so far.
 * MO_ERR_NOT_FOUND. */
int mo_store_results(struct mo_store *store, int64_t id, struct mo_evaluation_results **results);
/* Reads the results without the measures. */
int mo_store_results_unmeasured(struct mo_store *store, int64_t id,
                                struct mo_evaluation_results **results);
/* Reads the results of design n only, as results of one design. */
int mo_store_result(struct mo_store *store, int64_t id, uint32_t n,
                    struct mo_evaluation_results **results);
/* Reads the numbers of designs, starting at `first`: the designs with complete scores (in an
 * evaluation that has ended) or, with `any`, all designs. Returns how many, at most `limit`;
 * MO_ERR_NOT_FOUND. */
int64_t mo_store_result_numbers(struct mo_store *store, int64_t id, uint32_t first, bool any,
                                uint32_t *numbers, size_t limit);

/* Reads the trajectory of design n in environment k (both from 0). MO_ERR_NOT_FOUND: no such
 * evaluation, design or environment, or nothing is recorded (yet). */
int mo_store_trajectory(struct mo_store *store, int64_t id, uint32_t n, uint32_t k,
                        struct mo_trajectory **trajectory);

struct mo_trajectory_sides {
  uint64_t n; /* stored trajectories */
  uint32_t frames, masses, springs;
};
/* Reads the number of trajectories of an evaluation, and their largest dimensions. MO_ERR_CORRUPT:
 * their numbers of frames differ. */
int mo_store_trajectory_sides(struct mo_store *store, int64_t id,
                              struct mo_trajectory_sides *sides);

/* Removes all trajectories of an evaluation, with an event. *bytes: the space that they used; 0 if
 * there were none. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: the evaluation has not ended, and continues
 * from its trajectories. */
int mo_store_trajectories_remove(struct mo_store *store, int64_t id, uint64_t *bytes);

#endif
