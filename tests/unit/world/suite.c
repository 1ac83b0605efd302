/* suite.c: the named sets of environments: their sizes, tasks and frozen bits. */
#include "../make.h"

#include "base/words.h"

enum { SETS = 25, MAX = MO_SET_ENVIRONMENTS_MAX };

static struct mo_environment worlds[MAX], others[MAX];

static uint32_t draw(const char *name)
{
  const int i = mo_word_index(mo_set_words, name);
  CHECK(i >= 0);
  return i >= 0 ? mo_environment_set(i, worlds) : 0;
}

/* A new hash here is another set under the same name. */
static void frozen(void)
{
  static const uint64_t expected[SETS] = {
      UINT64_C(0xaacc8ba14f5a98fd), UINT64_C(0x4b71a73328ef2b1a), UINT64_C(0xf53609d6d94bd2f9),
      UINT64_C(0x2ef02dcd53e12702), UINT64_C(0x745d01972ec15e29), UINT64_C(0xc9a6bd9f7adade49),
      UINT64_C(0x163161df3ecaf242), UINT64_C(0xdcfb8d80b606de41), UINT64_C(0xd247e4341ce3ca79),
      UINT64_C(0x8cf3cdad9f4d0ec2), UINT64_C(0x7d383657c10c4f25), UINT64_C(0x8a9269b1e5502c2a),
      UINT64_C(0x936c243c8ce80e1e), UINT64_C(0x2ec6f94ec54044f5), UINT64_C(0x65641a37f30bd72d),
      UINT64_C(0xb39753bca079c761), UINT64_C(0x8c824ecda6d87ecf), UINT64_C(0x46f5711414dd97d4),
      UINT64_C(0xf0c96420397bfb26), UINT64_C(0xfe289b4674ec05d5), UINT64_C(0xe9c3a7c0fa37e7c1),
      UINT64_C(0x53945fe137ab063b), UINT64_C(0x36fdb57532f5e864), UINT64_C(0x1cdc3791739a2b81),
      UINT64_C(0x7573edc42854e239),
  };
  CHECK_INT(mo_words_count(mo_set_words), SETS);
  for (int i = 0; i < SETS; i++) {
    const uint32_t n = mo_environment_set(i, worlds);
    uint64_t h = FNV_START;
    CHECK_INT(n, i == 0 || i % 2 == 1 ? 10 : MAX);
    for (uint32_t k = 0; k < n; k++) {
      const struct mo_environment *e = &worlds[k];
      uint32_t where = 0;
      if (mo_environment_check(e, &where) != MO_OK)
        printf("# %s, environment %u: number %u\n", mo_set_words[i], k, where);
      CHECK_OK(mo_environment_check(e, NULL));
      hash(&h, e->light_xy_m, sizeof(e->light_xy_m));
      hash(&h, e->terrain_heights_m, sizeof(e->terrain_heights_m));
      hash(&h, &e->task.guide, sizeof(e->task.guide));
      hash(&h, &e->task.objective, sizeof(e->task.objective));
      hash(&h, &e->n_profile, sizeof(e->n_profile));
      hash(&h, &e->profile_spacing_m, sizeof(e->profile_spacing_m));
      if (e->damage.cut != 0) {
        hash(&h, &e->damage.cut, sizeof(e->damage.cut));
        hash(&h, &e->damage.time_s, sizeof(e->damage.time_s));
      }
    }
    printf("# 0x%016llx, %s\n", (unsigned long long)h, mo_set_words[i]);
    CHECK(h == expected[i]);
  }
}

static bool are_equal(const struct mo_environment *a, const struct mo_environment *b)
{
  return memcmp(a->light_xy_m, b->light_xy_m, sizeof(a->light_xy_m)) == 0 &&
         memcmp(a->terrain_heights_m, b->terrain_heights_m, sizeof(a->terrain_heights_m)) == 0 &&
         a->task.guide.heading_rad == b->task.guide.heading_rad &&
         memcmp(a->task.guide.points_m, b->task.guide.points_m, sizeof(a->task.guide.points_m)) ==
             0;
}

/* No held-out world is one to select with, and all worlds of a set differ. */
static void held_out(void)
{
  for (int i = 1; i < SETS; i += 2) {
    const uint32_t n = mo_environment_set(i, worlds), m = mo_environment_set(i + 1, others);
    for (uint32_t k = 0; k < m; k++) {
      for (uint32_t j = 0; j < n; j++)
        CHECK(!are_equal(&others[k], &worlds[j]));
      for (uint32_t j = 0; j < k; j++)
        CHECK(!are_equal(&others[k], &others[j]));
    }
  }
}

/* Both tasks with a light that stands still have the same places. */
static void photo(void)
{
  const uint32_t n = draw("morpho-12-photo");
  memcpy(others, worlds, sizeof(others));
  CHECK_INT(draw("morpho-12-photo-auc"), n);
  for (uint32_t k = 0; k < n; k++) {
    CHECK(are_equal(&worlds[k], &others[k]));
    CHECK(mo_task_is_plain(&others[k].task));
    CHECK_INT(worlds[k].task.objective, MO_OBJECTIVE_APPROACH);
    const double d_m = hypot(worlds[k].light_xy_m[0] - MO_WORLD_CENTER_M,
                             worlds[k].light_xy_m[1] - MO_WORLD_CENTER_M);
    CHECK(d_m >= 0.4 && d_m <= 2.0);
  }
}

/* The legs of paths and shuttles have the lengths and turns that docs/suite.md states. */
static void legs(void)
{
  const char *const sets[] = {"morpho-12-path-held-out", "morpho-12-shuttle-held-out"};
  for (int s = 0; s < 2; s++)
    for (uint32_t k = 0, n = draw(sets[s]); k < n; k++) {
      const struct mo_guide *guide = &worlds[k].task.guide;
      double from[2] = {MO_WORLD_CENTER_M, MO_WORLD_CENTER_M}, before[2] = {0, 0};
      CHECK_INT(guide->n_points, s == 0 ? 3 : 4);
      for (uint32_t i = 0; i < guide->n_points; i++) {
        const double leg[2] = {guide->points_m[i][0] - from[0], guide->points_m[i][1] - from[1]};
        const double length_m = hypot(leg[0], leg[1]);
        CHECK(length_m > 0.598 && length_m < (s == 0 ? 1.002 : 0.902));
        CHECK(s == 1 || i == 0 ||
              (leg[0] * before[0] + leg[1] * before[1]) / (length_m * hypot(before[0], before[1])) >
                  -0.51);
        memcpy(before, leg, sizeof(before));
        memcpy(from, guide->points_m[i], sizeof(from));
      }
    }
}

/* Terrains of the tasks that have one: profiles that begin level, and rise, fall, or vary. */
static void terrains(void)
{
  const char *const sets[] = {"up", "down", "hurdle", "gap"};
  for (int s = 0; s < 4; s++) {
    char name[64];
    snprintf(name, sizeof(name), "morpho-12-%s-held-out", sets[s]);
    for (uint32_t k = 0, n = draw(name); k < n; k++) {
      const struct mo_environment *e = &worlds[k];
      const double start = mo_terrain_height(e, 2.5, 2.5), end = mo_terrain_height(e, 5.9, 2.5);
      CHECK(e->n_profile == MO_TERRAIN_HEIGHTS);
      CHECK(s != 0 || end > start + 0.1);
      CHECK(s != 1 || end < start - 0.1);
      CHECK(s != 2 || mo_terrain_highest(e) > start + 0.02);
      CHECK(s != 3 || start > MO_TERRAIN_FLOOR_M + 0.04);
    }
  }
}

/* The sets of a suite are those of its tasks, in order. */
static void suites(void)
{
  CHECK_INT(mo_words_count(mo_suite_words), 2);
  CHECK_INT(mo_words_count(mo_suite_task_words), MO_SUITE_TASKS);
  CHECK_INT(mo_suite_environments(-1), 0);
  for (int s = 0; s < 2; s++) {
    uint32_t n = 0;
    for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
      char name[64];
      snprintf(name, sizeof(name), "morpho-12-%s%s", mo_suite_task_words[t],
               s == 1 ? "-held-out" : "");
      CHECK_TEXT(mo_suite_set(s, t), name);
      n += draw(name);
    }
    CHECK_INT(mo_suite_environments(s), n);
  }
}

static const struct check_case cases[] = {
    {"sets are frozen", frozen},         {"held-out worlds are others", held_out},
    {"lights that stand still", photo},  {"paths and shuttles", legs},
    {"terrains of the tasks", terrains}, {"suites", suites},
};
CHECK_MAIN(cases)
