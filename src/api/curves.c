/* curves.c: the curves of a campaign: its generations, its learning, and the generations of
 * a group of replicates. Replies with a page as JSON, or with the whole curve as CSV, which is read
 * and written page by page. */
#include <stdlib.h>
#include <string.h>

#include "api/campaign_json.h"
#include "api/job_reply.h"
#include "http/download.h"

#define PLACE_MAX     INT64_C(9999999999)
#define ROWS_READ_MAX 5000 /* for one page of replicates, over all of them: 10 µs each */

enum curve_kind { CURVE_GENERATIONS, CURVE_LEARNING, CURVE_REPLICATES };

struct curve {
  struct mo_store *store;
  enum curve_kind kind;
  bool csv, headed;
  int64_t id;
  int64_t after;       /* generation; −1: none */
  uint32_t after_step; /* of learning */
  uint64_t left;       /* rows that may still be written */
  /* For replicates: the members that count, and the newest generation that all of them have. */
  int64_t members[MO_REPLICATES_MAX];
  uint32_t n_members;
  int64_t newest;
};

/* ---- pages: each adds at most `limit` rows and returns how many, or an error ---- */

static void separate(const struct curve *curve, struct mo_text *text)
{
  if (!curve->csv && text->size > 0 && text->data[text->size - 1] == '}')
    mo_text_bytes(text, ",", 1);
}

static int64_t add_generations(struct curve *curve, size_t limit, struct mo_text *text)
{
  struct mo_campaign_generation *rows = malloc(limit * sizeof(*rows));
  int64_t n = rows != NULL ? mo_store_campaign_generations(curve->store, curve->id, curve->after,
                                                           rows, limit)
                           : MO_ERR_NO_MEMORY;
  for (int64_t i = 0; i < n; i++) {
    curve->after = rows[i].generation;
    separate(curve, text);
    (curve->csv ? mo_campaign_csv_generation : mo_campaign_json_generation)(text, &rows[i]);
  }
  free(rows);
  return n;
}

static int64_t add_steps(struct curve *curve, size_t limit, struct mo_text *text)
{
  struct mo_campaign_step *rows = malloc(limit * sizeof(*rows));
  int64_t n = rows != NULL
                  ? mo_store_campaign_steps(curve->store, curve->id, (uint32_t)curve->after,
                                            curve->after_step, rows, limit)
                  : MO_ERR_NO_MEMORY;
  for (int64_t i = 0; i < n; i++) {
    curve->after = rows[i].generation;
    curve->after_step = rows[i].step;
    separate(curve, text);
    (curve->csv ? mo_campaign_csv_step : mo_campaign_json_step)(text, &rows[i]);
  }
  free(rows);
  return n;
}

static int64_t add_replicates(struct curve *curve, size_t limit, struct mo_text *text)
{
  size_t most = curve->n_members > 0 ? ROWS_READ_MAX / curve->n_members : 0;
  int64_t n = curve->newest - curve->after, first = curve->after + 1;
  if (limit > most)
    limit = most;
  if (n <= 0 || limit == 0)
    return 0;
  if ((size_t)n > limit)
    n = (int64_t)limit;
  struct mo_campaign_generation *rows = malloc((size_t)n * sizeof(*rows));
  struct mo_replicate_row *sums = calloc((size_t)n, sizeof(*sums));
  int64_t code = rows != NULL && sums != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (uint32_t m = 0; m < curve->n_members && code >= 0; m++) {
    code = mo_store_campaign_generations(curve->store, curve->members[m], curve->after, rows,
                                         (size_t)n);
    for (int64_t i = 0; i < code; i++) {
      if (rows[i].generation < first || rows[i].generation >= first + n)
        continue;
      mo_replicate_add(&sums[rows[i].generation - first], &rows[i]);
    }
  }
  for (int64_t i = 0; i < n && code >= 0; i++) {
    if (sums[i].campaigns == 0)
      continue;
    separate(curve, text);
    (curve->csv ? mo_replicate_csv : mo_replicate_json)(text, &sums[i]);
  }
  free(rows);
  free(sums);
  if (code < 0)
    return code;
  curve->after += n;
  return n;
}

/* Adds a page. Returns 1: there may be more, 0: there are no more now, or an error. */
static int add_page(struct curve *curve, struct mo_text *text)
{
  size_t limit = curve->left < MO_PAGE_MAX ? (size_t)curve->left : MO_PAGE_MAX;
  if (limit == 0)
    return 0;
  int64_t n = curve->kind == CURVE_GENERATIONS ? add_generations(curve, limit, text)
              : curve->kind == CURVE_LEARNING  ? add_steps(curve, limit, text)
                                               : add_replicates(curve, limit, text);
  if (n < 0)
    return (int)n;
  curve->left -= (uint64_t)n;
  return curve->kind == CURVE_REPLICATES ? curve->n_members > 0 && curve->after < curve->newest
                                         : (size_t)n == limit;
}

/* ---- replies ---- */

static const char *heading(const struct curve *curve)
{
  return curve->kind == CURVE_GENERATIONS ? mo_campaign_csv_generations
         : curve->kind == CURVE_LEARNING  ? mo_campaign_csv_steps
                                          : mo_replicate_csv_heading;
}

static int more_csv(void *context, struct mo_text *text)
{
  struct curve *curve = context;
  if (!curve->headed)
    mo_text_add(text, heading(curve));
  curve->headed = true;
  int more = add_page(curve, text);
  return more > 0 && curve->left == 0 ? 0 : more;
}

static void reply_page(struct mo_request *request, struct curve *curve)
{
  struct mo_text text = {0};
  mo_text_add(&text, "{\"items\":[");
  int more = add_page(curve, &text);
  if (more < 0) {
    mo_text_free(&text);
    mo_reply_error(request, more, "page");
    return;
  }
  if (curve->kind == CURVE_LEARNING)
    mo_text_format(&text, "],\"next_after\":\"%lld.%u\"", (long long)curve->after,
                   curve->after_step);
  else if (curve->after >= 0)
    mo_text_format(&text, "],\"next_after\":%lld", (long long)curve->after);
  else
    mo_text_add(&text, "],\"next_after\":null");
  mo_text_member_bool(&text, "more", more > 0);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
  mo_reply_etag_of_body(request);
}

/* Finds the members of the group that were not cancelled and did not fail. */
static int find_members(struct curve *curve)
{
  struct mo_campaign_status *all = malloc(MO_REPLICATES_MAX * sizeof(*all));
  int64_t n = all != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (n == MO_OK)
    n = mo_store_campaign(curve->store, curve->id, all);
  if (n == MO_OK) {
    const struct mo_campaign_query query = {.state = -1, .group = all[0].record.group};
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

/* Reads "G.S", a generation and a step. Each has at most ten digits, enough for 32 bits. */
static bool read_place(const char *text, int64_t *generation, uint32_t *step)
{
  size_t n = strcspn(text, ".");
  int64_t number;
  if (text[n] != '.' || !mo_decimal(text, n, 0, PLACE_MAX, generation) ||
      !mo_decimal(text + n + 1, strlen(text + n + 1), 0, PLACE_MAX, &number))
    return false;
  *generation = *generation < UINT32_MAX ? *generation : UINT32_MAX;
  *step = (uint32_t)(number < UINT32_MAX ? number : UINT32_MAX);
  return true;
}

static void handle_curve(struct mo_request *request, enum curve_kind kind)
{
  static const char *const forms[] = {"json", "csv"};
  static const char *const types[] = {"application/json", "text/csv"};
  struct curve curve = {
      .store = mo_api_of(request)->store, .kind = kind, .after = kind == CURVE_LEARNING ? 0 : -1};
  int64_t limit = 0;
  int form;
  const char *after = mo_query(request, "after");
  if (!mo_query_form(request, forms, types, 2, &form))
    return;
  if (kind == CURVE_LEARNING && after != NULL &&
      !read_place(after, &curve.after, &curve.after_step)) {
    mo_reply_bad_parameter(request, "after", "generation and step, as in 12.30, are expected");
    return;
  }
  if ((kind != CURVE_LEARNING && !mo_query_number(request, "after", 0, UINT32_MAX, &curve.after)) ||
      !mo_query_number(request, "limit", 1, MO_PAGE_MAX, &limit) ||
      !mo_path_job(request, MO_JOB_CAMPAIGN, &curve.id))
    return;
  curve.csv = form == 1;
  curve.left = limit > 0 ? (uint64_t)limit : curve.csv ? UINT64_MAX : MO_PAGE_MAX;
  int code = kind == CURVE_REPLICATES ? find_members(&curve) : MO_OK;
  if (code != MO_OK) {
    mo_reply_error(request, code, "campaign");
    return;
  }
  if (!curve.csv) {
    reply_page(request, &curve);
    return;
  }
  struct curve *kept = malloc(sizeof(*kept));
  if (kept == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "reply");
    return;
  }
  *kept = curve;
  mo_download_open(request, "text/csv; charset=utf-8; header=present", NULL, sizeof(*kept),
                   more_csv, kept, free);
}

void mo_api_get_campaign_generations(struct mo_request *request)
{
  handle_curve(request, CURVE_GENERATIONS);
}

void mo_api_get_campaign_learning(struct mo_request *request)
{
  handle_curve(request, CURVE_LEARNING);
}

void mo_api_get_campaign_replicates(struct mo_request *request)
{
  handle_curve(request, CURVE_REPLICATES);
}
