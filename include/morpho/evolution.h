/* evolution.h: variation, selection and statistics of a population of designs (paper, sections 2.5
 * to 2.7).
 *
 * A campaign depends only on its settings and seed. One generation is:
 *   mo_variation  makes children that were never seen before: mutants, then recombinants
 *   (the caller)  learns and scores
 *   mo_select     ranks the survivors among parents and children, best first
 * Every random number comes from a stream identified by (seed, purpose, generation, index). An
 * interrupted generation can therefore be repeated, bit for bit, from the population and the set of
 * forms seen so far. Generation 0 is the initial population; generation g ≥ 1 is made from the
 * survivors of generation g − 1.
 *
 * Genotypes belong to the campaign's workspace (mo_workspace_words() words each, placed) and are
 * stored in arrays of n × words. A score is a mean loss: lower is better, +infinity if a rollout
 * diverged, never NaN. Only functions whose objects are all const may run concurrently. */
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

#define MO_POPULATION_MIN        2
#define MO_POPULATION_MAX        65536
#define MO_GENERATIONS_MAX       100000
#define MO_RACE_ENVIRONMENTS_MAX 64
#define MO_CAMPAIGN_DESIGNS_MAX  (UINT64_C(1) << 28) /* population × (generations + 1) */
#define MO_CAMPAIGN_STEPS_MAX                                                                      \
  10000 /* limit for the learning steps of a generation, for parents and children separately */

/* ---- settings ---- */

enum mo_campaign_mode {
  MO_ZERO_SHOT = 0, /* the controller is frozen; parents keep their scores */
  MO_FEW_SHOT =
      1, /* each generation starts learning from the pretrained weights; parents are scored again */
  MO_SIMULTANEOUS = 2, /* as few-shot, but each generation inherits weights and optimizer */
  MO_STUDY = 3         /* as zero-shot, but a client supplies the children of each generation */
};
extern const char
    *const mo_campaign_mode_words[]; /* "zero-shot", "few-shot", "simultaneous", "study", NULL */
#define MO_PRESETS 3
/* Properties of a mode. A new mode needs a row of mo_modes, its word and its enumerator. */
struct mo_mode {
  bool makes_children;    /* by variation; otherwise a client supplies them, and decides when the
                             campaign ends */
  bool learns;            /* in each generation; parents are scored again */
  bool inherits_learning; /* a generation continues the training run of the previous one */
  bool starts_untrained;  /* true: random weights if no controller is given; false: a controller is
                             required */
  /* In its presets: */
  uint32_t generations[MO_PRESETS];
  uint32_t steps; /* learning steps, for parents and for children each */
  enum mo_schedule_preset schedule;
};
extern const struct mo_mode mo_modes[]; /* by enum mo_campaign_mode */

/* In every scheme the best candidate survives. A diverged candidate survives only if too few others
 * exist.
 *   truncation   the best survive (paper)
 *   tournament   each further survivor is the best of tournament_size draws, with replacement,
 *                from those left
 *   novelty      the N with the smallest (1 − weight) · rank by score + weight · rank by
 *                novelty survive. Novelty: mean Hamming distance to all other candidates, most
 *                novel first. Both ranks count from 0; ties are broken by score
 *   age-layered  n_layers layers with growing age limits share the places equally. From the
 *                youngest layer on, the best candidates that are young enough and not yet
 *                chosen take its places; unfilled places go to the next layer. Age:
 *                generations since the design's own birth */
enum mo_selection_kind {
  MO_SELECT_TRUNCATION = 0,
  MO_SELECT_TOURNAMENT = 1,
  MO_SELECT_NOVELTY = 2,
  MO_SELECT_AGE_LAYERED = 3
};
extern const char
    *const mo_selection_words[]; /* "truncation", "tournament", "novelty", "age-layered", NULL */

struct mo_selection {
  enum mo_selection_kind kind;
  uint32_t tournament_size; /* 2 … 64; 4 */
  double novelty_weight;    /* 0 … 1; 0.5; 0 is truncation */
  uint32_t n_layers;        /* 2 … 16; 4 */
  uint32_t age_gap; /* generations, 1 … 1000; 5. Age limits: gap, 2 gap, 4 gap, …; none for the last
                       layer */
};

/* How the losses of a design become its score. x₁ ≤ … ≤ xₙ: its losses over the n environments of
 * the campaign in ascending order. Lower is better. For every kind, a score is +infinity if any
 * loss is.
 *   mean         (x₁ + … + xₙ) / n, added in the order of the environments
 *   quantile     linear between order statistics: with h = 1 + level · (n − 1) and i = ⌊h⌋, it is
 *                xᵢ + (h − i) · (xᵢ₊₁ − xᵢ). Level 0 is the least loss, 0.5 the median, 1 the worst
 *   cvar         mean of the worst share 1 − level of the losses (conditional value at risk,
 *                Rockafellar & Uryasev 2002, proposition 8). With k = ⌈level · n⌉, it is
 *                ((k − level · n) · xₖ + xₖ₊₁ + … + xₙ) / (n − level · n). Level 0 is the mean, 1
 *                the worst
 *   mean-sd      mean + weight · s, where s is the standard deviation, with n − 1; 0 for n = 1 */
enum mo_aggregate_kind {
  MO_AGGREGATE_MEAN = 0,
  MO_AGGREGATE_QUANTILE = 1,
  MO_AGGREGATE_CVAR = 2,
  MO_AGGREGATE_MEAN_SD = 3
};
extern const char *const mo_aggregate_words[]; /* "mean", "quantile", "cvar", "mean-sd", NULL */

struct mo_aggregate {
  enum mo_aggregate_kind kind;
  double level;  /* of a quantile or cvar: 0 … 1; 0.9 */
  double weight; /* of the standard deviation: 0 … 1000; 1 */
};
/* Computes a score from n ≤ MO_RACE_ENVIRONMENTS_MAX losses, none of them negative. NaN, a loss
 * that was not computed, counts as 0. If mo_aggregate_is_monotone, a score with missing losses is
 * therefore a lower bound of the complete score, bit for bit. */
double mo_aggregate_score(const struct mo_aggregate *aggregate, const double *losses, uint32_t n);
/* Returns whether a greater loss never gives a lower score, rounding included. A mean with a
 * standard deviation is not monotone: a loss that rises toward the others lowers the deviation. */
bool mo_aggregate_is_monotone(const struct mo_aggregate *aggregate);

/* Whether children that cannot survive are scored in all environments (racing.c). The choice
 * changes no population, no birth, no death and no controller. */
enum mo_racing { MO_RACING_LOSSLESS = 0, MO_RACING_OFF = 1 };
extern const char *const mo_racing_words[]; /* "lossless", "off", NULL */

struct mo_campaign_settings {
  enum mo_campaign_mode mode;
  uint64_t seed;
  struct mo_workspace workspace; /* bodies must fit it; 6 × 6 × 4; no side may be longer, because
                                    controllers are made for this size */
  uint32_t population; /* N: MO_POPULATION_MIN … MO_POPULATION_MAX; at most MO_TRAINING_DESIGNS_MAX
                          if it learns */
  uint32_t generations; /* after generation 0; 0 … MO_GENERATIONS_MAX; 0: only the initial
                           population is scored. For a study: its newest batch */
  double mutation_share; /* share of the population that mutates, 0 … 1; 0.25; the rest recombine */
  double mutation_rate;   /* per voxel; 0 (default): 1 / voxels of the workspace; ≤ 0.5 */
  double mutation_growth; /* factor of the rate after each attempt that found nothing new; 1 …
                             2; 1.025 */
  struct mo_selection selection;
  struct mo_aggregate aggregate; /* mean */
  enum mo_racing racing;         /* lossless; has no effect if mo_race_is_possible returns false */
  bool exclude_pretraining;      /* count the controller's pretraining bodies as seen; true */
  double collapse_share; /* warn when diversity falls below this share of its maximum so far; 0:
                            never; 0.5 */
  /* Learning; ignored in modes that do not learn. A step's batch is `batch` robots, each in its own
   * random environment. */
  uint32_t parent_steps, child_steps; /* of each generation: on parents, then on children */
  uint32_t batch;                     /* 0: the population */
  struct mo_learning
      learning; /* schedule: few-shot within each generation, simultaneous over the campaign */
  enum mo_sensor sensor; /* used if the mode starts untrained and no controller is given */
  struct mo_physics physics;
};

/* Presets: population 8192 ("paper", with the paper's generations: 100, 7, 180), 512
 * ("workstation"; 100, 10, 180), 64 ("demo"; 30, 3, 30). Everything else is as in the paper, except
 * adjoint_bound (MO_ADJOINT_BOUND; the paper uses 0). Few-shot: 30 + 30 steps, simultaneous: 1 + 1,
 * each with the paper's schedule. A study starts without generations, and excludes nothing. */
enum mo_preset { MO_PRESET_PAPER = 0, MO_PRESET_WORKSTATION = 1, MO_PRESET_DEMO = 2 };
extern const char *const mo_preset_words[]; /* "paper", "workstation", "demo", NULL */
struct mo_campaign_settings mo_campaign_preset(enum mo_campaign_mode mode, enum mo_preset preset);

/* MO_ERR_INVALID, MO_ERR_RANGE; message names the setting, its value and what it must be. */
int mo_campaign_settings_check(const struct mo_campaign_settings *settings,
                               struct mo_message *message);

/* Returns the settings of the training run of one generation (few-shot) or of the whole campaign
 * (simultaneous). Few-shot: n_steps = parent + child steps; the seed, below 2^53, is drawn from
 * (seed, EVOLUTION_SEED, generation). Simultaneous: n_steps = child steps + (parent + child steps)
 * · generations; the seed is the campaign's. Generation 0 has no parents: it takes only the child
 * steps, on the initial population. Its few-shot n_steps is the number of child steps, at least 1.
 * Kind MO_TRAINING_FINETUNE, nothing held out. */
struct mo_training_settings mo_campaign_training(const struct mo_campaign_settings *settings,
                                                 uint32_t generation);

/* ---- forms seen so far ---- */

/* The canonical forms of all designs of a campaign, and of the bodies that its controller was
 * pretrained on. */
struct mo_seen;
/* excluded: nullable, borrowed, read-only: several campaigns may share it. */
int mo_seen_create(struct mo_workspace workspace, const struct mo_form_set *excluded,
                   struct mo_seen **seen);
void mo_seen_free(struct mo_seen *seen); /* NULL-safe */
int mo_seen_add(struct mo_seen *seen,
                const uint64_t *genotype); /* 1: new, added; 0: already present; MO_ERR_NO_MEMORY,
                                              MO_ERR_EMPTY */
/* A callback for readers of genotypes: moves a genotype of any workspace to the workspace of the
 * set (a struct mo_seen), and adds it. Also returns MO_OK if it is already present; MO_ERR_RANGE:
 * it does not fit. */
int mo_seen_take(void *seen, const struct mo_genotype *genotype);
uint64_t mo_seen_count(const struct mo_seen *seen); /* forms added by mo_seen_add, mo_seen_take */

/* Adds to `set` (of `workspace`) the forms of the first n_bodies that a pretraining run with `seed`
 * learned from and that fit `workspace`. The bodies are those of mo_training_draw, without held-out
 * forms; cancel and done (bodies so far) are nullable, as there. 3.5 µs per body on one thread.
 * Memory: only `set` if it is empty and for the default workspace, else also a set of n_bodies
 * forms; and up to 3 MiB per thread. The set is the same for any number of threads (0 counts as 1;
 * the calling thread is one of them), which stop at the end of the call. MO_ERR_CANCELLED,
 * MO_ERR_NO_MEMORY, MO_ERR_EXHAUSTED: `set` may hold some of the forms. */
#define MO_PRETRAINING_FORMS_VERSION 1 /* incremented whenever the result changes */
int mo_pretraining_forms(uint64_t seed, uint64_t n_bodies, struct mo_workspace workspace,
                         uint32_t n_threads, const volatile int *cancel, volatile uint64_t *done,
                         struct mo_form_set *set);

/* ---- births ---- */

enum mo_operator {
  MO_BORN_RANDOM = 0,    /* initial population */
  MO_BORN_LISTED = 1,    /* initial population: given by the user */
  MO_BORN_INHERITED = 2, /* initial population: from another campaign */
  MO_BORN_MUTATION = 3,
  MO_BORN_CROSSOVER = 4
};
#define MO_OPERATORS 5
extern const char
    *const mo_operator_words[]; /* "random", "listed", "inherited", "mutation", "crossover", NULL */

#define MO_NO_PARENT UINT32_MAX
struct mo_birth {
  enum mo_operator op;
  uint32_t parents[2]; /* indices of the parents in the population; MO_NO_PARENT */
  uint32_t attempts;   /* attempts until a child was new; at least 1 */
};

/* Fills places n_given … population − 1 of `genotypes` with random bodies that were not seen
 * before: stream (seed, POPULATION, 0, i), i = 0, 1, …, skipping seen ones. Adds all bodies to
 * `seen`, including the given ones, which must be placed and valid and may have excluded forms. *n:
 * number of bodies; below `population` if the morphospace is exhausted, that is, if 2^16 draws in a
 * row found nothing new. MO_ERR_DUPLICATE: two given bodies have the same form (*fault, nullable:
 * index of the later one). cancel nullable: MO_ERR_CANCELLED. MO_ERR_NO_MEMORY; MO_ERR_RANGE: more
 * given bodies than the population has. On error `seen` may hold some of the bodies. */
int mo_population_initial(const struct mo_campaign_settings *settings, struct mo_seen *seen,
                          uint64_t *genotypes, uint32_t n_given, uint32_t *n, uint32_t *fault,
                          const volatile int *cancel);

struct mo_variation_counts {
  uint64_t mutation_attempts,
      crossover_attempts;         /* children drawn, including seen and empty ones */
  uint32_t mutants, recombinants; /* children born */
  uint32_t fallbacks; /* mutants that replace recombinants, because no pair produced a new child */
  bool exhausted; /* fewer than `population` children: 2^16 attempts in a row found nothing new */
};
/* Makes the children of a population, in order: mutants, recombinants, fallbacks. A random
 * round(mutation_share · n) of the n parents produce one mutant each: flips at mutation_rate,
 * repeated with rate · mutation_growth (at most 0.5) while the child is empty or seen. The other
 * parents (all parents, if they are fewer than two) are paired at random, two distinct ones each
 * time, until `population` children exist; empty or seen children are discarded. After 1000
 * discards in a row, or with only one parent, the rest are mutants of random members of that group,
 * each repeated until it is new. Adds the children to `seen`. children: (population, words);
 * births: (population). *n may be 0: exhausted. Streams (seed, MUTATION | CROSSOVER | SELECTION,
 * generation, …). MO_ERR_CANCELLED, MO_ERR_NO_MEMORY: `seen` then holds some of the children and
 * must be rebuilt. */
int mo_variation(const struct mo_campaign_settings *settings, uint32_t generation,
                 const uint64_t *parents, uint32_t n_parents, struct mo_seen *seen,
                 uint64_t *children, struct mo_birth *births, uint32_t *n,
                 struct mo_variation_counts *counts, const volatile int *cancel);
/* Chooses k ≤ n of the numbers 0 … n − 1 at random, in random order, as parents of a study's
 * batch. places: (n); the first k are chosen. Stream (seed, SELECTION, generation, …). */
void mo_variation_parents(uint64_t seed, uint32_t generation, uint32_t n, uint32_t k,
                          uint32_t *places);

/* ---- selection ---- */

struct mo_candidate {
  double score;
  uint64_t number; /* order of birth in the campaign: breaks ties, the older first */
  uint32_t born;   /* generation */
};
/* Selects survivors: (min(n, population)) places among the candidates, best score first. A diverged
 * candidate survives only if too few others exist. genotypes: (n, words), used by novelty.
 * MO_ERR_NO_MEMORY; MO_ERR_INVALID: a score is NaN. */
int mo_select(const struct mo_campaign_settings *settings, uint32_t generation,
              const uint64_t *genotypes, const struct mo_candidate *candidates, uint32_t n,
              uint32_t *survivors, uint32_t *n_survivors);

/* ---- racing: scoring of children stops once they cannot survive ---- */

/* Losses are never negative, and rounded means, quantiles and cvars are monotone (aggregate.c): the
 * score of a design whose missing losses count as 0 is a lower bound on its score, bit for bit.
 * Under truncation, a child whose lower bound is above the worst of N parents cannot survive,
 * because N candidates are better. Environments are scored in waves, the most informative first.
 *
 * Only truncation allows such a bound. In a tournament, every candidate that did not diverge may
 * survive; novelty lets bad designs survive; in age layers, children compete with children first,
 * and there are never more than N of them. A study must report every score to its client. A mean
 * with a standard deviation is not monotone. */
bool mo_race_is_possible(const struct mo_campaign_settings *settings);
#define MO_RACE_WAVES_MAX 6
struct mo_race {
  double bound; /* a child with a score above it cannot survive; +infinity: every child can */
  struct mo_aggregate aggregate; /* that the scores are computed with */
  uint32_t n_environments;
  uint8_t order[MO_RACE_ENVIRONMENTS_MAX]; /* (n_environments) environments in the order of
                                              scoring */
  uint32_t n_waves;
  uint8_t ends[MO_RACE_WAVES_MAX]; /* (n_waves) wave w scores order[ends[w − 1] … ends[w] − 1] */
  bool is_whole;                   /* no child is cut: all waves are scored at once */
};
/* Plans the race of a generation's children from the losses and scores of its parents: losses
 * (n_parents, n_environments), NaN if unknown; scores (n_parents). pays: a race saved time in the
 * previous generation, or would have. The plan depends on nothing else. With fewer than
 * `population` parents there is one wave, and nothing is cut. */
void mo_race_plan(const struct mo_campaign_settings *settings, const double *losses,
                  const double *scores, uint32_t n_parents, uint32_t n_environments, bool pays,
                  struct mo_race *race);
/* Returns the time, in rollouts, that a race saves on a child that was cut short or has all its
 * losses; negative if it costs time. A loss that was not computed is NaN: stored losses may cut a
 * child before a wave. */
int mo_race_saved(const struct mo_race *race, const double *losses, bool on_device);
/* Returns the time, in rollouts, that the race costs a generation: a device computes thousands of
 * rollouts at once, and is partly idle at the end of a wave, because the next wave waits until that
 * one has ended. parents_first: the first wave waits for the scores of parents. */
uint32_t mo_race_lost(const struct mo_race *race, bool on_device, bool parents_first);
/* Returns whether a child with these losses (NaN: not computed) cannot survive. */
bool mo_race_is_lost(const struct mo_race *race, const double *losses);
/* Computes the mean of n losses, in order; NaN, a loss that was not computed, counts as 0. */
double mo_race_score(const double *losses, uint32_t n);

/* ---- the k best of n designs ---- */

/* A race of n designs (best.c): designs with a score at most the k-th best get all their losses,
 * the others only enough to prove that their scores are higher. The race runs in rounds:
 * mo_best_ask requests losses, and is called again after mo_best_give has delivered all of them.
 * The requested losses depend only on the losses of earlier rounds. */
struct mo_best {
  uint32_t n_designs, n_environments, k;
  uint64_t n_cut;        /* losses that will never be requested */
  uint64_t *asked;       /* (n_designs) the environments requested so far, as bits */
  double *losses;        /* (n_designs, n_environments) NaN if unknown */
  struct mo_rank *ranks; /* (n_designs) scratch */
  struct mo_race race;   /* its bound is that of the designs with all losses */
  uint32_t round, wave;  /* rounds and waves requested */
  uint32_t prefix;       /* number of environments, in race.order, that open designs have before
                            this round */
  bool is_whole;         /* all designs get all their losses in the first round */
  uint64_t n_given;      /* losses delivered */
  struct {
    uint32_t round;
    uint64_t n_given;
    double later;
  } estimate; /* the newest result of mo_best_left, and when it was computed */
};
/* 1 ≤ k ≤ n_designs; 1 ≤ n_environments ≤ MO_RACE_ENVIRONMENTS_MAX. MO_ERR_NO_MEMORY. */
int mo_best_create(uint32_t n_designs, uint32_t n_environments, uint32_t k, struct mo_best **best);
void mo_best_free(struct mo_best *best); /* NULL-safe */
/* Records a requested loss; +infinity if it diverged. */
void mo_best_give(struct mo_best *best, uint32_t design, uint32_t environment, double loss);
/* Requests the next losses: adds bits to `asked`. Returns how many it added; 0 means that the race
 * is over, and designs with all bits set have their scores. */
uint64_t mo_best_ask(struct mo_best *best);
/* Estimates how many losses later rounds will request; negative if it is still unknown, which is
 * the case in the first round. */
double mo_best_left(struct mo_best *best);

/* ---- statistics ---- */

/* The size of a design. footprint: voxel columns (x, y) with at least one voxel. */
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
  double mean_score, quantiles[MO_QUANTILES]; /* of all that did not diverge, or NaN */
  double diversity; /* mean pairwise Hamming distance / voxels of the workspace; 0 for n < 2 */
  uint32_t species; /* distinct canonical forms */
  struct mo_spread voxels, footprint, masses, springs;
};
/* O(n · voxels). sizes: (n). MO_ERR_NO_MEMORY. */
int mo_population_stats(struct mo_workspace workspace, const uint64_t *genotypes,
                        const double *scores, const struct mo_design_size *sizes, uint32_t n,
                        struct mo_population_stats *stats);
double mo_diversity(struct mo_workspace workspace, const uint64_t *genotypes, uint32_t n);
/* Computes the mean Hamming distance of each genotype to all others, divided by the voxels of the
 * workspace, exactly, in O(n · voxels). distances: (n); 0 for n < 2. */
void mo_distinctiveness(struct mo_workspace workspace, const uint64_t *genotypes, uint32_t n,
                        double *distances);

/* Picks m of n designs (m ≤ n): the best, and others at equal intervals in the ranking by score
 * (diverged ones only if there are not enough others). Orders them by their mean Hamming distance
 * to each other, most distinct first; ties: better score, then lower place. picks: (m) places;
 * distances (nullable): (m) distances of the picks, as from mo_distinctiveness. MO_ERR_NO_MEMORY;
 * MO_ERR_RANGE: m > n. */
int mo_champions(struct mo_workspace workspace, const uint64_t *genotypes, const double *scores,
                 uint32_t n, uint32_t m, uint32_t *picks, double *distances);

/* ---- phylogeny ---- */

/* Designs of a campaign are numbered in order of birth; parents have lower numbers. */
struct mo_descent {
  uint32_t parents[2]; /* numbers; MO_NO_PARENT */
  uint8_t op;          /* enum mo_operator */
};
/* Mark every ancestor (descendant) of `number`, not `number` itself, with 1. marks: (n) bytes,
 * zeroed by the caller. descents: (n), of all designs 0 … n − 1. */
void mo_ancestors(const struct mo_descent *descents, uint32_t n, uint32_t number, uint8_t *marks);
void mo_descendants(const struct mo_descent *descents, uint32_t n, uint32_t number, uint8_t *marks);

/* The Newick text of the forest in which each design is a child of its first parent: one line
 * ("…;\n") per root, children in order of birth. A label is "n" and the number, because readers
 * mistake a bare number at an inner node for a confidence. Branch lengths are in generations; a
 * root has none. Iterative. Both arrays, (n), must outlive it; born: generations.
 * MO_ERR_NO_MEMORY. */
struct mo_newick;
int mo_newick_create(const struct mo_descent *descents, const uint32_t *born, uint32_t n,
                     struct mo_newick **newick);
/* Writes the next part of the text, without a NUL, into `size` ≥ MO_NEWICK_PIECE bytes. Returns
 * false if it was the last one. */
#define MO_NEWICK_PIECE 64 /* more than the longest piece: "n4294967295:4294967295)" */
bool mo_newick_next(struct mo_newick *newick, char *text, size_t size, size_t *length);
void mo_newick_free(struct mo_newick *newick); /* NULL-safe */

#ifdef __cplusplus
}
#endif
#endif
