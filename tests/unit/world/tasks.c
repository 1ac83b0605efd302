/* Tasks: words, units and bounds. */
#include "../make.h"

static const struct mo_guide guides[] = {
    {.kind = MO_GUIDE_FIXED},
    {.kind = MO_GUIDE_AHEAD, .heading_rad = 1, .distance_m = 1.5},
    {.kind = MO_GUIDE_TURNING, .heading_rad = 1, .turn_rad_per_s = 1, .distance_m = 1.5},
    {.kind = MO_GUIDE_PATH, .n_points = 2, .points_m = {{3, 3}, {4, 2}}, .distance_m = 1.5},
    {.kind = MO_GUIDE_MOVING, .velocity_m_per_s = {1, 0}},
};

/* Every pair of a guide and an objective is either accepted, or refused with both names. */
static void pairs(void)
{
  static const char *const fits[] = {"fixed moving",
                                     "fixed moving",
                                     "ahead turning",
                                     "path",
                                     "fixed ahead turning path moving",
                                     "moving",
                                     "fixed ahead turning path moving",
                                     "fixed ahead turning path moving"};
  CHECK(mo_guide_words[COUNT(guides)] == NULL && mo_objective_words[COUNT(fits)] == NULL);
  for (size_t o = 0; o < COUNT(fits); o++)
    for (size_t g = 0; g < COUNT(guides); g++) {
      const struct mo_task task = {.guide = guides[g], .objective = (enum mo_objective)o};
      struct mo_message message = {""};
      const bool fit = strstr(fits[o], mo_guide_words[g]) != NULL;
      CHECK_INT(mo_task_check(&task, &message), fit ? MO_OK : MO_ERR_INVALID);
      CHECK(fit || (strstr(message.text, mo_guide_words[g]) != NULL &&
                    strstr(message.text, mo_objective_words[o]) != NULL));
      CHECK(mo_task_is_plain(&task) == (o == 0 && g == 0));
    }
  CHECK_TEXT(mo_objective_unit(MO_OBJECTIVE_TRAVEL), "m");
  CHECK_TEXT(mo_objective_unit(MO_OBJECTIVE_REACH), "");
}

static void bounds(void)
{
  struct mo_environment environment;
  struct mo_guide *guide = &environment.task.guide;
  mo_environment_training(1, 2, 3, &environment);
  memset(environment.light_xy_m, 0, sizeof(environment.light_xy_m)); /* most guides have none */
  const struct {
    int guide;
    double *number, value;
    int code;
    const char *message;
  } bad[] = {
      {1, &guide->distance_m, 0, MO_ERR_RANGE,
       "distance_m must be at least 0.1 and at most 10, got 0"},
      {2, &guide->distance_m, 10.5, MO_ERR_RANGE,
       "distance_m must be at least 0.1 and at most 10, got 10.5"},
      {3, &guide->distance_m, NAN, MO_ERR_INVALID, "distance_m must be a finite number"},
      {1, &guide->heading_rad, -11, MO_ERR_RANGE,
       "heading_rad must be at least -10 and at most 10, got -11"},
      {2, &guide->turn_rad_per_s, 11, MO_ERR_RANGE,
       "turn_rad_per_s must be at least -10 and at most 10, got 11"},
      {4, &guide->turn_rad_per_s, -11, MO_ERR_RANGE,
       "turn_rad_per_s must be at least -10 and at most 10, got -11"},
      {3, &guide->points_m[1][1], 1000.5, MO_ERR_RANGE,
       "each coordinate in points_m must be at least -1000 and at most 1000, got 1000.5"},
      {3, &guide->points_m[2][0], 1, MO_ERR_INVALID,
       "members that a guide of kind path does not use must be 0"}, /* beyond the last point */
      {4, &guide->velocity_m_per_s[1], -INFINITY, MO_ERR_INVALID,
       "each component of velocity_m_per_s must be a finite number"},
      {4, &guide->center_m[0], -1001, MO_ERR_RANGE, /* it would be checked before its use */
       "each coordinate of center_m must be at least -1000 and at most 1000, got -1001"},
      {0, &guide->distance_m, 1, MO_ERR_INVALID,
       "members that a guide of kind fixed does not use must be 0"},
      {4, &guide->center_m[0], 1, MO_ERR_INVALID, /* it does not turn */
       "members that a guide of kind moving does not use must be 0"},
      {1, &environment.light_xy_m[1], 1, MO_OK, ""}, /* of the environment, below */
  };
  for (size_t i = 0; i < COUNT(bad); i++) {
    struct mo_message message = {""};
    uint32_t where = 99;
    environment.task =
        (struct mo_task){.guide = guides[bad[i].guide], .objective = MO_OBJECTIVE_CLIMB};
    CHECK_INT(mo_environment_check(&environment, &where), MO_OK);
    *bad[i].number = bad[i].value;
    CHECK_INT(mo_task_check(&environment.task, &message), bad[i].code);
    CHECK_TEXT(message.text, bad[i].message);
    const bool is_bad = bad[i].code != MO_OK || environment.light_xy_m[1] != 0;
    CHECK((mo_environment_check(&environment, &where) != MO_OK) == is_bad);
    CHECK_INT(where, is_bad ? MO_ENVIRONMENT_TASK : 99);
    environment.light_xy_m[1] = 0;
  }
  for (uint32_t n = 0; n <= MO_GUIDE_POINTS_MAX + 1; n += MO_GUIDE_POINTS_MAX + 1) {
    environment.task = (struct mo_task){.guide = guides[3], .objective = MO_OBJECTIVE_FOLLOW};
    guide->n_points = n;
    CHECK_INT(mo_task_check(&environment.task, NULL), MO_ERR_RANGE);
  }
  environment.task =
      (struct mo_task){.guide = {.kind = (enum mo_guide_kind)5}, .objective = MO_OBJECTIVE_CLIMB};
  CHECK_INT(mo_task_check(&environment.task, NULL), MO_ERR_INVALID);
  environment.task = (struct mo_task){.objective = (enum mo_objective)8};
  CHECK_INT(mo_task_check(&environment.task, NULL), MO_ERR_INVALID);
}

/* Terms: known, ascending, each with a weight, each with a guide that it fits. */
static void sums(void)
{
  const struct mo_task good = {.guide = guides[1],
                               .objective = MO_OBJECTIVE_SUM,
                               .n_terms = 2,
                               .terms = {MO_OBJECTIVE_TRAVEL, MO_TERM_MEASURE + MO_MEASURE_WORK},
                               .weights = {1, -0.001}};
  struct mo_task bad;
  struct mo_message message;
  CHECK_INT(mo_task_check(&good, NULL), MO_OK);
  CHECK(mo_task_needs_work(&good) && mo_task_measures(&good) == 0);
  bad = good;
  bad.terms[0] = MO_OBJECTIVE_FOLLOW;
  CHECK_INT(mo_task_check(&bad, &message), MO_ERR_INVALID);
  CHECK_TEXT(message.text, "objective follow needs a guide that is path, got ahead");
  const struct {
    uint32_t n, first, second;
    double weight;
    int code;
  } tries[] = {{0, 2, 272, 1, MO_ERR_RANGE},     {9, 2, 272, 1, MO_ERR_RANGE},
               {2, 272, 2, 1, MO_ERR_INVALID},   {2, 2, 2, 1, MO_ERR_INVALID},
               {2, 2, 8, 1, MO_ERR_INVALID},     {2, 2, 255, 1, MO_ERR_INVALID},
               {2, 2, 276, 1, MO_ERR_INVALID},   {2, 2, 272, 0, MO_ERR_INVALID},
               {2, 2, 272, NAN, MO_ERR_INVALID}, {2, 2, 272, 2e6, MO_ERR_RANGE},
               {1, 2, 272, 1, MO_ERR_INVALID},   {2, 2, 260, 1, MO_ERR_INVALID},
               {2, 2, 273, 1, MO_ERR_INVALID},   {2, 2, 261, 1, MO_ERR_INVALID}};
  for (size_t i = 0; i < COUNT(tries); i++) {
    bad = good;
    bad.n_terms = tries[i].n;
    bad.terms[0] = tries[i].first;
    bad.terms[1] = tries[i].second;
    bad.weights[1] = tries[i].weight;
    CHECK_INT(mo_task_check(&bad, NULL), tries[i].code);
  }
  bad = good;
  bad.objective = MO_OBJECTIVE_TRAVEL;
  CHECK_INT(mo_task_check(&bad, NULL), MO_ERR_RANGE);
}

static const struct check_case cases[] = {
    {"objectives fit guides", pairs},
    {"numbers are within their bounds", bounds},
    {"sums: terms and weights", sums},
};
CHECK_MAIN(cases)
