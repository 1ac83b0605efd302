/* Trainings as JSON and CSV: what is not finite, a training that waits for room, one that went on
 * from a checkpoint. */
#include "unit/check.h"

#include <jansson.h>

#include "api/columns.h"
#include "api/training_json.h"

static struct mo_training_status status;
static struct mo_live live;
static json_t *json;

static void begin(enum mo_job_state state)
{
  status = (struct mo_training_status){
      .job = {.id = 12, .kind = MO_JOB_TRAINING, .state = state, .created_us = 1}};
  status.record.settings = mo_training_defaults(MO_TRAINING_PRETRAIN);
  live = (struct mo_live){.seconds_left = -1};
}

static void write(bool as_job)
{
  struct mo_text text = {0};
  if (as_job)
    mo_training_json_job(&text, &status, &live);
  else
    mo_training_json_write(&text, &status, MO_JOB_EVALUATION, &live);
  json_decref(json);
  json = json_loadb(text.data, text.size, JSON_REJECT_DUPLICATES, NULL);
  CHECK(json != NULL);
  mo_text_free(&text);
}

static const json_t *at(const char *group, const char *key)
{
  return json_object_get(group != NULL ? json_object_get(json, group) : json, key);
}

static const char *text_at(const char *key)
{
  const char *text = json_string_value(at(NULL, key));
  return text != NULL ? text : "";
}

static void fresh(void)
{
  begin(MO_JOB_QUEUED);
  write(false);
  CHECK_TEXT(text_at("state"), "queued");
  CHECK_TEXT(text_at("name"), "training-12");
  CHECK_TEXT(text_at("phase"), "idle");
  CHECK(json_is_null(at(NULL, "reason")) && json_is_null(at(NULL, "parent")) &&
        json_is_null(at(NULL, "controller")));
  CHECK(json_is_null(at(NULL, "checkpoint_step")) && json_is_null(at(NULL, "validation")));
  CHECK(json_is_null(at("progress", "mean_loss")) && json_is_null(at("progress", "seconds_left")));
  CHECK_INT(json_integer_value(at("progress", "steps")), 1400);
  CHECK(json_is_null(at("settings", "n_designs")));
  CHECK_TEXT(json_string_value(at("settings", "sensor")), "inverse_sqrt");
  CHECK_TEXT(json_string_value(at("settings", "adjoint_rule")), "clip");
  CHECK(json_number_value(at("settings", "restart_weight")) == 3);
}

static void runs(void)
{
  begin(MO_JOB_RUNNING);
  status.step = 90;
  status.checkpoint_step = 80;
  status.last.report = (struct mo_training_report){
      .step = 90, .mean_loss = 0.25, .rate = 1e-3, .gradient_norm = 0.5};
  live = (struct mo_live){.phase = MO_PHASE_LEARN, .rate = 64, .seconds_left = 30};
  write(false); /* being prepared: the step is not known yet */
  CHECK_INT(json_integer_value(at("progress", "step")), 80);
  live.position = 85; /* after a crash, behind the curve */
  write(false);
  CHECK_INT(json_integer_value(at("progress", "step")), 85);
  CHECK_TEXT(text_at("state"), "running");
  CHECK(json_real_value(at("progress", "mean_loss")) == 0.25);
  CHECK(json_number_value(at("progress", "bodies_per_s")) == 64 &&
        json_number_value(at("progress", "seconds_left")) == 30);
  live.phase = MO_PHASE_REPLAY;
  live.done = 5;
  live.total = 20;
  write(false);
  CHECK_TEXT(text_at("phase"), "replaying");
  CHECK(json_integer_value(at("progress", "replayed")) == 5 &&
        json_integer_value(at("progress", "replay_total")) == 20);
}

static void waits_for_room(void)
{
  begin(MO_JOB_RUNNING);
  live = (struct mo_live){
      .phase = MO_PHASE_WAIT, .position = 7, .seconds_left = -1, .reason = "no \"space\""};
  for (int as_job = 0; as_job < 2; as_job++) {
    write(as_job != 0);
    CHECK_TEXT(text_at("state"), "paused");
    CHECK_TEXT(text_at("reason"), "no \"space\"");
  }
  CHECK_TEXT(text_at("kind"), "training");
  CHECK_INT(json_integer_value(at("training", "step")), 7);
  status.job.state = MO_JOB_PAUSED; /* its checkpoint is not written yet */
  write(false);
  CHECK_TEXT(text_at("state"), "paused");
  CHECK_TEXT(text_at("reason"), "no \"space\"");
  status.job.state = MO_JOB_CANCELLED; /* what people did counts */
  write(false);
  CHECK_TEXT(text_at("state"), "cancelled");
  CHECK(json_is_null(at(NULL, "reason")));
}

static void ended(void)
{
  begin(MO_JOB_FAILED);
  status.record.settings = mo_training_defaults(MO_TRAINING_FINETUNE);
  status.record.settings.learning.adjoint_rule = MO_ADJOINT_RESTART;
  status.record.settings.learning.restart_weight = 0.5;
  status.record.has_parent = true;
  status.record.n_designs = 3;
  status.record.population = 5;
  status.job.error = MO_ERR_IO;
  snprintf(status.job.error_text, sizeof(status.job.error_text), "the \x01 disk");
  snprintf(status.record.name, sizeof(status.record.name), "walker");
  status.step = 60;
  status.last.report =
      (struct mo_training_report){.step = 60, .mean_loss = NAN, .diverged = 256, .skipped = true};
  status.has_validation = true;
  status.validation =
      (struct mo_training_validation_row){.step = 60, .mean_score = NAN, .standard_error = NAN};
  status.has_result = true;
  write(false);
  CHECK_TEXT(json_string_value(at("error", "code")), "io");
  CHECK_TEXT(json_string_value(at("parent", "sha256")),
             "0000000000000000000000000000000000000000000000000000000000000000");
  CHECK(json_is_null(at("parent", "name")) && json_is_null(at("settings", "sensor")));
  CHECK_INT(json_integer_value(at("settings", "n_designs")), 3);
  CHECK_TEXT(json_string_value(at("settings", "adjoint_rule")), "restart");
  CHECK(json_number_value(at("settings", "restart_weight")) == 0.5);
  CHECK_TEXT(json_string_value(json_object_get(at("settings", "population"), "evaluation")), "5");
  CHECK(json_is_null(at("progress", "mean_loss")) && json_is_true(at("progress", "skipped")));
  CHECK(json_is_null(at("validation", "mean_score")) &&
        json_is_null(at("validation", "standard_error")));
  CHECK_TEXT(json_string_value(at("controller", "name")), "walker");
  CHECK_TEXT(json_string_value(at("links", "held_out")), "/v1/trainings/12/held-out");
}

static void tables(void)
{
  struct mo_text text = {0};
  const struct mo_training_step_row step = {
      {.step = 3, .mean_loss = NAN, .rate = 0.5, .diverged = 2, .skipped = true}, 0.25};
  const struct mo_training_validation_row validation = {
      .step = 0, .mean_score = 1, .standard_error = INFINITY, .rollouts = 8};
  mo_columns_csv(&text, &mo_step_columns, &step);
  mo_columns_csv(&text, &mo_validation_columns, &validation);
  REQUIRE(!text.failed);
  CHECK_TEXT(text.data, "3,,0.5,0,0,0,2,0,1,0,0.25\n0,1,,8,0\n");
  mo_text_free(&text);
  /* As many cells as headings. */
  size_t commas = 0;
  mo_columns_heading(&text, &mo_step_columns);
  for (size_t i = 0; i < text.size; i++)
    commas += text.data[i] == ',';
  CHECK_INT(commas, 10);
  mo_text_free(&text);
  json_decref(json);
  json = NULL;
}

static const struct check_case cases[] = {
    {"a training that is fresh", fresh},
    {"one that runs", runs},
    {"one that waits for room", waits_for_room},
    {"one that has ended", ended},
    {"tables", tables},
};
CHECK_MAIN(cases)
