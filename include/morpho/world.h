/* world.h: terrain, light, task, the named sets of environments (paper, section 2.2 and appendices
 * A.2, A.3), and families of terrains.
 *
 * A terrain is a grid or a profile; beyond its edges, its height continues unchanged.
 *   Grid: 8 × 8 heights over 5 m × 5 m, bilinear between them. Row j is y, column i is x:
 *   heights[j*8 + i] at (i·5/7 m, j·5/7 m).
 *   Custom grid (struct mo_terrain_grid): the same with its own rows and columns, one spacing along
 *   both axes, and its middle at the center of the robot's workspace.
 *   Profile: heights along x, linear between them, the same for every y: heights[k] at
 *   x = k · profile_spacing_m.
 * The robot's workspace is centered at (2.5 m, 2.5 m). The light stands on the terrain: its z is
 * the terrain height at its (x, y). */
#ifndef MORPHO_WORLD_H
#define MORPHO_WORLD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>
#include <morpho/task.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_TERRAIN_SIDE     8
#define MO_TERRAIN_HEIGHTS  64
#define MO_TERRAIN_SIZE_M   5.0
#define MO_WORLD_CENTER_M   2.5
#define MO_TERRAIN_FLOOR_M  0.05 /* the lowest height of a random terrain */
#define MO_PAPER_TEST_COUNT 10
#define MO_PAPER_TEST_SEED  UINT64_C(20250711)
#define MO_HEIGHT_LIMIT_M                                                                          \
  100.0 /* |height| and |light coordinate| that mo_environment_check accepts */
#define MO_LIGHT_LIMIT_M         1000.0
#define MO_PROFILE_HEIGHTS_MIN   2
#define MO_PROFILE_SPACING_MIN_M 0.02
#define MO_PROFILE_SPACING_MAX_M 1.0
#define MO_GRID_SIDE_MIN         2
#define MO_GRID_SIDE_MAX         128
#define MO_GRID_SPACING_MIN_M    0.02
#define MO_GRID_SPACING_MAX_M    2.0
/* Maximum number of heights in all grids of a request: 16 grids of the largest size, 2 MiB of
 * float64. */
#define MO_GRIDS_HEIGHTS_MAX (16 * MO_GRID_SIDE_MAX * MO_GRID_SIDE_MAX)

/* Springs that break during the rollout: those of one octant of the body's bounding box before the
 * rollout (a spring is where its midpoint is; on a middle plane, it is on the side with larger
 * coordinates) exert no force in steps that start at time_s or later. */
struct mo_damage {
  uint32_t cut;  /* 0: none; otherwise 1 + octant; bits of the octant: 1: the half with larger x, 2:
                    with larger y, 4: with larger z */
  double time_s; /* 0 … MO_DAMAGE_TIME_MAX_S; without damage 0 */
};
#define MO_OCTANTS           8
#define MO_DAMAGE_TIME_MAX_S 3600.0

/* A grid with its own size and spacing (it may be 8 × 8). Immutable; environments may share it. */
struct mo_terrain_grid {
  uint32_t columns, rows; /* along x, along y; MO_GRID_SIDE_MIN … MAX */
  double spacing_m;       /* MO_GRID_SPACING_MIN_M … MAX_M */
  double from_m[2];       /* x, y of heights_m[0] */
  double highest_m;
  uint32_t holders;   /* private */
  double heights_m[]; /* (rows, columns); no −0 */
};

/* How the physics of a world differs from that of the request: its constants are multiplied by
 * these. */
struct mo_factors {
  uint32_t given;   /* 0: all are 1, and the numbers below are 0; 1: at least one is not 1 */
  double stiffness; /* of springs; MO_FACTOR_MIN … MO_FACTOR_MAX, like mass */
  double mass;      /* of nodes */
  double drag;      /* 0 … MO_FACTOR_MAX, like the others */
  double gravity;
  double actuation;
  double friction; /* not of its cap */
};
#define MO_FACTOR_MIN 0.01
#define MO_FACTOR_MAX 100.0
/* Returns factors that are all 1, and marked as given. */
struct mo_factors mo_factors_ones(void);

/* Ranges from which worlds are drawn, each {lowest, highest}: factors ({1, 1}: the constant does
 * not vary), and what is added to an environment ({0, 0}: nothing). */
struct mo_factor_ranges {
  bool given; /* false: nothing varies */
  double stiffness[2], mass[2], drag[2], gravity[2], actuation[2], friction[2];
  double drop_m[2];        /* 0 … MO_DROP_MAX_M; added to the environment's own */
  double slope_degrees[2]; /* 0 … MO_VARY_DEGREES_MAX; the ground rises in a direction that is drawn
                              as well, uniformly */
};
#define MO_VARY_DEGREES_MAX 30.0
struct mo_factor_ranges mo_factors_constant(void); /* nothing varies */
/* MO_ERR_INVALID or MO_ERR_RANGE; above: the struct's name in messages. */
int mo_factor_ranges_check(const char *above, const struct mo_factor_ranges *ranges,
                           struct mo_message *message);
/* Draws n sets of factors by Latin hypercube sampling: each factor's range is divided into n equal
 * parts, from each of which one number is drawn, uniformly, and the parts of different factors are
 * paired at random. Streams (seed, FACTORS, step, number of the factor). Equal inputs, equal bits.
 * Drop and slope of the ranges are ignored. MO_ERR_NO_MEMORY. */
int mo_factors_draw(const struct mo_factor_ranges *ranges, uint64_t seed, uint32_t step, uint32_t n,
                    struct mo_factors *factors);
/* Returns the products of two sets of factors. */
struct mo_factors mo_factors_times(const struct mo_factors *a, const struct mo_factors *b);

/* What is drawn from ranges for one world. */
struct mo_variation {
  struct mo_factors factors;
  double drop_m, slope_degrees, toward_rad; /* toward_rad: where the ground rises, from +x to +y */
};
/* Draws n variations: the factors of mo_factors_draw, and drop, slope and direction by the same
 * method, from the streams with the next numbers. MO_ERR_NO_MEMORY. */
int mo_variations_draw(const struct mo_factor_ranges *ranges, uint64_t seed, uint32_t step,
                       uint32_t n, struct mo_variation *variations);

struct mo_environment {
  double light_xy_m[2];
  double terrain_heights_m[MO_TERRAIN_HEIGHTS]; /* those that a profile does not have are 0, as are
                                                   all if there is a custom grid */
  struct mo_task task;      /* all 0: the light is fixed, and the robot is to reach it */
  uint32_t n_profile;       /* 0: the terrain is a grid; else the number of a profile's heights,
                               MO_PROFILE_HEIGHTS_MIN … MO_TERRAIN_HEIGHTS */
  double profile_spacing_m; /* of a profile: MO_PROFILE_SPACING_MIN_M … MAX_M; of a grid: 0 */
  struct mo_damage damage;
  struct mo_factors factors;
  double drop_m; /* extra lift of the body at the start, added to that of the physics; 0 …
                    MO_DROP_MAX_M */
  const struct mo_terrain_grid *grid; /* the terrain is this custom grid; NULL: it is not custom. A
                                         copy of the struct borrows it; see mo_terrain_grid_hold */
};

#define MO_DROP_MAX_M 1.0

/* Varies an environment: multiplies its factors, adds the drop and, if the slope is not 0, a plane
 * to its heights, the lowest of which is then MO_TERRAIN_FLOOR_M. On failure nothing changes:
 * MO_ERR_UNSUPPORTED (only grids of 8 × 8 heights can slope) or MO_ERR_RANGE (drop, height). */
int mo_environment_vary(const struct mo_variation *by, struct mo_environment *environment);
/* Returns whether all variations from the ranges suit the environment, except that their factors
 * may be out of range: MO_ERR_UNSUPPORTED, MO_ERR_RANGE; message (nullable). */
int mo_environment_check_vary(const struct mo_environment *environment,
                              const struct mo_factor_ranges *ranges, struct mo_message *message);

/* Makes a grid with one holder. heights_m: (rows, columns), copied. MO_ERR_INVALID (a number is not
 * finite), MO_ERR_RANGE or MO_ERR_NO_MEMORY. */
int mo_terrain_grid_create(uint32_t columns, uint32_t rows, double spacing_m,
                           const double *heights_m, const struct mo_terrain_grid **grid);
/* Adds or drops a reference; dropping the last one frees the grid. Thread-safe. NULL is ignored. */
void mo_terrain_grid_hold(const struct mo_terrain_grid *grid);
void mo_terrain_grid_drop(const struct mo_terrain_grid *grid);
/* Does the same for the grids of n environments; when dropped, the pointers become NULL. */
void mo_environments_hold(const struct mo_environment *environments, size_t n);
void mo_environments_drop(struct mo_environment *environments, size_t n);
/* Drops the grids and frees the list; NULL: nothing. */
void mo_environments_free(struct mo_environment *environments, size_t n);

/* Returns the terrain's height at (x, y) in meters. Float64 reference for every faster path. */
double mo_terrain_height(const struct mo_environment *environment, double x_m, double y_m);
/* Computes the gradient (∂h/∂x, ∂h/∂y) of the patch at (x, y); 0 along an axis whose coordinate is
 * clamped. On a line between two cells, the cell with the higher index is used (at the far edge,
 * the last cell). */
void mo_terrain_gradient(const struct mo_environment *environment, double x_m, double y_m,
                         double gradient[2]);
double mo_terrain_highest(const struct mo_environment *environment);

/* Checks that all values are finite and within the limits. MO_ERR_INVALID (not finite, or a height
 * that a profile does not have is not 0) or MO_ERR_RANGE; *where (nullable): 0 and 1 for the
 * light's coordinates, 2 + k for height k, MO_ENVIRONMENT_TASK for the task, for which
 * mo_task_check has a message, MO_ENVIRONMENT_PROFILE for n_profile and profile_spacing_m (also
 * if both a profile and a custom grid are set), MO_ENVIRONMENT_DAMAGE for the damage,
 * MO_ENVIRONMENT_FACTORS for the factors (also if all are 1 but given), and MO_ENVIRONMENT_DROP. */
#define MO_ENVIRONMENT_TASK    (2 + MO_TERRAIN_HEIGHTS)
#define MO_ENVIRONMENT_PROFILE (3 + MO_TERRAIN_HEIGHTS)
#define MO_ENVIRONMENT_DAMAGE  (4 + MO_TERRAIN_HEIGHTS)
#define MO_ENVIRONMENT_FACTORS (5 + MO_TERRAIN_HEIGHTS)
#define MO_ENVIRONMENT_DROP    (6 + MO_TERRAIN_HEIGHTS)
int mo_environment_check(const struct mo_environment *environment, uint32_t *where);

/* Draws heights from N(0, σ), shifted so that the lowest is MO_TERRAIN_FLOOR_M; stream (seed,
 * TERRAIN, step, index). */
void mo_terrain_random(uint64_t seed, uint32_t step, uint64_t index, double sigma_m,
                       double heights_m[MO_TERRAIN_HEIGHTS]);

/* ---- families of terrains ----
 *
 * All but `rough` and `flat` are profiles of 64 heights, for robots that start at x = 2.5 m and
 * walk along +x. Each is level from x = 0 to where it begins: at 2.8 m, the end of the default
 * workspace, for `slope`, and at 3.1 m for the others, or at the next height. Between levels there
 * are ramps over one spacing, which is why no rise may exceed it: none is steeper than 45°. The
 * lowest height is MO_TERRAIN_FLOOR_M. docs/model.md has the formulas. */

#define MO_SLOPE_BEGINS_M         2.8
#define MO_FAMILY_BEGINS_M        3.1
#define MO_TERRAIN_SIGMA_MAX_M    10.0
#define MO_TERRAIN_DEGREES_MAX    45.0
#define MO_TERRAIN_TOWARD_MAX_RAD 6.3

enum mo_terrain_family {
  MO_TERRAIN_ROUGH = 0,   /* a grid: mo_terrain_random(seed, 0, 0, sigma_m) */
  MO_TERRAIN_FLAT,        /* a grid; the same as `rough` with a σ of 0 */
  MO_TERRAIN_SLOPE,       /* climbs to the end */
  MO_TERRAIN_STAIRS_UP,   /* steps of rise_m, each run_m after the previous one */
  MO_TERRAIN_STAIRS_DOWN, /* the same downward */
  MO_TERRAIN_HURDLES,     /* ridges two spacings wide, of random heights and distances */
  MO_TERRAIN_GAPS,        /* ditches between platforms of random lengths */
  MO_TERRAIN_STEPS        /* platforms of random heights */
};
extern const char *const mo_terrain_family_words[]; /* "rough", "flat", …, NULL */

/* Only the fields of the family are used; the others should be 0. Lengths along x other than
 * spacing_m are whole numbers of spacings. */
struct mo_terrain_recipe {
  enum mo_terrain_family family;
  uint64_t seed;     /* rough, hurdles, gaps, steps */
  double spacing_m;  /* between two heights of a profile: 0.08 … 1 */
  double sigma_m;    /* rough: 0 … 10 */
  double degrees;    /* slope; rough, flat: of the whole ground; −45 … 45 */
  double toward_rad; /* rough, flat: where the ground rises, from +x to +y */
  double rise_m;     /* stairs: above 0, at most spacing_m */
  double run_m;      /* stairs, steps: from one ramp to the next, at least two spacings */
  double height_m;   /* hurdles: of the highest; steps: between the highest and the lowest; above 0,
                        at most spacing_m */
  double every_m;    /* hurdles: mean distance, at least three spacings */
  double depth_m;    /* gaps: above 0, at most spacing_m */
  double gap_m;      /* gaps: width at the top, ramps included; at least two spacings */
  double platform_m; /* gaps: mean length of a platform, at least two spacings */
};

/* Returns a family's defaults, with the seed 0. */
struct mo_terrain_recipe mo_terrain_recipe_default(enum mo_terrain_family family);

/* Sets an environment's heights, n_profile and profile_spacing_m; the rest stays. MO_ERR_INVALID or
 * MO_ERR_RANGE; message (nullable) says which field is wrong and what to do. */
int mo_terrain_draw(const struct mo_terrain_recipe *recipe, struct mo_environment *environment,
                    struct mo_message *message);

/* ---- named sets ---- */

/* Draws a training environment: σ ~ U(0, 0.1 m); light uniform by area in the ring 0.4–2.0 m around
 * the center. */
void mo_environment_training(uint64_t seed, uint32_t step, uint64_t index,
                             struct mo_environment *environment);

/* Draws like mo_environment_training, under keys that no training run uses. */
void mo_environment_held_out(uint64_t seed, uint64_t index, struct mo_environment *environment);

/* Fills in the paper's test set, always the same 10 environments: five lights at 2.0 m (angles
 * 2πi/5), then five at 1.5 m (offset by π/5). Each ring is paired at random, with a fixed seed,
 * with one terrain of each σ in {0.02, …, 0.10} m. The pairing draws 0.10, 0.02, 0.04, 0.08, 0.06
 * m, then 0.02, 0.06, 0.08, 0.10, 0.04 m. Streams (MO_PAPER_TEST_SEED, TEST_SET, 0, i): i = 0 for
 * the pairing, 1 + k for the heights of environment k. */
void mo_environment_paper_test(struct mo_environment environments[MO_PAPER_TEST_COUNT]);

/* The named sets: "paper-test" and, for each task of the suite morpho-12, ten worlds for selection
 * ("morpho-12-walk") and 64 others ("morpho-12-walk-held-out"). A set never changes. */
#define MO_SUITE_SEED           UINT64_C(20261129)
#define MO_SET_ENVIRONMENTS_MAX 64
extern const char *const mo_set_words[]; /* NULL after the last */
/* Fills in the set number i of mo_set_words. Returns the number of its environments. */
uint32_t mo_environment_set(int i, struct mo_environment environments[MO_SET_ENVIRONMENTS_MAX]);

/* The suites: "morpho-12", the selection sets of its twelve tasks, in order, and
 * "morpho-12-held-out", their held-out sets. All sets of a suite have the same number of
 * environments. */
#define MO_SUITE_TASKS            12
#define MO_SUITE_ENVIRONMENTS_MAX (MO_SUITE_TASKS * MO_SET_ENVIRONMENTS_MAX)
extern const char *const mo_suite_words[];      /* NULL after the last */
extern const char *const mo_suite_task_words[]; /* (MO_SUITE_TASKS), NULL after the last */
/* Returns the number of environments of all sets of suite number i of mo_suite_words; 0 if i is
 * negative. */
uint32_t mo_suite_environments(int i);
/* Returns the word of mo_set_words for a task of a suite. */
const char *mo_suite_set(int i, uint32_t task);

#ifdef __cplusplus
}
#endif
#endif
