/* columns.c: see columns.h. */
#include "store/columns.h"

#include "store/campaigns.h"
#include "store/trainings.h"

/* ---- steps of learning ---- */

#define COUNT  MO_COLUMN_COUNT
#define LONG   MO_COLUMN_LONG
#define NUMBER MO_COLUMN_NUMBER
#define FLAG   MO_COLUMN_FLAG
/* The result of a learning step, in rows of training runs and campaigns. */
#define REPORT(row)                                                                                \
  {"mean_loss", NUMBER, offsetof(row, report.mean_loss)},                                          \
      {"rate", NUMBER, offsetof(row, report.rate)},                                                \
      {"gradient_norm", NUMBER, offsetof(row, report.gradient_norm)},                              \
      {"clipped_share", NUMBER, offsetof(row, report.clipped_share)},                              \
      {"clipped_robots_share", NUMBER, offsetof(row, report.clipped_robots_share)},                \
      {"diverged", COUNT, offsetof(row, report.diverged)},                                         \
      {"zeroed", COUNT, offsetof(row, report.zeroed)},                                             \
      {"skipped", FLAG, offsetof(row, report.skipped)},                                            \
      {"bounded", COUNT, offsetof(row, report.bounded)},                                           \
  {                                                                                                \
    "seconds", NUMBER, offsetof(row, seconds)                                                      \
  }

static const struct mo_column step_columns[] = {
    {"step", COUNT, offsetof(struct mo_training_step_row, report.step)},
    REPORT(struct mo_training_step_row),
};
const struct mo_columns mo_step_columns = MO_COLUMNS(step_columns, 0);

static const struct mo_column campaign_step_columns[] = {
    {"generation", COUNT, offsetof(struct mo_campaign_step, generation)},
    {"step", COUNT, offsetof(struct mo_campaign_step, step)},
    {"on", MO_COLUMN_WORD, offsetof(struct mo_campaign_step, on_children),
     .words = {"parents", "children"}},
    REPORT(struct mo_campaign_step),
    {"training_step", COUNT, offsetof(struct mo_campaign_step, report.step)},
};
const struct mo_columns mo_campaign_step_columns = MO_COLUMNS(campaign_step_columns, 1);

#define AT(member) offsetof(struct mo_training_validation_row, member)
static const struct mo_column validation_columns[] = {
    {"step", COUNT, AT(step)},
    {"mean_score", NUMBER, AT(mean_score)},
    {"standard_error", NUMBER, AT(standard_error)},
    {"rollouts", COUNT, AT(rollouts)},
    {"diverged", COUNT, AT(diverged)},
};
#undef AT
const struct mo_columns mo_validation_columns = MO_COLUMNS(validation_columns, 0);

/* ---- generations ---- */

#define AT(member) offsetof(struct mo_campaign_generation, member)
static const struct mo_column generation_columns[] = {
    {"generation", COUNT, AT(generation)},
    {"population", COUNT, AT(stats.n)},
    {"born", COUNT, AT(n_children)},
    {"first_number", LONG, AT(born_before)},
    {"score.mean", NUMBER, AT(stats.mean_score), "mean"},
    {"score.quantiles.p0", NUMBER, AT(stats.quantiles[0]), "p0"},
    {"score.quantiles.p5", NUMBER, AT(stats.quantiles[1]), "p5"},
    {"score.quantiles.p25", NUMBER, AT(stats.quantiles[2]), "p25"},
    {"score.quantiles.p50", NUMBER, AT(stats.quantiles[3]), "p50"},
    {"score.quantiles.p75", NUMBER, AT(stats.quantiles[4]), "p75"},
    {"score.quantiles.p95", NUMBER, AT(stats.quantiles[5]), "p95"},
    {"score.quantiles.p100", NUMBER, AT(stats.quantiles[6]), "p100"},
    {"score.diverged", COUNT, AT(stats.n_diverged), "diverged"},
    {"diversity", NUMBER, AT(stats.diversity)},
    {"species", COUNT, AT(stats.species)},
    {"turnover", NUMBER, AT(turnover)},
    {"operators.mutation.born", COUNT, AT(variation.mutants), "mutation_born"},
    {"operators.mutation.survived", COUNT, AT(survived_mutants), "mutation_survived"},
    {"operators.mutation.attempts", LONG, AT(variation.mutation_attempts), "mutation_attempts"},
    {"operators.crossover.born", COUNT, AT(variation.recombinants), "crossover_born"},
    {"operators.crossover.survived", COUNT, AT(survived_recombinants), "crossover_survived"},
    {"operators.crossover.attempts", LONG, AT(variation.crossover_attempts), "crossover_attempts"},
    {"operators.fallbacks", COUNT, AT(variation.fallbacks), "fallbacks"},
    MO_SPREAD_COLUMNS("voxels", AT(stats.voxels)),
    MO_SPREAD_COLUMNS("footprint", AT(stats.footprint)),
    MO_SPREAD_COLUMNS("masses", AT(stats.masses)),
    MO_SPREAD_COLUMNS("springs", AT(stats.springs)),
    {"parents_mean", NUMBER, AT(mean_parents)},
    {"children_mean", NUMBER, AT(mean_children)},
    {"children_cut", COUNT, AT(children_cut)},
    {"learning.steps", COUNT, AT(learning_steps), "learning_steps"},
    {"learning.first_loss", NUMBER, AT(first_loss), "first_loss"},
    {"learning.last_loss", NUMBER, AT(last_loss), "last_loss"},
    {"rollouts", LONG, AT(rollouts)},
    {"cached", LONG, AT(rollouts_cached)},
    {"rollouts_diverged", LONG, AT(rollouts_diverged)},
    {"exhausted", FLAG, AT(variation.exhausted)},
    {"collapse", FLAG, AT(collapse)},
    {"seconds", NUMBER, AT(seconds)},
    /* N_HELD_OUT columns about re-evaluations. They follow from other rows, and are not in
     * bundles. */
    {"held_out.designs", COUNT, AT(held_out.designs), "held_out_designs"},
    {"held_out.worlds", COUNT, AT(held_out.worlds), "held_out_worlds"},
    {"held_out.rollouts", LONG, AT(held_out.rollouts), "held_out_rollouts"},
    {"held_out.diverged", LONG, AT(held_out.diverged), "held_out_diverged"},
    {"held_out.mean", NUMBER, AT(held_out.champion.mean), "held_out_mean"},
    {"held_out.standard_error", NUMBER, AT(held_out.champion.standard_error),
     "held_out_standard_error"},
    {"held_out.low", NUMBER, AT(held_out.champion_interval.lo), "held_out_low"},
    {"held_out.high", NUMBER, AT(held_out.champion_interval.hi), "held_out_high"},
    {"held_out.top_mean", NUMBER, AT(held_out.top_mean), "held_out_top_mean"},
    {"held_out.top_score", NUMBER, AT(held_out.top_score), "held_out_top_score"},
    {"stored_us", MO_COLUMN_TIME, AT(stored_us)},
};
#undef AT
#define N_HELD_OUT 10
const struct mo_columns mo_generation_columns = MO_COLUMNS(generation_columns, 1);
const struct mo_columns mo_bundle_generation_columns =
    MO_COLUMNS(generation_columns, 1 + N_HELD_OUT);
_Static_assert(MO_QUANTILES == 7, "one column for each quantile");
