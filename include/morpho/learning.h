/* learning.h: how the controller learns: the optimizer, schedules, the stream of robots, and the
 * state of one training run (paper, sections 2.4 and 3; appendix A). A run can be saved after any
 * step, and resumes from there bit for bit.
 *
 * The caller drives a run one step at a time:
 *   mo_training_draw    the robots of the step: which body, which environment
 *   (their gradient: mo_compute_gradient, mo_gradient_reference, …)
 *   mo_training_apply   clip, Adam, next step
 * A step depends only on the settings, the starting weights and the gradient: no clocks, no global
 * state. Not for concurrent use. */
#ifndef MORPHO_LEARNING_H
#define MORPHO_LEARNING_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/controller.h>
#include <morpho/gradient.h>
#include <morpho/morphospace.h>
#include <morpho/rollout.h>
#include <morpho/world.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_TRAINING_STEPS_MAX   1000000
#define MO_TRAINING_BATCH_MAX   65536
#define MO_TRAINING_DESIGNS_MAX 10000
/* Limit of n_steps × batch of a pretraining run. The set of bodies seen, which includes the
 * held-out forms, takes 24 to 30 bytes per body: 7.5 GB at this limit. */
#define MO_TRAINING_BODIES_MAX       (UINT64_C(1) << 28)
#define MO_HELD_OUT_ENVIRONMENTS_MAX 64
#define MO_TRAINING_ENVIRONMENTS_MAX 64 /* of a training run in its own environments */
#define MO_GRADIENT_NORM_LIMIT_MAX   1e6

/* ---- learning rate ---- */

enum mo_schedule_kind {
  MO_SCHEDULE_RESTARTS =
      0, /* cosine annealing with warm restarts: from peak · decay^c down to floor in cycle c */
  MO_SCHEDULE_COSINE = 1, /* one cosine from peak to floor over all steps of the training run */
  MO_SCHEDULE_CONSTANT = 2
};
extern const char *const mo_schedule_words[]; /* "restarts", "cosine", "constant", NULL */

struct mo_schedule {
  enum mo_schedule_kind kind;
  double peak, floor;    /* learning rates, > 0, floor ≤ peak ≤ 1 */
  double decay;          /* of the peak from one cycle to the next, 0 < decay ≤ 1 (restarts) */
  uint32_t cycle_steps;  /* of the first cycle, ≥ 1 (restarts) */
  uint32_t cycle_growth; /* growth of the length per cycle, 1 … 1000 (restarts) */
  uint32_t warmup_steps; /* steps in which the rate grows linearly from peak/warmup to peak, before
                            the rest of the schedule; 0: no warm-up. A shorter run ends within the
                            warm-up */
};
/* The paper's three schedules, and this program's own defaults. */
enum mo_schedule_preset {
  MO_SCHEDULE_PAPER_PRETRAIN,     /* 1e-3 → 1e-5, cycles 10, 20, 40, …, decay 0.7 */
  MO_SCHEDULE_PAPER_FINETUNE,     /* between generations: 3.5e-4 → 3.5e-5 over one cycle of 100
                                     steps */
  MO_SCHEDULE_PAPER_SIMULTANEOUS, /* as for pretraining, with decay 0.65 */
  MO_SCHEDULE_ONE_COSINE,         /* 2e-3 → 1e-5, warm-up 10 steps */
  MO_SCHEDULE_FINETUNE_COSINE     /* 3e-4 → 1e-6: fully annealed at any length */
};
extern const struct mo_schedule mo_schedule_presets[];
extern const char *const mo_schedule_preset_words[]; /* "paper-pretrain", …, NULL */
/* Returns the learning rate of step `step` (from 0) of a training run of n_steps, for a schedule
 * that passed mo_training_settings_check. In step s of a cycle of n steps, or s of the n steps
 * after the warm-up of one cosine, the rate is floor + (peak − floor) (1 + cos(π s/n))/2; once
 * decay takes the peak below the floor, the rate is the floor. Bit-exact on every machine. */
double mo_schedule_rate(const struct mo_schedule *schedule, uint32_t step, uint32_t n_steps);

/* ---- settings ---- */

enum mo_training_kind {
  MO_TRAINING_PRETRAIN = 0, /* an endless stream of distinct random bodies, each seen once */
  MO_TRAINING_FINETUNE = 1  /* the given designs, in turn */
};

/* How weights follow from gradients; training runs and campaigns share this. */
struct mo_learning {
  struct mo_schedule schedule;
  double beta1, beta2, epsilon;        /* Adam: 0.9, 0.999, 1e-8 */
  double norm_limit;                   /* limit of the batch gradient's global L2 norm; 1; 0: off */
  struct mo_gradient_options gradient; /* the defaults; weight 0: the mean over the batch */
  struct mo_factor_ranges vary; /* the world of each robot of a step is varied within these ranges
                                   (mo_variations_draw with the run's seed and the step); worlds of
                                   validations are not. Default: nothing varies */
};

/* The defaults above, with a schedule. */
struct mo_learning mo_learning_defaults(enum mo_schedule_preset schedule);

struct mo_training_settings {
  enum mo_training_kind kind;
  uint64_t seed;    /* of bodies, environments and, without a parent, initial weights */
  uint32_t n_steps; /* 1 … MO_TRAINING_STEPS_MAX */
  uint32_t batch;   /* robots per step, 1 … MO_TRAINING_BATCH_MAX */
  struct mo_learning learning;
  struct mo_physics physics;
  enum mo_sensor sensor; /* for a controller with random initial weights; ignored with a parent */
  /* Validation scores these designs in these environments with the current controller. Pretraining:
   * the first mo_held_out_designs of the seed, which it never learns from. Finetuning: the first of
   * the designs that it trains on, or all if there are fewer. The environments are new to the
   * controller, unless the run has its own environments, which are then used. */
  uint32_t held_out_designs;      /* 64; ≤ MO_TRAINING_DESIGNS_MAX */
  uint32_t held_out_environments; /* 8; ≤ MO_HELD_OUT_ENVIRONMENTS_MAX */
};
/* Presets: complete sets of settings, each of which can be changed. Seed 1, physics, sensor,
 * epsilon, beta2, norm_limit and the held-out sets are the same in all; unless noted, so are Adam
 * and the adjoint's bound.
 *   workstation  1400 steps of 256 by one cosine; finetuning: 60 steps by the finetune cosine
 *   phototaxis   how the controller of this name was made: 1400 steps of 8192; after a
 *                warm-up of 5 steps, restarts from 2e-3 to 1e-5, the first cycle of 61 steps,
 *                the next 22 times as long with 0.75 of the peak; beta1 0.8;
 *                MO_ADJOINT_RESTART above 8, weight 3. Only for pretraining: finetuning uses
 *                workstation's
 *   paper        1400 steps of 8192 by the paper's schedule; finetuning: 60; adjoint_bound 0
 *   robust       phototaxis, in worlds that vary: friction 0.33 to 1.33, actuation 0.8 to 1, the
 *                other factors 0.8 to 1.2, drops to 0.1 m, slopes to 10 degrees. Only for
 *                pretraining, too */
enum mo_learning_preset {
  MO_LEARNING_PRESET_WORKSTATION = 0,
  MO_LEARNING_PRESET_PHOTOTAXIS = 1,
  MO_LEARNING_PRESET_PAPER = 2,
  MO_LEARNING_PRESET_ROBUST = 3
};
/* "workstation", "phototaxis", "paper", "robust", NULL. */
extern const char *const mo_learning_preset_words[];
struct mo_training_settings mo_training_preset(enum mo_training_kind kind,
                                               enum mo_learning_preset preset);
struct mo_training_settings
mo_training_defaults(enum mo_training_kind kind); /* the preset workstation */
/* MO_ERR_INVALID, MO_ERR_RANGE; message names the setting, its value and what it must be. */
int mo_training_settings_check(const struct mo_training_settings *settings,
                               struct mo_message *message);

/* ---- held-out sets ---- */

/* Returns 1 if a form is held out, else 0. One canonical form in MO_HELD_OUT_ONE_IN is held out,
 * chosen by a hash of the form and nothing else; no pretraining run draws it, for any seed.
 * Held-out bodies are therefore new to every controller, and two controllers can be compared on
 * them. form: canonical, of the default workspace (MO_DEFAULT_WORDS). */
#define MO_HELD_OUT_ONE_IN 16
int mo_held_out_form(const uint64_t *form);

/* Draws n random bodies with held-out forms, no two with the same form: stream (seed,
 * HELD_OUT_BODY, 0, i), skipping other forms. Longer lists begin with the shorter ones. designs:
 * (n, MO_DEFAULT_WORDS) placed genotypes of the default workspace. About 0.1 ms each.
 * MO_ERR_NO_MEMORY; MO_ERR_RANGE: n > MO_TRAINING_DESIGNS_MAX. */
int mo_held_out_designs(uint64_t seed, uint32_t n, uint64_t *designs);
/* Fills in mo_environment_held_out for this seed, 0 … n − 1: the training distribution under keys
 * that no training run uses. */
void mo_held_out_environments(uint64_t seed, uint32_t n, struct mo_environment *environments);
/* The same with tasks, in turn: environment i has that of tasks[i mod n_tasks], and its light if
 * the task moves the light. n_tasks 0: no tasks. */
void mo_held_out_tasks(uint64_t seed, uint32_t n, const struct mo_environment *tasks,
                       uint32_t n_tasks, struct mo_environment *environments);

/* ---- the state of one training run ---- */

struct mo_training;

/* parent: nullable for MO_TRAINING_PRETRAIN (random weights then); borrowed for the call. designs:
 * (n_designs, MO_DEFAULT_WORDS) placed genotypes for MO_TRAINING_FINETUNE, at most
 * MO_TRAINING_DESIGNS_MAX, copied; else NULL, 0. The caller has checked the settings and designs.
 * MO_ERR_UNSUPPORTED: the parent is not for the default workspace; MO_ERR_NO_MEMORY. */
int mo_training_create(const struct mo_training_settings *settings,
                       const struct mo_controller *parent, const uint64_t *designs,
                       size_t n_designs, struct mo_training **training);
void mo_training_free(struct mo_training *training); /* NULL-safe */

uint32_t
mo_training_step(const struct mo_training *training); /* steps applied so far; n_steps: finished */
uint32_t mo_training_skipped(
    const struct mo_training *training); /* number of those that changed no weight */
const struct mo_training_settings *mo_training_settings_of(const struct mo_training *training);
const struct mo_controller *
mo_training_controller(const struct mo_training *training); /* current weights; borrowed */

/* Gives a new training run its own environments (copied; n: 1 … MO_TRAINING_ENVIRONMENTS_MAX; each
 * has passed mo_environment_check), for example with tasks. Robot i of step t then has one of them,
 * all equally likely: stream (seed, TRAINING_WORLD, t, i). Checkpoints keep them. If the settings
 * vary worlds, each has passed mo_environment_check_vary, too. MO_ERR_RANGE: n;
 * MO_ERR_CONFLICT: a step has been drawn already; MO_ERR_NO_MEMORY. */
int mo_training_set_environments(struct mo_training *training,
                                 const struct mo_environment *environments, uint32_t n);
/* The same, but robots get drawn environments as usual, with the tasks of the given ones, and with
 * their lights if the task moves the light. */
int mo_training_set_tasks(struct mo_training *training, const struct mo_environment *tasks,
                          uint32_t n);
/* Returns the run's own environments, or its tasks: (*n), borrowed; NULL, 0: none. */
const struct mo_environment *mo_training_environments(const struct mo_training *training,
                                                      uint32_t *n);

/* Draws the robots of the current step: (batch), borrowed until the next draw or apply. Robot i of
 * step t has mo_environment_training(seed, t, i), or one of the run's own. A restored pretraining
 * run first replays its stream: a non-zero `cancel` (nullable) stops that with MO_ERR_CANCELLED;
 * `replayed` (nullable) counts the bodies redrawn so far, out of step × batch. Drawing twice
 * returns the same robots; after an error, the next call continues where the failed call stopped.
 * Memory: the bodies of the step (for finetuning, of all its designs), up to 25 kB each.
 * MO_ERR_EXHAUSTED: no new bodies are left; MO_ERR_CORRUPT: the replay needed a different number of
 * draws (the checkpoint is from different code); MO_ERR_CONFLICT: the run is finished;
 * MO_ERR_NO_MEMORY. */
int mo_training_draw(struct mo_training *training, const volatile int *cancel,
                     volatile uint64_t *replayed, const struct mo_robot **robots);

/* Draws the robots of the step after the current one, so that the next draw finds them ready. Call
 * it while the gradient of the current robots, which do not change, is being computed. During the
 * call only mo_training_controller, _step, _settings_of and _encode may be called for this
 * training. Also MO_OK if there is no such step. Errors as for a draw; an error changes no
 * result. */
int mo_training_draw_ahead(struct mo_training *training, const volatile int *cancel);
const struct mo_robot *
mo_training_robots_ahead(struct mo_training *training); /* the robots drawn ahead; NULL if none */
/* Sets how many threads make the robots of a step and apply its gradient (initially 1); they stop
 * at the end of each call. Changes no result. Useful for a thousand robots or more: one thread
 * makes about 30,000 per second. */
void mo_training_set_threads(struct mo_training *training, uint32_t n_threads);

/* Replaces the designs of a finetuning run, as a campaign does between steps: starting with the
 * current step, the run trains on the new designs (copied; as in mo_training_create). Discards a
 * drawn step. MO_ERR_NO_MEMORY: nothing changed. */
int mo_training_set_designs(struct mo_training *training, const uint64_t *designs, size_t n);
/* Makes a training run longer or shorter: n_steps ≥ the steps applied. Fails with
 * MO_ERR_UNSUPPORTED if the schedule depends on n_steps, because the steps applied so far would
 * then have had other rates. */
int mo_training_set_steps(struct mo_training *training, uint32_t n_steps);

/* The result of a step. */
struct mo_training_report {
  uint32_t step;        /* from 1 */
  double mean_loss;     /* over the robots that did not diverge, regardless of their tasks; NaN if
                           all diverged */
  double rate;          /* learning rate */
  double gradient_norm; /* of the batch gradient before the norm clip; 0 if skipped */
  double clipped_share; /* of backward steps with an adjoint above the bound */
  double clipped_robots_share;
  uint32_t diverged, zeroed;
  bool skipped;     /* not finite (gradient or new weights), or no robot contributed: weights and
                       moments did not change */
  uint32_t bounded; /* weights clamped to ±MO_WEIGHT_LIMIT */
};
/* Applies the gradient (n_parameters) of the mean loss of the robots last drawn: advances weights,
 * moments and counters by one step; a skipped step counts as a step. outcomes: (batch), in the
 * order of the robots. counts: of this step only. report nullable. MO_ERR_CONFLICT: nothing was
 * drawn, or the run is finished. */
int mo_training_apply(struct mo_training *training, const double *d_parameters,
                      const struct mo_outcome *outcomes, const struct mo_gradient_counts *counts,
                      struct mo_training_report *report);

/* ---- checkpoints ---- */

/* Encodes everything that the rest of the run depends on (malloc): settings, step, weights,
 * moments, counters, designs, environments. Equal states encode to equal bytes, whether or not a
 * step has been drawn. The checksum detects any change within 8 consecutive bytes. Size: 12.4 MB
 * and 24 bytes per design, and at most 80 kB of environments. MO_ERR_NO_MEMORY. */
#define MO_CHECKPOINT_BYTES_MAX (UINT64_C(16) << 20)
int mo_training_encode(const struct mo_training *training, uint8_t **bytes, size_t *size);
/* MO_ERR_FORMAT (not a checkpoint, damaged, or an unknown version; message says which),
 * MO_ERR_NO_MEMORY. */
int mo_training_decode(const uint8_t *bytes, size_t size, struct mo_training **training,
                       struct mo_message *message);

/* The code that computed the gradients of a training run from a step on. The bits of the gradients
 * depend on it and on the inputs. */
#define MO_FINGERPRINT_BYTES 64
#define MO_LINEAGE_MAX       32
struct mo_training_code {
  uint32_t from_step;                     /* steps learned before it */
  char fingerprint[MO_FINGERPRINT_BYTES]; /* as mo_compute_gradient_fingerprint: printable ASCII;
                                             "": unknown */
};
struct mo_training_lineage {
  uint32_t n;
  struct mo_training_code codes[MO_LINEAGE_MAX]; /* from_step ascending, neighbors differ */
};

/* Exports the current controller with its lineage in the metadata:
 *   "morphod.kind"
 *   ".parent"        its sha256, as passed; NULL: "random"
 *   ".seed"          of the data
 *   ".settings"      JSON
 *   ".step"
 *   ".version"       of the code, as passed
 *   ".code"          JSON: the entries of `lineage` (nullable) below this step
 *   ".designs_crc64" for a finetuning run
 *   ".environments_crc64" for a run in its own environments, the number of which is in ".settings"
 * The file contains no time and no host name: equal runs export equal files. The parent's own
 * metadata is not inherited. The caller frees the controller. MO_ERR_NO_MEMORY, MO_ERR_INVALID (a
 * text that is not UTF-8). */
int mo_training_export(const struct mo_training *training, const char *parent_sha256_hex,
                       const char *code_version, const struct mo_training_lineage *lineage,
                       struct mo_controller **controller);

#ifdef __cplusplus
}
#endif
#endif
