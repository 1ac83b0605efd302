/* certificate_figures.c: see certificate_figures.h. */
#include "jobs/certificate_figures.h"

#include <stdlib.h>
#include <string.h>

#include "store/worlds.h"

void mo_report_free(struct mo_report *report)
{
  for (uint32_t t = 0; report->losses != NULL && t < report->n_trials; t++)
    free(report->losses[t]);
  free(report->losses);
  free(report->measures);
  free(report->scores);
  free(report->lists);
  free(report->trials);
  free(report->genotypes);
  mo_environments_free(report->environments, report->base.n_environments);
}

/* Reads the losses of the trial t. */
static int load_losses(struct mo_store *store, struct mo_report *report, uint32_t t)
{
  const struct mo_trial *trial = &report->trials[t];
  const size_t n = (size_t)report->n_designs * trial->n_environments;
  report->losses[t] = malloc(n * sizeof(**report->losses));
  if (t == 0 && trial->measures)
    report->measures = malloc(n * sizeof(*report->measures));
  if (report->losses[t] == NULL || (t == 0 && trial->measures && report->measures == NULL))
    return MO_ERR_NO_MEMORY;
  return mo_store_certificate_losses(store, report->status.job.id, t, report->n_designs,
                                     trial->n_environments, report->losses[t],
                                     t == 0 ? report->measures : NULL);
}

static int compute(struct mo_report *report)
{
  report->scores =
      calloc((size_t)report->n_trials * report->n_designs + 1, sizeof(*report->scores));
  report->lists = calloc((size_t)report->n_trials + 1, sizeof(*report->lists));
  if (report->scores == NULL || report->lists == NULL)
    return MO_ERR_NO_MEMORY;
  return mo_certificate_figures(&report->status.record.settings, report->trials, report->n_trials,
                                (const float *const *)report->losses, report->n_designs,
                                report->scores, report->lists);
}

/* Determines why a complete trial has no losses: since its state was read, the job has begun again
 * under different code, or has been deleted; otherwise, the losses are lost. */
static int explain_loss(struct mo_store *store, const struct mo_report *report)
{
  struct mo_certificate_status now;
  const int error = mo_store_certificate(store, report->status.job.id, &now);
  if (error != MO_OK)
    return error;
  return now.record.trials_done < report->status.record.trials_done ? MO_ERR_EMPTY : MO_ERR_CORRUPT;
}

int mo_report_load(struct mo_store *store, int64_t id, struct mo_report *report)
{
  memset(report, 0, sizeof(*report));
  int error = mo_store_certificate(store, id, &report->status);
  if (error == MO_OK && report->status.record.trials_done == 0)
    error = MO_ERR_EMPTY;
  if (error == MO_OK)
    error = mo_store_job_designs(store, id, &report->genotypes, &report->n_designs);
  if (error == MO_OK)
    error = mo_store_certificate_base(store, &report->status, &report->environments, &report->base);
  if (error == MO_OK)
    error = mo_store_certificate_classes(store, id, &report->classes);
  if (error == MO_OK)
    error = mo_certificate_trials(&report->status.record.settings, &report->base, &report->trials,
                                  &report->n_trials);
  if (error == MO_OK && (report->n_trials != report->status.record.n_trials ||
                         report->n_designs != report->status.job.n_designs))
    error = MO_ERR_CORRUPT;
  if (error != MO_OK)
    return error;
  report->losses = calloc(report->n_trials, sizeof(*report->losses));
  if (report->losses == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t t = 0; t < report->status.record.trials_done && error == MO_OK; t++)
    error = load_losses(store, report, t);
  if (error == MO_ERR_NOT_FOUND)
    error = explain_loss(store, report);
  report->n_trials = report->status.record.trials_done;
  return error == MO_OK ? compute(report) : error;
}
