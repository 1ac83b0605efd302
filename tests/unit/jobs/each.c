/* each.c: training runs of each design alone, with a fake back end: each design ends as a training
 * run of its own does, whatever interrupts the job, and the controllers that were requested are
 * kept. */
#include <limits.h>

#include "fakes.h"
#include "store/deletion.h"
#include "store/training_bodies.h"

#define N 5

static struct mo_training_request each_of(const struct mo_bits *genotypes, uint32_t n)
{
  struct mo_training_request request = pretraining("");
  struct mo_training_record *record = &request.record;
  record->settings.kind = MO_TRAINING_FINETUNE;
  record->settings.held_out_designs = 1;
  record->settings.held_out_environments = 3;
  record->validate_every_steps = STEPS;
  record->each = true;
  record->n_designs = n;
  request.genotypes = genotypes;
  return request;
}

/* Runs the design in a training run of its own, and returns what its row must be. */
static struct mo_training_body alone(const struct mo_bits *genotype)
{
  struct mo_training_request request = each_of(genotype, 1);
  struct mo_training_validation_row scores[3];
  struct mo_training_step_row steps[STEPS];
  struct mo_training_body body = {.position = 0};
  struct mo_job job;
  request.record.each = false;
  int64_t id = submit_training(&request);
  CHECK(succeeds(id, &job));
  CHECK_INT(mo_store_training_validations(store, id, -1, scores, 3), 2);
  CHECK_INT(mo_store_training_steps(store, id, 0, 1, steps, STEPS), STEPS);
  body.zero_shot = scores[0].mean_score;
  body.zero_shot_diverged = scores[0].diverged;
  body.finetuned = scores[1].mean_score;
  body.finetuned_diverged = scores[1].diverged;
  body.controller_sha256 = job.result_sha256;
  body.first_loss = steps[0].report.mean_loss;
  body.last_loss = steps[STEPS - 1].report.mean_loss;
  return body;
}

static bool same_body(const struct mo_training_body *a, const struct mo_training_body *b)
{
  return same_number(a->zero_shot, b->zero_shot) && same_number(a->finetuned, b->finetuned) &&
         a->zero_shot_diverged == b->zero_shot_diverged &&
         a->finetuned_diverged == b->finetuned_diverged &&
         same_number(a->first_loss, b->first_loss) && same_number(a->last_loss, b->last_loss) &&
         mo_sha256_equal(&a->controller_sha256, &b->controller_sha256);
}

static void check_rows(int64_t id, const struct mo_training_body *expected, uint32_t n)
{
  struct mo_training_body rows[N + 1];
  REQUIRE(mo_store_training_bodies(store, id, -1, rows, N + 1) == n);
  for (uint32_t i = 0; i < n; i++) {
    CHECK_INT(rows[i].position, i);
    CHECK(same_body(&rows[i], &expected[i]));
  }
}

/* Returns whether the controller has this name and these bytes. */
static bool is_stored(int64_t id, uint32_t position, const struct mo_training_body *body)
{
  struct mo_controller_record record;
  char name[64];
  uint8_t *bytes = NULL;
  size_t size = 0;
  snprintf(name, sizeof(name), "training-%lld-%u", (long long)id, (unsigned)position);
  const bool found = mo_store_controller(store, name, &record) == MO_OK &&
                     mo_sha256_equal(&record.sha256, &body->controller_sha256) &&
                     mo_store_controller_bytes(store, &record.sha256, &bytes, &size) == MO_OK;
  free(bytes);
  return found;
}

static bool has_file(const struct mo_training_body *body)
{
  char path[PATH_MAX];
  snprintf(path, sizeof(path), "%s/controllers/%s.safetensors", fixture.path,
           MO_SHA256_HEX(&body->controller_sha256));
  return access(path, F_OK) == 0;
}

SERVICE_CASE(learns_as_alone, 1)
{
  const struct mo_bits *genotypes = bodies(31, N);
  struct mo_training_body expected[N], rows[2];
  struct mo_training_step_row steps[N * STEPS];
  struct mo_checkpoint_row checkpoints[2];
  struct mo_training_request request = each_of(genotypes, N);
  request.record.keep = MO_KEEP_ALL;
  int64_t id = submit_training(&request);
  CHECK(succeeds(id, NULL));
  for (uint32_t i = 0; i < N; i++)
    expected[i] = alone(&genotypes[i]);
  check_rows(id, expected, N);
  struct mo_sha256 plain =
      expect(&request, default_weights(), default_digits(), &genotypes[2], 1, &one_code);
  CHECK(mo_sha256_equal(&plain, &expected[2].controller_sha256));
  for (uint32_t i = 0; i < N; i++)
    CHECK(is_stored(id, i, &expected[i]));
  /* Pages; steps are numbered consecutively; the checkpoints are gone. */
  CHECK_INT(mo_store_training_bodies(store, id, 2, rows, 2), 2);
  CHECK(rows[0].position == 3 && rows[0].is_kept &&
        memcmp(&rows[0].genotype, &genotypes[3], sizeof(rows[0].genotype)) == 0);
  CHECK_INT(mo_store_training_steps(store, id, 0, 1, steps, N * STEPS), N * STEPS);
  CHECK(steps[2 * STEPS].report.step == 2 * STEPS + 1 &&
        same_number(steps[2 * STEPS].report.mean_loss, expected[2].first_loss));
  CHECK_INT(mo_store_checkpoints(store, id, checkpoints, 2), 0);
  CHECK_INT(count_events(id, "training.body"), N);
  struct mo_training_status status = training_of(id);
  CHECK_INT(status.bodies_done, N);
  CHECK(status.job.steps_total == N * STEPS && status.step == N * STEPS && !status.job.has_result);
  CHECK_INT(warnings, 0);
  CHECK_OK(check_whole());
  /* Deletion leaves the controllers that have names. */
  struct mo_deleted deleted;
  CHECK_OK(mo_store_delete_job(store, id, &deleted, &fixture.message));
  CHECK(AWAIT(mo_store_training_bodies(store, id, -1, rows, 2) < 0));
  service_close();
  CHECK_INT(outside_integer("SELECT count(*) FROM jobs WHERE state<>6"), N);
  CHECK_OK(service_open());
  CHECK(is_stored(id, 1, &expected[1]));
}

/* Compares by score; NaN last. */
static bool is_better(const struct mo_training_body *a, const struct mo_training_body *b)
{
  return a->finetuned < b->finetuned || (isnan(b->finetuned) && !isnan(a->finetuned));
}

SERVICE_CASE(keeps_the_best, 1)
{
  const struct mo_bits *genotypes = bodies(31, N);
  struct mo_training_body rows[N];
  struct mo_training_request request = each_of(genotypes, N);
  uint32_t n_kept = 0;
  request.record.keep_best = 2;
  int64_t id = submit_training(&request);
  CHECK(succeeds(id, NULL));
  REQUIRE(mo_store_training_bodies(store, id, -1, rows, N) == N);
  for (uint32_t i = 0; i < N; i++) {
    uint32_t better = 0;
    for (uint32_t k = 0; k < N; k++)
      better += is_better(&rows[k], &rows[i]);
    CHECK_INT(rows[i].is_kept, better < 2 && !isnan(rows[i].finetuned));
    CHECK_INT(is_stored(id, i, &rows[i]), rows[i].is_kept);
    CHECK_INT(has_file(&rows[i]), rows[i].is_kept);
    n_kept += rows[i].is_kept;
  }
  CHECK_INT(n_kept, 2);
  /* By default, none. */
  request.record.keep_best = 0;
  id = submit_training(&request);
  CHECK(succeeds(id, NULL));
  REQUIRE(mo_store_training_bodies(store, id, -1, rows, N) == N);
  for (uint32_t i = 0; i < N; i++)
    CHECK(!rows[i].is_kept && !is_stored(id, i, &rows[i]));
  CHECK_OK(check_whole());
}

/* Pauses, stops and kills within designs: the state of a kill is that of the last commit. */
SERVICE_CASE(continues_after_interruptions, 1)
{
  const struct mo_bits *genotypes = bodies(31, N);
  struct mo_training_body expected[N];
  struct mo_training_request request = each_of(genotypes, N);
  for (uint32_t i = 0; i < N; i++)
    expected[i] = alone(&genotypes[i]);
  fake_plan.gradient_delay_us = 5000;
  int64_t id = submit_training(&request);
  for (uint32_t round = 1; round < N; round++) {
    CHECK(await_step(id, round * STEPS + 2 * round));
    if (round % 2 == 0) {
      CHECK_OK(mo_jobs_pause(service.jobs, id));
      CHECK(await_phase(id, MO_PHASE_IDLE));
      struct mo_training_status status = training_of(id);
      CHECK(status.bodies_done == round && status.checkpoint_step >= round * STEPS + 2 * round);
      CHECK_OK(mo_jobs_resume(service.jobs, id));
    } else {
      REQUIRE_OK(service_reopen());
    }
  }
  CHECK(succeeds(id, NULL));
  check_rows(id, expected, N);
  CHECK_INT(job_of(id).attempts, 0);
  CHECK_OK(check_whole());
}

/* Another code in the middle of a design is in the lineage of its controller alone. */
SERVICE_CASE(records_the_code_of_each, 1)
{
  const struct mo_bits *genotypes = bodies(31, 3);
  struct mo_training_body rows[3];
  struct mo_training_request request = each_of(genotypes, 3);
  struct mo_training_lineage changed = {2, {{0, "fake gradient"}, {0, "other"}}};
  const struct mo_training_lineage other = {1, {{0, "other"}}};
  struct mo_sha256 expected[3];
  fake_plan.gradient_delay_us = 20000;
  int64_t id = submit_training(&request);
  CHECK(await_step(id, STEPS + 3));
  CHECK_OK(mo_jobs_pause(service.jobs, id));
  CHECK(await_phase(id, MO_PHASE_IDLE));
  const uint32_t at = training_of(id).checkpoint_step;
  REQUIRE(at > STEPS && at < 2 * STEPS);
  changed.codes[1].from_step = at - STEPS;
  fake_plan.gradient_fingerprint = "other";
  CHECK_OK(mo_jobs_resume(service.jobs, id));
  CHECK(succeeds(id, NULL));
  REQUIRE(mo_store_training_bodies(store, id, -1, rows, 3) == 3);
  const struct mo_training_lineage *const lineages[] = {&one_code, &changed, &other};
  for (uint32_t i = 0; i < 3; i++) {
    expected[i] =
        expect(&request, default_weights(), default_digits(), &genotypes[i], 1, lineages[i]);
    CHECK(mo_sha256_equal(&expected[i], &rows[i].controller_sha256));
  }
  struct mo_training_status status = training_of(id);
  CHECK(status.code.n == 2 && status.code.codes[1].from_step == at);
}

/* Code that takes over between two designs is alone in the lineage of the second: the job looks as
 * if it had been killed right after the first. */
SERVICE_CASE(begins_with_other_code, 1)
{
  const struct mo_bits *genotypes = bodies(31, 2);
  const struct mo_training_lineage other = {1, {{0, "other"}}};
  struct mo_training *training = NULL;
  struct mo_training_body rows[2];
  struct mo_training_request request = each_of(genotypes, 2);
  int64_t id = submit_training(&request);
  CHECK(succeeds(id, NULL));
  service_close();
  CHECK_OK(outside("DELETE FROM training_bodies WHERE position=1;"
                   "UPDATE jobs SET state=0,finished_us=0"));
  fake_plan.gradient_fingerprint = "other";
  REQUIRE_OK(service_open());
  CHECK(succeeds(id, NULL));
  REQUIRE(mo_store_training_bodies(store, id, -1, rows, 2) == 2);
  CHECK_OK(mo_training_create(&request.record.settings, default_weights(), genotypes[1].words, 1,
                              &training));
  plain_steps(&fake_plain, training, STEPS, NULL);
  const struct mo_sha256 expected = plain_result(training, default_digits(), "other", &other);
  mo_training_free(training);
  CHECK(mo_sha256_equal(&expected, &rows[1].controller_sha256));
  struct mo_training_status status = training_of(id);
  CHECK(status.code.n == 2 && status.code.codes[1].from_step == STEPS);
}

SERVICE_CASE(refuses_too_many_steps, 1)
{
  struct mo_training_request request = each_of(bodies(31, N), N);
  request.record.settings.n_steps = MO_TRAINING_STEPS_MAX / N + 1;
  CHECK_INT(submit_training(&request), MO_ERR_RANGE);
  CHECK_SAYS(fixture.message, "a training run has at most 1000000");
}

static const struct check_case cases[] = {
    {"each design learns as it would alone", learns_as_alone},
    {"keeps the best", keeps_the_best},
    {"continues after interruptions", continues_after_interruptions},
    {"records the code of each", records_the_code_of_each},
    {"begins a design with other code", begins_with_other_code},
    {"refuses too many steps", refuses_too_many_steps},
};
CHECK_MAIN(cases)
