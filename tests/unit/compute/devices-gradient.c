/* Gradients on devices: the same bits for any number of devices, laid out ahead or not, no matter
 * how often memory is short or a device is lost. */
#include "devices_fixture.h"

#include <unistd.h>

/* Sanitizers see the same code in fewer runs. */
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define LESS true
#else
#define LESS false
#endif

struct gradient {
  int status;
  enum mo_back_end computed_on;
  double *d_parameters;
  struct mo_outcome *outcomes;
  struct mo_gradient_counts counts;
};

/* Each adjoint restarts at each step. */
static const struct mo_gradient_options restarts = {
    .adjoint_bound = 0.01, .adjoint_rule = MO_ADJOINT_RESTART, .restart_weight = 2.5};

static struct gradient differentiate_with(struct mo_gradient_state *state,
                                          enum mo_back_end back_end, const volatile int *cancel)
{
  struct gradient gradient = {.d_parameters = make_zeros(controller->n_parameters, sizeof(double)),
                              .outcomes = make_zeros(ROBOTS, sizeof(struct mo_outcome))};
  struct mo_gradient_batch batch = {.controller = controller,
                                    .robots = robots,
                                    .n = ROBOTS,
                                    .physics = mo_paper_physics(),
                                    .options = restarts,
                                    .back_end = back_end,
                                    .cancel = cancel,
                                    .d_parameters = gradient.d_parameters,
                                    .outcomes = gradient.outcomes};
  batch.physics.scheme.n_steps = ROBOT_STEPS;
  gradient.status = mo_compute_gradient(state, &batch);
  gradient.computed_on = batch.computed_on;
  gradient.counts = batch.counts;
  return gradient;
}

/* Computes on a separate back end. */
static struct gradient differentiate(const char *devices, enum mo_back_end back_end,
                                     const volatile int *cancel)
{
  struct mo_compute *compute = check_take(open_devices(devices));
  struct mo_gradient_state *state = NULL;
  make_check(mo_gradient_state_create(compute, &state), "gradients");
  const struct gradient gradient = differentiate_with(state, back_end, cancel);
  mo_gradient_state_free(state);
  mo_compute_free(compute);
  return gradient;
}

static void expect_same(const struct gradient *a, const struct gradient *b)
{
  CHECK_INT(a->status, MO_OK);
  CHECK_INT(b->status, MO_OK);
  CHECK_INT(a->computed_on, b->computed_on);
  CHECK(SAME(a->d_parameters, b->d_parameters, controller->n_parameters));
  CHECK(SAME(a->outcomes, b->outcomes, ROBOTS));
  CHECK_INT(a->counts.robots, ROBOTS);
  CHECK(SAME(&a->counts, &b->counts, 1));
}

static void gradients_do_not_depend_on_devices(void)
{
  static const struct {
    const char *n, *shards, *lose;
  } cases[] = {
      {"2", NULL, NULL}, {"4", NULL, NULL}, {"1", "1", NULL}, {"2", "1", NULL}, {"2", NULL, "1:1"}};
  reset();
  struct gradient first = differentiate("1", MO_ON_DEVICE, NULL);
  struct gradient on_workers = differentiate("1", MO_ON_CPU, NULL);
  CHECK_INT(first.computed_on, MO_ON_DEVICE);
  CHECK_INT(on_workers.computed_on, MO_ON_CPU);
  double ratio; /* the same robots in another order of sums */
  CHECK(cosine_of(first.d_parameters, on_workers.d_parameters, controller->n_parameters, &ratio) >
            0.9999 &&
        fabs(ratio - 1) < 1e-4);
  for (size_t i = 0; i < COUNT(cases); i++) {
    reset();
    if (cases[i].shards != NULL)
      set("MORPHO_FAKE_SHARDS", cases[i].shards);
    if (cases[i].lose != NULL)
      set("MORPHO_FAKE_LOSE", cases[i].lose);
    struct gradient other = differentiate(cases[i].n, MO_ON_DEVICE, NULL);
    expect_same(&first, &other);
    CHECK_INT(atomic_load(&n_lost), cases[i].lose != NULL);
  }
  reset();
  set("MORPHO_FAKE_SPRINGS", "20"); /* some bodies are larger: then the workers compute all of it */
  struct gradient other = differentiate("2", MO_ON_DEVICE, NULL);
  expect_same(&on_workers, &other);
}

/* A batch that was laid out ahead, on n devices, is computed from that layout with the same result;
 * a layout that was forgotten or belongs to other robots is not used. */
static void gradients_are_laid_out_ahead(void)
{
  static struct mo_robot others[ROBOTS];
  const struct mo_physics physics = physics_of(ROBOT_STEPS);
  reset();
  struct gradient plain = differentiate("1", MO_ON_DEVICE, NULL);
  for (uint32_t i = 0; i < ROBOTS; i++)
    others[i] = robots[ROBOTS - 1 - i];
  for (uint32_t n = 1; n <= 3; n += LESS ? 2 : 1) {
    const char number[] = {(char)('0' + n), 0};
    reset();
    set("MORPHO_FAKE_HASTE", "1");
    set("MORPHO_FAKE_MEET", number); /* the parts are laid out at the same time */
    struct mo_compute *compute = open_devices(number);
    struct mo_gradient_state *state = make_gradient_state(compute);
    for (int i = 0; i < (LESS ? 2 : 3); i++) {
      /* Only the newest layout counts. */
      CHECK_INT(mo_compute_gradient_lay_out(state, others, ROBOTS, &physics), MO_OK);
      CHECK_INT(mo_compute_gradient_lay_out(state, robots, ROBOTS, &physics), MO_OK);
      struct gradient ahead = differentiate_with(state, MO_ON_DEVICE, NULL);
      CHECK_INT(ahead.status, MO_OK);
      expect_same(&plain, &ahead);
    }
    CHECK_INT(mo_compute_gradient_lay_out(state, robots, ROBOTS, &physics), MO_OK);
    mo_compute_gradient_forget(state);
    struct gradient forgotten = differentiate_with(state, MO_ON_DEVICE, NULL);
    /* The module now refuses whatever is not laid out. */
    CHECK_INT(forgotten.status, MO_ERR_INVALID);
    CHECK_INT(mo_compute_gradient_lay_out(state, others, ROBOTS, &physics), MO_OK);
    struct gradient other = differentiate_with(state, MO_ON_DEVICE, NULL);
    CHECK_INT(other.status, MO_ERR_INVALID);
    check_drop_from(compute);
  }
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
  for (size_t i = 0; i < COUNT(cases); i++) {
    reset();
    set(cases[i].name, cases[i].value);
    CHECK_INT(differentiate("1", MO_ON_DEVICE, cases[i].cancel).status, cases[i].status);
  }
  reset();
  CHECK_INT(differentiate(NULL, MO_ON_DEVICE, NULL).status, MO_ERR_DEVICE);
}

/* ---- devices of remote takers ---- */

/* Computes a shard like a taker, for devices that only takers have. */
enum answer { COMPUTE, RETURN, CANNOT, HOLD };

struct taker {
  struct mo_compute *from, *own;
  enum answer answer;
  int n;
  atomic_bool end;
};

static void compute_shard(struct taker *taker, struct mo_taken *taken)
{
  static struct mo_outcome results[MO_GRADIENT_SHARD];
  static double losses[MO_GRADIENT_SHARD];
  static uint32_t diverged[MO_GRADIENT_SHARD];
  struct mo_gradient_state *state = NULL;
  struct mo_gradient_batch part = *taken->shard;
  part.share = NULL;
  part.is_strict = true;
  part.d_parameters = calloc(controller->n_parameters, sizeof(double));
  part.outcomes = results;
  make_check(mo_gradient_state_create(taker->own, &state), "gradients");
  make_check(mo_compute_gradient(state, &part), "a shard");
  CHECK(part.computed_on == MO_ON_DEVICE && part.n <= MO_GRADIENT_SHARD);
  for (uint32_t i = 0; i < part.n; i++) {
    losses[i] = results[i].loss;
    diverged[i] = (uint32_t)results[i].diverged_step;
  }
  mo_compute_deliver(taker->from, taken,
                     &(struct mo_remote_result){.losses = losses,
                                                .diverged = diverged,
                                                .d_parameters = part.d_parameters,
                                                .counts = part.counts});
  mo_gradient_state_free(state);
  free(part.d_parameters);
}

static void *take_shards(void *argument)
{
  struct taker *taker = argument;
  while (!atomic_load(&taker->end)) {
    struct mo_taken *taken = mo_compute_take(taker->from, MO_ON_DEVICE, 1);
    if (taken == NULL) {
      usleep(1000);
      continue;
    }
    taker->n++;
    CHECK(taken->shard != NULL && taken->back_end == MO_ON_DEVICE);
    while (taker->answer == HOLD && !mo_taken_is_cancelled(taken))
      usleep(1000);
    if (taker->answer == COMPUTE)
      compute_shard(taker, taken);
    else if (taker->answer == CANNOT)
      mo_compute_keep(taker->from, taken);
    else
      mo_compute_put_back(taker->from, taken);
  }
  return NULL;
}

static void no_call(void *context)
{
  (void)context;
}

/* Computes the gradient of all robots on devices that only this taker has. */
static struct gradient differentiate_by(struct taker *taker, bool is_strict,
                                        const volatile int *cancel)
{
  struct gradient gradient = {.d_parameters = make_zeros(controller->n_parameters, sizeof(double)),
                              .outcomes = make_zeros(ROBOTS, sizeof(struct mo_outcome))};
  struct mo_compute_share *share = NULL;
  struct mo_gradient_state *state = NULL;
  pthread_t thread;
  taker->from = make_compute(2);
  make_check(mo_compute_expect_devices(taker->from), "devices");
  make_check(mo_compute_name_devices(taker->from, "scores", "gradients"), "their class");
  mo_compute_watch_remote(taker->from, no_call, NULL);
  make_check(mo_compute_share_create(taker->from, 1, &share), "a share");
  make_check(mo_gradient_state_create(taker->from, &state), "gradients");
  CHECK(pthread_create(&thread, NULL, take_shards, taker) == 0);
  struct mo_gradient_batch batch = {.controller = controller,
                                    .robots = robots,
                                    .n = ROBOTS,
                                    .physics = physics_of(ROBOT_STEPS),
                                    .options = restarts,
                                    .back_end = MO_ON_DEVICE,
                                    .is_strict = is_strict,
                                    .share = share,
                                    .cancel = cancel,
                                    .d_parameters = gradient.d_parameters,
                                    .outcomes = gradient.outcomes};
  gradient.status = mo_compute_gradient(state, &batch);
  gradient.computed_on = batch.computed_on;
  gradient.counts = batch.counts;
  atomic_store(&taker->end, true);
  pthread_join(thread, NULL);
  mo_gradient_state_free(state);
  mo_compute_share_free(share);
  mo_compute_free(check_take(taker->from));
  return gradient;
}

static void *set_soon(void *flag)
{
  usleep(50000);
  __atomic_store_n((volatile int *)flag, 1, __ATOMIC_RELAXED);
  return NULL;
}

/* Takers compute the bits of devices. Work that they cannot compute goes to the workers, unless
 * that is an error; a shard that they keep returning is an error. */
static void gradients_on_devices_of_takers(void)
{
  static const uint64_t genotype;
  volatile int cancel = 0;
  pthread_t thread;
  reset();
  for (uint32_t i = 0; i < ROBOTS; i++)
    robots[i].genotype = &genotype;
  struct gradient plain = differentiate("1", MO_ON_DEVICE, NULL);
  struct gradient on_workers = differentiate("1", MO_ON_CPU, NULL);
  struct taker computes = {.own = open_devices("1")}, returns = {.answer = RETURN},
               cannot = {.answer = CANNOT}, refuses = {.answer = CANNOT}, holds = {.answer = HOLD};
  const struct gradient far = differentiate_by(&computes, false, NULL);
  CHECK(far.status == MO_OK && far.computed_on == MO_ON_DEVICE && computes.n == 3);
  CHECK(SAME(far.d_parameters, plain.d_parameters, controller->n_parameters));
  CHECK(SAME(&far.counts, &plain.counts, 1));
  for (uint32_t i = 0; i < ROBOTS; i++)
    CHECK(far.outcomes[i].loss == plain.outcomes[i].loss);
  CHECK_INT(differentiate_by(&returns, false, NULL).status, MO_ERR_DEVICE);
  CHECK(returns.n >= 32);
  struct gradient here = differentiate_by(&cannot, false, NULL);
  expect_same(&here, &on_workers);
  CHECK_INT(differentiate_by(&refuses, true, NULL).status, MO_ERR_UNSUPPORTED);
  REQUIRE(pthread_create(&thread, NULL, set_soon, (void *)&cancel) == 0);
  CHECK_INT(differentiate_by(&holds, false, &cancel).status, MO_ERR_CANCELLED);
  pthread_join(thread, NULL);
}

static const struct check_case cases[] = {
    {"gradients do not depend on devices", gradients_do_not_depend_on_devices},
    {"gradients are laid out ahead", gradients_are_laid_out_ahead},
    {"gradients report what failed", gradients_say_what_failed},
    {"gradients on devices of takers", gradients_on_devices_of_takers},
};
CHECK_MAIN_WITH(make_robots_of_designs, cases)
