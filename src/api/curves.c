/* curves.c: the curves of a job: steps and validations of a training; generations and learning of a
 * campaign; the generations of a group of replicates. Replies with a page as JSON, or with the
 * whole curve as CSV, which is read and written page by page. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/columns.h"
#include "api/jobs.h"
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
  bool has_step;    /* a place in the curve is a generation and a step, "12.30", not one number */
  bool has_members; /* its rows are of several campaigns */
};

struct curve {
  struct mo_store *store;
  const struct curve_kind *kind;
  bool csv, headed;
  int64_t id;
  int64_t after;  /* step or generation; −1: none */
  uint32_t step;  /* of that generation */
  int64_t stride; /* of steps */
  uint64_t left;  /* rows that may still be written */
  /* For replicates: the members that count, and the newest generation that all of them have. */
  int64_t members[MO_REPLICATES_MAX];
  uint32_t n_members;
  int64_t newest;
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
  int64_t n = mo_store_campaign_generations(curve->store, curve->id, curve->after, rows, limit);
  if (n > 0)
    curve->after = ((struct mo_campaign_generation *)rows)[n - 1].generation;
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
    error = mo_store_campaign_generations(curve->store, curve->members[m], curve->after, of_one,
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

/* Adds a page. Returns 1: there may be more, 0: there are no more now, or an error. */
static int add_page(struct curve *curve, struct mo_text *text)
{
  const struct curve_kind *kind = curve->kind;
  size_t limit = curve->left < MO_PAGE_MAX ? (size_t)curve->left : MO_PAGE_MAX;
  char *rows = limit > 0 ? malloc(limit * kind->row_size) : NULL;
  int64_t n = limit == 0 ? 0 : rows == NULL ? MO_ERR_NO_MEMORY : kind->read(curve, rows, limit);
  for (int64_t i = 0; i < n; i++) {
    const char *row = rows + (size_t)i * kind->row_size;
    (curve->csv ? mo_columns_csv : mo_columns_json)(text, kind->columns, row);
  }
  free(rows);
  if (n < 0)
    return (int)n;
  curve->left -= (uint64_t)n;
  return kind->has_members ? curve->n_members > 0 && curve->after < curve->newest
                           : limit > 0 && (size_t)n == limit;
}

/* ---- replies ---- */

/* A mo_download_more. */
static int more_csv(void *context, struct mo_text *text)
{
  struct curve *curve = context;
  if (!curve->headed)
    mo_columns_heading(text, curve->kind->columns);
  curve->headed = true;
  int more = add_page(curve, text);
  return more > 0 && curve->left == 0 ? 0 : more;
}

static void reply_page(struct mo_request *request, struct curve *curve)
{
  struct mo_text text = {0};
  mo_text_add(&text, "{\"items\":[");
  int more = add_page(curve, &text);
  if (more <= 0)
    mo_text_add(&text, "],\"next_cursor\":null}");
  else if (curve->kind->has_step)
    mo_text_format(&text, "],\"next_cursor\":\"%lld.%u\"}", (long long)curve->after, curve->step);
  else
    mo_text_format(&text, "],\"next_cursor\":\"%lld\"}", (long long)curve->after);
  mo_reply_text(request, more < 0 ? more : MO_OK, &text, "page");
}

static void reply_csv(struct mo_request *request, const struct curve *curve)
{
  struct curve *kept = malloc(sizeof(*kept));
  if (kept == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "reply");
    return;
  }
  *kept = *curve;
  mo_download_open(request, "text/csv; charset=utf-8; header=present", NULL, sizeof(*kept),
                   more_csv, kept, free);
}

/* Finds the members of the group that were not cancelled and did not fail. */
static int find_members(struct curve *curve)
{
  struct mo_campaign_status *all = malloc(MO_REPLICATES_MAX * sizeof(*all));
  int64_t n = all != NULL ? mo_store_campaign(curve->store, curve->id, all) : MO_ERR_NO_MEMORY;
  if (n == MO_OK) {
    const struct mo_job_query query = {.state = -1, .group = all[0].record.group};
    n = mo_store_campaigns(curve->store, &query, all, MO_REPLICATES_MAX);
  }
  curve->newest = INT64_MAX;
  for (int64_t i = 0; i < n; i++) {
    if (all[i].job.state == MO_JOB_CANCELLED || all[i].job.state == MO_JOB_FAILED)
      continue;
    curve->members[curve->n_members++] = all[i].job.id;
    curve->newest = all[i].generation < curve->newest ? all[i].generation : curve->newest;
  }
  if (curve->n_members == 0)
    curve->newest = -1;
  free(all);
  return n < 0 ? (int)n : MO_OK;
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

void mo_api_get_curve(struct mo_request *request)
{
  static const char *const forms[] = {"json", "csv", NULL};
  static const char *const types[] = {"application/json", "text/csv", NULL};
  const struct curve_kind *kind = kinds;
  while (strcmp(strrchr(request->route->path, '/') + 1, kind->name) != 0)
    kind++;
  struct curve curve = {.store = mo_api_of(request)->store, .kind = kind, .after = -1, .stride = 1};
  int64_t limit = 0;
  int form;
  if (!mo_query_form(request, forms, types, &form) || !read_cursor(request, &curve) ||
      !mo_query_number(request, "limit", 1, MO_PAGE_MAX, &limit) ||
      !mo_query_number(request, "stride", 1, MO_TRAINING_STEPS_MAX, &curve.stride) ||
      !mo_path_job(request, &curve.id))
    return;
  curve.csv = form == 1;
  curve.left = limit > 0 ? (uint64_t)limit : curve.csv ? UINT64_MAX : MO_PAGE_MAX;
  int error = kind->has_members ? find_members(&curve) : MO_OK;
  if (error != MO_OK)
    mo_reply_error(request, error, "campaign");
  else if (curve.csv)
    reply_csv(request, &curve);
  else
    reply_page(request, &curve);
}
