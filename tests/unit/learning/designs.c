/* designs.c: a finetuning run with designs that change between steps, and a training run that
 * becomes longer, as campaigns need them. */
#include "fixture.h"

#include "learning/internal.h"

#define W    MO_DEFAULT_WORDS
#define MANY 7

static uint64_t first[3 * W], second[MANY * W];

static struct mo_training *begin(uint32_t n_steps, struct mo_schedule schedule)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  settings.n_steps = n_steps;
  settings.learning.schedule = schedule;
  make_check(mo_held_out_designs(3, 3, first), "designs");
  make_check(mo_held_out_designs(4, MANY, second), "designs");
  return make_training(&settings, make_random_controller(MO_SENSOR_INVERSE_SQRT, 7), first, 3);
}

/* Performs n steps of each. */
static void advance_all(struct mo_training *const *trainings, int n_trainings,
                        struct made_up *made_up, int n)
{
  for (int step = 0; step < n; step++)
    for (int i = 0; i < n_trainings; i++)
      CHECK_INT(advance(trainings[i], made_up, NULL), MO_OK);
}

/* The robots of step t come from designs t·batch, t·batch + 1, … of the current ones. */
static void takes_them_in_turn(void)
{
  struct mo_training *training = begin(9, mo_schedule_presets[MO_SCHEDULE_PAPER_SIMULTANEOUS]);
  struct made_up *made_up = make_made_up(training);
  const struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  for (uint32_t step = 0; step < 9; step++) {
    const bool late = step >= 4;
    if (step == 4) { /* also after a step has been drawn */
      CHECK(is_body_of(draw(training)[0].body, lattice, first + (size_t)W * (4 * 5 % 3)));
      CHECK_INT(mo_training_set_designs(training, second, MANY), MO_OK);
      CHECK_INT(apply(training, made_up, NULL), MO_ERR_CONFLICT); /* the draw is discarded */
    }
    const struct mo_robot *robots = draw(training);
    for (uint32_t i = 0; i < 5; i++) {
      struct mo_environment environment;
      CHECK(is_body_of(robots[i].body, lattice,
                       late ? second + (size_t)W * ((step * 5 + i) % MANY)
                            : first + (size_t)W * ((step * 5 + i) % 3)));
      mo_environment_training(mo_training_settings_of(training)->seed, step, i, &environment);
      CHECK(SAME(robots[i].environment, &environment, 1));
    }
    REQUIRE(advance(training, made_up, NULL) == MO_OK);
  }
}

/* The designs are part of the checkpoint, and weights and moments continue: saved and restored or
 * not, the result is the same. */
static void goes_on(void)
{
  enum { WHOLE, SAVED, UNCHANGED, N };
  struct mo_training *all[N];
  for (int i = 0; i < N; i++)
    all[i] = begin(9, mo_schedule_presets[MO_SCHEDULE_PAPER_SIMULTANEOUS]);
  struct made_up *made_up = make_made_up(all[WHOLE]);
  advance_all(all, N, made_up, 3);
  CHECK(same_state(all[WHOLE], all[UNCHANGED]));
  CHECK_INT(mo_training_set_designs(all[WHOLE], second, MANY), MO_OK);
  CHECK_INT(mo_training_set_designs(all[SAVED], second, MANY), MO_OK);
  CHECK(!same_state(all[WHOLE], all[UNCHANGED]));
  const float *changed = mo_training_controller(all[WHOLE])->parameters,
              *unchanged = mo_training_controller(all[UNCHANGED])->parameters;
  CHECK(SAME(changed, unchanged, made_up->n));
  all[SAVED] = decoded(encoded(all[SAVED]));
  advance_all(all, N, made_up, 6);
  CHECK(same_state(all[WHOLE], all[SAVED]));
  CHECK(!SAME(changed, unchanged, made_up->n));
}

static void placed(void)
{
  static const uint64_t empty[W], corner[W] = {1};
  static const uint64_t apart[W] = {1, 0, UINT64_C(1) << (MO_DEFAULT_VOXELS - 1) % 64};
  uint64_t beyond[W];
  REQUIRE(mo_held_out_designs(4, MANY, second) == MO_OK);
  memcpy(beyond, second, sizeof(beyond));
  beyond[W - 1] |= UINT64_C(1) << 63;
  CHECK_INT(mo_training_design_is_placed(second), 1);
  CHECK_INT(mo_training_design_is_placed(empty), 0);
  CHECK_INT(mo_training_design_is_placed(corner), 0);
  CHECK_INT(mo_training_design_is_placed(apart), 0);
  CHECK_INT(mo_training_design_is_placed(beyond), 0);
}

/* A training run of 4 steps that is extended to 9 ends like one of 9 steps. */
static void longer(void)
{
  struct mo_training *training = begin(4, mo_schedule_presets[MO_SCHEDULE_PAPER_SIMULTANEOUS]),
                     *whole = begin(9, mo_schedule_presets[MO_SCHEDULE_PAPER_SIMULTANEOUS]);
  struct made_up *made_up = make_made_up(whole);
  const struct mo_robot *robots = NULL;
  advance_all(&training, 1, made_up, 4);
  CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_ERR_CONFLICT);
  CHECK_INT(mo_training_set_steps(training, 3), MO_ERR_RANGE); /* fewer than it has completed */
  CHECK_INT(mo_training_set_steps(training, MO_TRAINING_STEPS_MAX + 1), MO_ERR_RANGE);
  CHECK_INT(mo_training_set_steps(training, 9), MO_OK);
  advance_all(&training, 1, made_up, 5);
  advance_all(&whole, 1, made_up, 9);
  CHECK(same_state(training, whole));
}

static void shorter_and_never(void)
{
  struct mo_training *training = begin(9, mo_schedule_presets[MO_SCHEDULE_PAPER_SIMULTANEOUS]),
                     *cosine = begin(9, mo_schedule_presets[MO_SCHEDULE_FINETUNE_COSINE]);
  struct mo_training_settings settings = small_settings(MO_TRAINING_PRETRAIN);
  struct made_up *made_up = make_made_up(training);
  advance_all(&training, 1, made_up, 2);
  CHECK_INT(mo_training_set_steps(training, 2), MO_OK); /* it is finished here */
  CHECK_INT(advance(training, made_up, NULL), MO_ERR_CONFLICT);
  CHECK_INT(mo_training_set_steps(cosine, 10), MO_ERR_UNSUPPORTED);
  CHECK_INT(mo_training_set_steps(cosine, 9), MO_OK);
  CHECK_INT(mo_training_set_steps(cosine, 0), MO_ERR_RANGE);
  CHECK_INT(mo_training_settings_of(cosine)->n_steps, 9);
  settings.learning.schedule = mo_schedule_presets[MO_SCHEDULE_PAPER_PRETRAIN];
  settings.batch = MO_TRAINING_BATCH_MAX;
  struct mo_training *pretraining = make_training(&settings, NULL, NULL, 0);
  CHECK_INT(mo_training_set_steps(pretraining, 4096), MO_OK);
  CHECK_INT(mo_training_set_steps(pretraining, 4097), MO_ERR_RANGE); /* bodies */
}

/* Weights for another workspace would not fit. */
static void another_workspace(void)
{
  const struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_training *training = NULL;
  const struct mo_controller *tiny =
      make_controller((struct mo_workspace){1, 2, 3}, MO_SENSOR_INVERSE_SQRT);
  make_check(mo_held_out_designs(3, 3, first), "designs");
  CHECK_INT(mo_training_create(&settings, tiny, first, 3, &training), MO_ERR_UNSUPPORTED);
}

static const struct check_case cases[] = {
    {"new designs are taken in turn from the current step on", takes_them_in_turn},
    {"new designs, the same weights and moments, saved or not", goes_on},
    {"designs are placed", placed},
    {"a training that becomes longer", longer},
    {"a training that becomes shorter, and those that cannot change", shorter_and_never},
    {"a parent for another workspace", another_workspace},
};
CHECK_MAIN(cases)
