/* campaigns.c: what the store records about campaigns: requests, queues, ends and extensions. */
#include "campaign_fixture.h"
#include "one_store.h"
#include "rollout/physics.h"
#include "store/worlds.h"

static void write_settings(const struct mo_campaign_record *record, struct mo_text *text)
{
  *text = (struct mo_text){0};
  mo_settings_write(MO_JOB_CAMPAIGN, record, text);
}

static bool same_as(const struct mo_campaign_settings *a, const struct mo_campaign_settings *b)
{
  return same_settings(MO_JOB_CAMPAIGN, &(struct mo_campaign_record){.settings = *a},
                       &(struct mo_campaign_record){.settings = *b});
}

/* Returns the environments in which a campaign scores. */
static struct mo_environment *environments_of(int64_t id, uint32_t *n)
{
  struct mo_environment *found = NULL;
  CHECK_OK(mo_store_job_environments(store, id, MO_JOB_CAMPAIGN, &found, n));
  return check_keep(found, free);
}

/* Every setting is read back bit for bit, except those that the other settings make meaningless. */
static void encodes_every_setting(void)
{
  static const enum mo_selection_kind kinds[] = {MO_SELECT_TRUNCATION, MO_SELECT_TOURNAMENT,
                                                 MO_SELECT_NOVELTY, MO_SELECT_AGE_LAYERED};
  struct mo_campaign_request submission = campaign_submission(MO_FEW_SHOT, 64, 30);
  struct mo_campaign_record record = submission.record, back = {.name = "walker"};
  struct mo_campaign_settings *settings = &back.settings;
  struct mo_text text;
  record.settings.collapse_share = -0.0;
  record.settings.physics.scheme.impact = MO_IMPACT_BISECTION;
  record.settings.physics.scheme.bisections = 3;
  write_settings(&record, &text);
  REQUIRE(text.data != NULL);
  CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
  CHECK(same_bits(settings->collapse_share, -0.0) && back.checkpoint_every_s == 30);
  CHECK(strcmp(back.name, "walker") == 0);
  CHECK(same_as(settings, &record.settings));
  text.data[text.size - 1] = '\0';
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_ERR_CORRUPT);
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, "{\"mode\":\"none\"}", &back), MO_ERR_CORRUPT);
  mo_text_free(&text);
  for (size_t i = 0; i < COUNT(kinds); i++) {
    record.settings.selection.kind = kinds[i];
    write_settings(&record, &text);
    CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
    CHECK(same_as(settings, &record.settings) && settings->selection.kind == kinds[i]);
    CHECK_INT(settings->selection.tournament_size, kinds[i] == MO_SELECT_TOURNAMENT ? 3 : 4);
    CHECK_INT(settings->selection.n_layers, kinds[i] == MO_SELECT_AGE_LAYERED ? 5 : 4);
    CHECK_INT(settings->selection.age_gap, kinds[i] == MO_SELECT_AGE_LAYERED ? 7 : 5);
    mo_text_free(&text);
  }
}

/* Only a study has an own score; the settings of other campaigns keep their form, as in bundles. */
static void names_the_score_of_a_study(void)
{
  struct mo_campaign_record record = {.settings = mo_campaign_preset(MO_STUDY, MO_PRESET_DEMO)};
  struct mo_campaign_record back = {.own_score = {"left", "over"}};
  struct mo_text text;
  write_settings(&record, &text);
  CHECK(strstr(text.data, "own_score") == NULL);
  CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
  CHECK(!mo_own_score_is_set(&back.own_score));
  mo_text_free(&text);
  record.own_score = (struct mo_own_score){"cost_of_transport", "J/(kg·m)"};
  write_settings(&record, &text);
  CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
  CHECK(mo_own_score_equal(&back.own_score, &record.own_score));
  CHECK(same_as(&back.settings, &record.settings));
  mo_text_free(&text);
  record.settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO);
  write_settings(&record, &text);
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_ERR_CORRUPT);
  mo_text_free(&text);
}

/* Only a campaign that learns in its environments says so; the settings of others keep their
 * form. */
static void names_the_worlds_of_learning(void)
{
  struct mo_campaign_record record = {.settings = mo_campaign_preset(MO_FEW_SHOT, MO_PRESET_DEMO)};
  struct mo_campaign_record back = {.worlds = MO_WORLDS_ENVIRONMENTS};
  struct mo_text text;
  write_settings(&record, &text);
  CHECK(strstr(text.data, "worlds") == NULL && strstr(text.data, "measures") == NULL);
  CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
  CHECK_INT(back.worlds, MO_WORLDS_RANDOM);
  mo_text_free(&text);
  record.worlds = MO_WORLDS_ENVIRONMENTS;
  for (int i = 0; i < 2; i++) {
    record.measures = i == 0 ? 0 : 1U << MO_MEASURE_WORK;
    write_settings(&record, &text);
    CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
    CHECK(back.worlds == MO_WORLDS_ENVIRONMENTS && back.measures == record.measures);
    CHECK(!back.select_by.is_set && !mo_own_score_is_set(&back.own_score));
    CHECK(same_as(&back.settings, &record.settings));
    mo_text_free(&text);
  }
  record.settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO);
  write_settings(&record, &text);
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_ERR_CORRUPT);
  mo_text_free(&text);
}

/* Only a campaign that does not score by the mean has an aggregate; the settings of others keep
 * their form. An own score has none, and without lower bounds, racing is off. */
static void names_the_aggregate(void)
{
  static const char *const words[] = {
      "\"aggregate\":{\"kind\":\"quantile\",\"level\":0.75}}",
      "\"aggregate\":{\"kind\":\"cvar\",\"level\":0.75}}",
      "\"aggregate\":{\"kind\":\"mean-sd\",\"weight\":2.5}}",
  };
  struct mo_campaign_record record = {.settings = mo_campaign_preset(MO_FEW_SHOT, MO_PRESET_DEMO),
                                      .worlds = MO_WORLDS_ENVIRONMENTS,
                                      .measures = 1U << MO_MEASURE_WORK};
  struct mo_campaign_record back = {.settings.aggregate.kind = MO_AGGREGATE_CVAR};
  struct mo_text text;
  write_settings(&record, &text);
  CHECK(strstr(text.data, "aggregate") == NULL);
  CHECK(strstr(text.data, ",\"own_score\":null,\"measures\":[\"work_j\"],\"select_by\":null,"
                          "\"learning_worlds\":\"environments\"}") != NULL);
  CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
  CHECK_INT(back.settings.aggregate.kind, MO_AGGREGATE_MEAN);
  CHECK(back.settings.aggregate.level == 0.9 && back.settings.aggregate.weight == 1);
  mo_text_free(&text);
  for (int kind = MO_AGGREGATE_QUANTILE; kind <= MO_AGGREGATE_MEAN_SD; kind++) {
    const bool races = kind != MO_AGGREGATE_MEAN_SD;
    record.settings.aggregate = (struct mo_aggregate){(enum mo_aggregate_kind)kind, 0.75, 2.5};
    record.settings.racing = races ? MO_RACING_LOSSLESS : MO_RACING_OFF;
    write_settings(&record, &text);
    CHECK(strstr(text.data, words[kind - 1]) != NULL);
    CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
    CHECK(same_as(&back.settings, &record.settings));
    CHECK_INT(back.settings.aggregate.kind, kind);
    mo_text_free(&text);
  }
  record.settings.racing = MO_RACING_LOSSLESS;
  write_settings(&record, &text);
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_ERR_CORRUPT);
  mo_text_free(&text);
  record = (struct mo_campaign_record){.settings = mo_campaign_preset(MO_STUDY, MO_PRESET_DEMO),
                                       .own_score = {"effort", "J"}};
  record.settings.aggregate.kind = MO_AGGREGATE_CVAR;
  write_settings(&record, &text);
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_ERR_CORRUPT);
  mo_text_free(&text);
}

/* Only a campaign that re-evaluates has the setting; a study never does. */
static void names_the_re_evaluation(void)
{
  struct mo_campaign_record record = {.settings = mo_campaign_preset(MO_FEW_SHOT, MO_PRESET_DEMO),
                                      .re_evaluate = {.environments = 5}};
  struct mo_campaign_record back = {.re_evaluate = {9, 9, 9}};
  struct mo_text text;
  write_settings(&record, &text);
  CHECK(strstr(text.data, "re_evaluate") == NULL);
  CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
  CHECK_INT(back.re_evaluate.every, 0);
  mo_text_free(&text);
  record.re_evaluate = (struct mo_re_evaluation){3, 70, 4};
  write_settings(&record, &text);
  CHECK(strstr(text.data, ",\"re_evaluate\":{\"every\":3,\"environments\":70,\"designs\":4}}") !=
        NULL);
  CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back));
  CHECK(memcmp(&back.re_evaluate, &record.re_evaluate, sizeof(back.re_evaluate)) == 0);
  mo_text_free(&text);
  record.settings = mo_campaign_preset(MO_STUDY, MO_PRESET_DEMO);
  write_settings(&record, &text);
  CHECK_INT(mo_settings_read(MO_JOB_CAMPAIGN, text.data, &back), MO_ERR_CORRUPT);
  mo_text_free(&text);
}

/* An older program stored no settings that it did not have. They were the paper's. */
static void keeps_the_physics_of_older_jobs(void)
{
  struct mo_physics paper = mo_paper_physics();
  struct mo_campaign_record back = {.name = "walker"};
  CHECK_OK(mo_settings_read(MO_JOB_CAMPAIGN, "{\"mode\":\"zero-shot\",\"seed\":3}", &back));
  CHECK(back.settings.seed == 3 && mo_physics_equal(&back.settings.physics, &paper));
  CHECK_OK(mo_settings_read(
      MO_JOB_CAMPAIGN, "{\"mode\":\"simultaneous\",\"physics\":{\"n_steps\":30,\"friction\":0.5}}",
      &back));
  paper.scheme.n_steps = 30;
  paper.constants.friction = 0.5;
  CHECK(mo_physics_equal(&back.settings.physics, &paper));
}

/* Whether requests are read back unchanged is tested over HTTP. */
static void refuses_what_cannot_be(void)
{
  struct mo_bits *found = NULL;
  struct mo_environment *environments = NULL;
  struct mo_campaign_request submission;
  struct mo_campaign_status status;
  struct mo_job jobs[1];
  uint32_t n = 0;
#define REFUSE(error, change)                                                                      \
  do {                                                                                             \
    submission = campaign_submission(MO_ZERO_SHOT, 4, 8);                                          \
    change;                                                                                        \
    CHECK_INT(submit_campaign(&submission), error);                                                \
  } while (0)
  REFUSE(MO_ERR_NOT_FOUND, submission.controller = "nobody");
  REFUSE(MO_ERR_NOT_FOUND, strcpy(submission.record.environment_set, "nowhere"));
#undef REFUSE
  CHECK_INT(mo_store_campaign(store, 99, &status), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_job_environments(store, 99, MO_JOB_CAMPAIGN, &environments, &n),
            MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_job_designs(store, 99, &found, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_jobs(store, &(struct mo_job_query){0, -1, -1}, jobs, 1), 0); /* no rows left */
}

/* Returns whether a page with `room` entries contains n campaigns, from `first` to `last`. */
static bool lists(const struct mo_job_query *query, uint32_t room, int64_t n, int64_t first,
                  int64_t last)
{
  struct mo_campaign_status page[8];
  return mo_store_campaigns(store, query, page, room) == n && page[0].job.id == first &&
         page[n - 1].job.id == last;
}

static void starts_replicates(void)
{
  struct mo_bits *found = NULL;
  struct mo_campaign_request submission = campaign_submission(MO_ZERO_SHOT, 10, 30);
  struct mo_campaign_status status, page[8];
  struct mo_job_query query = {.state = -1};
  int64_t ids[8], id, again = 0, other;
  uint32_t n = 0;
  bool replayed = true;
  genotypes = make_bodies(5, 3, &forms);
  other = submit_campaign(&submission);
  submission.forms = forms;
  submission.genotypes = genotypes;
  submission.record.n_listed = 3;
  submission.record.replicates = 4;
  submission.record.settings.seed = MO_SEED_MAX - 3;
  submission.job.key.text = "once";
  submission.job.priority = MO_INTERACTIVE;
  REQUIRE_OK(mo_store_submit_campaign(store, &submission, &id, &replayed));
  CHECK(!replayed && id == other + 1);
  for (uint32_t r = 0; r < 4; r++) {
    status = status_of(id + r);
    CHECK_INT(status.record.group, id);
    CHECK_INT(status.record.replicate, r);
    CHECK_INT(status.record.replicates, 4);
    CHECK(status.record.settings.seed == (uint64_t)MO_SEED_MAX - 3 + r);
    found = designs_of(id + r, &n);
    CHECK(n == 3 && SAME(found, genotypes, 3));
    (void)environments_of(id + r, &n);
    CHECK_INT(n, MO_PAPER_TEST_COUNT);
    CHECK(strcmp(last_event(id + r).type, "job.created") == 0);
  }
  /* Repeating the key returns the first campaign; with another body it is a conflict. */
  CHECK_OK(mo_store_submit_campaign(store, &submission, &again, &replayed));
  CHECK(replayed && again == id);
  submission.job.key.sha256.bytes[0] ^= 1;
  CHECK_INT(mo_store_submit_campaign(store, &submission, &again, &replayed), MO_ERR_CONFLICT);
  /* Interactive campaigns come first, then the others in order of submission. */
  CHECK_INT(mo_store_queued_runs(store, MO_JOB_CAMPAIGN, ids, 8), 5);
  CHECK(ids[0] == id && ids[1] == id + 1 && ids[3] == id + 3 && ids[4] == other);
  CHECK_INT(mo_store_queued_runs(store, MO_JOB_CAMPAIGN, ids, 2), 2);
  CHECK_INT(mo_store_queued_runs(store, MO_JOB_TRAINING, ids, 8), 0);
  CHECK_INT(mo_store_queued(store, MO_INTERACTIVE, 0, true, ids, 8), 0);
  /* Lists begin with the newest. */
  CHECK(lists(&query, 8, 5, id + 3, other));
  query.before = id + 2;
  CHECK(lists(&query, 1, 1, id + 1, id + 1));
  query = (struct mo_job_query){.state = -1, .group = id};
  CHECK(lists(&query, 8, 4, id + 3, id));
  REQUIRE_OK(mo_store_run_start(store, id + 1));
  REQUIRE_OK(mo_store_run_start(store, id + 2));
  query.state = MO_JOB_RUNNING;
  CHECK(lists(&query, 8, 2, id + 2, id + 1));
  query.waiting = (const int64_t[]){id + 1}; /* shown as paused */
  query.n_waiting = 1;
  CHECK(lists(&query, 8, 1, id + 2, id + 2));
  query.state = MO_JOB_PAUSED;
  CHECK(lists(&query, 8, 1, id + 1, id + 1));
  query.group = other;
  CHECK_INT(mo_store_campaigns(store, &query, page, 8), 0);
  CHECK_INT(mo_store_campaigns(store, &query, page, MO_PAGE_MAX + 1), MO_ERR_LIMIT);
  CHECK_OK(check_whole());
}

static uint32_t notes_of(int64_t id, struct mo_design_note **notes)
{
  uint32_t n = 0;
  CHECK_OK(mo_store_design_notes(store, id, notes, &n));
  check_keep(*notes, free);
  return n;
}

/* A campaign copies the current population of another one. Later changes to that campaign do not
 * matter. */
static void inherits_a_population(void)
{
  struct made made = {0};
  struct mo_campaign_request submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, 30);
  struct mo_bits before[MADE_POPULATION], *found = NULL, *best = NULL;
  struct mo_design_note *notes = NULL;
  uint32_t n = 0, n_sound = 0, n_fitting = 0, n_noted = 0, n_notes;
  int64_t first = submit_campaign(&submission);
  submission.record.initial_campaign = first;
  CHECK_INT(submit_campaign(&submission), MO_ERR_CONFLICT); /* no population yet */
  CHECK_INT(mo_store_population(store, first, 0, &best, &n), MO_ERR_CONFLICT);
  submission.record.initial_campaign = 77;
  CHECK_INT(submit_campaign(&submission), MO_ERR_NOT_FOUND);
  REQUIRE_OK(mo_store_run_start(store, first));
  made = made_start(first, MO_ZERO_SHOT, 9);
  REQUIRE_OK(made_generation(&made));
  REQUIRE_OK(made_generation(&made));
  memcpy(before, made.genotypes, sizeof(before));
  submission.record.initial_campaign = first;
  int64_t second = submit_campaign(&submission);
  REQUIRE(second > 0);
  /* As designs for a training run: only those that did not diverge, best first. */
  for (uint32_t i = 0; i < made.n; i++)
    n_sound += isfinite(made.scores[i]) != 0;
  best = best_of(first, 0, &n);
  CHECK(n == n_sound && SAME(best, before, n));
  best = best_of(first, 2, &n);
  CHECK(n == 2 && SAME(best, before, 2));
  REQUIRE_OK(made_generation(&made));
  found = designs_of(second, &n);
  CHECK(n == MADE_POPULATION && SAME(found, before, n));
  /* The best designs are copied until the population is full. Another workspace gets only the
   * designs that fit; each of the others gets a note. */
  memcpy(before, made.genotypes, sizeof(before));
  submission.record.settings.population = 4;
  found = designs_of(submit_campaign(&submission), &n);
  CHECK(n == 4 && SAME(found, before, 4));
  CHECK_INT(notes_of(submit_campaign(&submission), &notes), 0);
  submission.record.settings.population = MADE_POPULATION;
  submission.record.settings.workspace = (struct mo_workspace){6, 3, 3};
  second = submit_campaign(&submission);
  REQUIRE(second > 0);
  found = designs_of(second, &n);
  n_notes = notes_of(second, &notes);
  for (uint32_t i = 0; i < MADE_POPULATION; i++) {
    const struct mo_genotype member = mo_genotype_of(MO_DEFAULT_WORKSPACE, &before[i]);
    if (mo_fits_as_it_is(submission.record.settings.workspace, &member)) {
      CHECK(n_fitting < n && SAME(&found[n_fitting], &before[i], 1));
      n_fitting++;
    } else {
      CHECK(n_noted < n_notes && notes[n_noted].place == i && mo_is_skipped(&notes[n_noted]));
      n_noted++;
    }
  }
  CHECK(n_fitting == n && n_noted == n_notes && n > 0 && n_notes > 0);
  /* If none fits, nothing is stored. */
  submission.record.settings.workspace = (struct mo_workspace){2, 1, 1};
  CHECK_INT(submit_campaign(&submission), MO_ERR_EMPTY);
  submission.record.settings.workspace = MO_DEFAULT_WORKSPACE;
  CHECK_INT(submit_campaign(&submission), second + 1);
  CHECK_OK(check_whole());
}

static struct {
  struct mo_controller *controller;
  uint8_t *bytes;
  size_t size;
} result;

/* Finishes a campaign, with a result if a name is given. */
static int finish(int64_t id, enum mo_campaign_end end, uint32_t generations, const char *name)
{
  return mo_store_campaign_finish(
      store, id, end, generations, name, name != NULL ? result.bytes : NULL,
      name != NULL ? result.size : 0, name != NULL ? result.controller : NULL);
}

/* Returns the previous state, or an error. */
static int extend(int64_t id, uint32_t generations, const struct mo_request_key *key)
{
  enum mo_job_state before = MO_JOB_FAILED;
  const int error = mo_store_extend_campaign(store, id, generations, key, &before);
  return error != MO_OK ? error : (int)before;
}

static void finish_with_its_result(int64_t id)
{
  static const enum mo_campaign_end end = MO_CAMPAIGN_COMPLETED;
  const struct mo_sha256 odd = {{0xab, 0xcd}};
  struct mo_controller_record record;
  CHECK_OK(mo_store_campaign_lineage_fault(store, id, &odd, "morphod.seed", "no number"));
  struct mo_event event = last_event(id);
  CHECK_TEXT(event.type, "campaign.lineage_unreadable");
  CHECK_HAS(event.data, "\"controller\":\"abcd00");
  CHECK_HAS(event.data, "\"field\":\"morphod.seed\",\"detail\":\"no number\"}");
  CHECK_INT(finish(id, end, 0, "walker"), MO_ERR_CONFLICT); /* more generations remain */
  CHECK_INT(mo_store_controller(store, "walker", &record), MO_ERR_NOT_FOUND);
  CHECK_INT(finish(id, end, 1, "Not A Name"), MO_ERR_FORMAT);
  CHECK_OK(finish(id, end, 1, "walker"));
  const struct mo_campaign_status status = status_of(id);
  CHECK(status.job.state == MO_JOB_SUCCEEDED && status.job.finished_us > 0 && status.end == end);
  CHECK_OK(mo_store_controller(store, "walker", &record));
  CHECK(status.job.has_result && mo_sha256_equal(&status.job.result_sha256, &record.sha256));
  event = last_event(id);
  CHECK_TEXT(event.type, "job.finished");
  CHECK_HAS(event.data, "\"kind\":\"campaign\",\"state\":\"succeeded\",\"end\":\"completed\","
                        "\"controller\":\"walker\",\"sha256\":\"");
  CHECK_INT(finish(id, end, 1, "walker"), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_campaign_lineage_fault(store, id, &odd, "morphod.seed", "no number"),
            MO_ERR_CONFLICT);
}

static void finishes_and_extends(void)
{
  struct mo_campaign_request submission = campaign_submission(MO_SIMULTANEOUS, 4, 1);
  struct mo_request_key key = {.text = "more"};
  int64_t id = submit_campaign(&submission);
  result.controller = make_random_controller(MO_SENSOR_INVERSE_SQRT, 77);
  REQUIRE_OK(mo_controller_encode(result.controller, &result.bytes, &result.size));
  check_keep(result.bytes, free);
  /* A queued campaign cannot finish. */
  CHECK_INT(finish(id, MO_CAMPAIGN_COMPLETED, 9, NULL), MO_ERR_CONFLICT);
  REQUIRE_OK(mo_store_run_start(store, id));
  finish_with_its_result(id);
  /* After success: queued again, and its end is reset. */
  CHECK_INT(extend(id, 2, NULL), MO_JOB_SUCCEEDED);
  struct mo_campaign_status status = status_of(id);
  CHECK(status.job.state == MO_JOB_QUEUED && status.job.finished_us == 0 &&
        status.end == MO_CAMPAIGN_OPEN);
  CHECK(!status.job.has_result && status.record.settings.generations == 3 &&
        status.job.steps_total == 3);
  struct mo_event event = last_event(id);
  CHECK_TEXT(event.type, "campaign.extended");
  CHECK_HAS(event.data, "\"state\":\"queued\",\"generations\":3,\"added\":2");
  /* Queued, running or paused: only the number of generations grows. */
  CHECK_INT(extend(id, 1, NULL), MO_JOB_QUEUED);
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_INT(extend(id, 1, NULL), MO_JOB_RUNNING);
  CHECK_INT(state_of(id), MO_JOB_RUNNING);
  CHECK_INT(finish(id, MO_CAMPAIGN_COMPLETED, 4, NULL),
            MO_ERR_CONFLICT); /* extended in the meantime */
  CHECK_OK(change(id, MO_CHANGE_PAUSE));
  CHECK_INT(finish(id, MO_CAMPAIGN_COMPLETED, 5, NULL), MO_ERR_CONFLICT);
  CHECK_INT(extend(id, 1, NULL), MO_JOB_PAUSED);
  CHECK_INT(state_of(id), MO_JOB_PAUSED);
  CHECK_INT(job_of(id).steps_total, 6);
  /* With a key, an extension happens once. */
  mo_sha256_of("one", 3, &key.sha256);
  CHECK_INT(extend(id, 1, &key), MO_JOB_PAUSED);
  CHECK_INT(extend(id, 1, &key), MO_JOB_QUEUED);
  mo_sha256_of("two", 3, &key.sha256);
  CHECK_INT(extend(id, 2, &key), MO_ERR_DUPLICATE);
  CHECK_INT(job_of(id).steps_total, 7);
  /* The limits on generations, designs, and learning steps. */
  CHECK_INT(extend(id, MO_GENERATIONS_MAX - 6, NULL), MO_ERR_RANGE);
  CHECK_INT(extend(id, UINT32_MAX, NULL), MO_ERR_RANGE);
  CHECK_INT(extend(id, MO_GENERATIONS_MAX - 7, NULL), MO_JOB_PAUSED);
  submission.record.settings.child_steps = 1000;
  submission.record.settings.generations = 900;
  id = submit_campaign(&submission);
  CHECK_INT(extend(id, 98, NULL), MO_ERR_RANGE); /* 1000 + 1002 · 998 steps */
  CHECK_INT(extend(id, 97, NULL), MO_JOB_QUEUED);
  submission = campaign_submission(MO_ZERO_SHOT, MO_POPULATION_MAX, 4000);
  id = submit_campaign(&submission);
  CHECK_INT(extend(id, 96, NULL), MO_ERR_RANGE); /* 2^16 · 4097 designs */
  CHECK_INT(extend(id, 95, NULL), MO_JOB_QUEUED);
  /* Only schedules that do not depend on the number of generations can be extended. */
  submission = campaign_submission(MO_SIMULTANEOUS, 4, 1);
  submission.record.settings.learning.schedule.kind = MO_SCHEDULE_COSINE;
  CHECK_INT(extend(submit_campaign(&submission), 1, NULL), MO_ERR_UNSUPPORTED);
  submission.record.settings.mode = MO_FEW_SHOT;
  submission.controller = "default";
  id = submit_campaign(&submission);
  CHECK_INT(extend(id, 1, NULL), MO_JOB_QUEUED);
  /* An exhausted campaign cannot find any new design. */
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_OK(finish(id, MO_CAMPAIGN_EXHAUSTED, 2, NULL));
  CHECK_HAS(last_event(id).data, "\"end\":\"exhausted\"}");
  status = status_of(id);
  CHECK(status.end == MO_CAMPAIGN_EXHAUSTED && !status.job.has_result);
  CHECK_INT(extend(id, 1, NULL), MO_ERR_CONFLICT);
  /* Cancelled, failed, or unknown campaigns cannot be extended. */
  id = submit_campaign(&submission);
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  CHECK_INT(extend(id, 1, NULL), MO_ERR_CONFLICT);
  id = submit_campaign(&submission);
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_OK(mo_store_run_park(store, id, MO_ERR_NO_MEMORY, "out of memory", 1, NULL));
  CHECK_INT(state_of(id), MO_JOB_FAILED);
  CHECK_INT(extend(id, 1, NULL), MO_ERR_CONFLICT);
  CHECK_INT(extend(12345, 1, NULL), MO_ERR_NOT_FOUND);
  CHECK_OK(check_whole());
}

static void parks_and_requeues(void)
{
  const struct mo_campaign_request submission =
      campaign_submission(MO_FEW_SHOT, MADE_POPULATION, 100);
  int64_t id = submit_campaign(&submission);
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_TEXT(last_event(id).type, "job.started");
  CHECK_INT(park(id, MO_OK), MO_JOB_QUEUED);
  CHECK_TEXT(last_event(id).type, "job.requeued");
  CHECK(park(id, MO_OK) >= 0); /* not running */
  /* A process that crashes leaves the campaign running; the next process requeues it. */
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_OK(reopen());
  CHECK_INT(state_of(id), MO_JOB_RUNNING);
  CHECK_OK(mo_store_requeue(store, 0, 3, ""));
  CHECK_INT(state_of(id), MO_JOB_QUEUED);
  /* After an error, a crash and another error, the campaign fails, unless a generation was
   * committed in between. */
  struct made made = made_start(id, MO_FEW_SHOT, 3);
  for (int round = 0; round < 2; round++) {
    REQUIRE_OK(mo_store_run_start(store, id));
    CHECK_INT(park(id, MO_ERR_NO_MEMORY), MO_JOB_QUEUED);
    CHECK_OK(mo_store_requeue(store, id, 3, "killed"));
    CHECK_INT(job_of(id).attempts, 2);
    CHECK_TEXT(job_of(id).error_text, "killed");
    REQUIRE_OK(mo_store_run_start(store, id));
    if (round == 0) {
      REQUIRE_OK(made_generation(&made));
      CHECK_INT(job_of(id).attempts, 0);
      CHECK_INT(park(id, MO_OK), MO_JOB_QUEUED);
    }
  }
  CHECK_INT(park(id, MO_ERR_NO_MEMORY), MO_JOB_FAILED);
  CHECK_INT(mo_store_run_start(store, id), MO_ERR_CONFLICT);
  CHECK_HAS(last_event(id).data, "\"kind\":\"campaign\",\"state\":\"failed\"");
  /* A retry requeues a failed campaign; a resumption does not. A retry of an open campaign changes
   * nothing, and a cancelled one cannot be retried. */
  enum mo_job_state before;
  CHECK_INT(change(id, MO_CHANGE_RESUME), MO_ERR_CONFLICT);
  CHECK_OK(mo_store_change_job(store, id, MO_CHANGE_RETRY, &before));
  CHECK_INT(before, MO_JOB_FAILED);
  const struct mo_job job = job_of(id);
  CHECK(job.state == MO_JOB_QUEUED && job.attempts == 0 && job.error == MO_OK &&
        job.finished_us == 0);
  CHECK_TEXT(last_event(id).type, "job.resumed");
  CHECK_OK(mo_store_change_job(store, id, MO_CHANGE_RETRY, &before));
  CHECK_INT(before, MO_JOB_QUEUED);
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  CHECK_INT(change(id, MO_CHANGE_RETRY), MO_ERR_CONFLICT);
  /* A paused campaign stays paused. */
  id = submit_campaign(&submission);
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_OK(change(id, MO_CHANGE_PAUSE));
  CHECK_INT(park(id, MO_OK), MO_JOB_PAUSED);
  CHECK_INT(mo_store_run_start(store, id), MO_ERR_CONFLICT);
  CHECK_OK(change(id, MO_CHANGE_RESUME));
  CHECK_OK(mo_store_run_start(store, id));
}

static const struct check_case cases[] = {
    {"encodes every setting", encodes_every_setting},
    {"names the score of a study", names_the_score_of_a_study},
    {"names the worlds of learning", names_the_worlds_of_learning},
    {"names the aggregate", names_the_aggregate},
    {"names the re-evaluation only where there is one", names_the_re_evaluation},
    {"keeps the physics of older jobs", keeps_the_physics_of_older_jobs},
    {"refuses invalid requests", refuses_what_cannot_be},
    {"starts replicates", starts_replicates},
    {"inherits a population", inherits_a_population},
    {"finishes and extends", finishes_and_extends},
    {"parks and requeues", parks_and_requeues},
};
CHECK_MAIN_AROUND(cases, with_a_store)
