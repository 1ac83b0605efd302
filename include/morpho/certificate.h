/* certificate.h: how much the score of a design can be trusted: how it changes with the time step,
 * the worlds and the constants of the physics.
 *
 * A certificate scores a list of designs in *trials*. The first trial is the base: the designs in
 * the environments and with the physics that were requested. Each other trial changes one thing,
 * its axis, by a level: a finer step, different friction, fresh worlds. The figures follow from the
 * losses of all trials: per design its score at each level and the change from the base; per level
 * Kendall's tau-b between the scores of the designs there and at the base, and the regret of
 * choosing the top k by the base; and a verdict in words. docs/trust.md defines them.
 *
 * All of this is a function of settings and losses: equal inputs give equal bits. */
#ifndef MORPHO_CERTIFICATE_H
#define MORPHO_CERTIFICATE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/rollout.h>
#include <morpho/world.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_CERTIFICATE_DESIGNS_MAX  256
#define MO_CERTIFICATE_HELD_OUT_MAX 1024
#define MO_CERTIFICATE_WORLDS_MAX   256
#define MO_CERTIFICATE_CHANCE_MAX   64
#define MO_CERTIFICATE_LEVELS_MAX   8    /* of factors, which are the same for each constant */
#define MO_CERTIFICATE_CHANCE       1e-4 /* largest relative change on the axis `chance` */

/* In a fixed order: new axes are appended. The levels of an axis are in brackets; an axis without
 * levels is one trial, with the level NaN. */
enum mo_axis {
  MO_AXIS_BASE = 0,
  MO_AXIS_PRECISION, /* float64 [64] */
  MO_AXIS_STEP,      /* dt / level in float64 [2, 4]; the controller decides at the same times as in
                        the base. Its change includes that of the precision */
  MO_AXIS_HELD_OUT,  /* fresh worlds; mo_certificate_environments defines their kind */
  MO_AXIS_CHANCE,    /* the base's worlds with all constants changed by at most 0.01 %, as often as
                        the settings say: how much of a score is luck */
  MO_AXIS_STIFFNESS, /* a constant times the level [settings.levels]; and so on */
  MO_AXIS_MASS,
  MO_AXIS_DRAG,
  MO_AXIS_GRAVITY,
  MO_AXIS_ACTUATION,
  MO_AXIS_FRICTION,
  MO_AXIS_DROP,   /* drop_height_m + level [0.05, 0.2] */
  MO_AXIS_WORLDS, /* all constants drawn from `ranges` by Latin hypercube, in the base's worlds in
                     turn */
  MO_AXES
};
extern const char *const mo_axis_words[]; /* "base", "precision", "step", "held_out", …, NULL */
#define MO_AXES_ALL ((UINT32_C(1) << MO_AXES) - 1)

struct mo_certificate_settings {
  uint64_t seed;     /* 1 */
  uint32_t axes;     /* bits 1 << enum mo_axis; the base is always included */
  uint32_t held_out; /* 256: worlds, 2 … MO_CERTIFICATE_HELD_OUT_MAX */
  uint32_t worlds;   /* 64: 2 … MO_CERTIFICATE_WORLDS_MAX */
  uint32_t chance;   /* 16: 2 … MO_CERTIFICATE_CHANCE_MAX */
  uint32_t top;      /* 0: a tenth of the designs, at least 1 */
  uint32_t n_levels; /* 1 … MO_CERTIFICATE_LEVELS_MAX */
  double levels[MO_CERTIFICATE_LEVELS_MAX]; /* 0.7, 0.9, 1.1, 1.3; MO_FACTOR_MIN … MAX, ascending,
                                               without 1 */
  struct mo_factor_ranges ranges;           /* 0.7 to 1.3, and friction 1/3 to 4/3 */
};
struct mo_certificate_settings mo_certificate_defaults(void);
/* MO_ERR_INVALID or MO_ERR_RANGE; message names the member and says what to do. */
int mo_certificate_check(const struct mo_certificate_settings *settings,
                         struct mo_message *message);

/* One level of one axis. A level with more worlds than a job may list is still one trial: the
 * caller scores it in parts. */
struct mo_trial {
  enum mo_axis axis;
  double level; /* NaN: the axis has none */
  enum mo_precision precision;
  struct mo_physics physics;
  uint32_t n_environments;
  bool is_paired; /* world k is the base's world k % (its number of worlds), apart from the level */
  bool measures;  /* peak_strain and inverted_voxels of each rollout are requested: for the base */
};
/* What the trials are built from. */
struct mo_certificate_base {
  struct mo_physics physics; /* checked in all environments, and completed for the controller
                                (mo_physics_complete) */
  enum mo_precision precision;
  const struct mo_environment *environments; /* (n_environments) borrowed */
  uint32_t n_environments;                   /* at least 1 */
  const char *set; /* the word of mo_set_words if the environments are that set, unchanged; or
                      NULL */
};
/* Lists the trials of a certificate, ordered by axis and level; the base is the first. Leaves out
 * axes and levels that do not apply (mo_certificate_omits, mo_certificate_note). The settings have
 * been checked. *trials: (n) malloc, owned by the caller. MO_ERR_NO_MEMORY. */
int mo_certificate_trials(const struct mo_certificate_settings *settings,
                          const struct mo_certificate_base *base, struct mo_trial **trials,
                          uint32_t *n);
/* Fills in the environments of one trial: (trial->n_environments); grids are borrowed from the
 * base. MO_ERR_NO_MEMORY.
 *
 * Held out, the worlds are, for the base
 *   "paper-test"       mo_environment_held_out: drawn as training draws them. Their lights are 0.4
 *                      to 2.0 m away, those of the test set 1.5 and 2.0 m
 *   "morpho-12-TASK"   the first of "morpho-12-TASK-held-out", which has 64
 *   a list             mo_held_out_tasks, with the tasks, the damage and the factors of the list in
 *                      turn. Only if each of its worlds could occur in training: rough 8 × 8
 *                      heights, the lowest of which is MO_TERRAIN_FLOOR_M, and a fixed light, if it
 *                      has one, 0.4 to 2.0 m from the center
 */
int mo_certificate_environments(const struct mo_certificate_settings *settings,
                                const struct mo_certificate_base *base,
                                const struct mo_trial *trial, struct mo_environment *environments);
/* Returns why an axis has no trial, as a sentence for the reply; NULL: it has one, or was not
 * requested. */
const char *mo_certificate_omits(const struct mo_certificate_settings *settings,
                                 const struct mo_certificate_base *base, enum mo_axis axis);
/* Writes what a reader of the axis must know, as sentences for the reply: fewer worlds than
 * requested, levels that are left out, levels with which the springs of some bodies are unstable,
 * and worlds that differ in kind from the base's. Returns false if there is nothing. */
bool mo_certificate_note(const struct mo_certificate_settings *settings,
                         const struct mo_certificate_base *base, enum mo_axis axis,
                         struct mo_message *note);

/* ---- figures ----
 *
 * Sums are pairwise, in the order of worlds and designs, and no function of libm but sqrt is used,
 * so that equal losses give equal figures on all machines. */

/* A 95 % confidence interval; NaN, NaN: unknown. */
struct mo_interval {
  double lo, hi;
};
/* A design at one level. If a rollout diverged, the numbers are NaN: there is no mean. */
struct mo_trial_score {
  double score; /* mean loss over the worlds */
  /* Interval of the mean loss over all worlds of this kind, by Student's t. Unknown for a single
   * world. Losses are skewed, so intervals from ten worlds contain that mean in 90 to 95 of 100
   * cases. Where a trial repeats each world of the base (`worlds`), the base's worlds are the
   * independent units: the variance is that of the sums over the repetitions of each (CR1, Cameron
   * & Miller 2015). `chance`: a prediction interval for the score in one more copy of the worlds,
   * because the question is how much chance changes a score. */
  struct mo_interval interval;
  /* The score minus the base's score, with its interval. Paired: the mean, over the worlds, of the
   * loss here minus the base's loss in the same world; its interval is computed like that of the
   * score. Otherwise: the difference of the means, with Welch's interval, for which the degrees of
   * freedom are rounded down. Unknown for the base. */
  double change;
  struct mo_interval of_change;
  uint32_t diverged; /* rollouts */
  uint32_t rank;     /* 1 … n among the designs; diverged ones are last; equal scores share one */
};
/* All designs at one level. Designs that diverged, at this level or at the base, do not count in
 * tau. On the axis `chance`, tau, regret and top_score are means over the copies of the worlds:
 * each describes a single copy, not the mean score over the copies, which depends less on chance
 * than a score of the base does. */
struct mo_trial_list {
  double mean_score; /* over designs without a divergence */
  uint32_t n_diverged_designs;
  double tau; /* Kendall's tau-b between the scores at this level and at the base; NaN: at the base,
                 for fewer than two designs, or if all scores are equal */
  /* Interval of tau over all designs of this kind. Unknown for fewer than MO_TAU_DESIGNS_MIN
   * designs. The jackknife variance of tau over designs, which is consistent (Arvesen 1969), gives
   * the number of independent pairs that would have the same variance, (1 − tau²) / variance, at
   * least half the number of designs (Hoeffding 1948) and at most that of all pairs; Wilson's score
   * interval (1927) with this number stays within [−1, 1]. If all pairs agree, or all disagree, the
   * variance used is the one with a single exception. */
  struct mo_interval of_tau;
  /* For the designs that are best at the base (mo_certificate_top): their mean score at this level,
   * and how far it is above the mean score of the same number of designs that are best at this
   * level. NaN: one of them diverged at this level. The base's regret is NaN. */
  double top_score, regret;
};
#define MO_TAU_DESIGNS_MIN 4
/* losses: (n_designs, trials[t].n_environments) per trial t; +infinity: diverged. The base is the
 * first trial; an incomplete certificate has the figures of the trials scored so far. scores:
 * (n_trials, n_designs); lists: (n_trials); both filled in. MO_ERR_NO_MEMORY. */
int mo_certificate_figures(const struct mo_certificate_settings *settings,
                           const struct mo_trial *trials, uint32_t n_trials,
                           const float *const *losses, uint32_t n_designs,
                           struct mo_trial_score *scores, struct mo_trial_list *lists);
/* Returns the number of designs that top_score and regret cover: fewer than requested if not enough
 * are free of divergence at the base. */
uint32_t mo_certificate_top(const struct mo_certificate_settings *settings, uint32_t n_designs);

/* ---- verdicts ----
 *
 * Sentences by rules; equal figures give equal sentences. Numbers are rounded to two digits. An
 * axis that has no trial has no sentence. */

#define MO_VERDICT_MAX 1024
/* A body that stands still has a loss of 1. A score is worse at a level if it is higher by this
 * much or more, and the interval of its change, if known, is above 0. */
#define MO_VERDICT_CHANGE 0.05
#define MO_VERDICT_AXES   2 /* at most this many axes, those with the worst change, are named */
#define MO_VERDICT_RANKS                                                                           \
  0.1 /* a rank that moves by at most this share of the designs, or by 1, is                       \
         roughly kept */
/* An order holds if the interval of tau is at or above the first, and at least in part if it is at
 * or above the second; it does not hold if the interval is below the second. Otherwise, and with
 * fewer designs than MO_VERDICT_DESIGNS, it is undetermined. */
#define MO_VERDICT_HOLDS   0.8
#define MO_VERDICT_PARTLY  0.5
#define MO_VERDICT_DESIGNS 5

/* Describes a design: flags; its rank and score on the finest steps, or in float64; how far luck
 * moves its score, and over which ranks; with which constants it is worse, the worst first; its
 * score in fresh worlds. Example: "With finer time steps, it keeps rank 1, and its score changes
 * from 0.0086 to 0.0088. Its score worsens from 0.0086 to 0.34 when friction is multiplied by 0.5."
 * flags: of mo_measures_flags, over its rollouts at the base. */
void mo_certificate_verdict(const struct mo_trial *trials, uint32_t n_trials,
                            const struct mo_trial_score *scores, uint32_t n_designs,
                            uint32_t design, uint32_t flags, char text[MO_VERDICT_MAX]);

/* A verdict in brief: the first of these that holds for a design. */
enum mo_verdict_class {
  MO_CLASS_NO_SCORE = 0, /* it diverges at the base */
  MO_CLASS_IN_DOUBT = 1, /* its rank is not roughly kept on the finest steps (or in float64, without
                              finer steps), or it diverges there. A design alone: its score */
  MO_CLASS_DEPENDS = 2,  /* it is worse, or diverges, in fresh worlds or with other constants */
  MO_CLASS_HOLDS = 3     /* no level of the certificate says otherwise */
};
extern const char *const mo_verdict_words[]; /* "no_score", "in_doubt", "depends", "holds", NULL */
struct mo_verdict {
  enum mo_verdict_class class;
  uint32_t worse; /* as bits 1 << enum mo_axis: axes with a level at which it is worse, or diverges;
                     without the base, precision, step and chance */
  uint32_t finest; /* the trial with the smallest numerical error; 0: none */
  bool is_kept;    /* its rank, or the score of a design alone, is roughly kept there */
};
struct mo_verdict mo_certificate_brief(const struct mo_trial *trials, uint32_t n_trials,
                                       const struct mo_trial_score *scores, uint32_t n_designs,
                                       uint32_t design);
/* About the list: where its order holds, holds at least in part, does not hold, and is
 * undetermined, of single changes only at the level with the lowest tau; the largest regret; the
 * worst mean score; divergences. */
void mo_certificate_list_verdict(const struct mo_trial *trials, uint32_t n_trials,
                                 const struct mo_trial_list *lists, uint32_t n_designs,
                                 char text[MO_VERDICT_MAX]);

#ifdef __cplusplus
}
#endif
#endif
