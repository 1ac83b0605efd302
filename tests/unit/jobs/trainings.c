/* trainings.c: training runs with a fake back end, in which gradients are a function of robots and
 * weights: requests, results, order and exports. */
#include "fakes.h"
#include "jobs/held_out.h"

SERVICE_CASE(learns, 1)
{
  struct mo_training_request request = pretraining("walker");
  struct mo_training_step_row rows[STEPS + 1];
  struct mo_training_validation_row validations[10];
  struct mo_checkpoint_row checkpoints[10];
  struct mo_controller_record record;
  struct mo_event events[60];
  struct mo_held_out held_out;
  char *metadata = NULL;
  int progress;
  double seconds = -now_s();
  int64_t id = submit_training(&request);
  CHECK(learns_to(id, undisturbed()));
  seconds += now_s();
  CHECK_INT(job_of(id).steps_done, STEPS);
  CHECK_OK(mo_store_controller(store, "walker", &record));
  CHECK(mo_sha256_equal(&record.sha256, undisturbed()));
  CHECK_OK(mo_store_controller_metadata(store, undisturbed(), &metadata));
  CHECK(metadata != NULL && strstr(metadata, "\"morphod.version\":\"fake gradient\"") != NULL &&
        strstr(metadata, "\"morphod.parent\":\"random\"") != NULL);
  free(metadata);
  /* The curve has every step; validations occur at the requested steps, and at the first and the
   * last step. */
  CHECK_INT(mo_store_training_steps(store, id, 0, 1, rows, STEPS + 1), STEPS);
  CHECK(rows[0].report.step == 1 && rows[STEPS - 1].report.step == STEPS &&
        rows[0].report.rate > 0 && rows[0].report.mean_loss > 0 &&
        rows[0].report.clipped_share > 0);
  int64_t n = mo_store_training_validations(store, id, -1, validations, 10);
  CHECK_INT(n, 3);
  CHECK(validations[0].step == 0 && validations[1].step == 10 && validations[2].step == STEPS);
  for (int64_t i = 0; i < n; i++)
    CHECK(validations[i].rollouts == 60 && validations[i].mean_score > 0 &&
          validations[i].mean_score < 1);
  CHECK_INT(mo_store_checkpoints(store, id, checkpoints, 10), 2);
  CHECK(checkpoints[0].step == STEPS && checkpoints[1].step == 12);
  progress = count_events(id, "training.progress");
  CHECK(progress >= 5 &&
        progress <= 6 + seconds); /* before each checkpoint and validation, and one per second */
  n = mo_store_events(store, 0, id, events, 60, NULL, NULL);
  CHECK_TEXT(events[0].type, "job.created");
  CHECK_TEXT(events[1].type, "job.started");
  CHECK_TEXT(events[n - 1].type, "job.finished");
  struct mo_jobs_stats stats = idle_stats();
  CHECK_INT(stats.training_steps, STEPS);
  CHECK_INT(stats.training_robots, STEPS * BATCH);
  CHECK_INT(stats.training_checkpoints, 3);
  CHECK_INT(stats.training_validations, 3);
  CHECK_INT(stats.jobs_succeeded, 1);
  CHECK_INT(stats.open_jobs, 0);
  CHECK(await_phase(id, MO_PHASE_IDLE)); /* its thread ends a moment later */
  /* The validation set. */
  struct mo_training_status status = training_of(id);
  CHECK_OK(mo_held_out_load(store, &status, &held_out));
  CHECK(held_out.n_designs == 3 && held_out.n_environments == 20);
  mo_held_out_free(&held_out);
  CHECK_INT(status.step, STEPS);
  CHECK_INT(warnings, 0);
  CHECK_OK(check_whole());
}

/* Runs several training runs with a limit on how many run at once. Returns the order of their
 * steps. */
static size_t train(uint32_t side_by_side, int n, int64_t *ids, int64_t *tags)
{
  struct mo_training_request request = pretraining("");
  request.record.validate_every_steps = request.record.checkpoint_every_steps = 0;
  CHECK_OK(service_start(side_by_side));
  fake_plan.gradient_delay_us = 5000;
  for (int i = 0; i < n; i++)
    ids[i] = submit_training(&request);
  for (int i = 0; i < n; i++)
    CHECK(succeeds(ids[i], NULL));
  size_t n_steps = fake_history(tags, 4 * STEPS + 1);
  CHECK_INT(n_steps, n * STEPS);
  return n_steps;
}

static void takes_turns(void)
{
  int64_t ids[4], tags[4 * STEPS + 1];
#ifdef __SANITIZE_THREAD__ /* slow there */
  size_t n = train(1, 2, ids, tags);
#else
  size_t n = train(1, 4, ids, tags);
#endif
  int changes = 0;
  for (size_t i = 1; i < n; i++)
    CHECK(tags[i] >= tags[i - 1]);
  n = train(2, 3, ids, tags);
  for (size_t i = 1; i < n; i++) {
    changes += tags[i] != tags[i - 1];
    CHECK(i >= STEPS || tags[i] != ids[2]); /* the third waits for its turn */
  }
  CHECK(changes > STEPS / 2);
}

SERVICE_CASE(validates_as_an_evaluation_does, 1)
{
  struct mo_training_request request = pretraining("");
  struct mo_controller *controller = NULL;
  struct mo_held_out held_out;
  uint8_t *bytes = NULL;
  size_t size = 0;
  double scores[3], mean = 0, deviation = 0;
  uint32_t kept = 0, diverged = 0;
  int64_t id = submit_training(&request);
  CHECK(succeeds(id, NULL));
  struct mo_training_status status = training_of(id);
  struct mo_training_validation_row row = status.validation;
  REQUIRE_OK(mo_store_controller_bytes(store, &status.job.result_sha256, &bytes, &size));
  REQUIRE_OK(mo_controller_decode(bytes, size, &controller, NULL));
  REQUIRE_OK(mo_held_out_load(store, &status, &held_out));
  for (uint32_t d = 0; d < 3; d++) {
    uint32_t before = diverged;
    double sum = 0;
    for (uint32_t k = 0; k < 20; k++) {
      struct mo_outcome outcome =
          fake_outcome(held_out.genotypes[d].words, controller, &held_out.environments[k],
                       &request.record.settings.physics, MO_FLOAT32);
      diverged += outcome.diverged_step != 0;
      sum += outcome.loss;
    }
    if (diverged == before)
      scores[kept++] = sum / 20;
  }
  for (uint32_t d = 0; d < kept; d++)
    mean += scores[d] / kept;
  for (uint32_t d = 0; d < kept; d++)
    deviation += (scores[d] - mean) * (scores[d] - mean);
  CHECK_INT(row.step, STEPS);
  CHECK_INT(row.rollouts, 60);
  CHECK_INT(row.diverged, diverged);
  if (kept > 0)
    CHECK_NEAR(row.mean_score, mean, 1e-12);
  else
    CHECK(isnan(row.mean_score));
  if (kept > 1)
    CHECK_NEAR(row.standard_error, sqrt(deviation / (kept - 1) / kept), 1e-9);
  free(bytes);
  mo_controller_free(controller);
  mo_held_out_free(&held_out);
}

SERVICE_CASE(tunes_a_population, 1)
{
  struct mo_bits *best = NULL;
  struct mo_training_request request = pretraining("tuned");
  struct mo_held_out held_out;
  struct mo_job job;
  uint32_t n = 0;
  const struct mo_bits *genotypes = bodies(31, 30);
  int64_t scored = evaluate(genotypes, 30);
  CHECK(succeeds(scored, NULL));
  request.record.settings.kind = MO_TRAINING_FINETUNE;
  request.record.population = scored;
  request.population_best = 5;
  int64_t id = submit_training(&request);
  CHECK(succeeds(id, NULL));
  REQUIRE(mo_store_population(store, scored, 5, &best, &n) == MO_OK && n == 5);
  struct mo_sha256 expected =
      expect(&request, default_weights(), default_digits(), best, n, &one_code);
  CHECK(learns_to(id, &expected));
  struct mo_training_status status = training_of(id);
  CHECK(status.record.population == scored && status.record.n_designs == 5 &&
        status.job.has_controller);
  CHECK_TEXT(status.job.controller_name, "default");
  CHECK_OK(mo_held_out_load(store, &status, &held_out));
  CHECK(held_out.n_designs == 3 && memcmp(held_out.genotypes, best, 3 * sizeof(*best)) == 0);
  mo_held_out_free(&held_out);
  /* A finetuning run that starts from the result, on listed designs. */
  request.record.population = 0;
  request.parent = "tuned";
  request.genotypes = genotypes;
  request.record.n_designs = 7;
  snprintf(request.record.name, sizeof(request.record.name), "again");
  CHECK(succeeds(submit_training(&request), &job));
  CHECK(mo_sha256_equal(&job.controller_sha256, &expected));
  free(best);
}

static const struct check_case cases[] = {
    {"learns", learns},
    {"takes turns", takes_turns},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"validates as an evaluation does", validates_as_an_evaluation_does},
    {"tunes a population", tunes_a_population},
#endif
};
CHECK_MAIN(cases)
