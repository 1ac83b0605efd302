/* memory.c: every allocation of this room fails once. Each time the function must report the error,
 * leave its outputs unchanged, and leak nothing (checked by the address sanitizer); whatever had
 * begun continues when memory is available again. */
#include "fixture.h"

#include "../failing.h"

static struct mo_controller *parent;
static uint64_t designs[2 * MO_DEFAULT_WORDS];
static struct mo_training *shared;
static struct blob checkpoint;

static int create(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_training *training = NULL;
  const int r = mo_training_create(&settings, parent, designs, 2, &training);
  CHECK((training != NULL) == (r == MO_OK));
  mo_training_free(training);
  return r;
}

static int decode(void)
{
  struct mo_training *training = NULL;
  const int r = mo_training_decode(checkpoint.bytes, checkpoint.size, &training, NULL);
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
  return mo_training_set_designs(shared, other, 1);
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
  parent = make_controller(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT);
  shared = make_training(&settings, parent, designs, 2);
  checkpoint = encoded(shared);
  each_fails(create, 1);
  each_fails(encode, 1);
  each_fails(decode, 1);
  each_fails(export, 1);
  each_fails(set_designs, 1);
  each_fails(hold_out, 1);
}

/* A draw that runs out of memory continues at the next call, with the same robots. */
static void draws(void)
{
  for (int kind = 0; kind < 2; kind++) {
    struct mo_training_settings settings = small_settings((enum mo_training_kind)kind);
    struct mo_training *both[2];
    for (int i = 0; i < 2; i++)
      both[i] = kind == MO_TRAINING_FINETUNE ? finetuning(&settings, 3, 1.0F)
                                             : make_training(&settings, NULL, NULL, 0);
    const struct mo_robot *robots, *expected = draw(both[1]);
    int r = MO_ERR_NO_MEMORY, failed = 0;
    for (long k = 0; k < 1000 && r == MO_ERR_NO_MEMORY; k++) {
      left = k; /* each call gets one allocation further than the previous one */
      r = mo_training_draw(both[0], NULL, NULL, &robots);
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
  }
}

static const struct check_case cases[] = {
    {"functions without memory", functions},
    {"draws without memory continue later", draws},
};
CHECK_MAIN(cases)
