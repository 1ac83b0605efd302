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

static void set_tau(uint32_t t, double tau, double lo, double hi)
{
  lists[t].tau = tau;
  lists[t].of_tau = (struct mo_interval){lo, hi};
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
  CHECK_TEXT(verdict(0, 0), "Its score is 0.01; only the base was scored.");
  const uint32_t precision = add(MO_AXIS_PRECISION, 64);
  scores[precision][0].score = 0.0112;
  CHECK_TEXT(verdict(0, 0),
             "In float64, it keeps rank 1, and its score changes from 0.01 to 0.011.");
  add(MO_AXIS_STEP, 2);
  const uint32_t step = add(MO_AXIS_STEP, 4);
  CHECK_TEXT(verdict(4, 0), "With finer time steps, it keeps rank 5, and its score stays at 0.05.");
  scores[step][4].rank = 7;
  CHECK_TEXT(
      verdict(4, 0),
      "With finer time steps, its rank hardly changes, from 5 to 7, and its score stays at 0.05.");
  scores[step][4].rank = 8;
  scores[step][4].score = 0.34;
  CHECK_TEXT(verdict(4, 0), "With finer time steps, it falls from rank 5 to rank 8, and its score "
                            "changes from 0.05 to 0.34.");
  scores[step][4].rank = 1;
  scores[step][4].score = 0.001;
  CHECK_TEXT(verdict(4, 0), "With finer time steps, it rises from rank 5 to rank 1, and its score "
                            "changes from 0.05 to 0.001.");
  diverge(step, 4, 3);
  CHECK_TEXT(verdict(4, 0),
             "Its score is in doubt: 3 of 10 rollouts diverge with finer time steps.");
  diverge(0, 4, 2);
  CHECK_TEXT(verdict(4, 0), "It has no score: 2 of 10 rollouts diverge at the base.");
}

static void flags(void)
{
  begin();
  add(MO_AXIS_STEP, 4);
  CHECK_TEXT(verdict(0, MO_FLAG_OVERSTRAINED | MO_FLAG_INVERTED),
             "It stretches springs to more than 3 times their length. It turns voxels inside out. "
             "With finer "
             "time steps, it keeps rank 1, and its score stays at 0.01.");
}

static void luck(void)
{
  begin();
  const uint32_t t = add(MO_AXIS_CHANCE, NAN);
  CHECK_TEXT(verdict(4, 0),
             "By luck alone, its score could be anywhere from 0.048 to 0.052 (rank 5).");
  scores[t][4].interval = (struct mo_interval){-0.02, 0.071};
  CHECK_TEXT(verdict(4, 0),
             "By luck alone, its score could be anywhere from 0 to 0.071 (ranks 1 to 7).");
  scores[t][4].interval = (struct mo_interval){0.0501, 0.0502};
  CHECK_TEXT(verdict(4, 0), "Luck hardly changes its score of 0.05 (rank 5).");
  diverge(t, 4, 1);
  CHECK_TEXT(verdict(4, 0), "1 of 10 rollouts diverges when the constants vary by up to 0.01 %.");
}

static void constants(void)
{
  begin();
  add(MO_AXIS_MASS, 0.7);
  const uint32_t mass = add(MO_AXIS_MASS, 1.3), friction = add(MO_AXIS_FRICTION, 0.5);
  const uint32_t drag = add(MO_AXIS_DRAG, 2), drop = add(MO_AXIS_DROP, 0.2);
  CHECK_TEXT(verdict(0, 0),
             "No single change to the physics makes its score clearly worse (by 0.05 or more).");
  set_score(friction, 0, 0.34);
  CHECK_TEXT(verdict(0, 0),
             "Its score worsens from 0.01 to 0.34 when friction is multiplied by 0.5.");
  CHECK_HAS(verdict(1, 0), "No single change");
  set_score(mass, 0, 0.1);
  CHECK_TEXT(verdict(0, 0),
             "Its score worsens from 0.01 to 0.34 when friction is multiplied by 0.5, "
             "and to 0.1 when mass is multiplied by 1.3.");
  set_score(drop, 0, 0.2);
  CHECK_TEXT(
      verdict(0, 0),
      "Its score worsens from 0.01 to 0.34 when friction is multiplied by 0.5, and to 0.2 when the "
      "drop height increases by 0.2 m; 1 other change makes it worse, too.");
  diverge(drag, 0, 4);
  CHECK_TEXT(
      verdict(0, 0),
      "4 of 10 rollouts diverge when drag is multiplied by 2, and its score worsens from 0.01 to "
      "0.34 when friction is multiplied by 0.5; 2 other changes make it worse, too.");
  /* Neither a small change nor an uncertain one counts. */
  set_score(friction, 3, 0.0899);
  CHECK_HAS(verdict(3, 0), "No single change");
  set_score(friction, 3, 0.0901);
  CHECK_HAS(verdict(3, 0), "to 0.09 when friction");
  scores[friction][3].of_change.lo = -0.01;
  CHECK_HAS(verdict(3, 0), "No single change");
  scores[friction][3].of_change = (struct mo_interval){NAN, NAN}; /* one world */
  CHECK_HAS(verdict(3, 0), "to 0.09 when friction");
}

static void worlds(void)
{
  begin();
  const uint32_t fresh = add(MO_AXIS_HELD_OUT, NAN), varied = add(MO_AXIS_WORLDS, NAN);
  CHECK_TEXT(verdict(4, 0), "In fresh worlds, its score is 0.05 (0.048 to 0.052).");
  set_score(varied, 4, 0.2);
  scores[varied][4].interval = (struct mo_interval){0.1, 0.3};
  CHECK_TEXT(
      verdict(4, 0),
      "When all constants vary, its score is 0.2 (0.1 to 0.3). In fresh worlds, its score is "
      "0.05 (0.048 to 0.052).");
  scores[fresh][4].interval = (struct mo_interval){0.0499, 0.0501};
  CHECK_HAS(verdict(4, 0), "In fresh worlds, its score is 0.05.");
  diverge(fresh, 4, 2);
  CHECK_HAS(verdict(4, 0), " 2 of 10 rollouts diverge in fresh worlds.");
}

static void alone(void)
{
  begin();
  add(MO_AXIS_STEP, 4);
  add(MO_AXIS_CHANCE, NAN);
  struct mo_trial_score one[] = {scores[0][3], scores[1][3], scores[2][3]};
  one[0].rank = one[1].rank = one[2].rank = 1;
  mo_certificate_verdict(trials, 3, one, 1, 0, 0, text);
  CHECK_TEXT(
      text,
      "With finer time steps, its score stays at 0.04. By luck alone, its score could be anywhere "
      "from 0.038 to 0.042.");
  mo_certificate_list_verdict(trials, 3, lists, 1, text);
  CHECK_TEXT(text, "No level makes the mean score worse by 0.05 or more.");

  one[1].score = 0.05;
  mo_certificate_verdict(trials, 2, one, 1, 0, 0, text);
  CHECK_TEXT(text, "With finer time steps, its score hardly changes, from 0.04 to 0.05.");

  /* A better score, or one that is worse only in some worlds, is not the same score. */
  one[1].score = 0.001;
  one[0].score = 0.1;
  one[1].change = -0.099;
  one[1].of_change = (struct mo_interval){-0.1, -0.098};
  mo_certificate_verdict(trials, 2, one, 1, 0, 0, text);
  CHECK_TEXT(text, "With finer time steps, its score changes from 0.1 to 0.001.");
  one[1].score = 0.9;
  one[1].change = 0.8;
  one[1].of_change = (struct mo_interval){-0.1, 1.7};
  mo_certificate_verdict(trials, 2, one, 1, 0, 0, text);
  CHECK_TEXT(text, "With finer time steps, its score changes from 0.1 to 0.9.");
  one[1].of_change.lo = 0.1;
  mo_certificate_verdict(trials, 2, one, 1, 0, 0, text);
  CHECK_TEXT(text, "With finer time steps, its score worsens from 0.1 to 0.9.");
}

/* Mean scores are those of the other designs, so the list's verdict says that some diverge. */
static void divergences(void)
{
  begin();
  const uint32_t mass = add(MO_AXIS_MASS, 0.7), friction = add(MO_AXIS_FRICTION, 0.5);
  lists[friction].n_diverged_designs = 2;
  lists[friction].mean_score = 0.01;
  CHECK_HAS(list_verdict(), " At 1 of 2 levels, more designs diverge than at the base (up to 2, "
                            "when friction is multiplied by 0.5).");
  lists[mass].n_diverged_designs = 3;
  lists[0].n_diverged_designs = 2;
  CHECK_HAS(list_verdict(), " At 1 of 2 levels, more designs diverge than at the base (up to 3, "
                            "when mass is multiplied by 0.7). 2 of 20 designs diverge at the base "
                            "and have no score.");
  lists[0].n_diverged_designs = 3;
  CHECK(strstr(list_verdict(), "more designs diverge") == NULL);
  lists[0].n_diverged_designs = 1;
  CHECK_HAS(list_verdict(), " 1 of 20 designs diverges at the base and has no score.");
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
  CHECK_TEXT(verdict(0, 0),
             "With finer time steps, it keeps rank 1, and its score changes from 99 to 100.");
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
  CHECK_TEXT(list_verdict(), "Only the base was scored.");
  const uint32_t step = add(MO_AXIS_STEP, 4), chance = add(MO_AXIS_CHANCE, NAN);
  CHECK_TEXT(list_verdict(),
             "The order of the 20 designs holds with finer time steps (tau 1.00) and when the "
             "constants vary by up to 0.01 % (tau 1.00; the effect of luck). Choosing by base "
             "scores costs nothing at any level.");
  const uint32_t fresh = add(MO_AXIS_HELD_OUT, NAN), friction = add(MO_AXIS_FRICTION, 0.5);
  add(MO_AXIS_MASS, 0.7);
  set_tau(chance, 0.7, 0.5, 0.9);
  set_tau(fresh, 0.4, 0.3, 0.51);
  set_tau(friction, 0.3, 0.1, 0.49);
  lists[friction].regret = 0.21;
  lists[friction].mean_score = 0.4;
  CHECK_TEXT(list_verdict(),
             "The order of the 20 designs holds with finer time steps (tau 1.00); it holds at "
             "least in part when the constants vary by up to 0.01 % (tau 0.70; the effect of "
             "luck); it does not hold when friction is multiplied by 0.5 (tau 0.30; the lowest of "
             "all single changes); whether it holds in fresh worlds (tau 0.40, interval 0.30 to "
             "0.51) is undetermined. Choosing by base scores costs up to 0.21 (when friction is "
             "multiplied by 0.5). In the worst case, the mean score goes from 0.1 to 0.4 (when "
             "friction is multiplied by 0.5).");
  lists[step].tau = lists[step].regret = NAN;
  lists[0].n_diverged_designs = 3;
  CHECK_HAS(list_verdict(),
            "The order of the 20 designs holds at least in part when the constants");
  CHECK_HAS(text, "At 1 of 5 levels, one of the designs that are best at the base diverges.");
  CHECK_HAS(text, " 3 of 20 designs diverge at the base and have no score.");
}

/* An order that tau does not determine is not said to hold, or not to. */
static void undetermined(void)
{
  begin();
  const uint32_t step = add(MO_AXIS_STEP, 4);
  set_tau(step, 0.9, 0.81, 0.95);
  CHECK_HAS(list_verdict(), "The order of the 20 designs holds with");
  set_tau(step, 0.9, 0.79, 0.95);
  CHECK_HAS(list_verdict(), "The order of the 20 designs holds at least in part with");
  set_tau(step, 0.9, 0.49, 1);
  CHECK_HAS(list_verdict(), "Whether the order of the 20 designs holds with finer time steps (tau "
                            "0.90, interval 0.49 to 1.00) is undetermined. ");
  set_tau(step, 0.1, -0.3, 0.5);
  CHECK_HAS(list_verdict(), "is undetermined. ");
  set_tau(step, 0.1, -0.3, 0.49);
  CHECK_HAS(list_verdict(), "The order of the 20 designs does not hold with");
  set_tau(step, 1, NAN, NAN);
  CHECK_HAS(list_verdict(), "with finer time steps (tau 1.00) is undetermined. ");

  const uint32_t fresh = add(MO_AXIS_HELD_OUT, NAN);
  set_tau(step, 1, NAN, NAN);
  set_tau(fresh, 1, 0.9, 1);
  mo_certificate_list_verdict(trials, n_trials, lists, 4, text);
  CHECK_HAS(text, "Whether the order of the 4 designs holds with finer time steps (tau 1.00) or in "
                  "fresh worlds (tau 1.00, interval 0.90 to 1.00) is undetermined: tau says little "
                  "about fewer than 5 designs. ");
  mo_certificate_list_verdict(trials, n_trials, lists, 5, text);
  CHECK_HAS(text, "The order of the 5 designs holds in fresh worlds (tau 1.00); whether it holds "
                  "with finer time steps (tau 1.00) is undetermined. ");
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
    {"an order that is undetermined", undetermined},
};
CHECK_MAIN(cases)
