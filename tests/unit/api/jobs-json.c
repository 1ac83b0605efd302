/* Training runs and campaigns as JSON and CSV: non-finite numbers, a job that waits for room, a job
 * that continued from a checkpoint, an exhausted campaign, replicates; and Newick text in
 * pieces. */
#include "unit/check.h"

#include <jansson.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "api/replicates.h"
#include "exchange/columns.h"

static struct mo_training_status training;
static struct mo_campaign_status campaign;
static struct mo_live live;
static json_t *json;

static void begin_training(enum mo_training_kind kind, enum mo_job_state state)
{
  training = (struct mo_training_status){
      .job = {.id = 12, .kind = MO_JOB_TRAINING, .state = state, .created_us = 1}};
  training.record.settings = mo_training_defaults(kind);
  live = (struct mo_live){.seconds_left = -1};
}

static void begin_campaign(enum mo_campaign_mode mode, enum mo_job_state state)
{
  campaign = (struct mo_campaign_status){
      .job = {.id = 12, .kind = MO_JOB_CAMPAIGN, .state = state, .created_us = 1},
      .generation = -1};
  campaign.record.settings = mo_campaign_preset(mode, MO_PRESET_DEMO);
  campaign.record.group = 12;
  campaign.record.replicates = 1;
  live = (struct mo_live){.seconds_left = -1, .busy_s = -1};
}

static void parse(struct mo_text *text)
{
  json_decref(json);
  json = json_loadb(text->data, text->size, JSON_REJECT_DUPLICATES, NULL);
  CHECK(json != NULL);
  mo_text_free(text);
}

static void write_training(bool as_job)
{
  struct mo_text text = {0};
  if (as_job) {
    mo_training_json_job(&text, &training, &live);
  } else {
    mo_training_json_write(&text, &training, MO_JOB_EVALUATION, NULL, &live);
    mo_text_add(&text, "}"); /* the notes of its designs follow */
  }
  parse(&text);
}

static void write_campaign(bool as_job)
{
  struct mo_text text = {0};
  if (as_job) {
    mo_campaign_json_job(&text, &campaign, &live);
  } else {
    mo_campaign_json_write(&text, &campaign, &live);
    mo_text_add(&text, "}");
  }
  parse(&text);
}

/* Returns the member at a path such as "settings.learning.sensor". */
static const json_t *at(const char *path)
{
  const json_t *node = json;
  char part[64];
  for (; *path != '\0'; path += *path == '.') {
    size_t size = strcspn(path, ".");
    snprintf(part, sizeof(part), "%.*s", (int)size, path);
    node = json_object_get(node, part);
    path += size;
  }
  return node;
}

static const char *text_at(const char *path)
{
  const char *text = json_string_value(at(path));
  return text != NULL ? text : "";
}

static bool has_number(const char *path, double value)
{
  return json_is_number(at(path)) && json_number_value(at(path)) == value;
}

/* Checks that the members at these blank-separated paths are null. */
static void check_null(const char *paths)
{
  char path[64];
  for (int size = 0; sscanf(paths, "%63s%n", path, &size) == 1; paths += size) {
    if (!json_is_null(at(path)))
      printf("# %s is not null\n", path);
    CHECK(json_is_null(at(path)));
  }
}

static void check_rule(const char *settings, const char *rule, double weight)
{
  char path[64];
  snprintf(path, sizeof(path), "%s.adjoint_rule", settings);
  CHECK_TEXT(text_at(path), rule);
  snprintf(path, sizeof(path), "%s.restart_weight", settings);
  CHECK(has_number(path, weight));
}

/* If no mutation rate is given, it is one flip per body of the workspace. */
static void mutation_rate(void)
{
  begin_campaign(MO_ZERO_SHOT, MO_JOB_QUEUED);
  write_campaign(false);
  check_null("preset name controller newest end result progress.generation progress.under_way "
             "progress.rollouts_per_s progress.busy_s settings.learning");
  CHECK(has_number("settings.mutation.rate", 1.0 / 144));
  campaign.record.settings.workspace = (struct mo_workspace){2, 2, 2};
  campaign.record.settings.mutation_rate = 0;
  write_campaign(false);
  CHECK(has_number("settings.mutation.rate", 0.125));
}

static void training_runs(void)
{
  begin_training(MO_TRAINING_PRETRAIN, MO_JOB_RUNNING);
  training.step = 90;
  training.checkpoint_step = 80;
  training.last.report = (struct mo_training_report){
      .step = 90, .mean_loss = 0.25, .rate = 1e-3, .gradient_norm = 0.5};
  live = (struct mo_live){.phase = MO_PHASE_LEARN, .rate = 64, .seconds_left = 30};
  write_training(false); /* being prepared: the step is not known yet */
  CHECK(has_number("progress.step", 80));
  live.position = 85; /* after a crash: past the end of the curve */
  write_training(false);
  CHECK(has_number("progress.step", 85));
  CHECK_TEXT(text_at("state"), "running");
  CHECK(has_number("progress.mean_loss", 0.25) && has_number("progress.bodies_per_s", 64) &&
        has_number("progress.seconds_left", 30));
  live.phase = MO_PHASE_REPLAY;
  live.done = 5;
  live.total = 20;
  write_training(false);
  CHECK_TEXT(text_at("phase"), "replaying");
  CHECK(has_number("progress.replayed", 5) && has_number("progress.replay_total", 20));
}

/* Checks the state and the reason, both in the full object and in the list of jobs. */
static void check_reason(void (*write)(bool), const char *state, const char *reason)
{
  for (int as_job = 0; as_job < 2; as_job++) {
    write(as_job != 0);
    CHECK_TEXT(text_at("state"), state);
    CHECK_TEXT(text_at("reason"), reason);
  }
}

/* A job that waits for room is paused until a client cancels it. */
static void waits_for_room(void)
{
  const struct mo_live waits = {.phase = MO_PHASE_WAIT,
                                .position = 7,
                                .seconds_left = -1,
                                .busy_s = 3,
                                .reason = "no \"space\""};
  begin_training(MO_TRAINING_PRETRAIN, MO_JOB_RUNNING);
  begin_campaign(MO_FEW_SHOT, MO_JOB_RUNNING);
  live = waits;
  check_reason(write_training, "paused", waits.reason);
  CHECK_TEXT(text_at("kind"), "training");
  CHECK(has_number("training.step", 7));
  training.job.state = MO_JOB_PAUSED; /* its checkpoint is not written yet */
  check_reason(write_training, "paused", waits.reason);
  check_reason(write_campaign, "paused", waits.reason);
  CHECK_TEXT(text_at("kind"), "campaign");
  CHECK(json_is_null(at("campaign.generation")) && has_number("campaign.generations", 3));
  training.job.state = campaign.job.state = MO_JOB_CANCELLED;
  check_reason(write_training, "cancelled", "");
  check_reason(write_campaign, "cancelled", "");
  write_campaign(false);
  CHECK_TEXT(text_at("name"), "campaign-12");
}

/* A running campaign reports which campaign's drawing it waits for. */
static void waits_for_another(void)
{
  begin_campaign(MO_FEW_SHOT, MO_JOB_RUNNING);
  live = (struct mo_live){.phase = MO_PHASE_PREPARE,
                          .done = 5,
                          .total = 9,
                          .seconds_left = 2.5,
                          .busy_s = 0,
                          .reason = "campaign 7 draws"};
  check_reason(write_campaign, "running", "campaign 7 draws");
  write_campaign(false);
  CHECK(has_number("progress.done", 5) && has_number("progress.seconds_left", 2.5));
  live.reason[0] = '\0';
  write_campaign(false);
  CHECK(json_is_null(at("reason")));
}

static void training_failed(void)
{
  begin_training(MO_TRAINING_FINETUNE, MO_JOB_FAILED);
  training.record.settings.learning.gradient.adjoint_rule = MO_ADJOINT_RESTART;
  training.record.settings.learning.gradient.restart_weight = 0.5;
  training.job.has_controller = true;
  training.record.n_designs = 3;
  training.record.population = 5;
  training.job.error = MO_ERR_IO;
  snprintf(training.job.error_text, sizeof(training.job.error_text), "the \x01 disk");
  snprintf(training.record.name, sizeof(training.record.name), "walker");
  training.step = 60;
  training.last.report =
      (struct mo_training_report){.step = 60, .mean_loss = NAN, .diverged = 256, .skipped = true};
  training.has_validation = true;
  training.validation =
      (struct mo_training_validation_row){.step = 60, .mean_score = NAN, .standard_error = NAN};
  training.job.has_result = true;
  write_training(false);
  CHECK_TEXT(text_at("error.code"), "io");
  CHECK_TEXT(text_at("parent.sha256"),
             "0000000000000000000000000000000000000000000000000000000000000000");
  check_null("parent.name settings.sensor progress.mean_loss validation.mean_score "
             "validation.standard_error");
  CHECK(has_number("settings.n_designs", 3) && json_is_true(at("progress.skipped")));
  check_rule("settings", "restart", 0.5);
  CHECK_TEXT(text_at("settings.population.evaluation"), "5");
  CHECK_TEXT(text_at("controller.name"), "walker");
  CHECK_TEXT(text_at("links.held_out"), "/v1/trainings/12/held-out");
}

/* Checks the first values of a row in column order: null is empty, a flag is a digit. */
static void check_row(const struct mo_columns *columns, const void *row, const char *begins)
{
  struct mo_text text = {0}, values = {0};
  mo_columns_json(&text, columns, row);
  parse(&text);
  for (size_t i = 0; i < columns->n; i++) {
    const json_t *value = at(columns->items[i].path);
    REQUIRE(value != NULL);
    if (json_is_number(value))
      mo_text_json_number(&values, json_number_value(value));
    else if (json_is_boolean(value))
      mo_text_add(&values, json_is_true(value) ? "1" : "0");
    else
      CHECK(json_is_null(value));
    mo_text_add(&values, ",");
  }
  REQUIRE(!values.failed);
  CHECK(strncmp(values.data, begins, strlen(begins)) == 0);
  mo_text_free(&values);
}

/* A population in which every member diverged. */
static void campaign_exhausted(void)
{
  begin_campaign(MO_SIMULTANEOUS, MO_JOB_SUCCEEDED);
  campaign.end = MO_CAMPAIGN_EXHAUSTED;
  campaign.job.has_result = true;
  campaign.generation = 7;
  campaign.last = (struct mo_campaign_generation){.generation = 7,
                                                  .born_before = 14,
                                                  .mean_parents = NAN,
                                                  .mean_children = NAN,
                                                  .first_loss = NAN,
                                                  .last_loss = 0.5,
                                                  .variation = {.exhausted = true},
                                                  .collapse = true};
  campaign.last.stats = (struct mo_population_stats){.n = 2, .n_diverged = 2, .mean_score = NAN};
  for (int q = 0; q < MO_QUANTILES; q++)
    campaign.last.stats.quantiles[q] = NAN;
  write_campaign(false);
  CHECK_TEXT(text_at("end"), "exhausted");
  CHECK_TEXT(text_at("result.controller.name"), "campaign-12");
  CHECK(json_is_null(at("newest.score.mean")) && json_is_null(at("newest.parents_mean")));
  CHECK(json_is_true(at("newest.exhausted")) && json_is_true(at("newest.collapse")));
  CHECK(has_number("newest.learning.last_loss", 0.5));
  CHECK_TEXT(text_at("settings.learning.sensor"), "inverse_sqrt");
  check_rule("settings.learning", "clip", 3);
  campaign.record.settings.learning.gradient.adjoint_rule = MO_ADJOINT_RESTART;
  campaign.record.settings.learning.gradient.restart_weight = 0.5;
  write_campaign(false);
  check_rule("settings.learning", "restart", 0.5);
  check_row(&mo_generation_columns, &campaign.last, "7,2,0,14,,,,,,,,,2,0,0,0,");
}

static void training_rows(void)
{
  const struct mo_training_step_row step = {
      {.step = 3, .mean_loss = NAN, .rate = 0.5, .diverged = 2, .skipped = true}, 0.25};
  const struct mo_training_validation_row validation = {
      .step = 0, .mean_score = 1, .standard_error = INFINITY, .rollouts = 8};
  check_row(&mo_step_columns, &step, "3,,0.5,0,0,0,2,0,1,0,0.25,");
  check_row(&mo_validation_columns, &validation, "0,1,,8,0,");
}

static void check_shape(const struct mo_campaign_design *row, int64_t generation,
                        struct mo_phylogeny_shape shape, const char *begins)
{
  struct mo_text text = {0};
  mo_campaign_csv_design(&text, row, generation, &shape);
  CHECK(strncmp(text.data, begins, strlen(begins)) == 0);
  mo_text_free(&text);
}

static void check_design(const struct mo_campaign_design *row, int64_t generation,
                         const char *begins)
{
  check_shape(row, generation, (struct mo_phylogeny_shape){.root = -1}, begins);
}

static void designs(void)
{
  struct mo_campaign_design row = {
      .number = 5,
      .form = {MO_DEFAULT_WORKSPACE, {1}},
      .genotype = {MO_DEFAULT_WORKSPACE, {1}},
      .descent = {.parents = {3, MO_NO_PARENT}, .op = MO_BORN_MUTATION},
      .born = 2,
      .died = 4,
      .score = INFINITY,
      .size = {1, 1, 8, 24},
      .n_measures = 1,
      .measures = {0.1}};
  const struct mo_study_words words = {.n_measures = 2, .measures = {"reach", "height"}};
  struct mo_text text = {0};
  mo_text_add(&text, "{");
  mo_campaign_json_design(&text, &row, &words);
  mo_text_add(&text, "}");
  parse(&text);
  CHECK(json_is_null(at("score")) && json_integer_value(at("died")) == 4);
  CHECK_INT(json_array_size(at("parents")), 1);
  CHECK(json_real_value(at("measures.reach")) == 0.1 && json_is_null(at("measures.height")));
  check_design(&row, 4, "5,\"[3]\",2,4,mutation,,d80000");
  check_design(&row, 3, "5,\"[3]\",2,inf,mutation,,"); /* alive at the end of generation 3 */
  row.descent = (struct mo_descent){.parents = {MO_NO_PARENT, MO_NO_PARENT}, .op = MO_BORN_RANDOM};
  row.died = -1;
  row.score = 0.5;
  check_design(&row, 9, "5,\"[none]\",2,inf,random,0.5,");
  check_shape(&row, 9, (struct mo_phylogeny_shape){.root = 20}, "5,\"[20]\",2,");
  row.descent = (struct mo_descent){.parents = {3, 4}, .op = MO_BORN_CROSSOVER};
  check_design(&row, 9, "5,\"[3,4]\",2,");
  check_shape(&row, 9, (struct mo_phylogeny_shape){true, 20, 0}, "5,\"[3]\",2,");
}

static void replicates(void)
{
  struct mo_replicate_row row = {0};
  struct mo_campaign_generation one = {.generation = 3};
  struct mo_text text = {0};
  const double means[] = {0.5, NAN, 0.25};
  for (int i = 0; i < 3; i++) {
    one.stats.mean_score = means[i];
    one.stats.quantiles[0] = NAN;
    one.stats.diversity = 0.1 * i;
    mo_replicate_add(&row, &one);
  }
  mo_replicate_finish(&row);
  mo_columns_json(&text, &mo_replicate_columns, &row);
  parse(&text);
  CHECK_INT(json_integer_value(at("campaigns")), 3);
  CHECK(json_real_value(at("mean_score.mean")) == 0.375 &&
        json_real_value(at("mean_score.least")) == 0.25);
  CHECK(json_is_null(at("best_score.mean")) && json_real_value(at("diversity.most")) == 0.2);
  check_row(&mo_replicate_columns, &row, "3,3,0.25,0.375,0.5,,,,0,");
}

static const struct check_case cases[] = {
    {"a campaign that has not started", mutation_rate},
    {"a running training", training_runs},
    {"waiting for room", waits_for_room},
    {"a campaign that waits for another", waits_for_another},
    {"a failed training", training_failed},
    {"a campaign in which all diverged", campaign_exhausted},
    {"rows of trainings", training_rows},
    {"designs with births and deaths", designs},
    {"replicates", replicates},
};
CHECK_MAIN(cases)
