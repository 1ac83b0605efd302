/* training_curves.c: the curves of a training: steps and validations. */
#include <stdlib.h>
#include <string.h>

#include "api/job_reply.h"
#include "api/training_json.h"

#define CSV_ROWS_MAX                                                                               \
  10000 /* of one reply that was not asked for a limit: 5 µs each on a thread that serves others, \
           too */

/* One page of either curve; the curves differ only in their rows. */
struct curve {
  struct mo_store *store;
  bool validations;
  int64_t id, after; /* after −1: from step 0 */
  uint32_t stride;
  union {
    struct mo_training_step_row *steps;
    struct mo_training_validation_row *validations;
    void *any;
  } rows;
};

static int64_t read_rows(const struct curve *curve, size_t limit)
{
  return curve->validations ? mo_store_training_validations(curve->store, curve->id, curve->after,
                                                            curve->rows.validations, limit)
                            : mo_store_training_steps(curve->store, curve->id,
                                                      curve->after > 0 ? (uint32_t)curve->after : 0,
                                                      curve->stride, curve->rows.steps, limit);
}

static int64_t step_of_row(const struct curve *curve, int64_t i)
{
  return curve->validations ? curve->rows.validations[i].step : curve->rows.steps[i].report.step;
}

static void write_row(struct mo_text *text, const struct curve *curve, int64_t i, bool csv)
{
  if (curve->validations && csv)
    mo_training_csv_validation(text, &curve->rows.validations[i]);
  else if (curve->validations)
    mo_training_json_validation(text, &curve->rows.validations[i]);
  else if (csv)
    mo_training_csv_step(text, &curve->rows.steps[i]);
  else
    mo_training_json_step(text, &curve->rows.steps[i]);
}

/* Writes up to `limit` rows, page by page. *more: there may be more rows. */
static int write_rows(struct mo_text *text, struct curve *curve, size_t limit, bool csv, bool *more)
{
  size_t written = 0;
  *more = true;
  while (written < limit) {
    size_t wanted = limit - written < MO_PAGE_MAX ? limit - written : MO_PAGE_MAX;
    int64_t n = read_rows(curve, wanted);
    if (n < 0)
      return (int)n;
    for (int64_t i = 0; i < n; i++, written++) {
      if (!csv && text->size > 0 && text->data[text->size - 1] == '}')
        mo_text_bytes(text, ",", 1);
      write_row(text, curve, i, csv);
    }
    if (n > 0)
      curve->after = step_of_row(curve, n - 1);
    if ((size_t)n < wanted) {
      *more = false;
      break;
    }
  }
  return MO_OK;
}

static void reply_curve(struct mo_request *request, struct curve *curve, size_t limit, bool csv)
{
  struct mo_text text = {0};
  bool more;
  mo_text_add(&text, !csv                 ? "{\"items\":["
                     : curve->validations ? mo_training_csv_validations
                                          : mo_training_csv_steps);
  int code = write_rows(&text, curve, limit, csv, &more);
  if (code != MO_OK || (csv && text.failed)) {
    mo_text_free(&text);
    mo_reply_error(request, code != MO_OK ? code : MO_ERR_NO_MEMORY, "page");
    return;
  }
  if (csv) {
    mo_reply_bytes(request, 200, "text/csv; charset=utf-8; header=present", text.data, text.size);
    if (more)
      mo_reply_extra(request, "Morphod-Next-After", "%lld", (long long)curve->after);
  } else {
    if (curve->after >= 0)
      mo_text_format(&text, "],\"next_after\":%lld,\"more\":%s", (long long)curve->after,
                     more ? "true" : "false");
    else
      mo_text_add(&text, "],\"next_after\":null,\"more\":false");
    mo_text_add(&text, "}");
    mo_reply_json(request, 200, &text);
  }
  mo_reply_etag_of_body(request);
}

static void handle_curve(struct mo_request *request, bool validations)
{
  static const char *const forms[] = {"json", "csv"};
  static const char *const types[] = {"application/json", "text/csv"};
  int64_t id, after = validations ? -1 : 0, stride = 1, limit = MO_PAGE_MAX;
  int form;
  if (!mo_query_form(request, forms, types, 2, &form))
    return;
  if (form == 1)
    limit = CSV_ROWS_MAX;
  if (!mo_query_number(request, "after", 0, UINT32_MAX, &after) ||
      !mo_query_number(request, "limit", 1, MO_PAGE_MAX, &limit) ||
      !mo_query_number(request, "stride", 1, MO_TRAINING_STEPS_MAX, &stride) ||
      !mo_path_job(request, MO_JOB_TRAINING, &id))
    return;
  struct curve curve = {.store = mo_api_of(request)->store,
                        .validations = validations,
                        .id = id,
                        .after = after,
                        .stride = (uint32_t)stride};
  curve.rows.any = malloc(
      MO_PAGE_MAX * (validations ? sizeof(*curve.rows.validations) : sizeof(*curve.rows.steps)));
  if (curve.rows.any == NULL)
    mo_reply_error(request, MO_ERR_NO_MEMORY, "page");
  else
    reply_curve(request, &curve, (size_t)limit, form == 1);
  free(curve.rows.any);
}

void mo_api_get_training_steps(struct mo_request *request)
{
  handle_curve(request, false);
}

void mo_api_get_training_validations(struct mo_request *request)
{
  handle_curve(request, true);
}
