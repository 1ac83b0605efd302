/* curves.c: the curves of a job: steps and validations of a training; generations and learning of a
 * campaign; the generations of a group of replicates, and of any campaigns, one after the other.
 * Replies with a page as JSON, or with the whole curve in another form, which is read and written
 * page by page. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/columns.h"
#include "api/jobs.h"
#include "api/tables.h"
#include "http/download.h"

#define PLACE_MAX     INT64_C(9999999999)
#define ROWS_READ_MAX 5000 /* for one page of replicates, over all of them: 10 µs each */

struct curve;

/* A kind of curve. */
struct curve_kind {
  const char *name; /* the end of its route */
  const struct mo_columns *columns;
  size_t row_size;
  /* Reads at most `limit` rows behind the curve's place and moves it behind them. Returns their
   * number or an error. */
  int64_t (*read)(struct curve *curve, void *rows, size_t limit);
  bool has_step;     /* a place in the curve is a generation and a step, "12.30", or a campaign and
                        a generation, not one number */
  bool has_members;  /* its rows are of several campaigns */
  bool names_member; /* each row begins with what its campaign is */
};

struct curve {
  struct mo_store *store;
  const struct curve_kind *kind;
  enum mo_form form;
  bool headed;
  int64_t id;
  int64_t after;            /* step, generation or campaign; −1: none */
  uint32_t step;            /* of that generation; of a campaign the generation */
  int64_t stride;           /* of steps or generations */
  uint64_t left;            /* rows that may still be written */
  struct mo_gather *gather; /* of the form `columns` */
  /* The campaigns whose rows are read, ascending: of replicates those that count, with the newest
   * generation that all of them have. */
  int64_t *members;
  uint32_t n_members, member; /* member: the place of the one that is read */
  int64_t newest;
  struct {
    int64_t id;
    enum mo_job_state state;
  } left_out[MO_REPLICATES_MAX]; /* those that were cancelled or failed */
  uint32_t n_left_out;
  struct mo_text values[7], cells; /* what the campaign is, as JSON and as CSV */
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

/* Columns that come before those of a generation, where rows are of several campaigns. */
static const struct {
  const char *name, *type; /* as in a mo_gathered */
} member_columns[] = {{"campaign", NULL}, {"group", NULL}, {"replicate", "uint32"}, {"label", NULL},
                      {"mode", NULL},     {"state", NULL}, {"seed", "uint64"}};
#define MEMBER_COLUMNS (sizeof(member_columns) / sizeof(member_columns[0]))

/* Notes what the campaign is, once for all its rows. */
static void describe(struct curve *curve, const struct mo_campaign_status *status)
{
  const struct mo_campaign_record *record = &status->record;
  const struct mo_job *job = &status->job;
  struct mo_text *values = curve->values, *cells = &curve->cells;
  for (size_t i = 0; i < MEMBER_COLUMNS; i++)
    values[i].size = 0;
  mo_text_format(&values[0], "\"%lld\"", (long long)job->id);
  mo_text_format(&values[1], "\"%lld\"", (long long)record->group);
  mo_text_format(&values[2], "%u", record->replicate);
  if (job->has_label)
    mo_text_json_string(&values[3], job->label, strlen(job->label));
  else
    mo_text_add(&values[3], "null");
  mo_text_format(&values[4], "\"%s\"", mo_campaign_mode_words[record->settings.mode]);
  mo_text_format(&values[5], "\"%s\"", mo_job_state_name(job->state));
  mo_text_format(&values[6], "%llu", (unsigned long long)record->settings.seed);
  cells->size = 0;
  mo_text_format(cells, "%lld,%lld,%u,", (long long)job->id, (long long)record->group,
                 record->replicate);
  if (job->has_label)
    mo_csv_text(cells, job->label, strlen(job->label));
  mo_text_format(cells, ",%s,%s,%s,", mo_campaign_mode_words[record->settings.mode],
                 mo_job_state_name(job->state), values[6].data);
}

/* Reads rows of one campaign, the next one that has some. */
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
      describe(curve, status);
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
    {"steps", &mo_step_columns, sizeof(struct mo_training_step_row), read_steps},
    {"validations", &mo_validation_columns, sizeof(struct mo_training_validation_row),
     read_validations},
    {"generations", &mo_generation_columns, sizeof(struct mo_campaign_generation),
     read_generations},
    {"learning", &mo_campaign_step_columns, sizeof(struct mo_campaign_step), read_learning,
     .has_step = true},
    {"replicates", &mo_replicate_columns, sizeof(struct mo_replicate_row), read_replicates,
     .has_members = true},
};
static const struct curve_kind exported = {
    "generations", &mo_generation_columns, sizeof(struct mo_campaign_generation),
    read_exported, .has_step = true,       .names_member = true};

/* Adds a row, in JSON its comma, too. */
static void add_row(struct curve *curve, struct mo_text *text, const void *row)
{
  const struct curve_kind *kind = curve->kind;
  const size_t n = kind->names_member ? MEMBER_COLUMNS : 0;
  if (curve->form == MO_FORM_COLUMNS) {
    struct mo_gathered *columns = curve->gather->columns;
    for (size_t i = 0; i < n; i++) {
      if (columns[i].type != NULL)
        mo_gather_number(&columns[i], strtod(curve->values[i].data, NULL));
      else
        mo_gather_json(&columns[i], curve->values[i].data, curve->values[i].size);
    }
    mo_gather_row(curve->gather, (unsigned)n, kind->columns, row);
    curve->gather->n_rows++;
  } else if (curve->form == MO_FORM_CSV) {
    mo_text_bytes(text, curve->cells.data, curve->cells.size);
    mo_columns_csv(text, kind->columns, row);
  } else {
    if (curve->form == MO_FORM_JSON)
      mo_text_object(text);
    else
      mo_text_add(text, "{"); /* lines have no commas between them */
    for (size_t i = 0; i < n; i++) {
      mo_text_name(text, member_columns[i].name);
      mo_text_bytes(text, curve->values[i].data, curve->values[i].size);
    }
    mo_columns_members(text, kind->columns, row);
    mo_text_add(text, curve->form == MO_FORM_NDJSON ? "}\n" : "}");
  }
}

/* Adds a page. Returns 1: there may be more, 0: there are no more now, or an error. */
static int add_page(struct curve *curve, struct mo_text *text)
{
  const struct curve_kind *kind = curve->kind;
  size_t limit = curve->left < MO_PAGE_MAX ? (size_t)curve->left : MO_PAGE_MAX;
  char *rows = limit > 0 ? malloc(limit * kind->row_size) : NULL;
  int64_t n = limit == 0 ? 0 : rows == NULL ? MO_ERR_NO_MEMORY : kind->read(curve, rows, limit);
  for (int64_t i = 0; i < n; i++)
    add_row(curve, text, rows + (size_t)i * kind->row_size);
  free(rows);
  if (n < 0)
    return (int)n;
  curve->left -= (uint64_t)n;
  return kind->names_member  ? curve->member < curve->n_members
         : kind->has_members ? curve->n_members > 0 && curve->after < curve->newest
                             : limit > 0 && (size_t)n == limit;
}

/* ---- replies ---- */

static void free_curve(void *context)
{
  struct curve *curve = context;
  for (size_t i = 0; i < MEMBER_COLUMNS; i++)
    mo_text_free(&curve->values[i]);
  mo_text_free(&curve->cells);
  free(curve->members);
  free(curve);
}

/* A mo_download_more. */
static int more_lines(void *context, struct mo_text *text)
{
  struct curve *curve = context;
  if (!curve->headed && curve->form == MO_FORM_CSV) {
    for (size_t i = 0; i < MEMBER_COLUMNS && curve->kind->names_member; i++)
      mo_text_format(text, "%s,", member_columns[i].name);
    mo_columns_heading(text, curve->kind->columns);
  }
  curve->headed = true;
  int more = add_page(curve, text);
  return more > 0 && curve->left == 0 ? 0 : more;
}

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
  mo_text_add(&text, "{\"items\":[");
  int more = add_page(curve, &text);
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

static void reply_columns(struct mo_request *request, struct curve *curve)
{
  struct mo_gather gather = {0};
  int more = 1;
  for (size_t i = 0; i < MEMBER_COLUMNS && curve->kind->names_member; i++)
    mo_gather_column(&gather, member_columns[i].name, strlen(member_columns[i].name),
                     member_columns[i].type);
  mo_gather_columns(&gather, curve->kind->columns);
  curve->gather = &gather;
  while (more > 0 && curve->left > 0) {
    more = add_page(curve, NULL);
    const int fits = mo_gather_check(&gather);
    more = more >= 0 && fits != MO_OK ? fits : more;
  }
  mo_gather_reply(request, more < 0 ? more : MO_OK, &gather);
}

/* ---- whose rows ---- */

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

/* Finds the campaigns that the query names. False: the reply is made. */
static bool find_exported(struct mo_request *request, struct curve *curve)
{
  if (!mo_find_campaigns(request, &curve->members, &curve->n_members))
    return false;
  /* Goes on behind the cursor: campaigns before its one are done. */
  while (curve->member < curve->n_members && curve->members[curve->member] < curve->after)
    curve->member++;
  return true;
}

/* Reads a cursor: "12", or "12.30" where a place has a step. Numbers have at most ten digits,
 * enough for 32 bits. */
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

/* Replies with rows of the kind. Frees the curve, unless the reply goes on with it. */
static void reply_curve(struct mo_request *request, struct curve *curve)
{
  int64_t limit = 0;
  int form;
  if (mo_table_form(request, &form) && read_cursor(request, curve) &&
      mo_query_number(request, "limit", 1, MO_PAGE_MAX, &limit) &&
      mo_query_number(request, "stride", 1, MO_TRAINING_STEPS_MAX, &curve->stride) &&
      (curve->kind->names_member ? find_exported(request, curve)
                                 : mo_path_job(request, &curve->id))) {
    curve->form = (enum mo_form)form;
    curve->left = limit > 0 ? (uint64_t)limit : form != MO_FORM_JSON ? UINT64_MAX : MO_PAGE_MAX;
    const int error = curve->kind->has_members ? find_members(curve) : MO_OK;
    if (error != MO_OK) {
      mo_reply_error(request, error, "campaign");
    } else if (form == MO_FORM_JSON) {
      reply_page(request, curve);
    } else if (form == MO_FORM_COLUMNS) {
      reply_columns(request, curve);
    } else {
      mo_download_open(request, mo_table_type(curve->form), NULL, sizeof(*curve), more_lines, curve,
                       free_curve);
      return;
    }
  }
  free_curve(curve);
}

static void begin_curve(struct mo_request *request, const struct curve_kind *kind)
{
  struct curve *curve = malloc(sizeof(*curve));
  if (curve == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "reply");
    return;
  }
  *curve =
      (struct curve){.store = mo_api_of(request)->store, .kind = kind, .after = -1, .stride = 1};
  reply_curve(request, curve);
}

void mo_api_get_curve(struct mo_request *request)
{
  const struct curve_kind *kind = kinds;
  while (strcmp(strrchr(request->route->path, '/') + 1, kind->name) != 0)
    kind++;
  begin_curve(request, kind);
}

/* Replies with the generations of any campaigns. */
void mo_api_get_generations(struct mo_request *request)
{
  begin_curve(request, &exported);
}
