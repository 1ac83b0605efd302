/* campaign_records.h: a campaign and its rows, as the store returns them (store/campaigns.h). */
#ifndef MORPHO_STORE_CAMPAIGN_RECORDS_H
#define MORPHO_STORE_CAMPAIGN_RECORDS_H

#include <morpho/evolution.h>

#include "store/checkpoints.h"
#include "store/own_score.h"
#include "store/re_evaluation.h"
#include "store/select_by.h"

#define MO_REPLICATES_MAX 100

/* Names for operators and measures that a study's client chooses: words of A-Z, a-z, 0-9, '_', '.'
 * and '-', in the order of their first use. */
#define MO_STUDY_WORD_MAX      32
#define MO_STUDY_OPERATORS_MAX 32
#define MO_STUDY_MEASURES_MAX  16
#define MO_SAMPLER_BYTES_MAX   ((size_t)16 << 20)
/* The measures of a design: the service's, if the campaign names some, then the study's own. */
#define MO_DESIGN_MEASURES_MAX (MO_MEASURES + MO_STUDY_MEASURES_MAX)
struct mo_study_words {
  uint32_t n_operators, n_measures;
  char operators[MO_STUDY_OPERATORS_MAX][MO_STUDY_WORD_MAX + 1];
  char measures[MO_DESIGN_MEASURES_MAX][MO_STUDY_WORD_MAX + 1];
};

/* Where the robots of a campaign learn. */
enum mo_worlds {
  MO_WORLDS_RANDOM = 0,       /* each in its own random environment, following a fixed light */
  MO_WORLDS_ENVIRONMENTS = 1, /* each in one of the campaign's environments, drawn at random */
  MO_WORLDS_TASKS = 2 /* each in its own random environment, with a task of the campaign's */
};
extern const char *const mo_worlds_words[]; /* "random", "environments", "tasks", NULL */

/* The settings of a campaign. */
struct mo_campaign_record {
  struct mo_campaign_settings settings; /* generations includes extensions */
  /* Name of the resulting controller, for a campaign that learns; "": "campaign-<id>". */
  char name[MO_NAME_BYTES_MAX + 1];
  char preset[16];                             /* as requested; "": none */
  char environment_set[MO_NAME_BYTES_MAX + 1]; /* "": listed in the request */
  uint32_t n_environments;                     /* if there is a set, the store fills it in */
  uint32_t n_listed;                           /* initial designs listed in the request */
  int64_t initial_campaign; /* the campaign from which the initial population was taken: its newest
                               one at submission; 0: none */
  int64_t group;            /* id of the first replicate, set in the first one as well */
  uint32_t replicate, replicates; /* number in the group, from 0; size of the group */
  uint32_t checkpoint_every_s;    /* while a generation is learning; 0: only at its end */
  enum mo_worlds worlds;          /* of a campaign that learns; otherwise MO_WORLDS_RANDOM */
  uint32_t measures; /* as bits: the measures of each design; all rollouts are then measured */
  struct mo_select_by select_by; /* selects by one of these measures */
  /* The score, if it is not the mean loss: the client of a study sends it, or it follows from
   * select_by. */
  struct mo_own_score own_score;
  struct mo_re_evaluation re_evaluate;
};
/* Returns whether the client of a study sends the scores. */
static inline bool mo_campaign_takes_scores(const struct mo_campaign_record *record)
{
  return mo_own_score_is_set(&record->own_score) && !record->select_by.is_set;
}

/* A generation, as in lists. It depends only on settings and seed, except for `seconds`,
 * `stored_us`, and `rollouts_cached`, which depends on the scores already stored. */
struct mo_campaign_generation {
  uint32_t generation;
  uint64_t born_before; /* number of its first child: the designs born in earlier generations */
  uint32_t n_children;
  uint32_t children_cut;              /* children whose score is a lower bound */
  struct mo_population_stats stats;   /* of the population after selection */
  double mean_parents, mean_children; /* mean scores before selection, without designs that
                                         diverged; NaN: no design is left. The children's mean
                                         includes lower bounds if any child was cut short */
  struct mo_variation_counts variation;
  uint32_t survived_mutants,
      survived_recombinants; /* children that selection kept; fallbacks count as mutants */
  double turnover;           /* share of the population born in this generation */
  uint64_t rollouts, rollouts_cached,
      rollouts_diverged;        /* for scores; cached: found in the store, included in `rollouts` */
  uint32_t learning_steps;      /* in this generation */
  double first_loss, last_loss; /* mean training loss of its first and last step; NaN: none */
  struct mo_held_out_summary held_out; /* of the population */
  bool collapse;                       /* this generation triggered the diversity warning */
  double seconds;                      /* wall time since the previous generation, without pauses */
  int64_t stored_us;
};

struct mo_campaign_step {
  uint32_t generation, step; /* step from 1 within the generation */
  bool on_children;
  struct mo_training_report report;
  double seconds;
};

enum mo_campaign_end { MO_CAMPAIGN_OPEN = 0, MO_CAMPAIGN_COMPLETED = 1, MO_CAMPAIGN_EXHAUSTED = 2 };

/* The current status of a campaign, read in one transaction. */
struct mo_campaign_status {
  /* Kind, state, version, weight, times, attempts, error; steps_total: generations; steps_done:
   * committed ones; both without generation 0. */
  struct mo_job job;
  struct mo_campaign_record record;
  int64_t generation;                 /* newest committed; −1: none */
  struct mo_campaign_generation last; /* if generation ≥ 0 */
  uint64_t n_designs;                 /* ever born */
  double best_score;                  /* of the newest population; NaN: none */
  double diversity_max;               /* so far */
  enum mo_campaign_end end;           /* of a succeeded campaign */
  uint32_t scored;                    /* designs of the current generation whose losses are saved */
  struct mo_study_words words;        /* of a study, and the names of the service's measures */
  /* Of a study. */
  int64_t told;           /* newest batch; pending if it is greater than `generation` */
  uint64_t sampler_bytes; /* size of the sampler's state in the newest generation; 0: none */
  struct mo_sha256 sampler_sha256;
  /* The source of an imported campaign: the id of its store, and its own id there; 0: not
   * imported. */
  uint64_t source_store;
  int64_t source_campaign, imported_us;
};

#endif
