/* verdict.c: the sentences, from figures that are made up. */
#include "fixture.h"

enum { TRIALS = 16, DESIGNS = 20 };

static struct mo_trial trials[TRIALS];
static struct mo_trial_score scores[TRIALS][DESIGNS];
static struct mo_trial_list lists[TRIALS];
static uint32_t n_trials;
static char text[MO_VERDICT_MAX];

/* Adds a trial in which the designs score 0.01, 0.02, …, without changes. */
static uint32_t add(enum mo_axis axis, double level)
{
  const uint32_t t = n_trials++;
  trials[t] = (struct mo_trial){.axis = axis, .level = level, .n_environments = 10};
  for (uint32_t i = 0; i < DESIGNS; i++) {
    const double score = 0.01 * (i + 1);
    scores[t][i] = (struct mo_trial_score){
        score, {score - 0.002, score + 0.002}, 0, {-0.001, 0.001}, 0, i + 1};
  }
  lists[t] = (struct mo_trial_list){0.1, 0, 1, {0.9, 1}, 0.015, 0};
  if (t == 0)
    lists[t].tau = lists[t].of_tau.lo = lists[t].of_tau.hi = lists[t].regret = NAN;
  return t;
}

static void begin(void)
{
  n_trials = 0;
  add(MO_AXIS_BASE, NAN);
}

/* Sets the score of a design at a level, and a certain change. */
static void set_score(uint32_t t, uint32_t design, double score)
{
  const double change = score - scores[0][design].score;
  scores[t][design].score = score;
  scores[t][design].change = change;
  scores[t][design].of_change = (struct mo_interval){change - 0.001, change + 0.001};
}

static void diverge(uint32_t t, uint32_t design, uint32_t rollouts)
{
  scores[t][design] = (struct mo_trial_score){NAN, {NAN, NAN}, NAN, {NAN, NAN}, rollouts, DESIGNS};
}

static const char *verdict(uint32_t design, uint32_t flags)
{
  mo_certificate_verdict(trials, n_trials, scores[0], DESIGNS, design, flags, text);
  return text;
}

static const char *list_verdict(void)
{
  mo_certificate_list_verdict(trials, n_trials, lists, DESIGNS, text);
  return text;
}

static void numerics(void)
{
  begin();
  CHECK_TEXT(verdict(0, 0), "Scores 0.01; no axis says what changes it.");
  const uint32_t precision = add(MO_AXIS_PRECISION, 64);
  scores[precision][0].score = 0.0112;
  CHECK_TEXT(verdict(0, 0), "Keeps its rank in float64 (0.01 to 0.011).");
  add(MO_AXIS_STEP, 2);
  const uint32_t step = add(MO_AXIS_STEP, 4);
  CHECK_TEXT(verdict(4, 0), "Keeps its rank on finer steps (0.05).");
  scores[step][4].rank = 7;
  CHECK_TEXT(verdict(4, 0), "About keeps its rank (5 to 7) on finer steps (0.05).");
  scores[step][4].rank = 8;
  scores[step][4].score = 0.34;
  CHECK_TEXT(verdict(4, 0), "Falls from rank 5 to 8 on finer steps (0.05 to 0.34).");
  scores[step][4].rank = 1;
  scores[step][4].score = 0.001;
  CHECK_TEXT(verdict(4, 0), "Rises from rank 5 to 1 on finer steps (0.05 to 0.001).");
  diverge(step, 4, 3);
  CHECK_TEXT(verdict(4, 0),
             "Its score is in doubt: it diverges in 3 of 10 rollouts on finer steps.");
  diverge(0, 4, 2);
  CHECK_TEXT(verdict(4, 0), "Has no score: it diverges in 2 of 10 rollouts at the base.");
}

static void flags(void)
{
  begin();
  add(MO_AXIS_STEP, 4);
  CHECK_TEXT(verdict(0, MO_FLAG_OVERSTRAINED | MO_FLAG_INVERTED),
             "Stretches springs to more than 3 times their length. Turns voxels inside out. Keeps "
             "its rank on finer steps (0.01).");
}

static void luck(void)
{
  begin();
  const uint32_t t = add(MO_AXIS_CHANCE, NAN);
  CHECK_TEXT(verdict(4, 0), "By luck, its score is 0.048 to 0.052 (rank 5).");
  scores[t][4].interval = (struct mo_interval){-0.02, 0.071};
  CHECK_TEXT(verdict(4, 0), "By luck, its score is 0 to 0.071 (ranks 1 to 7).");
  diverge(t, 4, 1);
  CHECK_TEXT(verdict(4, 0), "It diverges in 1 of 10 rollouts when constants change by 0.01 %.");
}

static void constants(void)
{
  begin();
  add(MO_AXIS_MASS, 0.7);
  const uint32_t mass = add(MO_AXIS_MASS, 1.3), friction = add(MO_AXIS_FRICTION, 0.5);
  const uint32_t drag = add(MO_AXIS_DRAG, 2), drop = add(MO_AXIS_DROP, 0.2);
  CHECK_TEXT(verdict(0, 0),
             "No change of one constant clearly worsens its score (by 0.05 or more).");
  set_score(friction, 0, 0.34);
  CHECK_TEXT(verdict(0, 0),
             "Its score goes from 0.01 to 0.34 when friction is 0.5 times as large.");
  CHECK_HAS(verdict(1, 0), "No change");
  set_score(mass, 0, 0.1);
  CHECK_TEXT(verdict(0, 0), "Its score goes from 0.01 to 0.34 when friction is 0.5 times as large "
                            "and to 0.1 when mass is 1.3 times as large.");
  set_score(drop, 0, 0.2);
  CHECK_TEXT(verdict(0, 0),
             "Its score goes from 0.01 to 0.34 when friction is 0.5 times as large and to 0.2 when "
             "dropped from 0.2 m higher; 1 other change worsens it.");
  diverge(drag, 0, 4);
  CHECK_TEXT(
      verdict(0, 0),
      "It diverges in 4 of 10 rollouts when drag is 2 times as large and its score goes from "
      "0.01 to 0.34 when friction is 0.5 times as large; 2 other changes worsen it.");
  /* Neither a small change nor an uncertain one counts. */
  set_score(friction, 3, 0.0899);
  CHECK_HAS(verdict(3, 0), "No change");
  set_score(friction, 3, 0.0901);
  CHECK_HAS(verdict(3, 0), "to 0.09 when friction");
  scores[friction][3].of_change.lo = -0.01;
  CHECK_HAS(verdict(3, 0), "No change");
  scores[friction][3].of_change = (struct mo_interval){NAN, NAN}; /* one world */
  CHECK_HAS(verdict(3, 0), "to 0.09 when friction");
}

static void worlds(void)
{
  begin();
  const uint32_t fresh = add(MO_AXIS_HELD_OUT, NAN), varied = add(MO_AXIS_WORLDS, NAN);
  CHECK_TEXT(verdict(4, 0), "Scores 0.05 (0.048 to 0.052) in fresh worlds.");
  set_score(varied, 4, 0.2);
  scores[varied][4].interval = (struct mo_interval){0.1, 0.3};
  CHECK_TEXT(verdict(4, 0),
             "Scores 0.2 (0.1 to 0.3) when all constants vary. Scores 0.05 (0.048 to "
             "0.052) in fresh worlds.");
  diverge(fresh, 4, 2);
  CHECK_HAS(verdict(4, 0), "It diverges in 2 of 10 rollouts in fresh worlds.");
}

static void alone(void)
{
  begin();
  add(MO_AXIS_STEP, 4);
  add(MO_AXIS_CHANCE, NAN);
  struct mo_trial_score one[] = {scores[0][3], scores[1][3], scores[2][3]};
  one[0].rank = one[1].rank = one[2].rank = 1;
  mo_certificate_verdict(trials, 3, one, 1, 0, 0, text);
  CHECK_TEXT(text, "Keeps its score on finer steps (0.04). By luck, its score is 0.038 to 0.042.");
  mo_certificate_list_verdict(trials, 3, lists, 1, text);
  CHECK_TEXT(text, "No level worsens the mean score by 0.05 or more.");

  /* A better score, or one that is worse only in some worlds, is not the same score. */
  one[1].score = 0.001;
  one[0].score = 0.1;
  one[1].change = -0.099;
  one[1].of_change = (struct mo_interval){-0.1, -0.098};
  mo_certificate_verdict(trials, 2, one, 1, 0, 0, text);
  CHECK_TEXT(text, "Its score changes on finer steps (0.1 to 0.001).");
  one[1].score = 0.9;
  one[1].change = 0.8;
  one[1].of_change = (struct mo_interval){-0.1, 1.7};
  mo_certificate_verdict(trials, 2, one, 1, 0, 0, text);
  CHECK_TEXT(text, "Its score changes on finer steps (0.1 to 0.9).");
  one[1].of_change.lo = 0.1;
  mo_certificate_verdict(trials, 2, one, 1, 0, 0, text);
  CHECK_TEXT(text, "Is worse on finer steps (0.1 to 0.9).");
}

/* Mean scores are those of the other designs, so the list's verdict says that some diverge. */
static void divergences(void)
{
  begin();
  const uint32_t mass = add(MO_AXIS_MASS, 0.7), friction = add(MO_AXIS_FRICTION, 0.5);
  lists[friction].n_diverged_designs = 2;
  lists[friction].mean_score = 0.01;
  CHECK_HAS(list_verdict(), " At 1 of 2 levels, more designs diverge than at the base: up to 2, "
                            "when friction is 0.5 times as large.");
  lists[mass].n_diverged_designs = 3;
  lists[0].n_diverged_designs = 2;
  CHECK_HAS(list_verdict(), " At 1 of 2 levels, more designs diverge than at the base: up to 3, "
                            "when mass is 0.7 times as large. 2 of 20 designs diverge at the base");
  lists[0].n_diverged_designs = 3;
  CHECK(strstr(list_verdict(), "more designs diverge") == NULL);
  lists[0].n_diverged_designs = 0;
  mo_certificate_list_verdict(trials, n_trials, lists, 1, text);
  CHECK_TEXT(text, "The design diverges at 2 of 2 levels.");
}

static void numbers(void)
{
  begin();
  const uint32_t step = add(MO_AXIS_STEP, 4);
  scores[0][0].score = 99.4;
  scores[step][0].score = 99.6;
  CHECK_TEXT(verdict(0, 0), "Keeps its rank on finer steps (99 to 100).");
}

/* The longest verdict fits. */
static void longest(void)
{
  begin();
  for (enum mo_axis axis = MO_AXIS_PRECISION; axis < MO_AXES; axis++) {
    const uint32_t t = add(axis, 0.123456);
    trials[t].n_environments = 1000000;
    diverge(t, 0, 999999);
    lists[t].tau = -0.99;
    lists[t].mean_score = 1.2345e-10 + t;
    lists[t].n_diverged_designs = 10 + t;
  }
  lists[0].n_diverged_designs = 10;
  CHECK(strlen(verdict(0, MO_FLAG_OVERSTRAINED | MO_FLAG_INVERTED)) < MO_VERDICT_MAX - 300);
  CHECK(text[strlen(text) - 1] == '.');
  CHECK(strlen(list_verdict()) < MO_VERDICT_MAX - 300 && text[strlen(text) - 1] == '.');
}

static void order(void)
{
  begin();
  CHECK_TEXT(list_verdict(), "Only the base is scored.");
  const uint32_t step = add(MO_AXIS_STEP, 4), chance = add(MO_AXIS_CHANCE, NAN);
  CHECK_TEXT(list_verdict(),
             "The order of the 20 designs holds on finer steps (tau 1.00) and when "
             "constants change by 0.01 % (tau 1.00: luck). Choosing the best at the "
             "base costs nothing at any level.");
  lists[chance].of_tau.lo = NAN;
  CHECK_HAS(list_verdict(),
            "(tau 1.00: luck); with fewer than four designs, tau has no interval. ");
  lists[chance].of_tau.lo = 0.9;
  const uint32_t fresh = add(MO_AXIS_HELD_OUT, NAN), friction = add(MO_AXIS_FRICTION, 0.5);
  add(MO_AXIS_MASS, 0.7);
  lists[step].tau = 0.8;
  lists[chance].tau = 0.79;
  lists[fresh].tau = 0.5;
  lists[friction].tau = 0.49;
  lists[friction].regret = 0.21;
  lists[friction].mean_score = 0.4;
  CHECK_TEXT(
      list_verdict(),
      "The order of the 20 designs holds on finer steps (tau 0.80); it holds in part in "
      "fresh worlds (tau 0.50) and when constants change by 0.01 % (tau 0.79: luck); it does "
      "not hold when friction is 0.5 times as large (tau 0.49, the lowest of one constant). "
      "Choosing the best at the base costs at most 0.21, when friction is 0.5 times as "
      "large. The mean score goes at worst from 0.1 to 0.4, when friction is 0.5 times as "
      "large.");
  lists[step].tau = lists[step].regret = NAN;
  lists[0].n_diverged_designs = 3;
  CHECK_HAS(list_verdict(), "The order of the 20 designs holds in part in fresh worlds");
  CHECK_HAS(text, "At 1 of 5 levels, one of the best at the base diverges.");
  CHECK_HAS(text, " 3 of 20 designs diverge at the base and have no score.");
}

/* In brief: the rules of the sentences. */
static void briefs(void)
{
  begin();
#define BRIEF(design) mo_certificate_brief(trials, n_trials, scores[0], DESIGNS, design)
  CHECK_INT(BRIEF(4).class, MO_CLASS_HOLDS);
  CHECK(BRIEF(4).finest == 0 && !BRIEF(4).is_kept && BRIEF(4).worse == 0);
  add(MO_AXIS_PRECISION, 64);
  CHECK_INT(BRIEF(4).finest, 1);
  const uint32_t step = add(MO_AXIS_STEP, 4), fresh = add(MO_AXIS_HELD_OUT, NAN);
  const uint32_t chance = add(MO_AXIS_CHANCE, NAN);
  add(MO_AXIS_MASS, 0.7);
  const uint32_t heavy = add(MO_AXIS_MASS, 1.3), all = add(MO_AXIS_WORLDS, NAN);
  scores[step][4].rank = 7;
  CHECK(BRIEF(4).class == MO_CLASS_HOLDS && BRIEF(4).finest == step && BRIEF(4).is_kept);
  diverge(chance, 4, 1);
  set_score(1, 4, 5);
  CHECK_INT(BRIEF(4).class, MO_CLASS_HOLDS); /* neither luck nor precision is a condition */
  set_score(fresh, 4, 0.099);
  CHECK_INT(BRIEF(4).worse, 0);
  set_score(fresh, 4, 0.1001);
  CHECK_INT(BRIEF(4).class, MO_CLASS_DEPENDS);
  CHECK_INT(BRIEF(4).worse, 1 << MO_AXIS_HELD_OUT);
  scores[fresh][4].of_change.lo = 0;
  CHECK_INT(BRIEF(4).worse, 0);
  set_score(heavy, 4, 0.5);
  diverge(all, 4, 2);
  CHECK_INT(BRIEF(4).worse, 1 << MO_AXIS_MASS | 1 << MO_AXIS_WORLDS);
  scores[step][4].rank = 8;
  CHECK(BRIEF(4).class == MO_CLASS_IN_DOUBT && !BRIEF(4).is_kept);
  diverge(step, 3, 1);
  CHECK_INT(BRIEF(3).class, MO_CLASS_IN_DOUBT);
  diverge(0, 4, 2);
  CHECK_INT(BRIEF(4).class, MO_CLASS_NO_SCORE);
  CHECK_INT(BRIEF(2).class, MO_CLASS_HOLDS);
  begin(); /* a design alone: its score counts */
  struct mo_trial_score lone[2] = {scores[0][0], scores[0][0]};
  add(MO_AXIS_STEP, 4);
  CHECK_INT(mo_certificate_brief(trials, 2, lone, 1, 0).class, MO_CLASS_HOLDS);
  lone[1].change = 0.05;
  CHECK_INT(mo_certificate_brief(trials, 2, lone, 1, 0).class, MO_CLASS_IN_DOUBT);
#undef BRIEF
}

static const struct check_case cases[] = {
    {"in brief", briefs},
    {"numerics", numerics},
    {"flags", flags},
    {"luck", luck},
    {"constants: at most two, the worst first", constants},
    {"worlds", worlds},
    {"one design", alone},
    {"divergences of a list", divergences},
    {"numbers", numbers},
    {"the longest verdict", longest},
    {"the list", order},
};
CHECK_MAIN(cases)
