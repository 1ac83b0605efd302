/* training_bodies.c: the designs of a training run that finetunes each one separately: their scores
 * before and after, and how well the scores before predict those after. */
#include <math.h>
#include <stdlib.h>

#include "api/handlers.h"
#include "api/job_json.h"
#include "api/jobs.h"
#include "certificate/statistics.h"
#include "store/training_bodies.h"

/* ---- rows ---- */

static void write_controller(struct mo_text *text, const struct mo_training_status *status,
                             const struct mo_training_body *body)
{
  char made[MO_MADE_BYTES], name[MO_NAME_BYTES_MAX + 1] = "";
  if (body->is_kept)
    snprintf(name, sizeof(name), "%s-%u", mo_result_name(&status->job, status->record.name, made),
             (unsigned)body->position);
  mo_member_controller(text, "controller", true, name, &body->controller_sha256);
}

static int write_body(struct mo_text *text, const struct mo_lattice *lattice,
                      const struct mo_training_status *status, const struct mo_training_body *body)
{
  const struct mo_genotype form = mo_genotype_of(lattice->workspace, &body->form),
                           genotype = mo_genotype_of(lattice->workspace, &body->genotype);
  struct mo_design_size size;
  const int error = mo_design_size(lattice, genotype.words, &size);
  if (error != MO_OK)
    return error;
  mo_text_next(text);
  mo_text_format(text, "{\"position\":%u", (unsigned)body->position);
  mo_member_form(text, "id", &form);
  mo_member_robot(text, &genotype);
  mo_member_genotype(text, "genotype", &genotype);
  mo_text_member_count(text, "voxels", size.voxels);
  if (status->record.sample.atlas[0] != '\0')
    mo_text_member_count(text, "place",
                         mo_atlas_sample_place(&status->record.sample, body->position));
  mo_text_member_number(text, "zero_shot", body->zero_shot);
  mo_text_member_number(text, "finetuned", body->finetuned);
  mo_text_member_number(text, "gain", body->zero_shot - body->finetuned);
  mo_text_member_count(text, "zero_shot_diverged", body->zero_shot_diverged);
  mo_text_member_count(text, "finetuned_diverged", body->finetuned_diverged);
  mo_text_member_number(text, "first_loss", body->first_loss);
  mo_text_member_number(text, "last_loss", body->last_loss);
  mo_text_member_count(text, "skipped", body->skipped);
  write_controller(text, status, body);
  mo_text_add(text, "}");
  return MO_OK;
}

/* ---- the summary ---- */

static void write_interval(struct mo_text *text, const char *name,
                           const struct mo_interval *interval)
{
  if (isfinite(interval->lo) && isfinite(interval->hi))
    mo_member_numbers(text, name, (const double[]){interval->lo, interval->hi}, 2);
  else
    mo_text_member(text, name, NULL);
}

/* pairs: (n) scores before, (n) after. numbers: (3 n). */
static void write_pairs(struct mo_text *text, const double *pairs, uint32_t n, double *numbers)
{
  const double *before = pairs, *after = pairs + n;
  double *gains = numbers, *scratch = numbers + n;
  struct mo_kendall kendall = {.n_designs = n, .without = numbers + 2 * (size_t)n};
  struct mo_interval of_tau = MO_UNKNOWN_INTERVAL, of_gain = MO_UNKNOWN_INTERVAL;
  struct mo_mean gain = {.mean = NAN};
  uint32_t improved = 0;
  for (uint32_t i = 0; i < n; i++) {
    gains[i] = before[i] - after[i];
    improved += gains[i] > 0;
  }
  if (n > 0) {
    mo_kendall_add(&kendall, before, after);
    of_tau = mo_kendall_interval(&kendall);
    gain = mo_mean_of_units(gains, n, n, scratch);
    of_gain = mo_mean_interval(&gain, 1);
  }
  mo_text_member_number(text, "tau", mo_kendall_tau(&kendall));
  write_interval(text, "tau_interval", &of_tau);
  mo_text_member_number(text, "mean_zero_shot", n > 0 ? mo_pairwise_sum(before, n) / n : NAN);
  mo_text_member_number(text, "mean_finetuned", n > 0 ? mo_pairwise_sum(after, n) / n : NAN);
  mo_text_member_number(text, "mean_gain", gain.mean);
  write_interval(text, "mean_gain_interval", &of_gain);
  mo_text_member_count(text, "improved", improved);
}

static int write_summary(struct mo_text *text, struct mo_store *store,
                         const struct mo_training_status *status)
{
  double *pairs = NULL, *numbers = NULL;
  uint32_t n = 0;
  int error = mo_store_training_pairs(store, status->job.id, &pairs, &n);
  if (error == MO_OK)
    numbers = calloc(3 * (size_t)n + 1, sizeof(*numbers));
  if (error == MO_OK && numbers == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK) {
    mo_text_open(text, "summary", "{");
    mo_text_member_count(text, "bodies", status->record.n_designs);
    mo_text_member_count(text, "bodies_done", status->bodies_done);
    mo_text_member_count(text, "compared", n);
    write_pairs(text, pairs, n, numbers);
    mo_text_add(text, "}");
  }
  free(numbers);
  free(pairs);
  return error;
}

/* ---- the reply ---- */

/* Only the first page has the summary, because computing it takes time that grows with the square
 * of the number of designs: half a second for 10,000. */
static int write_page(struct mo_api *api, struct mo_text *text,
                      const struct mo_training_status *status, int64_t after, int64_t limit)
{
  struct mo_training_body *rows = malloc((size_t)limit * sizeof(*rows));
  const int64_t n = rows == NULL ? MO_ERR_NO_MEMORY
                                 : mo_store_training_bodies(api->store, status->job.id, after, rows,
                                                            (size_t)limit);
  int error = n < 0 ? (int)n : MO_OK;
  mo_text_add(text, "{\"items\":[");
  for (int64_t i = 0; i < n && error == MO_OK; i++)
    error = write_body(text, api->lattice, status, &rows[i]);
  mo_text_add(text, "]");
  if (n > 0 && n == limit)
    mo_text_member_id(text, "next_cursor", rows[n - 1].position);
  else
    mo_text_member(text, "next_cursor", NULL);
  if (error == MO_OK && after < 0)
    error = write_summary(text, api->store, status);
  else
    mo_text_member(text, "summary", NULL);
  mo_text_add(text, "}");
  free(rows);
  return error;
}

void mo_api_get_training_each(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_training_status status;
  struct mo_text text = {0};
  int64_t id, after = -1, limit = MO_PAGE_MAX;
  if (!mo_query_number(request, "limit", 1, MO_PAGE_MAX, &limit) ||
      !mo_query_cursor(request, &after) || !mo_path_job(request, &id))
    return;
  int error = mo_store_training(api->store, id, &status);
  if (error == MO_OK && !status.record.each) {
    mo_reply_problem(request, 404, NULL,
                     "The training run makes one controller for all of its bodies; only a "
                     "finetuning run with \"each\": true makes one per design.");
    return;
  }
  if (error == MO_OK)
    error = write_page(api, &text, &status, after, limit);
  mo_reply_text(request, error, &text, "training");
}
