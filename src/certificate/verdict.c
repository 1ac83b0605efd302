/* verdict.c: describes figures in words. The rules are those of include/morpho/certificate.h. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include <morpho/certificate.h>
#include <morpho/measure.h>

#include "base/text.h"

/* ---- words ---- */

#define SHORT_BYTES 32

/* Rounds a number to two digits, or to a whole number. 99.5 and more have a third digit, for which
 * "%.2g" would write an exponent. */
static const char *rounded(double value, char text[SHORT_BYTES])
{
  snprintf(text, SHORT_BYTES, fabs(value) >= 99.5 ? "%.0f" : "%.2g", value);
  return text;
}
#define ROUNDED(value) rounded((value), (char[SHORT_BYTES]){0})

static struct mo_text begin(char text[MO_VERDICT_MAX])
{
  text[0] = '\0';
  return (struct mo_text){.data = text, .capacity = MO_VERDICT_MAX, .is_fixed = true};
}

/* Separates a sentence from the previous one. */
static void next_sentence(struct mo_text *text)
{
  if (text->size > 0)
    mo_text_add(text, " ");
}

/* Returns whether two numbers are rounded to the same text. */
static bool look_equal(double one, double other)
{
  return strcmp(ROUNDED(one), ROUNDED(other)) == 0;
}

/* Appends what a level changes: "when friction is multiplied by 0.5". */
static void add_where(struct mo_text *text, const struct mo_trial *trial)
{
  switch (trial->axis) {
  case MO_AXIS_BASE: mo_text_add(text, "at the base"); break;
  case MO_AXIS_PRECISION: mo_text_add(text, "in float64"); break;
  case MO_AXIS_STEP: mo_text_add(text, "with finer time steps"); break;
  case MO_AXIS_HELD_OUT: mo_text_add(text, "in fresh worlds"); break;
  case MO_AXIS_CHANCE: mo_text_add(text, "when the constants vary by up to 0.01 %"); break;
  case MO_AXIS_WORLDS: mo_text_add(text, "when all constants vary"); break;
  case MO_AXIS_DROP:
    mo_text_format(text, "when the drop height increases by %.6g m", trial->level);
    break;
  default:
    mo_text_format(text, "when %s is multiplied by %.6g", mo_axis_words[trial->axis], trial->level);
  }
}

/* Returns whether an axis changes a single constant, or the start position. */
static bool is_of_one(enum mo_axis axis)
{
  return axis >= MO_AXIS_STIFFNESS && axis <= MO_AXIS_DROP;
}

/* Returns the last trial of an axis, or 0, the base, if there is none. */
static uint32_t last_of(const struct mo_trial *trials, uint32_t n_trials, enum mo_axis axis)
{
  uint32_t found = 0;
  for (uint32_t t = 1; t < n_trials; t++)
    if (trials[t].axis == axis)
      found = t;
  return found;
}

/* Returns the trial with the smallest numerical error; 0: none. */
static uint32_t finest(const struct mo_trial *trials, uint32_t n_trials)
{
  const uint32_t step = last_of(trials, n_trials, MO_AXIS_STEP);
  return step > 0 ? step : last_of(trials, n_trials, MO_AXIS_PRECISION);
}

/* ---- a design ---- */

struct about {
  const struct mo_trial *trials;
  const struct mo_trial_score *scores; /* (n_trials, n_designs) */
  uint32_t n_trials, n_designs, design;
};

static const struct mo_trial_score *score_at(const struct about *about, uint32_t t)
{
  return &about->scores[(size_t)t * about->n_designs + about->design];
}

/* Returns by how much the score is worse at a level: infinity for a divergence, 0 if it is not
 * worse. */
static double worse_by(const struct about *about, uint32_t t)
{
  const struct mo_trial_score *score = score_at(about, t);
  if (score->diverged > 0)
    return INFINITY;
  const bool is_sure = !(score->of_change.lo <= 0);
  return score->change >= MO_VERDICT_CHANGE && is_sure ? score->change : 0;
}

static void add_divergence(struct mo_text *text, const struct about *about, uint32_t t)
{
  const unsigned n = about->trials[t].n_environments, diverged = score_at(about, t)->diverged;
  mo_text_format(text, "%u of %u rollouts %s ", diverged, n,
                 diverged == 1 ? "diverges" : "diverge");
  add_where(text, &about->trials[t]);
}

static void add_flags(struct mo_text *text, uint32_t flags)
{
  if (flags & MO_FLAG_OVERSTRAINED) {
    next_sentence(text);
    mo_text_format(text, "It stretches springs to more than %g times their length.",
                   MO_PEAK_STRAIN_BOUND + 1);
  }
  if (flags & MO_FLAG_INVERTED) {
    next_sentence(text);
    mo_text_add(text, "It turns voxels inside out.");
  }
}

/* Returns whether a rank is roughly kept at a level; for a single design, which has no rank that
 * could change, whether its score is. */
static bool is_kept_at(const struct about *about, uint32_t t)
{
  const struct mo_trial_score *here = score_at(about, t), *base = score_at(about, 0);
  const double few = fmax(1, MO_VERDICT_RANKS * about->n_designs);
  if (here->diverged > 0)
    return false;
  return about->n_designs == 1 ? !(fabs(here->change) >= MO_VERDICT_CHANGE)
                               : fabs((double)here->rank - base->rank) <= few;
}

/* Appends what finer steps do to the rank and to the score. For a single design, only the score can
 * change. */
static void add_numerics(struct mo_text *text, const struct about *about)
{
  const uint32_t t = finest(about->trials, about->n_trials);
  const struct mo_trial_score *here = score_at(about, t), *base = score_at(about, 0);
  const unsigned from = base->rank, to = here->rank;
  const bool is_kept = is_kept_at(about, t), is_same = look_equal(base->score, here->score);
  if (t == 0)
    return;
  next_sentence(text);
  if (here->diverged > 0) {
    mo_text_add(text, "Its score is in doubt: ");
    add_divergence(text, about, t);
    mo_text_add(text, ".");
    return;
  }
  mo_text_add(text,
              about->trials[t].axis == MO_AXIS_STEP ? "With finer time steps, " : "In float64, ");
  if (about->n_designs == 1)
    mo_text_add(text, is_same                  ? "its score stays at "
                      : is_kept                ? "its score hardly changes, from "
                      : worse_by(about, t) > 0 ? "its score worsens from "
                                               : "its score changes from ");
  else if (from == to)
    mo_text_format(text, "it keeps rank %u, and its score ", to);
  else if (is_kept)
    mo_text_format(text, "its rank hardly changes, from %u to %u, and its score ", from, to);
  else
    mo_text_format(text, "it %s from rank %u to rank %u, and its score ",
                   to > from ? "falls" : "rises", from, to);
  if (about->n_designs > 1)
    mo_text_add(text, is_same ? "stays at " : "changes from ");
  mo_text_add(text, ROUNDED(base->score));
  if (!is_same)
    mo_text_format(text, " to %s", ROUNDED(here->score));
  mo_text_add(text, ".");
}

/* Returns the rank that a score would have among the other designs at the base. */
static uint32_t rank_among_others(const struct about *about, double score)
{
  uint32_t rank = 1;
  for (uint32_t i = 0; i < about->n_designs; i++)
    rank += i != about->design && about->scores[i].score < score;
  return rank;
}

static void add_luck(struct mo_text *text, const struct about *about)
{
  const uint32_t t = last_of(about->trials, about->n_trials, MO_AXIS_CHANCE);
  const struct mo_interval interval = score_at(about, t)->interval;
  if (t == 0)
    return;
  next_sentence(text);
  if (score_at(about, t)->diverged > 0) {
    add_divergence(text, about, t);
    mo_text_add(text, ".");
    return;
  }
  const double lo = fmax(interval.lo, 0); /* losses are at least 0 */
  const uint32_t first = rank_among_others(about, lo);
  const uint32_t last = rank_among_others(about, interval.hi);
  if (look_equal(lo, interval.hi))
    mo_text_format(text, "Luck hardly changes its score of %s", ROUNDED(lo));
  else
    mo_text_format(text, "By luck alone, its score could be anywhere from %s to %s", ROUNDED(lo),
                   ROUNDED(interval.hi));
  if (about->n_designs > 1 && first == last)
    mo_text_format(text, " (rank %u)", (unsigned)first);
  else if (about->n_designs > 1)
    mo_text_format(text, " (ranks %u to %u)", (unsigned)first, (unsigned)last);
  mo_text_add(text, ".");
}

/* Appends the worst axes of one constant, each at its worst level. */
static void add_constants(struct mo_text *text, const struct about *about)
{
  uint32_t worst[MO_AXES] = {0}, order[MO_AXES], n = 0, others = 0;
  bool any = false;
  for (uint32_t t = 1; t < about->n_trials; t++) {
    const enum mo_axis axis = about->trials[t].axis;
    any = any || is_of_one(axis);
    if (is_of_one(axis) &&
        worse_by(about, t) > (worst[axis] > 0 ? worse_by(about, worst[axis]) : 0))
      worst[axis] = t;
  }
  for (unsigned axis = 0; axis < MO_AXES; axis++) {
    uint32_t at = n;
    if (worst[axis] == 0)
      continue;
    while (at > 0 && worse_by(about, order[at - 1]) < worse_by(about, worst[axis])) {
      order[at] = order[at - 1];
      at--;
    }
    order[at] = worst[axis];
    n++;
  }
  if (!any)
    return;
  next_sentence(text);
  if (n == 0) {
    mo_text_format(text,
                   "No single change to the physics makes its score clearly worse (by %g or more).",
                   MO_VERDICT_CHANGE);
    return;
  }
  bool has_from = false;
  for (uint32_t i = 0; i < n && i < MO_VERDICT_AXES; i++) {
    mo_text_add(text, i == 0 ? "" : i + 1 < n && i + 1 < MO_VERDICT_AXES ? ", " : ", and ");
    if (score_at(about, order[i])->diverged > 0) {
      add_divergence(text, about, order[i]);
      continue;
    }
    mo_text_add(text, i == 0 ? "Its score worsens " : has_from ? "" : "its score worsens ");
    if (!has_from)
      mo_text_format(text, "from %s ", ROUNDED(score_at(about, 0)->score));
    has_from = true;
    mo_text_format(text, "to %s ", ROUNDED(score_at(about, order[i])->score));
    add_where(text, &about->trials[order[i]]);
  }
  others = n > MO_VERDICT_AXES ? n - MO_VERDICT_AXES : 0;
  if (others > 0)
    mo_text_format(text, "; %u other %s", (unsigned)others,
                   others == 1 ? "change makes it worse, too" : "changes make it worse, too");
  mo_text_add(text, ".");
}

/* Appends the score in fresh worlds, and with varied constants if it is worse there. */
static void add_worlds(struct mo_text *text, const struct about *about, enum mo_axis axis)
{
  const uint32_t t = last_of(about->trials, about->n_trials, axis);
  const struct mo_trial_score *score = score_at(about, t);
  if (t == 0 || (axis == MO_AXIS_WORLDS && worse_by(about, t) == 0))
    return;
  next_sentence(text);
  if (score->diverged > 0) {
    add_divergence(text, about, t);
  } else {
    mo_text_format(text, "%s, its score is %s",
                   axis == MO_AXIS_WORLDS ? "When all constants vary" : "In fresh worlds",
                   ROUNDED(score->score));
    if (!isnan(score->interval.lo) && !look_equal(score->interval.lo, score->interval.hi))
      mo_text_format(text, " (%s to %s)", ROUNDED(score->interval.lo), ROUNDED(score->interval.hi));
  }
  mo_text_add(text, ".");
}

void mo_certificate_verdict(const struct mo_trial *trials, uint32_t n_trials,
                            const struct mo_trial_score *scores, uint32_t n_designs,
                            uint32_t design, uint32_t flags, char text[MO_VERDICT_MAX])
{
  const struct about about = {trials, scores, n_trials, n_designs, design};
  struct mo_text words = begin(text);
  add_flags(&words, flags);
  if (score_at(&about, 0)->diverged > 0) {
    next_sentence(&words);
    mo_text_add(&words, "It has no score: ");
    add_divergence(&words, &about, 0);
    mo_text_add(&words, ".");
    return;
  }
  add_numerics(&words, &about);
  add_luck(&words, &about);
  add_constants(&words, &about);
  add_worlds(&words, &about, MO_AXIS_WORLDS);
  add_worlds(&words, &about, MO_AXIS_HELD_OUT);
  if (words.size == 0)
    mo_text_format(&words, "Its score is %s; %s.", ROUNDED(score_at(&about, 0)->score),
                   n_trials > 1 ? "no level makes it clearly worse" : "only the base was scored");
}

/* ---- in brief ---- */

const char *const mo_verdict_words[] = {"no_score", "in_doubt", "depends", "holds", NULL};

/* Returns whether an axis changes conditions that a design may depend on, rather than the numerics
 * or chance. */
static bool is_of_conditions(enum mo_axis axis)
{
  return axis == MO_AXIS_HELD_OUT || axis == MO_AXIS_WORLDS || is_of_one(axis);
}

struct mo_verdict mo_certificate_brief(const struct mo_trial *trials, uint32_t n_trials,
                                       const struct mo_trial_score *scores, uint32_t n_designs,
                                       uint32_t design)
{
  const struct about about = {trials, scores, n_trials, n_designs, design};
  struct mo_verdict brief = {.finest = finest(trials, n_trials)};
  for (uint32_t t = 1; t < n_trials; t++)
    if (is_of_conditions(trials[t].axis) && worse_by(&about, t) > 0)
      brief.worse |= UINT32_C(1) << trials[t].axis;
  brief.is_kept = brief.finest > 0 && is_kept_at(&about, brief.finest);
  brief.class = score_at(&about, 0)->diverged > 0    ? MO_CLASS_NO_SCORE
                : brief.finest > 0 && !brief.is_kept ? MO_CLASS_IN_DOUBT
                : brief.worse != 0                   ? MO_CLASS_DEPENDS
                                                     : MO_CLASS_HOLDS;
  return brief;
}

/* ---- the list ---- */

/* What the interval of tau says about an order. */
enum holding { HOLDS, PARTLY, NOT, OPEN, HOLDINGS };
static const char *const holding_words[] = {"holds", "holds at least in part", "does not hold"};

/* The answer is OPEN for few designs, or if the interval contains the least tau of an order that
 * holds in part. */
static enum holding holding_of(const struct mo_trial_list *list, uint32_t n_designs)
{
  const struct mo_interval tau = list->of_tau;
  if (n_designs < MO_VERDICT_DESIGNS || isnan(tau.lo))
    return OPEN;
  return tau.lo >= MO_VERDICT_HOLDS    ? HOLDS
         : tau.lo >= MO_VERDICT_PARTLY ? PARTLY
         : tau.hi < MO_VERDICT_PARTLY  ? NOT
                                       : OPEN;
}

/* Collects the trials that the sentence about the order covers. Returns their number. */
static uint32_t choose_trials(const struct mo_trial *trials, uint32_t n_trials,
                              const struct mo_trial_list *lists, uint32_t chosen[MO_AXES])
{
  const uint32_t of_axes[] = {finest(trials, n_trials), last_of(trials, n_trials, MO_AXIS_HELD_OUT),
                              last_of(trials, n_trials, MO_AXIS_WORLDS),
                              last_of(trials, n_trials, MO_AXIS_CHANCE)};
  uint32_t n = 0, lowest = 0;
  for (size_t i = 0; i < sizeof(of_axes) / sizeof(*of_axes); i++)
    if (of_axes[i] > 0 && !isnan(lists[of_axes[i]].tau))
      chosen[n++] = of_axes[i];
  for (uint32_t t = 1; t < n_trials; t++)
    if (is_of_one(trials[t].axis) && !isnan(lists[t].tau) &&
        (lowest == 0 || lists[t].tau < lists[lowest].tau))
      lowest = t;
  if (lowest > 0)
    chosen[n++] = lowest;
  return n;
}

/* Appends tau and, where it leaves the order open, its interval. */
static void add_tau(struct mo_text *text, const struct mo_trial *trial,
                    const struct mo_trial_list *list, bool is_open)
{
  mo_text_format(text, " (tau %.2f", list->tau);
  if (is_open && !isnan(list->of_tau.lo))
    mo_text_format(text, ", interval %.2f to %.2f", list->of_tau.lo, list->of_tau.hi);
  mo_text_add(text, trial->axis == MO_AXIS_CHANCE ? "; the effect of luck)"
                    : is_of_one(trial->axis)      ? "; the lowest of all single changes)"
                                                  : ")");
}

static void add_order(struct mo_text *text, const struct mo_trial *trials, uint32_t n_trials,
                      const struct mo_trial_list *lists, uint32_t n_designs)
{
  uint32_t chosen[MO_AXES];
  const uint32_t n = choose_trials(trials, n_trials, lists, chosen);
  bool any = false;
  if (n == 0)
    return;
  for (enum holding holding = HOLDS; holding < HOLDINGS; holding++) {
    uint32_t left = 0;
    for (uint32_t i = 0; i < n; i++)
      left += holding_of(&lists[chosen[i]], n_designs) == holding;
    if (left == 0)
      continue;
    const char *last = holding == NOT || holding == OPEN ? " or " : " and ";
    mo_text_add(text, any ? "; " : "");
    mo_text_add(text, holding != OPEN ? "" : any ? "whether " : "Whether ");
    if (any)
      mo_text_add(text, "it ");
    else
      mo_text_format(text, "%s order of the %u designs ", holding == OPEN ? "the" : "The",
                     (unsigned)n_designs);
    mo_text_format(text, "%s ", holding_words[holding == OPEN ? HOLDS : holding]);
    any = true;
    for (uint32_t i = 0; i < n; i++) {
      if (holding_of(&lists[chosen[i]], n_designs) != holding)
        continue;
      add_where(text, &trials[chosen[i]]);
      add_tau(text, &trials[chosen[i]], &lists[chosen[i]], holding == OPEN);
      left--;
      mo_text_add(text, left > 1 ? ", " : left == 1 ? last : "");
    }
    mo_text_add(text, holding == OPEN ? " is undetermined" : "");
  }
  if (n_designs < MO_VERDICT_DESIGNS)
    mo_text_format(text, ": tau says little about fewer than %d designs", MO_VERDICT_DESIGNS);
  mo_text_add(text, ".");
}

static void add_regret(struct mo_text *text, const struct mo_trial *trials, uint32_t n_trials,
                       const struct mo_trial_list *lists)
{
  uint32_t most = 0, lost = 0;
  for (uint32_t t = 1; t < n_trials; t++) {
    lost += isnan(lists[t].regret);
    if (!isnan(lists[t].regret) && (most == 0 || lists[t].regret > lists[most].regret))
      most = t;
  }
  if (lost > 0 && !isnan(lists[0].top_score)) {
    next_sentence(text);
    mo_text_format(text,
                   "At %u of %u levels, one of the designs that are best at the base "
                   "diverges.",
                   (unsigned)lost, (unsigned)(n_trials - 1));
  }
  if (most > 0 && !(lists[most].regret > 0)) {
    next_sentence(text);
    mo_text_add(text, lost > 0 ? "At the other levels, choosing by base scores costs nothing."
                               : "Choosing by base scores costs nothing at any level.");
  } else if (most > 0) {
    next_sentence(text);
    mo_text_format(text, "Choosing by base scores costs up to %s (", ROUNDED(lists[most].regret));
    add_where(text, &trials[most]);
    mo_text_add(text, ").");
  }
}

static void add_means(struct mo_text *text, const struct mo_trial *trials, uint32_t n_trials,
                      const struct mo_trial_list *lists)
{
  uint32_t worst = 0;
  for (uint32_t t = 1; t < n_trials; t++)
    if (lists[t].mean_score - lists[worst].mean_score > 0)
      worst = t;
  if (!(lists[worst].mean_score - lists[0].mean_score >= MO_VERDICT_CHANGE))
    return;
  next_sentence(text);
  mo_text_format(text, "In the worst case, the mean score goes from %s to %s (",
                 ROUNDED(lists[0].mean_score), ROUNDED(lists[worst].mean_score));
  add_where(text, &trials[worst]);
  mo_text_add(text, ").");
}

/* Appends where designs diverge. They are in no mean score, which may therefore look better than it
 * is. */
static void add_divergences(struct mo_text *text, const struct mo_trial *trials, uint32_t n_trials,
                            const struct mo_trial_list *lists, uint32_t n_designs)
{
  const uint32_t of_base = lists[0].n_diverged_designs;
  uint32_t most = 0, levels = 0;
  for (uint32_t t = 1; t < n_trials; t++) {
    levels += lists[t].n_diverged_designs > of_base;
    if (lists[t].n_diverged_designs > lists[most].n_diverged_designs)
      most = t;
  }
  if (levels > 0) {
    next_sentence(text);
    if (n_designs == 1)
      mo_text_format(text, "The design diverges at %u of %u levels.", (unsigned)levels,
                     (unsigned)(n_trials - 1));
    else {
      mo_text_format(text, "At %u of %u levels, more designs diverge than at the base (up to %u, ",
                     (unsigned)levels, (unsigned)(n_trials - 1),
                     (unsigned)lists[most].n_diverged_designs);
      add_where(text, &trials[most]);
      mo_text_add(text, ").");
    }
  }
  if (of_base > 0) {
    next_sentence(text);
    mo_text_format(text,
                   of_base == 1 ? "%u of %u designs diverges at the base and has no score."
                                : "%u of %u designs diverge at the base and have no score.",
                   (unsigned)of_base, (unsigned)n_designs);
  }
}

void mo_certificate_list_verdict(const struct mo_trial *trials, uint32_t n_trials,
                                 const struct mo_trial_list *lists, uint32_t n_designs,
                                 char text[MO_VERDICT_MAX])
{
  struct mo_text words = begin(text);
  if (n_designs > 1)
    add_order(&words, trials, n_trials, lists, n_designs);
  if (n_designs > 1)
    add_regret(&words, trials, n_trials, lists);
  add_means(&words, trials, n_trials, lists);
  add_divergences(&words, trials, n_trials, lists, n_designs);
  if (words.size == 0)
    mo_text_format(&words,
                   n_trials > 1 ? "No level makes the mean score worse by %g or more."
                                : "Only the base was scored.",
                   MO_VERDICT_CHANGE);
}
