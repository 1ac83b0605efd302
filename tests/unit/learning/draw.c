/* draw.c: the robots of a step: distinct, never held out, the same whenever they are drawn; and
 * what stops a draw. */
#include "fixture.h"

#include "learning/internal.h"

/* The linker redirects the room's calls to this function, so that a morphospace can run out of
 * bodies. */
int __real_mo_body_stream_next(struct mo_body_stream *stream, uint64_t *bits, uint64_t *form);
int __wrap_mo_body_stream_next(struct mo_body_stream *stream, uint64_t *bits, uint64_t *form);
static long left = -1; /* remaining bodies; negative = unlimited */

int __wrap_mo_body_stream_next(struct mo_body_stream *stream, uint64_t *bits, uint64_t *form)
{
  if (left == 0)
    return MO_ERR_EXHAUSTED;
  left -= left > 0;
  return __real_mo_body_stream_next(stream, bits, form);
}

/* Returns the bodies of the current step, as the stream returned them. */
static const uint64_t *drawn(const struct mo_training *training)
{
  return training->hands[training->step % 2].drawn;
}

static struct mo_training *pretraining(uint64_t seed, uint32_t batch, uint32_t n_steps)
{
  struct mo_training_settings settings = mo_training_defaults(MO_TRAINING_PRETRAIN);
  settings.seed = seed;
  settings.batch = batch;
  settings.n_steps = n_steps;
  return make_training(&settings, NULL, NULL, 0);
}

/* Checks draws that must fail, at once or when no more bodies are left. */
static void expect_failure(struct mo_training *training, long bodies, int code)
{
  const struct mo_robot *robots = NULL;
  left = bodies;
  CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), code);
  CHECK(robots == NULL);
  left = -1;
}

/* 20,000 bodies over several steps: all forms differ, none is held out, and environments are as
 * documented. */
__attribute__((unused)) static void distinct(void)
{
  struct mo_training *training = pretraining(3, 2500, 8);
  struct made_up *made_up = make_made_up(training);
  struct mo_form_set *seen = make_form_set(MO_DEFAULT_WORKSPACE);
  uint32_t held_out = 0, again = 0, other = 0;
  for (uint32_t step = 0; step < 8; step++) {
    const struct mo_robot *robots = draw(training);
    REQUIRE(draw(training) == robots);
    for (uint32_t i = 0; i < 2500; i++) {
      struct mo_environment environment;
      uint64_t form[MO_DEFAULT_WORDS];
      const uint64_t *design = drawn(training) + (size_t)MO_DEFAULT_WORDS * i;
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, design, form);
      other += !is_body_of(robots[i].body, training->lattice, design);
      held_out += mo_held_out_form(form);
      again += mo_form_set_add(seen, form) != 1;
      mo_environment_training(3, step, i, &environment);
      other += !SAME(&environment, robots[i].environment, 1);
    }
    REQUIRE(apply(training, made_up, NULL) == MO_OK);
  }
  CHECK_INT(held_out, 0);
  CHECK_INT(again, 0);
  CHECK_INT(other, 0);
  CHECK_INT(mo_form_set_count(seen), 20000);
}

static void held_out_designs(void)
{
  enum { N = 400 };
  static uint64_t designs[N * MO_DEFAULT_WORDS], few[10 * MO_DEFAULT_WORDS],
      others[N * MO_DEFAULT_WORDS];
  struct mo_form_set *seen = make_form_set(MO_DEFAULT_WORKSPACE);
  REQUIRE(mo_held_out_designs(1, N, designs) == MO_OK && mo_held_out_designs(1, 10, few) == MO_OK);
  REQUIRE(mo_held_out_designs(2, N, others) == MO_OK);
  CHECK(memcmp(designs, few, sizeof(few)) == 0);
  CHECK(memcmp(designs, others, sizeof(others)) != 0);
  int forms = 0;
  for (uint32_t i = 0; i < N; i++) {
    uint64_t form[MO_DEFAULT_WORDS];
    CHECK_INT(mo_training_design_is_placed(designs + (size_t)MO_DEFAULT_WORDS * i), 1);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, designs + (size_t)MO_DEFAULT_WORDS * i, form);
    forms += mo_held_out_form(form) && mo_form_set_add(seen, form) == 1;
  }
  CHECK_INT(forms, N);
  CHECK_INT(mo_held_out_designs(1, MO_TRAINING_DESIGNS_MAX + 1, designs), MO_ERR_RANGE);
  CHECK_INT(mo_held_out_designs(1, 0, NULL), MO_OK);
}

/* One form in 16 is held out, always the same ones: comparisons depend on this choice. */
static void held_out_share(void)
{
  uint32_t held_out = 0;
  uint64_t marks = 0;
  for (uint32_t i = 0; i < 32000; i++) {
    uint64_t form[MO_DEFAULT_WORDS];
    struct mo_random random = dice(1, 0, i);
    form[0] = mo_random_u64(&random);
    form[1] = mo_random_u64(&random);
    form[2] = mo_random_u64(&random) >> 48;
    held_out += mo_held_out_form(form);
    if (i < 640 && mo_held_out_form(form))
      marks ^= UINT64_C(1) << i % 64;
  }
  printf("# %u of 32000; marks %016llx\n", held_out, (unsigned long long)marks);
  CHECK(held_out > 1850 && held_out < 2150);
  CHECK(marks == UINT64_C(0x50ecb49552124e20));
}

static void held_out_environments(void)
{
  struct mo_environment held_out[64], training;
  mo_held_out_environments(1, 64, held_out);
  int known = 0, odd = 0;
  for (uint32_t i = 0; i < 64; i++) {
    const double x = held_out[i].light_xy_m[0] - MO_WORLD_CENTER_M,
                 y = held_out[i].light_xy_m[1] - MO_WORLD_CENTER_M;
    odd += !(hypot(x, y) >= 0.4 && hypot(x, y) <= 2.0) ||
           mo_environment_check(&held_out[i], NULL) != MO_OK;
    for (uint32_t k = 0; k < 64; k++) {
      mo_environment_training(1, 0, k, &training);
      known += training.light_xy_m[0] == held_out[i].light_xy_m[0] ||
               training.terrain_heights_m[20] == held_out[i].terrain_heights_m[20];
      known += k != i && memcmp(&held_out[i], &held_out[k], sizeof(training)) == 0;
    }
  }
  CHECK_INT(known, 0);
  CHECK_INT(odd, 0);
}

/* The designs take turns, continuing from one step to the next. */
static void finetuning_turns(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_training *training = finetuning(&settings, 3, 1.0F);
  struct made_up *made_up = make_made_up(training);
  for (uint32_t step = 0; step < 4; step++) {
    const struct mo_robot *robots = draw(training);
    for (uint32_t i = 0; i < 5; i++) {
      struct mo_environment environment;
      CHECK(is_body_of(robots[i].body, training->lattice,
                       training->designs + (size_t)MO_DEFAULT_WORDS * ((5 * step + i) % 3)));
      mo_environment_training(1, step, i, &environment);
      CHECK(SAME(&environment, robots[i].environment, 1));
    }
    REQUIRE(apply(training, made_up, NULL) == MO_OK);
  }
}

static int differences(const struct mo_training *a, const struct mo_robot *x,
                       const struct mo_robot *y, uint32_t n)
{
  int different = 0;
  for (uint32_t i = 0; i < n; i++)
    different +=
        !is_body_of(x[i].body, a->lattice, drawn(a) + (size_t)MO_DEFAULT_WORDS * i) ||
        x[i].body->n_springs != y[i].body->n_springs ||
        !SAME(x[i].body->spring_lattice, y[i].body->spring_lattice, y[i].body->n_springs) ||
        !SAME(x[i].environment, y[i].environment, 1);
  return different;
}

/* Without bodies, the draw reports that each time and loses nothing; with new bodies it continues
 * as if nothing had happened. */
static void exhausted(void)
{
  struct mo_training *training = pretraining(4, 300, 3), *other = pretraining(4, 300, 3);
  expect_failure(training, 100, MO_ERR_EXHAUSTED);
  expect_failure(training, 0, MO_ERR_EXHAUSTED);
  CHECK_INT(mo_training_step(training), 0);
  const struct mo_robot *robots = draw(training);
  CHECK_INT(differences(training, robots, draw(other), 300), 0);
}

/* The same if the step's first draws were held out: the step has no body yet, but the stream has
 * advanced. */
__attribute__((unused)) static void exhausted_at_a_held_out_form(void)
{
  struct mo_training *training = pretraining(5, 2, 100), *other = pretraining(5, 2, 100);
  struct made_up *made_up = make_made_up(training);
  uint32_t held_out = 0;
  int different = 0;
  for (uint32_t step = 0; step < 100; step++) {
    expect_failure(training, 1, MO_ERR_EXHAUSTED);
    held_out += training->hands[step % 2].n_drawn == 0;
    expect_failure(training, 0, MO_ERR_EXHAUSTED);
    draw(training);
    draw(other);
    different += !SAME(drawn(training), drawn(other), 2 * MO_DEFAULT_WORDS);
    REQUIRE(apply(training, made_up, NULL) == MO_OK && apply(other, made_up, NULL) == MO_OK);
  }
  printf("# %u of 100 steps began with a form that is held out\n", held_out);
  CHECK(held_out > 0);
  CHECK_INT(different, 0);
}

/* A replay can be cancelled and continued, counts its bodies, and notices a different stream. */
static void replay(void)
{
  struct mo_training *training = pretraining(6, 200, 4);
  struct made_up *made_up = make_made_up(training);
  for (int step = 0; step < 3; step++)
    REQUIRE(advance(training, made_up, NULL) == MO_OK);
  struct mo_training *restored = decoded(encoded(training)), *wrong = decoded(encoded(training));
  const volatile int cancel = 1;
  volatile uint64_t replayed = 0;
  const struct mo_robot *robots;
  CHECK_INT(mo_training_draw(restored, &cancel, &replayed, &robots), MO_ERR_CANCELLED);
  left = 250;
  CHECK_INT(mo_training_draw(restored, NULL, &replayed, &robots), MO_ERR_EXHAUSTED);
  left = -1;
  CHECK(replayed > 100 && replayed <= 250);
  REQUIRE(mo_training_draw(restored, NULL, &replayed, &robots) == MO_OK);
  CHECK_INT(replayed, 600);
  CHECK_INT(differences(restored, robots, draw(training), 200), 0);
  wrong->draws++;
  expect_failure(wrong, -1, MO_ERR_CORRUPT);
  expect_failure(wrong, -1, MO_ERR_CORRUPT);
}

/* Robots drawn ahead on several threads, with stops and checkpoints in between, equal those of a
 * plain draw; the current robots stay. */
static void ahead(void)
{
  enum { N = 700, STEPS = 6 };
  for (uint32_t threads = 1; threads <= 5; threads += 2) {
    struct mo_training *plain = pretraining(8, N, STEPS), *training = pretraining(8, N, STEPS);
    struct made_up *made_up = make_made_up(plain);
    const volatile int cancel = 1;
    int different = 0;
    CHECK_INT(mo_training_draw_ahead(training, NULL), MO_ERR_CONFLICT); /* nothing has been drawn */
    mo_training_set_threads(training, threads);
    for (uint32_t step = 0; step < STEPS; step++) {
      const struct mo_robot *expected = draw(plain), *robots = draw(training);
      if (step % 3 == 1) {
        left = N / 2;
        CHECK_INT(mo_training_draw_ahead(training, NULL), MO_ERR_EXHAUSTED);
        left = -1;
        (void)mo_training_draw_ahead(training, &cancel);
      }
      if (step % 3 != 2)
        CHECK_INT(mo_training_draw_ahead(training, NULL), MO_OK);
      CHECK(draw(training) == robots);
      different += differences(training, robots, expected, N);
      CHECK(same_state(training, plain));
      if (step == 3) {
        training = decoded(encoded(training));
        mo_training_set_threads(training, threads);
        different += differences(training, draw(training), expected, N);
      }
      REQUIRE(apply(plain, made_up, NULL) == MO_OK && apply(training, made_up, NULL) == MO_OK);
    }
    CHECK_INT(different, 0);
    CHECK_INT(mo_training_draw_ahead(training, NULL), MO_ERR_CONFLICT);
    check_drop_to(0);
  }
}

/* If the designs change after a step was drawn ahead, that step uses the new ones. */
static void ahead_of_new_designs(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_training *training = finetuning(&settings, 3, 1.0F);
  struct made_up *made_up = make_made_up(training);
  uint64_t design[MO_DEFAULT_WORDS];
  draw(training);
  REQUIRE(mo_training_draw_ahead(training, NULL) == MO_OK);
  REQUIRE(apply(training, made_up, NULL) == MO_OK);
  memcpy(design, training->designs + (size_t)2 * MO_DEFAULT_WORDS, sizeof(design));
  REQUIRE(mo_training_set_designs(training, design, 1) == MO_OK);
  const struct mo_robot *robots = draw(training);
  for (uint32_t i = 0; i < 5; i++) {
    struct mo_environment environment;
    CHECK(is_body_of(robots[i].body, training->lattice, design));
    mo_environment_training(1, 1, i, &environment);
    CHECK(SAME(&environment, robots[i].environment, 1));
  }
}

static const struct check_case cases[] = {
    {"held-out designs", held_out_designs},
    {"the fraction and the choice of held-out forms", held_out_share},
    {"held-out environments", held_out_environments},
    {"finetuning takes its designs in turn", finetuning_turns},
    {"an exhausted morphospace", exhausted},
    {"a replay", replay},
    {"robots drawn ahead, on several threads", ahead},
    {"designs that change after a step was drawn ahead", ahead_of_new_designs},
#ifndef __SANITIZE_THREAD__ /* slow there, and of one thread */
    {"20000 bodies are distinct and none is held out", distinct},
    {"exhausted at a held-out form", exhausted_at_a_held_out_form},
#endif
};
CHECK_MAIN(cases)
