/* draw.c: which robots a step gets: distinct, never held out, the same whenever they are drawn; and
 * what stops a draw. */
#include "fixture.h"

#include "learning/internal.h"

/* The linker sends the room's calls here, so that a morphospace can run dry. */
int __real_mo_body_stream_next_form(struct mo_body_stream *stream, uint64_t *bits, uint64_t *form);
int __wrap_mo_body_stream_next_form(struct mo_body_stream *stream, uint64_t *bits, uint64_t *form);
static long left = -1; /* bodies until there are no more; negative: no end */

int __wrap_mo_body_stream_next_form(struct mo_body_stream *stream, uint64_t *bits, uint64_t *form)
{
  if (left == 0)
    return MO_ERR_EXHAUSTED;
  left -= left > 0;
  return __real_mo_body_stream_next_form(stream, bits, form);
}

static bool is_body_of(const struct mo_body *body, const struct mo_lattice *lattice,
                       const uint64_t *design)
{
  struct mo_body *made = NULL;
  if (mo_body_create(lattice, design, &made) != MO_OK)
    return false;
  const bool same =
      body->n_springs == made->n_springs && body->n_masses == made->n_masses &&
      memcmp(body->spring_lattice, made->spring_lattice, made->n_springs * sizeof(uint32_t)) == 0;
  mo_body_free(made);
  return same;
}

/* The bodies of the current step, as they came out of the stream. */
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
  struct mo_training *training = NULL;
  return mo_training_create(&settings, NULL, NULL, 0, &training, NULL) == MO_OK ? training : NULL;
}

/* 20,000 bodies over several steps: all forms differ, none is held out; environments are those
 * promised. */
static void distinct(void)
{
  struct mo_training *training = pretraining(3, 2500, 8);
  struct mo_form_set *seen = NULL;
  struct made_up made_up;
  REQUIRE(training != NULL && made_up_create(&made_up, training) == 0);
  REQUIRE(mo_form_set_create(MO_DEFAULT_WORKSPACE, &seen) == MO_OK);
  uint32_t held_out = 0, again = 0, other = 0;
  for (uint32_t step = 0; step < 8; step++) {
    const struct mo_robot *robots, *same;
    REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
    REQUIRE(mo_training_draw(training, NULL, NULL, &same) == MO_OK && same == robots);
    for (uint32_t i = 0; i < 2500; i++) {
      struct mo_environment environment;
      uint64_t form[MO_DEFAULT_WORDS];
      const uint64_t *design = drawn(training) + (size_t)MO_DEFAULT_WORDS * i;
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, design, form);
      other += !is_body_of(robots[i].body, training->lattice, design);
      held_out += mo_held_out_form(form);
      again += mo_form_set_add(seen, form) != 1;
      mo_environment_training(3, step, i, &environment);
      other += memcmp(&environment, robots[i].environment, sizeof(environment)) != 0;
    }
    REQUIRE(mo_training_apply(training, made_up.gradient, made_up.outcomes, &made_up.counts,
                              NULL) == MO_OK);
  }
  CHECK_INT(held_out, 0);
  CHECK_INT(again, 0);
  CHECK_INT(other, 0);
  CHECK_INT(mo_form_set_count(seen), 20000);
  mo_form_set_free(seen);
  made_up_free(&made_up);
  mo_training_free(training);
}

static void held_out_designs(void)
{
  enum { N = 400 };
  static uint64_t designs[N * MO_DEFAULT_WORDS], few[10 * MO_DEFAULT_WORDS],
      others[N * MO_DEFAULT_WORDS];
  struct mo_form_set *seen = NULL;
  REQUIRE(mo_form_set_create(MO_DEFAULT_WORKSPACE, &seen) == MO_OK);
  REQUIRE(mo_held_out_designs(1, N, designs) == MO_OK && mo_held_out_designs(1, 10, few) == MO_OK);
  REQUIRE(mo_held_out_designs(2, N, others) == MO_OK);
  CHECK(memcmp(designs, few, sizeof(few)) == 0);
  CHECK(memcmp(designs, others, sizeof(others)) != 0);
  CHECK_INT(mo_training_check_designs(designs, N, NULL), MO_OK);
  int forms = 0;
  for (uint32_t i = 0; i < N; i++) {
    uint64_t form[MO_DEFAULT_WORDS];
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, designs + (size_t)MO_DEFAULT_WORDS * i, form);
    forms += mo_held_out_form(form) && mo_form_set_add(seen, form) == 1;
  }
  CHECK_INT(forms, N);
  CHECK_INT(mo_held_out_designs(1, MO_TRAINING_DESIGNS_MAX + 1, designs), MO_ERR_RANGE);
  CHECK_INT(mo_held_out_designs(1, 0, NULL), MO_OK);
  mo_form_set_free(seen);
}

/* One form in 16 is held out, and it is always the same ones: the choice is part of what a
 * comparison means. */
static void held_out_share(void)
{
  uint32_t held_out = 0;
  uint64_t marks = 0;
  for (uint32_t i = 0; i < 32000; i++) {
    struct mo_random random;
    uint64_t form[MO_DEFAULT_WORDS];
    mo_random_init(&random, 1, MO_PURPOSE_CHECK, 0, i);
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
    const double x = held_out[i].light_xy_m[0] - MO_WORLD_CENTRE_M,
                 y = held_out[i].light_xy_m[1] - MO_WORLD_CENTRE_M;
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

/* The designs take turns, on from one step to the next. */
static void finetuning_turns(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_training *training = finetuning(&settings, 3, 1.0F);
  struct made_up made_up;
  REQUIRE(training != NULL && made_up_create(&made_up, training) == 0);
  for (uint32_t step = 0; step < 4; step++) {
    const struct mo_robot *robots;
    REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
    for (uint32_t i = 0; i < 5; i++) {
      struct mo_environment environment;
      CHECK(is_body_of(robots[i].body, training->lattice,
                       training->designs + (size_t)MO_DEFAULT_WORDS * ((5 * step + i) % 3)));
      mo_environment_training(1, step, i, &environment);
      CHECK(memcmp(&environment, robots[i].environment, sizeof(environment)) == 0);
    }
    REQUIRE(mo_training_apply(training, made_up.gradient, made_up.outcomes, &made_up.counts,
                              NULL) == MO_OK);
  }
  made_up_free(&made_up);
  mo_training_free(training);
}

/* No bodies left: the draw says so, again and again, nothing is lost, and with new bodies it goes
 * on as if nothing had been. */
static void exhausted(void)
{
  struct mo_training *training = pretraining(4, 300, 3), *other = pretraining(4, 300, 3);
  const struct mo_robot *robots = NULL, *expected;
  REQUIRE(training != NULL && other != NULL);
  left = 100;
  CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_ERR_EXHAUSTED);
  CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_ERR_EXHAUSTED);
  CHECK(robots == NULL);
  CHECK_INT(mo_training_step(training), 0);
  left = -1;
  REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
  REQUIRE(mo_training_draw(other, NULL, NULL, &expected) == MO_OK);
  int different = 0;
  for (uint32_t i = 0; i < 300; i++)
    different +=
        !is_body_of(robots[i].body, other->lattice, drawn(other) + (size_t)MO_DEFAULT_WORDS * i);
  CHECK_INT(different, 0);
  mo_training_free(training);
  mo_training_free(other);
}

/* The same where the step's first draws were held out: no body of it is there yet, but the stream
 * has moved on. */
static void exhausted_at_a_held_out_form(void)
{
  struct mo_training *training = pretraining(5, 2, 100), *other = pretraining(5, 2, 100);
  struct made_up made_up;
  uint32_t held_out = 0;
  int different = 0;
  REQUIRE(training != NULL && other != NULL && made_up_create(&made_up, training) == 0);
  for (uint32_t step = 0; step < 100; step++) {
    const struct mo_robot *robots;
    left = 1;
    CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_ERR_EXHAUSTED);
    held_out += training->hands[step % 2].n_drawn == 0;
    left = 0;
    CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_ERR_EXHAUSTED);
    left = -1;
    REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
    REQUIRE(mo_training_draw(other, NULL, NULL, &robots) == MO_OK);
    different +=
        memcmp(drawn(training), drawn(other), 2 * MO_DEFAULT_WORDS * sizeof(uint64_t)) != 0;
    REQUIRE(mo_training_apply(training, made_up.gradient, made_up.outcomes, &made_up.counts,
                              NULL) == MO_OK);
    REQUIRE(mo_training_apply(other, made_up.gradient, made_up.outcomes, &made_up.counts, NULL) ==
            MO_OK);
  }
  printf("# %u of 100 steps began with a form that is held out\n", held_out);
  CHECK(held_out > 0);
  CHECK_INT(different, 0);
  made_up_free(&made_up);
  mo_training_free(training);
  mo_training_free(other);
}

/* A replay is cancelled, goes on, counts, and notices a stream that is not the one it was. */
static void replay(void)
{
  struct mo_training *training = pretraining(6, 200, 4), *restored = NULL;
  struct made_up made_up;
  uint8_t *bytes = NULL;
  size_t size = 0;
  REQUIRE(training != NULL && made_up_create(&made_up, training) == 0);
  for (int step = 0; step < 3; step++)
    REQUIRE(advance(training, &made_up, NULL) == MO_OK);
  REQUIRE(mo_training_encode(training, &bytes, &size) == MO_OK);
  REQUIRE(mo_training_decode(bytes, size, &restored, NULL) == MO_OK);
  const volatile int cancel = 1;
  volatile uint64_t replayed = 0;
  const struct mo_robot *robots, *expected;
  CHECK_INT(mo_training_draw(restored, &cancel, &replayed, &robots), MO_ERR_CANCELLED);
  left = 250;
  CHECK_INT(mo_training_draw(restored, NULL, &replayed, &robots), MO_ERR_EXHAUSTED);
  left = -1;
  CHECK(replayed > 100 && replayed <= 250);
  REQUIRE(mo_training_draw(restored, NULL, &replayed, &robots) == MO_OK);
  CHECK_INT(replayed, 600);
  REQUIRE(mo_training_draw(training, NULL, NULL, &expected) == MO_OK);
  int different = 0;
  for (uint32_t i = 0; i < 200; i++)
    different +=
        !is_body_of(robots[i].body, training->lattice,
                    drawn(training) + (size_t)MO_DEFAULT_WORDS * i) ||
        memcmp(robots[i].environment, expected[i].environment, sizeof(struct mo_environment)) != 0;
  CHECK_INT(different, 0);
  mo_training_free(restored);
  REQUIRE(mo_training_decode(bytes, size, &restored, NULL) == MO_OK);
  restored->draws++;
  CHECK_INT(mo_training_draw(restored, NULL, NULL, &robots), MO_ERR_CORRUPT);
  CHECK_INT(mo_training_draw(restored, NULL, NULL, &robots), MO_ERR_CORRUPT);
  mo_training_free(restored);
  free(bytes);
  made_up_free(&made_up);
  mo_training_free(training);
}

static int differences(const struct mo_training *a, const struct mo_robot *x,
                       const struct mo_robot *y, uint32_t n)
{
  int different = 0;
  for (uint32_t i = 0; i < n; i++)
    different += !is_body_of(x[i].body, a->lattice, drawn(a) + (size_t)MO_DEFAULT_WORDS * i) ||
                 x[i].body->n_springs != y[i].body->n_springs ||
                 memcmp(x[i].body->spring_lattice, y[i].body->spring_lattice,
                        y[i].body->n_springs * sizeof(uint32_t)) != 0 ||
                 memcmp(x[i].environment, y[i].environment, sizeof(struct mo_environment)) != 0;
  return different;
}

/* Robots drawn ahead, on several threads, with stops on the way, and checkpoints between, are those
 * of a plain draw; the present ones stay. */
static void ahead(void)
{
  enum { N = 700, STEPS = 6 };
  for (uint32_t threads = 1; threads <= 5; threads += 2) {
    struct mo_training *plain = pretraining(8, N, STEPS), *training = pretraining(8, N, STEPS),
                       *restored = NULL;
    struct made_up made_up;
    uint8_t *bytes = NULL, *expected_bytes = NULL;
    size_t size = 0, expected_size = 0;
    const struct mo_robot *robots, *expected, *same;
    int different = 0;
    REQUIRE(plain != NULL && training != NULL && made_up_create(&made_up, plain) == 0);
    CHECK_INT(mo_training_draw_ahead(training, NULL), MO_ERR_CONFLICT); /* nothing is drawn yet */
    mo_training_set_threads(training, threads);
    for (uint32_t step = 0; step < STEPS; step++) {
      REQUIRE(mo_training_draw(plain, NULL, NULL, &expected) == MO_OK);
      REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
      if (step % 3 == 1) {
        const volatile int cancel = 1;
        left = N / 2;
        CHECK_INT(mo_training_draw_ahead(training, NULL), MO_ERR_EXHAUSTED);
        left = -1;
        (void)mo_training_draw_ahead(training, &cancel);
      }
      if (step % 3 != 2)
        CHECK_INT(mo_training_draw_ahead(training, NULL), MO_OK);
      REQUIRE(mo_training_draw(training, NULL, NULL, &same) == MO_OK && same == robots);
      different += differences(training, robots, expected, N);
      REQUIRE(mo_training_encode(training, &bytes, &size) == MO_OK);
      REQUIRE(mo_training_encode(plain, &expected_bytes, &expected_size) == MO_OK);
      CHECK(size == expected_size && memcmp(bytes, expected_bytes, size) == 0);
      if (step == 3) {
        REQUIRE(mo_training_decode(bytes, size, &restored, NULL) == MO_OK);
        mo_training_free(training);
        training = restored;
        mo_training_set_threads(training, threads);
        REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
        different += differences(training, robots, expected, N);
      }
      free(bytes);
      free(expected_bytes);
      REQUIRE(mo_training_apply(plain, made_up.gradient, made_up.outcomes, &made_up.counts, NULL) ==
              MO_OK);
      REQUIRE(mo_training_apply(training, made_up.gradient, made_up.outcomes, &made_up.counts,
                                NULL) == MO_OK);
    }
    CHECK_INT(different, 0);
    CHECK_INT(mo_training_draw_ahead(training, NULL), MO_ERR_CONFLICT);
    made_up_free(&made_up);
    mo_training_free(plain);
    mo_training_free(training);
  }
}

/* Designs that change after a step was drawn ahead change that step. */
static void ahead_of_new_designs(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_training *training = finetuning(&settings, 3, 1.0F);
  const struct mo_robot *robots;
  struct made_up made_up;
  REQUIRE(training != NULL && made_up_create(&made_up, training) == 0);
  REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
  REQUIRE(mo_training_draw_ahead(training, NULL) == MO_OK);
  REQUIRE(mo_training_apply(training, made_up.gradient, made_up.outcomes, &made_up.counts, NULL) ==
          MO_OK);
  uint64_t design[MO_DEFAULT_WORDS];
  memcpy(design, training->designs + (size_t)2 * MO_DEFAULT_WORDS, sizeof(design));
  REQUIRE(mo_training_set_designs(training, design, 1, NULL) == MO_OK);
  REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
  for (uint32_t i = 0; i < 5; i++) {
    struct mo_environment environment;
    CHECK(is_body_of(robots[i].body, training->lattice, design));
    mo_environment_training(1, 1, i, &environment);
    CHECK(memcmp(&environment, robots[i].environment, sizeof(environment)) == 0);
  }
  made_up_free(&made_up);
  mo_training_free(training);
}

static const struct check_case cases[] = {
    {"20000 bodies are distinct and none is held out", distinct},
    {"held-out designs", held_out_designs},
    {"the share and the choice of held-out forms", held_out_share},
    {"held-out environments", held_out_environments},
    {"finetuning takes its designs in turn", finetuning_turns},
    {"an exhausted morphospace", exhausted},
    {"exhausted at a form that is held out", exhausted_at_a_held_out_form},
    {"a replay", replay},
    {"robots drawn ahead, on several threads", ahead},
    {"designs that change after a draw ahead", ahead_of_new_designs},
};
CHECK_MAIN(cases)
