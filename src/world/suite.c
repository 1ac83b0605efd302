/* suite.c: the named sets of environments: the paper's test set, and those of the suite morpho-12.
 *
 * Each task of the suite has ten worlds for selection and 64 that are held out. World i of task k
 * comes from the stream (MO_SUITE_SEED, SUITE, k, i); held-out worlds are i = 64 … 127. Numbers are
 * rounded to 0.00001 when they are drawn, so that the worlds are short in text form. */
#include <morpho/random.h>
#include <morpho/world.h>

#include "base/words.h"
#include "world/task_json.h"

#include <math.h>
#include <string.h>

#define HELD_OUT_FIRST 64
#define SELECTION      10
#define HELD_OUT       64
#define SIGMA_TOP_M    0.1
#define POINTS         3
#define DAMAGE_S       2.0

enum { PHOTO, PHOTO_AUC, WALK, ROUGH, UP, DOWN, HURDLE, GAP, CIRCLE, SHUTTLE, PATH, DAMAGE, TASKS };

const char *const mo_set_words[] = {"paper-test",
                                    "morpho-12-photo",
                                    "morpho-12-photo-held-out",
                                    "morpho-12-photo-auc",
                                    "morpho-12-photo-auc-held-out",
                                    "morpho-12-walk",
                                    "morpho-12-walk-held-out",
                                    "morpho-12-rough",
                                    "morpho-12-rough-held-out",
                                    "morpho-12-up",
                                    "morpho-12-up-held-out",
                                    "morpho-12-down",
                                    "morpho-12-down-held-out",
                                    "morpho-12-hurdle",
                                    "morpho-12-hurdle-held-out",
                                    "morpho-12-gap",
                                    "morpho-12-gap-held-out",
                                    "morpho-12-circle",
                                    "morpho-12-circle-held-out",
                                    "morpho-12-shuttle",
                                    "morpho-12-shuttle-held-out",
                                    "morpho-12-path",
                                    "morpho-12-path-held-out",
                                    "morpho-12-damage",
                                    "morpho-12-damage-held-out",
                                    NULL};
_Static_assert(sizeof(mo_set_words) / sizeof(*mo_set_words) == 2 + 2 * TASKS,
               "each task has two sets");

const char *const mo_suite_words[] = {"morpho-12", "morpho-12-held-out", NULL};
const char *const mo_suite_task_words[] = {"photo", "photo-auc", "walk", "rough",  "up",
                                           "down",  "hurdle",    "gap",  "circle", "shuttle",
                                           "path",  "damage",    NULL};
_Static_assert(MO_SUITE_TASKS == TASKS, "the contract names every task");

/* ---- drawing ---- */

/* Draws from [low, high], in steps of 0.00001. */
static double between(struct mo_random *random, double low, double high)
{
  return floor((low + (high - low) * mo_random_uniform(random)) * 1e5 + 0.5) / 1e5;
}

static double heading(struct mo_random *random)
{
  return between(random, -M_PI, M_PI);
}

/* Draws a unit vector without using sines, because their bits could differ between machines. */
static void draw_direction(struct mo_random *random, double direction[2])
{
  double square;
  do {
    for (int axis = 0; axis < 2; axis++)
      direction[axis] = 2 * mo_random_uniform(random) - 1;
    square = direction[0] * direction[0] + direction[1] * direction[1];
  } while (square < 0.01 || square > 1);
  for (int axis = 0; axis < 2; axis++)
    direction[axis] /= sqrt(square);
}

/* Sets point i of a path to `length_m` from `from`, in a direction. */
static void set_point(struct mo_guide *guide, uint32_t i, const double from[2], double length_m,
                      const double direction[2])
{
  for (int axis = 0; axis < 2; axis++)
    guide->points_m[i][axis] = floor((from[axis] + length_m * direction[axis]) * 1e5 + 0.5) / 1e5;
}

static const double middle_m[2] = {MO_WORLD_CENTER_M, MO_WORLD_CENTER_M};

static void draw_shuttle(struct mo_random *random, struct mo_guide *guide)
{
  double direction[2];
  draw_direction(random, direction);
  const double length_m = between(random, 0.6, 0.9);
  for (uint32_t i = 0; i < guide->n_points; i++)
    set_point(guide, i, middle_m, i % 2 == 0 ? length_m : 0, direction);
}

/* Draws a path: each leg turns by at most about 120° from the previous one. */
static void draw_path(struct mo_random *random, struct mo_guide *guide)
{
  double before[2], direction[2];
  draw_direction(random, before);
  guide->n_points = POINTS;
  memset(guide->points_m, 0, sizeof(guide->points_m));
  for (uint32_t i = 0; i < POINTS; i++) {
    do
      draw_direction(random, direction);
    while (direction[0] * before[0] + direction[1] * before[1] < -0.5);
    set_point(guide, i, i == 0 ? middle_m : guide->points_m[i - 1], between(random, 0.6, 1.0),
              direction);
    memcpy(before, direction, sizeof(before));
  }
}

/* ---- terrains ---- */

static void draw_family(struct mo_random *random, int task, uint64_t i,
                        struct mo_environment *environment)
{
  struct mo_terrain_recipe recipe;
  const bool is_slope = i % 2 == 1;
  switch (task) {
  case UP:
  case DOWN:
    recipe = mo_terrain_recipe_default(is_slope     ? MO_TERRAIN_SLOPE
                                       : task == UP ? MO_TERRAIN_STAIRS_UP
                                                    : MO_TERRAIN_STAIRS_DOWN);
    if (is_slope) {
      recipe.degrees = between(random, 4, 12) * (task == UP ? 1 : -1);
    } else {
      recipe.rise_m = between(random, 0.02, 0.08);
      recipe.run_m = recipe.spacing_m * (2 + mo_random_below(random, 4));
    }
    break;
  case HURDLE:
    recipe = mo_terrain_recipe_default(MO_TERRAIN_HURDLES);
    recipe.height_m = between(random, 0.03, 0.1);
    break;
  default:
    recipe = mo_terrain_recipe_default(MO_TERRAIN_GAPS);
    recipe.depth_m = between(random, 0.05, 0.1);
    recipe.gap_m = recipe.spacing_m * (2 + mo_random_below(random, 3));
  }
  if (task == HURDLE || task == GAP)
    recipe.seed = i;
  /* Cannot fail: within the bounds of every family. */
  (void)mo_terrain_draw(&recipe, environment, NULL);
}

/* ---- sets ---- */

static void set_task(const char *word, struct mo_environment *environment)
{
  mo_task_named(mo_word_index(mo_task_words, word), environment);
}

static void draw_world(int task, uint64_t i, struct mo_environment *environment)
{
  struct mo_guide *guide = &environment->task.guide;
  struct mo_random random;
  mo_random_init(&random, MO_SUITE_SEED, MO_PURPOSE_SUITE, (uint32_t)task, i);
  *environment = (struct mo_environment){0};
  switch (task) {
  case PHOTO:
  case PHOTO_AUC:
  case DAMAGE: /* the same worlds */
    mo_environment_held_out(MO_SUITE_SEED, i, environment);
    set_task(task == PHOTO_AUC ? "photo-auc" : "photo", environment);
    if (task == DAMAGE)
      environment->damage = (struct mo_damage){1 + (uint32_t)(i % MO_OCTANTS), DAMAGE_S};
    break;
  case WALK:
  case ROUGH:
    set_task("walk", environment);
    guide->heading_rad = heading(&random);
    if (task == ROUGH)
      mo_terrain_random(MO_SUITE_SEED, 0, i, between(&random, 0.02, SIGMA_TOP_M),
                        environment->terrain_heights_m);
    break;
  case UP: set_task("climb", environment); break;
  case DOWN:
  case HURDLE:
  case GAP: set_task("walk", environment); break;
  case CIRCLE:
    set_task("circle", environment);
    guide->heading_rad = heading(&random);
    guide->turn_rad_per_s = between(&random, 1.2, 2.0) * (mo_random_below(&random, 2) ? 1 : -1);
    break;
  case SHUTTLE:
    set_task("shuttle", environment);
    draw_shuttle(&random, guide);
    break;
  default: set_task("path", environment); draw_path(&random, guide);
  }
  if (task >= UP && task <= GAP)
    draw_family(&random, task, i, environment);
}

uint32_t mo_environment_set(int set, struct mo_environment environments[MO_SET_ENVIRONMENTS_MAX])
{
  if (set == 0) {
    mo_environment_paper_test(environments);
    return MO_PAPER_TEST_COUNT;
  }
  const bool is_held_out = (set - 1) % 2 == 1;
  const uint32_t n = is_held_out ? HELD_OUT : SELECTION;
  for (uint32_t i = 0; i < n; i++)
    draw_world((set - 1) / 2, (is_held_out ? HELD_OUT_FIRST : 0) + i, &environments[i]);
  return n;
}

uint32_t mo_suite_environments(int i)
{
  return i < 0 ? 0 : MO_SUITE_TASKS * (uint32_t)(i == 0 ? SELECTION : HELD_OUT);
}

const char *mo_suite_set(int i, uint32_t task)
{
  return mo_set_words[1 + 2 * task + (uint32_t)i];
}
