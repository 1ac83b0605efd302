/* Gradients on devices: the same bits for any number of them, laid out ahead or not, however often
 * memory is short or one is lost. */
#include "devices_fixture.h"

#include <math.h>

struct gradient {
  int status;
  enum mo_back_end computed_on;
  double *d_parameters;
  struct mo_outcome *outcomes;
  struct mo_gradient_counts counts;
};

static struct gradient differentiate_with(struct mo_gradient_state *state,
                                          enum mo_back_end back_end, const volatile int *cancel)
{
  struct gradient gradient = {.d_parameters = calloc(controller->n_parameters, sizeof(double)),
                              .outcomes = calloc(ROBOTS, sizeof(struct mo_outcome))};
  struct mo_gradient_batch batch = {.controller = controller,
                                    .robots = robots,
                                    .n = ROBOTS,
                                    .physics = mo_default_physics(),
                                    .adjoint_bound = 0.01, /* each adjoint restarts at each step */
                                    .adjoint_rule = MO_ADJOINT_RESTART,
                                    .restart_weight = 2.5,
                                    .back_end = back_end,
                                    .cancel = cancel,
                                    .d_parameters = gradient.d_parameters,
                                    .outcomes = gradient.outcomes};
  batch.physics.n_steps = ROBOT_STEPS;
  gradient.status = mo_compute_gradient(state, &batch);
  gradient.computed_on = batch.computed_on;
  gradient.counts = batch.counts;
  return gradient;
}

static struct gradient differentiate(struct mo_compute *compute, enum mo_back_end back_end,
                                     const volatile int *cancel)
{
  struct mo_gradient_state *state = NULL;
  CHECK_INT(mo_gradient_state_create(compute, &state), MO_OK);
  const struct gradient gradient = differentiate_with(state, back_end, cancel);
  mo_gradient_state_free(state);
  return gradient;
}

static void free_gradient(struct gradient *gradient)
{
  free(gradient->d_parameters);
  free(gradient->outcomes);
}

static void expect_same(const struct gradient *a, const struct gradient *b)
{
  CHECK_INT(a->status, MO_OK);
  CHECK_INT(b->status, MO_OK);
  CHECK_INT(a->computed_on, b->computed_on);
  CHECK(memcmp(a->d_parameters, b->d_parameters, controller->n_parameters * sizeof(double)) == 0);
  CHECK(memcmp(a->outcomes, b->outcomes, ROBOTS * sizeof(*a->outcomes)) == 0);
  CHECK_INT(a->counts.robots, ROBOTS);
  CHECK(memcmp(&a->counts, &b->counts, sizeof(a->counts)) == 0);
}

static void gradients_do_not_depend_on_devices(void)
{
  static const struct {
    const char *n, *shards, *lose;
  } cases[] = {
      {"2", NULL, NULL}, {"4", NULL, NULL}, {"1", "1", NULL}, {"2", "1", NULL}, {"2", NULL, "1:1"}};
  REQUIRE(setup());
  struct mo_compute *compute = open_devices("1");
  struct gradient first = differentiate(compute, MO_ON_DEVICE, NULL);
  struct gradient on_workers = differentiate(compute, MO_ON_CPU, NULL);
  mo_compute_free(compute);
  CHECK_INT(first.computed_on, MO_ON_DEVICE);
  CHECK_INT(on_workers.computed_on, MO_ON_CPU);
  double dot = 0, a = 0, b = 0; /* other sums of the same */
  for (size_t i = 0; i < controller->n_parameters; i++) {
    dot += first.d_parameters[i] * on_workers.d_parameters[i];
    a += first.d_parameters[i] * first.d_parameters[i];
    b += on_workers.d_parameters[i] * on_workers.d_parameters[i];
  }
  CHECK(a > 0 && dot / sqrt(a * b) > 0.9999 && fabs(sqrt(a / b) - 1) < 1e-4);
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
    REQUIRE(setup());
    if (cases[i].shards != NULL)
      set("MORPHO_FAKE_SHARDS", cases[i].shards);
    if (cases[i].lose != NULL)
      set("MORPHO_FAKE_LOSE", cases[i].lose);
    compute = open_devices(cases[i].n);
    struct gradient other = differentiate(compute, MO_ON_DEVICE, NULL);
    expect_same(&first, &other);
    CHECK_INT(atomic_load(&n_lost), cases[i].lose != NULL);
    free_gradient(&other);
    mo_compute_free(compute);
  }
  REQUIRE(setup());
  set("MORPHO_FAKE_SPRINGS", "20"); /* some are larger: then the workers do all of it */
  compute = open_devices("2");
  struct gradient other = differentiate(compute, MO_ON_DEVICE, NULL);
  expect_same(&on_workers, &other);
  free_gradient(&other);
  mo_compute_free(compute);
  free_gradient(&first);
  free_gradient(&on_workers);
}

/* A batch that was laid out ahead, on so many devices, is computed from that, and gives the same;
 * what is forgotten or of other robots is not. */
static void gradients_are_laid_out_ahead(void)
{
  static struct mo_robot others[ROBOTS];
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = ROBOT_STEPS;
  REQUIRE(setup());
  struct mo_compute *compute = open_devices("1");
  struct gradient plain = differentiate(compute, MO_ON_DEVICE, NULL);
  mo_compute_free(compute);
  for (uint32_t i = 0; i < ROBOTS; i++)
    others[i] = robots[ROBOTS - 1 - i];
  for (uint32_t n = 1; n <= 3; n++) {
    const char number[] = {(char)('0' + n), 0};
    REQUIRE(setup());
    set("MORPHO_FAKE_HASTE", "1");
    set("MORPHO_FAKE_MEET", number); /* the parts are laid out at the same time */
    compute = open_devices(number);
    struct mo_gradient_state *state = NULL;
    REQUIRE(mo_gradient_state_create(compute, &state) == MO_OK);
    for (int i = 0; i < 3; i++) {
      CHECK_INT(mo_compute_gradient_lay_out(state, others, ROBOTS, &physics),
                MO_OK); /* the newest counts */
      CHECK_INT(mo_compute_gradient_lay_out(state, robots, ROBOTS, &physics), MO_OK);
      struct gradient ahead = differentiate_with(state, MO_ON_DEVICE, NULL);
      CHECK_INT(ahead.status, MO_OK);
      expect_same(&plain, &ahead);
      free_gradient(&ahead);
    }
    CHECK_INT(mo_compute_gradient_lay_out(state, robots, ROBOTS, &physics), MO_OK);
    mo_compute_gradient_forget(state);
    struct gradient forgotten = differentiate_with(state, MO_ON_DEVICE, NULL);
    CHECK_INT(forgotten.status,
              MO_ERR_INVALID); /* in haste the module takes nothing that is not laid out */
    CHECK_INT(mo_compute_gradient_lay_out(state, others, ROBOTS, &physics), MO_OK);
    struct gradient other = differentiate_with(state, MO_ON_DEVICE, NULL);
    CHECK_INT(other.status, MO_ERR_INVALID);
    CHECK_INT(mo_compute_gradient_lay_out(state, robots, 0, &physics), MO_ERR_RANGE);
    CHECK_INT(mo_compute_gradient_lay_out(state, NULL, ROBOTS, &physics), MO_ERR_INVALID);
    free_gradient(&forgotten);
    free_gradient(&other);
    mo_gradient_state_free(state);
    mo_compute_free(compute);
  }
  free_gradient(&plain);
}

static void gradients_say_what_failed(void)
{
  static const volatile int cancelled = 1;
  static const struct {
    const char *name, *value;
    const volatile int *cancel;
    int status;
  } cases[] = {{"MORPHO_FAKE_SHARDS", "0", NULL, MO_ERR_NO_MEMORY},
               {"MORPHO_FAKE_LOSE", "0:1", NULL, MO_ERR_DEVICE},
               {"MORPHO_FAKE_DELAY_MS", "1", &cancelled, MO_ERR_CANCELLED}};
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
    REQUIRE(setup());
    set(cases[i].name, cases[i].value);
    struct mo_compute *compute = open_devices("1");
    struct gradient gradient = differentiate(compute, MO_ON_DEVICE, cases[i].cancel);
    CHECK_INT(gradient.status, cases[i].status);
    free_gradient(&gradient);
    mo_compute_free(compute);
  }
  REQUIRE(setup());
  struct mo_compute *compute = open_devices(NULL);
  struct gradient gradient = differentiate(compute, MO_ON_DEVICE, NULL);
  CHECK_INT(gradient.status, MO_ERR_DEVICE);
  free_gradient(&gradient);
  mo_compute_free(compute);
}

static const struct check_case cases[] = {
    {"gradients do not depend on devices", gradients_do_not_depend_on_devices},
    {"gradients are laid out ahead", gradients_are_laid_out_ahead},
    {"gradients say what failed", gradients_say_what_failed},
};
CHECK_MAIN(cases)
