/* trainings.c: trainings with a fake back end, whose gradients are a function of robots and
 * weights: what they ask for, do and leave. */
#include "jobs/held_out.h"
#include "learning.h"

static void learns(void)
{
  struct service service;
  struct mo_training_request request = pretraining("walker");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_status status;
  struct mo_training_step_row rows[STEPS + 1];
  struct mo_training_validation_row validations[10];
  struct mo_checkpoint_row checkpoints[10];
  struct mo_controller_record record;
  struct mo_event events[60];
  struct mo_jobs_stats stats;
  struct mo_live live;
  struct mo_held_out held_out;
  struct mo_job job;
  char *metadata = NULL;
  int progress = 0;
  int64_t id, n;
  double seconds = -now_s();
  REQUIRE(start(&service, 1) == MO_OK);
  id = submit(&service, &request);
  REQUIRE(id > 0 && await_end(service.jobs, id, 30000, &job) == MO_OK);
  seconds += now_s();
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.steps_done, STEPS);
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(mo_store_controller(service.fixture.store, "walker", &record), MO_OK);
  CHECK(mo_sha256_equal(&record.sha256, &expected));
  CHECK_INT(mo_store_controller_metadata(service.fixture.store, &expected, &metadata), MO_OK);
  CHECK(metadata != NULL && strstr(metadata, "\"morphod.version\":\"fake gradient\"") != NULL &&
        strstr(metadata, "\"morphod.parent\":\"random\"") != NULL);
  free(metadata);
  /* The curve has every step, the validations those that were asked for, with the first and the
   * last. */
  CHECK_INT(mo_store_training_steps(service.fixture.store, id, 0, 1, rows, STEPS + 1), STEPS);
  CHECK(rows[0].report.step == 1 && rows[STEPS - 1].report.step == STEPS &&
        rows[0].report.rate > 0 && rows[0].report.mean_loss > 0 &&
        rows[0].report.clipped_share > 0);
  n = mo_store_training_validations(service.fixture.store, id, -1, validations, 10);
  CHECK_INT(n, 3);
  CHECK(validations[0].step == 0 && validations[1].step == 10 && validations[2].step == STEPS);
  for (int64_t i = 0; i < n; i++)
    CHECK(validations[i].rollouts == 60 && validations[i].mean_score > 0 &&
          validations[i].mean_score < 1);
  CHECK_INT(mo_store_checkpoints(service.fixture.store, id, checkpoints, 10), 2);
  CHECK(checkpoints[0].step == STEPS && checkpoints[1].step == 12);
  n = mo_store_events(service.fixture.store, 0, id, events, 60, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    progress += strcmp(events[i].type, "training.progress") == 0;
  CHECK(progress >= 5 &&
        progress <= 6 + seconds); /* before each checkpoint and validation, and one per second */
  CHECK_TEXT(events[0].type, "job.created");
  CHECK_TEXT(events[1].type, "job.started");
  CHECK_TEXT(events[n - 1].type, "job.finished");
  stats = idle_stats(&service);
  CHECK_INT(stats.training_steps, STEPS);
  CHECK_INT(stats.training_robots, STEPS * BATCH);
  CHECK_INT(stats.training_checkpoints, 3);
  CHECK_INT(stats.training_validations, 3);
  CHECK_INT(stats.jobs_succeeded, 1);
  CHECK_INT(stats.open_jobs, 0);
  CHECK(await_phase(&service, id, MO_PHASE_IDLE, &live)); /* its thread follows in a moment */
  /* What it was validated on. */
  CHECK_INT(mo_store_training(service.fixture.store, id, &status), MO_OK);
  CHECK_INT(mo_held_out_load(service.fixture.store, &status, &held_out), MO_OK);
  CHECK(held_out.n_designs == 3 && held_out.n_environments == 20);
  mo_held_out_free(&held_out);
  CHECK_INT(status.step, STEPS);
  CHECK_INT(warnings, 0);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  service_end(&service);
}

static void takes_turns(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_job job;
  int64_t ids[4], tags[4 * STEPS + 1], last = 0;
  size_t n;
  int changes = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  request.record.validate_every_steps = request.record.checkpoint_every_steps = 0;
  for (int i = 0; i < 4; i++)
    ids[i] = submit(&service, &request);
  for (int i = 0; i < 4; i++)
    REQUIRE(await_end(service.jobs, ids[i], 30000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  n = fake_history(tags, 4 * STEPS + 1);
  CHECK_INT(n, 4 * STEPS);
  for (size_t i = 0; i < n; i++) {
    CHECK(tags[i] >= last);
    last = tags[i];
  }
  service_close(&service);
  /* Two at a time. */
  service.config.max_active_trainings = 2;
  REQUIRE(service_open(&service) == MO_OK);
  fake_forget();
  fake_plan.gradient_delay_us = 5000;
  for (int i = 0; i < 3; i++)
    ids[i] = submit(&service, &request);
  for (int i = 0; i < 3; i++)
    REQUIRE(await_end(service.jobs, ids[i], 30000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  n = fake_history(tags, 3 * STEPS);
  for (size_t i = 1; i < n; i++) {
    changes += tags[i] != tags[i - 1];
    CHECK(i >= STEPS || tags[i] != ids[2]); /* the third waits for a place */
  }
  CHECK(changes > STEPS / 2);
  service_end(&service);
}

__attribute__((unused)) static void validates_as_an_evaluation_does(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_training_validation_row row;
  struct mo_training_status status;
  struct mo_controller *controller = NULL;
  struct mo_held_out held_out;
  uint8_t *bytes = NULL;
  size_t size = 0;
  double scores[3], mean = 0, deviation = 0;
  uint32_t kept = 0, diverged = 0;
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  id = submit(&service, &request);
  REQUIRE(id > 0 && await_end(service.jobs, id, 30000, &job) == MO_OK);
  REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK && status.has_result);
  row = status.validation;
  REQUIRE(mo_store_controller_bytes(service.fixture.store, &status.result_sha256, &bytes, &size) ==
          MO_OK);
  REQUIRE(mo_controller_decode(bytes, size, &controller, NULL) == MO_OK);
  REQUIRE(mo_held_out_load(service.fixture.store, &status, &held_out) == MO_OK);
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
  service_end(&service);
}

__attribute__((unused)) static void tunes_a_population(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes, *best = NULL;
  struct mo_evaluation_request evaluation;
  struct mo_training_request request = pretraining("tuned");
  struct mo_training_status status;
  struct mo_controller_record record;
  struct mo_held_out held_out;
  struct mo_sha256 expected;
  char digits[MO_SHA256_DIGITS + 1];
  struct mo_job job;
  int64_t scored, id;
  uint32_t n = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  REQUIRE(fixture_bodies(31, 30, &forms, &genotypes) == MO_OK);
  evaluation = service_request(genotypes, 30);
  scored = service_submit(&service, &evaluation);
  REQUIRE(await_end(service.jobs, scored, 30000, &job) == MO_OK);
  request.record.settings.kind = MO_TRAINING_FINETUNE;
  request.population = scored;
  request.population_best = 5;
  id = submit(&service, &request);
  REQUIRE(id > 0 && await_end(service.jobs, id, 30000, &job) == MO_OK);
  REQUIRE(mo_store_population(service.fixture.store, scored, 5, &best, &n) == MO_OK && n == 5);
  REQUIRE(mo_store_controller(service.fixture.store, "default", &record) == MO_OK);
  mo_sha256_to_hex(&record.sha256, digits);
  REQUIRE(expect(&request, default_weights(), digits, best, n, &one_code, &expected));
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(mo_store_training(service.fixture.store, id, &status), MO_OK);
  CHECK(status.record.population == scored && status.record.n_designs == 5 &&
        status.record.has_parent);
  CHECK_TEXT(status.record.parent_name, "default");
  CHECK_INT(mo_held_out_load(service.fixture.store, &status, &held_out), MO_OK);
  CHECK(held_out.n_designs == 3 && memcmp(held_out.genotypes, best, 3 * sizeof(*best)) == 0);
  mo_held_out_free(&held_out);
  /* From the result, on designs that are listed. */
  request.population = 0;
  request.parent = "tuned";
  request.genotypes = genotypes;
  request.record.n_designs = 7;
  snprintf(request.record.name, sizeof(request.record.name), "again");
  id = submit(&service, &request);
  REQUIRE(id > 0 && await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK(mo_sha256_equal(&job.controller_sha256, &expected));
  free(best);
  free(forms);
  free(genotypes);
  service_end(&service);
}

__attribute__((unused)) static void refuses(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes, apart = {{0x8001}};
  struct mo_training_request request = pretraining(""), bad;
  struct mo_message *message = &service.fixture.message;
  int64_t id = 0, again = 0;
  bool replayed = false;
  REQUIRE(start(&service, 1) == MO_OK);
  service_close(&service);
  service.config.max_open_jobs = 1;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(9, 4, &forms, &genotypes) == MO_OK);
  fake_plan.gradient_delay_us = 1000000;
  request.idempotency_key = "k";
  CHECK_INT(mo_jobs_submit_training(service.jobs, &request, &id, &replayed, message), MO_OK);
  CHECK_INT(mo_jobs_submit_training(service.jobs, &request, &again, &replayed, message), MO_OK);
  CHECK(replayed && again == id);
  mo_sha256_of("x", 1, &request.body_sha256);
  CHECK_INT(mo_jobs_submit_training(service.jobs, &request, &again, &replayed, message),
            MO_ERR_CONFLICT);
  bad = pretraining("");
  CHECK_INT(mo_jobs_submit_training(service.jobs, &bad, &again, &replayed, message), MO_ERR_BUSY);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  bad.record.settings.batch = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_RANGE);
  bad = pretraining("");
  bad.record.settings.n_steps = 1000000000;
  CHECK_INT(submit(&service, &bad), MO_ERR_RANGE);
  bad = pretraining("");
  bad.record.settings.learning.schedule.peak = -1;
  CHECK(submit(&service, &bad) < 0);
  bad = pretraining("No Name");
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  bad = pretraining("");
  bad.record.checkpoints_kept = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_RANGE);
  bad = pretraining("");
  bad.record.settings.held_out_designs = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  bad = pretraining("");
  bad.parent = "nobody";
  CHECK_INT(submit(&service, &bad), MO_ERR_NOT_FOUND);
  CHECK(strstr(message->text, "controller \"nobody\"") != NULL);
  bad = pretraining("");
  bad.genotypes = genotypes;
  bad.record.n_designs = 2;
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  bad.record.settings.kind = MO_TRAINING_FINETUNE;
  bad.population = 77;
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  bad.record.n_designs = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_NOT_FOUND);
  CHECK(strstr(message->text, "population 77") != NULL);
  bad.population = id; /* a training */
  CHECK_INT(submit(&service, &bad), MO_ERR_NOT_FOUND);
  bad.population = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_RANGE);
  bad.genotypes = &apart;
  bad.record.n_designs = 1;
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
  bad = pretraining("");
  CHECK_INT(submit(&service, &bad), MO_ERR_CANCELLED);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static const struct check_case cases[] = {
    {"learns", learns},
    {"takes turns", takes_turns},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"validates as an evaluation does", validates_as_an_evaluation_does},
    {"tunes a population", tunes_a_population},
    {"refuses", refuses},
#endif
};
CHECK_MAIN(cases)
