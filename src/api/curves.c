/* curves.c: the curves of a job: steps and validations of a training run; generations and learning
 * of a campaign; the generations of a group of replicates; and the generations of any campaigns,
 * one campaign after another. Replies with pages of JSON, which tables.c converts to other
 * formats. */
#include <stdlib.h>
#include <string.h>

#include "api/jobs.h"
#include "api/replicates.h"
#include "api/tables.h"
#include "exchange/columns.h"

#define PLACE_MAX INT64_C(9999999999)
/* Rows read for one page of replicates, over all of them; 10 µs each. */
#define ROWS_READ_MAX 5000

struct curve;

/* A kind of curve. */
struct curve_kind {
  const char *path; /* of its route */
  const struct mo_columns *columns;
  size_t row_size;
  /* Reads at most `limit` rows after the curve's position and moves the position past them. Returns
   * their number or an error. */
  int64_t (*read)(struct curve *curve, void *rows, size_t limit);
  bool has_step;     /* a position in the curve has two numbers, "12.30": a generation and a step,
                        or a campaign and a generation */
  bool has_members;  /* each row combines several campaigns */
  bool names_member; /* each row begins with a description of its campaign */
};

struct curve {
  struct mo_store *store;
  const struct curve_kind *kind;
  int64_t id;
  int64_t after;  /* step, generation or campaign; −1: none */
  uint32_t step;  /* step within that generation or, if `after` is a campaign, its generation */
  int64_t stride; /* of steps or generations */
  int64_t limit;  /* rows of a page */
  /* The campaigns to read, ascending. Replicates: only those that count; `newest` is the newest
   * generation that all of them have reached. */
  int64_t *members;
  uint32_t n_members, member; /* member: the index of the one being read */
  int64_t newest;
  struct {
    int64_t id;
    enum mo_job_state state;
  } left_out[MO_REPLICATES_MAX]; /* campaigns that were cancelled or failed */
  uint32_t n_left_out;
  struct mo_text about; /* the beginning of each row: a description of its campaign */
};

/* ---- rows ---- */

static int64_t read_steps(struct curve *curve, void *rows, size_t limit)
{
  int64_t n = mo_store_training_steps(curve->store, curve->id,
                                      curve->after > 0 ? (uint32_t)curve->after : 0,
                                      (uint32_t)curve->stride, rows, limit);
  if (n > 0)
    curve->after = ((struct mo_training_step_row *)rows)[n - 1].report.step;
  return n;
}

static int64_t read_validations(struct curve *curve, void *rows, size_t limit)
{
  int64_t n = mo_store_training_validations(curve->store, curve->id, curve->after, rows, limit);
  if (n > 0)
    curve->after = ((struct mo_training_validation_row *)rows)[n - 1].step;
  return n;
}

static int64_t read_generations(struct curve *curve, void *rows, size_t limit)
{
  int64_t n = mo_store_campaign_generations(curve->store, curve->id, curve->after,
                                            (uint32_t)curve->stride, rows, limit);
  if (n > 0)
    curve->after = ((struct mo_campaign_generation *)rows)[n - 1].generation;
  return n;
}

/* Columns that precede those of a generation, in tables of several campaigns. */
static const char member_columns[] =
    "campaign group replicate:u label mode state seed:l own_score aggregate";

/* Writes how losses become scores: "cvar 0.9", or null for the mean. */
static void write_aggregate(struct mo_text *about, const struct mo_aggregate *aggregate)
{
  char text[64];
  snprintf(
      text, sizeof(text), "%s %s", mo_aggregate_words[aggregate->kind],
      MO_NUMBER(aggregate->kind == MO_AGGREGATE_MEAN_SD ? aggregate->weight : aggregate->level));
  mo_text_member(about, "aggregate", aggregate->kind == MO_AGGREGATE_MEAN ? NULL : text);
}

/* Describes the campaign, once for all its rows. */
static void describe(struct mo_text *about, const struct mo_campaign_status *status)
{
  const struct mo_campaign_record *record = &status->record;
  const struct mo_job *job = &status->job;
  about->size = 0;
  mo_text_object(about);
  mo_text_member_id(about, "campaign", job->id);
  mo_text_member_id(about, "group", record->group);
  mo_text_member_count(about, "replicate", record->replicate);
  mo_text_member(about, "label", job->has_label ? job->label : NULL);
  mo_text_member(about, "mode", mo_campaign_mode_words[record->settings.mode]);
  mo_text_member(about, "state", mo_job_state_name(job->state));
  mo_text_member_count(about, "seed", record->settings.seed);
  mo_text_member(about, "own_score",
                 mo_own_score_is_set(&record->own_score) ? record->own_score.name : NULL);
  write_aggregate(about, &record->settings.aggregate);
}

/* Reads rows of the next campaign that has any. */
static int64_t read_exported(struct curve *curve, void *rows, size_t limit)
{
  struct mo_campaign_generation *generations = rows;
  struct mo_campaign_status *status = malloc(sizeof(*status));
  int64_t n = status == NULL ? MO_ERR_NO_MEMORY : 0;
  while (n == 0 && curve->member < curve->n_members) {
    const int64_t id = curve->members[curve->member];
    const bool begun = curve->after == id;
    n = mo_store_campaign(curve->store, id, status);
    if (n == MO_OK)
      n = mo_store_campaign_generations(curve->store, id, begun ? (int64_t)curve->step : -1,
                                        (uint32_t)curve->stride, generations, limit);
    if (n > 0) {
      curve->after = id;
      curve->step = generations[n - 1].generation;
      describe(&curve->about, status);
    }
    curve->member += n >= 0 && (size_t)n < limit;
  }
  free(status);
  return n;
}

static int64_t read_learning(struct curve *curve, void *rows, size_t limit)
{
  int64_t n = mo_store_campaign_steps(curve->store, curve->id,
                                      curve->after > 0 ? (uint32_t)curve->after : 0, curve->step,
                                      rows, limit);
  if (n > 0) {
    const struct mo_campaign_step *last = &((struct mo_campaign_step *)rows)[n - 1];
    curve->after = last->generation;
    curve->step = last->step;
  }
  return n;
}

static int64_t read_replicates(struct curve *curve, void *rows, size_t limit)
{
  struct mo_replicate_row *sums = rows;
  const size_t most = curve->n_members > 0 ? ROWS_READ_MAX / curve->n_members : 0;
  const int64_t first = curve->after + 1;
  int64_t n = curve->newest - curve->after, error = MO_OK, written = 0;
  if (limit > most)
    limit = most;
  if (n <= 0 || limit == 0)
    return 0;
  if ((size_t)n > limit)
    n = (int64_t)limit;
  struct mo_campaign_generation *of_one = malloc((size_t)n * sizeof(*of_one));
  if (of_one == NULL)
    return MO_ERR_NO_MEMORY;
  memset(sums, 0, (size_t)n * sizeof(*sums));
  for (uint32_t m = 0; m < curve->n_members && error >= 0; m++) {
    error = mo_store_campaign_generations(curve->store, curve->members[m], curve->after, 1, of_one,
                                          (size_t)n);
    for (int64_t i = 0; i < error; i++)
      if (of_one[i].generation >= first && of_one[i].generation < first + n)
        mo_replicate_add(&sums[of_one[i].generation - first], &of_one[i]);
  }
  free(of_one);
  for (int64_t i = 0; i < n; i++)
    if (sums[i].campaigns > 0) {
      sums[written] = sums[i];
      mo_replicate_finish(&sums[written++]);
    }
  curve->after += error < 0 ? 0 : n;
  return error < 0 ? error : written;
}

static const struct curve_kind kinds[] = {
    {"/v1/trainings/{id}/steps", &mo_step_columns, sizeof(struct mo_training_step_row), read_steps},
    {"/v1/trainings/{id}/validations", &mo_validation_columns,
     sizeof(struct mo_training_validation_row), read_validations},
    {"/v1/campaigns/{id}/generations", &mo_generation_columns,
     sizeof(struct mo_campaign_generation), read_generations},
    {"/v1/campaigns/{id}/learning", &mo_campaign_step_columns, sizeof(struct mo_campaign_step),
     read_learning, .has_step = true},
    {"/v1/campaigns/{id}/replicates", &mo_replicate_columns, sizeof(struct mo_replicate_row),
     read_replicates, .has_members = true},
    {"/v1/campaigns/generations", &mo_generation_columns, sizeof(struct mo_campaign_generation),
     read_exported, .has_step = true, .names_member = true},
};

/* Adds rows of one campaign. Returns 1 if there may be more, 0 if there are no more for now, or an
 * error. */
static int add_rows(struct curve *curve, struct mo_text *text)
{
  const struct curve_kind *kind = curve->kind;
  const int64_t limit = curve->limit;
  char *rows = malloc((size_t)limit * kind->row_size);
  const int64_t n = rows == NULL ? MO_ERR_NO_MEMORY : kind->read(curve, rows, (size_t)limit);
  for (int64_t i = 0; i < n; i++) {
    mo_text_next(text);
    mo_text_bytes(text, curve->about.data, curve->about.size);
    mo_columns_members(text, kind->columns, rows + (size_t)i * kind->row_size);
    mo_text_add(text, "}");
  }
  free(rows);
  if (n < 0 || curve->about.failed)
    return n < 0 ? (int)n : MO_ERR_NO_MEMORY;
  curve->limit -= n;
  return kind->names_member  ? curve->member < curve->n_members
         : kind->has_members ? curve->n_members > 0 && curve->after < curve->newest
                             : n == limit;
}

/* ---- replies ---- */

static void write_left_out(struct mo_text *text, const struct curve *curve)
{
  mo_text_add(text, ",\"left_out\":[");
  for (uint32_t i = 0; i < curve->n_left_out; i++) {
    mo_text_object(text);
    mo_text_member_id(text, "id", curve->left_out[i].id);
    mo_text_member(text, "state", mo_job_state_name(curve->left_out[i].state));
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

static void reply_page(struct mo_request *request, struct curve *curve)
{
  struct mo_text text = {0};
  int more;
  mo_text_add(&text, "{\"items\":[");
  do
    more = add_rows(curve, &text);
  while (more > 0 && curve->limit > 0 && curve->kind->names_member);
  if (more <= 0)
    mo_text_add(&text, "],\"next_cursor\":null");
  else if (curve->kind->has_step)
    mo_text_format(&text, "],\"next_cursor\":\"%lld.%u\"", (long long)curve->after, curve->step);
  else
    mo_text_format(&text, "],\"next_cursor\":\"%lld\"", (long long)curve->after);
  if (curve->kind->has_members)
    write_left_out(&text, curve);
  mo_text_add(&text, "}");
  mo_reply_text(request, more < 0 ? more : MO_OK, &text, "page");
}

/* ---- which campaigns ---- */

/* Finds the members of the group that were not cancelled and did not fail. */
static int find_members(struct curve *curve)
{
  struct mo_campaign_status *all = malloc(MO_REPLICATES_MAX * sizeof(*all));
  int64_t n = all != NULL ? mo_store_campaign(curve->store, curve->id, all) : MO_ERR_NO_MEMORY;
  if (n == MO_OK) {
    const struct mo_job_query query = {.state = -1, .group = all[0].record.group, .archived = -1};
    n = mo_store_campaigns(curve->store, &query, all, MO_REPLICATES_MAX);
  }
  curve->members = malloc(MO_REPLICATES_MAX * sizeof(*curve->members));
  if (n >= 0 && curve->members == NULL)
    n = MO_ERR_NO_MEMORY;
  curve->newest = INT64_MAX;
  for (int64_t i = 0; i < n; i++) {
    if (all[i].job.state == MO_JOB_CANCELLED || all[i].job.state == MO_JOB_FAILED) {
      curve->left_out[curve->n_left_out].id = all[i].job.id;
      curve->left_out[curve->n_left_out++].state = all[i].job.state;
      continue;
    }
    curve->members[curve->n_members++] = all[i].job.id;
    curve->newest = all[i].generation < curve->newest ? all[i].generation : curve->newest;
  }
  if (curve->n_members == 0)
    curve->newest = -1;
  free(all);
  return n < 0 ? (int)n : MO_OK;
}

/* Finds the campaigns that the query selects. Returns false if it has replied. */
static bool find_exported(struct mo_request *request, struct curve *curve)
{
  if (!mo_find_campaigns(request, &curve->members, &curve->n_members))
    return false;
  /* Continue after the cursor: skip the campaigns before the cursor's campaign. */
  while (curve->member < curve->n_members && curve->members[curve->member] < curve->after)
    curve->member++;
  return true;
}

/* Reads a cursor: "12", or "12.30" where a position has two numbers. Numbers have at most ten
 * digits, enough for 32 bits. */
static bool read_cursor(struct mo_request *request, struct curve *curve)
{
  const char *text = mo_query(request, "cursor");
  size_t n = text != NULL ? strcspn(text, ".") : 0;
  int64_t step = 0;
  if (text == NULL)
    return true;
  if (!mo_decimal(text, n, 0, PLACE_MAX, &curve->after) ||
      (text[n] == '.') != curve->kind->has_step ||
      (text[n] == '.' && !mo_decimal(text + n + 1, strlen(text + n + 1), 0, PLACE_MAX, &step))) {
    mo_reply_bad_parameter(request, "cursor", MO_CURSOR_WORDS);
    return false;
  }
  if (curve->after > UINT32_MAX)
    curve->after = UINT32_MAX;
  curve->step = (uint32_t)(step < UINT32_MAX ? step : UINT32_MAX);
  return true;
}

void mo_api_get_curve(struct mo_request *request)
{
  struct curve curve = {.store = mo_api_of(request)->store,
                        .kind = kinds,
                        .after = -1,
                        .stride = 1,
                        .limit = MO_PAGE_MAX};
  int form;
  while (strcmp(request->route->path, curve.kind->path) != 0)
    curve.kind++;
  if (!mo_table_form(request, &form))
    return;
  if (form != MO_FORM_JSON) {
    mo_table_reply(request, (enum mo_form)form, mo_api_get_curve,
                   curve.kind->names_member ? member_columns : "", curve.kind->columns);
    return;
  }
  mo_text_object(&curve.about);
  if (read_cursor(request, &curve) &&
      mo_query_number(request, "limit", 1, MO_PAGE_MAX, &curve.limit) &&
      mo_query_number(request, "stride", 1, MO_TRAINING_STEPS_MAX, &curve.stride) &&
      (curve.kind->names_member ? find_exported(request, &curve)
                                : mo_path_job(request, &curve.id))) {
    const int error = curve.kind->has_members ? find_members(&curve) : MO_OK;
    if (error != MO_OK)
      mo_reply_error(request, error, "campaign");
    else
      reply_page(request, &curve);
  }
  mo_text_free(&curve.about);
  free(curve.members);
}
