/* windows.c: rollouts that go on from a state: windows have the bits of the whole, whatever the
 * body, the task, the physics, the instruction set, and wherever they are cut. */
#include "lane-cases.h"
#include "objective-cases.h"
#include "task-cases.h"

#include <morpho/state.h>

static struct mo_lattice *lattice;
static struct mo_controller *controller;
static struct mo_robot *robots;
enum { BODIES = 6, WINDOWS = 4, STEPS_MAX = 160 };

static void setup(void)
{
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_shipped_controller("phototaxis");
  robots = make_robots(lattice, 5, 5, BODIES);
}

/* ---- draws ---- */

struct draw {
  const struct mo_body *body;
  struct mo_environment environments[LANES];
  const struct mo_environment *list[LANES];
  uint32_t n, n_windows, cuts[WINDOWS + 1]; /* of steps, from 0 to all */
  struct mo_physics physics;                /* of the whole */
  enum mo_isa isa;
  enum mo_precision precision;
  bool passive;
  uint32_t set; /* measures */
};

static void set_task(struct mo_environment *environment, uint32_t k)
{
  k %= TASK_CASES + OBJECTIVE_CASES + 4;
  if (k < TASK_CASES)
    environment->task = task_case(k);
  else if (k < TASK_CASES + OBJECTIVE_CASES)
    set_objective(environment, k - TASK_CASES);
  if (!mo_guide_has_light(&environment->task.guide))
    environment->light_xy_m[0] = environment->light_xy_m[1] = 0;
}

static void draw_environments(struct draw *d, uint64_t number)
{
  for (uint32_t l = 0; l < d->n; l++) {
    struct mo_random random = dice(71, 1 + l, number);
    struct mo_environment *environment = &d->environments[l];
    mo_environment_training(33, (uint32_t)number, l, environment);
    if (mo_random_below(&random, 3) == 0)
      set_profile(environment, number + l, 0.04);
    set_task(environment, (uint32_t)mo_random_below(&random, 1000));
    if (mo_random_below(&random, 3) == 0)
      environment->damage = (struct mo_damage){1 + (uint32_t)mo_random_below(&random, MO_OCTANTS),
                                               0.004 * (double)mo_random_below(&random, 150)};
    make_check(mo_environment_check(environment, NULL), "an environment");
    d->list[l] = environment;
  }
}

static void draw_cuts(struct draw *d, struct mo_random *random, uint32_t n_steps)
{
  d->n_windows = 2 + (uint32_t)mo_random_below(random, WINDOWS - 1);
  d->cuts[0] = 0;
  for (uint32_t w = 1; w < d->n_windows; w++) {
    const uint32_t left = n_steps - d->cuts[w - 1] - (d->n_windows - w);
    const uint32_t length =
        mo_random_below(random, 4) == 0 ? 1 : 1 + (uint32_t)mo_random_below(random, left / 2 + 1);
    d->cuts[w] = d->cuts[w - 1] + (length < left ? length : left);
  }
  d->cuts[d->n_windows] = n_steps;
}

static void draw(struct draw *d, uint64_t number)
{
  static const uint32_t periods[] = {0, 1, 2, 4, 7, 400};
  struct mo_random random = dice(71, 0, number);
  *d = (struct draw){.body = robots[mo_random_below(&random, BODIES)].body,
                     .n = number % 3 == 0 ? 1 : 1 + (uint32_t)mo_random_below(&random, LANES)};
  d->physics = number % 2 == 0 ? mo_default_physics() : mo_paper_physics();
  struct mo_scheme *scheme = &d->physics.scheme;
  scheme->n_steps = 12 + (uint32_t)mo_random_below(&random, STEPS_MAX - 12);
  scheme->control_period_s = scheme->dt_s * periods[mo_random_below(&random, COUNT(periods))];
  if (mo_random_below(&random, 3) == 0)
    scheme->impact = MO_IMPACT_BISECTION;
  d->physics.drop_height_m = mo_random_below(&random, 2) == 0 ? 0.05 : 0;
  d->precision = mo_random_below(&random, 2) == 0 ? MO_FLOAT32 : MO_FLOAT64;
  d->isa = (enum mo_isa)mo_random_below(&random, (uint64_t)mo_isa_best() + 1);
  d->passive = mo_random_below(&random, 8) == 0;
  d->set = mo_random_below(&random, 2) == 0
               ? 0
               : (uint32_t)mo_random_below(&random, MO_MEASURES_ALL) & MO_MEASURES_ALL;
  draw_environments(d, number);
  draw_cuts(d, &random, scheme->n_steps);
}

/* ---- rollouts of a draw ---- */

struct results {
  struct mo_outcome outcomes[LANES];
  double values[LANES][MO_MEASURES];
  struct mo_recording recordings[LANES];
};

static void drop_states(void *states)
{
  for (uint32_t l = 0; l < LANES; l++)
    mo_state_free((struct mo_state *)states + l);
  free(states);
}

static struct mo_state *make_states(const struct mo_body *body)
{
  struct mo_state *states = check_keep(calloc(LANES, sizeof(*states)), drop_states);
  for (uint32_t l = 0; l < LANES; l++)
    make_check(mo_state_create(&states[l], body->n_masses, body->n_springs, body->n_voxels),
               "a state");
  return states;
}

static void drop_results(void *results)
{
  struct results *r = results;
  for (uint32_t l = 0; l < LANES; l++)
    mo_recording_free(&r->recordings[l]);
  free(r);
}

static struct results *make_results(const struct draw *d, uint32_t frames)
{
  struct results *r = check_keep(calloc(1, sizeof(*r)), drop_results);
  for (uint32_t l = 0; l < d->n; l++)
    make_check(mo_recording_create(&r->recordings[l], (1U << MO_CHANNELS) - 1, 1, frames,
                                   d->body->n_masses, d->body->n_springs),
               "a recording");
  return r;
}

/* The recordings of a window, which begins at frame `frame` of the whole. */
static void shift(const struct draw *d, const struct results *r, uint32_t frame,
                  struct mo_recording recordings[LANES])
{
  const size_t n = d->body->n_masses, n_springs = d->body->n_springs;
  for (uint32_t l = 0; l < d->n; l++) {
    recordings[l] = r->recordings[l];
    recordings[l].com_m += (size_t)frame * 3;
    recordings[l].mass_m += (size_t)frame * 3 * n;
    recordings[l].contacts += (size_t)frame * n;
    recordings[l].actuation += (size_t)frame * n_springs;
  }
}

static bool is_same_recording(const struct draw *d, const struct mo_recording *a,
                              const struct mo_recording *b, size_t frames)
{
  const size_t n = d->body->n_masses, n_springs = d->body->n_springs;
  return SAME(a->com_m, b->com_m, frames * 3) && SAME(a->mass_m, b->mass_m, frames * 3 * n) &&
         SAME(a->contacts, b->contacts, frames * n) &&
         SAME(a->actuation, b->actuation, frames * n_springs);
}

/* Runs a window of lanes `first` … `first + n − 1`. */
static int run(const struct draw *d, const struct mo_pack *pack, uint32_t w,
               const struct mo_states *states, struct mo_recording *recordings, uint32_t first,
               uint32_t n, struct results *r)
{
  struct mo_physics physics = d->physics;
  const struct mo_measuring measuring = {d->set, r->values + first};
  const struct mo_states part = {states->from != NULL ? states->from + first : NULL,
                                 states->to != NULL ? states->to + first : NULL};
  physics.scheme.n_steps = d->cuts[w + 1] - d->cuts[w];
  return mo_rollout_block_window(make_workspace_memory(), pack, d->body, d->list + first, n,
                                 &physics, &part, recordings != NULL ? recordings + first : NULL,
                                 &measuring, NULL, r->outcomes + first);
}

static void check_draw(uint64_t number)
{
  const size_t kept = check_n_kept;
  struct draw *d = make_zeros(1, sizeof(*d));
  draw(d, number);
  const uint32_t n_steps = d->physics.scheme.n_steps;
  const struct mo_pack *pack = make_pack(d->passive ? NULL : controller, d->isa, d->precision);
  struct results *whole = make_results(d, n_steps + 1), *halves = make_results(d, n_steps + 1);
  struct mo_state *from = make_states(d->body), *to = make_states(d->body);
  struct mo_recording recordings[LANES];
  const struct mo_measuring measuring = {d->set, whole->values};
  REQUIRE_OK(mo_rollout_block(make_workspace_memory(), pack, d->body, d->list, d->n, &d->physics,
                              whole->recordings, &measuring, NULL, whole->outcomes));
  for (uint32_t w = 0; w < d->n_windows; w++) {
    const struct mo_states states = {w > 0 ? from : NULL,
                                     w + 1 < d->n_windows || w % 2 ? to : NULL};
    shift(d, halves, d->cuts[w], recordings);
    /* In one block, or in two. */
    const uint32_t first = number % 4 == 1 ? d->n / 2 : 0;
    if (first > 0)
      REQUIRE_OK(run(d, pack, w, &states, recordings, 0, first, halves));
    REQUIRE_OK(run(d, pack, w, &states, recordings, first, d->n - first, halves));
    /* The first frame is the last one of the window before: it was written over, so compare at
     * once. */
    for (uint32_t l = 0; l < d->n; l++)
      CHECK(
          is_same_recording(d, &whole->recordings[l], &halves->recordings[l], d->cuts[w + 1] + 1));
    struct mo_state *swap = from;
    from = to;
    to = swap;
  }
  CHECK(SAME(whole->outcomes, halves->outcomes, d->n));
  CHECK(d->set == 0 || SAME(whole->values, halves->values, d->n));
  for (uint32_t l = 0; l < d->n; l++)
    if (!SAME(&whole->outcomes[l], &halves->outcomes[l], 1))
      printf("# draw %u, lane %u: objective %u, guide %u: loss %.17g, in windows %.17g\n",
             (unsigned)number, l, d->environments[l].task.objective,
             d->environments[l].task.guide.kind, whole->outcomes[l].loss, halves->outcomes[l].loss);
  check_drop_to(kept);
}

static void whole_and_windows(void)
{
  for (uint64_t number = 0; number < 60; number++)
    check_draw(number);
}

/* ---- the reference ---- */

static void reference(void)
{
  for (uint64_t number = 100; number < 124; number++) {
    const size_t kept = check_n_kept;
    struct draw *d = make_zeros(1, sizeof(*d));
    draw(d, number);
    d->n = 1;
    const struct mo_controller *c = d->passive ? NULL : controller;
    struct results *whole = make_results(d, d->physics.scheme.n_steps + 1),
                   *halves = make_results(d, d->physics.scheme.n_steps + 1);
    struct mo_state *from = make_states(d->body), *to = make_states(d->body);
    struct mo_recording recordings[LANES];
    const struct mo_measuring measuring = {d->set, whole->values}, again = {d->set, halves->values};
    REQUIRE_OK(mo_rollout_reference(d->body, c, d->list[0], &d->physics, whole->recordings,
                                    &measuring, whole->outcomes));
    for (uint32_t w = 0; w < d->n_windows; w++) {
      const struct mo_states states = {w > 0 ? from : NULL, to};
      struct mo_physics physics = d->physics;
      physics.scheme.n_steps = d->cuts[w + 1] - d->cuts[w];
      shift(d, halves, d->cuts[w], recordings);
      REQUIRE_OK(mo_rollout_reference_window(d->body, c, d->list[0], &physics, &states, recordings,
                                             &again, halves->outcomes));
      struct mo_state *swap = from;
      from = to;
      to = swap;
    }
    CHECK(SAME(whole->outcomes, halves->outcomes, 1));
    CHECK(d->set == 0 || SAME(whole->values, halves->values, 1));
    CHECK(is_same_recording(d, &whole->recordings[0], &halves->recordings[0],
                            d->physics.scheme.n_steps + 1));
    check_drop_to(kept);
  }
}

/* From a state of the kernels the reference goes on as they do. */
static void reference_agrees(void)
{
  double worst = 0;
  for (uint64_t number = 200; number < 240; number++) {
    const size_t kept = check_n_kept;
    struct draw *d = make_zeros(1, sizeof(*d));
    draw(d, number);
    d->n = 1;
    d->precision = MO_FLOAT64;
    const struct mo_pack *pack = make_pack(d->passive ? NULL : controller, d->isa, d->precision);
    struct results *r = make_results(d, d->physics.scheme.n_steps + 1);
    struct mo_state *middle = make_states(d->body), *end = make_states(d->body);
    struct mo_outcome outcome;
    d->cuts[2] = d->cuts[1] + 40; /* short enough that rounding stays small */
    const struct mo_states first = {NULL, middle}, second = {middle, end};
    REQUIRE_OK(run(d, pack, 0, &first, NULL, 0, 1, r));
    REQUIRE_OK(run(d, pack, 1, &second, NULL, 0, 1, r));
    struct mo_physics physics = d->physics;
    physics.scheme.n_steps = 40;
    REQUIRE_OK(mo_rollout_reference_window(d->body, d->passive ? NULL : controller, d->list[0],
                                           &physics, &second, NULL, NULL, &outcome));
    CHECK_INT(outcome.diverged_step, r->outcomes[0].diverged_step);
    /* The straightness of a body that falls straight down is noise. */
    const double dx = outcome.com_end_m[0] - outcome.com_start_m[0],
                 dy = outcome.com_end_m[1] - outcome.com_start_m[1];
    if (outcome.diverged_step == 0 && hypot(dx, dy) > 1e-9) {
      CHECK_NEAR(outcome.value, r->outcomes[0].value, 1e-6 * (1 + fabs(outcome.value)));
      worst = fmax(worst, apart(&outcome, &r->outcomes[0]));
    }
    check_drop_to(kept);
  }
  printf("# at most %.1e from the kernels\n", worst);
  CHECK(worst < 1e-7);
}

/* A window without a controller leaves no outputs, whichever the state before had. */
static void passive_window(void)
{
  const struct mo_body *body = robots[0].body;
  const struct mo_environment *list[] = {robots[0].environment};
  const struct mo_pack *passive = make_pack(NULL, mo_isa_best(), MO_FLOAT64);
  struct mo_state *states = make_states(body), *fast = make_states(body),
                  *plain = make_states(body);
  const struct mo_states first = {NULL, states}, to_fast = {states, fast},
                         to_plain = {states, plain};
  struct mo_physics physics = mo_default_physics();
  struct mo_outcome outcome;
  physics.scheme.n_steps = 20;
  REQUIRE_OK(mo_rollout_reference_window(body, controller, list[0], &physics, &first, NULL, NULL,
                                         &outcome));
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), passive, body, list, 1, &physics,
                                     &to_fast, NULL, NULL, NULL, &outcome));
  REQUIRE_OK(
      mo_rollout_reference_window(body, NULL, list[0], &physics, &to_plain, NULL, NULL, &outcome));
  double had = 0;
  for (uint32_t s = 0; s < body->n_springs; s++) {
    had += fabs(states[0].output[s]);
    CHECK(fast[0].output[s] == 0 && plain[0].output[s] == 0);
  }
  CHECK(had > 0);
}

/* ---- what may change, and what must not ---- */

static const struct mo_environment *light_at(struct mo_environment *environment, double x_m,
                                             double y_m)
{
  environment->light_xy_m[0] = x_m;
  environment->light_xy_m[1] = y_m;
  return environment;
}

/* A light that moves between two windows: the body turns to it, and the loss is measured from the
 * start and to where the light stands now. */
static void moved_light(void)
{
  struct mo_environment near = *robots[0].environment, far = near;
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  const struct mo_environment *list[] = {light_at(&near, 4.0, 2.5)},
                              *other[] = {light_at(&far, 1.0, 2.0)};
  struct mo_state *states = make_states(robots[0].body), *ends = make_states(robots[0].body);
  const struct mo_states first = {NULL, states}, second = {states, ends};
  struct mo_physics physics = mo_default_physics();
  struct mo_outcome a, b, c;
  physics.scheme.n_steps = 300;
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, robots[0].body, list, 1,
                                     &physics, &first, NULL, NULL, NULL, &a));
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, robots[0].body, list, 1,
                                     &physics, &second, NULL, NULL, NULL, &b));
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, robots[0].body, other, 1,
                                     &physics, &second, NULL, NULL, NULL, &c));
  CHECK(c.com_end_m[0] < b.com_end_m[0]);
  CHECK(SAME(c.com_start_m, a.com_start_m, 3));
  CHECK_NEAR(c.loss,
             hypot(c.com_end_m[0] - 1.0, c.com_end_m[1] - 2.0) /
                 hypot(c.com_start_m[0] - 1.0, c.com_start_m[1] - 2.0),
             1e-7);
  CHECK_INT(ends[0].step, 600);
}

/* A new task begins where the body is. */
static void new_task(void)
{
  struct mo_environment plain = *robots[1].environment;
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT64);
  struct mo_physics physics = mo_default_physics();
  physics.scheme.n_steps = 50; /* within a control period */
  for (uint32_t k = 0; k < TASK_CASES + OBJECTIVE_CASES; k++) {
    const size_t kept = check_n_kept;
    struct mo_state *states = make_states(robots[1].body), *ends = make_states(robots[1].body);
    struct mo_environment task = plain;
    set_task(&task, k);
    memcpy(task.terrain_heights_m, plain.terrain_heights_m, sizeof(plain.terrain_heights_m));
    const struct mo_environment *list[] = {&plain}, *then[] = {&task};
    const struct mo_states first = {NULL, states}, second = {states, ends};
    struct mo_outcome a, b, exact;
    double com_m[3] = {0, 0, 0};
    REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, robots[1].body, list, 1,
                                       &physics, &first, NULL, NULL, NULL, &a));
    REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, robots[1].body, then, 1,
                                       &physics, &second, NULL, NULL, NULL, &b));
    REQUIRE_OK(mo_rollout_reference_window(robots[1].body, controller, &task, &physics, &second,
                                           NULL, NULL, &exact));
    CHECK_NEAR(b.value, exact.value, 1e-8 * (1 + fabs(exact.value)));
    for (uint32_t m = 0; m < robots[1].body->n_masses; m++)
      for (int axis = 0; axis < 3; axis++)
        com_m[axis] += states[0].position_m[3 * m + (uint32_t)axis] / robots[1].body->n_masses;
    for (int axis = 0; axis < 3; axis++)
      CHECK_NEAR(b.com_start_m[axis], com_m[axis], 1e-12);
    CHECK_INT(ends[0].tally.begun_step, 50);
    CHECK_INT(ends[0].step, 100);
    check_drop_to(kept);
  }
}

/* Springs that damage has cut stay cut, also without the damage. */
static void lasting_damage(void)
{
  struct mo_environment broken = *robots[2].environment, whole = broken;
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  const struct mo_environment *list[] = {&broken}, *then[] = {&whole};
  struct mo_state *states = make_states(robots[2].body), *ends = make_states(robots[2].body);
  const struct mo_states first = {NULL, states}, second = {states, ends};
  struct mo_physics physics = mo_default_physics();
  struct mo_outcome a, b, c;
  physics.scheme.n_steps = 100;
  broken.damage = (struct mo_damage){1 + 7, 0.1};
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, robots[2].body, list, 1,
                                     &physics, &first, NULL, NULL, NULL, &a));
  CHECK(memchr(states[0].cut, 1, states[0].n_springs) != NULL);
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, robots[2].body, then, 1,
                                     &physics, &second, NULL, NULL, NULL, &b));
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, robots[2].body, list, 1,
                                     &physics, &second, NULL, NULL, NULL, &c));
  CHECK(SAME(&b, &c, 1));
  CHECK(SAME(states[0].cut, ends[0].cut, states[0].n_springs));
}

static void refusals(void)
{
  const struct mo_body *body = robots[3].body;
  const struct mo_environment environment = *robots[3].environment;
  struct mo_environment path = environment;
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  const struct mo_environment *list[] = {&environment};
  struct mo_state *states = make_states(body), *ends = make_states(body);
  const struct mo_states first = {NULL, states};
  struct mo_physics physics = mo_default_physics(), other = physics;
  struct mo_outcome outcome;
  struct mo_message message;
  physics.scheme.n_steps = other.scheme.n_steps = 20;
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, body, list, 1, &physics, &first,
                                     NULL, NULL, NULL, &outcome));
  struct mo_state s = states[0];
  CHECK_OK(mo_state_check(&s, body, &environment, &physics, MO_FLOAT32, &message));
  other.scheme.n_steps = 1;
  other.drop_height_m = 3;
  CHECK_OK(mo_state_check(&s, body, &environment, &other, MO_FLOAT32, &message));
  CHECK_INT(mo_state_check(&s, body, &environment, &physics, MO_FLOAT64, &message), MO_ERR_INVALID);
  CHECK_SAYS(message, "request that precision");
  CHECK_INT(mo_state_check(&s, robots[4].body, &environment, &physics, MO_FLOAT32, &message),
            MO_ERR_INVALID);
  CHECK_SAYS(message, "start the new body without a state");
  other = physics;
  other.constants.gravity_m_per_s2 = 9;
  CHECK_INT(mo_state_check(&s, body, &environment, &other, MO_FLOAT32, &message), MO_ERR_INVALID);
  CHECK_SAYS(message, "only n_steps");
  path.terrain_heights_m[7] += 0.01;
  CHECK_INT(mo_state_check(&s, body, &path, &physics, MO_FLOAT32, &message), MO_ERR_INVALID);
  CHECK_SAYS(message, "start a new world without a state");
  static const uint32_t times[] = {0, 1800001, UINT32_MAX};
  for (size_t i = 0; i < COUNT(times); i++) {
    s.step = times[i];
    CHECK_INT(mo_state_check(&s, body, &environment, &physics, MO_FLOAT32, &message), MO_ERR_RANGE);
  }
  s = states[0];
  /* Every number, with everything that it must not be. */
  const double wrong[] = {NAN, INFINITY, -INFINITY, 1e308, -1e308, 1e19};
  double *numbers[] = {s.position_m,
                       s.position_rest_m,
                       s.velocity_m_per_s,
                       s.output,
                       &s.tally.sum,
                       &s.tally.sums[3],
                       &s.tally.facing[1],
                       &s.tally.peak_m,
                       &s.tally.soft,
                       &s.tally.length_m,
                       &s.tally.path_m,
                       &s.tally.turns,
                       &s.tally.before_m,
                       &s.tally.along_m,
                       &s.tally.turn[0],
                       &s.tally.pull_m2,
                       &s.tally.com_m[1],
                       &s.tally.seen_com_m[2],
                       &s.tally.work_j,
                       &s.tally.strain,
                       &s.tally.com_start_m[0],
                       &s.tally.height_sum_m,
                       &s.tally.start_turn[1],
                       &s.tally.strain_square,
                       &s.tally.peak_height_m};
  for (size_t k = 0; k < COUNT(numbers); k++)
    for (size_t i = 0; i < COUNT(wrong); i++) {
      const double right = *numbers[k];
      *numbers[k] = wrong[i];
      CHECK_INT(mo_state_check(&s, body, &environment, &physics, MO_FLOAT32, &message),
                MO_ERR_RANGE);
      *numbers[k] = right;
    }
  /* A leg that the path does not have would be read outside the task. */
  s.tally.leg = 1;
  CHECK_INT(mo_state_check(&s, body, &environment, &physics, MO_FLOAT32, &message), MO_ERR_RANGE);
  s.tally = states[0].tally;
  s.tally.begun_step = 20;
  CHECK_INT(mo_state_check(&s, body, &environment, &physics, MO_FLOAT32, &message), MO_ERR_RANGE);
  s.tally = states[0].tally;
  /* Measures that were not observed before, and states at different times. */
  double values[2][MO_MEASURES];
  const struct mo_measuring measuring = {MO_MEASURES_ALL, values};
  const struct mo_states second = {states, ends};
  CHECK_INT(mo_rollout_block_window(make_workspace_memory(), pack, body, list, 1, &physics, &second,
                                    NULL, &measuring, NULL, &outcome),
            MO_ERR_INVALID);
  const struct mo_environment *two[] = {&environment, &environment};
  struct mo_outcome both[2];
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, body, two, 2, &physics, &first,
                                     NULL, NULL, NULL, both));
  states[1].step = 10;
  CHECK_INT(mo_rollout_block_window(make_workspace_memory(), pack, body, two, 2, &physics, &second,
                                    NULL, NULL, NULL, both),
            MO_ERR_INVALID);
}

/* A rollout that diverges leaves no state. */
static void diverged(void)
{
  const struct mo_body *body = robots[0].body;
  const struct mo_environment *list[] = {robots[0].environment};
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  struct mo_state *states = make_states(body);
  const struct mo_states to = {NULL, states}, from = {states, NULL};
  struct mo_physics physics = mo_paper_physics();
  struct mo_outcome outcome;
  physics.constants.stiffness_n_per_m = 1e6;
  REQUIRE_OK(mo_rollout_block_window(make_workspace_memory(), pack, body, list, 1, &physics, &to,
                                     NULL, NULL, NULL, &outcome));
  CHECK(outcome.diverged_step > 0);
  CHECK_INT(states[0].step, 0);
  CHECK_INT(mo_rollout_block_window(make_workspace_memory(), pack, body, list, 1, &physics, &from,
                                    NULL, NULL, NULL, &outcome),
            MO_ERR_RANGE);
}

static const struct check_case cases[] = {
    {"windows have the bits of the whole", whole_and_windows},
    {"also those of the reference", reference},
    {"the reference goes on from states of the kernels", reference_agrees},
    {"a window without a controller leaves no outputs", passive_window},
    {"a light that moves between windows", moved_light},
    {"a new task begins where the body is", new_task},
    {"springs stay cut", lasting_damage},
    {"states that do not fit are refused", refusals},
    {"a rollout that diverged leaves no state", diverged},
};
CHECK_MAIN_WITH(setup, cases)
