/* campaigns.c: what the store keeps of campaigns: what was asked for, how they run, wait, end and go on. */
#include "../check.h"
#include "campaign_fixture.h"
#include "store/encode.h"

#define UNTIL 5 /* generations after the first */

static int64_t submit(struct fixture *fixture, const struct mo_campaign_submission *submission)
{
  int64_t id = 0;
  bool replayed = true;
  int error = mo_store_submit_campaign(fixture->store, submission, &id, &replayed);
  return error != MO_OK ? error : id;
}

/* The newest event of a job. */
static struct mo_event event_of(struct fixture *fixture, int64_t id)
{
  struct mo_event events[200] = {{0}};
  int64_t n = mo_store_events(fixture->store, 0, id, events, 200, NULL, NULL);
  return events[n > 0 ? n - 1 : 0];
}

static bool same_bits(double a, double b)
{
  return memcmp(&a, &b, sizeof(a)) == 0;
}

static bool same_settings(const struct mo_campaign_settings *a, const struct mo_campaign_settings *b)
{
  uint8_t first[MO_CAMPAIGN_BYTES], second[MO_CAMPAIGN_BYTES];
  mo_encode_campaign(a, first);
  mo_encode_campaign(b, second);
  return memcmp(first, second, sizeof(first)) == 0;
}

/* Every setting has bits of its own in what is stored, and comes back from them. */
static void encodes_every_setting(void)
{
  struct mo_campaign_submission submission = campaign_submission(MO_FEW_SHOT, 64, 30);
  struct mo_campaign_settings settings = submission.record.settings, back, changed;
  uint8_t bytes[MO_CAMPAIGN_BYTES], others[MO_CAMPAIGN_BYTES];
  unsigned same = 0;
  settings.collapse_share = -0.0;
  settings.physics.bisections = 3;
  mo_encode_campaign(&settings, bytes);
  CHECK_INT(mo_decode_campaign(bytes, sizeof(bytes), &back), MO_OK);
  CHECK_INT(back.mode, MO_FEW_SHOT);
  CHECK(back.seed == settings.seed && back.workspace.nx == 6 && back.workspace.ny == 6 && back.workspace.nz == 4);
  CHECK(back.population == 64 && back.generations == 30 && back.mutation_share == 0.25);
  CHECK(back.mutation_rate == 0.1 && back.mutation_growth == 1.025 && back.selection.kind == MO_SELECT_NOVELTY);
  CHECK(back.selection.tournament_size == 3 && back.selection.novelty_weight == 0.3);
  CHECK(back.selection.n_layers == 5 && back.selection.age_gap == 7 && back.exclude_pretraining);
  CHECK(same_bits(back.collapse_share, -0.0) && back.parent_steps == 2 && back.child_steps == 3 && back.batch == 17);
  CHECK(back.schedule.kind == MO_SCHEDULE_RESTARTS && back.schedule.peak == 1e-3 && back.schedule.floor == 1e-5);
  CHECK(back.schedule.decay == 0.65 && back.schedule.cycle_steps == 10 && back.schedule.cycle_growth == 2);
  CHECK(back.schedule.warmup_steps == 3 && back.beta1 == 0.9 && back.beta2 == 0.999 && back.epsilon == 1e-8);
  CHECK(back.norm_limit == 1 && back.adjoint_bound == 2 && back.sensor == MO_SENSOR_INVERSE_SQUARE);
  CHECK(back.physics.n_steps == settings.physics.n_steps && back.physics.bisections == 3);
  CHECK_INT(mo_decode_campaign(bytes, sizeof(bytes) - 1, &back), MO_ERR_CORRUPT);
  CHECK_INT(mo_decode_campaign(NULL, 0, &back), MO_ERR_CORRUPT);
  bytes[0] = 2;
  CHECK_INT(mo_decode_campaign(bytes, sizeof(bytes), &back), MO_ERR_CORRUPT);
  bytes[0] = 1;
  /* Whichever byte changes: refused, or other settings. */
  for (size_t i = 1; i < sizeof(bytes); i++) {
    bytes[i] ^= 1;
    if (mo_decode_campaign(bytes, sizeof(bytes), &changed) == MO_OK) {
      bytes[i] ^= 1;
      mo_encode_campaign(&changed, others);
      same += memcmp(bytes, others, sizeof(bytes)) == 0;
      bytes[i] ^= 1;
    }
    bytes[i] ^= 1;
  }
  /* Of the flag's word only zero and not zero count: 3 bytes; the precision of the physics is always the same: 1; the bisections
   * of the physics' own encoding give way to the word beside it: 4. */
  CHECK_INT(same, 3 + 1 + 4);
}

static void submits_and_reads_back(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes, *found = NULL;
  struct mo_environment own[2], *environments = NULL;
  struct mo_campaign_submission submission = campaign_submission(MO_ZERO_SHOT, 10, 30);
  struct mo_campaign_status status;
  struct mo_campaign_generation rows[1];
  struct mo_campaign_state *state = NULL;
  struct mo_controller_record controller;
  struct mo_job jobs[10];
  struct mo_event event;
  uint64_t open = 0, rollouts = 9;
  uint32_t n = 0;
  int64_t id;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(5, 3, &forms, &genotypes) == MO_OK);
  REQUIRE(mo_store_controller(fixture.store, "default", &controller) == MO_OK);
  submission.forms = forms;
  submission.genotypes = genotypes;
  submission.record.n_listed = 3;
  submission.weight = 2.5;
  id = submit(&fixture, &submission);
  REQUIRE(id > 0);
  REQUIRE(mo_store_campaign(fixture.store, id, &status) == MO_OK);
  CHECK_INT(status.job.kind, MO_JOB_CAMPAIGN);
  CHECK_INT(status.job.state, MO_JOB_QUEUED);
  CHECK_TEXT(status.job.label, "a label");
  CHECK_INT(status.job.steps_total, 30);
  CHECK_INT(status.job.steps_done, 0);
  CHECK_INT(status.job.n_designs, 10);
  CHECK_INT(status.job.n_environments, MO_PAPER_TEST_COUNT);
  CHECK_TEXT(status.job.environment_set, "paper-test");
  CHECK_TEXT(status.job.controller_name, "default");
  CHECK_INT(status.job.precision, MO_FLOAT32);
  CHECK_TEXT(status.record.name, "walker");
  CHECK_TEXT(status.record.preset, "demo");
  CHECK(status.record.has_controller && mo_sha256_equal(&status.record.controller_sha256, &controller.sha256));
  CHECK_INT(status.record.sensor, MO_SENSOR_INVERSE_SQRT); /* the controller's */
  submission.record.settings.sensor = MO_SENSOR_INVERSE_SQRT;
  CHECK(same_settings(&status.record.settings, &submission.record.settings));
  CHECK_INT(status.record.n_listed, 3);
  CHECK_INT(status.record.group, id);
  CHECK_INT(status.record.replicate, 0);
  CHECK_INT(status.record.replicates, 1);
  CHECK_INT(status.record.checkpoint_every_s, 30);
  CHECK_INT(status.generation, -1);
  CHECK_INT(status.n_designs, 0);
  CHECK(isnan(status.best_score) && status.diversity_max == 0 && status.end == MO_CAMPAIGN_OPEN && !status.has_result);
  CHECK_INT(mo_store_campaign_initial(fixture.store, id, &found, &n), MO_OK);
  CHECK(n == 3 && memcmp(found, genotypes, 3 * sizeof(*found)) == 0);
  free(found);
  CHECK_INT(mo_store_campaign_environments(fixture.store, id, &environments, &n), MO_OK);
  CHECK_INT(n, MO_PAPER_TEST_COUNT);
  free(environments);
  CHECK_INT(mo_store_campaign_generations(fixture.store, id, -1, rows, 1), 0);
  CHECK_INT(mo_store_campaign_state(fixture.store, id, &state), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_jobs(fixture.store, &(struct mo_job_query){0, -1, MO_JOB_CAMPAIGN}, jobs, 10), 1);
  CHECK_INT(mo_store_jobs(fixture.store, &(struct mo_job_query){0, -1, MO_JOB_EVALUATION}, jobs, 10), 0);
  CHECK_INT(mo_store_open_work(fixture.store, &open, &rollouts), MO_OK);
  CHECK(open == 1 && rollouts == 0);
  event = event_of(&fixture, id);
  CHECK_TEXT(event.type, "job.created");
  CHECK(strstr(event.data, "\"kind\":\"campaign\",\"state\":\"queued\",\"generations\":30") != NULL);
  /* Environments of its own, random weights. */
  submission = campaign_submission(MO_SIMULTANEOUS, 4, 8);
  mo_environment_held_out(1, 0, &own[0]);
  mo_environment_held_out(1, 1, &own[1]);
  submission.record.environment_set[0] = '\0';
  submission.record.n_environments = 2;
  submission.environments = own;
  submission.label = NULL;
  id = submit(&fixture, &submission);
  REQUIRE(mo_store_campaign(fixture.store, id, &status) == MO_OK);
  CHECK(!status.record.has_controller && !status.job.has_label);
  CHECK_TEXT(status.record.environment_set, "");
  CHECK_INT(status.record.sensor, MO_SENSOR_INVERSE_SQUARE);
  CHECK_INT(mo_store_campaign_environments(fixture.store, id, &environments, &n), MO_OK);
  CHECK(n == 2 && memcmp(environments, own, sizeof(own)) == 0);
  free(environments);
  /* What cannot be. */
  submission.record.n_environments = 0;
  CHECK_INT(submit(&fixture, &submission), MO_ERR_RANGE);
  submission = campaign_submission(MO_ZERO_SHOT, 4, 8);
  submission.controller = "nobody";
  CHECK_INT(submit(&fixture, &submission), MO_ERR_NOT_FOUND);
  submission = campaign_submission(MO_ZERO_SHOT, 4, 8);
  snprintf(submission.record.environment_set, sizeof(submission.record.environment_set), "nowhere");
  CHECK_INT(submit(&fixture, &submission), MO_ERR_NOT_FOUND);
  submission = campaign_submission(MO_ZERO_SHOT, 4, 8);
  submission.record.replicates = 0;
  CHECK_INT(submit(&fixture, &submission), MO_ERR_RANGE);
  submission.record.replicates = MO_REPLICATES_MAX + 1;
  CHECK_INT(submit(&fixture, &submission), MO_ERR_RANGE);
  submission = campaign_submission(MO_ZERO_SHOT, 4, 8);
  submission.record.n_listed = 5;
  CHECK_INT(submit(&fixture, &submission), MO_ERR_RANGE);
  CHECK_INT(mo_store_campaign(fixture.store, 99, &status), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_environments(fixture.store, 99, &environments, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_initial(fixture.store, 99, &found, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_job_counts(fixture.store, (uint64_t[MO_JOB_STATES]){0}), MO_OK);
  CHECK_INT(mo_store_jobs(fixture.store, &(struct mo_job_query){0, -1, -1}, jobs, 10), 2);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

/* What a commit said is what every reader says, in every mode, before and after a restart. */
static bool same_population(struct fixture *fixture, const struct made *made)
{
  struct mo_campaign_state *state = NULL;
  bool same = mo_store_campaign_state(fixture->store, made->id, &state) == MO_OK &&
              state->generation == (uint32_t)made->generation && state->n == made->n &&
              state->n_designs == made->n_designs &&
              memcmp(state->numbers, made->numbers, made->n * sizeof(*made->numbers)) == 0 &&
              memcmp(state->genotypes, made->genotypes, made->n * sizeof(*made->genotypes)) == 0 &&
              memcmp(state->scores, made->scores, made->n * sizeof(*made->scores)) == 0;
  for (uint32_t i = 0; same && i < state->n; i++)
    same = state->born[i] == state->numbers[i] / made->population;
  same = same && state->diversity_max == 0.25;
  mo_campaign_state_free(state);
  return same;
}

static void commits_generations(enum mo_campaign_mode mode)
{
  struct fixture fixture;
  struct made made = {0};
  struct mo_campaign_submission submission = campaign_submission(mode, MADE_POPULATION, UNTIL);
  struct mo_campaign_status status;
  struct mo_campaign_generation rows[UNTIL + 2];
  struct mo_campaign_step steps[2 * UNTIL + 3];
  int64_t id;
  REQUIRE(fixture_start(&fixture) == 0);
  id = submit(&fixture, &submission);
  REQUIRE(made_start(&made, fixture.store, id, mode, MADE_POPULATION, 9) == MO_OK);
  REQUIRE(made_next(&made) == MO_OK);
  CHECK_INT(mo_store_campaign_commit(fixture.store, id, &made.commit), MO_ERR_CONFLICT); /* not started */
  REQUIRE(mo_store_campaign_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_campaign_start(fixture.store, id), MO_ERR_CONFLICT);
  REQUIRE(mo_store_campaign_commit(fixture.store, id, &made.commit) == MO_OK);
  made_apply(&made);
  CHECK(same_population(&fixture, &made));
  for (int g = 1; g <= UNTIL; g++)
    REQUIRE(made_generation(&made) == MO_OK);
  CHECK(same_population(&fixture, &made));
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK(same_population(&fixture, &made));
  REQUIRE(mo_store_campaign(fixture.store, id, &status) == MO_OK);
  CHECK_INT(status.generation, UNTIL);
  CHECK_INT(status.job.steps_done, UNTIL);
  CHECK_INT(status.n_designs, (UNTIL + 1) * MADE_POPULATION);
  CHECK(same_bits(status.best_score, made.scores[0]));
  CHECK_INT(mo_store_campaign_generations(fixture.store, id, -1, rows, UNTIL + 2), UNTIL + 1);
  CHECK(rows[3].generation == 3 && rows[3].born_before == 3 * MADE_POPULATION && isnan(rows[3].mean_parents));
  CHECK(rows[3].mean_children == 3.5 && rows[3].seconds == 1.5 && rows[3].stored_us > 0);
  CHECK_INT(mo_store_campaign_generations(fixture.store, id, 2, rows, 2), 2);
  CHECK_INT(rows[0].generation, 3);
  CHECK(memcmp(&rows[0].stats.diversity, &(double){0.25 - 0.01 * 3}, 8) == 0);
  CHECK_INT(mo_store_campaign_steps(fixture.store, id, -1, 0, steps, 2 * UNTIL + 3),
            mode == MO_ZERO_SHOT ? 0 : 2 * UNTIL + 2);
  if (mode != MO_ZERO_SHOT) {
    CHECK_INT(mo_store_campaign_steps(fixture.store, id, 1, 1, steps, 2), 2);
    CHECK(steps[0].generation == 1 && steps[0].step == 2 && steps[0].on_children && steps[0].report.step == 4);
    CHECK(steps[0].report.diverged == 1 && steps[1].generation == 2 && steps[1].step == 1 && !steps[1].on_children);
  }
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  made_free(&made);
  fixture_end(&fixture);
}

static void commits_in_every_mode(void)
{
  commits_generations(MO_ZERO_SHOT);
  commits_generations(MO_FEW_SHOT);
  commits_generations(MO_SIMULTANEOUS);
}

static const struct check_case cases[] = {
    {"encodes every setting", encodes_every_setting},
    {"submits and reads back", submits_and_reads_back},
    {"commits in every mode", commits_in_every_mode},
};
CHECK_MAIN(cases)
