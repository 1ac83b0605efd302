/* campaigns.c: what the store keeps of campaigns: what was asked for, how they wait, end and go on.
 */
#include "../check.h"
#include "campaign_fixture.h"
#include "one_store.h"
#include "store/fields.h"
#include "store/trainings.h"

static bool same_bits(double a, double b)
{
  return memcmp(&a, &b, sizeof(a)) == 0;
}

static void write_settings(const struct mo_campaign_record *record, struct mo_text *text)
{
  *text = (struct mo_text){0};
  mo_settings_write(MO_JOB_CAMPAIGN, record, text);
}

static bool same_settings(const struct mo_campaign_settings *a,
                          const struct mo_campaign_settings *b)
{
  struct mo_text first, second;
  bool same;
  write_settings(&(struct mo_campaign_record){.settings = *a}, &first);
  write_settings(&(struct mo_campaign_record){.settings = *b}, &second);
  same = first.data != NULL && second.data != NULL && strcmp(first.data, second.data) == 0;
  mo_text_free(&first);
  mo_text_free(&second);
  return same;
}

/* Every setting comes back from what is stored, bit for bit, but for those that have no meaning
 * beside the others. */
static void encodes_every_setting(void)
{
  static const enum mo_selection_kind kinds[] = {MO_SELECT_TRUNCATION, MO_SELECT_TOURNAMENT,
                                                 MO_SELECT_NOVELTY, MO_SELECT_AGE_LAYERED};
  struct mo_campaign_submission submission = campaign_submission(MO_FEW_SHOT, 64, 30);
  struct mo_campaign_record record = submission.record, back = {.name = "walker"};
  struct mo_campaign_settings *settings = &back.settings;
  struct mo_text text;
  record.settings.collapse_share = -0.0;
  record.settings.physics.impact = MO_IMPACT_BISECTION;
  record.settings.physics.bisections = 3;
  write_settings(&record, &text);
  REQUIRE(text.data != NULL);
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_OK);
  CHECK(same_bits(settings->collapse_share, -0.0) && back.checkpoint_every_s == 30);
  CHECK(strcmp(back.name, "walker") == 0);
  CHECK(same_settings(settings, &record.settings));
  text.data[text.size - 1] = '\0';
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_ERR_CORRUPT);
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, "{\"mode\":\"none\"}", &back), MO_ERR_CORRUPT);
  mo_text_free(&text);
  for (size_t i = 0; i < sizeof(kinds) / sizeof(kinds[0]); i++) {
    record.settings.selection.kind = kinds[i];
    write_settings(&record, &text);
    CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_OK);
    CHECK(same_settings(settings, &record.settings) && settings->selection.kind == kinds[i]);
    CHECK_INT(settings->selection.tournament_size, kinds[i] == MO_SELECT_TOURNAMENT ? 3 : 4);
    CHECK_INT(settings->selection.n_layers, kinds[i] == MO_SELECT_AGE_LAYERED ? 5 : 4);
    CHECK_INT(settings->selection.age_gap, kinds[i] == MO_SELECT_AGE_LAYERED ? 7 : 5);
    mo_text_free(&text);
  }
}

static void submits_and_reads_back(void)
{
  struct mo_bits *found = NULL;
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
  REQUIRE(fixture_bodies(5, 3, &fixture.forms, &fixture.genotypes) == MO_OK);
  REQUIRE(mo_store_controller(fixture.store, "default", &controller) == MO_OK);
  submission.forms = fixture.forms;
  submission.genotypes = fixture.genotypes;
  submission.record.n_listed = 3;
  submission.weight = 2.5;
  id = campaign_submit(&fixture, &submission);
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
  CHECK(status.record.has_controller &&
        mo_sha256_equal(&status.record.controller_sha256, &controller.sha256));
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
  CHECK(isnan(status.best_score) && status.diversity_max == 0 && status.end == MO_CAMPAIGN_OPEN &&
        !status.has_result);
  CHECK_INT(mo_store_job_designs(fixture.store, id, &found, &n), MO_OK);
  CHECK(n == 3 && memcmp(found, fixture.genotypes, 3 * sizeof(*found)) == 0);
  free(found);
  CHECK_INT(mo_store_campaign_environments(fixture.store, id, &environments, &n), MO_OK);
  CHECK_INT(n, MO_PAPER_TEST_COUNT);
  free(environments);
  CHECK_INT(mo_store_campaign_generations(fixture.store, id, -1, rows, 1), 0);
  CHECK_INT(mo_store_campaign_state(fixture.store, id, &state), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_jobs(fixture.store, &(struct mo_job_query){0, -1, MO_JOB_CAMPAIGN}, jobs, 10),
            1);
  CHECK_INT(
      mo_store_jobs(fixture.store, &(struct mo_job_query){0, -1, MO_JOB_EVALUATION}, jobs, 10), 0);
  CHECK_INT(mo_store_open_work(fixture.store, &open, &rollouts), MO_OK);
  CHECK(open == 1 && rollouts == 0);
  event = campaign_event(&fixture, id);
  CHECK_TEXT(event.type, "job.created");
  CHECK(strstr(event.data, "\"kind\":\"campaign\",\"state\":\"queued\",\"generations\":30") !=
        NULL);
  /* Environments of its own, random weights. */
  submission = campaign_submission(MO_SIMULTANEOUS, 4, 8);
  mo_environment_held_out(1, 0, &own[0]);
  mo_environment_held_out(1, 1, &own[1]);
  submission.record.environment_set[0] = '\0';
  submission.record.n_environments = 2;
  submission.environments = own;
  submission.label = NULL;
  id = campaign_submit(&fixture, &submission);
  REQUIRE(mo_store_campaign(fixture.store, id, &status) == MO_OK);
  CHECK(!status.record.has_controller && !status.job.has_label);
  CHECK_TEXT(status.record.environment_set, "");
  CHECK_INT(status.record.sensor, MO_SENSOR_INVERSE_SQUARE);
  CHECK_INT(mo_store_campaign_environments(fixture.store, id, &environments, &n), MO_OK);
  CHECK(n == 2 && memcmp(environments, own, sizeof(own)) == 0);
  free(environments);
  /* What cannot be. */
  submission.record.n_environments = 0;
  CHECK_INT(campaign_submit(&fixture, &submission), MO_ERR_RANGE);
  submission = campaign_submission(MO_ZERO_SHOT, 4, 8);
  submission.controller = "nobody";
  CHECK_INT(campaign_submit(&fixture, &submission), MO_ERR_NOT_FOUND);
  submission = campaign_submission(MO_ZERO_SHOT, 4, 8);
  snprintf(submission.record.environment_set, sizeof(submission.record.environment_set), "nowhere");
  CHECK_INT(campaign_submit(&fixture, &submission), MO_ERR_NOT_FOUND);
  submission = campaign_submission(MO_ZERO_SHOT, 4, 8);
  submission.record.replicates = 0;
  CHECK_INT(campaign_submit(&fixture, &submission), MO_ERR_RANGE);
  submission.record.replicates = MO_REPLICATES_MAX + 1;
  CHECK_INT(campaign_submit(&fixture, &submission), MO_ERR_RANGE);
  submission = campaign_submission(MO_ZERO_SHOT, 4, 8);
  submission.record.n_listed = 5;
  CHECK_INT(campaign_submit(&fixture, &submission), MO_ERR_RANGE);
  CHECK_INT(mo_store_campaign(fixture.store, 99, &status), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_environments(fixture.store, 99, &environments, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_job_designs(fixture.store, 99, &found, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_job_counts(fixture.store, (uint64_t[MO_JOB_STATES]){0}), MO_OK);
  CHECK_INT(mo_store_jobs(fixture.store, &(struct mo_job_query){0, -1, -1}, jobs, 10), 2);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
}

static void starts_replicates(void)
{
  struct mo_bits *found = NULL;
  struct mo_environment *environments = NULL;
  struct mo_campaign_submission submission = campaign_submission(MO_ZERO_SHOT, 10, 30);
  struct mo_campaign_status status, page[8];
  struct mo_job_query query = {.state = -1};
  int64_t ids[8], id, again = 0, other;
  uint32_t n = 0;
  bool replayed = true;
  REQUIRE(fixture_bodies(5, 3, &fixture.forms, &fixture.genotypes) == MO_OK);
  other = campaign_submit(&fixture, &submission);
  submission.forms = fixture.forms;
  submission.genotypes = fixture.genotypes;
  submission.record.n_listed = 3;
  submission.record.replicates = 4;
  submission.record.settings.seed = MO_SEED_MAX - 3;
  submission.idempotency_key = "once";
  submission.priority = MO_INTERACTIVE;
  REQUIRE(mo_store_submit_campaign(fixture.store, &submission, &id, &replayed) == MO_OK);
  CHECK(!replayed && id == other + 1);
  for (uint32_t r = 0; r < 4; r++) {
    REQUIRE(mo_store_campaign(fixture.store, id + r, &status) == MO_OK);
    CHECK_INT(status.record.group, id);
    CHECK_INT(status.record.replicate, r);
    CHECK_INT(status.record.replicates, 4);
    CHECK(status.record.settings.seed == (uint64_t)MO_SEED_MAX - 3 + r);
    CHECK_INT(mo_store_job_designs(fixture.store, id + r, &found, &n), MO_OK);
    CHECK(n == 3 && memcmp(found, fixture.genotypes, 3 * sizeof(*found)) == 0);
    free(found);
    CHECK_INT(mo_store_campaign_environments(fixture.store, id + r, &environments, &n), MO_OK);
    CHECK_INT(n, MO_PAPER_TEST_COUNT);
    free(environments);
    CHECK(strcmp(campaign_event(&fixture, id + r).type, "job.created") == 0);
  }
  /* The key's answer is the first; with another body it is a conflict. */
  CHECK_INT(mo_store_submit_campaign(fixture.store, &submission, &again, &replayed), MO_OK);
  CHECK(replayed && again == id);
  submission.body_sha256.bytes[0] ^= 1;
  CHECK_INT(mo_store_submit_campaign(fixture.store, &submission, &again, &replayed),
            MO_ERR_CONFLICT);
  /* Interactive ones first, then as they came. */
  CHECK_INT(mo_store_queued_runs(fixture.store, MO_JOB_CAMPAIGN, ids, 8), 5);
  CHECK(ids[0] == id && ids[1] == id + 1 && ids[3] == id + 3 && ids[4] == other);
  CHECK_INT(mo_store_queued_runs(fixture.store, MO_JOB_CAMPAIGN, ids, 2), 2);
  CHECK_INT(mo_store_queued_runs(fixture.store, MO_JOB_TRAINING, ids, 8), 0);
  CHECK_INT(mo_store_queued(fixture.store, MO_INTERACTIVE, 0, ids, 8), 0);
  /* Lists, newest first. */
  CHECK_INT(mo_store_campaigns(fixture.store, &query, page, 8), 5);
  CHECK(page[0].job.id == id + 3 && page[4].job.id == other);
  query.before = id + 2;
  CHECK_INT(mo_store_campaigns(fixture.store, &query, page, 1), 1);
  CHECK_INT(page[0].job.id, id + 1);
  query = (struct mo_job_query){.state = -1, .group = id};
  CHECK_INT(mo_store_campaigns(fixture.store, &query, page, 8), 4);
  REQUIRE(mo_store_run_start(fixture.store, id + 1) == MO_OK);
  REQUIRE(mo_store_run_start(fixture.store, id + 2) == MO_OK);
  query.state = MO_JOB_RUNNING;
  CHECK_INT(mo_store_campaigns(fixture.store, &query, page, 8), 2);
  CHECK(page[0].job.id == id + 2 && page[1].job.id == id + 1);
  query.waiting = (const int64_t[]){id + 1}; /* shown as paused */
  query.n_waiting = 1;
  CHECK_INT(mo_store_campaigns(fixture.store, &query, page, 8), 1);
  CHECK_INT(page[0].job.id, id + 2);
  query.state = MO_JOB_PAUSED;
  CHECK_INT(mo_store_campaigns(fixture.store, &query, page, 8), 1);
  CHECK_INT(page[0].job.id, id + 1);
  query.group = other;
  CHECK_INT(mo_store_campaigns(fixture.store, &query, page, 8), 0);
  CHECK_INT(mo_store_campaigns(fixture.store, &query, page, MO_PAGE_MAX + 1), MO_ERR_LIMIT);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
}

/* The population that another campaign has now, as it stands: what that one does later changes
 * nothing. */
static void inherits_a_population(void)
{
  struct made made = {0};
  struct mo_campaign_submission submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, 30);
  struct mo_bits listed, form, before[MADE_POPULATION], *found = NULL, *best = NULL;
  int64_t first, second;
  uint32_t n = 0, n_sound = 0;
  first = campaign_submit(&fixture, &submission);
  submission.record.initial_campaign = first;
  CHECK_INT(campaign_submit(&fixture, &submission), MO_ERR_CONFLICT); /* nothing there yet */
  CHECK_INT(mo_store_population(fixture.store, first, 0, &best, &n), MO_ERR_CONFLICT);
  submission.record.initial_campaign = 77;
  CHECK_INT(campaign_submit(&fixture, &submission), MO_ERR_NOT_FOUND);
  REQUIRE(mo_store_run_start(fixture.store, first) == MO_OK);
  REQUIRE(made_start(&made, fixture.store, first, MO_ZERO_SHOT, MADE_POPULATION, 9) == MO_OK);
  REQUIRE(made_generation(&made) == MO_OK);
  REQUIRE(made_generation(&made) == MO_OK);
  memcpy(before, made.genotypes, sizeof(before));
  submission.record.initial_campaign = first;
  second = campaign_submit(&fixture, &submission);
  REQUIRE(second > 0);
  /* As designs of a training: those that did not diverge, best first. */
  for (uint32_t i = 0; i < made.n; i++)
    n_sound += isfinite(made.scores[i]) != 0;
  CHECK_INT(mo_store_population(fixture.store, first, 0, &best, &n), MO_OK);
  CHECK(n == n_sound && memcmp(best, before, n * sizeof(*best)) == 0);
  free(best);
  CHECK_INT(mo_store_population(fixture.store, first, 2, &best, &n), MO_OK);
  CHECK(n == 2 && memcmp(best, before, 2 * sizeof(*best)) == 0);
  free(best);
  REQUIRE(made_generation(&made) == MO_OK);
  CHECK_INT(mo_store_job_designs(fixture.store, second, &found, &n), MO_OK);
  CHECK(n == MADE_POPULATION && memcmp(found, before, sizeof(before)) == 0);
  free(found);
  /* One of its designs is listed, turned or not: it comes once, first. The last ones have no place.
   */
  memcpy(before, made.genotypes, sizeof(before));
  mo_genotype_image(MO_DEFAULT_WORKSPACE, before[1].words, 1, listed.words);
  mo_genotype_place(MO_DEFAULT_WORKSPACE, listed.words);
  mo_genotype_canonical(MO_DEFAULT_WORKSPACE, listed.words, form.words);
  submission.forms = &form;
  submission.genotypes = &listed;
  submission.record.n_listed = 1;
  submission.record.settings.population = 4;
  second = campaign_submit(&fixture, &submission);
  REQUIRE(second > 0);
  CHECK_INT(mo_store_job_designs(fixture.store, second, &found, &n), MO_OK);
  CHECK(n == 4 && memcmp(&found[0], &listed, sizeof(listed)) == 0 &&
        memcmp(&found[1], &before[0], sizeof(listed)) == 0 &&
        memcmp(&found[2], &before[2], sizeof(listed)) == 0 &&
        memcmp(&found[3], &before[3], sizeof(listed)) == 0);
  free(found);
  /* Into a workspace of two voxels nothing fits that has more. */
  submission.record.settings.workspace = (struct mo_workspace){2, 1, 1};
  submission.record.n_listed = 0;
  second = campaign_submit(&fixture, &submission);
  REQUIRE(second > 0);
  CHECK_INT(mo_store_job_designs(fixture.store, second, &found, &n), MO_OK);
  CHECK_INT(n, 0);
  free(found);
  made_free(&made);
}

static void finish_with(int64_t id, struct mo_controller *controller)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  struct mo_campaign_status status;
  struct mo_controller_record record;
  struct mo_event event;
  const struct mo_sha256 odd = {{0xab, 0xcd}};
  CHECK_INT(mo_controller_encode(controller, &bytes, &size), MO_OK);
  CHECK_INT(mo_store_campaign_lineage_fault(fixture.store, id, &odd, "morphod.seed", "no number"),
            MO_OK);
  event = campaign_event(&fixture, id);
  CHECK_TEXT(event.type, "campaign.lineage_unreadable");
  CHECK(strstr(event.data, "\"controller\":\"abcd00") != NULL);
  CHECK(strstr(event.data, "\"field\":\"morphod.seed\",\"detail\":\"no number\"}") != NULL);
  CHECK_INT(mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_COMPLETED, 0, "walker", bytes,
                                     size, controller),
            MO_ERR_CONFLICT); /* it has more generations to go */
  CHECK_INT(mo_store_controller(fixture.store, "walker", &record), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_COMPLETED, 1, "Not A Name",
                                     bytes, size, controller),
            MO_ERR_FORMAT);
  CHECK_INT(mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_COMPLETED, 1, "walker", bytes,
                                     size, controller),
            MO_OK);
  CHECK_INT(mo_store_campaign(fixture.store, id, &status), MO_OK);
  CHECK(status.job.state == MO_JOB_SUCCEEDED && status.job.finished_us > 0 &&
        status.end == MO_CAMPAIGN_COMPLETED);
  CHECK_INT(mo_store_controller(fixture.store, "walker", &record), MO_OK);
  CHECK(status.has_result && mo_sha256_equal(&status.result_sha256, &record.sha256));
  event = campaign_event(&fixture, id);
  CHECK_TEXT(event.type, "job.finished");
  CHECK(strstr(event.data, "\"kind\":\"campaign\",\"state\":\"succeeded\",\"end\":\"completed\","
                           "\"controller\":\"walker\",\"sha256\":\"") != NULL);
  CHECK_INT(mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_COMPLETED, 1, "walker", bytes,
                                     size, controller),
            MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_lineage_fault(fixture.store, id, &odd, "morphod.seed", "no number"),
            MO_ERR_CONFLICT);
  free(bytes);
}

static void finishes_and_extends(void)
{
  struct mo_campaign_submission submission = campaign_submission(MO_SIMULTANEOUS, 4, 1);
  struct mo_campaign_status status;
  struct mo_controller *controller = NULL;
  enum mo_job_state before = MO_JOB_FAILED;
  struct mo_request_key key = {.text = "more"};
  struct mo_event event;
  int64_t id;
  REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) == MO_OK);
  mo_controller_randomize(controller, 77);
  id = campaign_submit(&fixture, &submission);
  /* Queued. */
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 0, NULL, &before), MO_ERR_RANGE);
  CHECK_INT(
      mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_COMPLETED, 9, NULL, NULL, 0, NULL),
      MO_ERR_CONFLICT);
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  finish_with(id, controller);
  /* Succeeded: queued again, without its end. */
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 2, NULL, &before), MO_OK);
  CHECK_INT(before, MO_JOB_SUCCEEDED);
  CHECK_INT(mo_store_campaign(fixture.store, id, &status), MO_OK);
  CHECK(status.job.state == MO_JOB_QUEUED && status.job.finished_us == 0 &&
        status.end == MO_CAMPAIGN_OPEN);
  CHECK(!status.has_result && status.record.settings.generations == 3 &&
        status.job.steps_total == 3);
  event = campaign_event(&fixture, id);
  CHECK_TEXT(event.type, "campaign.extended");
  CHECK(strstr(event.data, "\"state\":\"queued\",\"generations\":3,\"added\":2") != NULL);
  /* Queued, running, paused: just longer. */
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_OK);
  CHECK_INT(before, MO_JOB_QUEUED);
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_OK);
  CHECK(before == MO_JOB_RUNNING && campaign_state(&fixture, id) == MO_JOB_RUNNING);
  CHECK_INT(
      mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_COMPLETED, 4, NULL, NULL, 0, NULL),
      MO_ERR_CONFLICT); /* extended meanwhile */
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, NULL), MO_OK);
  CHECK_INT(
      mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_COMPLETED, 5, NULL, NULL, 0, NULL),
      MO_ERR_CONFLICT);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_OK);
  CHECK(before == MO_JOB_PAUSED && campaign_state(&fixture, id) == MO_JOB_PAUSED);
  CHECK_INT(mo_store_campaign(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.job.steps_total, 6);
  /* With a key: once. */
  mo_sha256_of("one", 3, &key.sha256);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, &key, &before), MO_OK);
  CHECK_INT(before, MO_JOB_PAUSED);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, &key, &before), MO_OK);
  CHECK_INT(before, MO_JOB_QUEUED);
  mo_sha256_of("two", 3, &key.sha256);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 2, &key, &before), MO_ERR_DUPLICATE);
  CHECK_INT(mo_store_campaign(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.job.steps_total, 7);
  /* Limits: of generations, of designs, of the steps of a training. */
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, MO_GENERATIONS_MAX - 6, NULL, &before),
            MO_ERR_RANGE);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, UINT32_MAX, NULL, &before), MO_ERR_RANGE);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, MO_GENERATIONS_MAX - 7, NULL, &before),
            MO_OK);
  submission.record.settings.child_steps = 1000;
  submission.record.settings.generations = 900;
  id = campaign_submit(&fixture, &submission);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 98, NULL, &before),
            MO_ERR_RANGE); /* 1000 + 1002 · 998 steps */
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 97, NULL, &before), MO_OK);
  submission = campaign_submission(MO_ZERO_SHOT, MO_POPULATION_MAX, 4000);
  id = campaign_submit(&fixture, &submission);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 96, NULL, &before),
            MO_ERR_RANGE); /* 2^16 · 4097 designs */
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 95, NULL, &before), MO_OK);
  /* What depends on the number of generations. */
  submission = campaign_submission(MO_SIMULTANEOUS, 4, 1);
  submission.record.settings.learning.schedule.kind = MO_SCHEDULE_COSINE;
  id = campaign_submit(&fixture, &submission);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_ERR_UNSUPPORTED);
  submission.record.settings.mode = MO_FEW_SHOT;
  submission.controller = "default";
  id = campaign_submit(&fixture, &submission);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_OK);
  /* Exhausted: there is nothing new to find. */
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_OPEN, 2, NULL, NULL, 0, NULL),
            MO_ERR_INVALID);
  CHECK_INT(
      mo_store_campaign_finish(fixture.store, id, MO_CAMPAIGN_EXHAUSTED, 2, NULL, NULL, 0, NULL),
      MO_OK);
  CHECK(strstr(campaign_event(&fixture, id).data, "\"end\":\"exhausted\"}") != NULL);
  CHECK_INT(mo_store_campaign(fixture.store, id, &status), MO_OK);
  CHECK(status.end == MO_CAMPAIGN_EXHAUSTED && !status.has_result);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_ERR_CONFLICT);
  /* Cancelled, failed, of another kind, not there. */
  id = campaign_submit(&fixture, &submission);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_CANCEL, NULL), MO_OK);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_ERR_CONFLICT);
  id = campaign_submit(&fixture, &submission);
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_run_park(fixture.store, id, MO_ERR_NO_MEMORY, "out of memory", 1, NULL),
            MO_OK);
  CHECK_INT(campaign_state(&fixture, id), MO_JOB_FAILED);
  CHECK_INT(mo_store_extend_campaign(fixture.store, id, 1, NULL, &before), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_extend_campaign(fixture.store, 12345, 1, NULL, &before), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  mo_controller_free(controller);
}

static void parks_and_requeues(void)
{
  struct made made = {0};
  struct mo_campaign_submission submission = campaign_submission(MO_FEW_SHOT, MADE_POPULATION, 100);
  enum mo_job_state after = MO_JOB_CANCELLED;
  struct mo_job job;
  int64_t id;
  id = campaign_submit(&fixture, &submission);
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  CHECK(strcmp(campaign_event(&fixture, id).type, "job.started") == 0);
  CHECK_INT(mo_store_run_park(fixture.store, id, MO_OK, NULL, 3, &after), MO_OK);
  CHECK(after == MO_JOB_QUEUED && strcmp(campaign_event(&fixture, id).type, "job.requeued") == 0);
  CHECK_INT(mo_store_run_park(fixture.store, id, MO_OK, NULL, 3, &after),
            MO_OK); /* it does not run */
  /* A process that dies leaves it running; the next one queues it again. */
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(campaign_state(&fixture, id), MO_JOB_RUNNING);
  CHECK_INT(mo_store_requeue(fixture.store, 0, 3, ""), MO_OK);
  CHECK_INT(campaign_state(&fixture, id), MO_JOB_QUEUED);
  /* An error, a crash, an error: the third is the last, unless a generation comes between. */
  REQUIRE(made_start(&made, fixture.store, id, MO_FEW_SHOT, MADE_POPULATION, 3) == MO_OK);
  for (int round = 0; round < 2; round++) {
    REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
    CHECK_INT(mo_store_run_park(fixture.store, id, MO_ERR_NO_MEMORY, "out of memory", 3, &after),
              MO_OK);
    CHECK_INT(after, MO_JOB_QUEUED);
    CHECK_INT(mo_store_requeue(fixture.store, id, 3, "killed"), MO_OK);
    CHECK_INT(mo_store_job(fixture.store, id, &job), MO_OK);
    CHECK_INT(job.attempts, 2);
    CHECK_TEXT(job.error_text, "killed");
    REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
    if (round == 0) {
      REQUIRE(made_generation(&made) == MO_OK);
      CHECK_INT(mo_store_job(fixture.store, id, &job), MO_OK);
      CHECK_INT(job.attempts, 0);
      CHECK_INT(mo_store_run_park(fixture.store, id, MO_OK, NULL, 3, &after), MO_OK);
    }
  }
  CHECK_INT(mo_store_run_park(fixture.store, id, MO_ERR_NO_MEMORY, "out of memory", 3, &after),
            MO_OK);
  CHECK_INT(after, MO_JOB_FAILED);
  CHECK_INT(mo_store_run_start(fixture.store, id), MO_ERR_CONFLICT);
  CHECK(strstr(campaign_event(&fixture, id).data, "\"kind\":\"campaign\",\"state\":\"failed\"") !=
        NULL);
  /* A retry, not a mere resumption, takes it up again; nothing of one that is not over, and none
   * that was cancelled. */
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RESUME, &after), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RETRY, &after), MO_OK);
  CHECK_INT(after, MO_JOB_FAILED);
  CHECK_INT(mo_store_job(fixture.store, id, &job), MO_OK);
  CHECK(job.state == MO_JOB_QUEUED && job.attempts == 0 && job.error == MO_OK &&
        job.finished_us == 0);
  CHECK(strcmp(campaign_event(&fixture, id).type, "job.resumed") == 0);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RETRY, &after), MO_OK);
  CHECK_INT(after, MO_JOB_QUEUED);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_CANCEL, NULL), MO_OK);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RETRY, NULL), MO_ERR_CONFLICT);
  /* One that is paused stays so. */
  id = campaign_submit(&fixture, &submission);
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, NULL), MO_OK);
  CHECK_INT(mo_store_run_park(fixture.store, id, MO_OK, NULL, 3, &after), MO_OK);
  CHECK_INT(after, MO_JOB_PAUSED);
  CHECK_INT(mo_store_run_start(fixture.store, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RESUME, NULL), MO_OK);
  CHECK_INT(mo_store_run_start(fixture.store, id), MO_OK);
  made_free(&made);
}

static const struct check_case cases[] = {
    {"encodes every setting", encodes_every_setting},
    {"submits and reads back", submits_and_reads_back},
    {"starts replicates", starts_replicates},
    {"inherits a population", inherits_a_population},
    {"finishes and extends", finishes_and_extends},
    {"parks and requeues", parks_and_requeues},
};
CHECK_MAIN_AROUND(cases, with_a_store)
