/* worlds.c: training runs in environments of their own: which robot gets which, checkpoints,
 * lineage.
 */
#include "fixture.h"

#include "learning/internal.h"
#include "world/environment.h"
#include "world/task_json.h"
#include "world/terrain.h"

enum { N = 5 };

static bool same_environment(const struct mo_environment *a, const struct mo_environment *b)
{
  return mo_fields_equal(&mo_environment_fields, a, b);
}

/* A light, a profile, and three tasks; the last one is listed twice. */
static const struct mo_environment *own(void)
{
  static const char *const words[] = {"walk", "path", "path"};
  static struct mo_environment environments[N];
  const struct mo_terrain_recipe stairs = mo_terrain_recipe_default(MO_TERRAIN_STAIRS_UP);
  memset(environments, 0, sizeof(environments));
  environments[0].light_xy_m[0] = environments[1].light_xy_m[0] = 4;
  make_check(mo_terrain_draw(&stairs, &environments[1], NULL), "stairs");
  for (int i = 0; i < 3; i++)
    mo_task_named(mo_word_index(mo_task_words, words[i]), &environments[2 + i]);
  return environments;
}

static struct mo_training *in_own(enum mo_training_kind kind, uint64_t seed, uint32_t batch)
{
  struct mo_training_settings settings = small_settings(kind);
  settings.seed = seed;
  settings.batch = batch;
  struct mo_training *training = kind == MO_TRAINING_FINETUNE
                                     ? finetuning(&settings, 3, 1.0F)
                                     : make_training(&settings, NULL, NULL, 0);
  make_check(mo_training_set_environments(training, own(), N), "environments");
  return training;
}

static uint32_t place_of(const struct mo_training *training, const struct mo_robot *robot)
{
  uint32_t n;
  return (uint32_t)(robot->environment - mo_training_environments(training, &n));
}

/* Each robot has the environment that the documented stream selects. All are about equally likely,
 * and seeds and steps differ. */
static void drawn_by_the_stream(void)
{
  enum { BATCH = 2000, STEPS = 3 };
  uint32_t counts[N] = {0}, same = 0, wrong = 0;
  struct mo_training *training = in_own(MO_TRAINING_FINETUNE, 6, BATCH);
  struct made_up *made_up = make_made_up(training);
  static uint32_t before[BATCH];
  for (uint32_t step = 0; step < STEPS; step++) {
    const struct mo_robot *robots = draw(training);
    for (uint32_t i = 0; i < BATCH; i++) {
      const uint32_t place = place_of(training, &robots[i]);
      struct mo_random random;
      mo_random_init(&random, 6, MO_PURPOSE_TRAINING_WORLD, step, i);
      wrong += place != mo_random_below(&random, N) ||
               !same_environment(robots[i].environment, own() + place);
      same += step > 0 && before[i] == place;
      before[i] = place;
      counts[place]++;
    }
    REQUIRE(apply(training, made_up, NULL) == MO_OK);
  }
  CHECK_INT(wrong, 0);
  for (uint32_t k = 0; k < N; k++)
    CHECK(counts[k] > 1080 && counts[k] < 1320); /* 1200 ± 4 σ */
  CHECK(same > 650 && same < 950); /* 800 ± 6 σ: a step does not repeat the last one */
}

/* The same robots with any number of threads, drawn ahead or not, and after a checkpoint. The
 * bodies of a pretraining run are those of the same seed without its own environments. */
static void same_again(void)
{
  for (int kind = 0; kind < 2; kind++) {
    struct mo_training *plain = in_own((enum mo_training_kind)kind, 8, 200),
                       *training = in_own((enum mo_training_kind)kind, 8, 200);
    struct made_up *made_up = make_made_up(plain);
    int different = 0;
    mo_training_set_threads(training, 3);
    for (uint32_t step = 0; step < 5; step++) {
      const struct mo_robot *expected = draw(plain), *robots = draw(training);
      REQUIRE(mo_training_draw_ahead(training, NULL) == MO_OK);
      for (uint32_t i = 0; i < 200; i++)
        different += place_of(plain, &expected[i]) != place_of(training, &robots[i]) ||
                     expected[i].body->n_springs != robots[i].body->n_springs;
      make_up(made_up, plain, expected);
      REQUIRE(apply(plain, made_up, NULL) == MO_OK && apply(training, made_up, NULL) == MO_OK);
      CHECK(same_state(plain, training));
      if (step == 2)
        training = decoded(encoded(training));
    }
    CHECK_INT(different, 0);
    check_drop_to(0);
  }
}

/* With tasks only, terrains and the lights that stand still are the usual ones, and the tasks are
 * those of the stream; also after a checkpoint, on several threads. Held-out environments take the
 * tasks in turn. */
static void tasks_in_drawn_worlds(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  settings.batch = 300;
  struct mo_environment tasks[N];
  memcpy(tasks, own(), sizeof(tasks));
  mo_task_named(mo_word_index(mo_task_words, "pursue"), &tasks[0]);
  mo_task_named(mo_word_index(mo_task_words, "photo-auc"), &tasks[1]);
  struct mo_training *training = finetuning(&settings, 3, 1.0F);
  make_check(mo_training_set_tasks(training, tasks, N), "tasks");
  training = decoded(encoded(training));
  mo_training_set_threads(training, 3);
  const struct mo_robot *robots = draw(training);
  uint32_t wrong = 0, lights = 0;
  for (uint32_t i = 0; i < 300; i++) {
    struct mo_environment expected;
    struct mo_random random;
    mo_random_init(&random, settings.seed, MO_PURPOSE_TRAINING_WORLD, 0, i);
    const struct mo_environment *tasked = &tasks[mo_random_below(&random, N)];
    mo_environment_training(settings.seed, 0, i, &expected);
    expected.task = tasked->task;
    if (tasked != &tasks[1])
      memcpy(expected.light_xy_m, tasked->light_xy_m, sizeof(expected.light_xy_m));
    wrong += !same_environment(&expected, robots[i].environment) ||
             mo_environment_check(robots[i].environment, NULL) != MO_OK;
    lights += tasked == &tasks[1];
  }
  CHECK_INT(wrong, 0);
  CHECK(lights > 30);
  struct mo_environment held_out[7], plain[7];
  mo_held_out_tasks(4, 7, tasks, N, held_out);
  mo_held_out_environments(4, 7, plain);
  for (uint32_t i = 0; i < 7; i++) {
    mo_training_give_task(&tasks[i % N], &plain[i]);
    CHECK(same_environment(&held_out[i], &plain[i]));
  }
  struct mo_controller *exported = NULL;
  REQUIRE(mo_training_export(training, NULL, "1.2.3", NULL, &exported) == MO_OK);
  CHECK(strstr(mo_controller_get_metadata(exported, "morphod.settings"),
               "\"designs\":3,\"tasks\":5}") != NULL);
  mo_controller_free(exported);
}

/* Every robot's world has factors of the stream, times its own, a drop and, in drawn worlds, a
 * slope; everything else about it stays. The same on several threads and after a checkpoint. */
static void varied_worlds(void)
{
  enum { BATCH = 120 };
  for (int listed = 0; listed < 2; listed++) {
    struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
    struct mo_environment places[N];
    struct mo_variation drawn[BATCH];
    memcpy(places, own(), sizeof(places));
    places[1].factors = (struct mo_factors){1, 1, 1.5, 1, 1, 1, 2};
    settings.batch = BATCH;
    struct mo_training *plain = finetuning(&settings, 3, 1.0F);
    settings.learning.vary = mo_factors_constant();
    settings.learning.vary.given = true;
    settings.learning.vary.stiffness[0] = 0.9;
    settings.learning.vary.friction[0] = 1.0 / 3;
    settings.learning.vary.drop_m[1] = 0.2;
    settings.learning.vary.slope_degrees[1] = listed ? 0 : 10; /* one of the places is a profile */
    places[2].drop_m = 0.5;
    struct mo_training *training = finetuning(&settings, 3, 1.0F);
    if (listed) {
      make_check(mo_training_set_environments(plain, places, N), "environments");
      make_check(mo_training_set_environments(training, places, N), "environments");
    }
    training = decoded(encoded(training));
    mo_training_set_threads(training, 3);
    const struct mo_robot *before = draw(plain), *robots = draw(training);
    uint32_t wrong = 0;
    make_check(mo_variations_draw(&settings.learning.vary, settings.seed, 0, BATCH, drawn),
               "variations");
    for (uint32_t i = 0; i < BATCH; i++) {
      struct mo_environment expected = *before[i].environment;
      expected.factors = mo_factors_times(&expected.factors, &drawn[i].factors);
      expected.drop_m += drawn[i].drop_m;
      if (!listed)
        mo_terrain_tilt(drawn[i].slope_degrees, drawn[i].toward_rad, expected.terrain_heights_m);
      wrong += !same_environment(&expected, robots[i].environment) ||
               mo_environment_check(robots[i].environment, NULL) != MO_OK;
    }
    CHECK_INT(wrong, 0);
    REQUIRE(mo_training_draw_ahead(training, NULL) == MO_OK);
    check_drop_to(0);
  }
}

/* An environment that cannot slope is an error, not one without a slope. */
static void profiles_do_not_slope(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  const struct mo_robot *robots = NULL;
  settings.learning.vary.given = true;
  settings.learning.vary.slope_degrees[1] = 10;
  struct mo_training *training = finetuning(&settings, 3, 1.0F);
  make_check(mo_training_set_environments(training, own() + 1, 1), "stairs");
  CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_ERR_UNSUPPORTED);
}

static void bodies_stay(void)
{
  struct mo_training *training = in_own(MO_TRAINING_PRETRAIN, 8, 50);
  struct mo_training_settings settings = *mo_training_settings_of(training);
  struct mo_training *plain = make_training(&settings, NULL, NULL, 0);
  draw(training);
  draw(plain);
  CHECK(SAME(training->hands[0].drawn, plain->hands[0].drawn, 50 * MO_DEFAULT_WORDS));
}

/* A checkpoint has the environments, in a version of its own; without them its bytes are those of
 * earlier programs. Damage to them is noticed even if the checksum is correct. */
static void checkpoints(void)
{
  struct mo_training *training = in_own(MO_TRAINING_FINETUNE, 1, 5);
  struct mo_training_settings settings = *mo_training_settings_of(training);
  struct blob own_blob = encoded(training), plain = encoded(finetuning(&settings, 3, 1.0F));
  uint32_t version, settings_bytes, n = 0;
  memcpy(&version, plain.bytes + 8, sizeof(version));
  CHECK_INT(version, 3);
  memcpy(&version, own_blob.bytes + 8, sizeof(version));
  CHECK_INT(version, 4);
  memcpy(&settings_bytes, own_blob.bytes + 12, sizeof(settings_bytes));
  const struct mo_environment *kept = mo_training_environments(decoded(own_blob), &n);
  CHECK_INT(n, N);
  for (uint32_t k = 0; k < n; k++)
    CHECK(same_environment(&kept[k], own() + k));
  /* number, packed version, the first light, a kind of guide somewhere in the middle */
  const size_t at = 72 + settings_bytes;
  const struct {
    size_t at;
    uint32_t value;
  } faults[] = {{at, 0},     {at, 65},    {at, 64},    {at, 4},     {at + 4, 0},
                {at + 4, 1}, {at + 4, 2}, {at + 4, 4}, {at + 8, 2}, {at + 16, 0x7ff00000}};
  for (size_t i = 0; i < COUNT(faults); i++) {
    struct blob wrong = encoded(training);
    struct mo_training *read = NULL;
    struct mo_message message = {""};
    memcpy(wrong.bytes + faults[i].at, &faults[i].value, sizeof(uint32_t));
    const uint64_t sum = mo_checksum(wrong.bytes, wrong.size - sizeof(sum));
    memcpy(wrong.bytes + wrong.size - sizeof(sum), &sum, sizeof(sum));
    CHECK_INT(mo_training_decode(wrong.bytes, wrong.size, &read, &message), MO_ERR_FORMAT);
    CHECK(read == NULL);
    CHECK_SAYS(message, "damaged");
  }
  for (size_t size = at - 4; size < own_blob.size; size += size < at + 40 ? 4 : 10007) {
    struct mo_training *read = NULL;
    uint8_t *cut = malloc(size); /* of its exact size, for the sanitizer */
    memcpy(cut, own_blob.bytes, size);
    const uint64_t sum = mo_checksum(cut, size - sizeof(sum));
    memcpy(cut + size - sizeof(sum), &sum, sizeof(sum));
    CHECK_INT(mo_training_decode(cut, size, &read, NULL), MO_ERR_FORMAT);
    free(cut);
    if (size > at + 100000)
      break;
  }
}

/* Grids of other sizes stay in the training run when the caller drops them, and in its
 * checkpoints. */
static void grids(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  struct mo_environment environments[3], copies[3];
  struct mo_sha256 hashes[2];
  const size_t kept = check_n_kept;
  struct mo_training *training = finetuning(&settings, 3, 1.0F);
  uint32_t n;
  memcpy(environments, own(), sizeof(environments));
  memset(environments[1].terrain_heights_m, 0, sizeof(environments[1].terrain_heights_m));
  environments[1].n_profile = 0;
  environments[1].profile_spacing_m = 0;
  environments[1].grid = make_grid(128, 128, 0.05, 1, 0.01);
  environments[2].grid = make_grid(3, 2, 2, 2, 0.1);
  memcpy(copies, environments, sizeof(copies));
  mo_environments_hold(copies, 3);
  REQUIRE_OK(mo_training_set_environments(training, copies, 3));
  mo_environments_drop(copies, 3);
  const struct blob blob = encoded(training);
  struct mo_training *again = decoded(blob);
  const struct mo_environment *read = mo_training_environments(again, &n);
  CHECK_INT(n, 3);
  for (uint32_t k = 0; k < 3; k++) {
    mo_environment_digest(&environments[k], &hashes[0]);
    mo_environment_digest(&read[k], &hashes[1]);
    CHECK(mo_sha256_equal(&hashes[0], &hashes[1]));
  }
  CHECK(draw(again)[0].environment->task.guide.kind ==
        draw(training)[0].environment->task.guide.kind);
  for (size_t size = blob.size - 1; size > 100; size -= 1 + size / 7) {
    struct mo_training *none = NULL;
    uint8_t *cut = malloc(size);
    memcpy(cut, blob.bytes, size);
    const uint64_t sum = mo_checksum(cut, size - sizeof(sum));
    memcpy(cut + size - sizeof(sum), &sum, sizeof(sum));
    CHECK_INT(mo_training_decode(cut, size, &none, NULL), MO_ERR_FORMAT);
    free(cut);
  }
  check_drop_to(kept);
}

static void lineage(void)
{
  struct mo_training *training = in_own(MO_TRAINING_FINETUNE, 1, 5);
  struct mo_controller *exported = NULL, *other = NULL;
  REQUIRE(mo_training_export(training, NULL, "1.2.3", NULL, &exported) == MO_OK);
  const char *sum = mo_controller_get_metadata(exported, "morphod.environments_crc64");
  CHECK(sum != NULL && strlen(sum) == 16);
  CHECK(strstr(mo_controller_get_metadata(exported, "morphod.settings"),
               "\"designs\":3,\"environments\":5}") != NULL);
  struct mo_environment changed[N];
  memcpy(changed, own(), sizeof(changed));
  changed[0].light_xy_m[1] = 1;
  REQUIRE(mo_training_set_environments(training, changed, N) == MO_OK);
  REQUIRE(mo_training_export(training, NULL, "1.2.3", NULL, &other) == MO_OK);
  const char *other_sum = mo_controller_get_metadata(other, "morphod.environments_crc64");
  CHECK(sum != NULL && other_sum != NULL && strcmp(other_sum, sum) != 0);
  mo_controller_free(exported);
  mo_controller_free(other);
  struct mo_training_settings settings = *mo_training_settings_of(training);
  REQUIRE(mo_training_export(finetuning(&settings, 3, 1.0F), NULL, "1.2.3", NULL, &exported) ==
          MO_OK);
  CHECK(mo_controller_get_metadata(exported, "morphod.environments_crc64") == NULL);
  CHECK(strstr(mo_controller_get_metadata(exported, "morphod.settings"), "environments") == NULL);
  mo_controller_free(exported);
}

static void refused(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_PRETRAIN);
  struct mo_training *training = make_training(&settings, NULL, NULL, 0);
  uint32_t n = 7;
  CHECK(mo_training_environments(training, &n) == NULL && n == 0);
  CHECK_INT(mo_training_set_environments(training, own(), 0), MO_ERR_RANGE);
  CHECK_INT(mo_training_set_environments(training, own(), 65), MO_ERR_RANGE);
  draw(training);
  CHECK_INT(mo_training_set_environments(training, own(), N), MO_ERR_CONFLICT);
}

static const struct check_case cases[] = {
    {"robots have the environments of the stream", drawn_by_the_stream},
    {"the same robots on several threads and after a checkpoint", same_again},
    {"tasks in drawn environments", tasks_in_drawn_worlds},
    {"variations of the robots' worlds", varied_worlds},
    {"profiles do not slope", profiles_do_not_slope},
    {"the bodies are those of the seed", bodies_stay},
    {"environments in checkpoints", checkpoints},
    {"grids of other sizes in checkpoints", grids},
    {"environments in the lineage", lineage},
    {"environments come before the first draw", refused},
};
CHECK_MAIN(cases)
