/* designs.c: a finetuning whose designs change between its steps, and one that goes on for longer,
 * as campaigns need them. */
#include "fixture.h"

#define W    MO_DEFAULT_WORDS
#define MANY 7

static uint64_t first[3 * W], second[MANY * W];

static struct mo_training *begin(uint32_t n_steps, enum mo_schedule_kind kind)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_controller *parent = NULL;
  struct mo_training *training = NULL;
  settings.n_steps = n_steps;
  settings.learning.schedule =
      kind == MO_SCHEDULE_COSINE ? mo_schedule_finetune() : mo_schedule_paper_simultaneous();
  if (mo_held_out_designs(3, 3, first) == MO_OK && mo_held_out_designs(4, MANY, second) == MO_OK &&
      mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &parent) == MO_OK) {
    mo_controller_randomize(parent, 7);
    mo_training_create(&settings, parent, first, 3, &training, NULL);
  }
  mo_controller_free(parent);
  return training;
}

static bool is_body_of(const struct mo_robot *robot, const uint64_t *design)
{
  struct mo_lattice *lattice = NULL;
  struct mo_body *body = NULL;
  bool same = false;
  if (mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) == MO_OK &&
      mo_body_create(lattice, design, &body) == MO_OK)
    same = body->n_springs == robot->body->n_springs &&
           memcmp(body->spring_lattice, robot->body->spring_lattice,
                  body->n_springs * sizeof(uint32_t)) == 0;
  mo_body_free(body);
  mo_lattice_free(lattice);
  return same;
}

static int same_state(const struct mo_training *a, const struct mo_training *b)
{
  uint8_t *one = NULL, *other = NULL;
  size_t n_one = 0, n_other = 1;
  const int same = mo_training_encode(a, &one, &n_one) == MO_OK &&
                   mo_training_encode(b, &other, &n_other) == MO_OK && n_one == n_other &&
                   memcmp(one, other, n_one) == 0;
  free(one);
  free(other);
  return same;
}

/* The robots of step t are of designs t·batch, t·batch + 1, … of those that are set. */
static void takes_them_in_turn(void)
{
  struct mo_training *training = begin(9, MO_SCHEDULE_RESTARTS);
  struct made_up made_up;
  const struct mo_robot *robots = NULL;
  REQUIRE(training != NULL && made_up_create(&made_up, training) == 0);
  for (uint32_t step = 0; step < 9; step++) {
    const bool late = step >= 4;
    if (step == 4) { /* also where a step has been drawn */
      REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
      CHECK(is_body_of(&robots[0], first + (size_t)W * (4 * 5 % 3)));
      CHECK_INT(mo_training_set_designs(training, second, MANY, NULL), MO_OK);
      CHECK_INT(
          mo_training_apply(training, made_up.gradient, made_up.outcomes, &made_up.counts, NULL),
          MO_ERR_CONFLICT); /* it is forgotten */
    }
    REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
    for (uint32_t i = 0; i < 5; i++) {
      struct mo_environment environment;
      CHECK(is_body_of(&robots[i], late ? second + (size_t)W * ((step * 5 + i) % MANY)
                                        : first + (size_t)W * ((step * 5 + i) % 3)));
      mo_environment_training(mo_training_settings_of(training)->seed, step, i, &environment);
      CHECK(memcmp(robots[i].environment, &environment, sizeof(environment)) == 0);
    }
    REQUIRE(advance(training, &made_up, NULL) == MO_OK);
  }
  made_up_free(&made_up);
  mo_training_free(training);
}

/* They are part of the checkpoint, and weights and moments go on: saved and restored, or not, the
 * end is the same. */
static void goes_on(void)
{
  struct mo_training *whole = begin(9, MO_SCHEDULE_RESTARTS),
                     *other = begin(9, MO_SCHEDULE_RESTARTS);
  struct mo_training *unchanged = begin(9, MO_SCHEDULE_RESTARTS), *restored = NULL;
  struct made_up made_up;
  uint8_t *bytes = NULL;
  size_t size = 0;
  REQUIRE(whole != NULL && other != NULL && unchanged != NULL &&
          made_up_create(&made_up, whole) == 0);
  for (int step = 0; step < 3; step++)
    REQUIRE(advance(whole, &made_up, NULL) == MO_OK && advance(other, &made_up, NULL) == MO_OK &&
            advance(unchanged, &made_up, NULL) == MO_OK);
  CHECK(same_state(whole, unchanged));
  CHECK_INT(mo_training_set_designs(whole, second, MANY, NULL), MO_OK);
  CHECK_INT(mo_training_set_designs(other, second, MANY, NULL), MO_OK);
  CHECK(!same_state(whole, unchanged));
  CHECK(memcmp(mo_training_controller(whole)->parameters,
               mo_training_controller(unchanged)->parameters, made_up.n * sizeof(float)) == 0);
  REQUIRE(mo_training_encode(other, &bytes, &size) == MO_OK);
  REQUIRE(mo_training_decode(bytes, size, &restored, NULL) == MO_OK);
  for (int step = 3; step < 9; step++)
    REQUIRE(advance(whole, &made_up, NULL) == MO_OK && advance(restored, &made_up, NULL) == MO_OK &&
            advance(unchanged, &made_up, NULL) == MO_OK);
  CHECK(same_state(whole, restored));
  CHECK(memcmp(mo_training_controller(whole)->parameters,
               mo_training_controller(unchanged)->parameters, made_up.n * sizeof(float)) != 0);
  free(bytes);
  made_up_free(&made_up);
  mo_training_free(whole);
  mo_training_free(other);
  mo_training_free(unchanged);
  mo_training_free(restored);
}

static void refused(void)
{
  struct mo_training *training = begin(9, MO_SCHEDULE_RESTARTS),
                     *same = begin(9, MO_SCHEDULE_RESTARTS);
  const struct mo_training_settings settings = small_settings(MO_TRAINING_PRETRAIN);
  struct mo_training *pretraining = NULL;
  struct mo_message message = {""};
  uint64_t bad[2 * W];
  REQUIRE(training != NULL && same != NULL);
  REQUIRE(mo_training_create(&settings, NULL, NULL, 0, &pretraining, NULL) == MO_OK);
  CHECK_INT(mo_training_set_designs(pretraining, second, 1, &message), MO_ERR_CONFLICT);
  CHECK(strstr(message.text, "pretraining") != NULL);
  CHECK_INT(mo_training_set_designs(training, second, 0, &message), MO_ERR_INVALID);
  CHECK_INT(mo_training_set_designs(training, NULL, 3, &message), MO_ERR_INVALID);
  CHECK_INT(mo_training_set_designs(training, second, 10001, &message), MO_ERR_RANGE);
  CHECK(strstr(message.text, "10001 designs") != NULL);
  memcpy(bad, second, sizeof(bad));
  bad[W + 2] |= UINT64_C(1) << 40;
  CHECK_INT(mo_training_set_designs(training, bad, 2, &message), MO_ERR_INVALID);
  CHECK(strstr(message.text, "design 1") != NULL);
  memset(bad, 0, sizeof(bad));
  CHECK_INT(mo_training_set_designs(training, bad, 1, NULL), MO_ERR_INVALID);
  CHECK(same_state(training, same));
  mo_training_free(training);
  mo_training_free(same);
  mo_training_free(pretraining);
}

/* A training of 4 steps that is made one of 9 ends where one of 9 does. */
static void longer(void)
{
  struct mo_training *training = begin(4, MO_SCHEDULE_RESTARTS),
                     *whole = begin(9, MO_SCHEDULE_RESTARTS);
  struct made_up made_up;
  const struct mo_robot *robots = NULL;
  REQUIRE(training != NULL && whole != NULL && made_up_create(&made_up, whole) == 0);
  for (int step = 0; step < 4; step++)
    REQUIRE(advance(training, &made_up, NULL) == MO_OK);
  CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_ERR_CONFLICT);
  CHECK_INT(mo_training_set_steps(training, 3), MO_ERR_RANGE); /* fewer than it has done */
  CHECK_INT(mo_training_set_steps(training, MO_TRAINING_STEPS_MAX + 1), MO_ERR_RANGE);
  CHECK_INT(mo_training_set_steps(training, 9), MO_OK);
  for (int step = 4; step < 9; step++)
    REQUIRE(advance(training, &made_up, NULL) == MO_OK);
  for (int step = 0; step < 9; step++)
    REQUIRE(advance(whole, &made_up, NULL) == MO_OK);
  CHECK(same_state(training, whole));
  made_up_free(&made_up);
  mo_training_free(training);
  mo_training_free(whole);
}

static void shorter_and_never(void)
{
  struct mo_training *training = begin(9, MO_SCHEDULE_RESTARTS),
                     *cosine = begin(9, MO_SCHEDULE_COSINE);
  struct mo_training_settings settings = small_settings(MO_TRAINING_PRETRAIN);
  struct mo_training *pretraining = NULL;
  struct made_up made_up;
  REQUIRE(training != NULL && cosine != NULL && made_up_create(&made_up, training) == 0);
  REQUIRE(advance(training, &made_up, NULL) == MO_OK && advance(training, &made_up, NULL) == MO_OK);
  CHECK_INT(mo_training_set_steps(training, 2), MO_OK); /* it ends here */
  CHECK_INT(advance(training, &made_up, NULL), MO_ERR_CONFLICT);
  CHECK_INT(mo_training_set_steps(cosine, 10), MO_ERR_UNSUPPORTED);
  CHECK_INT(mo_training_set_steps(cosine, 9), MO_OK);
  CHECK_INT(mo_training_set_steps(cosine, 0), MO_ERR_RANGE);
  CHECK_INT(mo_training_settings_of(cosine)->n_steps, 9);
  settings.learning.schedule = mo_schedule_paper_pretrain();
  settings.batch = MO_TRAINING_BATCH_MAX;
  REQUIRE(mo_training_create(&settings, NULL, NULL, 0, &pretraining, NULL) == MO_OK);
  CHECK_INT(mo_training_set_steps(pretraining, 4096), MO_OK);
  CHECK_INT(mo_training_set_steps(pretraining, 4097), MO_ERR_RANGE); /* bodies */
  made_up_free(&made_up);
  mo_training_free(training);
  mo_training_free(cosine);
  mo_training_free(pretraining);
}

static const struct check_case cases[] = {
    {"new designs are taken in turn from the current step on", takes_them_in_turn},
    {"new designs, the same weights and moments, saved or not", goes_on},
    {"designs that are refused change nothing", refused},
    {"a training made longer", longer},
    {"a training made shorter, and those that cannot be changed", shorter_and_never},
};
CHECK_MAIN(cases)
