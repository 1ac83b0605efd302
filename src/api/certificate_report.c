/* certificate_report.c: the report of a certificate, as JSON and CSV. Each request computes it from
 * the stored losses; for a running job, from the complete trials. */
#include "api/certificates.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "jobs/certificate_figures.h"
#include "rollout/physics.h"

/* ---- content ---- */

/* Returns the flags of a design at the base, and its largest measures there; NaN: unknown. */
static uint32_t flags_of(const struct mo_report *report, uint32_t design, double *peak_strain,
                         double *inverted_voxels)
{
  const uint32_t n = report->trials[0].n_environments;
  uint32_t flags = 0;
  *peak_strain = *inverted_voxels = NAN;
  for (uint32_t k = 0; report->measures != NULL && k < n; k++) {
    const double *measures = report->measures[(size_t)design * n + k];
    flags |= mo_measures_flags(measures);
    *peak_strain = fmax(*peak_strain, measures[MO_MEASURE_PEAK_STRAIN]);
    *inverted_voxels = fmax(*inverted_voxels, measures[MO_MEASURE_INVERTED_VOXELS]);
  }
  return flags;
}

/* ---- JSON ---- */

static void write_interval(struct mo_text *text, const char *name,
                           const struct mo_interval *interval)
{
  if (!isfinite(interval->lo) || !isfinite(interval->hi)) {
    mo_text_member(text, name, NULL);
    return;
  }
  const double ends[2] = {interval->lo, interval->hi};
  mo_member_numbers(text, name, ends, 2);
}

static void write_level_name(struct mo_text *text, const struct mo_trial *trial)
{
  mo_text_member(text, "axis", mo_axis_words[trial->axis]);
  mo_text_member_number(text, "level", trial->level);
}

static void write_level(struct mo_text *text, const struct mo_report *report, uint32_t t)
{
  const struct mo_trial *trial = &report->trials[t];
  const struct mo_trial_list *list = &report->lists[t];
  const bool is_double = trial->precision == MO_FLOAT64;
  mo_text_object(text);
  write_level_name(text, trial);
  mo_text_member_count(text, "environments", trial->n_environments);
  mo_text_member(text, "precision", is_double ? "float64" : "float32");
  mo_text_member(text, "fingerprint", report->classes.fingerprint[is_double]);
  mo_text_member_number(text, "mean_score", list->mean_score);
  mo_text_member_count(text, "diverged_designs", list->n_diverged_designs);
  mo_text_member_number(text, "tau", list->tau);
  write_interval(text, "tau_interval", &list->of_tau);
  mo_text_member_number(text, "regret", list->regret);
  mo_text_member_number(text, "top_score", list->top_score);
  mo_text_add(text, "}");
}

static void write_score(struct mo_text *text, const struct mo_trial_score *score)
{
  mo_text_object(text);
  mo_text_member_number(text, "score", score->score);
  write_interval(text, "interval", &score->interval);
  mo_text_member_number(text, "change", score->change);
  write_interval(text, "change_interval", &score->of_change);
  mo_text_member_count(text, "rank", score->rank);
  mo_text_member_count(text, "diverged", score->diverged);
  mo_text_add(text, "}");
}

static struct mo_genotype form_of(const struct mo_genotype *genotype)
{
  struct mo_genotype form = *genotype;
  mo_genotype_canonical(genotype->workspace, genotype->words, form.words);
  return form;
}

/* Writes a verdict in brief: its class, whether the rank is roughly kept on the finest steps, and
 * the axes at whose levels the design is worse. */
static void write_brief(struct mo_text *text, const struct mo_report *report, uint32_t d)
{
  const struct mo_verdict brief =
      mo_certificate_brief(report->trials, report->n_trials, report->scores, report->n_designs, d);
  mo_text_member(text, "class", mo_verdict_words[brief.class]);
  mo_text_name(text, "numerics");
  if (brief.finest > 0) {
    const struct mo_trial_score *there =
        &report->scores[(size_t)brief.finest * report->n_designs + d];
    mo_text_object(text);
    mo_text_member(text, "axis", mo_axis_words[report->trials[brief.finest].axis]);
    mo_text_member_bool(text, "kept", brief.is_kept);
    mo_text_member_count(text, "rank", there->rank);
    mo_text_member_count(text, "diverged", there->diverged);
    mo_text_add(text, "}");
  } else {
    mo_text_add(text, "null");
  }
  mo_text_open(text, "worse", "[");
  for (unsigned axis = 0; axis < MO_AXES; axis++)
    if (brief.worse >> axis & 1) {
      mo_text_next(text);
      mo_text_format(text, "\"%s\"", mo_axis_words[axis]);
    }
  mo_text_add(text, "]");
}

static void write_design(struct mo_text *text, const struct mo_report *report, uint32_t d)
{
  const struct mo_genotype genotype = mo_genotype_of(MO_STORE_WORKSPACE, &report->genotypes[d]),
                           form = form_of(&genotype);
  const struct mo_trial_score *base = &report->scores[d];
  char verdict[MO_VERDICT_MAX];
  double peak_strain, inverted_voxels;
  const uint32_t flags = flags_of(report, d, &peak_strain, &inverted_voxels);
  mo_certificate_verdict(report->trials, report->n_trials, report->scores, report->n_designs, d,
                         flags, verdict);
  mo_text_object(text);
  mo_member_form(text, "id", &form);
  mo_text_name(text, "design");
  mo_text_add(text, "\"");
  mo_robot_write(text, &genotype);
  mo_text_add(text, "\"");
  mo_text_member_count(text, "rank", base->rank);
  mo_text_member_number(text, "score", base->score);
  write_interval(text, "interval", &base->interval);
  mo_member_flags(text, flags);
  mo_text_member_number(text, "peak_strain", peak_strain);
  mo_text_member_number(text, "inverted_voxels", inverted_voxels);
  mo_text_member(text, "verdict", verdict);
  write_brief(text, report, d);
  mo_text_open(text, "levels", "[");
  for (uint32_t t = 0; t < report->n_trials; t++)
    write_score(text, &report->scores[(size_t)t * report->n_designs + d]);
  mo_text_add(text, "]}");
}

static void write_report(struct mo_text *text, const struct mo_report *report)
{
  const struct mo_job *job = &report->status.job;
  const struct mo_certificate_record *record = &report->status.record;
  char verdict[MO_VERDICT_MAX];
  mo_certificate_list_verdict(report->trials, report->n_trials, report->lists, report->n_designs,
                              verdict);
  mo_text_object(text);
  mo_text_member_id(text, "id", job->id);
  mo_text_member_bool(text, "complete", report->n_trials == record->n_trials);
  mo_member_controller(text, "controller", true, job->controller_name, &job->controller_sha256);
  mo_member_environments(text, job->environment_set, job->n_environments);
  mo_text_name(text, "physics");
  mo_fields_write_object(text, &mo_physics_fields, &job->physics);
  mo_text_member_count(text, "seed", record->settings.seed);
  mo_text_member_count(text, "top", mo_certificate_top(&record->settings, report->n_designs));
  mo_text_member_count(text, "n_designs", report->n_designs);
  mo_members_axes(text, &record->settings, &report->base);
  mo_text_member(text, "verdict", verdict);
  mo_text_open(text, "levels", "[");
  for (uint32_t t = 0; t < report->n_trials; t++)
    write_level(text, report, t);
  mo_text_add(text, "]");
  mo_text_open(text, "designs", "[");
  for (uint32_t d = 0; d < report->n_designs; d++)
    write_design(text, report, d);
  mo_text_add(text, "]}");
}

/* ---- CSV ---- */

static void add_number(struct mo_text *text, double number)
{
  mo_text_add(text, ",");
  if (isfinite(number))
    mo_text_json_number(text, number);
}

static void add_interval(struct mo_text *text, const struct mo_interval *interval)
{
  add_number(text, interval->lo);
  add_number(text, interval->hi);
}

static void add_row(struct mo_text *text, const struct mo_report *report, uint32_t t, uint32_t d)
{
  const struct mo_trial *trial = &report->trials[t];
  const struct mo_trial_score *score = &report->scores[(size_t)t * report->n_designs + d];
  mo_text_format(text, ",%s", mo_axis_words[trial->axis]);
  add_number(text, trial->level);
  mo_text_format(text, ",%u,%s", (unsigned)trial->n_environments,
                 trial->precision == MO_FLOAT64 ? "float64" : "float32");
  add_number(text, score->score);
  add_interval(text, &score->interval);
  add_number(text, score->change);
  add_interval(text, &score->of_change);
  mo_text_format(text, ",%u,%u\n", (unsigned)score->rank, (unsigned)score->diverged);
}

static void write_csv(struct mo_text *text, const struct mo_report *report)
{
  mo_text_add(text, "id,robot,axis,level,environments,precision,score,score_low,score_high,change,"
                    "change_low,change_high,rank,diverged\n");
  for (uint32_t d = 0; d < report->n_designs; d++) {
    const struct mo_genotype genotype = mo_genotype_of(MO_STORE_WORKSPACE, &report->genotypes[d]),
                             form = form_of(&genotype);
    for (uint32_t t = 0; t < report->n_trials; t++) {
      mo_text_add(text, "d");
      mo_form_write(text, &form);
      mo_text_add(text, ",");
      mo_robot_write(text, &genotype);
      add_row(text, report, t, d);
    }
  }
}

/* ---- replies ---- */

/* type NULL: JSON. */
static void reply(struct mo_request *request,
                  void (*write)(struct mo_text *text, const struct mo_report *report),
                  const char *type)
{
  struct mo_text text = {0};
  struct mo_report report;
  int64_t id;
  if (!mo_path_job(request, &id))
    return;
  int error = mo_report_load(mo_api_of(request)->store, id, &report);
  const enum mo_job_state state = report.status.job.state;
  if (error == MO_OK)
    write(&text, &report);
  mo_report_free(&report);
  if (error == MO_OK && text.failed)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_ERR_EMPTY) {
    mo_reply_problem(request, 409, NULL,
                     "The certificate is %s and has no complete trial yet; its report is available "
                     "once all designs are scored in the base.",
                     mo_job_state_name(state));
  } else if (error != MO_OK || type == NULL) {
    mo_reply_text(request, error, &text, "certificate");
  } else {
    mo_reply_bytes(request, 200, type, text.data, text.size);
    mo_reply_etag_of_body(request);
  }
}

void mo_api_get_certificate_report(struct mo_request *request)
{
  reply(request, write_report, NULL);
}

void mo_api_get_certificate_csv(struct mo_request *request)
{
  reply(request, write_csv, "text/csv; charset=utf-8");
}
