/* Campaigns as JSON and CSV: what is not finite, one that waits for room, one that is exhausted,
 * replicates; Newick piece by piece. */
#include "unit/check.h"

#include <jansson.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/campaign_json.h"
#include "api/columns.h"
#include "api/newick_pieces.h"

static struct mo_campaign_status status;
static struct mo_live live;
static json_t *json;

static void begin(enum mo_campaign_mode mode, enum mo_job_state state)
{
  status = (struct mo_campaign_status){
      .job = {.id = 12, .kind = MO_JOB_CAMPAIGN, .state = state, .created_us = 1},
      .generation = -1};
  status.record.settings = mo_campaign_preset(mode, MO_PRESET_DEMO);
  status.record.group = 12;
  status.record.replicates = 1;
  live = (struct mo_live){.seconds_left = -1, .busy_s = -1};
}

static void parse(struct mo_text *text)
{
  json_decref(json);
  json = json_loadb(text->data, text->size, JSON_REJECT_DUPLICATES, NULL);
  CHECK(json != NULL);
  mo_text_free(text);
}

static void write(bool as_job)
{
  struct mo_text text = {0};
  if (as_job)
    mo_campaign_json_job(&text, &status, &live);
  else
    mo_campaign_json_write(&text, &status, &live);
  parse(&text);
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
  begin(MO_ZERO_SHOT, MO_JOB_QUEUED);
  write(false);
  CHECK_TEXT(text_at("state"), "queued");
  CHECK_TEXT(text_at("phase"), "idle");
  CHECK(json_is_null(at(NULL, "preset")) && json_is_null(at(NULL, "name")) &&
        json_is_null(at(NULL, "controller")));
  CHECK(json_is_null(at(NULL, "newest")) && json_is_null(at(NULL, "end")) &&
        json_is_null(at(NULL, "result")));
  CHECK(json_is_null(at("progress", "generation")) && json_is_null(at("progress", "under_way")));
  CHECK(json_is_null(at("progress", "rollouts_per_s")) && json_is_null(at("progress", "busy_s")));
  CHECK(json_is_null(at("settings", "learning")));
  CHECK(json_real_value(json_object_get(at("settings", "mutation"), "rate")) == 1.0 / 144);
  status.record.settings.workspace = (struct mo_workspace){2, 2, 2};
  status.record.settings.mutation_rate = 0;
  write(false);
  CHECK(json_real_value(json_object_get(at("settings", "mutation"), "rate")) == 0.125);
  CHECK_INT(json_integer_value(json_array_get(at("settings", "workspace"), 2)), 2);
}

static void waits_for_room(void)
{
  begin(MO_FEW_SHOT, MO_JOB_RUNNING);
  live = (struct mo_live){.phase = MO_PHASE_WAIT, .position = 1, .seconds_left = -1, .busy_s = 3};
  snprintf(live.reason, sizeof(live.reason), "no \"space\"");
  for (int as_job = 0; as_job < 2; as_job++) {
    write(as_job != 0);
    CHECK_TEXT(text_at("state"), "paused");
    CHECK_TEXT(text_at("reason"), "no \"space\"");
  }
  CHECK_TEXT(text_at("kind"), "campaign");
  CHECK(json_is_null(at("campaign", "generation")) &&
        json_integer_value(at("campaign", "generations")) == 3);
  status.job.state = MO_JOB_CANCELLED; /* what people did counts */
  write(false);
  CHECK_TEXT(text_at("state"), "cancelled");
  CHECK(json_is_null(at(NULL, "reason")));
  CHECK_TEXT(text_at("name"), "campaign-12");
}

/* It runs, and says whose drawing it waits for. */
static void waits_for_another(void)
{
  begin(MO_FEW_SHOT, MO_JOB_RUNNING);
  live = (struct mo_live){.phase = MO_PHASE_PREPARE,
                          .done = 5,
                          .total = 9,
                          .seconds_left = 2.5,
                          .busy_s = 0,
                          .reason = "campaign 7 draws"};
  for (int as_job = 0; as_job < 2; as_job++) {
    write(as_job != 0);
    CHECK_TEXT(text_at("state"), "running");
    CHECK_TEXT(text_at("reason"), "campaign 7 draws");
  }
  write(false);
  CHECK(json_integer_value(at("progress", "done")) == 5 &&
        json_real_value(at("progress", "seconds_left")) == 2.5);
  live.reason[0] = '\0';
  write(false);
  CHECK(json_is_null(at(NULL, "reason")));
}

/* A population of which nothing stayed sane. */
static void ended(void)
{
  begin(MO_SIMULTANEOUS, MO_JOB_SUCCEEDED);
  status.end = MO_CAMPAIGN_EXHAUSTED;
  status.has_result = true;
  status.generation = 7;
  status.last = (struct mo_campaign_generation){.generation = 7,
                                                .born_before = 14,
                                                .mean_parents = NAN,
                                                .mean_children = NAN,
                                                .first_loss = NAN,
                                                .last_loss = 0.5,
                                                .variation = {.exhausted = true},
                                                .collapse = true};
  status.last.stats = (struct mo_population_stats){.n = 2, .n_diverged = 2, .mean_score = NAN};
  for (int q = 0; q < MO_QUANTILES; q++)
    status.last.stats.quantiles[q] = NAN;
  write(false);
  CHECK_TEXT(text_at("end"), "exhausted");
  CHECK_TEXT(json_string_value(json_object_get(at("result", "controller"), "name")), "campaign-12");
  CHECK(json_is_null(json_object_get(at("newest", "score"), "mean")) &&
        json_is_null(at("newest", "parents_mean")));
  CHECK(json_is_true(at("newest", "exhausted")) && json_is_true(at("newest", "collapse")));
  CHECK(json_real_value(json_object_get(at("newest", "learning"), "last_loss")) == 0.5);
  CHECK_TEXT(json_string_value(json_object_get(at("settings", "learning"), "sensor")),
             "inverse_sqrt");
  CHECK_TEXT(json_string_value(json_object_get(at("settings", "learning"), "adjoint_rule")),
             "clip");
  CHECK(json_number_value(json_object_get(at("settings", "learning"), "restart_weight")) == 3);
  status.record.settings.learning.adjoint_rule = MO_ADJOINT_RESTART;
  status.record.settings.learning.restart_weight = 0.5;
  write(false);
  CHECK_TEXT(json_string_value(json_object_get(at("settings", "learning"), "adjoint_rule")),
             "restart");
  CHECK(json_number_value(json_object_get(at("settings", "learning"), "restart_weight")) == 0.5);
  struct mo_text text = {0};
  mo_columns_csv(&text, &mo_generation_columns, &status.last);
  CHECK(strncmp(text.data, "7,2,0,14,,,,,,,,,2,0,0,0,", 25) == 0);
  unsigned commas = 0, columns = 0;
  for (size_t i = 0; i < text.size; i++)
    commas += text.data[i] == ',';
  mo_text_free(&text);
  mo_columns_heading(&text, &mo_generation_columns);
  for (size_t i = 0; i < text.size; i++)
    columns += text.data[i] == ',';
  CHECK_INT(commas, columns);
  mo_text_free(&text);
}

static void designs(void)
{
  struct mo_campaign_design row = {
      .number = 5,
      .form = {{1}},
      .genotype = {{1}},
      .descent = {.parents = {3, MO_NO_PARENT}, .op = MO_BORN_MUTATION},
      .born = 2,
      .died = 4,
      .score = INFINITY,
      .size = {1, 1, 8, 24}};
  struct mo_text text = {0};
  mo_text_add(&text, "{");
  mo_campaign_json_design(&text, &row);
  mo_text_add(&text, "}");
  parse(&text);
  CHECK(json_is_null(at(NULL, "score")) && json_integer_value(at(NULL, "died")) == 4);
  CHECK_INT(json_array_size(at(NULL, "parents")), 1);
  mo_campaign_csv_design(&text, &row, 4);
  CHECK(strncmp(text.data, "5,\"[3]\",2,4,mutation,,d80000", 28) == 0);
  mo_text_free(&text);
  mo_campaign_csv_design(&text, &row, 3); /* at the end of generation 3 it lived */
  CHECK(strncmp(text.data, "5,\"[3]\",2,inf,mutation,,", 24) == 0);
  mo_text_free(&text);
  row.descent = (struct mo_descent){.parents = {MO_NO_PARENT, MO_NO_PARENT}, .op = MO_BORN_RANDOM};
  row.died = -1;
  row.score = 0.5;
  mo_campaign_csv_design(&text, &row, 9);
  CHECK(strncmp(text.data, "5,\"[none]\",2,inf,random,0.5,", 28) == 0);
  mo_text_free(&text);
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
  CHECK_INT(json_integer_value(at(NULL, "campaigns")), 3);
  CHECK(json_real_value(at("mean_score", "mean")) == 0.375 &&
        json_real_value(at("mean_score", "least")) == 0.25);
  CHECK(json_is_null(at("best_score", "mean")) && json_real_value(at("diversity", "most")) == 0.2);
  mo_columns_csv(&text, &mo_replicate_columns, &row);
  CHECK(strncmp(text.data, "3,3,0.25,0.375,0.5,,,,0,", 24) == 0);
  mo_text_free(&text);
}

static int gather(void *context, const char *text, size_t length)
{
  mo_text_bytes(context, text, length);
  return 0;
}

/* A comb of n designs, each the child of the one before. */
static void comb(uint32_t n, struct mo_descent **descents, uint32_t **born)
{
  *descents = calloc(n, sizeof(**descents));
  *born = calloc(n, sizeof(**born));
  for (uint32_t i = 0; i < n; i++) {
    (*descents)[i] = (struct mo_descent){.parents = {i > 0 ? i - 1 : MO_NO_PARENT, MO_NO_PARENT}};
    (*born)[i] = i;
  }
}

static void newick(void)
{
  const uint32_t n = 50000;
  struct mo_text whole = {0}, pieces_text = {0}, piece = {0};
  struct mo_newick_pieces *pieces;
  struct mo_descent *descents;
  uint32_t *born;
  int more = 1, count = 0;
  comb(n, &descents, &born);
  CHECK_INT(mo_newick(descents, born, NULL, n, gather, &whole), MO_OK);
  CHECK_INT(mo_newick_pieces_start(descents, born, n, &pieces), MO_OK);
  while (more > 0) {
    more = mo_newick_pieces_more(pieces, &piece);
    mo_text_bytes(&pieces_text, piece.data, piece.size);
    piece.size = 0;
    count++;
  }
  mo_newick_pieces_free(pieces);
  CHECK_INT(more, 0);
  CHECK(count > 5 && pieces_text.size == whole.size &&
        memcmp(pieces_text.data, whole.data, whole.size) == 0);
  for (int taken = 0; taken < 3; taken++) { /* readers that leave */
    comb(n, &descents, &born);
    CHECK_INT(mo_newick_pieces_start(descents, born, n, &pieces), MO_OK);
    for (int i = 0; i < taken; i++)
      CHECK_INT(mo_newick_pieces_more(pieces, &piece), 1);
    mo_newick_pieces_free(pieces);
  }
  CHECK(mo_newick_pieces_bytes(n) > n);
  json_decref(json);
  json = NULL;
  mo_text_free(&whole);
  mo_text_free(&pieces_text);
  mo_text_free(&piece);
}

static const struct check_case cases[] = {
    {"before it begins", fresh},
    {"waits for room", waits_for_room},
    {"waits for another", waits_for_another},
    {"ended, with nothing sane", ended},
    {"designs and their lives", designs},
    {"replicates", replicates},
    {"newick in pieces", newick},
};
CHECK_MAIN(cases)
