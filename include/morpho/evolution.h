/* evolution.h: how a population of designs varies, is selected, and is described (paper,
 * sections 2.5 to 2.7; design, evolution).
 *
 * A campaign is a function of its settings and seed alone. One generation:
 *   mo_variation       children of the population: mutants, then recombinants; none was ever seen
 * before (learning, scores: the caller's) mo_select          who lives, best first, of parents and
 * children together Every random number is of a stream named by (seed, purpose, generation, index),
 * so a generation that was cut off is made again, bit for bit, from the population alone and the
 * set of forms seen so far. Generation 0 is the initial population; generation g ≥ 1 is made from
 * the population that generation g − 1 left.
 *
 * Genotypes are of the campaign's workspace (mo_workspace_words() words each, placed), in arrays of
 * n × words. Scores: mean loss, lower is better, +infinity when a rollout diverged; NaN is not a
 * score. Nothing here is for concurrent use but what is const. */
#ifndef MORPHO_EVOLUTION_H
#define MORPHO_EVOLUTION_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/learning.h>
#include <morpho/morphospace.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_POPULATION_MIN       2
#define MO_POPULATION_MAX       65536
#define MO_GENERATIONS_MAX      100000
#define MO_CAMPAIGN_DESIGNS_MAX (UINT64_C(1) << 28) /* population × (generations + 1) */
#define MO_CAMPAIGN_STEPS_MAX                                                                      \
  10000 /* learning steps of a generation, parents and children each                               \
         */

/* ---- settings ---- */

enum mo_campaign_mode {
  MO_ZERO_SHOT = 0,   /* the controller is frozen; parents keep their scores */
  MO_FEW_SHOT = 1,    /* each generation starts from the pretrained weights and learns; parents are
                         scored again */
  MO_SIMULTANEOUS = 2 /* weights and optimizer are inherited from generation to generation; parents
                         are scored again */
};
const char *
mo_campaign_mode_name(enum mo_campaign_mode mode); /* "zero-shot", "few-shot", "simultaneous" */
int mo_campaign_mode_from_name(const char *name,
                               enum mo_campaign_mode *mode); /* MO_ERR_NOT_FOUND */

/* In every scheme the best lives, and what diverged lives only when there is nothing better.
 *   truncation   the best live (paper)
 *   tournament   each further survivor is the best of tournament_size draws, with repetition, from
 * those left novelty      the N of the smallest (1 − weight) · rank by score + weight · rank by
 * novelty: the mean Hamming distance to all other candidates, most novel first; both ranks from 0,
 * equals in the order of their scores age-layered  n_layers layers of growing age limits, with
 * equal shares of the places. From the youngest on, the best of those that are young enough and do
 * not live yet take a layer's places; what is not filled goes to the next. Age: generations since a
 *                design's own birth */
enum mo_selection_kind {
  MO_SELECT_TRUNCATION = 0,
  MO_SELECT_TOURNAMENT = 1,
  MO_SELECT_NOVELTY = 2,
  MO_SELECT_AGE_LAYERED = 3
};
const char *mo_selection_name(
    enum mo_selection_kind kind); /* "truncation", "tournament", "novelty", "age-layered" */
int mo_selection_from_name(const char *name, enum mo_selection_kind *kind);

struct mo_selection {
  enum mo_selection_kind kind;
  uint32_t tournament_size; /* 2 … 64; 4 */
  double novelty_weight;    /* 0 … 1; 0.5; 0 is truncation */
  uint32_t n_layers;        /* 2 … 16; 4 */
  uint32_t
      age_gap; /* generations, 1 … 1000; 5. Limits: gap, 2 gap, 4 gap, …; the last layer has none */
};

struct mo_campaign_settings {
  enum mo_campaign_mode mode;
  uint64_t seed;
  struct mo_workspace
      workspace; /* that bodies must fit; 6 × 6 × 4, no side longer: controllers are for that */
  uint32_t population;    /* N: MO_POPULATION_MIN … MO_POPULATION_MAX; of a campaign that learns
                             MO_TRAINING_DESIGNS_MAX */
  uint32_t generations;   /* after generation 0; 0 … MO_GENERATIONS_MAX: 0 scores the initial
                             population only */
  double mutation_share;  /* of the population that mutates, 0 … 1; 0.25; the rest recombines */
  double mutation_rate;   /* per voxel; 0 (default): 1 / voxels of the workspace; ≤ 0.5 */
  double mutation_growth; /* of the rate after each attempt that gave nothing new; 1.025; 1 … 2 */
  struct mo_selection selection;
  bool exclude_pretraining; /* bodies that the controller was pretrained on count as seen; true */
  double collapse_share; /* warn when the diversity falls below this share of its maximum so far; 0:
                            never; 0.5 */
  /* Learning; ignored by MO_ZERO_SHOT. A step's batch is `batch` robots, each in a random
   * environment of its own. */
  uint32_t parent_steps, child_steps; /* of each generation: on the parents, then on the children */
  uint32_t batch;                     /* 0: the population */
  struct mo_schedule
      schedule; /* few-shot: within each generation; simultaneous: over the campaign */
  double beta1, beta2, epsilon, norm_limit, adjoint_bound;
  enum mo_adjoint_rule adjoint_rule;
  double restart_weight; /* of MO_ADJOINT_RESTART; MO_RESTART_WEIGHT */
  enum mo_sensor sensor; /* simultaneous without a controller */
  struct mo_physics physics;
};

/* Presets: population 8192 ("paper", with the paper's generations: 100, 7, 180), 512
 * ("workstation"; 100, 10, 180), 64 ("demo"; 30, 3, 30); everything else as in the paper, but for
 * adjoint_bound (MO_ADJOINT_BOUND; 0 is the paper's). Few-shot: 30 + 30 steps, schedule of
 * mo_schedule_paper_finetune. Simultaneous: 1 + 1, mo_schedule_paper_simultaneous. */
enum mo_preset { MO_PRESET_PAPER = 0, MO_PRESET_WORKSTATION = 1, MO_PRESET_DEMO = 2 };
const char *mo_preset_name(enum mo_preset preset); /* "paper", "workstation", "demo" */
int mo_preset_from_name(const char *name, enum mo_preset *preset);
struct mo_campaign_settings mo_campaign_preset(enum mo_campaign_mode mode, enum mo_preset preset);

/* MO_ERR_INVALID, MO_ERR_RANGE; message names the setting, its value and what it must be. */
int mo_campaign_settings_check(const struct mo_campaign_settings *settings,
                               struct mo_message *message);

/* The training of a generation (few-shot: n_steps = parent + child steps, its seed, below 2^53,
 * drawn from (seed, EVOLUTION_SEED, generation)) or of the whole campaign (simultaneous: n_steps =
 * child steps + (parent + child steps) · generations, seed the campaign's). Generation 0 has no
 * parents: it takes the child steps on the initial population, and n_steps of a few-shot campaign's
 * is that, at least 1. Kind MO_TRAINING_FINETUNE, nothing held out. */
struct mo_training_settings mo_campaign_training(const struct mo_campaign_settings *settings,
                                                 uint32_t generation);

/* ---- what was seen ---- */

/* Canonical forms of every design of a campaign, over those that its controller was pretrained on.
 */
struct mo_seen;
/* excluded: nullable, borrowed, only read: several campaigns may share one. */
int mo_seen_create(struct mo_workspace workspace, const struct mo_form_set *excluded,
                   struct mo_seen **seen);
void mo_seen_free(struct mo_seen *seen); /* NULL-safe */
int mo_seen_add(
    struct mo_seen *seen,
    const uint64_t *genotype); /* 1: new, added; 0: was there; MO_ERR_NO_MEMORY, MO_ERR_EMPTY */
int mo_seen_has(
    const struct mo_seen *seen,
    const uint64_t *genotype); /* 1, 0; MO_ERR_NO_MEMORY: workspaces above 1024 voxels only */
uint64_t mo_seen_count(const struct mo_seen *seen); /* added by mo_seen_add */
size_t mo_seen_bytes(const struct mo_seen *seen);   /* without `excluded` */

/* Adds the forms of the first n_bodies that a pretraining of `seed` learned from (as
 * mo_training_draw draws them: held-out forms left out) and that fit `workspace`, to `set` (of
 * `workspace`). cancel, done (bodies so far) nullable, as in mo_training_draw. 3.5 µs each on one
 * thread. Memory: `set` alone if it is empty and of the default workspace, else a set of n_bodies
 * forms beside it; and up to 3 MiB a thread. The set is the same on any number of threads (0 counts
 * as 1, the caller's is one of them), which live inside the call. MO_ERR_CANCELLED,
 * MO_ERR_NO_MEMORY, MO_ERR_EXHAUSTED: `set` may hold some of them. */
int mo_pretraining_forms(uint64_t seed, uint64_t n_bodies, struct mo_workspace workspace,
                         uint32_t n_threads, const volatile int *cancel, volatile uint64_t *done,
                         struct mo_form_set *set);

/* ---- births ---- */

enum mo_operator {
  MO_BORN_RANDOM = 0,    /* initial population */
  MO_BORN_LISTED = 1,    /* initial population: given by the user */
  MO_BORN_INHERITED = 2, /* initial population: of another campaign */
  MO_BORN_MUTATION = 3,
  MO_BORN_CROSSOVER = 4
};
#define MO_OPERATORS 5
const char *mo_operator_name(
    enum mo_operator birth); /* "random", "listed", "inherited", "mutation", "crossover" */

#define MO_NO_PARENT UINT32_MAX
struct mo_birth {
  enum mo_operator op;
  uint32_t parents[2]; /* places in the population that the children are of; MO_NO_PARENT */
  uint32_t attempts;   /* until it was new: 1 at best */
};

/* Fills places n_given … population − 1 of `genotypes` with random bodies that were not seen:
 * stream (seed, POPULATION, 0, i), i = 0, 1, …, those that were seen left out; all of them are
 * added to `seen`, those that are given (placed, valid; they may be of the forms that are excluded)
 * too. MO_ERR_DUPLICATE: two given ones have one form (*fault, nullable: the later). *n: how many
 * there are: fewer than `population` when the morphospace holds no more, that is, 2^16 draws in a
 * row gave nothing new. cancel nullable: MO_ERR_CANCELLED. MO_ERR_NO_MEMORY; MO_ERR_RANGE: more
 * given than the population. On error `seen` may hold some of them. */
int mo_population_initial(const struct mo_campaign_settings *settings, struct mo_seen *seen,
                          uint64_t *genotypes, uint32_t n_given, uint32_t *n, uint32_t *fault,
                          const volatile int *cancel);

struct mo_variation_counts {
  uint64_t mutation_attempts,
      crossover_attempts;         /* children drawn, also those that were seen or empty */
  uint32_t mutants, recombinants; /* born */
  uint32_t fallbacks; /* of the mutants: born in place of recombinants because no pair gave anything
                         new */
  bool exhausted; /* fewer than `population` children: nothing new was found in 2^16 attempts in a
                     row */
};
/* Children of a population, in order: mutants, then recombinants, then fallbacks. A random
 * round(mutation_share · n) of the n parents give one mutant each: flips at mutation_rate, again
 * with the rate · mutation_growth (at most 0.5) while empty or seen. The others (all parents, if
 * they are fewer than two) are paired at random, two distinct ones each time, until `population`
 * children exist; what is empty or seen is discarded; after 1000 discards in a row (or if there is
 * one parent) the rest are mutants of random members of the group, one of them at a time until it
 * is new. What is born is added to `seen`. children: (population, words); births: (population). *n
 * may be 0: exhausted. Streams (seed, MUTATION | CROSSOVER | SELECTION, generation, …).
 * MO_ERR_CANCELLED, MO_ERR_NO_MEMORY: `seen` is left with some of the children and must be made
 * again. */
int mo_variation(const struct mo_campaign_settings *settings, uint32_t generation,
                 const uint64_t *parents, uint32_t n_parents, struct mo_seen *seen,
                 uint64_t *children, struct mo_birth *births, uint32_t *n,
                 struct mo_variation_counts *counts, const volatile int *cancel);

/* ---- selection ---- */

struct mo_candidate {
  double score;
  uint64_t number; /* order of birth in the campaign: breaks ties, the older first */
  uint32_t born;   /* generation */
};
/* survivors: (min(n, population)) places among the candidates, in the order of their scores, best
 * first. What diverged lives only when there is nothing better. genotypes: (n, words), used by
 * novelty. MO_ERR_NO_MEMORY; MO_ERR_INVALID: a score is NaN. */
int mo_select(const struct mo_campaign_settings *settings, uint32_t generation,
              const uint64_t *genotypes, const struct mo_candidate *candidates, uint32_t n,
              uint32_t *survivors, uint32_t *n_survivors);

/* ---- statistics ---- */

/* What a design is made of. footprint: voxel columns (x, y) that hold at least one voxel. */
struct mo_design_size {
  uint32_t voxels, footprint, masses, springs;
};
int mo_design_size(const struct mo_lattice *lattice, const uint64_t *bits,
                   struct mo_design_size *size); /* MO_ERR_NO_MEMORY */

struct mo_spread {
  double least, mean, most;
};
#define MO_QUANTILES 7 /* 0, 5, 25, 50, 75, 95, 100 %: linear between ranks */
struct mo_population_stats {
  uint32_t n, n_diverged;
  double mean_score,
      quantiles[MO_QUANTILES]; /* of those that did not diverge; NaN: there are none */
  double diversity; /* mean pairwise Hamming distance / voxels of the workspace; 0 for n < 2 */
  uint32_t species; /* distinct canonical forms */
  struct mo_spread voxels, footprint, masses, springs;
};
/* O(n · voxels). sizes: (n). MO_ERR_NO_MEMORY. */
int mo_population_stats(struct mo_workspace workspace, const uint64_t *genotypes,
                        const double *scores, const struct mo_design_size *sizes, uint32_t n,
                        struct mo_population_stats *stats);
double mo_diversity(struct mo_workspace workspace, const uint64_t *genotypes, uint32_t n);
/* Mean Hamming distance / voxels of each to all others, exact in O(n · voxels). distances: (n); 0
 * for n < 2. */
void mo_distinctiveness(struct mo_workspace workspace, const uint64_t *genotypes, uint32_t n,
                        double *distances);

/* m of n (m ≤ n): the best, and the others at even steps over the ranking by score (diverged ones
 * left out while there are enough); in the order of their mean Hamming distance to each other, most
 * distinct first; ties: better score, then lower place. picks: (m) places. MO_ERR_NO_MEMORY;
 * MO_ERR_RANGE: m > n. */
int mo_champions(struct mo_workspace workspace, const uint64_t *genotypes, const double *scores,
                 uint32_t n, uint32_t m, uint32_t *picks);

/* ---- phylogeny ---- */

/* Designs of a campaign are numbered in order of birth; parents have lower numbers. */
struct mo_descent {
  uint32_t parents[2]; /* numbers; MO_NO_PARENT */
  uint8_t op;          /* enum mo_operator */
};
/* marks: (n) bytes, zeroed by the caller; set to 1 for every ancestor (descendant) of `number`,
 * itself not. descents: (n), of all designs 0 … n − 1. */
void mo_ancestors(const struct mo_descent *descents, uint32_t n, uint32_t number, uint8_t *marks);
void mo_descendants(const struct mo_descent *descents, uint32_t n, uint32_t number, uint8_t *marks);

/* Newick text of the forest in which each design hangs on its first parent, one line ("…;\n") per
 * root, children in order of birth, labels are numbers, branch lengths generations (a root has
 * none). Iterative; `write` gets pieces; its non-zero return ends it and is returned. born: (n)
 * generations. keep: nullable (n) bytes: only these designs and the path to their roots.
 * MO_ERR_NO_MEMORY. */
int mo_newick(const struct mo_descent *descents, const uint32_t *born, const uint8_t *keep,
              uint32_t n, int (*write)(void *context, const char *text, size_t length),
              void *context);

#ifdef __cplusplus
}
#endif
#endif
