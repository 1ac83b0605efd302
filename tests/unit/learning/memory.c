/* memory.c: every allocation of this room fails once; each time the function says so, leaves its
 * outputs alone, leaks nothing (the address sanitizer looks), and what was begun goes on when there
 * is memory again. */
#include "fixture.h"

#include "../failing.h"

/* Runs `work` with the first, the second, … allocation failing, until none is left to fail. */
static void each_fails(int (*work)(void))
{
  int failed = 0;
  for (long k = 0; k < 5000; k++) {
    left = k;
    const int r = work();
    const int reached = left < 0;
    left = -1;
    if (!reached) {
      CHECK_INT(r, MO_OK);
      printf("# %d allocations failed in turn\n", failed);
      CHECK(failed > 0);
      return;
    }
    failed++;
    CHECK_INT(r, MO_ERR_NO_MEMORY);
  }
  CHECK(0); /* it never ends */
}

static struct mo_controller *parent;
static uint64_t designs[2 * MO_DEFAULT_WORDS];
static struct mo_training *shared;
static uint8_t *checkpoint;
static size_t checkpoint_size;

static int create(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_training *training = NULL;
  const int r = mo_training_create(&settings, parent, designs, 2, &training, NULL);
  CHECK((training != NULL) == (r == MO_OK));
  mo_training_free(training);
  return r;
}

static int decode(void)
{
  struct mo_training *training = NULL;
  const int r = mo_training_decode(checkpoint, checkpoint_size, &training, NULL);
  CHECK((training != NULL) == (r == MO_OK));
  mo_training_free(training);
  return r;
}

static int encode(void)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  const int r = mo_training_encode(shared, &bytes, &size);
  CHECK((bytes != NULL) == (r == MO_OK));
  free(bytes);
  return r;
}

static int export(void)
{
  struct mo_controller *controller = NULL;
  const int r = mo_training_export(shared, "00", "1", NULL, &controller);
  CHECK((controller != NULL) == (r == MO_OK));
  mo_controller_free(controller);
  return r;
}

static int set_designs(void)
{
  uint64_t other[MO_DEFAULT_WORDS];
  memcpy(other, designs, sizeof(other));
  const int r = mo_training_set_designs(shared, other, 1, NULL);
  return r;
}

static int hold_out(void)
{
  uint64_t some[2 * MO_DEFAULT_WORDS];
  return mo_held_out_designs(1, 2, some);
}

static void functions(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  REQUIRE(mo_held_out_designs(3, 2, designs) == MO_OK);
  REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &parent) == MO_OK);
  REQUIRE(mo_training_create(&settings, parent, designs, 2, &shared, NULL) == MO_OK);
  REQUIRE(mo_training_encode(shared, &checkpoint, &checkpoint_size) == MO_OK);
  each_fails(create);
  each_fails(encode);
  each_fails(decode);
  each_fails(export);
  each_fails(set_designs);
  each_fails(hold_out);
  free(checkpoint);
  mo_training_free(shared);
  mo_controller_free(parent);
}

/* A draw that runs out of memory goes on at the next call, with the same robots. */
static void draws(void)
{
  for (int kind = 0; kind < 2; kind++) {
    struct mo_training_settings settings = small_settings((enum mo_training_kind)kind);
    const struct mo_robot *robots, *expected;
    struct mo_training *training = NULL, *other = NULL;
    if (kind == MO_TRAINING_FINETUNE) {
      training = finetuning(&settings, 3, 1.0F);
      other = finetuning(&settings, 3, 1.0F);
    } else {
      mo_training_create(&settings, NULL, NULL, 0, &training, NULL);
      mo_training_create(&settings, NULL, NULL, 0, &other, NULL);
    }
    REQUIRE(training != NULL && other != NULL);
    REQUIRE(mo_training_draw(other, NULL, NULL, &expected) == MO_OK);
    int r = MO_ERR_NO_MEMORY, failed = 0;
    for (long k = 0; k < 1000 && r == MO_ERR_NO_MEMORY; k++) {
      left = k; /* each call gets one allocation further than the last */
      r = mo_training_draw(training, NULL, NULL, &robots);
      left = -1;
      failed += r == MO_ERR_NO_MEMORY;
    }
    REQUIRE(r == MO_OK);
    printf("# %d draws failed\n", failed);
    CHECK(failed > 3);
    for (uint32_t i = 0; i < settings.batch; i++) {
      CHECK(robots[i].body->n_springs == expected[i].body->n_springs);
      CHECK(robots[i].environment->light_xy_m[0] == expected[i].environment->light_xy_m[0]);
    }
    mo_training_free(training);
    mo_training_free(other);
  }
}

static const struct check_case cases[] = {
    {"functions without memory", functions},
    {"draws without memory go on later", draws},
};
CHECK_MAIN(cases)
