/* train.c: a tiny training run with real gradients: three designs, 80 time steps, 10 steps of
 * learning. The mean loss of all its robots must decrease, and an interrupted training run must end
 * with the same bytes. */
#include "fixture.h"

enum { DESIGNS = 3, STEPS = 10, BATCH = 4 };

/* Returns the mean loss of the robots of all steps with these weights. */
static double loss_of(const struct mo_controller *controller,
                      const struct mo_body *const bodies[DESIGNS], const struct mo_physics *physics)
{
  double sum = 0.0;
  for (uint32_t step = 0; step < STEPS; step++)
    for (uint32_t i = 0; i < BATCH; i++) {
      struct mo_environment environment;
      struct mo_outcome outcome = {.loss = NAN};
      mo_environment_training(1, step, i, &environment);
      mo_rollout_reference(bodies[(step * BATCH + i) % DESIGNS], controller, &environment, physics,
                           NULL, NULL, &outcome);
      sum += outcome.loss / (STEPS * BATCH);
    }
  return sum;
}

static struct mo_training *begin(void)
{
  struct mo_training_settings settings = mo_training_defaults(MO_TRAINING_FINETUNE);
  settings.n_steps = STEPS;
  settings.batch = BATCH;
  settings.physics.scheme.n_steps = 80;
  settings.learning.schedule = mo_schedule_presets[MO_SCHEDULE_ONE_COSINE];
  settings.learning.schedule.warmup_steps = 2;
  return finetuning(&settings, DESIGNS, 1.0F);
}

static int learn(struct mo_training *training, struct made_up *made_up, bool save)
{
  const struct mo_training_settings *settings = mo_training_settings_of(training);
  struct mo_gradient_options options = settings->learning.gradient;
  const struct mo_robot *robots;
  int r = mo_training_draw(training, NULL, NULL, &robots);
  options.weight = 1.0 / settings->batch;
  memset(made_up->gradient, 0, made_up->n * sizeof(double));
  made_up->counts = (struct mo_gradient_counts){0};
  for (uint32_t i = 0; i < settings->batch && r == MO_OK; i++)
    r = mo_gradient_reference(robots[i].body, mo_training_controller(training),
                              robots[i].environment, &settings->physics, &options,
                              &made_up->outcomes[i], made_up->gradient, &made_up->counts);
  struct mo_training_report report = {0};
  if (r == MO_OK)
    r = apply(training, made_up, &report);
  if (save)
    printf("# step %u: loss %.6f, gradient norm %.3g, rate %.3g\n", report.step, report.mean_loss,
           report.gradient_norm, report.rate);
  return report.skipped ? MO_ERR_INVALID : r;
}

static void learns(void)
{
  struct mo_training *training = begin(), *again = begin();
  const struct mo_body *bodies[DESIGNS];
  uint64_t designs[DESIGNS * MO_DEFAULT_WORDS];
  struct made_up *made_up = make_made_up(training);
  REQUIRE(mo_held_out_designs(1, DESIGNS, designs) == MO_OK);
  struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  for (int i = 0; i < DESIGNS; i++)
    bodies[i] = make_body(lattice, designs + (size_t)MO_DEFAULT_WORDS * i);
  const struct mo_physics *physics = &mo_training_settings_of(training)->physics;
  const double before = loss_of(mo_training_controller(training), bodies, physics);
  for (uint32_t step = 0; step < STEPS; step++) {
    REQUIRE(learn(training, made_up, true) == MO_OK);
    if (step == 4) /* the second one is interrupted */
      again = decoded(encoded(again));
    REQUIRE(learn(again, made_up, false) == MO_OK);
  }
  const double after = loss_of(mo_training_controller(training), bodies, physics);
  printf("# loss of all %d robots: %.6f before, %.6f after\n", STEPS * BATCH, before, after);
  CHECK(after < before - 0.001);
  CHECK(same_state(training, again));
}

static const struct check_case cases[] = {{"a tiny training lowers its loss", learns}};
CHECK_MAIN(cases)
